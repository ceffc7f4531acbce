"""Lidar: joint refinement, once loops are closed, by all overlapping clouds; and the check of the map's consistency."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, chunks
from ..graph.calibration import LASER, RADIO, with_free
from ..graph.graph import Graph
from ..graph.marginals import marginals
from ..graph.solver import Optimizer
from ..graph.work import POINTS
from ..lidar import clouds, joint_refinement, visibility
from ..lidar.joint_refinement import RefinementConfig, RefinementResult, with_fewer_pairs
from ..lidar.scan_matching import PairPolicy, align_pairs, measured, pairs_of
from ..lidar.scan_to_scan import TrackingConfig
from ..odometry import keyframes
from ..odometry.slips import covariance_of
from ..problem.alternatives import EvidencePolicy
from ..problem.solution import rough, with_nonnegative_heights
from ..radio.range_errors import without_pattern
from . import keyframe_data
from .estimate import Estimate, Task
from .progress import solver_figures
from .radio_stages import evidence_against, with_range_noise
from .recordings import Recording, RecordingPolicy

_TO_COME = 1e-3
"""Relative decrease of chi2 that ends a solution before the adjustment to surfaces, which solves once more."""
STILL = 1e-3
"""Root mean square motion of the poses from which on the ranges' noise is estimated again, m."""
_VIOLATION = 0.05
"""Share of points in free space from which visits do not show the same place; glass and doors cause half of it."""
_COME_AND_GONE = 2.0
"""Ratio to the share within one visit that people explain: those of either visit are not there on the other one."""
_AT_ONCE = 1024
"""Single scans whose clouds are in memory at once."""
_PLACED_FIRST = 2
"""Scans between two keyframes that are placed first; where the odometry agrees with them as well as they measure, no others."""
_ENOUGH_VISITS = 5
"""Least number of keyframes of either visit for which their free-space violation counts."""


def pairs(estimate: Estimate, graph: Graph, settings: RefinementConfig, task: Task) -> tuple[Ints, Ints]:
    """Return pairs of clouds (e,), (e,) that overlap at a graph's poses, without those that the user has forbidden and those
    of one visit that lead across a step which clouds measure falsely."""
    recordings, clouds = task.recordings, estimate.lidar.clouds
    i, j = joint_refinement.choose_pairs(clouds, graph.poses, recordings.path, recordings.of_keyframe, settings)
    kept = task.allowed(i, j)
    if estimate.rejected is not None:
        until: Ints = np.cumsum(estimate.rejected) - estimate.rejected
        kept &= (j - i > max(settings.neighbours)) | (until[i] == until[j])
    return i[kept], j[kept]


def refine(estimate: Estimate, graph: Graph, settings: RefinementConfig, task: Task, stage: str) -> RefinementResult:
    """Refine a graph by the estimate's odometry and ranges, and by pairs of clouds that overlap at its poses."""
    report = task.stages.reporter(stage)
    report(0, settings.rounds)
    (i, j), scans = pairs(estimate, graph, settings, task), estimate.lidar
    graph = graph.with_edges(*estimate.odometry_and_ranges)
    unmeasured = joint_refinement.unmeasured(graph, i, j, task.recordings.twist, scans.delay)
    return joint_refinement.refine(graph, scans, unmeasured, settings, task.config.solver, report)


def refine_jointly(estimate: Estimate, task: Task) -> Estimate:
    """Let all overlapping clouds constrain all poses, where there are enough; re-estimate the ranges' noise on what results."""
    if estimate.steps is not None and estimate.rests_on_ranges:
        return estimate
    config = task.config
    if estimate.ranges is not None:
        estimate = replace(estimate, graph=with_free(estimate.graph, *RADIO))
    before = estimate.graph.poses
    refined = refine(estimate, estimate.graph, config.refinement, task, "joint refinement")
    graph = with_nonnegative_heights(estimate.graph.with_estimates_of(refined.graph))
    estimate = with_range_noise(replace(estimate, graph=graph, joint=refined.edges), config, steady=True)
    counts = {"pairs": len(refined.used), "used": int(refined.used.sum()), "rounds": refined.rounds}
    figures = {"sigma": refined.sigma, "shift": estimate.moved_since(before)}
    task.stages.end("joint refinement", **counts, **figures, **solver_figures(refined.summary))
    return estimate


def solve_by_own_errors(estimate: Estimate, task: Task) -> Estimate:
    """Solve everything with ranges that are weighted by their own errors alone, and correct these.

    The common error of all ranges from one direction moves an anchor, but gives a pose nothing false, since the anchor's place
    absorbs it. Where such ranges move poses by much, the lidar hardly constrains these, and they may absorb the error as well:
    the evidence decides between the two weightings, and where it is for the ranges, the lidar is matched again.
    """
    if estimate.ranges is None or estimate.joint is None:
        return estimate
    before, optimizer = estimate, Optimizer()
    quick = replace(rough(task.config.solver), relative_decrease=_TO_COME)
    estimate = with_range_noise(before, task.config).solved(quick, optimizer)[0]
    if (shift := estimate.moved_since(before.graph.poses)) >= task.config.refinement.same_pairs:
        # The analysis of other pairs of clouds cannot be used again, and it is large.
        optimizer = Optimizer()
        steady = before.solved(rough(task.config.solver))[0]
        if evidence_against(with_range_noise(estimate, task.config), steady, task.config) <= EvidencePolicy.positive:
            return _without_pattern(steady, task)
        estimate = _matched_once_more(estimate, shift, task)
        before = estimate
        estimate = with_range_noise(estimate, task.config).solved(quick, optimizer)[0]
    if estimate.moved_since(before.graph.poses) >= STILL:
        estimate = with_range_noise(estimate, task.config)
    del optimizer  # The optimizer's analysis takes as much memory as the covariances.
    task.stages.report("joint refinement", 1, 1)
    return _without_pattern(estimate, task)


def _without_pattern(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with ranges corrected by their common error in each direction from the robot."""
    if estimate.ranges is None or task.config.ranges.steady == 0.0:
        return estimate
    graph = with_fewer_pairs(estimate.problem)
    return replace(estimate, ranges=without_pattern(estimate.ranges, graph, marginals(graph)))


def _matched_once_more(estimate: Estimate, shift: float, task: Task) -> Estimate:
    """Match all clouds again after the poses moved by a shift, m, and solve with these matches."""
    settings = replace(task.config.refinement, first_gate=task.config.refinement.later_gate)
    refined = refine(estimate, estimate.graph, settings, task, "joint refinement")
    task.stages.end("matched once more", pairs=len(refined.used), used=int(refined.used.sum()), shift=shift)
    graph = with_nonnegative_heights(estimate.graph.with_estimates_of(refined.graph))
    return replace(estimate, graph=graph, joint=refined.edges)


def place_scans_between(estimate: Estimate, task: Task) -> Estimate:
    """Measure where the robot was at scans between keyframes, each by the cloud of the keyframe on its farther side."""
    if estimate.joint is None:
        return estimate
    each = tuple(_with_scans_between(r, estimate, task) if r.has_scans else r for r in task.recordings.each)
    placed = sum(0 if r.between is None else len(r.between.keyframe) - len(r.frames) for r in each)
    task.stages.end("scans between keyframes", placed=placed)
    return replace(estimate, recordings=replace(task.recordings, each=each))


def _with_scans_between(recording: Recording, estimate: Estimate, task: Task) -> Recording:
    """Place scans between a recording's keyframes, those that are not placed first only where these show more than odometry."""
    assert recording.log.scans is not None
    own, stamps = recording.frames.stamps, recording.log.scans.middles + estimate.lidar.delay
    stamps = stamps[(stamps > own[0]) & (stamps < own[-1])]
    step = np.searchsorted(own, stamps, "right") - 1
    before, after = stamps - own[step], own[step + 1] - stamps
    further = np.minimum(before, after) > RecordingPolicy.same_moment
    if not further.any():
        return recording
    stamps, step = stamps[further], step[further]
    # The nearer keyframe's cloud may hold the scan itself.
    side = recording.first + step + (before <= after)[further]

    def placed(rows: Ints) -> list[Floats]:
        """Place some scans, so many at once that their clouds take little memory."""
        parts = (rows[some] for some in chunks(len(rows), _AT_ONCE))
        each = [_seen_from(recording, estimate, task, (stamps[some], step[some], side[some])) for some in parts]
        return [np.concatenate(of) for of in zip(*each, strict=True)]

    first = _evenly(step, _PLACED_FIRST)
    rows, rest = np.flatnonzero(first), np.flatnonzero(~first)
    good, seen, squared = placed(rows)
    if len(rest) and good.any() and np.median(squared[good]) > TrackingConfig.median:
        rows = np.concatenate([rows, rest])
        good, seen = (np.concatenate(of) for of in zip((good, seen), placed(rest)[:2], strict=True))
    return recording.with_poses_between(stamps[rows][good], (side - recording.first)[rows][good], seen[good])


def _evenly(step: Ints, most: int) -> Bools:
    """Return which of ascending numbers of steps (m,) are chosen: of each number at most so many, evenly spread."""
    first, end = (np.searchsorted(step, step, side) for side in ("left", "right"))
    rank = np.arange(len(step)) - first
    before, after = ((rank + k) * (most + 1) // (end - first + 1) for k in (0, 1))
    return np.asarray(after > before)


def _seen_from(
    recording: Recording, estimate: Estimate, task: Task, of: tuple[Floats, Ints, Ints]
) -> tuple[Bools, Floats, Floats]:
    """Return which scans (m,) match the cloud of a keyframe, where the base was, seen from it (m, 3), and the squared
    Mahalanobis distance (m,) of the odometry's pose from the match, by the variance of the match alone.

    Parameters
    ----------
    of : stamps (m,), s; numbers (m,) of the recording's steps that hold them; keyframes (m,) that see them.
    """
    scans, graph, (stamps, step, side) = estimate.lidar, estimate.graph, of
    frames = keyframes.at(recording.log, stamps, np.ones(len(stamps), dtype=bool))
    alone = keyframe_data.clouds_of(replace(recording, frames=frames), task.config, scans.delay)
    both = clouds.joined([scans.clouds, *alone])
    raster = replace(scans.raster, clouds=replace(both, work=scans.clouds.work))
    scans.clouds.work[POINTS] += len(both.points) - len(scans.clouds.points)
    mounting = np.array([graph.calibration.get(name) for name in LASER[:3]])
    expected = recording.dense_trajectory(graph.poses, stamps)
    guess = se2.between(se2.compose(graph.poses[side], mounting), se2.compose(expected, mounting))
    pairs = pairs_of(both, side, len(scans.clouds) + np.arange(len(stamps)))
    aligned = align_pairs(raster, pairs, guess, PairPolicy.gate, PairPolicy.gate)
    variance = np.full(len(stamps), TrackingConfig.sigma**2 * PairPolicy.correlation)
    z, root = measured(aligned.factors, aligned.pose, variance)
    # The odometry's noise over the step is that of the way from either side, and of its clock.
    of_step = np.searchsorted(estimate.odometry.i, recording.first + step)
    turn = se2.rotation(guess[:, 2] + graph.poses[side, 2] - graph.poses[recording.first + step, 2])
    prior = np.linalg.inv(np.swapaxes(turn, 1, 2) @ covariance_of(estimate.odometry, graph)[of_step] @ turn)
    off = np.linalg.solve(np.swapaxes(root, 1, 2) @ root + prior, prior @ se2.between(z, guess)[..., None])[..., 0]
    seen = se2.compose(se2.compose(se2.compose(mounting, z), off), se2.inverse(mounting))
    squared = np.sum(np.einsum("eij,ej->ei", root, se2.between(z, guess)) ** 2, axis=1)
    return (aligned.share >= PairPolicy.good_share) & (aligned.factors.asked >= PairPolicy.fewest), seen, squared


def check_map_consistency(estimate: Estimate, task: Task) -> Estimate:
    """Compare the free space of one visit to a place with the points of another: what moves shows within one visit as well."""
    recordings, poses, clouds = task.recordings, estimate.graph.poses, estimate.lidar.clouds
    share, moving, visits = visibility.free_space_violation(clouds, poses, recordings.path, recordings.of_keyframe)
    task.stages.end("map consistency", visits=visits, free_space_violation=share, within_one_visit=moving)
    if share > max(_VIOLATION, _COME_AND_GONE * moving) and visits >= _ENOUGH_VISITS:
        task.stages.note("free-space-violation", share=share, moving=moving, visits=visits)
    return estimate
