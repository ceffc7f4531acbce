"""The clouds of all keyframes and their rasters; made again only where scans or times have changed."""

from dataclasses import replace

import numpy as np

from ..arrays import Ints
from ..graph.work import POINTS, Work
from ..lidar import cloud_rasters, clouds
from ..lidar.cloud_rasters import ScanClouds
from ..lidar.clouds import Clouds
from ..odometry.attached import choose_scans, scan_points
from .mapping_config import MappingConfig
from .recordings import Recording, Recordings

_BLOCK = 32
"""Keyframes whose rays are in memory at once."""


def make(recordings: Recordings, config: MappingConfig, delay: float, work: Work) -> ScanClouds:
    """Return the clouds of all recordings, the lidar's clock taken as late by `delay` s, whose work is counted."""
    parts = [part for r in recordings.each for part in _blocks(r, np.arange(len(r.frames)), config, delay)]
    built = clouds.joined(parts)
    return _with_raster(replace(built, work=work), config, delay, len(built.points))


def remake(old: ScanClouds, before: Recordings, after: Recordings, config: MappingConfig) -> ScanClouds:
    """Return the clouds of recordings to which keyframes were added; unchanged clouds are taken over."""
    pairs = list(zip(before.each, after.each, strict=True))
    former = np.concatenate([_former(a, b, config, old.delay) for a, b in pairs])
    changed = [np.flatnonzero(former[b.rows] < 0) for b in after.each]
    parts = [p for r, which in zip(after.each, changed, strict=True) for p in _blocks(r, which, config, old.delay)]
    place = np.where(former >= 0, former, len(old.clouds) + np.cumsum(former < 0) - 1)
    both = clouds.joined([old.clouds, *parts]).chosen(place)
    return _with_raster(replace(both, work=old.clouds.work), config, old.delay, sum(len(p.points) for p in parts))


def _with_raster(built: Clouds, config: MappingConfig, delay: float, new: int) -> ScanClouds:
    """Return clouds with rasters, and count so many points of them as made."""
    built.work[POINTS] += new
    raster = cloud_rasters.rasterize(built, config.clouds.raster, max(config.refinement.first_gate, 0.2))
    return ScanClouds(built, raster, delay)


def _blocks(recording: Recording, which: Ints, config: MappingConfig, delay: float) -> list[Clouds]:
    """Return the clouds of some keyframes (w,) of a recording, a block at a time; empty ones without lidar."""
    log, frames = recording.log.with_later_scans(delay), recording.frames
    if log.scans is None:
        none = np.zeros(0, dtype=np.intp)
        return [Clouds(np.zeros(len(which) + 1, dtype=np.intp), np.zeros((0, 2)), np.zeros((0, 2)), none, np.zeros(0))]
    owner, chosen = choose_scans(log.scans, frames, config.keyframes)
    blocks = []
    for first in range(0, len(which), _BLOCK):
        block = which[first : first + _BLOCK]
        own = np.flatnonzero(np.isin(owner, block))
        rays = scan_points(log, frames, owner[own], chosen[own], config.clouds.range_max)
        blocks.append(clouds.build(replace(rays, keyframe=np.searchsorted(block, rays.keyframe)), len(block), config.clouds))
    return blocks


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
        now, then = owners[1], owners[0]
        moved = (now >= 0) & (then != at[now])
        same &= (np.bincount(now[moved], minlength=len(stamps)) == 0) & (counts[0][at] == counts[1])
    return np.where(same, before.first + at, -1)
