"""Comparison of the motion by wheels and by lidar, stretch by stretch.

Pairs of scans a short time apart, spread over the recording, are matched and compared with the odometry of the same time.
One factor for all distances and one for all turns are calibration, and removed before. A remaining difference over a stretch is
a fault: wheels that count nothing while the scans move are replaced there by the motion from scan to scan; wheels that count
too much for a while slip, and are named; any other lasting difference is a doubt.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import ENOUGH, MOST, Bools, Floats, Ints, Table, runs_of
from ..findings import Fact
from ..lidar.scan_odometry import directional_shares, misfits, scan_steps
from ..sensor_log import LaserScans, Odometry, OdometryBreaks, SensorLog


class PairPolicy:
    """Comparison of wheels and lidar over pairs of scans."""

    beams: int = 30
    """Least number of beams that show motion."""
    pairs: int = 250
    """Compared over the whole recording."""
    per_stand: int = 8
    """Further pairs in each stretch in which the wheels stand."""
    stands: int = 30
    """Such stretches, the longest first."""
    apart: float = 0.1
    """Usual distance between the scans of a pair, m."""
    spans: tuple[float, float] = (0.1, 1.0)
    """Least and longest time between them, s."""
    still: tuple[float, float] = (0.005, 0.01)
    """Distance, m, and turn, rad, within a second below which wheels stand."""
    least_stand: float = 1.5
    """Shorter stands do not matter, s."""
    matching: float = 0.6
    """Pairs that share less of their points measure nothing."""
    gain: float = 0.03
    """Share by which rest must explain a pair better than the wheels do."""
    noise_share: float = 0.4
    """Share of matching points that one pair of scans in ten exceeds in any place; noise gives 0.1 to 0.2."""
    noise: float = 0.02
    """Rms distance of matches of two scans from one place, m: lidars of robots have 1 to 2 cm."""
    worse: float = 1.2
    """Factor between mean square distances of matches from which the better motion is shown; twice is clear."""
    moving: float = 0.03
    """Motion between the scans of a pair that is larger than noise, m and rad."""
    clear: float = 0.05
    """Distance that is large enough for a ratio and a direction, m."""
    related: float = 0.5
    """Correlation of the motions by two sensors that both work, at least."""
    enough: int = 12
    """Pairs whose median is a figure."""
    lasting: int = 6
    """Pairs in a row, and seconds, of a lasting difference; half as many show whether the robot moves."""
    allowed: tuple[float, float] = (0.05, 0.06)
    relative: float = 0.35
    """Difference, m and rad, and share of the larger motion, that noise of single scans explains."""
    replaced: float = 0.25
    """Time between the scans whose motion replaces the wheels, s."""
    step_sigma: tuple[float, float, float] = (0.02, 0.02, 0.01)
    unknown_sigma: float = 0.3
    """Standard deviations of such a step, m, m, rad, and of one where scans do not match either, m and rad."""
    searches: int = 100
    """Steps of a stretch that are searched for, where they match badly."""


_NAN = float("nan")


def times_as_large(others: Floats, motions: Floats, clear: float) -> float:
    """Return how many times as large as motions (e, d) others of the same times (e, d) are, in the median over clear motions;
    nan where there are too few."""
    size = np.sqrt(np.sum(motions**2, axis=1))
    rows = size > clear
    ratio = np.sum(motions * others, axis=1)[rows] / size[rows] ** 2
    return float(np.median(ratio)) if len(ratio) >= PairPolicy.enough else _NAN


def lidar_by_wheels(wheels: Floats, lidar: Floats, clear: float, otherwise: float) -> float:
    """Return how many times as large as the wheels' motions (e, d) the lidar's are; `otherwise` where too few are clear, or
    the two have nothing in common.

    Noise of one sensor, such as rounding, draws the ratio to its own motions down (regression dilution). So the ratio to the
    other's motions is taken as well, and of both the one that is nearer to 1.
    """
    if unrelated(wheels, lidar, clear):
        return otherwise
    ratio, inverse = times_as_large(lidar, wheels, clear), times_as_large(wheels, lidar, clear)
    if not (ratio > 0.0 and inverse > 0.0):
        return otherwise if np.isnan(ratio) else ratio
    return min(ratio, 1.0 / inverse, key=lambda value: abs(np.log(value)))


def unrelated(wheels: Floats, lidar: Floats, clear: float) -> bool:
    """Return whether clear motions by wheels and by lidar (e, d) have nothing in common.

    The product of the slopes of the one by the other and of the other by the one is their correlation, squared.
    """
    return 0.0 <= times_as_large(lidar, wheels, clear) * times_as_large(wheels, lidar, clear) < PairPolicy.related**2


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
        return self.share >= PairPolicy.matching

    def within(self, start: float, end: float) -> Bools:
        """Return which pairs (e,) measure a motion between two times, s."""
        return self.measured & (self.start >= start) & (self.end <= end)

    def seen(self, start: float, end: float) -> bool:
        """Return whether scans show if the robot moves between two times, s."""
        return 2 * int(self.within(start, end).sum()) >= PairPolicy.lasting

    @property
    def unrelated(self) -> bool:
        """Whether the ways by lidar and wheels have nothing in common."""
        own = self.rows(self.measured)
        return unrelated(own.wheels[:, :2], own.lidar[:, :2], PairPolicy.clear)

    @property
    def way_ratio(self) -> float:
        """The way by the lidar / the way by the wheels; nan where there are too few clear motions."""
        own = self.rows(self.measured)
        return lidar_by_wheels(own.wheels[:, :2], own.lidar[:, :2], PairPolicy.clear, _NAN)


def standing(odometry: Odometry, least: float = PairPolicy.least_stand) -> list[tuple[float, float]]:
    """Return the stretches (first and last stamp, s) in which the wheels count nothing."""
    steps, stamps = odometry.steps, odometry.stamps
    before, after = (np.interp(stamps + d, stamps, np.arange(len(stamps))) for d in (-0.5, 0.5))
    moving = np.zeros(len(stamps), dtype=bool)
    for size, still in zip((np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])), PairPolicy.still, strict=True):
        sums, number = np.concatenate([[0.0], np.cumsum(size)]), np.arange(len(stamps))
        moving |= np.interp(after, number, sums) - np.interp(before, number, sums) > still
    # Half a second before and after a stretch without motion around it there was none either.
    runs = [(max(stamps[a] - 0.5, stamps[0]), min(stamps[b - 1] + 0.5, stamps[-1])) for a, b in runs_of(~moving)]
    return [(float(a), float(b)) for a, b in runs if b - a >= least]


def show_motion(scans: LaserScans | None) -> bool:
    """Return whether scans are enough, and have beams enough, to show motion."""
    return scans is not None and len(scans.stamps) >= ENOUGH and scans.ranges.shape[1] >= PairPolicy.beams


def compare(log: SensorLog) -> Pairs | None:
    """Match pairs of scans spread over the recording; None where there are too few scans."""
    scans = log.scans
    if scans is None or not show_motion(scans):
        return None
    middle = scans.middles
    first, second = _chosen(log, middle)
    if not len(first):
        return None
    wheels = log.odometry.motion(middle[first], middle[second])
    by_wheels, good = scan_steps(scans, log.mounting, first, second, wheels)
    # Pairs that match so well from the wheels' guess are not also matched from zero motion.
    poor = np.flatnonzero(good < MOST)
    by_rest, rest = scan_steps(scans, log.mounting, first[poor], second[poor], 0.0 * wheels[poor])
    better = rest > good[poor] + PairPolicy.gain
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
    return np.asarray((a > b + PairPolicy.gain) & (a > 0.5) & _clearly_worse(far, near))


def _clearly_worse(one: Floats, other: Floats) -> Bools:
    """Return which pairs (e,) match worse at mean square distances one than at the other, m^2, by more than noise.

    Two scans of a robot at rest differ by the noise of its lidar, and some motion fits that better.
    """
    return one > np.maximum(2.0 * other, PairPolicy.noise**2)


def _chosen(log: SensorLog, middle: Floats) -> tuple[Ints, Ints]:
    """Choose the pairs: some everywhere, some in every stretch in which the wheels stand."""
    odometry = log.odometry
    inside = (middle >= odometry.stamps[0]) & (middle <= odometry.stamps[-1])
    period = usual_period(middle)
    apart = max(1, round(_span(odometry) / period))
    first = np.flatnonzero(inside[:-apart] & inside[apart:] & (middle[apart:] - middle[:-apart] < 3.0 * apart * period))
    chosen = [first[:: max(1, len(first) // PairPolicy.pairs)]]
    for a, b in sorted(standing(odometry), key=lambda run: run[0] - run[1])[: PairPolicy.stands]:
        own = first[(middle[first] > a) & (middle[first + apart] < b)]
        chosen.append(own[:: max(1, len(own) // PairPolicy.per_stand)])
    first = np.unique(np.concatenate(chosen))
    return first, first + apart


def usual_period(stamps: Floats) -> float:
    """Return the usual time between stamps (n,), s, n > 1; a millisecond where many share one."""
    return max(float(np.median(np.diff(stamps))), 1e-3)


def _span(odometry: Odometry) -> float:
    """Return the time between the scans of a pair, s, in which the robot usually drives a little way.

    Speeds are taken over a second: over shorter times rounded odometry stands, or leaps.
    """
    stamps = odometry.stamps
    # Not every second of the time from first to last: one false stamp may lie years away.
    at = stamps[0] + np.unique((stamps - stamps[0]) // 1.0)
    at = at[at < stamps[-1]]
    place = np.column_stack([np.interp(at, stamps, column) for column in odometry.poses[:, :2].T])
    speeds = np.hypot(*np.diff(place, axis=0).T)[np.diff(at) < 1.5]
    moving = speeds > PairPolicy.still[0]
    least, most = PairPolicy.spans
    return float(np.clip(PairPolicy.apart / np.median(speeds[moving]), least, most)) if moving.any() else most


def lost(log: SensorLog, pairs: Pairs) -> list[tuple[float, float]]:
    """Return the stretches in which the wheels stand and the scans move, and match clearly worse if the robot stood.

    Scans that show other motions than the wheels wherever these drive do not show that they fail where they stand.
    """
    if pairs.unrelated:
        return []
    moving = (np.hypot(*pairs.lidar[:, :2].T) > PairPolicy.moving) | (np.abs(pairs.lidar[:, 2]) > PairPolicy.moving)
    found = []
    for a, b in standing(log.odometry):
        own = pairs.within(a, b)
        if not pairs.seen(a, b) or np.mean(moving[own]) <= 0.5:
            continue
        moved = pairs.rows(own & moving)
        by_lidar, at_rest = (_misfits(log, moved, motion) for motion in (moved.lidar, 0.0 * moved.lidar))
        if np.mean(_clearly_worse(at_rest, by_lidar)) * np.mean(moving[own]) > 0.5:
            found.append((a, b))
    return found


def _misfits(log: SensorLog, pairs: Pairs, motion: Floats) -> Floats:
    """Return the mean square distances (e,), m^2, at which pairs of scans match at given motions (e, 3)."""
    assert log.scans is not None
    first, second = (np.searchsorted(log.scans.middles, t) for t in (pairs.start, pairs.end))
    return misfits(log.scans, log.mounting, first, second, motion)


def disagreeing(pairs: Pairs, start: float, log: SensorLog | None = None) -> list[Fact]:
    """Tell where wheels and lidar measure different motions for long, one factor for all taken out.

    Along a bare wall any motion matches two scans of few rays, that of the wheels as well as that which the lidar seems to
    measure; such pairs show nothing, where the log with their scans is given. Wheels that spin while the robot drives count too
    much, until they grip again; late clocks give back what they take, or go on to the end, and a covered lidar stands still.
    """
    own, lasting = pairs.rows(pairs.measured), PairPolicy.lasting
    if len(own.start) < 2 * PairPolicy.enough:
        return []
    if pairs.unrelated:
        return [Fact.of("wheels-against-lidar", start=start, stretches=[], slips=False)]
    parts = slice(0, 2), slice(2, None)
    way, turn = (lidar_by_wheels(own.wheels[:, p], own.lidar[:, p], PairPolicy.moving, 1.0) for p in parts)
    wheels = own.wheels * np.array([way, way, turn])
    bad, more = np.zeros(len(own.start), dtype=bool), []
    drives = np.any(np.abs(own.lidar) > PairPolicy.moving, axis=1)
    for part, allowed in zip(parts, PairPolicy.allowed, strict=True):
        differs, *sizes = (np.linalg.norm(motion[:, part], axis=1) for motion in (own.lidar - wheels, own.lidar, wheels))
        off = differs > allowed + PairPolicy.relative * np.maximum(*sizes)
        along = np.sum((wheels - own.lidar)[:, part] * wheels[:, part], axis=1)
        # Of a way that a slipping wheel counts all may be missing, but no more.
        within = (along > 0.5 * differs * sizes[1]) & (along < (sizes[1] + allowed) * sizes[1])
        more.append(off & drives & within)
        bad |= off
    if log is not None and bad.any():
        by_lidar, by_wheels = (_misfits(log, own.rows(bad), motion[bad]) for motion in (own.lidar, wheels))
        bad[bad] = by_wheels > PairPolicy.worse * by_lidar
    smooth = np.convolve(bad, np.ones(lasting) / lasting, mode="same") > PairPolicy.matching
    smooth |= _turn_otherwise(own.lidar[:, 2], wheels[:, 2])
    runs = [(a, b) for a, b in runs_of(smooth) if own.end[b - 1] - own.start[a] >= lasting]
    slips = all(max(np.mean(of[a:b]) for of in more) > 0.5 and b + lasting // 2 < len(smooth) for a, b in runs)
    stretches = [(float(own.start[a]), float(own.end[b - 1])) for a, b in runs]
    return [Fact.of("wheels-against-lidar", start=start, stretches=stretches, slips=slips)] if stretches else []


def _turn_otherwise(lidar: Floats, wheels: Floats) -> Bools:
    """Return which pairs (e,) are of a stretch in which nearly all clear turns (e,) differ.

    Pairs of a straight way say nothing about turns. Where so many differ each may do so by less than a single one shows.
    """
    larger, count = np.maximum(np.abs(lidar), np.abs(wheels)), 2 * PairPolicy.enough
    least = PairPolicy.allowed[1] * np.sqrt(PairPolicy.lasting / count) + PairPolicy.relative * larger
    found, clear = np.zeros(len(larger), dtype=bool), np.flatnonzero(larger > PairPolicy.moving)
    off = (np.abs(lidar - wheels) > least)[clear]
    if len(clear) >= count:
        for k in np.flatnonzero(np.convolve(off, np.ones(count) / count, mode="valid") >= MOST).tolist():
            row = clear[k : k + count][off[k : k + count]]
            found[row[0] : row[-1] + 1] = True
    return found


def unmatched(pairs: Pairs) -> list[Fact]:
    """Tell where scans a short time apart hardly ever match; pairs with too few readings do not count."""
    seen = pairs.share[pairs.share > 0.0]
    if len(seen) < 2 * PairPolicy.enough or (most := float(np.quantile(seen, MOST))) >= PairPolicy.noise_share:
        return []
    return [Fact.of("scans-do-not-match", share=most)]


def replaced(log: SensorLog, stretches: list[tuple[float, float]]) -> tuple[Odometry, OdometryBreaks]:
    """Return the odometry with the motion from scan to scan in stretches in which the wheels were lost."""
    odometry, scans = log.odometry, log.scans
    assert scans is not None
    stamps, breaks, middle = odometry.stamps, [OdometryBreaks.none()], scans.middles
    for a, b in stretches:
        begin, end = max(int(np.searchsorted(middle, a)) - 1, 0), min(int(np.searchsorted(middle, b)), len(middle) - 1)
        inside = np.append(np.arange(begin, end, max(1, round(PairPolicy.replaced / usual_period(middle)))), end)
        inside = inside[(middle[inside] >= stamps[0]) & (middle[inside] <= stamps[-1])]
        if len(inside) < 2:
            continue
        steps, matched = _smooth_steps(log, inside)
        at = middle[inside]
        own = np.flatnonzero((stamps > at[0]) & (stamps <= at[-1]))
        moved = se2.interpolate_trajectory(at, se2.chain(np.zeros_like(steps[0]), steps), stamps[own])
        moved = se2.compose(odometry.poses[max(own[0] - 1, 0)], moved)
        rest = se2.compose(moved[-1], se2.between(odometry.poses[own[-1]], odometry.poses[own[-1] + 1 :]))
        odometry = Odometry(stamps, np.concatenate([odometry.poses[: own[0]], moved, rest]))
        before = np.clip(np.searchsorted(stamps, at[1:]) - 1, 0, len(stamps) - 1)
        sigma = np.where(matched[:, None], PairPolicy.step_sigma, PairPolicy.unknown_sigma)
        breaks.append(OdometryBreaks(stamps[before], sigma))
    return odometry, OdometryBreaks.of_all(breaks)


def _smooth_steps(log: SensorLog, chosen: Ints) -> tuple[Floats, Bools]:
    """Return the motions between chosen scans, and which of them match; the others go on as those before and after.

    They are measured twice: the second time directions that scans do not measure continue the motion before and after.
    """
    assert log.scans is not None
    first, second = chosen[:-1], chosen[1:]
    steps, share = scan_steps(log.scans, log.mounting, first, second, np.zeros((len(first), 3)), PairPolicy.searches)
    half = PairPolicy.lasting // 2
    padded = np.pad(steps, ((half, half), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0), axis=2)
    again, better = scan_steps(log.scans, log.mounting, first, second, usual)
    taken = np.where((better >= share - PairPolicy.gain)[:, None], again, steps)
    # No step is longer than a metre: that is 4 m/s.
    matched = (np.maximum(share, better) >= 0.5) & (np.hypot(taken[:, 0], taken[:, 1]) <= 1.0)
    return np.where(matched[:, None], taken, usual), matched
