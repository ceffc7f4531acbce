"""Units that are clearly wrong, reported before anything is computed with them."""

from typing import NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import DataError
from ..sensor_log import LONGEST_RANGE, Odometry, SensorLog

FASTEST = 3.0
"""Largest speed of a ground robot that maps a building, m/s."""
_FAR_TOO_FAST = 9.0
"""Usual speed, m/s, that no such robot has for long; millimetres taken as metres give 20 m/s at a very low speed."""
_CENTIMETRES = 90.0
"""Usual speed, m/s, from which positions are rather millimetres than centimetres."""
_FAST_TURN, _MORE_THAN_A_TURN = 1.0, 7.0
"""Usual turn rate, rad/s, and range of headings, rad, without which they cannot be degrees."""
_LONGEST_READING = 150.0
"""Largest usual reach of a lidar of this kind, m."""
_CHORD = 1.0
"""Time over which speed is taken, s: readings of two robots by turns, or in bursts, jump from one to the next."""
_ENOUGH = 10
"""Least number of readings for a test of the unit."""
_LENGTHS = {"feet": 0.3048, "centimetres": 0.01, "millimetres": 0.001}
_YARD, _SAME_UNIT = 0.9144, 0.05
"""m; and by how much, relatively, a factor that a map found may differ from that of a unit: ranges in yards came out as 1.09 to
1.14, for wheels are off by a few percent by themselves."""
_OTHER_LENGTH = 1.2
"""Ranges in another unit change by its factor as much as the wheels drive, up to this factor."""
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LONG_TIMES = {"minutes": 60.0, "hours": 3600.0, "days": 86400.0}
_SELDOM, _OFTEN = 1.0, 0.005
"""Limits of the time between readings, s, within which stamps are taken as seconds."""
_RAPID, _SPIN = 0.002, 3.0
"""Time between readings of the odometry, s, that is shorter than any; and mean turn rate, rad/s, that no robot keeps."""
_USUAL_SPEED = 0.3
"""m/s."""
_PERIODS, _SPEEDS = (5e-4, 2.0), (0.01, _FAR_TOO_FAST)
"""Times between readings, s, and highest usual speeds, m/s, of a robot: what the right unit of time gives."""
_SAME_LENGTH = 2.0
"""Sensors of one recording last equally long to this factor."""
_AGREEMENT = 0.7
"""Agreement of heading and direction of motion below which the heading is not the path's."""
CLEARLY = 0.2
"""Another interpretation of the heading must agree better by so much."""


def refuse_wrong_lengths(log: SensorLog) -> None:
    """Raise DataError where the recording's lengths clearly have another unit than metres."""
    found = [text for text in (_positions(log.odometry), _of_ranges(log), _of_scans(log)) if text]
    if found:
        raise DataError("; ".join(found))


def refuse_wrong_times(log: SensorLog) -> None:
    """Raise DataError where stamps clearly have another unit than seconds."""
    text = _odometry_stamps(log.odometry) or _other_stamps(log)
    if text:
        raise DataError(text)


def refuse_degrees(odometry: Odometry) -> None:
    """Raise DataError where the odometry's heading is clearly in degrees."""
    text = _heading(odometry)
    if text:
        raise DataError(text)


def refuse_other_ranges(change_by_way: float, lidar_by_wheels: float) -> None:
    """Raise DataError where ranges change by more than the wheels drive, and by the factor of another unit.

    Parameters
    ----------
    change_by_way : see range_motion.change_by_way.
    lidar_by_wheels : distance by the lidar / distance by the wheels, nan where it does not: a lidar that agrees with
        the ranges shows that the wheels are wrong.
    """
    if lidar_by_wheels > 0.0 and abs(np.log(change_by_way / lidar_by_wheels)) < np.log(_OTHER_LENGTH):
        return
    for name, unit in _LENGTHS.items():
        if abs(np.log(change_by_way * unit)) < np.log(_OTHER_LENGTH):
            usual = f"usual change would be {change_by_way:.3g} times the distance that the wheels count"
            raise DataError(_other_unit("the ranges", usual, name, "range"))


def likely_unit(times: float) -> str:
    """Return words on what looks as if the robot drove so many times as far as its wheels count; '' where nothing does."""
    if times <= 0.0:
        return ""
    if abs(np.log(times * _YARD)) < _SAME_UNIT:
        return f"; ranges in yards would look like this (`range_unit={_YARD}`)"
    if abs(np.log(times / _LENGTHS["feet"])) < _SAME_UNIT:
        return f"; odometry in feet would look like this (`odometry_unit={_LENGTHS['feet']}`)"
    return ""


def heading_agreement(odometry: Odometry, factor: float = 1.0) -> tuple[float, bool]:
    """Compare the heading times a factor with the direction of motion.

    Returns
    -------
    |mean exp(2 i (direction - factor heading))|, 1 for wheels that do not slide, forwards or backwards, near 0 for a wrong
    unit or sign; and whether the path turns enough to decide.
    """
    xy, heading = odometry.poses[:, :2], np.unwrap(odometry.poses[:, 2])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    # A fifth of a metre at a time, or a part of a path whose unit is not known.
    piece = np.floor(way / min(0.2, max(float(way[-1]) / 100.0, 1e-9)))
    apart = np.flatnonzero(np.diff(piece, prepend=-1.0) > 0)
    if len(apart) < 12:
        return 1.0, False
    move = np.diff(xy[apart], axis=0)
    direction = np.arctan2(move[:, 1], move[:, 0])
    weight = np.hypot(move[:, 0], move[:, 1])
    half = 0.5 * (heading[apart[1:]] + heading[apart[:-1]])
    varied = np.abs(np.sum(weight * np.exp(2j * direction))) / np.sum(weight) < 0.9
    return float(np.abs(np.sum(weight * np.exp(2j * (direction - factor * half)))) / np.sum(weight)), bool(varied)


class HeadingReading(NamedTuple):
    """How well the heading agrees with the direction of motion, see heading_agreement."""

    plain: float
    mirrored: float
    """With the other sign."""
    degrees: float
    """As degrees, wrapped or not."""
    sound: bool
    """Whether the path does not turn enough to tell, or the heading is the path's as it stands."""


def heading_reading(odometry: Odometry) -> HeadingReading:
    """Return how the heading agrees with the path as it stands, with the other sign, and as degrees."""
    plain, varied = heading_agreement(odometry)
    mirrored, radians = heading_agreement(odometry, -1.0)[0], np.radians(odometry.poses[:, 2])
    degrees = heading_agreement(Odometry(odometry.stamps, np.column_stack([odometry.poses[:, :2], radians])))[0]
    return HeadingReading(plain, mirrored, degrees, not varied or plain >= _AGREEMENT)


def _odometry_stamps(odometry: Odometry) -> str:
    """Return the words on stamps with which neither the time between readings nor the speed is a robot's."""
    if text := _seldom_stamps(odometry):
        return text
    period, speeds = _period(odometry.stamps), _speeds(odometry)
    if period <= _SELDOM or len(speeds) < _ENOUGH:
        return ""
    fast = float(np.quantile(speeds, 0.9))
    for name, unit in _TIMES.items():
        if _PERIODS[0] <= period * unit <= _PERIODS[1] and _SPEEDS[0] <= fast / unit <= _SPEEDS[1]:
            return _other_time(name, unit, period, fast)
    return ""


def _seldom_stamps(odometry: Odometry) -> str:
    """Return the words on stamps with which the robot would be too fast, and report that too often.

    With positions in centimetres it would be as fast, but would not spin.
    """
    span = float(np.ptp(odometry.stamps))
    steps = np.abs(np.diff(odometry.poses, axis=0))
    period = span / max(len(steps), 1)
    if len(steps) < _ENOUGH or not 0.0 < period < _OFTEN:
        return ""
    turns = np.minimum(steps[:, 2] % (2.0 * np.pi), -steps[:, 2] % (2.0 * np.pi))
    speed, spin = float(np.hypot(steps[:, 0], steps[:, 1]).sum()) / span, float(turns.sum()) / span
    found = [
        (abs(np.log(speed / unit / _USUAL_SPEED)), name, unit)
        for name, unit in _LONG_TIMES.items()
        if speed > FASTEST
        and (spin > _SPIN or period < _RAPID)
        and spin / unit < _SPIN
        and _PERIODS[0] <= period * unit <= _PERIODS[1]
        and _SPEEDS[0] <= speed / unit <= _SPEEDS[1]
    ]
    return _other_time(*min(found)[1:], period, speed) if found else ""


def _other_time(name: str, unit: float, period: float, speed: float) -> str:
    """Return the words on stamps in another unit, s."""
    return (
        f"the stamps look like {name}: the odometry would come every {period:.3g} s, at {speed:.1g} m/s; "
        f"write seconds into the log (`time_unit={unit:g}`)"
    )


def _other_stamps(log: SensorLog) -> str:
    """Return the words on a sensor whose stamps have another unit than the odometry's."""
    wheels = log.odometry.stamps
    for what, sensor in (("gyro", log.gyro), ("radio", log.ranges), ("lidar", log.scans)):
        if sensor is None or len(sensor.stamps) < _ENOUGH:
            continue
        name = _finer(sensor.stamps, wheels)
        odd, name = (what, name) if name else ("odometry", _finer(wheels, sensor.stamps))
        if name:
            return (
                f"the stamps of the {odd} look like {name}: odometry and {what} would last {np.ptp(wheels):.4g} s and "
                f"{np.ptp(sensor.stamps):.4g} s; write every stamp in seconds"
            )
    return ""


def _finer(stamps: Floats, others: Floats) -> str:
    """Return the unit of stamps (n,) that makes them last as long as others (m,), s, at a sensor's rate; '' without one."""
    period = _period(stamps)
    for name, unit in (_TIMES | (_LONG_TIMES if period < _OFTEN else {})).items():
        alike = np.ptp(others) / _SAME_LENGTH < np.ptp(stamps) * unit < np.ptp(others) * _SAME_LENGTH
        if alike and _PERIODS[0] <= period * unit <= _PERIODS[1]:
            return name
    return ""


def _period(stamps: Floats) -> float:
    """Return the usual time between readings (n,), s."""
    steps = np.diff(stamps)
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0


def _speeds(odometry: Odometry) -> Floats:
    """Return the speeds (k,), m/s, of the readings that move, each taken over a second or to the next reading."""
    first = np.arange(len(odometry.stamps) - 1)
    # A second added to nanoseconds since 1970 is lost in rounding.
    second = np.clip(np.searchsorted(odometry.stamps, odometry.stamps[first] + _CHORD), first + 1, len(first))
    span = odometry.stamps[second] - odometry.stamps[first]
    length = np.hypot(*(odometry.poses[second] - odometry.poses[first])[:, :2].T)
    moving = (length > 1e-6) & (span > 0.5 * _CHORD)
    return np.asarray(length[moving] / span[moving])


def _positions(odometry: Odometry) -> str:
    speeds = _speeds(odometry)
    if len(speeds) < _ENOUGH:
        return ""
    speed = float(np.median(speeds))
    if speed <= _FAR_TOO_FAST:
        return ""
    unit = "millimetres" if speed > _CENTIMETRES else "centimetres"
    return _other_unit("the odometry's positions", f"usual speed would be {speed:.0f} m/s", unit, "odometry")


def _other_unit(what: str, usual: str, unit: str, option: str) -> str:
    """Return the words on lengths in another unit."""
    factor = f"{_LENGTHS[unit]:g}"
    return f"{what} look like {unit}: the {usual}; write metres into the log (`{option}_unit={factor}`)"


def _heading(odometry: Odometry) -> str:
    reading = heading_reading(odometry)
    turn, span = np.abs(np.diff(odometry.poses[:, 2])), np.diff(odometry.stamps)
    turning = (turn > 1e-6) & (span > 0)
    rate = float(np.median(turn[turning] / span[turning])) if turning.sum() >= _ENOUGH else 0.0
    large = rate > _FAST_TURN or float(np.ptp(odometry.poses[:, 2])) > _MORE_THAN_A_TURN
    if large and not reading.sound and reading.degrees > max(reading.plain, reading.mirrored) + CLEARLY:
        return (
            f"the odometry's heading looks like degrees (as such it agrees with the path to {reading.degrees:.2f} of 1, as "
            f"radians to {reading.plain:.2f}); write radians into the log (`angle_unit=0.0174533`)"
        )
    return ""


def _of_ranges(log: SensorLog) -> str:
    if log.ranges is None:
        return ""
    positive = log.ranges.ranges[log.ranges.ranges > 0]
    if len(positive) < _ENOUGH or np.median(positive) <= LONGEST_RANGE:
        return ""
    usual = float(np.median(positive))
    unit = "millimetres" if usual > 1500.0 else "centimetres"
    return _other_unit("the ranges", f"usual one would be {usual:.0f} m", unit, "range")


def _of_scans(log: SensorLog) -> str:
    scans = log.scans
    if scans is None or not len(scans.stamps):
        return ""
    view = abs(scans.angle_increment) * (scans.ranges.shape[1] - 1)
    if view > 2.0 * np.pi + 0.1:
        return f"the laser's field of view is {np.degrees(view):.0f} degrees; angles must be radians, at most one turn in all"
    sample = scans.ranges[:: max(1, len(scans.ranges) // 200)]
    seen = sample[scans.hits(sample)]
    if len(seen) < _ENOUGH or np.median(seen) <= _LONGEST_READING:
        return ""
    usual = float(np.median(seen))
    unit = "millimetres" if usual > 500.0 else "centimetres"
    return _other_unit("the laser's readings", f"usual one would be {usual:.0f} m", unit, "laser")
