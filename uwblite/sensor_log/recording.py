"""One recording as arrays, checked once when it enters, and the checks."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from ..arrays import Floats
from ..errors import DataError
from .notes import LogNotes, Screening
from .sensors import Gyro, LaserScans, Odometry, SensorMounting, UwbRanges

_Sensor = TypeVar("_Sensor", Odometry, UwbRanges, LaserScans, Gyro)


MOST_METRES, MOST_SECONDS = 1e7, 1e20
"""Numbers beyond these are no measurements: a quarter of the Earth's girth, and more than any time in any unit."""
_FARTHEST_ON_ROBOT = 100.0
"""m; no robot is larger."""
MOST_ANCHORS = 1000
"""A building may have hundreds."""


def one_word(name: str) -> str:
    """Return an anchor's id as the one word that it is in a line of text: blanks become underscores."""
    return re.sub("[ \t]+", "_", name.strip(" \t"))


def fault_of_id(name: str) -> str:
    """Return what is wrong with an anchor's id, '' where nothing is.

    Ids stand in lines of text, on terminals and in tables that spreadsheets open, which take a word that begins with = + -
    or @ for a formula.
    """
    if not 0 < len(name) <= 64:
        return "must be 1 to 64 characters long"
    if not name.isprintable() or " " in name:
        return f"{name!a} holds a blank or what cannot be printed"
    if re.match(r"[=+@]|-(?!\d+$)", name):
        return f"{name!r} begins like the formula of a spreadsheet"
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class SensorLog:
    """One recording. `ranges` and `scans` are None when the sensor was not there."""

    odometry: Odometry
    ranges: UwbRanges | None = None
    scans: LaserScans | None = None
    mounting: SensorMounting = field(default_factory=SensorMounting)
    notes: LogNotes = field(default_factory=LogNotes)
    screening: Screening | None = None
    """What screening found; None before it."""
    gyro: Gyro | None = None

    def __post_init__(self) -> None:
        sensors = {"odometry": self.odometry, "gyro": self.gyro, "ranges": self.ranges, "scans": self.scans}
        for name, sensor in sensors.items():
            if sensor is not None:
                _check(sensor.stamps, f"{name}.stamps", (None,), ordered=True)
        _check(self.odometry.poses, "odometry.poses", (len(self.odometry.stamps), 3), most=MOST_METRES)
        if len(self.odometry.stamps) == 0:
            raise DataError("the log has no odometry; uwblite needs ODOM messages (or ROBOTLASER1 with robot poses)")
        if self.gyro is not None:
            _check(self.gyro.heading, "gyro.heading", (len(self.gyro.stamps),))
        if self.ranges is not None:
            m = len(self.ranges.stamps)
            if len(self.ranges.anchor_ids) > MOST_ANCHORS:
                raise DataError(
                    f"the ranges name {len(self.ranges.anchor_ids)} anchors, more than {MOST_ANCHORS}: is the anchor's id what "
                    "stands in its field?"
                )
            _check(self.ranges.ranges, "ranges.ranges", (m,), most=MOST_METRES)
            _check(self.ranges.quality, "ranges.quality", (m,))
            tag, tags = self.ranges.tag, len(self.mounting.tags)
            if tag is not None and (tag.shape != (m,) or not np.all((tag >= 0) & (tag < tags))):
                raise DataError(f"ranges.tag does not say one of {tags} tags for each of {m} ranges")
            if self.ranges.anchor.shape != (m,):
                raise DataError(f"ranges.anchor has shape {self.ranges.anchor.shape}, expected ({m},)")
            if m and not 0 <= self.ranges.anchor.min() <= self.ranges.anchor.max() < len(self.ranges.anchor_ids):
                raise DataError("ranges.anchor holds an index outside anchor_ids")
        for name, places in (("laser", self.mounting.T_base_laser[:2]), ("tag", self.mounting.tags)):
            if not np.all(np.abs(places) <= _FARTHEST_ON_ROBOT):
                away = f"{np.abs(places).max():.3g} m from the base, on which it is mounted"
                raise DataError(f"the {name} stands {away}; lengths are in m, not mm")
        for name in (*(() if self.ranges is None else self.ranges.anchor_ids), *self.mounting.anchor_heights):
            if fault := fault_of_id(name):
                raise DataError(f"the anchor's id {fault}")
        if self.scans is not None and (self.scans.ranges.ndim != 2 or len(self.scans.ranges) != len(self.scans.stamps)):
            raise DataError(f"scans.ranges has shape {self.scans.ranges.shape}, expected ({len(self.scans.stamps)}, beams)")
        if self.scans is not None and not np.isfinite(self._laser_numbers).all():
            raise DataError("angle_min, angle_increment, time_increment, range_min and range_max of scans must be finite")

    @property
    def _laser_numbers(self) -> list[float]:
        s = self.scans
        return [] if s is None else [s.angle_min, s.angle_increment, s.time_increment, s.range_min, s.range_max]

    def without(self, *, uwb: bool = False, lidar: bool = False) -> "SensorLog":
        """Return the same recording with a sensor left out."""
        return replace(self, ranges=None if uwb else self.ranges, scans=None if lidar else self.scans)

    def with_odometry_times(self, factor: float) -> "SensorLog":
        """Return the same recording with the odometry's lengths multiplied by a factor."""
        lengths = np.array([factor, factor, 1.0])
        odometry, screening = replace(self.odometry, poses=self.odometry.poses * lengths), self.screening
        if screening is not None:
            breaks = replace(screening.breaks, sigma=screening.breaks.sigma * lengths)
            screening = replace(screening, breaks=breaks, lidar_by_wheels=screening.lidar_by_wheels / factor)
        return replace(self, odometry=odometry, screening=screening)

    def with_time_unit(self, unit: float) -> "SensorLog":
        """Return the same recording with its stamps multiplied by the seconds of their unit."""
        return self._of_each(lambda sensor: replace(sensor, stamps=sensor.stamps * unit))

    def with_later_scans(self, delay: float) -> "SensorLog":
        """Return the same recording with every scan later by delay, s."""
        if self.scans is None or delay == 0.0:
            return self
        return replace(self, scans=replace(self.scans, stamps=self.scans.stamps + delay))

    def crop(self, start: float = -np.inf, end: float = np.inf) -> "SensorLog":
        """Return the part of the recording with start <= stamp <= end, s."""

        def cut(sensor: _Sensor) -> _Sensor:
            first, last = np.searchsorted(sensor.stamps, start, "left"), np.searchsorted(sensor.stamps, end, "right")
            return sensor.rows(slice(int(first), int(last)))

        return self._of_each(cut)

    def _of_each(self, change: Callable[[Any], Any]) -> "SensorLog":
        """Return the recording with every sensor changed."""
        sensors = {name: getattr(self, name) for name in ("odometry", "ranges", "scans", "gyro")}
        return replace(self, **{name: change(sensor) for name, sensor in sensors.items() if sensor is not None})


def _check(values: Floats, name: str, shape: tuple[int | None, ...], ordered: bool = False, most: float = MOST_SECONDS) -> None:
    if values.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, values.shape, strict=True)):
        raise DataError(f"{name} has shape {values.shape}, expected {shape}")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if len(bad):
        raise DataError(f"{name}[{bad[0]}] is not finite ({len(bad)} such rows)")
    far = np.flatnonzero((np.abs(values) > most).any(axis=tuple(range(1, values.ndim))))
    if len(far):
        raise DataError(f"{name}[{far[0]}] is beyond {most:g} ({len(far)} such rows); are the units right?")
    if ordered and np.any(np.diff(values) < 0):
        raise DataError(f"{name} runs backwards at index {int(np.argmax(np.diff(values) < 0)) + 1}; sort by time first")
