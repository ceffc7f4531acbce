"""Calibration values against what is known of them otherwise.

The scale of turns, which must be one constant that no single wrong turn changes; the point about which the robot turns; the
unit of the odometry; and the offset of the lidar's clock, which must be the same in all parts of a recording.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from ..arrays import ENOUGH, TINY, Bools, Floats
from ..errors import SolverError
from ..graph.calibration import TURNING, with_free
from ..graph.marginals import marginals
from ..graph.pose_edges import ScanEdges
from ..graph.solver import optimize
from ..lidar.joint_refinement import RefinementConfig
from ..lidar.scan_duration import PARTS, MovedRays, missing_duration
from ..lidar.scan_matching import pairs_of
from ..lidar.scan_to_scan import Steps
from ..loop_closure.candidates import CandidatePolicy
from ..odometry.wheels import turn_scales
from ..problem.alternatives import EvidencePolicy
from ..problem.evidence import log_odds_by_parts, log_odds_of_constant, prior_sigma, with_prior_sigma, without_prior
from ..problem.solution import rough, stretch
from ..sensor_log import SensorLog
from .estimate import Estimate, Task
from .mapping_config import MappingConfig

OTHER_UNIT = 0.12
"""Relative error of travelled distance from which on it is not a wheel radius to be calibrated but another unit."""
TOLERANCE = 0.004
"""Offset of the lidar's clock, and error of a scan's duration, that clouds may have, s: an odometry that is wrong by 0.3 rad/s
then costs 0.07 degrees."""


class TurningPolicy:
    """Offsets of a lidar from the place that is given, and whether wheels that slip in turns cause them."""

    small: float = 0.01
    """m; a mounting, or the origin of a base, is not known better than this."""
    by_tape: float = 0.03
    """Standard deviation of a mounting that is given and right, m."""
    wrong_frame: float = 0.1
    """Share of given mountings that belong to another robot or frame, and are off by the setting `laser_offset`."""
    slips: float = 0.5
    """Prior odds of a robot that slips in turns against one that does not."""


def with_constant_turn_scales(estimate: Estimate, steps: ScanEdges, task: Task) -> Estimate:
    """Fix each scale of turns at the lidar's from step to step, where the scale of the whole estimate contradicts it.

    A turn that the wheels missed, or a heading lost in a fast turn, then stays a local error. Where the scale of the steps is
    the larger correction, the estimate keeps its own, and the map is checked at the end: the lidar may be wrong.
    """
    graph = estimate.graph
    values, fixed = graph.calibration.values.copy(), graph.fixed_calibration.copy()
    for index, found in turn_scales(estimate.odometry, steps, graph).items():
        if found.contradicts(used := float(values[index])) and abs(found.value) < abs(used):
            label = graph.calibration.keys[index].label
            task.stages.note("turn-scale", name=label, by_steps=found.value, sigma=found.sigma, by_all=used)
            values[index], fixed[index] = found.value, True
    return replace(estimate, graph=replace(graph.updated(graph.poses, graph.anchors, values), fixed_calibration=fixed))


def with_slip_in_turns(estimate: Estimate, task: Task) -> Estimate:
    """Let the robot turn about another point than the base's origin, where the lidar seems to be mounted off its place.

    Wheels that slip in turns (skid steering) have exactly the same residuals as a lidar mounted elsewhere. So the offset h that
    the lidar has without slip is split by the probability p that the robot slips: priors N(0, p h^2) of the slip and
    N(0, (1 - p) h^2) of the mounting give mean p h and variance p (1 - p) h^2, those of the two alternatives. Where no mounting
    is given, the base's origin is the point about which it turns.
    """
    graph, config, policy = estimate.graph, task.config.calibration, TurningPolicy
    at, slips = graph.calibration.index("laser_x"), graph.calibration.of_kinds(TURNING)
    offset = graph.calibration.get("laser_x")
    given = all(np.any(r.log.mounting.T_base_laser != 0.0) for r in task.recordings.each if r.has_scans)
    if not given or not slips.any() or abs(offset) < policy.small or graph.fixed_calibration[at]:
        return estimate
    if abs(offset) < CandidatePolicy.sigmas * marginals(estimate.problem).covariances.calibration[at]:
        return estimate
    widths = np.array([config.sideways_per_turn, min(policy.by_tape, config.laser_offset), config.laser_offset])
    odds = np.array([policy.slips, 1.0 - policy.wrong_frame, policy.wrong_frame])
    share = float(softmax(np.log(odds / widths) - 0.5 * (offset / widths) ** 2)[0])
    sigma = prior_sigma(graph)
    sigma[slips] = max(abs(offset) * np.sqrt(share), policy.small)
    sigma[at] = max(abs(offset) * np.sqrt(1.0 - share), policy.small)
    estimate = replace(estimate, graph=with_free(with_prior_sigma(graph, sigma), TURNING))
    return estimate.with_estimates_of(optimize(estimate.problem, task.config.solver)[0])


def with_units_checked(config: MappingConfig, logs: Sequence[SensorLog]) -> MappingConfig:
    """Return the settings with the prior of a worn tyre for wheels of another unit, where a lidar has measured their ways.

    Ranges through walls may fit wheels several times too short better than a path that is right; lidar and wheels that agree
    would both have to be wrong, by one factor. With recordings of which some show nothing, it stays.
    """
    ways = np.array([float("nan") if log.screening is None else log.screening.lidar_by_wheels for log in logs])
    if not np.all(np.abs(ways - 1.0) <= OTHER_UNIT):
        return config
    priors = config.calibration
    return replace(config, calibration=replace(priors, odometry_unit=min(priors.odometry_unit, OTHER_UNIT)))


def without_known_calibration(config: MappingConfig, logs: Sequence[SensorLog]) -> MappingConfig:
    """Return the settings without the calibration values that the recordings fix.

    Against stamps of receipt in bursts no clock has an offset, nor where a format has one clock for all. Where the poses of a
    log are those of the laser, the laser has its place, and the point about which the robot turns is unknown instead.
    """
    priors = config.calibration
    late = {sensor for log in logs if log.screening is not None for sensor in log.screening.in_bursts}
    if late or all(log.notes.one_clock for log in logs):
        priors = replace(priors, laser_delay=0.0, range_delay=0.0 if "odometry" in late else priors.range_delay)
    mounted = [log.mounting for log in logs if log.scans is not None]
    if mounted and all(mounting.laser_is_base for mounting in mounted):
        priors = replace(priors, laser_offset=0.0)
    return replace(config, calibration=priors)


def odometry_unit_factors(estimate: Estimate, task: Task) -> Floats:
    """Return the factor (r,) by which the odometry of each recording is to be multiplied to be in metres.

    It is 1 where the unit is right up to what a calibration of the wheels' radius may take up, and where it is known: then the
    ranges have other lengths.
    """
    calibration, recordings = estimate.graph.calibration, task.recordings
    if task.config.calibration.odometry_unit <= OTHER_UNIT:
        return np.ones(len(recordings))
    places = [calibration.index("odometry_scale", recording=n) for n in range(len(recordings))]
    factors = np.array([1.0 if place < 0 else 1.0 + float(calibration.values[place]) for place in places])
    factors = np.where(np.abs(factors - 1.0) > OTHER_UNIT, factors, 1.0)
    other = estimate.other_heights
    for recording, factor in zip(recordings.each, factors.tolist(), strict=True):
        if factor != 1.0:
            screening = recording.log.screening
            ratio = float("nan") if screening is None else screening.lidar_by_wheels
            lidar_agrees = abs(ratio - factor) < abs(ratio - 1.0)
            high = other is not None and not other.taken and not lidar_agrees
            task.stages.note(
                "odometry-unit",
                recording=recording.number + 1,
                name=recording.name if len(recordings) > 1 else "",
                factor=factor,
                checked=recording.has_scans or len(task.constraints.anchors) > 1 or bool(task.constraints.distances),
                high=other.high if other is not None and high else None,
            )
    return factors


def late(estimate: Estimate, task: Task) -> float:
    """Return by how much the lidar's clock is later than that with which the clouds were made, s; 0 where that is not shown.

    Undecided, the offset stays an unknown of the problem, with its prior.
    """
    calibration = estimate.graph.calibration
    at = calibration.index("laser_delay")
    off = calibration.get("laser_delay") - estimate.lidar.delay
    if at < 0 or estimate.graph.fixed_calibration[at] or abs(off) < TOLERANCE:
        return 0.0
    values, sigmas = _by_parts(estimate, at, task)
    prior = float(prior_sigma(estimate.graph)[at])
    return off if log_odds_of_constant(values - estimate.lidar.delay, sigmas, prior) > EvidencePolicy.positive else 0.0


def missing_durations(estimate: Estimate, steps: Steps, task: Task) -> tuple[Floats, Bools]:
    """Return by how much the scans of each recording (r,) take longer than their clouds were made with, s, as clouds show that
    neighbouring steps place in each other, and whether that is evidently no 0 and more than clouds may have, or than turns
    of the wheels that are wrong by their prior look like.

    Between stamps of receipt the odometry does not tell how the robot moved during a scan.
    """
    recordings, raster, config = task.recordings, estimate.lidar.raster, task.config.calibration
    missing, shown = np.zeros(len(recordings)), np.zeros(len(recordings), dtype=bool)
    for recording in recordings.each:
        log, k = recording.log, recording.number
        receipt = log.screening is not None and log.screening.in_bursts
        if log.scans is None or receipt or config.scan_duration == 0.0:
            continue
        i, j, T_i_j = steps.pairs(recording.rows, max(RefinementConfig.neighbours))
        rays = MovedRays(raster, recordings.twist, log.scans, log.mounting)
        values, sigmas = missing_duration(raster, pairs_of(raster.clouds, i, j, RefinementConfig.points), T_i_j, rays)
        precision = sigmas**-2.0
        missing[k] = values @ precision / max(precision.sum(), TINY)
        tolerance = max(TOLERANCE, config.heading_scale * abs(log.scans.duration))
        evident = log_odds_by_parts(values, sigmas, config.scan_duration) > EvidencePolicy.positive
        shown[k] = evident and abs(missing[k]) > tolerance
    return missing, shown


def _by_parts(estimate: Estimate, at: int, task: Task) -> tuple[Floats, Floats]:
    """Return the offset (p,), s, that wheels and lidar show in parts of the recordings, and its standard deviation (p,)."""
    problem, prior = estimate.problem, float(prior_sigma(estimate.graph)[at])
    values, sigmas = [], []
    for recording in task.following(estimate).recordings.each:
        rows = np.arange(recording.rows.start, recording.rows.stop)
        for part in np.array_split(rows, max(1, min(PARTS, len(rows) // ENOUGH))):
            try:
                alone = optimize(stretch(problem, int(part[0]), int(part[-1]) + 1), rough(task.config.solver))[0]
                sigma = float(marginals(alone).covariances.calibration[at])
            except SolverError:
                continue
            values.append(float(alone.calibration.values[at]))
            sigmas.append(sigma)
    return without_prior(np.array(values), np.array(sigmas), prior)
