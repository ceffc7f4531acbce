"""Scan-to-scan matching: clouds per keyframe, matched with their neighbours; keyframes and clouds follow the lidar's clock.

Neighbours make sub-maps stiff, show the offset of the lidar's clock, and tell slips of the wheels.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools
from ..graph.calibration import LASER, TURNING, indices, with_free
from ..graph.pose_edges import ScanEdges
from ..graph.robust import SQUARED
from ..graph.solver import optimize
from ..lidar import scan_to_scan
from ..lidar.scan_to_scan import ScanOdometry, Steps
from ..odometry.wheels import reestimate_wheel_noise
from ..problem.solution import rough
from . import calibration_checks, keyframe_data
from .estimate import Estimate, Task
from .keyframe_data import with_keyframes
from .lidar_stages import refine
from .recordings import denser, later, with_longer_scans


class NeighbourPolicy:
    """Times and weights of the matching of neighbours."""

    likely: float = 0.5
    """Probability from which on a step slipped."""
    cuts: int = 4
    """Keyframes added within a doubtful step, at most."""
    retimings: int = 5
    """Most times that clouds are made again; a quarter of the error remains each time."""
    least_slope: float = 0.5
    """Least change of the duration that clouds of a scan show as missing per change of the one that they are made with."""
    inflation: float = 10.0
    """Factor on the ranges' standard deviations."""


def make_clouds(estimate: Estimate, task: Task) -> Estimate:
    """Make a cloud for each keyframe, and free the laser's mounting and clock, or where it turns."""
    scans = keyframe_data.make(task.recordings, task.config, 0.0, task.stages.work)
    task.stages.end("clouds", points=len(scans.clouds.points))
    # Wheels that turn about another point of the base look like a laser elsewhere on it: one of the two is known.
    kinds = LASER if estimate.graph.calibration.of_kinds(*LASER[:2]).any() else (*LASER, TURNING)
    return replace(estimate, graph=with_free(estimate.graph, *kinds), scans=scans)


def match_scan_to_scan(estimate: Estimate, task: Task) -> Estimate:
    """Make clouds and match neighbouring ones; where the lidar's clock is found to be off, move keyframes and clouds with it.

    Keyframes are then at the times of the scans: otherwise the odometry's velocity would have to bridge the offset. Clouds are
    made here, so that no reference keeps the replaced ones in memory.
    """
    found = _with_duration_found(*_descended(make_clouds(estimate, task), task), task)
    estimate, steps = _with_clock_found(*found, task.following(found[0]))
    task = task.following(estimate)
    # With ranges, which judge the path, steps that slipped are cut; else those that the clouds contradict.
    doubtful = steps.contradicted() & (estimate.ranges is None)
    cut = _with_keyframes_where(estimate, doubtful, task)
    if cut is not None:
        estimate, task = cut, task.following(cut)
        steps = _steps(estimate, task)
    track = _followed(estimate, steps)
    slipped = (track.slips > NeighbourPolicy.likely) & (estimate.ranges is not None)
    cut = _with_keyframes_where(replace(estimate, odometry=replace(track.wheels, slips=track.slips)), slipped, task)
    if cut is not None:
        estimate, task = cut, task.following(cut)
        track = _followed(estimate, _steps(estimate, task))
    return _match_neighbours(replace(estimate, odometry=track.slipped), track, task)


def _with_duration_found(estimate: Estimate, steps: Steps, task: Task) -> tuple[Estimate, Steps]:
    """Return the estimate with clouds of scans that take as long as neighbouring clouds show, and the steps between these.

    Where the evidence shows that the log's duration is wrong, that at which clouds show no further error is found by secants.
    An error that grows when it is corrected is not one of the duration, which then stays as stated.
    """
    stated = task.recordings
    first, shown = calibration_checks.missing_durations(estimate, steps, task)
    missing = change = longer = np.where(shown, first, 0.0)
    for _ in range(NeighbourPolicy.retimings):
        if not (np.abs(change) > calibration_checks.TOLERANCE).any():
            break
        estimate = replace(estimate, scans=None, recordings=with_longer_scans(stated, longer))
        task = task.following(estimate)
        estimate = _with_clouds_at(estimate, 0.0, task)
        steps, before = _steps(estimate, task), missing
        missing = calibration_checks.missing_durations(estimate, steps, task)[0]
        shown &= np.abs(missing) < np.abs(first)
        slope = (before - missing) / np.where(change == 0.0, 1.0, change)
        change = np.where(shown, missing / np.clip(slope, NeighbourPolicy.least_slope, 1.0), -longer)
        longer = longer + change
    for old, new in zip(stated.each, task.recordings.each, strict=True):
        if (was := old.log.scans) is not None and (now := new.log.scans) is not None and now is not was:
            task.stages.note(
                "scan-duration",
                recording=new.number + 1,
                name=new.name if len(stated) > 1 else "",
                stated=was.duration,
                duration=now.duration,
                increment=now.time_increment,
            )
    return estimate, steps


def _with_clock_found(estimate: Estimate, steps: Steps, task: Task) -> tuple[Estimate, Steps]:
    """Return the estimate with keyframes and clouds at the lidar's clock, which the steps that the clouds measure show, and
    these steps; where that is the log's clock, the estimate is their optimum."""
    corrected = np.inf
    for _ in range(NeighbourPolicy.retimings):
        shown = _solved_with(steps, estimate, task)
        late = calibration_checks.late(shown, task)
        settled = late == 0.0
        if settled and estimate.lidar.delay == 0.0:
            # Clouds tell the errors of the wheels that last better than ranges.
            return estimate.with_estimates_of(shown.graph), steps
        if abs(late) > corrected:
            # With a clock that is off by a constant, each correction leaves a part of the error before it.
            task.stages.note("clock-offset", offset=estimate.lidar.delay)
            settled, late = True, -estimate.lidar.delay
        elif settled:
            late = shown.graph.calibration.get("laser_delay") - estimate.lidar.delay
        corrected, delay = abs(late), estimate.lidar.delay + late
        # No reference keeps the clouds in memory while others take their place.
        estimate = replace(estimate.with_estimates_of(shown.graph), scans=None)
        del shown
        estimate = _at_delay(estimate, late, delay, task)
        task = task.following(estimate)
        estimate, steps = _descended(_with_clock_at(estimate, delay) if settled else estimate, task)
        if settled:
            break
    return estimate, steps


def _solved_with(steps: Steps, estimate: Estimate, task: Task) -> Estimate:
    """Return the optimum of odometry, weakly weighted ranges and the steps that descent from the odometry measured."""
    scans, twist = estimate.lidar, task.recordings.twist
    found = scan_to_scan.descended_edges(scans.raster, steps)
    names = indices(estimate.graph.calibration, *LASER)
    i, j, kernel = found.i, found.j, estimate.odometry.kernel
    root = found.sqrt_information
    edges = ScanEdges(i, j, found.T_i_j, root, twist[i], twist[j], names, scans.delay, kernel=kernel)
    wheels = reestimate_wheel_noise(estimate.odometry, found, estimate.graph)
    return _with_inflated_ranges(replace(estimate, odometry=wheels, steps=edges)).solved(rough(task.config.solver))[0]


def _with_clock_at(estimate: Estimate, delay: float) -> Estimate:
    """Return the estimate with the lidar's clock late by `delay` s and no longer an unknown, until covariances are taken.

    Clouds made with the offset need no velocity of the wheels, whose noise would bend steps and bias it.
    """
    graph = estimate.graph
    fixed = graph.calibration.of_kinds("laser_delay")
    graph = graph.updated(graph.poses, graph.anchors, np.where(fixed, delay, graph.calibration.values))
    return replace(estimate, graph=replace(graph, fixed_calibration=graph.fixed_calibration | fixed))


def _at_delay(estimate: Estimate, late: float, delay: float, task: Task) -> Estimate:
    """Return the estimate with keyframes later by `late` s and clouds made for a lidar whose clock is late by `delay` s."""
    before = task.following(estimate).recordings
    estimate = with_keyframes(estimate, before, later(before, late))
    return _with_clouds_at(estimate, delay, task.following(estimate))


def _with_clouds_at(estimate: Estimate, delay: float, task: Task) -> Estimate:
    """Return the estimate with clouds made again for a lidar whose clock is late by `delay` s."""
    scans = keyframe_data.make(task.recordings, task.config, delay, task.stages.work)
    task.stages.end("clouds made again", laser_delay=delay)
    return replace(estimate, scans=scans)


def _descended(estimate: Estimate, task: Task) -> tuple[Estimate, Steps]:
    """Return the estimate from odometry and weakly weighted ranges, and the steps that the clouds measure from there.

    False ranges of full weight would displace neighbours; with weak ones, these follow the odometry until clouds correct it.
    """
    weak, config = _with_inflated_ranges(estimate), task.config
    whole = replace(weak, odometry=replace(weak.odometry, kernel=SQUARED)).odometry_and_ranges
    estimate = estimate.with_estimates_of(optimize(estimate.graph.with_edges(*whole), rough(config.solver))[0])
    return estimate, _steps(estimate, task)


def _steps(estimate: Estimate, task: Task) -> Steps:
    """Return the steps of the odometry as the clouds measure them from the estimate's poses."""
    scans, poses, i = estimate.lidar, estimate.graph.poses, estimate.odometry.i
    guess = se2.between(poses[i], poses[i + 1])
    return scan_to_scan.match_plainly(scans.raster, i, guess, task.config.refinement.first_gate)


def _followed(estimate: Estimate, steps: Steps) -> ScanOdometry:
    """Return the steps between neighbouring clouds, near the odometry's or elsewhere where it slipped."""
    scans = estimate.lidar
    return scan_to_scan.follow(scans.raster, estimate.odometry, estimate.graph, steps)


def _with_keyframes_where(estimate: Estimate, doubtful: Bools, task: Task) -> Estimate | None:
    """Cut doubtful steps of the odometry (e,) at the scans within them; None where no scans are.

    Where the robot moves little between two scans, any odometry is good enough to place the rays of a cloud.
    """
    before = task.recordings
    steps = estimate.odometry.i[doubtful]
    after = denser(before, steps, NeighbourPolicy.cuts, estimate.lidar.delay)
    if len(after.stamps) == len(before.stamps):
        return None
    scans = keyframe_data.remake(estimate.lidar, before, after, task.config)
    task.stages.end("keyframes added", steps=len(steps), keyframes=len(after.stamps))
    return replace(with_keyframes(estimate, before, after), scans=scans)


def _match_neighbours(estimate: Estimate, track: ScanOdometry, task: Task) -> Estimate:
    """Match each cloud with those just before and after it, so that sub-maps are stiff."""
    rules, graph = task.config.refinement, estimate.graph
    rejected = np.zeros(len(graph.poses), dtype=bool)
    rejected[estimate.odometry.i[track.rejected]] = True
    estimate = replace(estimate, rejected=rejected)
    weak = _with_inflated_ranges(estimate)
    problem = graph.with_edges(*weak.odometry_and_ranges, track.steps)
    graph = graph.with_estimates_of(optimize(problem, rough(task.config.solver))[0])
    gate = float(np.clip(track.miss, rules.later_gate, rules.first_gate))
    settings = replace(rules, partners=0, rounds=rules.track_rounds, first_gate=gate)
    refined = refine(weak, graph, settings, task, "scan-to-scan matching")
    task.stages.end(
        "scan-to-scan matching", pairs=len(refined.used), used=int(refined.used.sum()), gate=gate, sigma=refined.sigma,
        rounds=refined.rounds, searched=track.searched, rejected=int(track.rejected.sum()),
        slipped=int(np.sum(track.slips > NeighbourPolicy.likely)),
    )
    estimate = replace(estimate, graph=graph.with_estimates_of(refined.graph), steps=refined.edges)
    return calibration_checks.with_constant_turn_scales(estimate, refined.edges, task)


def _with_inflated_ranges(estimate: Estimate) -> Estimate:
    """Return the estimate with ranges that constrain the trajectory only where nothing else does."""
    if (ranges := estimate.ranges) is None:
        return estimate
    return replace(estimate, ranges=replace(ranges, sigma=ranges.sigma * NeighbourPolicy.inflation))
