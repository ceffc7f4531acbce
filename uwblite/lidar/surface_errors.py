"""Errors of ranges that stay with surfaces, and what they do to covariances.

A lidar errs by one or two centimetres with paint, material and warmth (Kneip et al., Characterization of the compact Hokuyo
URG-04LX, ICRA 2009), the same in every scan. A wall moved by that much does no harm; but the error lies along the ray, so that
it bends the wall towards its oblique parts, and the bend travels with the robot. Along a corridor whose two walls differ by
3 cm, each step of 0.25 m comes out turned by a quarter of a milliradian, always to the same side: no residual shows it, and no
number of pairs averages it out.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..graph.graph import Graph, whiten
from ..graph.marginals import CommonErrors
from ..graph.pose_edges import ScanEdges
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .joint_refinement import RefinementConfig
from .scan_matching import pair_points, shifts_by_range_error

_ERRORS = ((np.inf, 0.010), (32.0, 0.014), (8.0, 0.014))
"""Size of what an error stays with, and its standard deviation, m: the device, by data sheets (10 mm for URG-04LX, 15 mm for
LMS 200), and surfaces, which err by 10 to 40 mm against each other (Kneip et al.), in equal parts a wall as long as a corridor
and a piece of furniture: how far paint stays the same is not known."""
_MOST = 64
"""Places of one size; more of them would cost more than all else, and larger ones state larger errors."""


def with_range_errors(
    edges: ScanEdges, graph: Graph, clouds: Clouds, raster: CloudRasters, config: RefinementConfig
) -> ScanEdges:
    """Return the edges with what errors of ranges to surfaces would do to them."""
    points, gate = pair_points(clouds, edges.j, config.points), config.last_gate
    turn = graph.poses[edges.i, 2]
    shifts = shifts_by_range_error(clouds, raster, edges.i, edges.relative(graph), points, gate, gate / 3.0, turn)
    return replace(edges, by_surface=shifts)


def common_range_errors(graph: Graph) -> list[CommonErrors]:
    """Return the errors that scan edges have in common: of the device, and of surfaces by place and by the way they face."""
    return [
        _of_size(edges, graph, size, sigma) for edges in graph.edges if isinstance(edges, ScanEdges) for size, sigma in _ERRORS
        if edges.by_surface is not None
    ]  # fmt: skip


def _of_size(edges: ScanEdges, graph: Graph, size: float, sigma: float) -> CommonErrors:
    assert edges.by_surface is not None
    shift = sigma * whiten(edges.sqrt_information, edges.by_surface.transpose(0, 2, 1)).transpose(0, 2, 1)
    edge = np.arange(len(edges))
    if not np.isfinite(size):
        return CommonErrors(edges, edge, np.zeros(len(edges), dtype=np.int64), shift.sum(axis=1))
    places = _places(graph.poses[edges.i, :2], size)
    error = 4 * places[:, None] + np.arange(4)
    return CommonErrors(edges, np.repeat(edge, 4), error.ravel(), shift.reshape(-1, 3))


def _places(xy: Floats, size: float) -> Ints:
    """Return the number (e,) of the square of this size in which each point (e, 2) lies; of larger ones if these are many."""
    while True:
        found, number = np.unique(np.floor(xy / size), axis=0, return_inverse=True)
        if len(found) <= _MOST:
            return np.asarray(number, dtype=np.int64).reshape(-1)
        size *= 2.0
