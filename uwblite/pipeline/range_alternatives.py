"""Other explanations of the same ranges: anchors that are high, another side of a line of anchors, mirror images of anchors.

**Heights**: slant ranges to high anchors look like a wrong unit of the odometry; anchors are low, or as high as in a large hall
and the wheels' unit is right.

**Sides**: along a line of anchors, ranges do not show on which side of it a robot drives; without a lidar only the odometry
between passes decides. An optimisation that started with one of them on the wrong side stays there, and its covariance does not
contain the other side. So wherever the trajectory comes near the line, the rest of it is put on the other side once.

**Mirror images**: a nearly straight path leaves an anchor a second place. They are tested along the final trajectory and with
the ranges' final noise: a curve, other anchors or the lidar decide then. Where the lidar sees little, or there is none, the
ranges have bent a straight trajectory to suit the place that was found; so along straight ways the poses are free too.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, runs_of
from ..graph.calibration import BIAS, HEIGHT, RADIO, CalibrationConfig, with_free
from ..graph.graph import Graph, PriorEdges
from ..graph.range_edges import RangeEdges
from ..graph.solver import Optimizer, SolverConfig, optimize
from ..problem.alternatives import EvidencePolicy, Explanation, apart, compared, explanations
from ..problem.evidence import laplace_marginal_likelihood, log_density, prior_sigma, with_prior_sigma
from ..problem.solution import comparable, solve
from .estimate import Estimate, OtherHeights, Task
from .mapping_config import MappingConfig


class RangePolicy:
    """When another explanation is worth proposing, and when it matters."""

    elsewhere: float = 0.4
    """m rms between two trajectories from which on it matters which of them is true."""
    wrong_noise: float = 10.0
    """Logarithm of odds between heights that wrong assumptions about the noise of ranges can cause."""
    noticeable: float = 1.0
    """m above the tag from which on anchors can look like another unit; lower ones lengthen short ranges only."""
    high: float = 6.0
    """m above the tag; anchors in a large hall."""
    across: float = 1.0
    share: float = 0.2
    """Standard deviation of the anchors across their line, m and as a share of that along it, up to which they stand on one."""
    all_but_one: int = 5
    """Number of anchors from which on one of them may be off the line of the others."""
    near: float = 0.7
    """m from the line up to which a trajectory may have changed sides."""
    ends: int = 3
    """Poses at either end of a trajectory within which no change of sides is tried."""
    pace: float = 0.01
    """Share of the evidence that refutes by which a step has to make other places likelier: at a lower pace none of them
    becomes likely in a hundred steps."""
    straight: float = 1.0
    """m across a path, rms, beyond which no odometry lets it bend into its mirror image."""
    bends: float = 0.05
    """m, the noise of ranges; a path that a lidar holds to less suits no place beside those that given poses allow."""


def choose_heights(estimate: Estimate, config: MappingConfig) -> Estimate:
    """Return the estimate under the likelier of low and high anchors, with the other one where it is not refuted.

    Recordings that were joined are tested alone first: only where they do not refute high anchors, all are solved together.
    """
    heights = estimate.graph.calibration.of_kinds(HEIGHT)
    if estimate.ranges is None or not heights.any() or _refuted(estimate.alone, config):
        return estimate
    low, optimizer = estimate.problem, Optimizer()
    if (high := _high_anchors(estimate, config, optimizer)) is None:
        return estimate
    height = float(np.sqrt(np.median(high.graph.calibration.values[heights])))
    if taken := high.log_odds > EvidencePolicy.positive:
        graph = replace(high.graph, edges=high.graph.edges[: len(estimate.graph.edges)])
        estimate = replace(estimate, graph=graph).solved(config.solver, optimizer)[0]
    if abs(high.log_odds) > _refuting() or height < RangePolicy.noticeable:
        return estimate
    return replace(estimate, other_heights=OtherHeights(height, taken, apart(low, high.graph)))


def _refuting() -> float:
    return EvidencePolicy.very_strong + RangePolicy.wrong_noise


def _high_anchors(estimate: Estimate, config: MappingConfig, optimizer: Optimizer) -> Explanation | None:
    """Return the explanation by high anchors, None where the measurements do not determine it or the present one."""

    def solved(graph: Graph) -> Graph:
        return solve(graph, comparable(config.solver), optimizer)[0]

    def evidence(graph: Graph) -> float:
        # Heights that were put back to 0 count as known no better than the others.
        return laplace_marginal_likelihood(with_free(graph, HEIGHT))

    present = estimate.problem
    return compared(present, raise_anchors(present, config.calibration), solved, evidence)


def raise_anchors(graph: Graph, config: CalibrationConfig) -> Graph:
    """Return the graph with priors under which the wheels' unit is right and the anchors are as high as in a large hall.

    As the start, lengths scaled by a wrong unit are scaled back; heights that were fixed at 0 are free again.
    """
    scales, heights = graph.calibration.of_kinds("odometry_scale"), graph.calibration.of_kinds(HEIGHT)
    stretched = 1.0 + float(np.mean(graph.calibration.values[scales])) if scales.any() else 1.0
    poses = np.column_stack([graph.poses[:, :2] / stretched, graph.poses[:, 2]])
    graph = graph.updated(poses, graph.anchors / stretched, np.where(scales, 0.0, graph.calibration.values))
    sigma = prior_sigma(graph)
    sigma[scales], sigma[heights] = config.odometry_scale, RangePolicy.high**2
    return with_prior_sigma(with_free(graph, *RADIO), sigma)


def _refuted(alone: Sequence[Estimate], config: MappingConfig) -> bool:
    """Return whether recordings (r,), each on its own, refute together that anchors are high.

    A recording whose anchors all occur in earlier ones is not tested; one that does not determine its anchors does not count.
    """
    log_odds, asked = 0.0, set[str]()
    for own in alone:
        if own.ranges is not None and own.graph.calibration.of_kinds(HEIGHT).any() and not asked.issuperset(own.anchor_ids):
            high = _high_anchors(own, config, Optimizer())
            if high is not None:
                log_odds += high.log_odds
                asked.update(own.anchor_ids)
    return log_odds < -_refuting()


def check_heights(estimate: Estimate, task: Task) -> None:
    """Note where the ranges do not decide how high the anchors are, and a map without lidar depends on it."""
    other = estimate.other_heights
    if other is not None and not task.recordings.have_scans and other.apart >= RangePolicy.elsewhere:
        task.stages.note("anchor-heights", height=other.high, taken=other.taken, apart=other.apart)


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

    def propose(explanation: Graph) -> list[Graph]:
        starts = mirrored_tails(explanation, placed)
        return [further, *starts] if further is not None and explanation is graph else starts

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
    near = np.abs(off) < RangePolicy.near
    # A change of sides between two poses is near, too.
    near[1:] |= off[1:] * off[:-1] < 0.0
    times = [first + int(np.argmin(np.abs(off[first:last]))) for first, last in runs_of(near)]
    starts = []
    for k in times:
        if RangePolicy.ends <= k < len(off) - RangePolicy.ends:
            poses = graph.poses.copy()
            poses[k:] = se2.compose(se2.align(places[k:], places[k:] - 2.0 * off[k:, None] * across), poses[k:])
            starts.append(replace(graph, poses=poses))
    return starts


def _line(anchors: Floats) -> tuple[Floats, Floats] | None:
    """Return the middle (2,) of the line on which the anchors (a, 2) stand, or all but one, and the direction across it."""
    every = np.arange(len(anchors))
    for some in [every, *(every[every != k] for k in every if len(every) >= RangePolicy.all_but_one)]:
        places = anchors[some]
        variances, axes = np.linalg.eigh(np.cov(places.T)) if len(places) > 1 else (np.ones(2), np.eye(2))
        across, along = np.sqrt(np.maximum(variances, 0.0))
        if across < min(RangePolicy.across, RangePolicy.share * along):
            return places.mean(axis=0), axes[:, 0]
    return None


def find_mirror_images(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with anchors ambiguous whose mirror image is not refuted, and no others."""
    ranges, bootstrap, config = estimate.ranges, estimate.bootstrap, task.config.solver
    if ranges is None or bootstrap is None:
        return estimate
    free = bootstrap.placed & (np.bincount(ranges.anchor[ranges.alive], minlength=len(bootstrap.placed)) > 0)
    free &= ~estimate.graph.fixed_anchors
    if not free.any():
        return estimate
    (mirrored, straight), second, best = _images(estimate, ranges), _second_places(estimate), estimate.graph
    present = _minimum(best, ranges, free, best.anchors, config)
    pace = RangePolicy.pace * EvidencePolicy.very_strong / (EvidencePolicy.very_strong - log_density(present))
    slow = replace(config, relative_decrease=max(config.relative_decrease, pace))
    log_odds, others = np.full(len(free), -np.inf), present.anchors.copy()
    for start in (mirrored, second):
        image = _minimum(best, ranges, free, start, slow)
        odds = 0.5 * (_costs(present, ranges) - _costs(image, ranges))
        likelier = _elsewhere(image.anchors, present.anchors) & (odds > log_odds)
        log_odds, others = np.where(likelier, odds, log_odds), np.where(likelier[:, None], image.anchors, others)
    possible = log_odds > -EvidencePolicy.very_strong
    second_known = bootstrap.ambiguous & np.any(second != best.anchors, axis=1)
    images = np.where(second_known[:, None], second, mirrored)
    bent = np.flatnonzero(free & ~possible & straight & _elsewhere(images, best.anchors))
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
    ambiguous, hypotheses = np.where(free, possible, bootstrap.ambiguous), list(bootstrap.hypotheses)
    for k in np.flatnonzero(free & ambiguous).tolist():
        if hypotheses[k]:
            hypotheses[k] = (hypotheses[k][0], replace(hypotheses[k][0], position=others[k]))
    return replace(estimate, bootstrap=replace(bootstrap, ambiguous=ambiguous, hypotheses=tuple(hypotheses)))


def _elsewhere(one: Floats, other: Floats) -> Bools:
    """Return which places (a, 2) are not those of others (a, 2)."""
    return np.asarray(np.hypot(*(one - other).T) > EvidencePolicy.same_anchor)


def _other_optimum(graph: Graph, anchors: Floats, config: SolverConfig) -> Graph | None:
    """Return the optimum with anchors (a, 2) elsewhere and a path that follows; None where it is refuted or the present one."""
    found = compared(graph, replace(graph, anchors=anchors), lambda start: optimize(start, config)[0], log_density)
    return found.graph if found is not None and found.open else None


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
    image = _other_optimum(graph, anchors, config)
    return image if image is not None and _elsewhere(image.anchors, graph.anchors)[free].all() else None


def _along_another_path(best: Graph, ranges: RangeEdges, k: int, image: Floats, task: Task) -> Floats | None:
    """Return the other place (2,) that anchor k has near its image (2,) where the path bends with it, if any."""
    anchors = best.anchors.copy()
    anchors[k] = image
    other = _other_optimum(best, anchors, task.config.solver)
    if other is None or not _elsewhere(other.anchors, best.anchors)[k]:
        return None
    keyframes = ranges.pose[ranges.alive & (ranges.anchor == k)]
    bend = np.hypot(*(other.poses - best.poses)[keyframes, :2].T).max(initial=0.0)
    return None if task.recordings.have_scans and bend < RangePolicy.bends else np.asarray(other.anchors[k])


def _images(estimate: Estimate, ranges: RangeEdges) -> tuple[Floats, Bools]:
    """Return the anchors (a, 2), m, each mirrored at the line that fits the tag's places best; and which anchors (a,) were
    measured from nearly a straight line alone."""
    anchors, tags = estimate.graph.anchors.copy(), ranges.tag_positions(estimate.graph.poses)
    straight = np.zeros(len(anchors), dtype=bool)
    for k in np.flatnonzero(estimate.placed).tolist():
        seen_from = tags[ranges.alive & (ranges.anchor == k)]
        if len(seen_from) > 2:
            variances, axes = np.linalg.eigh(np.cov(seen_from.T))
            straight[k] = variances[0] <= RangePolicy.straight**2
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
        used = np.unique(ranges.calibration[ranges.anchor == k][:, [1, 2]])
        costs[k] += float(of_unknown[used[used >= 0]].sum())
    return costs
