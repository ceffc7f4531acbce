"""Sensors that repeat themselves while the robot moves, beams that see it, values that stand for no distance."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import ENOUGH, MAD_TO_SIGMA, MOST, Bools, Floats, Ints, bends, evenly, row_medians, runs_of
from ..findings import Fact
from ..sensor_log import LaserScans, SensorLog


class RepeatPolicy:
    """From where on equal readings are no chance."""

    in_row: int = 12
    """Least number of constant ranges in a row."""
    moved: float = 0.5
    """Travelled distance, m, from which on a robot is elsewhere."""
    new_place: float = 0.01
    """Travelled distance, m, after which a range is a new measurement, for a robot that hardly moves."""
    unlikely: float = 25.0
    """Negative logarithm of a probability so small that chance does not reach it in any recording."""
    inner: tuple[float, float] = (0.05, 0.95)
    """Quantiles between which ranges count as standing; about the ends of a stretch some do not."""
    finest_share: float = 0.02
    finest: float = 0.001
    """Quantile of the steps between values that occur, and the finest resolution that counts, m."""
    changes: float = 0.2
    """Change of a range, m, or four steps of its resolution, with which it is measured and not repeated."""
    usual_noise: float = 0.03
    least_noise: float = 0.005
    """Noise of radios, m, where the recording does not show it, and the least that is assumed."""
    often: float = 0.1
    """Share of repeated scans from which on even single ones are no chance: of seven real recordings one has any, 0.5 %."""
    mark_share: float = 0.03
    times_others: float = 8.0
    """Share of all readings at different places, and how much more frequent than others a value is that stands for no distance;
    no value of seven lidars, in steps of 1 to 10 mm, is more than 0.7 %."""
    sector: float = float(np.deg2rad(30.0))
    """Turn after which walls are elsewhere in a scan, rad."""
    sectors: int = 8
    way: float = 3.0
    """Such turns, and way, m, that show what moves with the robot: along a wall there is one at the same side all the time."""
    near: float = 0.8
    """m; parts of a robot are nearer to its lidar than this."""
    steady: float = 0.04
    steady_share: float = 0.8
    """Deviation from a beam's median that noise of lidars makes nearby, m, and share of the readings within it."""


def without_repeated_scans(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out scans that repeat the one before to the last digit.

    Of hundreds of beams one always changes, but two scans in a row may be alike by chance. A driver that sends at twice the
    lidar's rate repeats many: each is a step of the wheels on which the lidar would stand still.
    """
    scans = log.scans
    if scans is None or len(scans.stamps) < 2:
        return log, []
    bits = scans.ranges.view(np.int32)
    few = bits[:, evenly(bits.shape[1], ENOUGH)]
    again = np.append(False, (few[1:] == few[:-1]).all(axis=1))
    again[again] = [np.array_equal(bits[k], bits[k - 1]) for k in np.flatnonzero(again)]
    twice = again & (np.diff(scans.stamps, prepend=-np.inf) == 0.0)
    stuck = again & ~twice
    stuck[stuck] = np.isfinite(scans.ranges[stuck]).sum(axis=1) >= 10
    often = int(np.sum(stuck)) > max(RepeatPolicy.often * len(again), 5)
    for first, last in runs_of(stuck):
        stuck[first:last] = often or last - first > 1
    wrong = twice | stuck
    if not wrong.any():
        return log, []
    when, facts = _when(scans.stamps, stuck, float(log.odometry.stamps[0])), []
    if when:
        facts.append(Fact.of("repeated-scans", count=int(stuck.sum()), total=len(stuck), stretches=when, often=often))
    return replace(log, scans=scans.rows(~wrong)), facts


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
    each = [np.flatnonzero(ranges.anchor == anchor) for anchor in range(len(ranges.anchor_ids))]
    for own in each:
        wrong[own[1:]] = (np.diff(ranges.ranges[own]) == 0.0) & (np.diff(ranges.stamps[own]) == 0.0)
    usable = ~wrong & (ranges.ranges > 0.0)
    each, resolution = [own[usable[own]] for own in each], resolution_of(ranges.ranges[usable])
    sigma = quiet_noise([ranges.ranges[own] for own in each], resolution)
    for name, own in zip(ranges.anchor_ids, each, strict=True):
        stuck = _standing(ranges.ranges[own], travelled[own], resolution, sigma)
        if stuck.any():
            facts.append(Fact.of("repeated-ranges", anchor=name, stretches=_when(ranges.stamps[own], stuck, start)))
        wrong[own[stuck]] = True
    return (replace(log, ranges=None if wrong.all() else ranges.rows(~wrong)) if wrong.any() else log), facts


def _standing(values: Floats, travelled: Floats, resolution: float, sigma: float) -> Bools:
    """Return which of one anchor's ranges (m,) stand still while the robot travels; resolution and sigma of all, m."""
    stuck, in_row = np.zeros(len(values), dtype=bool), RepeatPolicy.in_row
    if len(values) < in_row:
        return stuck
    ends = np.ptp(np.lib.stride_tricks.sliding_window_view(values, in_row), axis=1)
    for most in (0.0, sigma):
        for first, last in runs_of(ends <= most):
            last += in_row - 1
            low, high = np.quantile(values[first:last], RepeatPolicy.inner)
            density = (high - low + resolution) / (sigma * np.sqrt(2.0 * np.pi))
            way = travelled[last - 1] - travelled[first]
            count = min(last - first, way / RepeatPolicy.new_place)
            unlikely = density < 1.0 and -count * np.log(density) > RepeatPolicy.unlikely
            # Where some repeat themselves to the last digit, those about them may be measured.
            stuck[first:last] |= way > RepeatPolicy.moved and unlikely and not stuck[first:last].any()
    return stuck


def resolution_of(values: Floats) -> float:
    """Return the step in which ranges (m,) come, m; far less than their noise where they are not rounded."""
    steps = np.diff(np.unique(np.round(values, 4)))
    return max(float(np.quantile(steps, RepeatPolicy.finest_share)), RepeatPolicy.finest) if len(steps) else RepeatPolicy.finest


def quiet_noise(each: list[Floats], resolution: float) -> float:
    """Return the noise of the quieter ranges, m: by stretches in which the range to an anchor clearly changes.

    Parameters
    ----------
    each : ranges of each anchor (m,), m. resolution : m; rounding looks like noise of up to 0.6 times as much.
    """
    size = RepeatPolicy.in_row
    parts = np.concatenate([values[: len(values) // size * size].reshape(-1, size) for values in each])
    parts = parts[np.ptp(parts, axis=1) > max(RepeatPolicy.changes, 4.0 * resolution)]
    found = MAD_TO_SIGMA * row_medians(np.abs(bends(parts.T).T))
    if 2 * len(found) < size:
        return RepeatPolicy.usual_noise
    # A quarter of them are in line of sight.
    return float(np.sqrt(max(np.quantile(found, 0.25) ** 2 - (0.5 * resolution) ** 2, RepeatPolicy.least_noise**2)))


def without_marks(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out a value that stands for no distance: what a radio reports beyond its reach, or when it missed its partner."""
    ranges = log.ranges
    if ranges is None or len(ranges.stamps) < ENOUGH:
        return log, []
    # A robot that stands may repeat its readings.
    place = np.floor(log.odometry.travelled_at(ranges.stamps) / RepeatPolicy.moved)
    apart = np.column_stack([ranges.ranges, ranges.anchor, place])[ranges.ranges > 0.0]
    mark = _mark(np.unique(apart, axis=0)[:, 0])
    wrong = ranges.ranges == mark
    if mark is None or len(np.unique(ranges.anchor[wrong])) < 2:  # one that is stuck
        return log, []
    alone = log.scans is None and float(np.mean(wrong)) > 0.5
    fact = Fact.of("marked-ranges", count=int(wrong.sum()), total=len(wrong), value=mark, alone=alone)
    return replace(log, ranges=ranges.rows(~wrong)), [fact]


def without_lidar_marks(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Remove a reading that stands for no distance: for example the value of a lidar or its driver beyond its reach."""
    scans = log.scans
    if scans is None or not len(scans.stamps):
        return log, []
    place = np.floor(log.odometry.travelled_at(scans.stamps) / RepeatPolicy.moved)
    apart = scans.ranges[np.unique(place, return_index=True)[1]]
    holds = scans.hits(apart)
    mark = _mark(apart[holds])
    if mark is None or np.any(apart == np.float32(mark), axis=1).sum() < ENOUGH:
        return log, []
    wrong, farthest = scans.ranges == np.float32(mark), mark == float(apart[holds].max())
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
    others = RepeatPolicy.times_others * np.quantile(np.delete(counts, most), MOST)
    frequent = counts[most] >= max(ENOUGH, RepeatPolicy.mark_share * counts.sum(), others)
    return float(distinct[most]) if frequent else None


def _when(stamps: Floats, flags: Bools, start: float) -> list[tuple[float, float]]:
    """Return when the flags are set, first and last time of each stretch, s since the start."""
    return [(float(stamps[a] - start), float(stamps[b - 1] - start)) for a, b in runs_of(flags)]


def without_own_body(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Remove readings that stay the same at all places and headings of the robot."""
    scans = log.scans
    if scans is None or not len(scans.stamps) or log.odometry.travelled_at(scans.stamps[-1:])[0] < RepeatPolicy.way:
        return log, []
    _, sector = np.unique(np.floor(log.odometry.at(scans.stamps)[:, 2] / RepeatPolicy.sector), return_inverse=True)
    own = _steady(scans, sector) if sector.max() + 1 >= RepeatPolicy.sectors else np.zeros(0, dtype=bool)
    if not own.any():
        return log, []
    ranges = np.where(own, np.float32(np.nan), scans.ranges)
    where = np.rad2deg(scans.angles)
    sectors = [(float(where[a]), float(where[b - 1])) for a, b in runs_of(own)]
    fact = Fact.of("own-body", count=int(own.sum()), total=len(own), sectors=sectors)
    return replace(log, scans=replace(scans, ranges=ranges)), [fact]


def _steady(scans: LaserScans, sector: Ints) -> Bools:
    """Return which beams (b,) have the same near reading in nearly all scans, with equal weight of every sector (k,)."""
    some = scans.ranges[:: max(1, len(sector) // 500)]
    middle = np.median(np.where(scans.hits(some), some, np.inf), axis=0)
    own = middle < RepeatPolicy.near
    with np.errstate(invalid="ignore"):
        alike = np.abs(scans.ranges[:, own] - middle[own]) < RepeatPolicy.steady
    share = alike / np.bincount(sector)[sector, None]
    own[own] = share.sum(axis=0) >= RepeatPolicy.steady_share * (sector.max() + 1)
    return own
