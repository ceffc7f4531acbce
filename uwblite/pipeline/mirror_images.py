"""Mirror ambiguity: anchors with a second place that explains their ranges, as a nearly straight path leaves it.

The bootstrap tests this with ranges along odometry that drifts. Here it is tested again along the final trajectory and with
the ranges' final noise, which contains the correlation of neighbouring errors: a curve, other anchors or the lidar decide then.
Where the lidar sees little, or there is none, the ranges have bent a straight trajectory to suit the place that was found; so
along straight ways the poses are free too.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats
from ..graph.calibration import BIAS, HEIGHT
from ..graph.graph import Graph, PriorEdges
from ..graph.range_edges import RangeEdges
from ..graph.solver import SolverConfig, optimize
from .estimate import Estimate, Task

_CLEAR = 30.0
"""Difference of chi2 between two places from which on the worse one is excluded. For noise alone 9 would be enough, but
poses that are off by decimetres, which chi2 does not contain, gave up to 11; the wrong side of a bent path gives hundreds."""
_LIKELIER = 10.0
"""The same where correlated ranges count once, three standard deviations: a hundred ranges that come along one aisle may
prefer the wrong side of it by 34, and by 1.3 as what they are worth. Where neither place was right it was 9, and the mirror
images of right places had 10 to 125. With poses free as well and a lidar that sees little, a wrong place was preferred by 6.9,
and right ones by 0.3, 5.3 and 13."""
_SLOW = 0.01 * _LIKELIER
"""Decrease of chi2 by a step that ends the search for other places once they are about as likely; where they cost more, in
proportion more: at this pace none of them becomes likely in a hundred steps."""
_APART = 0.5
"""Places nearer to each other than this are the same, m."""


def find_mirror_images(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with anchors ambiguous whose mirror image explains their ranges about as well, and no others."""
    ranges, found = estimate.ranges, estimate.bootstrap
    if ranges is None or found is None:
        return estimate
    free = found.placed & (np.bincount(ranges.anchor[ranges.alive], minlength=len(found.placed)) > 0)
    free &= ~estimate.graph.fixed_anchors
    if not free.any():
        return estimate
    images, config = _images(estimate, ranges), task.config.solver
    here = _minimum(estimate, ranges, free, estimate.graph.anchors, config)
    slow = max(config.relative_decrease, _SLOW / (here.chi2() + _CLEAR))
    there = _minimum(estimate, ranges, free, images, replace(config, relative_decrease=slow))
    apart = np.hypot(*(there.anchors - here.anchors).T)
    each, together = (_costs(there, ranges, w) - _costs(here, ranges, w) for w in (ranges.alive, ranges.own_weights))
    as_well = (apart > _APART) & ((each < _CLEAR) | (together < _LIKELIER))
    others = there.anchors
    best: Graph | None = None
    for k in np.flatnonzero(free & ~as_well & _straight(estimate, ranges)).tolist():
        best = best or _optimum(estimate, task)
        other = _along_another_path(best, ranges, k, images[k], task)
        if other is not None:
            as_well[k], others[k] = True, other
    if not task.recordings.have_scans and not as_well[free].all() and as_well[free].any():
        # The side of the anchor that seems clear may be that of all of them: the path and all anchors have a mirror image.
        image = mirrored_whole(_optimum(estimate, task), ranges, free, config)
        if image is not None:
            others = np.where((free & ~as_well)[:, None], image.anchors, others)
            as_well = free | as_well
    ambiguous = np.where(free, as_well, found.ambiguous)
    hypotheses = list(found.hypotheses)
    for k in np.flatnonzero(free & ambiguous).tolist():
        if hypotheses[k]:
            hypotheses[k] = (hypotheses[k][0], replace(hypotheses[k][0], position=others[k]))
    return replace(estimate, bootstrap=replace(found, ambiguous=ambiguous, hypotheses=tuple(hypotheses)))


def mirrored_whole(graph: Graph, ranges: RangeEdges, free: Bools, config: SolverConfig) -> Graph | None:
    """Return the optimum with all anchors on the other side of the path, which bends with them; None where it is excluded.

    Only the odometry's turns distinguish it from the given optimum, and along a nearly straight path they hardly do.

    Parameters
    ----------
    graph : with all measurements, at its optimum. free : (a,) anchors that may move.
    """
    tags = ranges.tag_positions(graph.poses)[ranges.alive]
    across = np.linalg.eigh(np.cov(tags.T))[1][:, 0]
    anchors = graph.anchors.copy()
    anchors[free] -= 2.0 * ((anchors[free] - tags.mean(axis=0)) @ across)[:, None] * across
    image = optimize(replace(graph, anchors=anchors), config)[0]
    apart = np.hypot(*(image.anchors - graph.anchors)[free].T)
    return None if image.chi2() - graph.chi2() >= _CLEAR or apart.min(initial=np.inf) < _APART else image


def _straight(estimate: Estimate, ranges: RangeEdges) -> Bools:
    """Return which anchors (a,) were measured from nearly a straight line alone."""
    tags = ranges.tag_positions(estimate.graph.poses)
    own = [tags[ranges.alive & (ranges.anchor == k)] for k in range(len(estimate.graph.anchors))]
    return np.array([len(t) > 2 and bool(np.linalg.eigvalsh(np.cov(t.T))[0] <= _STRAIGHT**2) for t in own], dtype=bool)


def _optimum(estimate: Estimate, task: Task) -> Graph:
    """Return the graph at its optimum: with a lidar, anchors were estimated last and alone, and all together may be better."""
    return optimize(estimate.graph, task.config.solver)[0] if task.recordings.have_scans else estimate.graph


def _along_another_path(best: Graph, ranges: RangeEdges, k: int, image: Floats, task: Task) -> Floats | None:
    """Return the other place (2,) that an anchor has where the path bends with it, None where there is none or it is excluded.

    Parameters
    ----------
    best : the graph at its optimum. image : (2,) where it is looked for, m.
    """
    if np.hypot(*(image - best.anchors[k])) < _APART:
        return None
    anchors = best.anchors.copy()
    anchors[k] = image
    found = optimize(replace(best, anchors=anchors), task.config.solver)[0]
    excluded = found.chi2() - best.chi2() >= (_LIKELIER if task.recordings.have_scans else _CLEAR)
    own = ranges.pose[ranges.alive & (ranges.anchor == k)]
    held = task.recordings.have_scans and np.hypot(*(found.poses - best.poses)[own, :2].T).max(initial=0.0) < _BENDS
    return None if excluded or held or np.hypot(*(found.anchors[k] - best.anchors[k])) < _APART else found.anchors[k]


_BENDS = 0.05
"""m, the noise of ranges; a path that a lidar holds to less suits no other place than the comparison at given poses allows."""
_STRAIGHT = 1.0
"""m across a path, rms, beyond which no odometry lets it bend into its mirror image."""


def _images(estimate: Estimate, ranges: RangeEdges) -> Floats:
    """Return the other place (a, 2) of each anchor to be tried, m: mirrored at the line that fits the tag's places best."""
    assert estimate.bootstrap is not None
    anchors, tags = estimate.graph.anchors.copy(), ranges.tag_positions(estimate.graph.poses)
    for k in np.flatnonzero(estimate.placed).tolist():
        own = tags[ranges.alive & (ranges.anchor == k)]
        found = estimate.bootstrap.hypotheses[k]
        if estimate.bootstrap.ambiguous[k] and len(found) > 1:
            # Later measurements may have moved the anchor from the first of the two places to the second.
            anchors[k] = max((each.position for each in found[:2]), key=lambda place: float(np.hypot(*(place - anchors[k]))))
        elif len(own) > 2:
            across = np.linalg.eigh(np.cov(own.T))[1][:, 0]
            anchors[k] -= 2.0 * across * float(across @ (anchors[k] - own.mean(axis=0)))
    return anchors


def _minimum(estimate: Estimate, ranges: RangeEdges, free: Bools, anchors: Floats, config: SolverConfig) -> Graph:
    """Return the graph with the free anchors (a,), biases and heights at their best near a start (a, 2), the poses fixed."""
    graph = estimate.graph
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(BIAS, HEIGHT)
    priors = tuple(e for e in graph.edges if isinstance(e, PriorEdges) and e.block != "poses")
    alone = Graph(graph.poses, anchors, priors, graph.calibration, np.ones(len(graph.poses), dtype=bool), ~free, fixed)
    return optimize(alone.with_edges(ranges), config)[0]


def _costs(graph: Graph, ranges: RangeEdges, worth: Floats | Bools) -> Floats:
    """Return the cost (a,) of each anchor's ranges with weights (m,), and of the priors of its bias and height.

    A range that counts a hundredth is no outlier at ten standard deviations: many of them together may exclude a place.
    """
    squared = ranges.residuals(graph)[:, 0] ** 2
    each = ranges.kernel.rho(squared * worth)
    costs: Floats = np.bincount(ranges.anchor, each, len(graph.anchors)).astype(np.float64)
    of_unknown = np.zeros(len(graph.calibration.values))
    for priors in graph.calibration_priors:
        np.add.at(of_unknown, priors.index, np.sum(priors.residuals(graph) ** 2, axis=1))
    for k in range(len(graph.anchors)):
        used = np.unique(ranges.calibration[ranges.anchor == k][:, 1:3])
        costs[k] += float(of_unknown[used[used >= 0]].sum())
    return costs
