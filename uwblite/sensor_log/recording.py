"""One recording as arrays, checked once when it enters, with what reader and screening saw in it besides."""

import numbers
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .. import se2
from ..arrays import Floats, Table, concatenated, require_finite, require_index, require_type
from ..config import documented
from ..errors import DataError
from ..findings import Fact
from .sensors import Gyro, LaserScans, Odometry, SensorMounting, UwbRanges


@dataclass(frozen=True, slots=True, eq=False)
class LogNotes:
    """What the reader saw besides the data: counts that must not vanish silently."""

    source: str = ""
    """Name of the file(s), as given."""
    sha256: str = ""
    """Hash of the bytes read."""
    lines: int = 0
    broken_lines: tuple[tuple[int, str], ...] = ()
    """First broken lines as (line number, why); `broken` counts all."""
    broken: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    """Messages that are known and not used, by name."""
    warnings: tuple[str, ...] = ()
    """Oddities in words, each with its remedy or what was done."""
    unread: tuple[str, ...] = ()
    """Topics of a bag that may hold ranges and were not read."""
    set_back: dict[str, float] = field(default_factory=dict)
    """By how much a sensor's clock was set back at most, s, in the order in which its messages were written."""
    one_clock: bool = False
    """Whether odometry and scans cannot be of different clocks: they share messages, or their stamps are made up."""
    scans_left_out: int = 0
    """Scans that were recorded and are not among `scans`, because no map looks at them."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryBreaks(Table):
    """Steps of the odometry that were predicted, not measured."""

    stamps: Floats
    """(b,) of the reading before the step, s."""
    sigma: Floats
    """(b, 3) standard deviation of the step, m, m, rad; what wheels are uncertain by besides comes on top."""

    @staticmethod
    def none() -> "OdometryBreaks":
        """Return no breaks."""
        return OdometryBreaks(np.zeros(0), np.zeros((0, *se2.POSE)))

    @staticmethod
    def of_all(parts: "Sequence[OdometryBreaks]") -> "OdometryBreaks":
        """Return the breaks of one or more parts, in the order of time."""
        whole = concatenated(parts)
        return whole.rows(np.argsort(whole.stamps, kind="stable"))


@dataclass(frozen=True, slots=True, eq=False)
class Screening:
    """What was found and repaired in a recording before it is mapped."""

    facts: tuple[Fact, ...]
    """Of each of them a rule makes a finding."""
    breaks: OdometryBreaks
    lidar_by_wheels: float = float("nan")
    """Distance by the lidar / distance by the wheels; nan where nothing shows it."""
    in_bursts: tuple[str, ...] = ()
    """Sensors whose stamps are times of receipt in bursts: no clock offset can be estimated against them."""


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


@documented
@dataclass(frozen=True, slots=True, eq=False)
class SensorLog:
    """One recording. `ranges` and `scans` are None when the sensor was not there."""

    odometry: Odometry
    """Poses of the base by the wheels, see sensor_log.Odometry."""
    ranges: UwbRanges | None = None
    """Distances to anchors, see sensor_log.UwbRanges."""
    scans: LaserScans | None = None
    """Scans of one lidar, see sensor_log.LaserScans."""
    mounting: SensorMounting = field(default_factory=SensorMounting)
    """Where laser, tag and anchors are, see sensor_log.SensorMounting."""
    notes: LogNotes = field(default_factory=LogNotes)
    """Where it comes from, and what the reader saw besides."""
    screening: Screening | None = None
    """What screening found; None before it."""
    gyro: Gyro | None = None
    """Heading of a gyro, see sensor_log.Gyro."""

    def __post_init__(self) -> None:
        kinds = {"odometry": Odometry, "gyro": Gyro, "ranges": UwbRanges, "scans": LaserScans}
        for name, kind in kinds.items():
            sensor = getattr(self, name)
            if sensor is not None or name == "odometry":
                require_type(sensor, name, kind)
                _check_stamps(sensor, name)
        require_type(self.mounting, "mounting", SensorMounting)
        require_finite(self.odometry.poses, "odometry.poses", MOST_METRES)
        if len(self.odometry.stamps) == 0:
            raise DataError("there is no odometry, which a map begins with; a log has it as ODOM or in ROBOTLASER1")
        if self.gyro is not None:
            require_finite(self.gyro.heading, "gyro.heading", MOST_SECONDS)
        if self.ranges is not None:
            _check_ranges(self.ranges, len(self.mounting.tags))
        if self.scans is not None:
            _check_geometry(self.scans)
        for name, places in (("laser", self.mounting.T_base_laser[:2]), ("tag", self.mounting.tags)):
            if not (away := float(np.abs(places).max())) <= _FARTHEST_ON_ROBOT:
                where = f"{away:.3g} m from the base, on which it is mounted"
                raise DataError(f"the {name} stands {where}; lengths are in m, not mm")
        require_finite(self.mounting.T_base_laser, "mounting.T_base_laser")
        require_finite(self.mounting.tags, "mounting.tag_position and more_tags")
        for name in (*(() if self.ranges is None else self.ranges.anchor_ids), *self.mounting.anchor_heights):
            if fault := fault_of_id(name):
                raise DataError(f"the anchor's id {fault}")

    def without(self, *, uwb: bool = False, lidar: bool = False) -> "SensorLog":
        """Return the same recording with a sensor left out."""
        return replace(self, ranges=None if uwb else self.ranges, scans=None if lidar else self.scans)

    def with_odometry_times(self, factor: float) -> "SensorLog":
        """Return the same recording with the odometry's lengths multiplied by a factor."""
        lengths, screening = np.array([factor, factor, 1.0]), self.screening
        if screening is not None:
            breaks = replace(screening.breaks, sigma=screening.breaks.sigma * lengths)
            screening = replace(screening, breaks=breaks, lidar_by_wheels=screening.lidar_by_wheels / factor)
        return replace(self, odometry=replace(self.odometry, poses=self.odometry.poses * lengths), screening=screening)

    def with_time_unit(self, unit: float) -> "SensorLog":
        """Return the same recording with its stamps multiplied by the seconds of their unit."""
        return self._of_each(lambda sensor: replace(sensor, stamps=sensor.stamps * unit))

    def with_later_scans(self, delay: float) -> "SensorLog":
        """Return the same recording with every scan later by delay, s."""
        if self.scans is None or delay == 0.0:
            return self
        return replace(self, scans=replace(self.scans, stamps=self.scans.stamps + delay))

    def with_longer_scans(self, longer: float) -> "SensorLog":
        """Return the same recording with scans that take longer from the first ray to the last, s, about the same middles."""
        if self.scans is None or longer == 0.0:
            return self
        beams = self.scans.ranges.shape[1]
        more = longer / max(beams - 1, 1)
        scans = replace(
            self.scans, time_increment=self.scans.time_increment + more, stamps=self.scans.stamps - 0.5 * more * beams
        )
        return replace(self, scans=scans)

    def crop(self, start: float = -np.inf, end: float = np.inf) -> "SensorLog":
        """Return the part of the recording with start <= stamp <= end, s."""

        def cut(sensor: Any) -> Any:
            first, last = np.searchsorted(sensor.stamps, start, "left"), np.searchsorted(sensor.stamps, end, "right")
            return sensor.rows(slice(int(first), int(last)))

        return self._of_each(cut)

    def _of_each(self, change: Callable[[Any], Any]) -> "SensorLog":
        """Return the recording with every sensor changed."""
        sensors = {name: getattr(self, name) for name in ("odometry", "ranges", "scans", "gyro")}
        return replace(self, **{name: change(sensor) for name, sensor in sensors.items() if sensor is not None})


def _check_stamps(sensor: Any, name: str) -> None:
    require_finite(sensor.stamps, f"{name}.stamps", MOST_SECONDS)
    if np.any(back := np.diff(sensor.stamps) < 0):
        raise DataError(f"{name}.stamps runs backwards at index {int(np.argmax(back)) + 1}; sort by time first")


def _check_ranges(ranges: UwbRanges, tags: int) -> None:
    names = ranges.anchor_ids
    if len(names) > MOST_ANCHORS:
        raise DataError(
            f"the ranges name {len(names)} anchors, more than {MOST_ANCHORS}: is the anchor's id what stands in its field?"
        )
    for k, name in enumerate(names):
        require_type(name, f"ranges.anchor_ids[{k}]", str)
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise DataError(f"ranges.anchor_ids has {twice[0]!r} twice; each anchor has one entry, and ranges.anchor refers to it")
    require_finite(ranges.ranges, "ranges.ranges", MOST_METRES)
    require_finite(ranges.quality, "ranges.quality", MOST_SECONDS)
    require_index(ranges.anchor, "ranges.anchor", len(names), "anchor_ids")
    if ranges.tag is not None:
        require_index(ranges.tag, "ranges.tag", tags, "tags of the mounting")


def _check_geometry(scans: LaserScans) -> None:
    for name in ("angle_min", "angle_increment", "time_increment", "range_min", "range_max"):
        value = getattr(scans, name)
        require_type(value, f"scans.{name}", numbers.Real, "number")
        if not np.isfinite(value) and name != "range_max":
            raise DataError(f"scans.{name} is {value}; it must be a finite number")
