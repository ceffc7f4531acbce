"""Odometry and ranges: from dead reckoning to the first optimisation, and re-estimating the ranges later.

Each recording is bootstrapped on its own, then the recordings are joined. Once the lidar has stiffened the trajectory,
the ranges are re-estimated: their noise and the priors of their systematic errors. The prior of the wheels' scale is chosen
there too, also without ranges.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, spread
from ..graph import calibration
from ..graph.calibration import BIAS, ODOMETRY, OMNI, RADIO, RANGE_SCALE, with_free
from ..graph.graph import Graph, edge_cost
from ..graph.robust import SQUARED
from ..graph.solver import Optimizer, SolverSummary
from ..graph.work import Work
from ..odometry import gyro
from ..odometry.attached import attach_ranges
from ..odometry.slips import slipped, with_slips
from ..odometry.wheels import sideways_priors, variance_factors, wheel_edges
from ..problem.evidence import laplace_marginal_likelihood
from ..problem.solution import comparable, rough
from ..radio import bootstrap, prior_selection
from ..radio.bootstrap_attempt import Measured
from ..radio.line_of_sight import blocked
from ..radio.range_measurements import learn_noise, log_densities, range_edges
from ..radio.range_noise import RangeNoiseConfig, assumed, short_term_sigma
from . import joining, map_frame, range_alternatives
from .estimate import Estimate, Task
from .mapping_config import MappingConfig
from .progress import solver_figures
from .recordings import Recording


class LapPolicy:
    """How ranges and path are estimated in turn."""

    laps: int = 4
    """Laps of the first optimisation: each estimates noise and optimises the graph; in the last one the radio's calibration is
    free too."""
    most_growth: float = 1.3
    """Factor by which a typical anchor's scatter grows at most with weaker ranges, where the lidar constrains the poses."""


def first_optimisation(task: Task) -> Estimate:
    """Bootstrap each recording, join them and optimise odometry and ranges (paper: first optimisation)."""
    recordings = task.recordings
    task.stages.end("keyframes", keyframes=len(recordings.stamps), travelled=recordings.travelled)
    estimates = [dead_reckoning(recording, task.config, task.stages.work) for recording in recordings.each]
    ranges = sum(len(estimate.ranges) for estimate in estimates if estimate.ranges is not None)
    task.stages.end("edges", odometry=sum(len(estimate.odometry) for estimate in estimates), ranges=ranges)
    estimates = [_optimised(bootstrapped(estimate, n, task), task) for n, estimate in enumerate(estimates)]
    if len(estimates) == 1:
        return range_alternatives.choose_heights(estimates[0], task.config)
    joined = _optimised(replace(joining.join(estimates, recordings), alone=tuple(estimates)), task)
    return range_alternatives.choose_heights(joined, task.config)


def dead_reckoning(recording: Recording, config: MappingConfig, work: Work | None = None) -> Estimate:
    """Return a recording's graph by dead reckoning, with its calibration priors, odometry edges and range edges."""
    log, frames, ids = recording.log, recording.frames, recording.anchor_ids
    priors, noise = gyro.settings(log, sideways_priors(log.odometry, config.calibration), config.odometry)
    listed = calibration.unknowns(priors, ids, heights_given(recording), rises=tag_rises(recording))
    block = calibration.block(listed)
    graph = Graph(frames.odometry.copy(), np.zeros((len(ids), 2)), (), block, work=Work() if work is None else work)
    graph = graph.with_edges(calibration.prior_edges(listed))
    graph = replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool))
    graph = with_free(graph, *ODOMETRY, *OMNI, BIAS, RANGE_SCALE)
    odometry = wheel_edges(frames, noise, block)
    if log.ranges is None:
        return Estimate(graph, odometry, None, ids)
    attached = attach_ranges(log.ranges, log.odometry, frames, log.mounting)
    ranges = range_edges(attached, ids, log.mounting, block, config.ranges, config.trilateration.max_range)
    return Estimate(graph, odometry, ranges if np.any(ranges.weights) else None, ids)


def tag_rises(recording: Recording) -> tuple[float, ...]:
    """Return the height of each of a robot's tags above the first tag, m."""
    heights = recording.log.mounting.tags[:, -1]
    return tuple((heights - heights[0]).tolist())


def heights_given(recording: Recording) -> Bools:
    """Return which of a recording's anchors (a,) have a given height above the tag."""
    heights = [recording.log.mounting.height_difference(a) for a in recording.anchor_ids]
    return np.array([height is not None for height in heights], dtype=bool)


def bootstrapped(estimate: Estimate, number: int, task: Task) -> Estimate:
    """Find trajectory and anchors of one recording without any guess of the anchors.

    The radio is taken for calibrated until the last lap: noise that is learnt under wide priors justifies them.
    """
    ranges, recordings, config = estimate.ranges, task.recordings, task.config
    if ranges is None:
        return estimate
    estimate = replace(estimate, graph=prior_selection.with_calibrated_radio(estimate.graph, config.calibration))
    path = recordings.path[recordings.each[number].rows]
    used = ranges.alive
    sigma = short_term_sigma(ranges.stamps[used], ranges.anchor[used], ranges.ranges[used], config.ranges)
    # Differences of neighbours do not show the part of the errors that lasts.
    sigma = float(np.hypot(sigma, assumed(config.ranges).slow))
    measured = Measured(estimate.odometry, ranges, path - path[0], sigma)
    result = bootstrap.bootstrap_graph(estimate.graph, measured, config.trilateration)
    number_if_several = {"recording": number + 1} if len(recordings) > 1 else {}
    task.stages.end("bootstrap", range_sigma=sigma, placed=int(result.placed.sum()), **number_if_several)
    # The bootstrap starts in the middle of the path; the frame of the map is that of the odometry's first pose.
    back = se2.compose(estimate.graph.poses[0], se2.inverse(result.graph.poses[0]))
    graph = estimate.graph.with_estimates_of(map_frame.moved(result.graph, back))
    graph = replace(graph, fixed_anchors=~result.placed)
    ranges = replace(ranges, weights=(used & result.placed[ranges.anchor]).astype(np.float64))
    return replace(estimate, graph=graph, ranges=ranges, bootstrap=result).with_hypotheses_moved(back)


def _optimised(estimate: Estimate, task: Task) -> Estimate:
    """Optimise odometry and ranges together, alternating with estimates of the ranges' noise.

    Recordings that were joined have been through all laps alone: they are solved together once with the noise learnt for
    each, and without a lidar in one more lap that estimates noise and priors of all.
    """
    if estimate.ranges is None or estimate.bootstrap is None:
        return estimate
    assumed_noise = wheels = estimate.odometry
    slips, factors = np.zeros(len(wheels)), np.ones_like(estimate.graph.poses[0])
    # Recordings that were joined have their slips in their odometry.
    if len(estimate.bootstrap.slips) and not estimate.alone:
        slips = estimate.bootstrap.slips
    optimizer, have_scans, laps = Optimizer(), task.recordings.have_scans, range(LapPolicy.laps)
    if estimate.alone:
        estimate = replace(estimate, graph=with_free(estimate.graph, *RADIO))
        estimate, result = estimate.solved(comparable(task.config.solver), optimizer)
        laps = range(0) if have_scans else laps[-1:]
    for lap in laps:
        # Clouds show the noise of the wheels better; each recording that was joined has its own already.
        if lap and task.config.ranges.learn and not (have_scans or estimate.alone):
            factors = variance_factors(estimate.problem, estimate.odometry, 1.0 - slips, factors)
            wheels = replace(assumed_noise, sqrt_information=assumed_noise.sqrt_information / np.sqrt(factors))
        # Noise learnt with wheels bent over a slip would keep them bent.
        estimate = replace(estimate, odometry=with_slips(wheels, slips) if slips.any() else wheels)
        estimate, result = _lap(estimate, lap, task, optimizer)
        slips = slipped(wheels, estimate.graph) if slips.any() else slips
    if slips.any():
        # Ranges that are wrong show slips as well: where clouds measure a step, they tell.
        estimate = replace(estimate, odometry=replace(wheels, slips=slips)) if have_scans else estimate
        task.stages.report("first optimisation", lap + 1, LapPolicy.laps)
    sided = estimate if have_scans or estimate.alone else range_alternatives.choose_side(estimate, task)
    if sided is not estimate:
        estimate, result = _lap(sided, lap, task, optimizer)
    task.stages.end("first optimisation", placed=int(estimate.placed.sum()), **solver_figures(result))
    return estimate


def _lap(estimate: Estimate, lap: int, task: Task, optimizer: Optimizer) -> tuple[Estimate, SolverSummary]:
    """Estimate the ranges' noise and optimise once; the last lap chooses the radio's priors and frees its calibration."""
    config, estimate = task.config, with_range_noise(estimate, task.config)
    if lap == LapPolicy.laps - 1:
        graph = with_selected_priors(estimate, config).graph
        return replace(estimate, graph=with_free(graph, *RADIO)).solved(config.solver, optimizer)
    # A robust odometry would break where the path only begins badly.
    odometry, solver = estimate.odometry, config.solver if lap else rough(config.solver)
    estimate, result = replace(estimate, odometry=replace(odometry, kernel=SQUARED)).solved(solver, optimizer)
    return replace(estimate, odometry=odometry), result


def with_range_noise(estimate: Estimate, config: MappingConfig, *, steady: bool = False) -> Estimate:
    """Re-estimate the ranges' noise from their residuals; steady: see range_measurements.learn_noise."""
    if estimate.ranges is None:
        return estimate
    graph, through = estimate.graph, None
    if (steady or estimate.joint is not None) and estimate.scans is not None and config.ranges.learn:
        seen = estimate.scans.clouds
        surfaces = se2.transform_each(graph.poses, seen.owner, seen.points)
        tags = estimate.ranges.tag_positions(graph.poses)
        through = blocked(tags, graph.anchors[estimate.ranges.anchor], surfaces)
    ranges, _ = learn_noise(estimate.ranges, graph, len(estimate.anchor_ids), config.ranges, steady=steady, blocked=through)
    return replace(estimate, ranges=ranges)


def evidence_against(one: Estimate, other: Estimate, config: MappingConfig) -> float:
    """Return by how much the logarithm of the evidence of one estimate of a recording is greater than that of another.

    The noise of the ranges was learnt under either, so that the ranges count with their normalised densities; both with the
    same number of independent ranges, for errors that last are counted once: the geometric mean of either noise's numbers, as
    such a number is known to an order of magnitude only.
    """
    (rest, density, share), (rest_of_other, density_of_other, share_of_other) = (_evidence(e, config) for e in (one, other))
    common = np.sqrt(share * share_of_other)
    ranges = float(common @ density) - float(common @ density_of_other)
    return rest - rest_of_other + ranges


def _evidence(estimate: Estimate, config: MappingConfig) -> tuple[float, Floats, Floats]:
    """Return the logarithms of the evidence but for the ranges, and of each range's density (m,), and its independent share."""
    ranges = estimate.ranges
    assert ranges is not None
    graph = estimate.problem
    squared = edge_cost(ranges, ranges.residuals(graph))
    density, share = log_densities(ranges, graph, config.ranges.min_sigma)
    return laplace_marginal_likelihood(graph) + 0.5 * squared, density, share


def reestimate_ranges(estimate: Estimate, task: Task) -> Estimate:
    """Re-estimate anchors and range noise on the trajectory that matches of neighbouring clouds have stiffened.

    Odometry alone bends until ranges with errors that last for minutes seem to fit. On the stiffer chain of scan matches such
    errors show in the residuals, unless scans see so little that it bends as well.
    """
    if estimate.ranges is None or estimate.steps is None:
        return estimate
    optimizer = Optimizer()
    held = estimate.solved(rough(task.config.solver), optimizer)[0]
    estimate = _learn_ranges(held if _let_go(held, estimate, task.config.ranges) else estimate, task, optimizer)
    task.stages.end("ranges re-estimated")
    return estimate


def reestimate_noise_and_priors(estimate: Estimate, task: Task) -> Estimate:
    """Re-estimate the ranges' noise on the trajectory with loops closed, and the priors of units and systematic errors.

    Ranges have little weight meanwhile, so that sustained outliers of an anchor show in its residuals, unless ranges alone
    constrain the poses.
    """
    if estimate.ranges is not None and (estimate.steps is None or not estimate.rests_on_ranges):
        weak = _learn_ranges(estimate, task, Optimizer(), steady=True)
        estimate = _learn_ranges(estimate, task, Optimizer()) if _let_go(estimate, weak, task.config.ranges) else weak
    return with_selected_priors(estimate, task.config)


def with_selected_priors(estimate: Estimate, config: MappingConfig) -> Estimate:
    """Return the estimate, which is at its optimum, with the priors of units of length and biases of greatest evidence."""
    measured = estimate.problem.edges[len(estimate.graph.edges) :]
    return replace(estimate, graph=prior_selection.select_priors(estimate.graph, measured, config.calibration))


def _learn_ranges(estimate: Estimate, task: Task, optimizer: Optimizer, *, steady: bool = False) -> Estimate:
    """Return the optimum with ranges whose noise was learnt there; steady: see range_measurements.learn_noise."""
    for solver in (rough(task.config.solver), task.config.solver):
        # The marginal likelihood is valid only at the optimum for the weights with which it is computed.
        estimate = with_range_noise(estimate, task.config, steady=steady).solved(solver, optimizer)[0]
    return estimate


def _let_go(held: Estimate, weak: Estimate, config: RangeNoiseConfig) -> bool:
    """Return whether most anchors' residuals grew where ranges had little weight: then nothing else constrains the poses.

    Noise learnt there would be the error of the poses, and would fix them where they are. Sustained outliers of one anchor
    cause residuals too, but of this anchor only.
    """
    growth = np.array([b / max(a, config.min_sigma) for a, b in zip(_scatter(held), _scatter(weak), strict=True)])
    return len(growth) > 0 and float(np.median(growth)) > LapPolicy.most_growth


def _scatter(estimate: Estimate) -> list[float]:
    """Return the scatter of ranges about the estimate, m, of each anchor that has ranges."""
    ranges = estimate.ranges
    assert ranges is not None
    off, alive = ranges.residuals(estimate.graph)[:, 0] * ranges.sigma, ranges.alive
    return [spread(off[alive & (ranges.anchor == anchor)]) for anchor in np.unique(ranges.anchor[alive])]
