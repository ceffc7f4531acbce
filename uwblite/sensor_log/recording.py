"""What was measured: one recording as arrays, checked once when it enters.

Every array is time-ordered. Times are seconds of one clock (the log's ipc_timestamp); lengths metres; angles radians.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .arrays import Bools, Floats, Ints
from .errors import DataError


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Wheel odometry: poses of the base in the drifting odom frame."""

    stamps: Floats
    """(n,) s, non-decreasing."""
    poses: Floats
    """(n, 3) x, y, theta of T_odom_base; m, m, rad."""

    @property
    def travelled(self) -> Floats:
        """(n,) m, distance since the first stamp."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.poses[:, :2], axis=0).T))])


@dataclass(frozen=True, slots=True, eq=False)
class UwbRanges:
    """Distances between the tag on the robot and fixed anchors."""

    stamps: Floats
    """(m,) s, non-decreasing."""
    anchor: Ints
    """(m,) index into anchor_ids."""
    ranges: Floats
    """(m,) m, as the radio reported them: zeros, spikes and biases included."""
    quality: Floats
    """(m,) 0..100 as the radio reported it; 100 where it reports none."""
    anchor_ids: tuple[str, ...]
    """Names of the anchors, sorted; each has at least one range."""
    tag: Ints | None = None
    """(m,) which of the robot's tags measured, an index into SensorMounting.tags; None = all the first."""

    def require_one_tag(self, place: str) -> None:
        """Raise DataError where the ranges of several tags would lose whose they are."""
        if self.tag is not None:
            raise DataError(f"{place} does not keep the ranges of several tags apart; convert to a .log, which does")

    def rows(self, which: slice | Ints | Bools) -> "UwbRanges":
        """Return some of the ranges, with the anchors that they are to."""
        used, anchor = np.unique(self.anchor[which], return_inverse=True)
        ids = tuple(self.anchor_ids[k] for k in used)
        tag = None if self.tag is None else self.tag[which]
        return UwbRanges(self.stamps[which], anchor.astype(np.int64), self.ranges[which], self.quality[which], ids, tag)


@dataclass(frozen=True, slots=True, eq=False)
class Gyro:
    """The heading of a gyro, from an arbitrary zero, with its bias."""

    stamps: Floats
    """(g,) s, non-decreasing."""
    heading: Floats
    """(g,) rad, counter-clockwise, unwrapped."""


@dataclass(frozen=True, slots=True, eq=False)
class LaserScans:
    """2D scans with the field names of sensor_msgs/LaserScan; all scans share one geometry."""

    stamps: Floats
    """(k,) s, time of the first ray, non-decreasing."""
    ranges: NDArray[np.float32]
    """(k, b) m; +inf = nothing seen up to range_max, nan = invalid (REP-117)."""
    angle_min: float
    """Angle of ray 0 in the laser frame, rad, counter-clockwise."""
    angle_increment: float
    """Angle between rays, rad."""
    time_increment: float
    """Time between rays, s (0: the scan is a snapshot)."""
    range_min: float
    range_max: float
    """m; a reading outside [range_min, range_max] is not an obstacle."""

    @property
    def angles(self) -> Floats:
        """(b,) angle of each ray in the laser frame, rad."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1]), dtype=np.float64)

    @property
    def middles(self) -> Floats:
        """(k,) s, time of the ray in the middle of each scan."""
        return self.stamps + 0.5 * self.time_increment * self.ranges.shape[1]

    def rows(self, which: slice | Ints | Bools) -> "LaserScans":
        """Return some of the scans."""
        return replace(self, stamps=self.stamps[which], ranges=self.ranges[which])


@dataclass(frozen=True, slots=True, eq=False)
class SensorMounting:
    """Where the sensors sit on the base."""

    T_base_laser: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) x, y, theta of the laser on the base."""
    laser_flipped: bool = False
    """Laser mounted upside down: its rays run clockwise."""
    tag_position: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) x, y, z of the tag on the base; z is the height above the floor."""
    anchor_height: float | None = None
    """Height of the anchors above the floor, m; None = not given (taken as the tag's height)."""
    anchor_heights: dict[str, float] = field(default_factory=dict)
    """Heights of single anchors above the floor, m, by id; they win over anchor_height."""
    more_tags: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(t, 3) x, y, z of further tags on the base."""

    @property
    def tags(self) -> Floats:
        """(1 + t, 3) x, y, z of all tags on the base, m."""
        return np.concatenate([self.tag_position[None], self.more_tags])

    def height_difference(self, anchor_id: str) -> float | None:
        """Height of an anchor above the tag, m; None where none is given."""
        height = self.anchor_heights.get(anchor_id, self.anchor_height)
        return None if height is None else height - float(self.tag_position[2])


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
    scans_left_out: int = 0
    """Scans that were recorded and are not among `scans`, because no map looks at them."""


@dataclass(frozen=True, slots=True)
class Remark:
    """One contradiction within a recording."""

    kind: str
    """A name for programs."""
    text: str
    """What, where and how to fix it, for people."""
    doubt: bool = False
    """Whether a map of the recording should not be trusted; otherwise it was repaired, or costs accuracy only."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryBreaks:
    """Steps of the odometry that were predicted, not measured."""

    stamps: Floats
    """(b,) of the reading before the step, s."""
    sigma: Floats
    """(b, 3) standard deviation of the step, m, m, rad; what wheels are uncertain by besides comes on top."""

    @staticmethod
    def none() -> "OdometryBreaks":
        """Return no breaks."""
        return OdometryBreaks(np.zeros(0), np.zeros((0, 3)))

    @staticmethod
    def of_all(parts: "Sequence[OdometryBreaks]") -> "OdometryBreaks":
        """Return the breaks of one or more parts, in the order of time."""
        stamps, sigma = np.concatenate([b.stamps for b in parts]), np.concatenate([b.sigma for b in parts])
        order = np.argsort(stamps, kind="stable")
        return OdometryBreaks(stamps[order], sigma[order])


@dataclass(frozen=True, slots=True, eq=False)
class Screening:
    """What was found and repaired in a recording before it is mapped."""

    remarks: tuple[Remark, ...]
    breaks: OdometryBreaks
    lidar_by_wheels: float = float("nan")
    """Way by the lidar / way by the wheels; nan where nothing shows it."""


MOST_METRES, MOST_SECONDS = 1e7, 1e20
"""Numbers beyond these are no measurements: a quarter of the Earth's girth, and more than any time in any unit."""
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
        _check(self.odometry.stamps, "odometry.stamps", (None,), ordered=True)
        _check(self.odometry.poses, "odometry.poses", (len(self.odometry.stamps), 3), most=MOST_METRES)
        if len(self.odometry.stamps) == 0:
            raise DataError("the log has no odometry; uwblite needs ODOM messages (or ROBOTLASER1 with robot poses)")
        if self.gyro is not None:
            _check(self.gyro.stamps, "gyro.stamps", (None,), ordered=True)
            _check(self.gyro.heading, "gyro.heading", (len(self.gyro.stamps),))
        if self.ranges is not None:
            m = len(self.ranges.stamps)
            _check(self.ranges.stamps, "ranges.stamps", (None,), ordered=True)
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
        for name in (*(() if self.ranges is None else self.ranges.anchor_ids), *self.mounting.anchor_heights):
            if fault := fault_of_id(name):
                raise DataError(f"the anchor's id {fault}")
        if self.scans is not None:
            _check(self.scans.stamps, "scans.stamps", (None,), ordered=True)
            if self.scans.ranges.ndim != 2 or len(self.scans.ranges) != len(self.scans.stamps):
                raise DataError(f"scans.ranges has shape {self.scans.ranges.shape}, expected ({len(self.scans.stamps)}, beams)")

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

    def with_later_scans(self, delay: float) -> "SensorLog":
        """Return the same recording with every scan later by delay, s."""
        if self.scans is None or delay == 0.0:
            return self
        return replace(self, scans=replace(self.scans, stamps=self.scans.stamps + delay))

    def crop(self, start: float = -np.inf, end: float = np.inf) -> "SensorLog":
        """Return the part of the recording with start <= stamp <= end, s."""

        def part(stamps: Floats) -> slice:
            return slice(int(np.searchsorted(stamps, start, "left")), int(np.searchsorted(stamps, end, "right")))

        odometry, ranges, scans = self.odometry, self.ranges, self.scans
        cut = part(odometry.stamps)
        odometry = Odometry(odometry.stamps[cut], odometry.poses[cut])
        if ranges is not None:
            cut = part(ranges.stamps)
            ranges = ranges.rows(cut)
        if scans is not None:
            cut = part(scans.stamps)
            scans = scans.rows(cut)
        gyro = self.gyro
        if gyro is not None:
            cut = part(gyro.stamps)
            gyro = Gyro(gyro.stamps[cut], gyro.heading[cut])
        return replace(self, odometry=odometry, ranges=ranges, scans=scans, gyro=gyro)


def _check(
    values: Floats, name: str, shape: tuple[int | None, ...], ordered: bool = False, most: float = MOST_SECONDS
) -> None:
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
