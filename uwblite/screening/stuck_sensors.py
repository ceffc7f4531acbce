"""Sensors that repeat themselves while the robot moves, beams that see it, readings written twice, stamps that stand still."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints, runs_of, white_noise
from ..findings import Fact
from ..sensor_log import LaserScans, SensorLog

_SAME_RANGES = 12
"""Least number of constant ranges in a row."""
_MOVED = 0.5
"""Travelled distance, m, from which on a robot is elsewhere."""
_NEW_PLACE = 0.01
"""Travelled distance, m, after which a range is a new measurement, for a robot that hardly moves."""
_UNLIKELY = 25.0
"""Negative logarithm of a probability so small that chance does not reach it in any recording."""
_MIDDLE = (0.05, 0.95)
"""Quantiles between which ranges count as standing; about the ends of a stretch some do not."""
_FINEST, _FINEST_STEP = 0.02, 0.001
"""Quantile of the steps between values that occur, and the finest resolution that counts, m."""
_CHANGES, _STEPS = 0.2, 4.0
"""Change of a range, m and in steps of its resolution, with which it is measured and not repeated."""
_QUIET, _ENOUGH = 0.25, 8
"""Quantile of the noise of stretches that represents line of sight, and the least number of stretches to know it."""
_USUAL_NOISE, _LEAST_NOISE = 0.03, 0.005
"""Noise of such radios, m, where the recording does not show it, and the least that is assumed."""
_SAME_SCANS = 3
"""Number of equal scans in a row that a working lidar never gives: some beam of hundreds always changes."""
_OFTEN, _FEW_REPEATS = 0.1, 5
"""Share of the scans, and number, from which on even single repeats are no chance; of seven real recordings one has any
(0.5 %)."""
_LEAST_SEEN = 10
"""Least number of beams with a reading; scans without readings may be equal."""


def without_bursts(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Spread readings of odometry and lidar that share one stamp because they waited in a buffer.

    Each burst is spread evenly over the time since the one before; the remaining delay is calibrated.
    """
    facts = []
    for name, what, sensor in (("odometry", "odometry readings", log.odometry), ("scans", "scans", log.scans)):
        if sensor is not None and (spread := _spread(sensor.stamps)) is not None:
            log = replace(log, **{name: replace(sensor, stamps=spread[0])})  # type: ignore[arg-type]
            facts.append(Fact.of("stamps-in-bursts", readings=what, size=spread[1], period=spread[2]))
    return log, facts


def _spread(stamps: Floats) -> tuple[Floats, float, float] | None:
    """Return stamps (n,) with bursts spread, s, usual size of a burst and time between two; None without bursts."""
    distinct, group, size = np.unique(stamps, return_inverse=True, return_counts=True)
    usual = float(np.median(size[group])) if len(stamps) else 0.0
    if len(distinct) < _LEAST_BURSTS or usual < _BURST:
        return None
    gap = np.diff(distinct)
    between = float(np.median(gap))
    gap = np.minimum(np.concatenate([[between], gap]), between)
    place = np.arange(len(stamps)) - np.searchsorted(stamps, distinct)[group]
    return stamps - gap[group] * (1.0 - (place + 1.0) / size[group]), usual, between


_BURST, _LEAST_BURSTS = 4, 5
"""Readings with one stamp that make a burst (two or three are a coarse clock), and bursts that must be."""


def without_repeated_scans(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out scans that repeat the one before to the last digit.

    Two in a row may be alike by chance. A driver that sends at twice the lidar's rate repeats many: each is a step of the
    wheels on which the lidar would stand still.
    """
    scans = log.scans
    if scans is None or len(scans.stamps) < _SAME_SCANS:
        return log, []
    again = _repeats(scans.ranges)
    twice = again & np.concatenate([[False], np.diff(scans.stamps) == 0.0])
    seen = np.isfinite(scans.ranges).sum(axis=1) >= _LEAST_SEEN
    often = int(np.sum(again & seen & ~twice)) > max(_OFTEN * len(again), _FEW_REPEATS)
    stuck = again & seen & _in_runs(again & seen & ~twice, 1 if often else _SAME_SCANS - 1)
    wrong = twice | stuck
    if not wrong.any():
        return log, []
    facts = []
    if stuck.any():
        when = _when(scans.stamps, stuck, float(log.odometry.stamps[0]))
        facts.append(Fact.of("repeated-scans", count=int(stuck.sum()), total=len(stuck), stretches=when, often=often))
    return replace(log, scans=scans.rows(~wrong)), facts


def _repeats(readings: NDArray[np.floating]) -> Bools:
    """Return which scans (k, b) are the same as the one before to the last digit; a few beams exclude nearly all."""
    some = np.nan_to_num(readings[:, :: max(1, readings.shape[1] // _FEW_BEAMS)])
    again = np.zeros(len(readings), dtype=bool)
    again[1:] = np.all(some[1:] == some[:-1], axis=1)
    likely = np.flatnonzero(again)
    again[likely] = [np.array_equal(readings[k], readings[k - 1], equal_nan=True) for k in likely.tolist()]
    return again


_FEW_BEAMS = 32
"""Beams that are compared first."""


def without_repeated_ranges(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out ranges that stand still while the robot moves, and ranges written twice.

    Noise lets n ranges in a row lie within a width w with a probability of at most (w / (sigma sqrt(2 pi)))^n, wherever the
    robot drives: on a circle about the anchor, too. w is at least a step of the radio's resolution, so that ranges rounded to
    more than their noise repeat themselves rightly.
    """
    ranges = log.ranges
    if ranges is None or len(ranges.stamps) < 2:
        return log, []
    travelled = log.odometry.travelled_at(ranges.stamps)
    wrong, facts, start = np.zeros(len(ranges.stamps), dtype=bool), [], float(log.odometry.stamps[0])
    for anchor in range(len(ranges.anchor_ids)):
        own = np.flatnonzero(ranges.anchor == anchor)
        wrong[own[1:]] = (np.diff(ranges.ranges[own]) == 0.0) & (np.diff(ranges.stamps[own]) == 0.0)
    usable = ~wrong & (ranges.ranges > 0.0)
    each = [np.flatnonzero(usable & (ranges.anchor == anchor)) for anchor in range(len(ranges.anchor_ids))]
    resolution = resolution_of(ranges.ranges[usable])
    sigma = quiet_noise([ranges.ranges[own] for own in each], resolution)
    for name, own in zip(ranges.anchor_ids, each, strict=True):
        stuck = _standing(ranges.ranges[own], travelled[own], resolution, sigma)
        if stuck.any():
            facts.append(Fact.of("repeated-ranges", anchor=name, stretches=_when(ranges.stamps[own], stuck, start)))
        wrong[own[stuck]] = True
    if not wrong.any():
        return log, []
    return replace(log, ranges=None if wrong.all() else ranges.rows(~wrong)), facts


def _standing(values: Floats, travelled: Floats, resolution: float, sigma: float) -> Bools:
    """Return which of one anchor's ranges (m,) stand still while the robot travels; resolution and sigma of all, m."""
    stuck = np.zeros(len(values), dtype=bool)
    if len(values) < _SAME_RANGES:
        return stuck
    ends = np.ptp(np.lib.stride_tricks.sliding_window_view(values, _SAME_RANGES), axis=1)
    for most in (0.0, sigma):
        for first, last in runs_of(ends <= most):
            last += _SAME_RANGES - 1
            low, high = np.quantile(values[first:last], _MIDDLE)
            density = (high - low + resolution) / (sigma * np.sqrt(2.0 * np.pi))
            way = travelled[last - 1] - travelled[first]
            count = min(last - first, way / _NEW_PLACE)
            unlikely = density < 1.0 and -count * np.log(density) > _UNLIKELY
            # Where some repeat themselves to the last digit, those about them may be measured.
            stuck[first:last] |= way > _MOVED and unlikely and not stuck[first:last].any()
    return stuck


def resolution_of(values: Floats) -> float:
    """Return the step in which ranges (m,) come, m; far less than their noise where they are not rounded."""
    steps = np.diff(np.unique(np.round(values, 4)))
    return max(float(np.quantile(steps, _FINEST)), _FINEST_STEP) if len(steps) else _FINEST_STEP


def quiet_noise(each: list[Floats], resolution: float) -> float:
    """Return the noise of the quieter ranges, m: by stretches in which the range to an anchor clearly changes.

    Parameters
    ----------
    each : ranges of each anchor (m,), m. resolution : m; rounding looks like noise of up to 0.6 times as much.
    """
    found = []
    for values in each:
        parts = [values[k : k + _SAME_RANGES] for k in range(0, len(values) - _SAME_RANGES + 1, _SAME_RANGES)]
        found += [white_noise(part) for part in parts if np.ptp(part) > max(_CHANGES, _STEPS * resolution)]
    if len(found) < _ENOUGH:
        return _USUAL_NOISE
    return float(np.sqrt(max(np.quantile(found, _QUIET) ** 2 - (0.5 * resolution) ** 2, _LEAST_NOISE**2)))


def without_marks(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out a value that stands for no distance: what a radio reports beyond its reach, or when it missed its partner."""
    ranges = log.ranges
    if ranges is None or len(ranges.stamps) < _MARKS:
        return log, []
    travelled = log.odometry.travelled_at(ranges.stamps)
    # A robot that stands may repeat its readings.
    apart = np.column_stack([ranges.ranges, ranges.anchor, np.floor(travelled / _MOVED)])[ranges.ranges > 0.0]
    mark = _mark(np.unique(apart, axis=0)[:, 0])
    if mark is None:
        return log, []
    wrong = ranges.ranges == mark
    if len(np.unique(ranges.anchor[wrong])) < 2:  # one that is stuck
        return log, []
    fact = Fact.of("marked-ranges", count=int(wrong.sum()), total=len(wrong), value=mark, lidar=log.scans is not None)
    return replace(log, ranges=ranges.rows(~wrong)), [fact]


def without_lidar_marks(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Remove a reading that stands for no distance: for example the value of a lidar or its driver beyond its reach."""
    scans = log.scans
    if scans is None or not len(scans.stamps):
        return log, []
    travelled = log.odometry.travelled_at(scans.stamps)
    apart = scans.ranges[np.unique(np.floor(travelled / _MOVED), return_index=True)[1]]
    holds = scans.hits(apart)
    mark = _mark(apart[holds])
    if mark is None or np.any(apart == np.float32(mark), axis=1).sum() < _MARKS:
        return log, []
    wrong = scans.ranges == np.float32(mark)
    farthest = mark == float(apart[holds].max())
    fact = Fact.of("repeated-readings", count=int(wrong.sum()), total=wrong.size, value=mark, reach=farthest)
    ranges = np.where(wrong, np.float32(np.inf if farthest else np.nan), scans.ranges)
    scans = replace(scans, ranges=ranges, range_max=mark if farthest else scans.range_max)
    return replace(log, scans=scans), [fact]


def _mark(values: Floats | NDArray[np.float32]) -> float | None:
    """Return the value among readings (n,), of different places, that is far more frequent than others; None without one."""
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < 2:
        return None
    most = int(np.argmax(counts))
    usual = np.quantile(np.delete(counts, most), 0.9)
    frequent = counts[most] >= max(_MARKS, _MARK_SHARE * counts.sum(), _TIMES_OTHERS * usual)
    return float(distinct[most]) if frequent else None


_MARKS, _MARK_SHARE, _TIMES_OTHERS = 20, 0.03, 8.0
"""Readings (of a lidar: scans with readings) of one value at different places, their share of all, and how much more frequent
than others it must be. No value of seven recorded lidars, in steps of 1 mm to 1 cm, is more than 0.7 % of their readings."""


def _in_runs(flags: Bools, least: int) -> Bools:
    """Return which set flags stand in runs of at least so many."""
    long = np.zeros(len(flags), dtype=bool)
    for first, last in runs_of(flags):
        long[first:last] = last - first >= least
    return long


def _when(stamps: Floats, flags: Bools, start: float) -> list[tuple[float, float]]:
    """Return when the flags are set, first and last time of each stretch, s since the start."""
    return [(float(stamps[a] - start), float(stamps[b - 1] - start)) for a, b in runs_of(flags)]


_SECTOR = np.deg2rad(30.0)
"""Turn after which walls are elsewhere in a scan, rad: a robot that follows a wall has it at one side only without turns."""
_SECTORS, _WAY = 8, 3.0
"""Least number of such turns, and least travelled distance, m, for a recording to show objects that move with the robot."""
_NEAR = 0.8
"""m; parts of a robot are nearer to its lidar than this."""
_STEADY, _SHARE, _COMPARED = 0.04, 0.8, 500
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
    some = scans.ranges[:: max(1, len(sector) // _COMPARED)]
    middle = np.median(np.where(scans.hits(some), some, np.inf), axis=0)
    own = middle < _NEAR
    with np.errstate(invalid="ignore"):
        alike = np.abs(scans.ranges[:, own] - middle[own]) < _STEADY
    share = alike / np.bincount(sector)[sector, None]
    own[own] = share.sum(axis=0) >= _SHARE * (sector.max() + 1)
    return own
