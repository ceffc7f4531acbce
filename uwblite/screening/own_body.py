"""Beams that see the robot itself: a mast, a tray, a cable of its own."""

from dataclasses import replace

import numpy as np

from ..arrays import Bools, Ints, runs_of
from ..findings import Fact
from ..sensor_log import LaserScans, SensorLog

_SECTOR = np.deg2rad(30.0)
"""Turn after which walls are elsewhere in a scan, rad: a robot that follows a wall has it at one side only without turns."""
_SECTORS, _WAY = 8, 3.0
"""Least number of such turns, and least travelled distance, m, for a recording to show objects that move with the robot."""
_NEAR = 0.8
"""m; parts of a robot are nearer to its lidar than this."""
_STEADY, _SHARE, _ENOUGH = 0.04, 0.8, 500
"""Deviation from a beam's median that noise of lidars makes nearby, m, share of the readings within it, and scans that show
the median."""


def without_own_body(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Remove readings that stay the same at all places and headings of the robot."""
    scans = log.scans
    if scans is None or not len(scans.stamps) or log.odometry.travelled_at(scans.stamps[-1:])[0] < _WAY:
        return log, []
    _, sector = np.unique(np.floor(log.odometry.at(scans.stamps)[:, 2] / _SECTOR), return_inverse=True)
    if sector.max() + 1 < _SECTORS:
        return log, []
    own = _steady(scans, sector)
    if not own.any():
        return log, []
    ranges = np.where(own, np.float32(np.nan), scans.ranges)
    where = np.rad2deg(scans.angles)
    sectors = [(float(where[a]), float(where[b - 1])) for a, b in runs_of(own)]
    fact = Fact.of("own-body", count=int(own.sum()), total=len(own), sectors=sectors)
    return replace(log, scans=replace(scans, ranges=ranges)), [fact]


def _steady(scans: LaserScans, sector: Ints) -> Bools:
    """Return which beams (b,) have the same near reading in nearly all scans (k,), with equal weight of every sector of
    headings."""
    some = scans.ranges[:: max(1, len(sector) // _ENOUGH)]
    middle = np.median(np.where(scans.hits(some), some, np.inf), axis=0)
    own = middle < _NEAR
    with np.errstate(invalid="ignore"):
        alike = np.abs(scans.ranges[:, own] - middle[own]) < _STEADY
    share = alike / np.bincount(sector)[sector, None]
    own[own] = share.sum(axis=0) >= _SHARE * (sector.max() + 1)
    return own
