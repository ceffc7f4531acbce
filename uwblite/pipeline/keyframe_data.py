"""What is made of a recording at its keyframes: clouds, and again, where keyframes are moved in time or added, all edges.

The lidar's clock is known only once scans have been matched, and so is where the odometry needs more keyframes. Poses are
then interpolated on the trajectory; clouds are made again only where scans or times have changed.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Ints, chunks
from ..graph.graph import Edges, PriorEdges
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..graph.range_edges import RangeEdges
from ..graph.work import POINTS, Work
from ..lidar import cloud_rasters, clouds
from ..lidar.cloud_rasters import ScanClouds
from ..lidar.clouds import Clouds
from ..odometry.attached import ScanPoints, attach_ranges, choose_scans, scan_points
from ..odometry.wheels import drift_time
from .estimate import Estimate
from .mapping_config import MappingConfig
from .recordings import Recording, Recordings

_AT_ONCE = 128
"""Keyframes whose rays are in memory at once."""
_LEAST_REACH = 0.2
"""m; least reach of the rasters."""
_STANDING = 1e-3
"""m/s or rad/s; a robot that stands spreads the odometry's noise evenly in time."""
_LEAST_SHARE = 1e-6
"""Of the variance of a step that was cut, for each of its pieces."""


def make(recordings: Recordings, config: MappingConfig, delay: float, work: Work) -> ScanClouds:
    """Return the clouds of all recordings, the lidar's clock taken as late by `delay` s, whose work is counted."""
    built = clouds.joined([part for recording in recordings.each for part in clouds_of(recording, config, delay)])
    return _with_raster(replace(built, work=work), config, delay, len(built.points))


def remake(old: ScanClouds, before: Recordings, after: Recordings, config: MappingConfig) -> ScanClouds:
    """Return the clouds of recordings to which keyframes were added; unchanged clouds are taken over."""
    former = np.concatenate([_former(*pair, config, old.delay) for pair in zip(before.each, after.each, strict=True)])
    parts = [part for r in after.each for part in clouds_of(r, config, old.delay, former[r.rows] < 0)]
    place = np.where(former >= 0, former, len(old.clouds) + np.cumsum(former < 0) - 1)
    both = clouds.joined([old.clouds, *parts]).chosen(place)
    return _with_raster(replace(both, work=old.clouds.work), config, old.delay, sum(len(part.points) for part in parts))


def _with_raster(built: Clouds, config: MappingConfig, delay: float, new: int) -> ScanClouds:
    """Return clouds with rasters, and count so many points of them as made."""
    built.work[POINTS] += new
    raster = cloud_rasters.rasterize(built, config.clouds.raster, max(config.refinement.first_gate, _LEAST_REACH))
    return ScanClouds(built, raster, delay)


def clouds_of(recording: Recording, config: MappingConfig, delay: float, wanted: Bools | None = None) -> Iterator[Clouds]:
    """Yield the clouds of the keyframes of a recording, or of those wanted (k,), some at a time; empty ones without lidar."""
    if not recording.has_scans:
        count = len(recording.frames) if wanted is None else int(wanted.sum())
        none, offsets = np.zeros(0, dtype=np.intp), np.zeros(count + 1, dtype=np.intp)
        yield Clouds(offsets, np.zeros((0, 2)), np.zeros((0, 2)), none, np.zeros(0))
    for some, rays in rays_of(recording, config, delay, wanted):
        built = clouds.build(replace(rays, keyframe=rays.keyframe - some.start), some.stop - some.start, config.clouds)
        yield built if wanted is None else built.chosen(np.flatnonzero(wanted[some]))


def _former(before: Recording, after: Recording, config: MappingConfig, delay: float) -> Ints:
    """Return the former keyframe (k,) with the same time and scans as each new one; -1 = there is none."""
    stamps, old = after.frames.stamps, before.frames.stamps
    at = np.minimum(np.searchsorted(old, stamps), len(old) - 1)
    same = old[at] == stamps
    log = after.log.with_later_scans(delay)
    if log.scans is not None:
        owners, counts = [], []
        for frames in (before.frames, after.frames):
            owner, chosen = choose_scans(log.scans, frames, config.keyframes)
            owners.append(np.full(len(log.scans.stamps), -1))
            owners[-1][chosen] = owner
            counts.append(np.bincount(owner, minlength=len(frames)))
        then, now = owners
        moved = (now >= 0) & (then != at[now])
        same &= (np.bincount(now[moved], minlength=len(stamps)) == 0) & (counts[0][at] == counts[1])
    return np.where(same, before.first + at, -1)


def rays_of(
    recording: Recording, config: MappingConfig, delay: float, wanted: Bools | None = None
) -> Iterator[tuple[slice, ScanPoints]]:
    """Yield some keyframes of a recording at a time, and the rays of those wanted (k,), None = of all."""
    log, frames = recording.log.with_later_scans(delay), recording.frames
    if log.scans is None:
        return
    owner, chosen = choose_scans(log.scans, frames, config.keyframes)
    if wanted is not None:
        owner, chosen = owner[wanted[owner]], chosen[wanted[owner]]
    for some in chunks(len(frames), _AT_ONCE):
        if wanted is None or wanted[some].any():
            own = (owner >= some.start) & (owner < some.stop)
            yield some, scan_points(log, frames, owner[own], chosen[own], config.clouds.range_max)


def with_keyframes(estimate: Estimate, before: Recordings, after: Recordings) -> Estimate:
    """Return the estimate for recordings whose keyframes were moved in time, or to which some were added in between."""
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
    share = way / np.maximum(np.bincount(origin, way)[origin], np.finfo(np.float64).tiny)
    pieces = odometry.rows(origin)
    root = pieces.sqrt_information / np.sqrt(np.maximum(share, _LEAST_SHARE))[:, None, None]
    return replace(pieces, i=begins, j=begins + 1, sqrt_information=root)


def _renumbered(edges: Edges, number: Ints) -> Edges:
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
