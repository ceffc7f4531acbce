"""The map's axes, and the part of the map that is kept. The data are rotated, so that the yaw of the map stays 0."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..errors import ConfigError, DataError
from ..graph.graph import Graph, PriorEdges
from ..grid.occupancy_grid import OccupancyGrid
from .estimate import Estimate, Task

ALIGNMENTS = ("odometry", "first-pose", "walls", "anchors")
"""odometry: the first pose is where the odometry began. first-pose: it is the origin, looking along x. walls: as
first-pose, turned by at most 45 degrees so that most walls run along x and y. anchors: the first placed anchor (by id) is
the origin and the last one lies along x."""

_BINS = 90
"""Of directions of walls, one degree each."""
_WIDTHS = np.radians([5.0, 2.0])
"""Of the kernels about their main direction, rad."""
_EDGE = 1e-6
"""Of a cell; a box that ends so near to the edge of one ends there. At coordinates of 5e6 m rounding is 2e-8 of one of 5 cm."""


def wall_direction(normals: Floats) -> float:
    """Return the angle of the walls' main direction, rad in (-pi/4, pi/4], by unit normals (n, 2) of wall pieces.

    Zeros are left out, and walls at right angles count as one direction. A kernel around the most frequent angle, tightened
    once, excludes oblique walls.

    Raises
    ------
    DataError : there are no normals.
    """
    normals = normals[np.hypot(normals[:, 0], normals[:, 1]) > 0.5]
    if not len(normals):
        raise DataError("no walls were seen to align the map with: set align to odometry or first-pose")
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    bins = np.bincount(((angle % (np.pi / 2)) / (np.pi / 2) * _BINS).astype(np.intp) % _BINS, minlength=_BINS)
    smooth = bins + np.roll(bins, 1) + np.roll(bins, -1)
    main = (int(np.argmax(smooth)) + 0.5) / _BINS * np.pi / 2
    for width in _WIDTHS:
        apart = _quarter(angle - main)
        weight = np.exp(-0.5 * (apart / width) ** 2)
        main += float(np.sum(weight * apart) / np.sum(weight))
    return float(_quarter(np.array(main)))


def _quarter(angle: Floats) -> Floats:
    """Return the angle moved into (-pi/4, pi/4]."""
    quarter = np.pi / 2
    return np.asarray(0.5 * quarter - np.remainder(0.5 * quarter - angle, quarter), dtype=np.float64)


def align_axes(estimate: Estimate, task: Task) -> Estimate:
    """Align the map's axes as the settings ask; walls are not needed after this."""
    motion = alignment_of(estimate, task)
    return replace(estimate, graph=moved(estimate.graph, motion), scans=None).with_hypotheses_moved(motion)


def alignment_of(estimate: Estimate, task: Task) -> Floats:
    """Return T_new_map (3,), the motion that aligns the map's axes as the settings ask."""
    graph, normals = estimate.graph, np.zeros((0, 2))
    if task.config.align == "walls" and estimate.scans is not None:
        clouds = estimate.scans.clouds
        normals = se2.rotate_each(graph.poses[:, 2], clouds.owner, clouds.normals)
    return alignment(task.config.align, graph, estimate.placed, normals)


def alignment(how: str, graph: Graph, placed: Bools, normals: Floats) -> Floats:
    """Return T_new_map (3,), the motion that turns the map frame of final estimates into the wished one, one of ALIGNMENTS.

    Parameters
    ----------
    placed : (a,) anchors whose position is known. normals : (n, 2) unit normals of wall pieces, map frame.

    Raises
    ------
    ConfigError : there is no such alignment.
    DataError : the recording lacks the data that the alignment needs.
    """
    if how == "odometry":
        return np.zeros_like(graph.poses[0])
    to_first = se2.inverse(graph.poses[0])
    if how == "first-pose":
        return to_first
    if how == "walls":
        turned = wall_direction(se2.rotate(to_first[2], normals))
        return se2.compose(np.array([0.0, 0.0, -turned]), to_first)
    if how == "anchors":
        indices = np.flatnonzero(placed)
        if len(indices) < 2:
            raise DataError("two placed anchors are needed to align the map with: set align to odometry or first-pose")
        first, last = graph.anchors[indices[0]], graph.anchors[indices[-1]]
        return se2.inverse(np.array([*first, np.arctan2(*(last - first)[::-1])]))
    raise ConfigError(f"unknown alignment {how!r}; choose one of {', '.join(ALIGNMENTS)}")


def moved(graph: Graph, T_new_map: Floats) -> Graph:
    """Return the graph in another map frame; priors on poses and anchors move along, so chi2 stays as it is."""
    if not np.any(T_new_map):
        return graph
    edges = tuple(_moved_prior(e, T_new_map) if isinstance(e, PriorEdges) else e for e in graph.edges)
    poses, anchors = se2.compose(T_new_map, graph.poses), se2.transform(T_new_map, graph.anchors)
    return replace(graph, poses=poses, anchors=anchors, edges=edges)


def _moved_prior(prior: PriorEdges, T_new_map: Floats) -> PriorEdges:
    if prior.block == "calibration":
        return prior
    back = se2.rotation(-T_new_map[2])
    if prior.block == "anchors":
        value, back = se2.transform(T_new_map, prior.value), back[:2, :2]
    else:
        value = se2.compose(T_new_map, prior.value)
    return replace(prior, value=value, sqrt_information=prior.sqrt_information @ back)


def cropped(grid: OccupancyGrid, box: tuple[float, float, float, float]) -> OccupancyGrid:
    """Return the part of a map whose cells lie in a box x0, y0, x1, y1, m, map frame.

    Raises
    ------
    ConfigError : the box is empty or lies outside the map.
    """
    x0, y0, x1, y1 = box
    geometry = grid.geometry
    low = np.clip(np.floor((np.array([x0, y0]) - geometry.origin) / geometry.resolution + _EDGE), 0, None).astype(np.intp)
    high = np.ceil((np.array([x1, y1]) - geometry.origin) / geometry.resolution - _EDGE).astype(np.intp)
    high = np.minimum(high, [geometry.cols, geometry.rows])
    if not np.all(high > low):
        (west, south), (east, north) = geometry.origin, geometry.corner
        raise ConfigError(
            f"a crop to {x0:g},{y0:g},{x1:g},{y1:g} holds no cell; "
            f"the map reaches from {west:.1f},{south:.1f} to {east:.1f},{north:.1f}"
        )
    cols, rows = slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
    part = geometry.window(rows.start, cols.start, rows.stop - rows.start, cols.stop - cols.start)
    return replace(grid, geometry=part, log_odds=grid.log_odds[rows, cols].copy())
