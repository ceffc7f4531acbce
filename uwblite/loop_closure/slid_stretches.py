"""Stretches of the recording that closures shifted along a corridor: the odometry would have to jump there, and back again.

Doors and pillars repeat. Closures that confuse one with the next agree with each other, and a robust odometry allows jumps at
the two ends of the stretch that they move. A wheel may slip once; it does not slip back by the same distance metres later.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, connected
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges

NEAR = 4
"""Most keyframes that a scan edge of the same visit spans."""


@dataclass(frozen=True, slots=True)
class SlidPolicy:
    """Jumps of the odometry, and scan edges that exclude them."""

    jump: ClassVar[float] = 0.5
    """m; errors of one step of the odometry that are larger than noise."""
    torn: ClassVar[float] = 10.0
    """The same in standard deviations."""
    clear_place: ClassVar[float] = 0.05
    """Standard deviation up to which a scan edge fixes a place, m; none does along a bare corridor."""
    clear_heading: ClassVar[float] = 0.02
    """The same of a heading, rad."""
    directions: ClassVar[int] = 3
    """Directions of a pose."""
    agrees: ClassVar[float] = 4.0
    """Standard deviations within which a scan edge agrees with the map."""
    made_good: ClassVar[float] = 0.3
    """Share of a jump that may remain after the opposite jump."""


def jumps(wheels: OdometryEdges, graph: Graph) -> tuple[Ints, Floats]:
    """Return the steps (s,) at which the graph jumps from what the odometry counts and no scans measure it, and by what.

    Returns
    -------
    Rows of the odometry's edges (s,), and jumps (s, 2), m, in the map frame.
    """
    away = se2.between(graph.poses[wheels.i], graph.poses[wheels.j])[:, :2] - wheels.corrected(graph)[:, :2]
    off = np.abs(wheels.residuals(graph))[:, :2].max(axis=1, initial=0.0) > SlidPolicy.torn
    rows = np.flatnonzero(off & (np.hypot(away[:, 0], away[:, 1]) > SlidPolicy.jump) & (scans_fixing(graph)[wheels.i] == 0))
    return rows, se2.rotate(graph.poses[wheels.i[rows], 2], away[rows])


def scans_fixing(graph: Graph) -> Ints:
    """Return how many scan edges of the same visit fix, in all directions, the step from each keyframe (k,) and agree."""
    count = np.zeros(len(graph.poses) + 1, dtype=np.intp)
    for edges in graph.edges:
        if isinstance(edges, ScanEdges):
            good = (np.abs(edges.i - edges.j) <= NEAR) & (_fixed(edges) == SlidPolicy.directions) & _agrees(edges, graph)
            np.add.at(count, np.minimum(edges.i, edges.j)[good], 1)
            np.add.at(count, np.maximum(edges.i, edges.j)[good], -1)
    return np.cumsum(count)[:-1]


def directions_constrained(graph: Graph) -> Ints:
    """Return in how many directions, 0 to 3, the best scan edge of the same visit fixes the step from each keyframe (k,)."""
    constrained = np.zeros(len(graph.poses), dtype=np.intp)
    for edges in graph.edges:
        if isinstance(edges, ScanEdges):
            first, span = np.minimum(edges.i, edges.j), np.abs(edges.i - edges.j)
            agrees = (span <= NEAR) & _agrees(edges, graph)
            fixed = _fixed(edges)
            for k in range(NEAR):
                over = agrees & (span > k)
                np.maximum.at(constrained, first[over] + k, fixed[over])
    return constrained


def tied_parts(wheels: OdometryEdges, graph: Graph, least: int, sound: Bools) -> Ints:
    """Return the part (k,) of each keyframe: scan edges of any visits connect keyframes in `least` directions or more.

    Steps that such edges of the same visit span connect, too, and so do steps of the odometry that are sound (e,).
    """
    constrained = (directions_constrained(graph)[wheels.i] >= least) | sound
    i, j = [wheels.i[constrained]], [wheels.j[constrained]]
    for edges in graph.edges:
        if isinstance(edges, ScanEdges):
            good = (_fixed(edges) >= least) & _agrees(edges, graph)
            i.append(edges.i[good])
            j.append(edges.j[good])
    return connected(np.concatenate(i), np.concatenate(j), len(graph.poses))


def _agrees(edges: ScanEdges, graph: Graph) -> Bools:
    """Return which scan edges (e,) agree with the map."""
    return np.asarray(np.abs(edges.residuals(graph)).max(axis=1, initial=0.0) < SlidPolicy.agrees)


def _fixed(edges: ScanEdges) -> Ints:
    """Return in how many directions, 0 to 3, scan edges (e,) fix a pose."""
    information = np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information
    units = np.array([SlidPolicy.clear_place, SlidPolicy.clear_place, SlidPolicy.clear_heading])
    # With the limits as units, an eigenvalue is above 1 where its direction has a sigma below the limit.
    return np.asarray(np.sum(np.linalg.eigvalsh(information * np.outer(units, units)) > 1.0, axis=1))


def slid(graph: Graph) -> list[tuple[int, int, float]]:
    """Return stretches: first and last keyframe, and the jump at both ends, m."""
    found = []
    for wheels in (e for e in graph.edges if isinstance(e, OdometryEdges)):
        rows, by = jumps(wheels, graph)
        size = np.hypot(by[:, 0], by[:, 1])
        left = np.hypot(*(by[:-1] + by[1:]).T)
        for k in np.flatnonzero(left < SlidPolicy.made_good * np.maximum(size[:-1], size[1:])).tolist():
            found.append((int(wheels.j[rows[k]]), int(wheels.i[rows[k + 1]]), float(size[k])))
    return found


def moved_by(closures: RelativePoseEdges, graph: Graph) -> Floats:
    """Return for each closure (e,) the shift of the stretch that it connects with the rest, m; 0 = no shifted stretch."""
    by = np.zeros(len(closures))
    for first, last, size in slid(graph):
        inside = [(k >= first) & (k <= last) for k in (closures.i, closures.j)]
        by[inside[0] != inside[1]] = size
    return by
