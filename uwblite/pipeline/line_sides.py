"""Sides of a line of anchors: without a lidar, a trajectory may end in a poor local minimum.

Along a line of anchors, ranges do not show on which side of it a robot drives: each pass along a corridor fits on either side,
and only the odometry between the passes decides. An optimisation that started with one of them on the wrong side stays there,
and its covariance does not contain the other side. So wherever the trajectory comes near the line, all poses after this are put
on the other side once, and the same problem is solved from there; and again from each optimum found in this way.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, runs_of
from ..graph.graph import Graph
from ..graph.solver import SolverConfig, optimize
from ..problem.alternatives import Alternative, Explanation, explanations
from ..problem.evidence import log_density
from .estimate import Estimate, Task


@dataclass(frozen=True, slots=True)
class LinePolicy:
    """When anchors stand on a line, and when it matters on which side of it a robot drove."""

    across: ClassVar[float] = 1.0
    share: ClassVar[float] = 0.2
    """Standard deviation of the anchors across their line, m and as a share of that along it, up to which they stand on one."""
    all_but_one: ClassVar[int] = 5
    """Number of anchors from which on one of them may be off the line of the others."""
    near: ClassVar[float] = 0.7
    """m from the line up to which a trajectory may have changed sides."""
    ends: ClassVar[int] = 3
    """Poses at either end of a trajectory within which no change of sides is tried."""
    elsewhere: ClassVar[float] = 0.4
    """m rms between two trajectories from which on it matters which of them is true."""


def choose_side(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate of one recording after its first optimisation, at the best optimum; itself where no other is."""
    best, *others = sides(estimate.problem, estimate.placed, task.config.solver)
    return replace(estimate.with_estimates_of(best.graph), other_side=others[0].graph) if others else estimate


def sides(graph: Graph, placed: Bools, config: SolverConfig, further: Graph | None = None) -> list[Explanation]:
    """Return the explanations by other sides of the line of anchors, the likeliest first; the present one is among them.

    Parameters
    ----------
    graph : of one recording, optimised. placed : (a,) anchors that have a position. further : where to search as well.
    """

    def propose(explanation: Graph) -> list[Alternative]:
        starts = [further] if further is not None and explanation is graph else []
        return [Alternative(start) for start in (*starts, *mirrored_tails(explanation, placed))]

    return explanations(graph, propose, lambda start: optimize(start, config)[0], log_density)


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
    near = np.abs(off) < LinePolicy.near
    # A change of sides between two poses is near, too.
    near[1:] |= off[1:] * off[:-1] < 0.0
    times = [first + int(np.argmin(np.abs(off[first:last]))) for first, last in runs_of(near)]
    starts = []
    for k in times:
        if LinePolicy.ends <= k < len(off) - LinePolicy.ends:
            image = places[k:] - 2.0 * off[k:, None] * across
            poses = graph.poses.copy()
            poses[k:] = se2.compose(se2.align(places[k:], image), poses[k:])
            starts.append(replace(graph, poses=poses))
    return starts


def _line(anchors: Floats) -> tuple[Floats, Floats] | None:
    """Return the middle (2,) of the line on which the anchors (a, 2) stand, or all but one, and the direction across it."""
    every = np.arange(len(anchors))
    for some in [every, *(every[every != k] for k in every if len(every) >= LinePolicy.all_but_one)]:
        places = anchors[some]
        variances, axes = np.linalg.eigh(np.cov(places.T)) if len(places) > 1 else (np.ones(2), np.eye(2))
        across, along = np.sqrt(np.maximum(variances, 0.0))
        if across < min(LinePolicy.across, LinePolicy.share * along):
            return places.mean(axis=0), axes[:, 0]
    return None
