"""Never worse than its parts: where ranges and odometry deny a step of the lidar's path, the map without that step competes.

Both are scored on one set of measurements, with associations made anew for either: the evidence of all ranges with the
anchors' likeliest places and moves, the odometry's steps there with the tail of slips, and the rays of one side of the step on
the surfaces and in the free space of the other. Ranges that are wrong together do not outweigh what both sides saw.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import BEYOND_NOISE, Bools, Ints
from ..findings import Fact
from ..graph.pose_edges import OdometryEdges, ScanEdges
from ..lidar.object_likelihood import ObjectLikelihood
from ..lidar.scan_matching import pairs_of
from ..lidar.scan_to_scan import TrackingConfig
from ..odometry.slips import log_densities, with_slips
from ..problem.solution import rough
from . import lidar_stages, surface_adjustment
from .anchor_places import decide_places, of_places
from .broken_steps import BreakPolicy, BrokenStep, broken_steps, range_evidence
from .estimate import Estimate, Task
from .radio_stages import with_range_noise

_NOISE_ROUNDS = 2
"""Number of solutions before clouds are matched anew; each begins with an estimate of the ranges' noise."""
_AROUND = 2.0
"""Time within which steps that contradict the odometry are one slip, s: twice as long as one lasts on the mean, or less."""


def replace_broken_stretches(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with broken steps of the lidar's path left to wheels and radio where that is more probable."""
    if estimate.scans is None or estimate.ranges is None or estimate.joint is None or estimate.rests_on_ranges:
        return estimate
    said = [fact.kind for fact in task.stages.facts if of_places(fact)]
    if not said and not len(_suspects(estimate, task)):
        return estimate
    wheels, found, first = estimate.odometry, list[Fact](), estimate
    # One anchor alone that moves is no symptom.
    while said != ["moved-anchor"] and len(found) < BreakPolicy.rounds and (step := _proposed(estimate, task)) is not None:
        stretch = _stretch(estimate, task, step.begin)
        other = _released(estimate, task, step, stretch)
        # Elsewhere wheels and lidar hold the path together, and what the lidar says there is not counted.
        counted = wheels.rows((wheels.i >= stretch[0]) & (wheels.j <= stretch[1]))
        gain = _gain(other, estimate, counted, task, step) + float(np.log(BreakPolicy.broken))
        task.stages.end("broken stretch", begin=float(task.recordings.stamps[stretch[0]]), gain=gain)
        if gain <= 0.0:
            break
        found.append(_fact(estimate, other, step, stretch, task))
        estimate = other
    # The path has been mended since the places were decided, here or by matches of scans.
    estimate = decide_places(estimate, task)
    if estimate is first:
        return estimate
    task.stages.facts += found
    estimate = lidar_stages.solve_by_own_errors(estimate, task)
    return surface_adjustment.adjust_surfaces(estimate, task)


def _proposed(estimate: Estimate, task: Task) -> BrokenStep | None:
    """Return the broken step that explains the ranges best; None where anchors that move explain them better, or none move."""
    steps = broken_steps(estimate, task, _suspects(estimate, task))
    gain, step = max(steps, key=lambda each: each[0], default=(0.0, None))
    return step if gain > 0.0 else None


def _off(estimate: Estimate) -> Bools:
    """Return which steps (e,) of the odometry contradict the path, or may as wheels slip over them."""
    off = np.abs(estimate.odometry.residuals(estimate.graph)).max(axis=1)
    return np.asarray(estimate.slipped | (off > BEYOND_NOISE))


def _suspects(estimate: Estimate, task: Task) -> Ints:
    """Return the keyframe at which each stretch of steps that contradict, or may, begins (see _off)."""
    ends = estimate.odometry.j[_off(estimate)]
    later = np.diff(task.recordings.stamps[ends], prepend=-np.inf) > _AROUND
    return np.asarray(ends[later], dtype=np.intp)


def _stretch(estimate: Estimate, task: Task, begin: int) -> tuple[int, int]:
    """Return the first and last keyframe of the steps that are off (see _off) around a broken one, which ends at a keyframe."""
    stamps, of = task.recordings.stamps, task.recordings.of_keyframe
    ends = np.append(estimate.odometry.j[_off(estimate)], begin)
    ends = np.unique(ends[of[ends] == of[begin]])
    group = np.cumsum(np.diff(stamps[ends], prepend=stamps[ends[0]]) > _AROUND)
    own = ends[group == group[np.searchsorted(ends, begin)]]
    return int(own[0]) - 1, int(own[-1])


def _displaced(estimate: Estimate, step: BrokenStep) -> Bools:
    number = np.arange(len(estimate.graph.poses))
    return (number >= step.begin) & (number < step.end)


def _released(estimate: Estimate, task: Task, step: BrokenStep, stretch: tuple[int, int]) -> Estimate:
    """Return the estimate with a stretch left to wheels that slip and ranges, and all clouds matched anew from there."""
    assert estimate.joint is not None
    far, (first, last) = _displaced(estimate, step), stretch
    graph = replace(estimate.graph, poses=step.displaced(estimate.graph.poses), anchors=step.places(estimate.graph.anchors))
    slips = (estimate.odometry.i >= first) & (estimate.odometry.j <= last)
    wheels = with_slips(estimate.odometry, slips.astype(np.float64))
    lidar = estimate.joint.rows(_kept(estimate.joint, far, first, last))
    other = replace(estimate, graph=graph, joint=lidar, steps=None, surfaces=None, odometry=wheels)
    for _ in range(_NOISE_ROUNDS):
        other = with_range_noise(other, task.config).solved(rough(task.config.solver))[0]
    other = lidar_stages.refine_jointly(replace(other, joint=None), task)
    edges = other.closures.edges
    agrees = np.abs(edges.residuals(other.graph)).max(axis=1, initial=0.0) <= BEYOND_NOISE
    reasons = ["leads across a broken step of the path"] * len(edges)
    return replace(other, closures=other.closures.without(agrees, "contradicts-graph", reasons))


def _kept(edges: ScanEdges, far: Bools, first: int, last: int) -> Bools:
    """Return which scan edges (e,) neither begin nor end within a stretch, nor lead across the broken step."""
    inside = [(first < end) & (end < last) for end in (edges.i, edges.j)]
    return ~(inside[0] | inside[1]) & (far[edges.i] == far[edges.j])


def _gain(other: Estimate, estimate: Estimate, wheels: OdometryEdges, task: Task, step: BrokenStep) -> float:
    """Return by how much the log likelihood of all measurements is greater along another path, by the noise of some wheels."""
    assert estimate.joint is not None
    assert other.joint is not None
    far = _displaced(estimate, step)
    i, j = (np.concatenate([getattr(e.joint, end) for e in (estimate, other)]) for end in ("i", "j"))
    i, j = np.unique(np.stack([i, j])[:, far[i] != far[j]], axis=1)
    pairs, seen = pairs_of(estimate.lidar.clouds, i, j), _likelihood(estimate)
    # The points of a cloud are the same in all of its pairs.
    share = 1.0 / np.bincount(j, minlength=len(far))[j]
    scores = []
    for graph, ranges in ((e.graph, range_evidence(e, task)) for e in (other, estimate)):
        rays = seen.log_likelihood(pairs, se2.between(graph.poses[i], graph.poses[j]))
        scores.append(ranges + float(np.sum(log_densities(wheels, graph))) + float(rays @ share))
    return scores[0] - scores[1]


def _likelihood(estimate: Estimate) -> ObjectLikelihood:
    """Return the likelihood of rays, with what matches by chance and what moves as neighbouring clouds show it."""
    lidar, i, j, poses = estimate.lidar, estimate.odometry.i, estimate.odometry.j, estimate.graph.poses
    pairs, steps = pairs_of(lidar.clouds, i, j), se2.between(poses[i], poses[j])
    return ObjectLikelihood.of(lidar.raster, TrackingConfig.sigma, pairs, steps).learnt(pairs, steps)


def _fact(estimate: Estimate, other: Estimate, step: BrokenStep, stretch: tuple[int, int], task: Task) -> Fact:
    stamps, start = task.recordings.stamps, float(step.recording.log.odometry.stamps[0])
    begin, end = (float(stamps[k]) for k in stretch)
    before, after = (se2.between(*e.graph.poses[list(stretch)]) for e in (estimate, other))
    off = float(np.hypot(*(after - before)[:2]))
    turned = float(np.rad2deg(abs(se2.wrap_angle(after[2] - before[2]))))
    number = step.recording.number + 1
    return Fact.of("worse-than-parts", recording=number, stretch=(begin, end), start=start, off=off, turned=turned)
