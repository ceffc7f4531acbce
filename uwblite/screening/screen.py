"""The screening of one recording: units first, then the chain of odometry, then sensors that stand still."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..findings import Fact
from ..odometry.gyro import heading_from_gyro
from ..sensor_log import Odometry, OdometryBreaks, Screening, SensorLog
from . import clocks, cuts, directions, odometry_chain, range_motion, replaced_wheels, stuck_sensors, units, wheel_motion
from .clocks import with_late_scans_placed
from .range_explanations import explained_by_ranges
from .range_motion import without_shared_names
from .stuck_sensors import without_own_body
from .wheel_motion import Pairs

_GAP = 2.0
"""Silence of the odometry that is a gap, s; or twenty periods, where that is longer."""
_STANDS = (0.05, 0.05)
"""Distance, m, and turn, rad, by the wheels, below which the robot stood meanwhile."""
_SHORTEST_PATH = 2.0
"""A shorter path is not enough for the tests, m."""
_ANYWHERE = (20.0, 20.0, 3.0)
"""Standard deviation of a step that no sensor measured, m, m, rad."""
_STEP = 2.0
"""Time between the steps of lost wheels, where no lidar replaces them, s."""
_LONG_STAND = 5.0
"""Least time without motion of the wheels, s, that is tested with ranges where there is no lidar."""
_APART = 3.0
"""A cut nearer than this in time to another break is the same, s."""
UNKNOWN = 3.0
"""Steps with an uncertainty of so much, m, do not predict where the robot is."""


def screen(log: SensorLog, turn_laser: bool = True) -> SensorLog:
    """Return the recording repaired, with the facts in its `screening`; a recording screened before is returned unchanged.

    Parameters
    ----------
    turn_laser : take the laser as mounted the way that its scans show, not as given.

    Raises
    ------
    DataError : a unit is clearly wrong, or two recordings were written into one.
    """
    if log.screening is not None:
        return log
    clocks.refuse_without_stamps(log)
    units.refuse_wrong_times(log)
    facts = [*clocks.set_back(log), *clocks.made_up(log)]
    log, set_right = clocks.without_jumps(log)
    log, outside = clocks.within_odometry(log)
    facts += [*set_right, *outside]
    units.refuse_wrong_lengths(log)
    odometry, repeats = odometry_chain.without_repeats(log.odometry)
    log, spread = stuck_sensors.without_bursts(replace(log, odometry=odometry))
    bursts, times = clocks.in_bursts(log)
    odometry = log.odometry
    odometry, glitches = odometry_chain.without_glitches(odometry)
    units.refuse_degrees(odometry)
    odometry, jumps, broken = odometry_chain.rejoined(odometry)
    log, turned = heading_from_gyro(replace(log, odometry=odometry))
    facts += [Fact.of("repeated-odometry", count=repeats)] if repeats else []
    facts += [*spread, *times, *glitches, *broken, *turned]
    repairs = [stuck_sensors.without_repeated_scans, stuck_sensors.without_lidar_marks, without_own_body]
    repairs += [stuck_sensors.without_marks, stuck_sensors.without_repeated_ranges, without_shared_names]
    repairs += [explained_by_ranges, directions.heading_with_the_path]
    repairs += [directions.laser_upright] * turn_laser + [with_late_scans_placed]
    for repair in repairs:
        log, more = repair(log)
        facts += more
    log, gaps, more = _gaps(log)
    log, pairs, turned = _looking_ahead(log)
    units.refuse_other_ranges(range_motion.change_by_way(log), _way_ratio(pairs))
    log, pairs, lost, standing = _lost_wheels(log, pairs)
    facts += [*more, *turned, *standing]
    cut, more = _cuts(log, jumps.stamps, OdometryBreaks.of_all([gaps, lost]).stamps)
    if pairs is not None:
        more += wheel_motion.unmatched(pairs) + wheel_motion.disagreeing(pairs, float(log.odometry.stamps[0]), log)
    more += _hardly_moving(log.odometry)
    breaks = OdometryBreaks.of_all([jumps, gaps, lost, cut])
    turns = (float("nan"), float("nan")) if pairs is None else wheel_motion.turn_ratio(pairs)
    return replace(log, screening=Screening((*facts, *more), breaks, _way_ratio(pairs), turns, bursts))


def _way_ratio(pairs: Pairs | None) -> float:
    """Return the ratio of the distance by the lidar to that by the wheels; nan where the lidar measures none."""
    return float("nan") if pairs is None else wheel_motion.way_ratio(pairs)


def _looking_ahead(log: SensorLog) -> tuple[SensorLog, Pairs | None, list[Fact]]:
    """Compare wheels and lidar, with the laser in the direction that the driving shows."""
    pairs = wheel_motion.compare(log)
    if pairs is None:
        return log, None, []
    if not pairs.measured.any():
        return log, None, wheel_motion.unmatched(pairs)
    log, facts = directions.laser_ahead(log, pairs)
    return log, wheel_motion.compare(log) if facts else pairs, facts


def _hardly_moving(odometry: Odometry) -> list[Fact]:
    """Tell of a robot that stands: nothing can be placed from one spot."""
    path = float(np.sum(np.hypot(*np.diff(odometry.poses[:, :2], axis=0).T)))
    if path >= _SHORTEST_PATH:
        return []
    turned = float(np.ptp(np.unwrap(odometry.poses[:, 2])))
    return [Fact.of("hardly-moving", way=path, seconds=float(np.ptp(odometry.stamps)), turned=turned)]


def _gaps(log: SensorLog) -> tuple[SensorLog, OdometryBreaks, list[Fact]]:
    """Classify gaps of the odometry: did the robot stand, drive on, or was it carried?

    A gap in the messages is none in the odometry: the pose after it counts, with the noise of the way and turn that it shows,
    unless other sensors find the robot elsewhere. What they measured while it drove has no place between the two poses.
    """
    stamps, poses = log.odometry.stamps, log.odometry.poses
    span = np.diff(stamps)
    period = float(np.median(span[span > 0])) if np.any(span > 0) else 0.0
    gaps = np.flatnonzero((span > max(_GAP, 20.0 * period)) & ~_as_between_others(log.odometry))
    at, facts, silent = list[float](), list[Fact](), list[tuple[float, float]]()
    for k in gaps.tolist():
        a, b = float(stamps[k]), float(stamps[k + 1])
        step = se2.between(poses[k], poses[k + 1])
        held = bool(np.hypot(*step[:2]) < _STANDS[0])
        stood = held and bool(abs(step[2]) < _STANDS[1])
        seen = any(_inside(sensor.stamps, a, b).any() for sensor in (log.ranges, log.scans) if sensor is not None)
        # A gyro may have turned with the robot while no sensor measured its distance.
        elsewhere = held and _elsewhere(log, a, b)
        begin = a - float(stamps[0])
        if elsewhere:
            facts.append(Fact.of("carried", at=[begin], silent=b - a))
        elif not stood and seen:
            facts.append(Fact.of("odometry-gap", begin=begin, seconds=b - a))
        if elsewhere or not stood:
            silent.append((a, b))
        if elsewhere:
            at.append(a)
    found = OdometryBreaks(np.array(at), np.tile(_ANYWHERE, (len(at), 1))) if at else OdometryBreaks.none()
    return _without(log, silent), found, facts


def _as_between_others(odometry: Odometry) -> Bools:
    """Return over which steps (n-1,) the robot moved no farther than over most others.

    A log thinned by motion holds a reading each so many centimetres, and none while the robot stands: the wheels counted all
    the same, and the reading after a pause has the noise of the way that it shows.
    """
    motion = np.abs(odometry.steps)
    way, moved = np.hypot(motion[:, 0], motion[:, 1]), np.diff(odometry.stamps) > 0.0
    usual = [float(np.quantile(part[moved], _USUAL)) if moved.any() else 0.0 for part in (way, motion[:, 2])]
    return np.asarray((way > _STANDS[0]) & (way <= usual[0]) & (motion[:, 2] <= usual[1]))


_USUAL = 0.99
"""Share of steps up to whose largest a step is usual."""


def _elsewhere(log: SensorLog, a: float, b: float) -> bool:
    """Return whether lidar or radio find the robot elsewhere after a time in which the wheels stood."""
    same = cuts.same_place(log, a, b)
    return not same if same is not None else range_motion.excess(log, a, b) > 0.0


def _inside(stamps: Floats, a: float, b: float) -> Bools:
    """Return which stamps (n,) are well within a silence of the odometry."""
    return np.asarray((stamps > a + 0.2) & (stamps < b - 0.2))


def _without(log: SensorLog, silent: list[tuple[float, float]]) -> SensorLog:
    """Leave out scans and ranges of times at which the robot's place is unknown."""

    def kept(stamps: Floats) -> Bools:
        inside = np.zeros(len(stamps), dtype=bool)
        for a, b in silent:
            inside |= _inside(stamps, a, b)
        return ~inside

    if not silent:
        return log
    ranges, scans = log.ranges, log.scans
    if ranges is not None:
        left = kept(ranges.stamps)
        ranges = ranges.rows(left) if left.any() else None
    if scans is not None:
        scans = scans.rows(kept(scans.stamps))
    return replace(log, ranges=ranges, scans=scans)


def _lost_wheels(log: SensorLog, pairs: Pairs | None) -> tuple[SensorLog, Pairs | None, OdometryBreaks, list[Fact]]:
    """Find stretches in which the wheels stand and other sensors move, and replace the wheels there."""
    start = float(log.odometry.stamps[0])
    unseen = [s for s in wheel_motion.standing(log.odometry, _LONG_STAND) if pairs is None or not wheel_motion.seen(pairs, *s)]
    unseen = [(a, b) for a, b in unseen if range_motion.excess(log, a, b) > 0.0]
    facts = [Fact.of("wheels-stand-still", begin=a - start, end=b - start, by_scans=False) for a, b in unseen]
    unknown = _unknown_steps(log.odometry, unseen)
    stretches = [] if pairs is None else wheel_motion.lost(log, pairs)
    if not stretches:
        return log, pairs, unknown, facts
    odometry, breaks = replaced_wheels.replaced(log, stretches)
    facts += [Fact.of("wheels-stand-still", begin=a - start, end=b - start, by_scans=True) for a, b in stretches]
    log = replace(log, odometry=odometry)
    return log, wheel_motion.compare(log), OdometryBreaks.of_all([unknown, breaks]), facts


def _unknown_steps(odometry: Odometry, stretches: list[tuple[float, float]]) -> OdometryBreaks:
    """Return steps every few seconds with the uncertainty of a robot that may have driven at usual speed in any direction."""
    usual = float(odometry_chain.Motion.of(odometry).speed[0]) / 4.0
    stamps = [np.arange(a + 0.5 * _STEP, b, _STEP) for a, b in stretches]
    at = np.concatenate([np.zeros(0), *stamps])
    before = np.clip(np.searchsorted(odometry.stamps, at) - 1, 0, max(len(odometry.stamps) - 2, 0))
    sigma = np.broadcast_to([usual * _STEP, usual * _STEP, 0.5], (len(at), 3))
    return OdometryBreaks(odometry.stamps[before], sigma)


def _cuts(log: SensorLog, jumps: Floats, others: Floats) -> tuple[OdometryBreaks, list[Fact]]:
    """Find moments at which the robot is suddenly elsewhere, away from breaks (b,) that are known, s; jumps may be such."""
    times = cuts.found(log, jumps)
    stamps, start = log.odometry.stamps, log.odometry.stamps[0]
    ends = stamps[np.minimum(np.searchsorted(stamps, others, "right"), len(stamps) - 1)]
    times = times[~np.any((times[:, None] > others - _APART) & (times[:, None] < ends + _APART), axis=1)]
    if not len(times):
        return OdometryBreaks.none(), []
    before = stamps[np.clip(np.searchsorted(stamps, times) - 1, 0, len(stamps) - 1)]
    breaks = OdometryBreaks(before, np.tile(_ANYWHERE, (len(times), 1)))
    return breaks, [Fact.of("carried", at=(times - start).tolist())]
