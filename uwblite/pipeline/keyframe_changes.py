"""Keyframes that are moved in time or added after the first optimisation, and the edges made from them before.

The lidar's clock is known only once scans have been matched, and so is where the odometry needs more keyframes. Poses are
then interpolated on the trajectory; the edges of odometry and ranges are made from the recording again.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Ints
from ..graph.graph import Edges, PriorEdges
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..graph.range_edges import RangeEdges
from ..odometry.attached import attach_ranges
from ..odometry.wheels import drift_time
from .estimate import Estimate
from .recordings import Recordings

_STANDING = 1e-3
"""m/s or rad/s; a robot that stands spreads the odometry's noise evenly in time."""


def with_keyframes(estimate: Estimate, before: Recordings, after: Recordings) -> Estimate:
    """Return the estimate for recordings whose keyframes were moved in time or added.

    Parameters
    ----------
    before, after : the recordings with the estimate's keyframes and with the new ones: as many, or more in between.
    """
    pairs = list(zip(before.each, after.each, strict=True))
    poses, number, odometry = estimate.graph.poses, np.arange(len(before.stamps)), estimate.odometry
    if len(after.stamps) != len(before.stamps):
        poses = np.concatenate([old.dense_trajectory(poses, new.frames.stamps) for old, new in pairs])
        number = np.concatenate([new.first + np.searchsorted(new.frames.stamps, old.frames.stamps) for old, new in pairs])
        odometry = _cut(odometry, number, after)
    frames = [recording.frames for recording in after.each]
    motion, length = (np.concatenate([getattr(f, name) for f in frames]) for name in ("motion", "length"))
    odometry = replace(odometry, motion=motion, length=length, duration=np.concatenate([drift_time(f) for f in frames]))
    edges = tuple(_renumbered(e, number) for e in estimate.graph.edges)
    ranges = None if estimate.ranges is None else _attached(estimate.ranges, before, after)
    fixed = np.isin(np.arange(len(poses)), number[estimate.graph.fixed_poses])
    graph = replace(estimate.graph, poses=poses, edges=edges, fixed_poses=fixed)
    rejected = None if estimate.rejected is None or len(poses) != len(estimate.rejected) else estimate.rejected
    return replace(estimate, graph=graph, odometry=odometry, ranges=ranges, rejected=rejected, recordings=after)


def _cut(odometry: OdometryEdges, number: Ints, after: Recordings) -> OdometryEdges:
    """Return a step for every pair of following keyframes; those into which one was cut share its variance.

    Parameters
    ----------
    number : (k,) the new number of each keyframe.
    """
    begins = np.concatenate([r.first + np.arange(len(r.frames) - 1) for r in after.each])
    way = np.concatenate([r.frames.path + r.frames.turned + _STANDING * r.frames.duration for r in after.each])
    origin = np.searchsorted(number[odometry.i], begins, "right") - 1
    share = np.maximum(way / np.maximum(np.bincount(origin, way)[origin], 1e-12), 1e-6)
    pieces = odometry.rows(origin)
    root = pieces.sqrt_information / np.sqrt(share)[:, None, None]
    return replace(pieces, i=begins, j=begins + 1, sqrt_information=root)


def _renumbered(edges: Edges, number: Ints) -> Edges:
    """Return edges of keyframes that have got other numbers."""
    if isinstance(edges, PriorEdges) and edges.block == "poses":
        return replace(edges, index=number[edges.index])
    return replace(edges, i=number[edges.i], j=number[edges.j]) if isinstance(edges, RelativePoseEdges) else edges


def _attached(ranges: RangeEdges, before: Recordings, after: Recordings) -> RangeEdges:
    """Return ranges attached to the keyframes before them as these are now."""
    pose, arm, turn, velocity = ranges.pose.copy(), ranges.lever_arm.copy(), ranges.turn.copy(), ranges.velocity.copy()
    for old, recording in zip(before.each, after.each, strict=True):
        log = recording.log
        own = np.flatnonzero(old.has(ranges.pose))
        if log.ranges is None or not len(own):
            continue
        again = attach_ranges(log.ranges, log.odometry, recording.frames, log.mounting)
        tag = np.asarray(log.mounting.tag_position[:2], dtype=np.float64)
        pose[own], turn[own], velocity[own] = again.keyframe + recording.first, again.turn, again.velocity
        arm[own] = again.lever_arm + se2.rotate(again.turn, tag - ranges.tag)
    return replace(ranges, pose=pose, lever_arm=arm, turn=turn, velocity=velocity)
