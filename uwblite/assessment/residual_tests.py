"""Tests of each kind of measurement against the joint estimate: residuals that noise cannot explain are a doubt.

Every test compares the residuals of the estimate with the sensor's own noise, over stretches of time, and
is not specific to one fault.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, spread_about_median
from ..findings import Finding, doubt, warning
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..grid.occupancy_grid import OccupancyGrid
from ..pipeline.estimate import Estimate, Task
from ..pipeline.recordings import Recordings
from ..radio.line_of_sight import blocked
from ..radio.range_noise import short_term_sigma
from .facts import listed
from .untied_parts import untied_steps

_SCATTER, _TIMES_NOISE = 0.3, 3.0
"""Largest typical scatter of ranges about the map under multipath and NLOS, m, and relative to their scatter from one to the
next."""
_FREE, _EARLY = 0.1, 0.05
"""Least share of ranges in line of sight to represent all, and share that gross errors make too short."""
NO_DISTANCES = 1.5
"""Ranges that scatter by more are no distances, m."""
_JUMP, _CARRIED = 20.0, 0.5
"""Standard deviations that a step of wheels on the floor never exceeds; and the size, m or rad, too large for slip."""
_MEASURED = 1.0
"""Steps more uncertain than wheels that slip, m, are no measurements."""


def seconds(recordings: Recordings, keyframe: int) -> float:
    """Return the time of a keyframe since the first one of its recording, s."""
    first = int((recordings.of_keyframe == recordings.of_keyframe[keyframe]).argmax())
    return float(recordings.stamps[keyframe] - recordings.stamps[first])


def between_keyframes(finding: Finding, recordings: Recordings, *spans: tuple[int, int]) -> Finding:
    """Return a finding that concerns the stretches from one keyframe to another, with the command that leaves them out.

    Parameters
    ----------
    spans : first and last keyframe of each stretch, in one recording; there is one at least.
    """
    stretches = tuple((float(recordings.stamps[first]), float(recordings.stamps[last])) for first, last in spans)
    begin, end = seconds(recordings, spans[0][0]), seconds(recordings, spans[-1][1])
    number = int(recordings.of_keyframe[spans[0][0]]) + 1
    cure = (
        f"`end={begin:.0f}` and `start={end:.0f}` give the parts before and after it; "
        "map each, or both together where they have anchors in common"
    )
    return replace(finding, recording=number, stretches=stretches, cure=cure)


def check_range_scatter(estimate: Estimate, residuals: Floats, grid: OccupancyGrid | None, task: Task) -> Iterator[Finding]:
    """Compare how ranges scatter about the map with how they scatter from one to the next.

    Behind metal shelves, ranges are too long by half a metre, but none is too short. Where a lidar shows the obstacles, only
    ranges in line of sight count then: wrong clocks, ids and trajectories also make ranges too short.

    Parameters
    ----------
    residuals : (m,) measured minus expected, m.
    """
    ranges = estimate.ranges
    if ranges is None or not (alive := ranges.alive).any():
        return
    # Clocks of different recordings may show the same times.
    apart = ranges.anchor + (ranges.anchor.max() + 1) * task.recordings.of_keyframe[ranges.pose]
    short = short_term_sigma(ranges.stamps[alive], apart[alive], ranges.ranges[alive], task.config.ranges)
    most = min(max(_SCATTER, _TIMES_NOISE * short), NO_DISTANCES)
    typical = _typical_spread(residuals[alive], ranges.anchor[alive])
    if most < typical < NO_DISTANCES and grid is not None and np.mean(residuals[alive] < -most) < _EARLY:
        tags, anchors = ranges.tag_positions(estimate.graph.poses), estimate.graph.anchors[ranges.anchor]
        free = alive & ~blocked(tags, anchors, grid.occupied_points(), least=1)
        if free.sum() > _FREE * alive.sum():
            typical = _typical_spread(residuals[free], ranges.anchor[free])
    if typical <= most:
        return
    text = f"the ranges scatter by {typical:.1f} m about the map: they are not distances to stationary anchors; check the ids"
    if typical <= _TIMES_NOISE * short:
        yield doubt("range-scatter", text, typical=typical, short_term=short)
    else:
        # The ranges are good distances: what is wrong is the path, or to which time or anchor they belong.
        text = (
            f"the ranges differ from the map by {typical:.2f} m (median), but from one to the next by {short:.2f} m only: the "
            "radio's clock, anchor ids or the trajectory are wrong"
        )
        yield doubt("ranges-disagree", text, typical=typical, short_term=short)


def check_odometry(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Find steps of the odometry that the map contradicts far beyond their noise, whatever that was estimated to be.

    Where scans tie both sides of such steps, the wheels slipped and the map followed. Where ranges alone do, a robust kernel
    lets one step absorb the errors of many, and the map looks as if the robot had been carried.
    """
    wheels, recordings = estimate.odometry, task.recordings
    lidar = np.array([r.has_scans for r in recordings.each])[recordings.of_keyframe[wheels.i]]
    loose = untied_steps(estimate, recordings) if lidar.any() else np.flatnonzero(lidar)
    if len(loose := loose[lidar[loose]]):
        at = recordings.stamps[wheels.i[loose]] - recordings.stamps[0]
        text = (
            f"at t = {listed(at.tolist())} s the odometry fails where the lidar cannot measure the travelled distance, as "
            "along a bare wall, and neither loop closures nor ranges connect the parts before and after: they may be misplaced "
            "to each other; drive through the first part once more"
        )
        yield doubt("loose-links", text, at=at.tolist())
    whitened, noise = wheels.residuals(estimate.graph), 1.0 / wheels.sqrt_information[:, 0, 0]
    if not len(noise) or not estimate.placed.any():
        return
    # Of a step that probably slipped the noise is that of slip: it is compared with the noise of the others. But wheels that
    # slip count too much: a robot that moved farther was carried.
    larger = noise / (2.0 * np.median(noise))
    poses, counted = estimate.graph.poses, wheels.corrected(estimate.graph)
    moved = se2.between(poses[wheels.i], poses[wheels.j])
    carried = np.hypot(moved[:, 0], moved[:, 1]) > np.hypot(counted[:, 0], counted[:, 1]) + _CARRIED
    off = ~lidar & (np.abs(whitened).max(axis=1) * np.maximum(larger, 1.0) > _JUMP)
    far = np.flatnonzero(off & (noise < _MEASURED) & ((larger <= 1.0) | carried))
    if len(far):
        yield _slips(far, whitened, wheels, recordings)


def _slips(at: Ints, whitened: Floats, wheels: OdometryEdges, recordings: Recordings) -> Finding:
    """Return the finding on single steps (s,) that are far off by the ranges, where no scans tie their sides."""
    when = listed([seconds(recordings, k) for k in wheels.i[at].tolist()])
    off = np.einsum("eij,ej->ei", np.linalg.inv(wheels.end_sqrt_information[at]), whitened[at])
    way, turn = float(np.hypot(off[:, 0], off[:, 1]).max()), float(np.abs(off[:, 2]).max())
    text = (
        f"at t = {when} s the ranges contradict the odometry by up to {way:.2f} m and {turn:.2f} rad: the wheels slipped or "
        "were stuck, or the robot or all anchors were carried"
    )
    add = doubt if max(way, turn) > _CARRIED else warning
    spans = [(int(wheels.i[k]), int(wheels.j[k])) for k in at]
    return between_keyframes(add("odometry-slips", text, way=way, turn=turn), recordings, *spans)


def check_support(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map that nothing but the odometry constrains."""
    ranges = estimate.ranges
    constrained = ranges is not None and bool(ranges.alive.any())
    constrained |= any(isinstance(edges, ScanEdges | RelativePoseEdges) for edges in estimate.graph.edges)
    if not constrained and len(estimate.graph.poses) > 2:
        text = "neither ranges nor scans constrain the trajectory: it is the odometry's, which drifts; check the other sensors"
        yield doubt("odometry-alone", text)


def _typical_spread(residuals: Floats, anchor: Ints) -> float:
    """Return the robust standard deviation of the residuals (m,) of a typical anchor, m."""
    return float(np.median([spread_about_median(residuals[anchor == k]) for k in np.unique(anchor)]))
