"""Never worse than its parts: where ranges and odometry deny a step of the lidar's path, the map without that step competes.

A step of the path that scan matching has broken tears the map, and ranges along it look like anchors that were moved together.
Both explanations are scored on one set of measurements, with associations made anew for either: the evidence of all ranges with
the anchors' likeliest places and moves, the odometry's steps with the tail of slips, and the rays of one side of the step on the
surfaces and in the free space of the other. The problem with the step left to wheels and radio is solved from the estimate, and
replaces it only where it is the more probable one: ranges that are wrong together do not outweigh what both sides saw.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..findings import Finding, doubt
from ..graph.pose_edges import ScanEdges
from ..lidar.registration import Registration
from ..lidar.scan_matching import pair_points
from ..lidar.visibility import nearest_by_bearing
from ..odometry.slips import log_densities, with_slips
from . import lidar_stages, surface_adjustment
from .anchor_places import BrokenStep, broken_steps, range_evidence
from .estimate import Estimate, Task
from .radio_stages import rough, with_range_noise

_SUDDEN = 5.0
"""Standard deviations that a step of faultless wheels hardly ever exceeds."""
_AROUND = 2.0
"""Time within which steps that contradict the odometry are one slip, s: twice as long as one lasts on the mean, or less."""


def replace_broken_stretches(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with each broken step of the lidar's path left to wheels and radio where that is more probable."""
    if estimate.scans is None or estimate.ranges is None or estimate.joint is None or estimate.rests_on_ranges:
        return estimate
    for step in broken_steps(estimate, task, _suspects(estimate, task)):
        stretch = _stretch(estimate, task, step.begin)
        other = _released(estimate, task, step, stretch)
        gain = step.log_odds_beforehand() + _gain(other, estimate, task, step)
        task.stages.end("broken stretch", begin=round(float(task.recordings.stamps[stretch[0]]), 2), gain=round(gain, 1))
        if gain > 0.0:
            estimate = _adjusted(other, task)
            task.stages.findings.append(_finding(step, stretch, task))
    return estimate


def _off(estimate: Estimate) -> Bools:
    """Return which steps (e,) of the odometry contradict the path."""
    return np.asarray(np.abs(estimate.odometry.residuals(estimate.graph)).max(axis=1) > _SUDDEN)


def _suspects(estimate: Estimate, task: Task) -> Ints:
    """Return the keyframe at which each stretch that contradicts the odometry begins."""
    ends = estimate.odometry.j[_off(estimate)]
    later = np.diff(task.recordings.stamps[ends], prepend=-np.inf) > _AROUND
    return np.asarray(ends[later], dtype=np.intp)


def _stretch(estimate: Estimate, task: Task, begin: int) -> tuple[int, int]:
    """Return the first and last keyframe of the steps around a broken one, which ends at a keyframe, that contradict as well."""
    stamps, of = task.recordings.stamps, task.recordings.of_keyframe
    ends = np.append(estimate.odometry.j[_off(estimate)], begin)
    ends = np.unique(ends[of[ends] == of[begin]])
    group = np.cumsum(np.diff(stamps[ends], prepend=stamps[ends[0]]) > _AROUND)
    own = ends[group == group[np.searchsorted(ends, begin)]]
    return int(own[0]) - 1, int(own[-1])


def _displaced(estimate: Estimate, step: BrokenStep) -> Bools:
    """Return which keyframes (k,) lie on the far side of a broken step."""
    number = np.arange(len(estimate.graph.poses))
    return (number >= step.begin) & (number < step.end)


def _released(estimate: Estimate, task: Task, step: BrokenStep, stretch: tuple[int, int]) -> Estimate:
    """Return the estimate with a stretch left to wheels that slip and ranges, and all clouds matched anew from there."""
    assert estimate.joint is not None
    far, (first, last) = _displaced(estimate, step), stretch
    graph = replace(estimate.graph, poses=step.displaced(estimate.graph.poses), anchors=step.places(estimate.graph.anchors))
    slips = (estimate.odometry.i >= first) & (estimate.odometry.j <= last)
    lidar = estimate.joint.rows(_kept(estimate.joint, far, first, last))
    other = replace(
        estimate, graph=graph, joint=lidar, steps=None, surfaces=None, odometry=with_slips(estimate.odometry, slips.astype(float))
    )
    for _ in range(2):
        other = lidar_stages.solved(with_range_noise(other, task.config), rough(task.config.solver))
    return lidar_stages.refine_jointly(replace(other, joint=None), task)


def _kept(edges: ScanEdges, far: Bools, first: int, last: int) -> Bools:
    """Return which scan edges (e,) neither begin nor end within a stretch, nor lead across the broken step."""
    inside = [(first < end) & (end < last) for end in (edges.i, edges.j)]
    return ~(inside[0] | inside[1]) & (far[edges.i] == far[edges.j])


def _gain(other: Estimate, estimate: Estimate, task: Task, step: BrokenStep) -> float:
    """Return by how much the log likelihood of all measurements is greater along another path, all associations made anew."""
    assert estimate.joint is not None
    assert other.joint is not None
    far = _displaced(estimate, step)
    i, j = (np.concatenate([getattr(e.joint, end) for e in (estimate, other)]) for end in ("i", "j"))
    i, j = np.unique(np.stack([i, j])[:, far[i] != far[j]], axis=1)
    scans, points = estimate.lidar, pair_points(estimate.lidar.clouds, j, task.config.scan_to_scan.points)
    rays_of = Registration(scans.clouds, scans.raster, nearest_by_bearing(scans.clouds), task.config.scan_to_scan.sigma)
    degree = np.bincount(j, minlength=len(far))[j]
    scores = []
    for each in (other, estimate):
        rays = rays_of.log_likelihood(i, points, se2.between(each.graph.poses[i], each.graph.poses[j])) / degree
        wheels = log_densities(estimate.odometry, each.graph)
        scores.append(np.array([range_evidence(each, task), float(np.sum(wheels)), float(np.sum(rays))]))
    return float(np.sum(scores[0] - scores[1]))


def _adjusted(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with weights of ranges, and walls and columns, as after every joint refinement."""
    return surface_adjustment.adjust_surfaces(lidar_stages.solve_by_own_errors(estimate, task), task)


def _finding(step: BrokenStep, stretch: tuple[int, int], task: Task) -> Finding:
    """Return what the user is told of a stretch that was replaced."""
    stamps, start = task.recordings.stamps, float(step.recording.log.odometry.stamps[0])
    begin, end = (float(stamps[k]) for k in stretch)
    off, turned = float(np.hypot(*step.motion[:2])), float(np.rad2deg(abs(step.motion[2])))
    told = doubt(
        "worse-than-parts",
        f"from t = {begin - start:.0f} to {end - start:.0f} s the lidar is not understood: wheels and ranges together deny "
        f"{off:.1f} m and {turned:.0f} deg of its motion; its matches there were left out, and all scans matched anew from where "
        "wheels and ranges have them",
        off=off, turned=turned,
    )  # fmt: skip
    cure = (
        f"`uwblite convert run.log part.log --end {begin - start:.0f}` and map it: the part before that is supported best; "
        "`uwblite map --without lidar` shows what wheels and ranges say of the rest"
    )
    return replace(told, sensor="lidar", recording=step.recording.number + 1, stretches=((begin, end),), cure=cure)
