"""Units that are clearly wrong, reported before anything is computed with them."""

from typing import NamedTuple

import numpy as np

from .. import se2
from ..arrays import MOST, TINY, Floats
from ..errors import DataError
from ..sensor_log import LONGEST_RANGE, Odometry, SensorLog

FASTEST, IMPOSSIBLE = 3.0, 9.0
"""m/s; largest speed of a ground robot that maps a building, and one that none has for long."""
_USUAL_SPEED, _USUAL_DISTANCE = 0.3, 3.0
"""m/s; and m of ranges and readings: of two units the one that gives about as much is meant."""
_LONGEST_READING = 150.0
"""Largest usual reach of a lidar of this kind, m."""
_ENOUGH = 10
"""Least number of readings for a test of the unit."""
LENGTHS = {"feet": 0.3048, "centimetres": 0.01, "millimetres": 0.001}
_YARD, _SAME_UNIT = 0.9144, 0.05
"""m; and by how much, relatively, a factor that a map found may differ from that of a unit: ranges in yards came out as 1.09 to
1.14, for wheels are off by a few percent by themselves."""
_OTHER_LENGTH = 1.2
"""Ranges in another unit change by its factor as much as the wheels drive, up to this factor."""
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_LONG_TIMES = {"minutes": 60.0, "hours": 3600.0, "days": 86400.0}
_SELDOM, _OFTEN, _RAPID = 1.0, 0.005, 0.002
"""Limits of the time between readings, s, within which stamps are taken as seconds; no odometry is faster than the last."""
_MOVES = 1e-6
"""m or rad; below it nothing moves."""
_TURN_RATE = 3.0
"""Mean turn rate, rad/s, that no robot keeps."""
_PERIODS, _SPEEDS = (5e-4, 2.0), (0.01, IMPOSSIBLE)
"""Times between readings, s, and highest usual speeds, m/s, of a robot: what the right unit of time gives."""
_AGREEMENT = 0.7
"""Agreement of heading and direction of motion below which the heading is not the path's."""
_STRAIGHT = 0.9
"""Agreement of the directions of motion from which on a path shows one heading only."""
CLEARLY = 0.2
"""Another interpretation of the heading must agree better by so much."""


def refuse_wrong_lengths(log: SensorLog) -> None:
    """Raise DataError where the recording's lengths clearly have another unit than metres."""
    ranges, scans, view = np.zeros(0), np.zeros(0), 0.0
    if log.ranges is not None:
        ranges = log.ranges.ranges[log.ranges.ranges > 0]
    if log.scans is not None and len(log.scans.stamps):
        view = abs(log.scans.angle_increment) * (log.scans.ranges.shape[1] - 1)
        sample = log.scans.ranges[:: max(1, len(log.scans.ranges) // 200)]
        scans = sample[log.scans.hits(sample)].astype(np.float64)
    found = [
        _length(
            _speeds(log.odometry),
            IMPOSSIBLE,
            _USUAL_SPEED,
            "the odometry's positions",
            "usual speed would be {:.0f} m/s",
            "odometry",
        ),
        _length(ranges, LONGEST_RANGE, _USUAL_DISTANCE, "the ranges", "usual one would be {:.0f} m", "range"),
        _length(scans, _LONGEST_READING, _USUAL_DISTANCE, "the laser's readings", "usual one would be {:.0f} m", "laser"),
    ]
    if view > 2.0 * np.pi + 0.1:
        turn = f"the laser's field of view is {np.degrees(view):.0f} degrees"
        found[2] = f"{turn}; angles must be radians, at most one turn in all"
    if any(found):
        raise DataError("; ".join(filter(None, found)))


def _length(values: Floats, most: float, expected: float, what: str, words: str, option: str) -> str:
    """Return words on values (n,) that are usually larger than the most that is possible; '' where they are not."""
    usual = float(np.median(values)) if len(values) >= _ENOUGH else 0.0
    if usual <= most:
        return ""
    unit = min("centimetres", "millimetres", key=lambda name: abs(np.log(usual * LENGTHS[name] / expected)))
    return _other_unit(what, words.format(usual), unit, option)


def _other_unit(what: str, usual: str, unit: str, option: str) -> str:
    return f"{what} look like {unit}: the {usual}; write metres into the log (`{option}_unit={LENGTHS[unit]:g}`)"


def _speeds(odometry: Odometry) -> Floats:
    """Return the speeds (k,), m/s, of the readings that move.

    Each is taken over a second or to the next reading: those of two robots by turns, or in bursts, jump to and fro.
    """
    stamps, first = odometry.stamps, np.arange(len(odometry.stamps) - 1)
    # A second added to nanoseconds since 1970 is lost in rounding.
    second = np.clip(np.searchsorted(stamps, stamps[first] + 1.0), first + 1, len(first))
    span = stamps[second] - stamps[first]
    length = np.hypot(*(odometry.poses[second] - odometry.poses[first])[:, :2].T)
    moving = (length > _MOVES) & (span > 0.5)
    return np.asarray(length[moving] / span[moving])


def refuse_wrong_times(log: SensorLog) -> None:
    """Raise DataError where stamps clearly have another unit than seconds."""
    if text := _odometry_stamps(log.odometry) or _other_stamps(log):
        raise DataError(text)


def _odometry_stamps(odometry: Odometry) -> str:
    """Return words on stamps with which neither the time between readings nor the speed is a robot's; '' otherwise.

    With positions in centimetres a robot would be too fast as well, but would not spin.
    """
    span, steps = float(np.ptp(odometry.stamps)), np.abs(np.diff(odometry.poses, axis=0))
    length, times = np.hypot(steps[:, 0], steps[:, 1]), np.diff(odometry.stamps)
    moving = (length > _MOVES) & (times > 0.0)
    if span <= 0.0 or moving.sum() < _ENOUGH:
        return ""
    period, speed = span / len(steps), float(np.quantile(length[moving] / times[moving], MOST))
    spin = float(np.minimum(steps[:, 2] % (2.0 * np.pi), -steps[:, 2] % (2.0 * np.pi)).sum()) / span
    rapid = period < _OFTEN and speed > FASTEST and (spin > _TURN_RATE or period < _RAPID)
    fits = [
        (abs(np.log(speed / unit / _USUAL_SPEED)), name, unit)
        for name, unit in (_TIMES if period > _SELDOM else _LONG_TIMES if rapid else {}).items()
        if spin / unit < _TURN_RATE and _PERIODS[0] <= period * unit <= _PERIODS[1] and _SPEEDS[0] <= speed / unit <= _SPEEDS[1]
    ]
    if not fits:
        return ""
    _, name, unit = min(fits)
    return (
        f"the stamps look like {name}: the odometry would come every {period:.3g} s, at {speed:.1g} m/s; "
        f"write seconds into the log (`time_unit={unit:g}`)"
    )


def _other_stamps(log: SensorLog) -> str:
    """Return words on a sensor whose stamps have another unit than the odometry's; '' where none has."""
    wheels = log.odometry.stamps
    for what, sensor in (("gyro", log.gyro), ("radio", log.ranges), ("lidar", log.scans)):
        if sensor is None or len(sensor.stamps) < _ENOUGH:
            continue
        unit = _finer(sensor.stamps, wheels)
        odd, unit = (what, unit) if unit else ("odometry", _finer(wheels, sensor.stamps))
        if unit:
            return (
                f"the stamps of the {odd} look like {unit}: odometry and {what} would last {np.ptp(wheels):.4g} s and "
                f"{np.ptp(sensor.stamps):.4g} s; write every stamp in seconds"
            )
    return ""


def _finer(stamps: Floats, others: Floats) -> str:
    """Return the unit of stamps (n,) that makes them last as long as others (m,), s, at a sensor's rate; '' without one."""
    steps = np.diff(stamps)
    period = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    for name, unit in (_TIMES | (_LONG_TIMES if period < _OFTEN else {})).items():
        alike = 0.5 * np.ptp(others) < np.ptp(stamps) * unit < 2.0 * np.ptp(others)
        if alike and _PERIODS[0] <= period * unit <= _PERIODS[1]:
            return name
    return ""


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
    for name, unit in LENGTHS.items():
        if abs(np.log(change_by_way * unit)) < np.log(_OTHER_LENGTH):
            usual = f"usual change would be {change_by_way:.3g} times the distance that the wheels count"
            raise DataError(_other_unit("the ranges", usual, name, "range"))


def likely_unit(times: float) -> str:
    """Return words on what looks as if the robot drove so many times as far as its wheels count; '' where nothing does."""
    foot = LENGTHS["feet"]
    units = [(1.0 / _YARD, f"ranges in yards would look like this (`range_unit={_YARD}`)")]
    units += [(foot, f"odometry in feet would look like this (`odometry_unit={foot}`)")]
    return next((f"; {words}" for unit, words in units if times > 0.0 and abs(np.log(times / unit)) < _SAME_UNIT), "")


def heading_agreement(odometry: Odometry, factor: float = 1.0) -> tuple[float, float]:
    """Compare the heading times a factor with the direction of motion.

    Returns
    -------
    |mean exp(2 i (direction - factor heading))|, 1 for wheels that do not slide, forwards or backwards, near 0 for a wrong
    unit or sign; and the same of a heading that stays: 1 for a straight path, which shows nothing.
    """
    xy, heading, way = odometry.poses[:, :2], np.unwrap(odometry.poses[:, 2]), odometry.travelled
    # A fifth of a metre at a time, or a part of a path whose unit is not known.
    piece = np.floor(way / min(0.2, max(float(way[-1]) / 100.0, TINY)))
    apart = np.flatnonzero(np.diff(piece, prepend=-1.0) > 0)
    if len(apart) <= _ENOUGH:
        return 1.0, 1.0
    move = np.diff(xy[apart], axis=0)
    # As complex numbers: of squares the sign does not count.
    along = se2.as_complex(move) ** 2 / np.maximum(np.hypot(*move.T), np.finfo(float).tiny)
    weight, half = float(np.abs(along).sum()), 0.5 * (heading[apart[1:]] + heading[apart[:-1]])
    turned = along * se2.unit_complex(-2.0 * factor * half)
    return float(np.abs(turned.sum())) / weight, float(np.abs(along.sum())) / weight


class HeadingReading(NamedTuple):
    """How well the heading agrees with the direction of motion, see heading_agreement."""

    plain: float
    mirrored: float
    """With the other sign."""
    degrees: float
    """As degrees, wrapped or not."""
    straight: float
    """Of a heading that stays."""

    @property
    def sound(self) -> bool:
        """Whether the path does not turn enough to tell, or the heading is the path's as it stands."""
        return self.straight >= _STRAIGHT or self.plain >= _AGREEMENT

    @property
    def in_degrees(self) -> bool:
        """Whether the heading is the path's as degrees only, and explains more than half of how that turns."""
        others = max(self.plain, self.mirrored)
        return others < _AGREEMENT and self.degrees > others + CLEARLY and 1.0 - self.degrees < 0.5 * (1.0 - self.straight)


def heading_reading(odometry: Odometry) -> HeadingReading:
    """Return how the heading agrees with the path as it stands, with the other sign, and as degrees."""
    plain, straight = heading_agreement(odometry)
    mirrored, radians = heading_agreement(odometry, -1.0)[0], np.radians(odometry.poses[:, 2])
    degrees = heading_agreement(Odometry(odometry.stamps, np.column_stack([odometry.poses[:, :2], radians])))[0]
    return HeadingReading(plain, mirrored, degrees, straight)


def refuse_degrees(odometry: Odometry) -> None:
    """Raise DataError where the odometry's heading is clearly in degrees."""
    reading = heading_reading(odometry)
    if reading.in_degrees:
        raise DataError(
            f"the odometry's heading looks like degrees (as such it agrees with the path to {reading.degrees:.2f} of 1, as "
            f"radians to {reading.plain:.2f}); write radians into the log (`angle_unit=0.0174533`)"
        )
