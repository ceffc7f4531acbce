"""Clocks: stamps that are missing, made up, set back, late, or of another time than the odometry's."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import ENOUGH, Floats, weighted_median
from ..errors import DataError
from ..findings import Fact
from ..lidar.scan_odometry import scan_steps
from ..odometry.attached import OUTSIDE
from ..odometry.wheels import displaced
from ..sensor_log import LaserScans, Odometry, SensorLog, UwbRanges, odometry_in_bursts, stand_still
from ..sensor_log import in_bursts as stamps_in_bursts
from .wheel_motion import PairPolicy

_COARSE, _EXACT = 0.4, 1e-4
"""s; sensors of moving robots are faster than the one, and no clock is more regular than the other."""
_JUMP = 10.0
"""A clock that was set forward by less cannot be distinguished from a sensor that was silent, s."""
_SAME_END = 2.0
"""Sensors of one recording end within so much of each other, s."""
_SOME = 0.02
"""Share of scans outside the odometry's time from which on it is reported."""
_BURST, _LEAST_BURSTS = 4, 5
"""Readings with one stamp that make a burst (two or three are a coarse clock), and bursts that must be."""


def refuse_without_stamps(log: SensorLog) -> None:
    """Refuse a recording of a moving robot whose stamps stand still."""
    stamps, poses = log.odometry.stamps, log.odometry.poses
    same = len(stamps) > 2 and np.ptp(stamps) == 0.0 and bool(np.any(np.ptp(poses, axis=0) > 0.0))
    if same or stand_still(stamps, log.odometry.travelled):
        count = int(np.sum(np.diff(stamps) == 0.0)) + 1
        which = f"all {count} of the odometry are of" if same else f"{count} of {len(stamps)} of the odometry share one, as"
        raise DataError(
            f"the readings have no stamps: {which} t = {np.median(stamps):g} s; write the time of each, or, where it is lost"
            " and messages came in a steady rhythm, one that grows from reading to reading"
        )


def made_up(log: SensorLog) -> list[Fact]:
    """Report stamps on a grid too coarse for a sensor's clock: they were made by counting messages."""
    if log.scans is None or min(len(log.scans.stamps), len(log.odometry.stamps)) < ENOUGH:
        return []
    steps = np.diff(log.scans.stamps), np.diff(log.odometry.stamps)
    period = min(float(np.median(s)) for s in steps)
    return [Fact.of("made-up-stamps", period=period)] if period >= _COARSE and max(map(np.ptp, steps)) <= _EXACT else []


def in_bursts(log: SensorLog) -> tuple[tuple[str, ...], list[Fact]]:
    """Return the sensors (odometry, scans) whose stamps are times of receipt in bursts."""
    names = ["odometry"] if odometry_in_bursts(log.odometry) else []
    names += ["scans"] if log.scans is not None and stamps_in_bursts(log.scans.stamps) else []
    return tuple(names), [Fact.of("stamps-of-receipt", sensors=names)] if names else []


def set_back(log: SensorLog) -> list[Fact]:
    """Return each sensor whose clock was set back."""
    return [Fact.of("clock-set-back", sensor=sensor, by=by) for sensor, by in log.notes.set_back.items() if by > 1.0]


def without_bursts(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Spread readings of odometry and lidar that share one stamp because they waited in a buffer.

    Each burst is spread evenly over the time since the one before; the remaining delay is calibrated.
    """
    facts = []
    for name, what, sensor in (("odometry", "odometry readings", log.odometry), ("scans", "scans", log.scans)):
        if sensor is not None and (spread := _spread(sensor.stamps)) is not None:
            log = replace(log, **{name: replace(sensor, stamps=spread[0])})  # type: ignore[arg-type]
            if spread[1] >= _BURST:
                facts.append(Fact.of("stamps-in-bursts", readings=what, size=spread[1], period=spread[2]))
    return log, facts


def _spread(stamps: Floats) -> tuple[Floats, float, float] | None:
    """Return stamps (n,) that differ, s, the usual number of readings with one stamp and time between two; None if they do.

    Two or three readings of a coarse clock are spread about their stamp, so that each keeps what was read with it.
    """
    distinct, group, size = np.unique(stamps, return_inverse=True, return_counts=True)
    if len(distinct) < _LEAST_BURSTS or len(distinct) == len(stamps):
        return None
    usual, gap = float(np.median(size[group])), np.diff(distinct)
    between = float(np.median(gap))
    place = np.arange(len(stamps)) - np.searchsorted(stamps, distinct)[group]
    before = np.minimum(np.append(between, gap), between)
    if usual >= _BURST:
        return stamps - before[group] * (1.0 - (place + 1.0) / size[group]), usual, between
    about = np.where(size < _BURST, np.minimum(before, np.append(before[1:], between)), 0.0)
    return stamps + about[group] * ((place + 0.5) / size[group] - 0.5), usual, between


def without_jumps(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Undo jumps forward of one clock: gaps without which odometry and sensor end together, and with which they do not.

    The odometry's stamps stay: where its own clock jumped, those of the other sensors follow.
    """
    odometry, facts = log.odometry.stamps, []
    for name, what, sensor in _sensors(log):
        own = sensor.stamps
        ahead, behind = _jump(own, float(odometry[-1])), _jump(odometry, float(own[-1]))
        if ahead is None and behind is None:
            continue
        at, by = ahead or behind or (0.0, 0.0)
        moved = -by if ahead else by
        log = replace(log, **{name: replace(sensor, stamps=np.where(own > at, own + moved, own))})  # type: ignore[arg-type]
        clock, since = what if ahead else "odometry", at - float(odometry[0])
        facts.append(Fact.of("clock-jump", clock=clock, sensor=what, by=by, at=since, moved=moved))
    return log, facts


def _jump(stamps: Floats, end: float) -> tuple[float, float] | None:
    """Return the stamp before a jump of the clock and its size, s, where stamps (n,) end with the others without it alone.

    A jump replaces a usual step: the one in which half of the time passes, between bursts where readings come in bursts.
    """
    if len(stamps) < ENOUGH or stamps[-1] - end < _JUMP:
        return None
    steps = np.diff(stamps)
    longest = int(np.argmax(steps))
    others = np.delete(steps, longest)
    by = float(steps[longest]) - weighted_median(others, others)
    return (float(stamps[longest]), by) if abs(stamps[-1] - by - end) < _SAME_END else None


def within_odometry(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out scans outside the odometry's time where they are more than a few; note how many, and how many ranges.

    Ranges outside it stay in the recording, as few scans do; a map gives them no weight.
    """
    first, last = log.odometry.stamps[[0, -1]]
    facts = []
    for name, _, sensor in _sensors(log):
        outside = (sensor.stamps < first - OUTSIDE) | (sensor.stamps > last + OUTSIDE)
        share = float(np.mean(outside))
        if share == 0.0 or (name == "scans" and share < _SOME):
            continue
        if isinstance(sensor, LaserScans):
            log = replace(log, scans=sensor.rows(~outside))
        off = float(np.median(sensor.stamps) - 0.5 * (first + last))
        figures = {"sensor": name, "count": int(outside.sum()), "total": len(outside), "off": off, "most": share > 0.5}
        facts.append(Fact.of(f"{name}-outside-odometry", **figures))
    return log, facts


def _sensors(log: SensorLog) -> list[tuple[str, str, UwbRanges | LaserScans]]:
    """Return the sensors besides the odometry: field, name for people, readings."""
    sensors = (("ranges", "radio", log.ranges), ("scans", "lidar", log.scans))
    return [(name, what, s) for name, what, s in sensors if s is not None and len(s.stamps)]


def with_late_scans_placed(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Give the scans that came late the poses at which they were taken; only where scans came through a queue, in bursts.

    The odometry of such a recording is tied to the scans by their order. A scan that was overtaken fits neither the pose
    before it nor the one after it, by the same difference forth and back, while the odometry fits over both.
    """
    scans = log.scans
    if scans is None or not stamps_in_bursts(scans.stamps):
        return log, []
    times, rows = scans.middles, np.arange(len(scans.stamps) - 1)
    wheels = log.odometry.motion(times[:-1], times[1:])
    steps, share, _ = scan_steps(scans, log.mounting, rows, rows + 1, wheels)
    steps = np.where((share >= PairPolicy.matching)[:, None], steps, wheels)
    late = 1 + np.flatnonzero(displaced(se2.between(wheels, steps)))
    if not len(late):
        return log, []
    kept = ~np.isin(log.odometry.stamps, times[late])
    stamps = np.concatenate([log.odometry.stamps[kept], times[late]])
    poses = np.concatenate([log.odometry.poses[kept], se2.compose(log.odometry.at(times[late - 1]), steps[late - 1])])
    order = np.argsort(stamps, kind="stable")
    log = replace(log, odometry=Odometry(stamps[order], poses[order]))
    return log, [Fact.of("late-scans", count=len(late), total=len(times))]
