"""Steps of the chain that scans do not fix, and what closures shift between two of them.

Doors and pillars repeat. Closures that confuse one with the next agree with each other, and a robust odometry allows jumps at
the two ends of the stretch that they move. A wheel may slip once; it does not slip back by the same distance metres later.
"""


import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..lidar.visibility import VisibilityPolicy
from .closures import LoopClosureConfig


class TiePolicy:
    """Scan edges that fix a step, and jumps of the odometry where none does."""

    near: int = 4
    """Most keyframes that a scan edge of the same visit spans."""
    another_visit: float = VisibilityPolicy.apart
    """Travelled distance between two visits, m."""
    clear: tuple[float, ...] = (0.05, 0.05, 0.02)
    """Standard deviations, m, m, rad, up to which a scan edge fixes a direction; none fixes the way along a bare corridor."""
    jump: float = 0.5
    torn: float = 10.0
    """m, and standard deviations, from which an error of one step of the odometry is more than noise."""
    made_good: float = 0.3
    """Share of a jump that may remain after the opposite jump."""


def steps_fixed(graph: Graph) -> Bools:
    """Return whether some scan edge of the same visit fixes the step from each keyframe (k,) in all directions."""
    count = np.zeros(len(graph.poses) + 1, dtype=np.intp)
    for edges in (e for e in graph.edges if isinstance(e, ScanEdges)):
        own = (np.abs(edges.i - edges.j) <= TiePolicy.near) & fixing(edges, graph)
        np.add.at(count, np.minimum(edges.i, edges.j)[own], 1)
        np.add.at(count, np.maximum(edges.i, edges.j)[own], -1)
    return np.asarray(np.cumsum(count)[:-1] > 0)


def fixing(edges: ScanEdges, graph: Graph) -> Bools:
    """Return which scan edges (e,) agree with the map and fix a pose in all directions."""
    agrees = np.abs(edges.residuals(graph)).max(axis=1, initial=0.0) < LoopClosureConfig.agrees
    information = np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information
    # With the limits as units, an eigenvalue is above 1 where its direction has a sigma below the limit.
    least = np.linalg.eigvalsh(information * np.outer(TiePolicy.clear, TiePolicy.clear))[:, 0]
    return np.asarray(agrees & (least > 1.0))


def jumps(wheels: OdometryEdges, graph: Graph) -> tuple[Ints, Floats]:
    """Return the steps (s,) at which the graph jumps from what the odometry counts and no scans measure it, and by what.

    Returns
    -------
    Rows of the odometry's edges (s,), and jumps (s, 2), m, in the map frame.
    """
    away = se2.between(graph.poses[wheels.i], graph.poses[wheels.j])[:, :2] - wheels.corrected(graph)[:, :2]
    off = np.abs(wheels.residuals(graph))[:, :2].max(axis=1, initial=0.0) > TiePolicy.torn
    off &= np.hypot(away[:, 0], away[:, 1]) > TiePolicy.jump
    rows = np.flatnonzero(off & ~steps_fixed(graph)[wheels.i])
    return rows, se2.rotate(graph.poses[wheels.i[rows], 2], away[rows])


def slid(graph: Graph) -> list[tuple[int, int, float]]:
    """Return stretches: first and last keyframe, and the jump at both ends, m."""
    found = []
    for wheels in (e for e in graph.edges if isinstance(e, OdometryEdges)):
        rows, by = jumps(wheels, graph)
        size = np.hypot(by[:, 0], by[:, 1])
        left = np.hypot(*(by[:-1] + by[1:]).T)
        for k in np.flatnonzero(left < TiePolicy.made_good * np.maximum(size[:-1], size[1:])).tolist():
            found.append((int(wheels.j[rows[k]]), int(wheels.i[rows[k + 1]]), float(size[k])))
    return found


def moved_by(closures: RelativePoseEdges, graph: Graph) -> Floats:
    """Return for each closure (e,) the shift of the stretch that it connects with the rest, m; 0 = no shifted stretch."""
    by = np.zeros(len(closures))
    for first, last, size in slid(graph):
        inside = [(k >= first) & (k <= last) for k in (closures.i, closures.j)]
        by[inside[0] != inside[1]] = size
    return by
