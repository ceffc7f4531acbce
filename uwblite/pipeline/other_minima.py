"""Search for a better optimum than that of the bootstrap: without a lidar, a trajectory may end in a poor local minimum.

Along a line of anchors, ranges do not show on which side of it a robot drives: each pass along a corridor fits on either side,
and only the odometry between the passes decides. An optimisation that started with one of them on the wrong side stays there,
and its covariance does not contain the other side. So wherever the trajectory comes near the line, all poses after this are put
on the other side once, and the same problem is solved from there; and again from each optimum found in this way.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, rms_length, runs_of
from ..errors import SolverError
from ..graph.graph import Graph
from ..graph.solver import SolverConfig, optimize
from .estimate import Estimate, Task

_ACROSS, _SHARE = 1.0, 0.2
"""Standard deviation of the anchors across their line, m and as a share of that along it, up to which they stand on one."""
_LEAST = 5
"""Number of anchors from which on one of them may be off the line of the others."""
_NEAR = 0.7
"""Distance from the line up to which a trajectory may have changed sides, m."""
_ENDS = 3
"""Poses at either end of a trajectory within which no change of sides is tried."""
_MOST = 4
"""Most optima from which the search is continued."""
_SAME = 0.1
"""Optima nearer to each other than this, m rms, count as one."""
_WORSE = 40.0
"""Difference of chi2 to the best from which on the search is not continued from an optimum."""


def at_best(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate of one recording after its first optimisation, at the best optimum; itself where no other is."""
    problem = estimate.graph.with_edges(*estimate.odometry_and_ranges)
    best, *others = minima(problem, estimate.placed, task.config.solver)
    return replace(estimate.with_estimates_of(best), other_minimum=others[0]) if others else estimate


def minima(graph: Graph, placed: Bools, config: SolverConfig, starts: Sequence[Graph] = ()) -> list[Graph]:
    """Return the optima that are found from a first one, the graph, which is among them, the best first.

    Parameters
    ----------
    graph : of one recording, optimised. placed : (a,) anchors that have a position. starts : where to search as well.
    """
    found, waiting = [graph], [graph]
    begin = list(starts)
    for _ in range(_MOST):
        if not waiting:
            break
        for start in [*begin, *mirrored_tails(waiting.pop(0), placed)]:
            try:
                there = optimize(start, config)[0]
            except SolverError:
                continue
            if all(apart(there, other) > _SAME for other in found):
                found.append(there)
                waiting.append(there)
        begin = []
        found.sort(key=Graph.chi2)
        waiting = sorted((other for other in waiting if other.chi2() < found[0].chi2() + _WORSE), key=Graph.chi2)
    return found


def mirrored_tails(graph: Graph, placed: Bools) -> list[Graph]:
    """Return the graph with the rest of its trajectory on the other side of the line of its anchors, from each time on at which
    it comes near that line; none where the anchors stand on no line.

    The rest is moved as a whole, to where it lies best on its mirror image: reflected, it would turn the other way.
    """
    line = _line(graph.anchors[placed])
    if line is None:
        return []
    places, (middle, across) = graph.poses[:, :2], line
    off = (places - middle) @ across
    near = np.abs(off) < _NEAR
    # A change of sides between two poses is near, too.
    near[1:] |= off[1:] * off[:-1] < 0.0
    times = [first + int(np.argmin(np.abs(off[first:last]))) for first, last in runs_of(near)]
    starts = []
    for k in times:
        if _ENDS <= k < len(off) - _ENDS:
            image = places[k:] - 2.0 * off[k:, None] * across
            poses = graph.poses.copy()
            poses[k:] = se2.compose(se2.align(places[k:], image), poses[k:])
            starts.append(replace(graph, poses=poses))
    return starts


def _line(anchors: Floats) -> tuple[Floats, Floats] | None:
    """Return the middle (2,) of the line on which the anchors (a, 2) stand, or all but one, and the direction across it."""
    every = np.arange(len(anchors))
    for some in [every, *(every[every != k] for k in every if len(every) >= _LEAST)]:
        own = anchors[some]
        variances, axes = np.linalg.eigh(np.cov(own.T)) if len(own) > 1 else (np.ones(2), np.eye(2))
        across, along = np.sqrt(np.maximum(variances, 0.0))
        if across < min(_ACROSS, _SHARE * along):
            return own.mean(axis=0), axes[:, 0]
    return None


def apart(one: Graph, other: Graph) -> float:
    """Return the rms distance of the poses of two graphs after alignment, m."""
    here, there = one.poses[:, :2], other.poses[:, :2]
    return rms_length(se2.transform(se2.align(there, here), there) - here)
