"""Comparison of the motion by wheels and by lidar, stretch by stretch.

Pairs of scans a short time apart, spread over the recording, are matched and compared with the odometry of the same time.
One factor for all distances and one for all turns are calibration, and removed before. Two explanations of what the lidar
measures over a pair compete: the motion by the wheels, or that of any other time. A stretch with very strong evidence for the
second is a fault: wheels that count too much for a while slip, and are named; any other is a doubt. Wheels that count nothing
while the scans move are replaced there by the motion from scan to scan.
"""

import math
from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import ENOUGH, MOST, Bools, Floats, Ints, Table, runs_of
from ..findings import Fact
from ..lidar.scan_odometry import directional_shares, misfits, scan_steps
from ..problem.alternatives import EvidencePolicy
from ..sensor_log import LaserScans, Odometry, OdometryBreaks, SensorLog
from .odometry_chain import unmeasured


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
    slips: float = 0.4
    """Probability that wheels which work measure no motion over a pair, for they slip."""
    enough: int = 12
    """Pairs whose median is a figure."""
    lasting: int = 6
    """Steps from scan to scan over which motion is steady; half as many pairs show whether the robot moves."""
    errors: tuple[float, float] = (0.05, 0.02)
    """Differences between wheels and lidar over a pair, m and rad, that a slight slip and noise of single scans explain."""
    wheels: float = 1e-2
    """Probability that wheels do not measure the motion."""
    replaced: float = 0.25
    """Time between the scans whose motion replaces the wheels, s."""
    searches: int = 100
    """Steps of a stretch that are searched for, where they match badly."""


_NAN = float("nan")
_PARTS = slice(0, 2), slice(2, None)
"""Ways and turns of motions."""


def times_as_large(others: Floats, motions: Floats, clear: float, information: Floats) -> float:
    """Return how many times as large as motions (e, d) others of the same times (e, d) are, in the median over clear motions.

    Each counts by the information (e, d, d) about the motion in its direction; nan where too few show it beyond noise.
    """
    toward = np.einsum("ei,eij->ej", motions, information)
    size, known = np.sum(motions**2, axis=1), np.sum(toward * motions, axis=1)
    rows = np.flatnonzero((size > clear**2) & (known > PairPolicy.noise**2))
    if len(rows) < PairPolicy.enough:
        return _NAN
    ratio, weight = np.sum(toward * others, axis=1)[rows] / known[rows], known[rows] / size[rows]
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(np.interp(0.5 * total[-1], total - 0.5 * weight[order], ratio[order]))


def lidar_by_wheels(wheels: Floats, lidar: Floats, clear: float, otherwise: float, information: Floats) -> float:
    """Return how many times as large as the wheels' motions (e, d) the lidar's are; information (e, d, d) is the lidar's.

    It is `otherwise` where too few are clear, or most are opposite.

    Noise of one sensor, such as rounding, draws the ratio to its own motions down (regression dilution). So the ratio to the
    other's motions is taken as well, and of both the one that is nearer to 1.
    """
    ratio, inverse = (times_as_large(*pair, clear, information) for pair in ((lidar, wheels), (wheels, lidar)))
    if not (ratio > 0.0 and inverse > 0.0):
        return ratio if ratio > 0.0 else otherwise
    return min(ratio, 1.0 / inverse, key=lambda value: abs(np.log(value)))


def _of_another_time(lidar: Floats, wheels: Floats) -> Floats:
    """Return the log odds (e,) of motions by the lidar (e, 3) being those of any other pair, not those by the wheels (e, 3).

    Errors have Cauchy's distribution, and wheels that slip may have moved as at another time as well.
    """
    others, own = np.zeros((len(lidar), len(lidar))), np.zeros(len(lidar))
    for part, error in zip(_PARTS, PairPolicy.errors, strict=True):
        power, one = -0.5 * (1.0 + lidar[:, part].shape[1]), lidar[:, part] / error
        others += power * np.log1p(np.sum((one[:, None] - one) ** 2, axis=2))
        own += power * np.log1p(np.sum((one - wheels[:, part] / error) ** 2, axis=1))
    np.fill_diagonal(others, -np.inf)
    another = np.logaddexp.reduce(others, axis=1) - math.log(max(len(lidar) - 1, 1))
    return np.asarray(another - np.logaddexp(math.log(1.0 - PairPolicy.slips) + own, math.log(PairPolicy.slips) + another))


def _likely_runs(log_odds: Floats) -> list[tuple[int, int]]:
    """Return the runs (first, end) of pairs for which there is very strong evidence, given the log odds (e,) of each.

    The likeliest of all sequences of runs is sought (A. Viterbi, 1967); each run has the prior odds of wheels that fail.
    """
    prior, total = math.log(PairPolicy.wheels), np.concatenate([[0.0], np.cumsum(log_odds)])
    sound: tuple[float, tuple[int, ...]] = (0.0, ())
    within: tuple[float, tuple[int, ...]] = (-math.inf, ())
    for k, gain in enumerate(log_odds.tolist()):
        score, edges = max(within, (sound[0] + prior, (*sound[1], k)))
        within = (score + gain, edges)
        sound = max(sound, (within[0], (*edges, k + 1)))
    runs = zip(sound[1][::2], sound[1][1::2], strict=True)
    return [(a, b) for a, b in runs if total[b] - total[a] + prior > EvidencePolicy.very_strong]


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
    information: Floats
    """(e, 3, 3) about the motion by the lidar, see scan_steps."""

    @property
    def measured(self) -> Bools:
        """Which pairs measure a motion."""
        return self.share >= PairPolicy.matching

    def within(self, start: float, end: float) -> Bools:
        """Return which pairs (e,) measure a motion between two times, s."""
        return self.measured & (self.start >= start) & (self.end <= end)

    @property
    def unrelated(self) -> bool:
        """Whether motions by the lidar are none of the wheels' wherever these count."""
        counts = np.any(np.abs(self.wheels) > PairPolicy.errors[0], axis=1)
        own = self.rows(self.measured & counts)
        return sum(end - first for first, end in _likely_runs(_of_another_time(own.lidar, own.scaled))) > MOST * len(own.start)

    @property
    def scaled(self) -> Floats:
        """(e, 3) motion by wheels, one factor for all ways and one for all turns taken out."""
        factors = [self._lidar_by_wheels(part, PairPolicy.moving, 1.0) for part in _PARTS]
        return self.wheels * np.repeat(factors, [2, 1])

    @property
    def way_ratio(self) -> float:
        """The way by the lidar / the way by the wheels; nan where there are too few clear motions."""
        return _NAN if self.unrelated else self.rows(self.measured)._lidar_by_wheels(_PARTS[0], PairPolicy.clear, _NAN)

    def against_wheels(self, start: float, end: float) -> float:
        """Return the log odds of the lidar's motions between two times, s, being others than the wheels'.

        Only those count whose way scans measure.
        """
        ways = self.wheels[:, _PARTS[0]]
        shown = np.einsum("ei,eij,ej->e", ways, self._information(_PARTS[0]), ways) > PairPolicy.noise**2
        own, count = self.rows(self.measured), (self.within(start, end) & shown)[self.measured]
        return float(_of_another_time(own.lidar, own.scaled)[count].sum())

    def wheels_fail(self, start: float, end: float) -> bool:
        """Return whether there is very strong evidence for wheels that fail for a time between two times, s."""
        own = self.rows(self.measured)
        return bool(_likely_runs(_of_another_time(own.lidar, own.scaled)[self.within(start, end)[self.measured]]))

    def _lidar_by_wheels(self, part: slice, clear: float, otherwise: float) -> float:
        """Return how many times as large as the wheels' the ways or turns by the lidar are; see lidar_by_wheels."""
        return lidar_by_wheels(self.wheels[:, part], self.lidar[:, part], clear, otherwise, self._information(part))

    def _information(self, part: slice) -> Floats:
        """Return the information (e, d, d) about the lidar's ways or turns, the other unknown."""
        rest = np.delete(np.arange(3), part)
        of_part, cross, of_rest = (self.information[:, i][:, :, k] for i, k in ((part, part), (part, rest), (rest, rest)))
        return np.asarray(of_part - cross @ np.linalg.pinv(of_rest, hermitian=True) @ np.swapaxes(cross, 1, 2))


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
    by_wheels, good, information = scan_steps(scans, log.mounting, first, second, wheels)
    # Pairs that match so well from the wheels' guess are not also matched from zero motion.
    poor = np.flatnonzero(good < MOST)
    by_rest, rest, of_rest = scan_steps(scans, log.mounting, first[poor], second[poor], 0.0 * wheels[poor])
    better = rest > good[poor] + PairPolicy.gain
    better[better] = _fit_better(log, first[poor[better]], second[poor[better]], by_rest[better], by_wheels[poor[better]])
    by_wheels[poor[better]], good[poor[better]], information[poor[better]] = by_rest[better], rest[better], of_rest[better]
    return Pairs(middle[first], middle[second], by_wheels, wheels, good, information)


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
    """Return the stretches in which the wheels stand and scans show that the robot does not.

    While a robot rests, one pair of scans in ten at most matches clearly better at some motion, as where somebody walks by;
    while its wheels count nothing any share of them may. Scans that show other motions than the wheels wherever these drive
    do not show that they fail where they stand.
    """
    if pairs.unrelated:
        return []
    found = []
    for a, b in standing(log.odometry):
        own = pairs.rows(pairs.within(a, b))
        by_lidar, at_rest = (_misfits(log, own, motion) for motion in (own.lidar, 0.0 * own.lidar))
        moved = _clearly_worse(at_rest, by_lidar)
        count, still = int(moved.sum()), int((~moved).sum())
        any_share = math.lgamma(count + 1.0) + math.lgamma(still + 1.0) - math.lgamma(len(moved) + 2.0)
        at_most = count * math.log(1.0 - MOST) + still * math.log(MOST)
        if any_share + math.log(PairPolicy.wheels) - at_most > EvidencePolicy.very_strong:
            found.append((a, b))
    return found


def show_rest(log: SensorLog, pairs: Pairs, start: float, end: float) -> bool:
    """Return whether scans show that a robot whose wheels stand between two times, s, stands.

    Along a smooth wall they match as well if it drove on.
    """
    own = pairs.rows(pairs.within(start, end))
    at_rest, driven = (_misfits(log, own, np.tile([way, 0.0, 0.0], (len(own.start), 1))) for way in (0.0, PairPolicy.apart))
    return 2 * int(_clearly_worse(driven, at_rest).sum()) >= PairPolicy.lasting


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
    own = pairs.rows(pairs.measured)
    if len(own.start) < 2 * PairPolicy.enough:
        return []
    if pairs.unrelated:
        return [Fact.of("wheels-against-lidar", start=start, stretches=[], slips=False)]
    wheels = own.scaled
    runs = _likely_runs(_of_another_time(own.lidar, wheels))
    if log is not None and runs:
        by_lidar, by_wheels = (_misfits(log, own, motion) for motion in (own.lidar, wheels))
        shown = by_wheels > PairPolicy.worse * by_lidar
        runs = _likely_runs(_of_another_time(np.where(shown[:, None], own.lidar, wheels), wheels))
    drives, more = np.any(np.abs(own.lidar) > PairPolicy.moving, axis=1), []
    for part, error in zip(_PARTS, PairPolicy.errors, strict=True):
        differs, way = (np.linalg.norm(motion[:, part], axis=1) for motion in (own.lidar - wheels, wheels))
        along = np.sum((wheels - own.lidar)[:, part] * wheels[:, part], axis=1)
        # Of a way that a slipping wheel counts all may be missing, but no more.
        more.append(drives & (differs > error) & (along > 0.5 * differs * way) & (along < (way + error) * way))
    slips = all(max(np.mean(of[a:b]) for of in more) > 0.5 and b + PairPolicy.lasting // 2 < len(drives) for a, b in runs)
    stretches = [(float(own.start[a]), float(own.end[b - 1])) for a, b in runs]
    return [Fact.of("wheels-against-lidar", start=start, stretches=stretches, slips=slips)] if stretches else []


def unmatched(pairs: Pairs) -> list[Fact]:
    """Tell where scans a short time apart hardly ever match; pairs with too few readings do not count."""
    seen = pairs.share[pairs.share > 0.0]
    if len(seen) < 2 * PairPolicy.enough or (most := float(np.quantile(seen, MOST))) >= PairPolicy.noise_share:
        return []
    return [Fact.of("scans-do-not-match", share=most)]


def replaced(log: SensorLog, stretches: list[tuple[float, float]]) -> tuple[Odometry, OdometryBreaks]:
    """Return the odometry with the motion from scan to scan in stretches in which the wheels were lost.

    Nothing but the scans, which the map matches again, measures those steps, and where these show nothing either nothing does.
    """
    odometry, scans = log.odometry, log.scans
    assert scans is not None
    stamps, breaks, middle = odometry.stamps, [OdometryBreaks.none()], scans.middles
    for a, b in stretches:
        begin, end = max(int(np.searchsorted(middle, a)) - 1, 0), min(int(np.searchsorted(middle, b)), len(middle) - 1)
        inside = np.append(np.arange(begin, end, max(1, round(PairPolicy.replaced / usual_period(middle)))), end)
        inside = inside[(middle[inside] >= stamps[0]) & (middle[inside] <= stamps[-1])]
        if len(inside) < 2:
            continue
        steps, at = _smooth_steps(log, inside), middle[inside]
        own = np.flatnonzero((stamps > at[0]) & (stamps <= at[-1]))
        moved = se2.interpolate_trajectory(at, se2.chain(np.zeros_like(steps[0]), steps), stamps[own])
        moved = se2.compose(odometry.poses[max(own[0] - 1, 0)], moved)
        rest = se2.compose(moved[-1], se2.between(odometry.poses[own[-1]], odometry.poses[own[-1] + 1 :]))
        odometry = Odometry(stamps, np.concatenate([odometry.poses[: own[0]], moved, rest]))
        before = np.clip(np.searchsorted(stamps, at[1:]) - 1, 0, len(stamps) - 1)
        breaks.append(OdometryBreaks(stamps[before], unmeasured(log.odometry, np.diff(at))))
    return odometry, OdometryBreaks.of_all(breaks)


def _smooth_steps(log: SensorLog, chosen: Ints) -> Floats:
    """Return the motions between chosen scans; those that do not match go on as those before and after.

    They are measured twice: the second time directions that scans do not measure continue the motion before and after.
    """
    assert log.scans is not None
    first, second = chosen[:-1], chosen[1:]
    steps, share, _ = scan_steps(log.scans, log.mounting, first, second, np.zeros((len(first), 3)), PairPolicy.searches)
    half = PairPolicy.lasting // 2
    padded = np.pad(steps, ((half, half), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0), axis=2)
    again, better, _ = scan_steps(log.scans, log.mounting, first, second, usual)
    taken = np.where((better >= share - PairPolicy.gain)[:, None], again, steps)
    # No step is longer than a metre: that is 4 m/s.
    matched = (np.maximum(share, better) >= 0.5) & (np.hypot(taken[:, 0], taken[:, 1]) <= 1.0)
    return np.where(matched[:, None], taken, usual)
