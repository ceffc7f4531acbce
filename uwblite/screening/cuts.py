"""Times at which the robot is elsewhere: it was carried, or the log was cut, and no sensor measured the motion.

After a silence of the odometry in which the wheels stood, or suddenly: neighbouring scans differ little. Where one differs from
the next by far more than its neighbours do, and no motion near that of the wheels aligns the two, the robot is at another
place; so it is where ranges to several anchors jump and the scans do not contradict them: along a smooth tunnel every scan
matches every other one. After a fast turn two scans may overlap little: the surfaces of the one then stand beside or behind
those of the other. For scans from different places, many points stand in the free space of the other.
"""

from dataclasses import replace

import numpy as np

from ..arrays import MOST, Bools, Floats, Ints
from ..findings import Fact
from ..lidar.scan_odometry import directional_shares, in_free_space, scan_steps
from ..sensor_log import Odometry, OdometryBreaks, SensorLog
from . import range_motion
from .units import FASTEST
from .wheel_motion import show_motion, usual_period


class CutPolicy:
    """Silences of the odometry, and changes from scan to scan."""

    gap: float = 2.0
    periods: float = 20.0
    """Silence of the odometry that is a gap, s; or so many periods, where that is longer."""
    margin: float = 0.2
    """Time at either end of a silence in which other sensors still have a place, s."""
    stands: float = 0.05
    """Distance, m, and turn, rad, by the wheels, below which the robot stood meanwhile."""
    usual: float = 0.99
    """Share of steps up to whose largest a step is usual."""
    anywhere: tuple[float, float, float] = (20.0, 20.0, 3.0)
    """Standard deviation of a step that no sensor measured, m, m, rad."""
    one_cut: float = 3.0
    """Cuts and breaks nearer than this in time are the same, s."""
    neighbours: int = 8
    """Scans on either side from which the usual difference of scans is computed: the 90 % quantile, or twice that."""
    silence: float = 6.0
    """Usual periods of the lidar after which two scans do not count as neighbours."""
    least_change: float = 0.25
    most_change: float = 1.0
    """Mean difference of readings, m, below which nothing happened, and the most of a single one that counts."""
    tested: int = 40
    """Most candidates that are tested, the largest first."""
    same_place: float = 0.55
    """Scans that match by a larger share are of one place."""
    through: float = 0.12
    """Share in free space that is too large for a true place; people and doors cause less."""


def gaps(log: SensorLog) -> tuple[SensorLog, OdometryBreaks, list[Fact]]:
    """Classify gaps of the odometry: did the robot stand, drive on, or was it carried?

    A gap in the messages is none in the odometry: the pose after it counts, with the noise of the way and turn that it shows,
    unless other sensors find the robot elsewhere. What they measured while it drove has no place between the two poses.
    """
    stamps = log.odometry.stamps
    span, (way, turn) = np.diff(stamps), _ways(log.odometry)
    period = float(np.median(span[span > 0])) if np.any(span > 0) else 0.0
    long = span > max(CutPolicy.gap, CutPolicy.periods * period)
    at, facts, silent = list[float](), list[Fact](), list[tuple[float, float]]()
    for k in np.flatnonzero(long & ~_as_between_others(log.odometry)).tolist():
        a, b = float(stamps[k]), float(stamps[k + 1])
        held = bool(way[k] < CutPolicy.stands)
        stood = held and bool(turn[k] < CutPolicy.stands)
        same = same_place(log, a, b) if held else None
        # A gyro may have turned with the robot while no sensor measured its distance.
        if held and (range_motion.excess(log, a, b) > 0.0 if same is None else not same):
            at.append(a)
            facts.append(Fact.of("carried", at=[a - float(stamps[0])], silent=b - a))
        elif stood:
            continue
        elif any(_inside(sensor.stamps, a, b).any() for sensor in (log.ranges, log.scans) if sensor is not None):
            facts.append(Fact.of("odometry-gap", begin=a - float(stamps[0]), seconds=b - a))
        silent.append((a, b))
    return _without(log, silent), _anywhere(np.array(at)), facts


def _ways(odometry: Odometry) -> tuple[Floats, Floats]:
    """Return way, m, and turn, rad, of each step (n-1,)."""
    steps = np.abs(odometry.steps)
    return np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2]


def _anywhere(stamps: Floats) -> OdometryBreaks:
    """Return breaks after readings (b,), s, from which the robot may be anywhere."""
    return OdometryBreaks(stamps, np.tile(CutPolicy.anywhere, (len(stamps), 1)))


def _as_between_others(odometry: Odometry) -> Bools:
    """Return over which steps (n-1,) the robot moved no farther than over most others.

    A log thinned by motion holds a reading each so many centimetres, and none while the robot stands: the wheels counted all
    the same, and the reading after a pause has the noise of the way that it shows.
    """
    (way, turn), moved = _ways(odometry), np.diff(odometry.stamps) > 0.0
    usual = [float(np.quantile(part[moved], CutPolicy.usual)) if moved.any() else 0.0 for part in (way, turn)]
    return np.asarray((way > CutPolicy.stands) & (way <= usual[0]) & (turn <= usual[1]))


def _inside(stamps: Floats, a: float, b: float) -> Bools:
    """Return which stamps (n,) are well within a silence of the odometry."""
    return np.asarray((stamps > a + CutPolicy.margin) & (stamps < b - CutPolicy.margin))


def _without(log: SensorLog, silent: list[tuple[float, float]]) -> SensorLog:
    """Leave out scans and ranges of times at which the robot's place is unknown."""
    for a, b in silent:
        ranges, scans = log.ranges, log.scans
        kept = None if ranges is None else ranges.rows(~_inside(ranges.stamps, a, b))
        ranges = None if kept is None or not len(kept.stamps) else kept
        log = replace(log, ranges=ranges, scans=None if scans is None else scans.rows(~_inside(scans.stamps, a, b)))
    return log


def cuts(log: SensorLog, jumps: Floats, others: Floats) -> tuple[OdometryBreaks, list[Fact]]:
    """Find moments at which the robot is suddenly elsewhere.

    Parameters
    ----------
    jumps : (b,) times at which the odometry jumps, s; they may be such moments.
    others : (c,) times of breaks that are known, s: near these there are none.
    """
    times, stamps = found(log, jumps), log.odometry.stamps
    ends = stamps[np.minimum(np.searchsorted(stamps, others, "right"), len(stamps) - 1)]
    near = (times[:, None] > others - CutPolicy.one_cut) & (times[:, None] < ends + CutPolicy.one_cut)
    times = times[~near.any(axis=1)]
    facts = [Fact.of("carried", at=(times - stamps[0]).tolist(), silent=0.0)] if len(times) else []
    return _anywhere(stamps[np.clip(np.searchsorted(stamps, times) - 1, 0, len(stamps) - 1)]), facts


def found(log: SensorLog, jumps: Floats) -> Floats:
    """Return the times (c,) of cuts, s; jumps : (b,) times at which the odometry jumps, s."""
    by_lidar = _by_lidar(log)
    by_ranges = [_nearest(jumps, t) for t in range_motion.cuts(log, jumps)]
    more = [t for t in by_ranges if not same_place(log, t, t) and np.all(np.abs(by_lidar - t) > CutPolicy.one_cut)]
    return np.sort(np.concatenate([by_lidar, more]))


def _nearest(jumps: Floats, time: float) -> float:
    """Return the jump that is the same moment as a cut by ranges, s; the cut's own time where there is none."""
    return float(min(jumps[np.abs(jumps - time) < CutPolicy.one_cut], key=lambda jump: abs(jump - time), default=time))


def same_place(log: SensorLog, before: float, after: float) -> bool | None:
    """Return whether the last scan before a time and the first after another show one place.

    None where there are none, and where nothing would distinguish it from places along a smooth wall.
    """
    if log.scans is None or len(log.scans.stamps) < 2:
        return None
    middle = log.scans.middles
    first, second = int(np.searchsorted(middle, before, "right")) - 1, int(np.searchsorted(middle, after))
    if first < 0 or second >= len(middle) or max(middle[second] - after, before - middle[first]) > CutPolicy.gap:
        return None
    pair = np.array([first]), np.array([second])
    motion, share = _matched(log, *pair)
    if 0.0 < share[0] < CutPolicy.same_place:
        return False
    everywhere = share[0] > 0.0 and directional_shares(log.scans, log.mounting, *pair, motion)[0] >= 0.5
    return True if everywhere else None


def _by_lidar(log: SensorLog) -> Floats:
    """Return the times (c,) between scans from two places, s."""
    scans, half = log.scans, CutPolicy.neighbours
    if scans is None or not show_motion(scans):
        return np.zeros(0)
    change = _changes(log)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(change, half, mode="edge"), 2 * half + 1).copy()
    windows[:, half] = 0.0
    span = np.diff(scans.stamps)
    change = np.where(span > CutPolicy.silence * usual_period(scans.middles), 0.0, change)
    jumps = np.flatnonzero((change > CutPolicy.least_change) & (change > 2.0 * np.quantile(windows, MOST, axis=1)))
    jumps = np.sort(jumps[np.argsort(-change[jumps], kind="stable")[: CutPolicy.tested]])
    if not len(jumps):
        return np.zeros(0)
    apart, share = _elsewhere(log, jumps, jumps + 1)
    apart &= share > 0.0
    # The scan itself may be wrong: those on either side of both must not match either.
    # The first and the last change are none: about them, where scans are repeated, as large a one is usual.
    apart[apart] &= _elsewhere(log, jumps[apart] - 1, jumps[apart] + 2)[0]
    middle = scans.middles
    return 0.5 * (middle[jumps[apart]] + middle[jumps[apart] + 1])


def _changes(log: SensorLog) -> Floats:
    """Return the mean difference of readings, of a hundred beams or so, between each scan and the next (k-1,), m."""
    assert log.scans is not None
    every = max(1, log.scans.ranges.shape[1] // 120)
    reach = min(log.scans.range_max, 30.0)
    readings = np.nan_to_num(log.scans.ranges[:, ::every], nan=reach, posinf=reach)
    return np.minimum(np.abs(np.diff(readings, axis=0)), CutPolicy.most_change).mean(axis=1)


def _elsewhere(log: SensorLog, first: Ints, second: Ints) -> tuple[Bools, Floats]:
    """Return which pairs of scans (e,) no motion that a robot can make brings together, and what share of them matches (e,).

    After a fast turn the scans overlap little, but the wheels' motion puts no surfaces before others.
    """
    assert log.scans is not None
    middle = log.scans.middles
    motion, share = _matched(log, first, second)
    wheels, span = log.odometry.motion(middle[first], middle[second]), middle[second] - middle[first]
    apart = (share < CutPolicy.same_place) | (np.hypot(*(motion - wheels)[:, :2].T) > FASTEST * span)
    through = in_free_space(log.scans, log.mounting, first[apart], second[apart], wheels[apart])
    apart[apart] &= through > CutPolicy.through
    return apart, share


def _matched(log: SensorLog, first: Ints, second: Ints) -> tuple[Floats, Floats]:
    """Return the motions (e, 3) at which scans match best near the wheels' guess, and how well (e,), 0..1."""
    assert log.scans is not None
    middle = log.scans.middles
    guess = log.odometry.motion(middle[first], middle[second])
    return scan_steps(log.scans, log.mounting, first, second, guess, searches=len(first))[:2]
