"""Turns measured by laser and by wheels, from scans a moment apart; no map is needed.

When the robot turns left by a, everything in its scans moves right by a. Matching two scans by a shift of beams
measures the turn; the wheels measure it too. From many such pairs follow whether the laser is mounted upside down (the
sign), the clock offset (the lag at which both agree best) and the wheels' heading scale (the ratio).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, renumbered
from ..sensor_log import LaserScans, SensorLog


@dataclass(frozen=True, slots=True)
class TurningPolicy:
    """Pairs of scans, and what is clear of them."""

    pairs: ClassVar[int] = 1000
    """Scan pairs matched at most."""
    least_pairs: ClassVar[int] = 20
    """Fewer pairs give no result, nor half as many clear ones: single pairs of a post or two fit upright and upside down."""
    least_beams: ClassVar[int] = 30
    beams: ClassVar[int] = 180
    """Beams of a scan that are compared, or up to twice as many."""
    reach: ClassVar[float] = 12.0
    """Longer readings count as none, m."""
    apart: ClassVar[float] = 0.5
    """Time between the scans of a pair, s."""
    longest: ClassVar[float] = 2.0
    """Longest time between them, where scans are missing, s."""
    turn: ClassVar[float] = 0.05
    """Least turn between them, rad."""
    view: ClassVar[float] = 0.4
    """Largest turn between them, and of the match, as a share of the lidar's view."""
    spot: ClassVar[tuple[float, float]] = (0.15, 0.3)
    """Largest distance between them, m, and as a multiple of the turn: the robot turns in place."""
    driving: ClassVar[float] = 1.0
    """The same where few pairs turn in place, m."""
    noise: ClassVar[float] = 0.02
    """Mean difference of ranges that means nothing, m."""
    least_seen: ClassVar[float] = 0.05
    """Least share of beams with a reading."""
    widest: ClassVar[float] = 3.0
    """Factor by which the wheels' turns may be wrong."""
    farthest: ClassVar[float] = 0.3
    """Difference of turns that no pair exceeds, rad."""
    clearly: ClassVar[float] = 0.7
    """Share of the difference of turns without a clock offset that it leaves at most."""


LAGS = np.linspace(-1.0, 1.0, 101)
"""Clock offsets tried, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """The same turns measured by laser and wheels."""

    pairs: int
    """Scan pairs that were matched."""
    typical: float
    """Median turn between them by the wheels, rad."""
    as_given: float
    """Mean difference of turns, laser mounted as given, at the best clock offset, rad."""
    other: float
    """The same with the laser turned upside down."""
    misfit: float
    """The same with the better of both mountings."""
    delay: float
    """To be added to the laser's stamps, s: where both agree best; the sign is that of the calibration's ``laser_delay``."""
    delay_clear: bool
    """Without it the turns agree clearly less."""
    ratio: float
    """Turn by the laser / turn by the wheels; nan where there are too few clear turns."""

    @property
    def agree(self) -> bool:
        """Whether laser and wheels see the same turns at all, with the laser upright or upside down."""
        return self.misfit <= 0.5 * self.typical

    @property
    def turned_over(self) -> bool:
        """Whether the laser is upside down against what was given."""
        return self.other < 0.5 * self.as_given


def compare(log: SensorLog, pairs: int = TurningPolicy.pairs) -> Turning | None:
    """Compare the turns that laser and wheels see between so many pairs of scans at most; None where these are too few."""
    c, scans = TurningPolicy, log.scans
    assert scans is not None
    if scans.ranges.shape[1] < c.least_beams or len(scans.stamps) < c.least_pairs:
        return None
    first, second = _turning_pairs(log, scans, pairs)
    if len(first) < c.least_pairs:
        return None
    middle = 0.5 * scans.time_increment * scans.ranges.shape[1]
    wheels = _wheel_turns(log, scans, first, second, middle + LAGS)
    sign, shift = -1.0 if log.mounting.laser_flipped else 1.0, _laser_shift(log, scans, first, second)
    both = [_differences(*_matched_turn(scans, first, second, shift * (1.0, s)), wheels, s) for s in (sign, -sign)]
    if any(2 * errors.shape[1] < c.least_pairs for _, errors in both):
        return None
    as_given, other = misfits = [errors.mean(axis=1) for _, errors in both]
    right = int(other.min() < 0.5 * as_given.min())
    (turn, errors), misfit = both[right], misfits[right]
    best, centre = int(np.argmin(misfit)), len(LAGS) // 2
    gain = errors[centre] - errors[best]
    clear = misfit[best] < c.clearly * misfit[centre] and gain.mean() > 2.0 * gain.std() / np.sqrt(gain.size)
    return Turning(
        len(first), float(np.median(np.abs(wheels[centre]))), float(as_given.min()), float(other.min()),
        float(misfit[best]), float(LAGS[best]), bool(clear), _ratio(turn, wheels[best]),
    )


def _ratio(laser: Floats, wheels: Floats) -> float:
    """Return the median ratio of turns; nan where there are too few clear ones."""
    clear = np.abs(wheels) > 2.0 * TurningPolicy.turn
    return float(np.median(laser[clear] / wheels[clear])) if clear.sum() >= TurningPolicy.least_pairs else float("nan")


def _differences(turn: Floats, sharp: Floats, wheels: Floats, sign: float) -> tuple[Floats, Floats]:
    """Return turns (p,) by the laser, rad, counter-clockwise, and how far the wheels' are off (lags, pairs), rad, of the
    clearer half of the pairs."""
    some = sharp > 0.0
    clear = some & (sharp >= np.quantile(sharp[some], 0.5)) if some.any() else some
    # A wrong track width makes all turns wrong by one factor; they go the same way all the same.
    by_wheels, seen, widest = wheels[len(wheels) // 2], sign * turn, TurningPolicy.widest
    large = clear & (np.abs(by_wheels) > TurningPolicy.turn)
    factor = float(np.clip(np.median(seen[large] / by_wheels[large]), 1.0 / widest, widest)) if large.any() else 1.0
    return seen, np.minimum(np.abs(factor * wheels[:, clear] - seen[clear]), TurningPolicy.farthest)


def _turning_pairs(log: SensorLog, scans: LaserScans, pairs: int) -> tuple[Ints, Ints]:
    """Choose scan pairs about half a second apart between which the robot turns and hardly drives, or drives least."""
    c = TurningPolicy
    step = max(1, round(c.apart / max(float(np.median(np.diff(scans.stamps))), float(np.finfo(np.float32).eps))))
    first = np.arange(len(scans.stamps) - step)
    second = first + step
    near = scans.stamps[second] - scans.stamps[first] < c.longest
    motion = log.odometry.motion(scans.stamps[first], scans.stamps[second])
    turn, travel = np.abs(motion[:, 2]), np.hypot(motion[:, 0], motion[:, 1])
    view, beyond = abs(scans.angle_increment) * scans.ranges.shape[1], travel - c.spot[1] * turn
    clear = near & (turn > c.turn) & (turn < c.view * view)
    chosen = np.flatnonzero(clear & (beyond < c.spot[0]))
    if len(chosen) < c.least_pairs:
        driving = np.flatnonzero(clear & (travel < c.driving))
        chosen = np.sort(driving[np.argsort(beyond[driving], kind="stable")[: 2 * c.least_pairs]])
    chosen = chosen[:: max(1, len(chosen) // pairs)]
    return first[chosen], second[chosen]


def _wheel_turns(log: SensorLog, scans: LaserScans, first: Ints, second: Ints, lags: Floats) -> Floats:
    """Return the turns (lags, pairs) by the wheels between scans, each as late as the lag says, rad."""
    heading = np.unwrap(log.odometry.poses[:, 2])
    at = [np.interp(scans.stamps[k] + lags[:, None], log.odometry.stamps, heading) for k in (first, second)]
    return np.asarray(at[1] - at[0], dtype=np.float64)


def _laser_shift(log: SensorLog, scans: LaserScans, first: Ints, second: Ints) -> Floats:
    """Return where the laser is at the second scan in its own frame at the first (p, 2), m, by the wheels."""
    base = (log.odometry.at(scans.stamps[k]) for k in (first, second))
    start, end = (se2.compose(pose, log.mounting.T_base_laser) for pose in base)
    return se2.between(start, end)[:, :2]


def _matched_turn(scans: LaserScans, first: Ints, second: Ints, shift: Floats) -> tuple[Floats, Floats]:
    """Return the turn (p,) between scans by the shift of beams that matches best, rad, and how clear it is (0..1)."""
    c = TurningPolicy
    every, reach = max(1, scans.ranges.shape[1] // c.beams), min(scans.range_max, c.reach)
    angles = scans.angles[::every]
    used, one, other = renumbered(first, second)
    profile = np.nan_to_num(scans.ranges[used, ::every].astype(np.float64), nan=reach, posinf=reach)
    profile = np.where(profile < scans.range_min, reach, np.minimum(profile, reach))
    # Pairs last: each beam of all pairs lies in one piece.
    both = _seen_from(profile[one], angles, shift, reach), profile[other]
    before, after = (np.ascontiguousarray(seen.T, np.float32) for seen in both)
    beams, most = len(angles), int(c.view * len(angles))
    turns = range(-most, most + 1)
    cost = np.empty((len(first), len(turns)))
    for column, turn in enumerate(turns):
        low, high = max(0, -turn), min(beams, beams - turn)
        cost[:, column] = np.abs(after[low:high] - before[low + turn : high + turn]).mean(axis=0)
    best = np.clip(np.argmin(cost, axis=1), 1, len(turns) - 2)
    rows = np.arange(len(first))
    left, middle, right = cost[rows, best - 1], cost[rows, best], cost[rows, best + 1]
    fine = best - most + 0.5 * (left - right) / np.maximum(left - 2.0 * middle + right, np.finfo(np.float32).tiny)
    # Scans without readings fit every turn exactly equally well, and a single wall fits best where it leaves the view.
    clear = 1.0 - (middle + c.noise) / (np.median(cost, axis=1) + c.noise)
    seen = np.mean(profile < reach, axis=1) > c.least_seen
    clear *= seen[one] & seen[other]
    return np.asarray(fine * every * scans.angle_increment, dtype=np.float64), clear


def _seen_from(profile: Floats, angles: Floats, shift: Floats, reach: float) -> Floats:
    """Return range profiles (p, b) as seen from a laser moved by shift (p, 2), m, its heading kept; at most reach, m."""
    x = profile * np.cos(angles) - shift[:, :1]
    y = profile * np.sin(angles) - shift[:, 1:]
    moved = np.arctan2(y, x)
    # The same turn of the circle as before; points that are hidden now keep the order of the beams.
    moved = angles + se2.wrap_angle(moved - angles)
    order = np.sign(angles[-1] - angles[0])
    moved = order * np.maximum.accumulate(order * moved, axis=1)
    ranges = np.where(profile >= reach, reach, np.minimum(np.hypot(x, y), reach))
    return np.stack([np.interp(order * angles, order * a, r) for a, r in zip(moved, ranges, strict=True)])
