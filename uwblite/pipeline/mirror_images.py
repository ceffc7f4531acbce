"""Mirror images: anchors with a second place that explains their ranges, as a nearly straight path leaves it.

The bootstrap tests this with ranges along odometry that drifts. Here it is tested again along the final trajectory and with
the ranges' final noise, which contains the correlation of neighbouring errors: a curve, other anchors or the lidar decide then.
Where the lidar sees little, or there is none, the ranges have bent a straight trajectory to suit the place that was found; so
along straight ways the poses are free too.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats
from ..graph.calibration import BIAS, HEIGHT
from ..graph.graph import Graph, PriorEdges
from ..graph.range_edges import RangeEdges
from ..graph.solver import SolverConfig, optimize
from ..problem.alternatives import Alternative, EvidencePolicy, compared
from ..problem.evidence import log_density
from .estimate import Estimate, Task


@dataclass(frozen=True, slots=True)
class MirrorPolicy:
    """When two places are two, and when a path may bend to suit the other one."""

    apart: ClassVar[float] = 0.5
    """m between two places; nearer ones are the same."""
    pace: ClassVar[float] = 0.01
    """Share of the evidence that refutes by which a step has to make other places likelier: at a lower pace none of them
    becomes likely in a hundred steps."""
    straight: ClassVar[float] = 1.0
    """m across a path, rms, beyond which no odometry lets it bend into its mirror image."""
    bends: ClassVar[float] = 0.05
    """m, the noise of ranges; a path that a lidar holds to less suits no place beside those that given poses allow."""


def find_mirror_images(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with anchors ambiguous whose mirror image is not refuted, and no others."""
    ranges, bootstrap = estimate.ranges, estimate.bootstrap
    if ranges is None or bootstrap is None:
        return estimate
    free = bootstrap.placed & (np.bincount(ranges.anchor[ranges.alive], minlength=len(bootstrap.placed)) > 0)
    free &= ~estimate.graph.fixed_anchors
    if not free.any():
        return estimate
    config, (mirrored, straight), second = task.config.solver, _images(estimate, ranges), _second_places(estimate)
    present = _minimum(estimate.graph, ranges, free, estimate.graph.anchors, config)
    pace = MirrorPolicy.pace * EvidencePolicy.very_strong / (EvidencePolicy.very_strong - log_density(present))
    slow = replace(config, relative_decrease=max(config.relative_decrease, pace))
    log_odds, others = np.full(len(free), -np.inf), present.anchors.copy()
    for start in (mirrored, second):
        image = _minimum(estimate.graph, ranges, free, start, slow)
        odds = 0.5 * (_costs(present, ranges) - _costs(image, ranges))
        likelier = (np.hypot(*(image.anchors - present.anchors).T) > MirrorPolicy.apart) & (odds > log_odds)
        log_odds, others = np.where(likelier, odds, log_odds), np.where(likelier[:, None], image.anchors, others)
    possible, best = log_odds > -EvidencePolicy.very_strong, estimate.graph
    second_known = bootstrap.ambiguous & np.any(second != best.anchors, axis=1)
    images = np.where(second_known[:, None], second, mirrored)
    bent = np.flatnonzero(free & ~possible & straight & (np.hypot(*(images - best.anchors).T) > MirrorPolicy.apart))
    if len(bent) and task.recordings.have_scans:
        # Anchors were estimated last and alone, and all together may be better.
        best = optimize(best, config)[0]
    for k in bent.tolist():
        other = _along_another_path(best, ranges, k, images[k], task)
        if other is not None:
            possible[k], others[k] = True, other
    if not task.recordings.have_scans and not possible[free].all() and possible[free].any():
        # The side of the anchor that seems clear may be that of all of them: the path and all anchors have a mirror image.
        whole = mirrored_whole(best, ranges, free, config)
        if whole is not None:
            others = np.where((free & ~possible)[:, None], whole.anchors, others)
            possible = free | possible
    ambiguous = np.where(free, possible, bootstrap.ambiguous)
    hypotheses = list(bootstrap.hypotheses)
    for k in np.flatnonzero(free & ambiguous).tolist():
        if hypotheses[k]:
            hypotheses[k] = (hypotheses[k][0], replace(hypotheses[k][0], position=others[k]))
    return replace(estimate, bootstrap=replace(bootstrap, ambiguous=ambiguous, hypotheses=tuple(hypotheses)))


def mirrored_whole(graph: Graph, ranges: RangeEdges, free: Bools, config: SolverConfig) -> Graph | None:
    """Return the optimum with all anchors on the other side of the path, which bends with them; None where it is refuted.

    Only the odometry's turns distinguish it from the given optimum, and along a nearly straight path they hardly do.

    Parameters
    ----------
    graph : with all measurements, at its optimum. free : (a,) anchors that may move.
    """
    tags = ranges.tag_positions(graph.poses)[ranges.alive]
    across = np.linalg.eigh(np.cov(tags.T))[1][:, 0]
    anchors = graph.anchors.copy()
    anchors[free] -= 2.0 * ((anchors[free] - tags.mean(axis=0)) @ across)[:, None] * across

    image = compared(graph, Alternative(replace(graph, anchors=anchors)), lambda start: optimize(start, config)[0], log_density)
    if image is None or not image.open:
        return None
    apart = np.hypot(*(image.graph.anchors - graph.anchors)[free].T)
    return image.graph if apart.min(initial=np.inf) > MirrorPolicy.apart else None


def _along_another_path(best: Graph, ranges: RangeEdges, k: int, image: Floats, task: Task) -> Floats | None:
    """Return the other place (2,) that an anchor has where the path bends with it, None where there is none or it is refuted.

    Parameters
    ----------
    best : the graph at its optimum. image : (2,) where it is looked for, m.
    """
    anchors = best.anchors.copy()
    anchors[k] = image
    alternative, config = Alternative(replace(best, anchors=anchors)), task.config.solver
    other = compared(best, alternative, lambda start: optimize(start, config)[0], log_density)
    if other is None or not other.open:
        return None
    keyframes = ranges.pose[ranges.alive & (ranges.anchor == k)]
    bend = np.hypot(*(other.graph.poses - best.poses)[keyframes, :2].T).max(initial=0.0)
    stiff = task.recordings.have_scans and bend < MirrorPolicy.bends
    apart = np.hypot(*(other.graph.anchors[k] - best.anchors[k])) > MirrorPolicy.apart
    return None if stiff or not apart else np.asarray(other.graph.anchors[k])


def _images(estimate: Estimate, ranges: RangeEdges) -> tuple[Floats, Bools]:
    """Return the anchors (a, 2), m, each mirrored at the line that fits the tag's places best; and which anchors (a,) were
    measured from nearly a straight line alone."""
    anchors, tags = estimate.graph.anchors.copy(), ranges.tag_positions(estimate.graph.poses)
    straight = np.zeros(len(anchors), dtype=bool)
    for k in np.flatnonzero(estimate.placed).tolist():
        seen_from = tags[ranges.alive & (ranges.anchor == k)]
        variances, axes = np.linalg.eigh(np.cov(seen_from.T)) if len(seen_from) > 2 else (np.full(2, np.inf), np.zeros((2, 2)))
        straight[k] = variances[0] <= MirrorPolicy.straight**2
        if len(seen_from) > 2:
            anchors[k] -= 2.0 * axes[:, 0] * float(axes[:, 0] @ (anchors[k] - seen_from.mean(axis=0)))
    return anchors, straight


def _second_places(estimate: Estimate) -> Floats:
    """Return the anchors (a, 2), m, each at the other of the two places that the bootstrap found likeliest; where it found one,
    at its own.

    A few ranges from beside a straight way tilt the line that fits the tag's places, but not these.
    """
    assert estimate.bootstrap is not None
    anchors = estimate.graph.anchors.copy()
    for place, hypotheses in zip(anchors, estimate.bootstrap.hypotheses, strict=True):
        if len(hypotheses) > 1:
            # Later measurements may have moved the anchor from the first of the two places to the second.
            place[:] = max((each.position for each in hypotheses[:2]), key=lambda other: float(np.hypot(*(other - place))))
    return anchors


def _minimum(graph: Graph, ranges: RangeEdges, free: Bools, anchors: Floats, config: SolverConfig) -> Graph:
    """Return the graph with the free anchors (a,), biases and heights at their best near a start (a, 2), the poses fixed."""
    priors = (e for e in graph.edges if isinstance(e, PriorEdges) and e.block != "poses")
    fixed, poses = graph.fixed_calibration | ~graph.calibration.of_kinds(BIAS, HEIGHT), np.ones(len(graph.poses), dtype=bool)
    alone = replace(graph, anchors=anchors, edges=(*priors, ranges), fixed_poses=poses, fixed_anchors=~free)
    return optimize(replace(alone, fixed_calibration=fixed), config)[0]


def _costs(graph: Graph, ranges: RangeEdges) -> Floats:
    """Return the cost (a,) of each anchor's ranges, and of the priors of its bias and height.

    A range that counts a hundredth is no outlier at ten standard deviations: many of them together may exclude a place.
    """
    each = ranges.kernel.rho(ranges.residuals(graph)[:, 0] ** 2 * ranges.own_weights)
    costs: Floats = np.bincount(ranges.anchor, each, len(graph.anchors)).astype(np.float64)
    of_unknown = np.zeros(len(graph.calibration.values))
    for priors in graph.calibration_priors:
        np.add.at(of_unknown, priors.index, np.sum(priors.residuals(graph) ** 2, axis=1))
    for k in range(len(graph.anchors)):
        used = np.unique(ranges.calibration[ranges.anchor == k][:, 1:3])
        costs[k] += float(of_unknown[used[used >= 0]].sum())
    return costs
