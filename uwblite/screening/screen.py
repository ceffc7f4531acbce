"""The screening of one recording: units first, then the chain of odometry, then sensors that stand still."""

from dataclasses import replace

import numpy as np

from ..findings import Fact
from ..odometry.gyro import heading_from_gyro
from ..problem.alternatives import EvidencePolicy
from ..sensor_log import Odometry, OdometryBreaks, Screening, SensorLog
from . import clocks, cuts, directions, odometry_chain, range_motion, repeats, units, wheel_motion
from .odometry_chain import SAME_MOTION, unmeasured
from .range_explanations import explained_by_ranges
from .wheel_motion import Pairs

_SHORTEST_PATH = 2.0
"""A shorter path is not enough for the tests, m."""
_LONG_STAND = 5.0
"""Least time without motion of the wheels, s, that is tested with ranges where there is no lidar."""


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
    units.refuse_wrong_lengths(log)
    odometry, repeated = odometry_chain.without_repeats(log.odometry)
    # What is written twice is one reading; what differs was read at different times.
    log, stuck = repeats.without_repeated_scans(replace(log, odometry=odometry))
    log, spread = clocks.without_bursts(log)
    bursts, times = clocks.in_bursts(log)
    odometry, glitches = odometry_chain.without_glitches(log.odometry)
    units.refuse_degrees(odometry)
    odometry, jumps, broken = odometry_chain.rejoined(odometry)
    log, turned = heading_from_gyro(replace(log, odometry=odometry))
    facts += [*set_right, *outside, *repeated, *stuck, *spread, *times, *glitches, *broken, *turned]
    repairs = [repeats.without_lidar_marks, repeats.without_own_body, repeats.without_marks, repeats.without_repeated_ranges]
    repairs += [explained_by_ranges, directions.heading_with_the_path]
    for repair in repairs:
        log, more = repair(log)
        facts += more
    log, gaps, silent = cuts.gaps(log)
    pairs = wheel_motion.compare(log)
    if pairs is not None and not pairs.measured.any():
        silent += wheel_motion.unmatched(pairs)
        pairs = None
    for mounted_as_seen in (directions.laser_upright,) * turn_laser + (directions.laser_ahead,):
        if pairs is not None:
            log, mounted = mounted_as_seen(log, pairs)
            pairs, silent = wheel_motion.compare(log) if mounted else pairs, silent + mounted
    # Where a scan was taken shows only with the laser mounted as it is.
    log, late = clocks.with_late_scans_placed(log)
    pairs, silent = wheel_motion.compare(log) if late and pairs is not None else pairs, silent + late
    ratio = float("nan") if pairs is None else pairs.way_ratio
    units.refuse_other_ranges(range_motion.change_by_way(log), ratio)
    log, pairs, lost, standing = _lost_wheels(log, pairs)
    cut, carried = cuts.cuts(log, jumps.stamps, OdometryBreaks.of_all([gaps, lost]).stamps)
    facts += [*silent, *standing, *carried]
    ratio = float("nan")
    if pairs is not None:
        facts += wheel_motion.unmatched(pairs) + wheel_motion.disagreeing(pairs, float(log.odometry.stamps[0]), log)
        ratio = pairs.way_ratio
        facts = [fact for fact in facts if not _refuted(fact, pairs, float(log.odometry.stamps[0]))]
    facts += _hardly_moving(log.odometry)
    breaks = OdometryBreaks.of_all([jumps, gaps, lost, cut])
    return replace(log, screening=Screening(tuple(facts), breaks, ratio, bursts))


def _refuted(fact: Fact, pairs: Pairs, start: float) -> bool:
    """Return whether the lidar shows that wheels are right which ranges contradict all along a stretch."""
    lasting = fact.kind == "wheels-against-ranges" and fact.figures["what"] in ("turns", "mirrored")
    begin, end = (start + fact.figures[name] for name in ("begin", "end")) if lasting else (start, start)
    return lasting and pairs.against_wheels(begin, end) < -EvidencePolicy.very_strong and not pairs.wheels_fail(begin, end)


def _hardly_moving(odometry: Odometry) -> list[Fact]:
    """Tell of a robot that stands: nothing can be placed from one spot."""
    path = float(odometry.travelled[-1])
    if path >= _SHORTEST_PATH:
        return []
    turned = float(np.ptp(np.unwrap(odometry.poses[:, 2])))
    return [Fact.of("hardly-moving", way=path, seconds=float(np.ptp(odometry.stamps)), turned=turned)]


def _lost_wheels(log: SensorLog, pairs: Pairs | None) -> tuple[SensorLog, Pairs | None, OdometryBreaks, list[Fact]]:
    """Find stretches in which the wheels stand and other sensors move, and replace the wheels there."""
    start = float(log.odometry.stamps[0])
    stretches = [] if pairs is None else wheel_motion.lost(log, pairs)
    unseen = [s for s in wheel_motion.standing(log.odometry, _LONG_STAND) if s not in stretches]
    unseen = [s for s in unseen if pairs is None or not wheel_motion.show_rest(log, pairs, *s)]
    unseen = [(a, b) for a, b in unseen if range_motion.excess(log, a, b) > 0.0]
    facts = [
        Fact.of("wheels-stand-still", begin=a - start, end=b - start, by_scans=by_scans)
        for by_scans, found in ((False, unseen), (True, stretches))
        for a, b in found
    ]
    breaks = _unknown_steps(log.odometry, unseen)
    if stretches:
        odometry, by_scans = wheel_motion.replaced(log, stretches)
        log, breaks = replace(log, odometry=odometry), OdometryBreaks.of_all([breaks, by_scans])
        pairs = wheel_motion.compare(log)
    return log, pairs, breaks, facts


def _unknown_steps(odometry: Odometry, stretches: list[tuple[float, float]]) -> OdometryBreaks:
    """Return steps every few seconds in stretches in which nothing but ranges shows where the robot drove."""
    at = np.concatenate([np.zeros(0), *(np.arange(a + 0.5 * SAME_MOTION, b, SAME_MOTION) for a, b in stretches)])
    before = np.clip(np.searchsorted(odometry.stamps, at) - 1, 0, max(len(odometry.stamps) - 2, 0))
    return OdometryBreaks(odometry.stamps[before], unmeasured(odometry, np.full(len(at), SAME_MOTION)))
