"""Comparison of the motion by wheels and by lidar, stretch by stretch.

Pairs of scans a short time apart, spread over the recording, are matched and compared with the odometry of the same time.
One factor for all distances and one for all turns are calibration, and removed before. A remaining difference over a stretch is
a fault: wheels that count nothing while the scans move are replaced there (replaced_wheels.py); any other lasting
difference is a doubt.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints, Table, runs_of, sigma_of_median
from ..findings import Fact
from ..lidar.scan_odometry import directional_shares, misfits, scan_steps
from ..sensor_log import Odometry, SensorLog

_LEAST_RATIOS = 12
"""Clear motions whose median is a factor."""


def ratios(wheels: Floats, lidar: Floats, clear: float) -> tuple[Ints, Floats]:
    """Return the pairs whose motion by the wheels (e, d) is clear, and the ratio of the lidar's motion to it, along it."""
    size = np.sqrt(np.sum(wheels**2, axis=1))
    rows = np.flatnonzero(size > clear)
    return rows, np.sum(wheels * lidar, axis=1)[rows] / size[rows] ** 2


def factor(wheels: Floats, lidar: Floats, clear: float, otherwise: float = 1.0) -> float:
    """Return the factor of the wheels' motions (e, d) that most agree on; `otherwise` where there are too few."""
    ratio = ratios(wheels, lidar, clear)[1]
    return float(np.median(ratio)) if len(ratio) >= _LEAST_RATIOS else otherwise


def undiluted(wheels: Floats, lidar: Floats, clear: float, otherwise: float) -> float:
    """Return the factor of the wheels' motions (e, d) to the lidar's; `otherwise` where there are too few clear ones.

    Noise of one sensor, such as rounding, draws the ratio to its own motions down (regression dilution). So the ratio to the
    other's motions is taken as well, and of both the one that is nearer to 1.
    """
    nan = float("nan")
    ratio, inverse = factor(wheels, lidar, clear, nan), factor(lidar, wheels, clear, nan)
    if not (ratio > 0.0 and inverse > 0.0):
        return otherwise if np.isnan(ratio) else ratio
    return min(ratio, 1.0 / inverse, key=lambda value: abs(np.log(value)))


_PAIRS = 250
"""Pairs of scans compared over the whole recording."""
_PAIRS_STANDING = 8
"""Further pairs in each stretch in which the wheels stand."""
_STRETCHES = 30
"""Number of such stretches that are tested, the longest first."""
_STILL = (0.005, 0.01)
"""Distance, m, and turn, rad, within a second below which wheels stand."""
_HALF, _EDGE = 0.5, 0.45
"""Half of that second, and how much of it belongs to the stretch on either side, s."""
_LEAST_STANDING = 1.5
"""Shorter stretches do not matter, s."""
_APART = 0.1
"""Usual distance between the scans of a pair, m."""
_CLEAR_SHARE = 0.9
"""Pairs that match so well from the wheels' guess are not also matched from zero motion."""
_GAIN = 0.03
"""Share by which rest must explain a pair better than the wheels do, of all points and of those that face the way fewest do."""
_EVERYWHERE = 0.5
"""Least share of the points that face the way fewest do by which a match is right: of two neighbouring scans most match."""
_SHARE = 0.6
"""Pairs that match less measure nothing."""
_ABSOLUTE, _RELATIVE = (0.05, 0.06), 0.35
"""Difference, m and rad, and share of the larger motion, that noise of single scans explains."""
_SEEN_MOVING = (0.03, 0.03)
"""Motion between the scans of a pair that is larger than noise, m and rad."""
_MOST = 0.6
"""Share of a stretch's pairs from which it is reported."""
_LEAST_PAIRS, _LEAST_SECONDS = 6, 6.0
"""Pairs and seconds of a lasting difference."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs(Table):
    """Motion between scans a moment apart by lidar and by wheels."""

    start: Floats
    """(e,) s."""
    end: Floats
    """(e,) s."""
    lidar: Floats
    """(e, 3) m, m, rad."""
    wheels: Floats
    """(e, 3)."""
    share: Floats
    """(e,) of points that match."""

    @property
    def measured(self) -> Bools:
        """Which pairs measure a motion."""
        return self.share >= _SHARE


def standing(odometry: Odometry, least: float = _LEAST_STANDING) -> list[tuple[float, float]]:
    """Return the stretches (first and last stamp, s) in which the wheels count nothing."""
    steps, stamps = odometry.steps, odometry.stamps
    way, turn = (np.concatenate([[0.0], np.cumsum(s)]) for s in (np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])))
    before, after = (np.interp(stamps + d, stamps, np.arange(len(stamps))) for d in (-_HALF, _HALF))
    number = np.arange(len(stamps))
    moving = np.zeros(len(stamps), dtype=bool)
    for sums, still in ((way, _STILL[0]), (turn, _STILL[1])):
        moving |= np.interp(after, number, sums) - np.interp(before, number, sums) > still
    # Half a second before and after a stretch without motion around it there was none either.
    runs = [(float(stamps[a]) - _EDGE, float(stamps[b - 1]) + _EDGE) for a, b in runs_of(~moving)]
    runs = [(max(a, float(stamps[0])), min(b, float(stamps[-1]))) for a, b in runs]
    return [(a, b) for a, b in runs if b - a >= least]


def compare(log: SensorLog) -> Pairs | None:
    """Match pairs of scans spread over the recording; None where there are too few scans."""
    scans = log.scans
    if scans is None or len(scans.stamps) < 20 or scans.ranges.shape[1] < 30:
        return None
    middle = scans.middles
    first, second = _chosen(log, middle)
    if not len(first):
        return None
    wheels = log.odometry.motion(middle[first], middle[second])
    by_wheels, good = scan_steps(scans, log.mounting, first, second, wheels)
    poor = np.flatnonzero(good < _CLEAR_SHARE)
    by_rest, rest = scan_steps(scans, log.mounting, first[poor], second[poor], np.zeros((len(poor), 3)))
    better = rest > good[poor] + _GAIN
    better[better] = _fit_better(log, first[poor[better]], second[poor[better]], by_rest[better], by_wheels[poor[better]])
    by_wheels[poor[better]], good[poor[better]] = by_rest[better], rest[better]
    return Pairs(middle[first], middle[second], by_wheels, wheels, good)


def _fit_better(log: SensorLog, first: Ints, second: Ints, one: Floats, other: Floats) -> Bools:
    """Return for which pairs of scans (e,) one motion (e, 3) matches better than another in every direction.

    What lies in sight of both must match better as well: of a bare corridor a scan shows as many metres as the lidar reaches,
    wherever it was taken, and the ends of two scans coincide where the robot stood.
    """
    assert log.scans is not None
    a, b = (directional_shares(log.scans, log.mounting, first, second, motion) for motion in (one, other))
    near, far = (misfits(log.scans, log.mounting, first, second, motion) for motion in (one, other))
    return np.asarray((a > b + _GAIN) & (a > _EVERYWHERE) & _clearly_worse(far, near))


def _chosen(log: SensorLog, middle: Floats) -> tuple[Ints, Ints]:
    """Choose the pairs: some everywhere, some in every stretch in which the wheels stand."""
    odometry = log.odometry
    inside = (middle >= odometry.stamps[0]) & (middle <= odometry.stamps[-1])
    period = max(float(np.median(np.diff(middle))), 1e-3)
    apart = max(1, round(_span(odometry) / period))
    first = np.flatnonzero(inside[:-apart] & inside[apart:] & (middle[apart:] - middle[:-apart] < 3.0 * apart * period))
    spread = first[:: max(1, len(first) // _PAIRS)]
    extra = [np.zeros(0, dtype=np.intp)]
    for a, b in sorted(standing(odometry), key=lambda run: run[0] - run[1])[:_STRETCHES]:
        own = first[(middle[first] > a) & (middle[first + apart] < b)]
        extra.append(own[:: max(1, len(own) // _PAIRS_STANDING)])
    chosen = np.unique(np.concatenate([spread, *extra]))
    return chosen, chosen + apart


_SPEED_OVER = 1.0
"""Time over which speeds are taken, s: over shorter ones rounded odometry stands, or leaps."""


def _span(odometry: Odometry) -> float:
    """Return the time between the scans of a pair, s, in which the robot usually drives a little way."""
    stamps = odometry.stamps
    # Not every second of the time from first to last: one false stamp may lie years away.
    at = stamps[0] + np.unique((stamps - stamps[0]) // _SPEED_OVER) * _SPEED_OVER
    at = at[at < stamps[-1]]
    place = np.column_stack([np.interp(at, stamps, column) for column in odometry.poses[:, :2].T])
    speeds = (np.hypot(*np.diff(place, axis=0).T) / _SPEED_OVER)[np.diff(at) < 1.5 * _SPEED_OVER]
    moving = speeds > _STILL[0]
    speed = float(np.median(speeds[moving])) if moving.any() else 0.3
    return float(np.clip(_APART / max(speed, 1e-3), 0.1, 1.0))


def seen(pairs: Pairs, start: float, end: float) -> bool:
    """Return whether scans show if the robot moves between two times, s."""
    return int(_within(pairs, start, end).sum()) >= _FEW


def _within(pairs: Pairs, start: float, end: float) -> Bools:
    """Return which pairs (e,) measure a motion between two times, s."""
    return pairs.measured & (pairs.start >= start) & (pairs.end <= end)


_FEW = 3
"""Least number of pairs of scans for a result."""


def lost(log: SensorLog, pairs: Pairs) -> list[tuple[float, float]]:
    """Return the stretches in which the wheels stand and the scans move."""
    moving = (np.hypot(*pairs.lidar[:, :2].T) > _SEEN_MOVING[0]) | (np.abs(pairs.lidar[:, 2]) > _SEEN_MOVING[1])
    found = []
    for a, b in standing(log.odometry):
        own = _within(pairs, a, b)
        if own.sum() < _FEW or np.mean(moving[own]) <= _MOST:
            continue
        if np.mean(_not_at_rest(log, pairs.rows(own & moving))) * np.mean(moving[own]) > _MOST:
            found.append((a, b))
    return found


def _not_at_rest(log: SensorLog, pairs: Pairs) -> Bools:
    """Return which pairs (e,) match clearly worse if the robot stood: about a single column it may turn as well.

    Two scans of a robot at rest differ by the noise of its lidar, and some motion fits that better.
    """
    moving, rest = (_misfits(log, pairs, motion) for motion in (pairs.lidar, 0.0 * pairs.lidar))
    return _clearly_worse(rest, moving)


def _clearly_worse(one: Floats, other: Floats) -> Bools:
    """Return which pairs (e,) match worse at mean square distances one than at the other, m^2, by more than noise."""
    return one > np.maximum(_CLEARLY_WORSE * other, _NOISE**2)


def _misfits(log: SensorLog, pairs: Pairs, motion: Floats) -> Floats:
    """Return the mean square distances (e,), m^2, at which pairs of scans match at given motions (e, 3)."""
    assert log.scans is not None
    first, second = (np.searchsorted(log.scans.middles, t) for t in (pairs.start, pairs.end))
    return misfits(log.scans, log.mounting, first, second, motion)


_NOISE = 0.02
"""Rms distance of matches of two scans from one place, m: lidars of robots have 1 to 2 cm."""
_CLEARLY_WORSE = 2.0
"""Factor between the mean square distances of matches at two motions from which one of them is wrong."""


def disagreeing(pairs: Pairs, start: float, log: SensorLog | None = None) -> list[Fact]:
    """Tell where wheels and lidar measure different motions for long, one factor for all taken out.

    Along a bare wall any motion matches two scans of few rays, that of the wheels as well as that which the lidar seems to
    measure; such pairs show nothing, where the log with their scans is given.
    """
    own = pairs.rows(pairs.measured)
    if len(own.start) < 4 * _LEAST_PAIRS:
        return []
    parts = slice(0, 2), slice(2, 3)
    way, turn = (undiluted(own.wheels[:, p], own.lidar[:, p], _CLEAR_MOTION, 1.0) for p in parts)
    wheels = own.wheels * np.array([way, way, turn])
    off, larger = own.lidar - wheels, np.maximum(np.abs(own.lidar), np.abs(wheels))
    bad = np.hypot(off[:, 0], off[:, 1]) > _ABSOLUTE[0] + _RELATIVE * np.hypot(larger[:, 0], larger[:, 1])
    bad |= np.abs(off[:, 2]) > _ABSOLUTE[1] + _RELATIVE * larger[:, 2]
    if log is not None and bad.any():
        by_lidar, by_wheels = (_misfits(log, own.rows(bad), motion[bad]) for motion in (own.lidar, wheels))
        bad[bad] = by_wheels > _WORSE_BY_WHEELS * by_lidar
    smooth = np.convolve(bad, np.ones(_LEAST_PAIRS) / _LEAST_PAIRS, mode="same") > _MOST
    runs = [(own.start[a], own.end[b - 1]) for a, b in runs_of(smooth) if own.end[b - 1] - own.start[a] >= _LEAST_SECONDS]
    stretches = [(float(a), float(b)) for a, b in runs]
    return [Fact.of("wheels-against-lidar", start=start, stretches=stretches)] if runs else []


_WORSE_BY_WHEELS = 1.2
"""Factor between the mean square distances of matches as wheels and lidar measure the motion from which the lidar shows it."""


def unmatched(pairs: Pairs) -> list[Fact]:
    """Tell where scans a short time apart hardly ever match; pairs with too few readings do not count."""
    seen = pairs.share[pairs.share > 0.0]
    if len(seen) < 4 * _LEAST_PAIRS or (most := float(np.quantile(seen, 0.9))) >= _NOISE_SHARE:
        return []
    return [Fact.of("scans-do-not-match", share=most)]


_NOISE_SHARE = 0.4
"""Share of matching points that one pair of scans in ten exceeds in any place; noise gives 0.1 to 0.2."""


def way_ratio(pairs: Pairs) -> float:
    """Return the way by the lidar / the way by the wheels; nan where there are too few clear motions."""
    own = pairs.rows(pairs.measured)
    return undiluted(own.wheels[:, :2], own.lidar[:, :2], _CLEAR_WAY, float("nan"))


def turn_ratio(pairs: Pairs) -> tuple[float, float]:
    """Return the turn by the lidar / the turn by the wheels, and its standard deviation; nan where clear turns are too few."""
    own = pairs.rows(pairs.measured)
    each = ratios(own.wheels[:, 2:], own.lidar[:, 2:], _CLEAR_TURN)[1]
    ratio = undiluted(own.wheels[:, 2:], own.lidar[:, 2:], _CLEAR_TURN, float("nan"))
    return ratio, sigma_of_median(each) if len(each) else float("nan")


_CLEAR_MOTION = 0.03
"""Way, m, or turn, rad, of most pairs of a robot that drives or turns."""
_CLEAR_WAY, _CLEAR_TURN = 0.05, 0.1
"""Distances, m, and turns, rad, that are large enough for a ratio."""
