"""Sensors that repeat themselves while the robot moves, readings that were written twice, and stamps that stand still."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, runs_of
from ..sensor_log import Remark, SensorLog

_SAME_RANGES = 12
"""Equal ranges in a row that no radio gives while the robot moves: their noise is centimetres, their resolution millimetres."""
_MOVED = 0.5
"""Travelled distance, m, over which a range of noise alone would not stay the same to the last digit."""
_SAME_SCANS = 3
"""Equal scans in a row that no lidar gives: some beam of hundreds always changes."""
_LEAST_SEEN = 10
"""Beams that must see something; scans that see nothing are rightly equal."""


def without_bursts(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Spread readings of odometry and lidar that share one stamp because they waited in a buffer.

    Each burst is spread evenly over the time since the one before; what then remains is a delay, which is calibrated.
    """
    remarks = []
    for name, what, sensor in (("odometry", "odometry readings", log.odometry), ("scans", "scans", log.scans)):
        if sensor is not None and (spread := _spread(sensor.stamps)) is not None:
            log = replace(log, **{name: replace(sensor, stamps=spread[0])})  # type: ignore[arg-type]
            remarks.append(_burst_remark(what, *spread[1:]))
    return log, remarks


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


def _burst_remark(what: str, size: float, between: float) -> Remark:
    text = (
        f"{what} come in bursts of about {size:.0f} with one stamp, every {between:.2f} s: they were spread over the time "
        "since the burst before; stamp each reading when it is made"
    )
    return Remark("stamps-in-bursts", text)


_BURST, _LEAST_BURSTS = 4, 5
"""Readings with one stamp that make a burst (two or three are a coarse clock), and bursts that must be."""


def without_repeated_scans(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Leave out scans that repeat the one before to the last digit."""
    scans = log.scans
    if scans is None or len(scans.stamps) < _SAME_SCANS:
        return log, []
    again = _repeats(scans.ranges)
    twice = again & np.concatenate([[False], np.diff(scans.stamps) == 0.0])
    seen = np.isfinite(scans.ranges).sum(axis=1) >= _LEAST_SEEN
    stuck = again & seen & _in_runs(again & seen & ~twice, _SAME_SCANS - 1)
    wrong = twice | stuck
    if not wrong.any():
        return log, []
    remarks = []
    if stuck.any():
        start = float(log.odometry.stamps[0])
        when = _when(scans.stamps, stuck, start)
        share = f"{int(stuck.sum())} of {len(stuck)} scans repeat the one before to the last digit ({when})"
        remarks.append(Remark("repeated-scans", f"{share}: the lidar or its driver stood still; they were left out"))
    return replace(log, scans=scans.rows(~wrong)), remarks


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


def without_repeated_ranges(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Leave out ranges that repeat themselves to the last digit while the robot moves, and ranges written twice."""
    ranges = log.ranges
    if ranges is None or len(ranges.stamps) < 2:
        return log, []
    travelled = np.interp(ranges.stamps, log.odometry.stamps, log.odometry.travelled)
    wrong, remarks, start = np.zeros(len(ranges.stamps), dtype=bool), [], float(log.odometry.stamps[0])
    for anchor, name in enumerate(ranges.anchor_ids):
        own = np.flatnonzero(ranges.anchor == anchor)
        same = np.concatenate([[False], np.diff(ranges.ranges[own]) == 0.0])
        twice = same & np.concatenate([[False], np.diff(ranges.stamps[own]) == 0.0])
        stuck = np.zeros(len(own), dtype=bool)
        for first, last in runs_of(same & ~twice):
            far = travelled[own[last - 1]] - travelled[own[first - 1]] > _MOVED
            if last - first >= _SAME_RANGES and far and ranges.ranges[own[first]] > 0.0:
                stuck[first - 1 : last] = True
        if stuck.any():
            when = _when(ranges.stamps[own], stuck, start)
            text = f"anchor {name} repeats one range to the last digit while the robot moves ({when}); these were left out"
            remarks.append(Remark("repeated-ranges", text))
        wrong[own[twice | stuck]] = True
    if not wrong.any():
        return log, []
    return replace(log, ranges=None if wrong.all() else ranges.rows(~wrong)), remarks


def without_marks(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Leave out a value that stands for no distance: what a radio reports beyond its reach, or when it missed its partner."""
    ranges = log.ranges
    if ranges is None or len(ranges.stamps) < _MARKS:
        return log, []
    travelled = np.interp(ranges.stamps, log.odometry.stamps, log.odometry.travelled)
    # A robot that stands repeats itself rightly.
    apart = np.column_stack([ranges.ranges, ranges.anchor, np.floor(travelled / _MOVED)])[ranges.ranges > 0.0]
    mark = _mark(np.unique(apart, axis=0)[:, 0])
    if mark is None:
        return log, []
    wrong = ranges.ranges == mark
    if len(np.unique(ranges.anchor[wrong])) < 2:  # one that is stuck
        return log, []
    text = (
        f"{int(wrong.sum())} of {len(wrong)} ranges are {mark:g} m to the last digit, wherever the robot is: the radio "
        "marks with it what it could not measure; these were left out"
    )
    return replace(log, ranges=ranges.rows(~wrong)), [Remark("repeated-ranges", text)]


def without_lidar_marks(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Take a reading that stands for no distance as no wall: what a lidar or its driver reports beyond its reach, say."""
    scans = log.scans
    if scans is None or not len(scans.stamps):
        return log, []
    travelled = np.interp(scans.stamps, log.odometry.stamps, log.odometry.travelled)
    apart = scans.ranges[np.unique(np.floor(travelled / _MOVED), return_index=True)[1]]
    holds = (apart >= scans.range_min) & (apart <= scans.range_max)
    mark = _mark(apart[holds])
    if mark is None or np.any(apart == np.float32(mark), axis=1).sum() < _MARKS:
        return log, []
    wrong = scans.ranges == np.float32(mark)
    farthest = mark == float(apart[holds].max())
    what = "it marks with it what it did not see" if farthest else "it is a mark, or the robot itself that it sees"
    share = f"{int(wrong.sum())} of {wrong.size} readings of the lidar are {mark:g} m to the last digit, wherever the robot is"
    ranges = np.where(wrong, np.float32(np.inf if farthest else np.nan), scans.ranges)
    scans = replace(scans, ranges=ranges, range_max=mark if farthest else scans.range_max)
    return replace(log, scans=scans), [Remark("repeated-readings", f"{share}: {what}; they were taken as no wall")]


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


def _when(stamps: Floats, flags: Bools, start: float) -> str:
    """Return when the flags are set, in words."""
    runs = runs_of(flags)
    text = ", ".join(f"t = {stamps[a] - start:.0f} to {stamps[b - 1] - start:.0f} s" for a, b in runs[:3])
    return text + (f", and {len(runs) - 3} more stretches" if len(runs) > 3 else "")
