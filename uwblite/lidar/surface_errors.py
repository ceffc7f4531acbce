"""Range errors that are constant for each surface, and their effect on poses.

A lidar's ranges have errors of one or two centimetres that depend on colour, material and temperature (Kneip et al.,
Characterization of the compact Hokuyo URG-04LX, ICRA 2009) and do not change. A wall moved by that much does no harm; but the
error lies along the ray, so that it bends the wall towards its oblique parts, and the bend moves with the robot. Along a
corridor whose two walls differ by 3 cm, each step of 0.25 m comes out turned by a quarter of a milliradian, always to the same
side: no residual shows it, and no number of pairs averages it out. Where the robot sees the wall again from elsewhere, or
has another measurement of its heading, scan edges contradict each other by it, and the error is estimated (graph/marginals.py).
"""

from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints, unique_rows
from ..graph.graph import Graph, whiten
from ..graph.marginals import CommonErrors
from ..graph.pose_edges import ScanEdges
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .joint_refinement import RefinementConfig
from .scan_matching import pair_points, shifts_by_range_error

_DEVICE = 0.010
"""Constant error of a lidar's ranges, m, by data sheets (10 mm for URG-04LX, 15 mm for LMS 200)."""
_SURFACE = 0.014
"""Constant error of one surface for each of the sizes below, m: together 20 mm, of the 10 to 40 mm of Kneip et al."""
_SIZES = (32.0, 8.0)
"""Correlation length of errors of surfaces, m: a wall as long as a corridor, a piece of furniture. The extent of one colour is
unknown: both have equal prior variances, which the recording may change (graph/variance_components.py)."""
_MOST = 64
"""Most places of one size; more would dominate the computing time. Larger places give larger stated errors."""


def with_range_errors(
    edges: ScanEdges, graph: Graph, clouds: Clouds, raster: CloudRasters, config: RefinementConfig
) -> ScanEdges:
    """Return the edges with their sensitivity to errors of ranges to surfaces."""
    points, gate = pair_points(clouds, edges.j, config.points), config.last_gate
    turn = graph.poses[edges.i, 2]
    shifts = shifts_by_range_error(clouds, raster, edges.i, edges.relative(graph), points, gate, gate / 3.0, turn)
    return replace(edges, by_surface=shifts)


def common_range_errors(graph: Graph) -> list[CommonErrors]:
    """Return the errors that scan edges have in common: of the device, and of surfaces by place and facing."""
    return [_common(e, graph) for e in graph.edges if isinstance(e, ScanEdges) and e.by_surface is not None]


def _common(edges: ScanEdges, graph: Graph) -> CommonErrors:
    """Return the errors of one table, those of each size numbered after those before."""
    assert edges.by_surface is not None
    shift = whiten(edges.sqrt_information, edges.by_surface.transpose(0, 2, 1)).transpose(0, 2, 1)
    edge, errors, count = np.arange(len(edges)), [np.zeros(len(edges), dtype=np.intp)], 1
    shifts, kind = [_DEVICE * shift.sum(axis=1)], [np.zeros(1, dtype=np.intp)]
    for number, size in enumerate(_SIZES):
        errors.append((count + 4 * _places(graph.poses[edges.i, :2], size)[:, None] + np.arange(4)).ravel())
        shifts.append(_SURFACE * shift.reshape(-1, 3))
        kind.append(np.full(int(errors[-1].max(initial=count)) + 1 - count, number + 1))
        count += len(kind[-1])
    own = np.concatenate([edge, *(np.repeat(edge, 4) for _ in _SIZES)])
    return CommonErrors(edges, own, np.concatenate(errors), np.concatenate(shifts), np.concatenate(kind))


def _places(xy: Floats, size: float) -> Ints:
    """Return the number (e,) of the square of this size in which each point (e, 2) lies; of larger ones if these are many."""
    while True:
        found, number = unique_rows(np.floor(xy / size))
        if len(found) <= _MOST:
            return number
        size *= 2.0
