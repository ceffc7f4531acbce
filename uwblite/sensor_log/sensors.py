"""Measurements of each sensor, its mounting on the base, and the names of anchors that were moved."""

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, settle
from ..config import documented
from ..errors import DataError


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Odometry(Table):
    """Wheel odometry: poses of the base in the drifting odom frame."""

    stamps: Floats
    """(n,) s, non-decreasing."""
    poses: Floats
    """(n, 3) x, y, theta of T_odom_base; m, m, rad."""

    def __post_init__(self) -> None:
        settle(self, "odometry", {"stamps": ("n",), "poses": ("n", *se2.POSE)})

    @property
    def travelled(self) -> Floats:
        """(n,) m, distance since the first stamp."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.poses[:, :2], axis=0).T))])

    def travelled_at(self, stamps: Floats) -> Floats:
        """Return the distance (m,), m, driven until stamps (m,), s."""
        return np.interp(stamps, self.stamps, self.travelled)

    @property
    def steps(self) -> Floats:
        """(n - 1, 3) motion from each reading to the next, m, m, rad."""
        return se2.between(self.poses[:-1], self.poses[1:])

    def at(self, stamps: Floats) -> Floats:
        """Return the poses (..., 3) at stamps (...), s; see se2.interpolate_trajectory."""
        return se2.interpolate_trajectory(self.stamps, self.poses, stamps)

    def motion(self, start: Floats, end: Floats) -> Floats:
        """Return the motions (..., 3) between stamps (...), (...), s; m, m, rad."""
        return se2.between(self.at(start), self.at(end))


SHORTEST_RANGE, LONGEST_RANGE = 0.02, 200.0
"""m; no radio of this kind reaches farther, and one that reports zero has missed its partner."""


def plausible(ranges: Floats, longest: float = LONGEST_RANGE) -> Bools:
    """Return which readings (m,) of a radio, m, can be distances."""
    return (ranges > SHORTEST_RANGE) & (ranges < longest)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class UwbRanges(Table):
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

    def __post_init__(self) -> None:
        settle(self, "ranges", dict.fromkeys(("stamps", "anchor", "ranges", "quality", "tag"), ("m",)))
        object.__setattr__(self, "anchor_ids", tuple(self.anchor_ids))

    def require_one_tag(self, place: str) -> None:
        """Raise DataError where the ranges of several tags would lose whose they are."""
        if self.tag is not None:
            raise DataError(f"{place} does not keep the ranges of several tags apart; convert to a .log, which does")

    @property
    def tags(self) -> Ints:
        """(m,) which of the robot's tags measured."""
        return np.zeros(len(self.stamps), dtype=np.intp) if self.tag is None else self.tag

    def by_pair(self, among: Bools) -> list[tuple[int, Ints]]:
        """Return for each pair of an anchor and a tag the anchor and the rows of its ranges among some (m,)."""
        pairs = np.unique(np.column_stack([self.anchor, self.tags])[among], axis=0).tolist()
        return [(anchor, np.flatnonzero(among & (self.anchor == anchor) & (self.tags == tag))) for anchor, tag in pairs]

    def rows(self, which: slice | Ints | Bools) -> "UwbRanges":
        """Return some of the ranges, with the anchors that they are to."""
        some = Table.rows(self, which)
        used, anchor = np.unique(some.anchor, return_inverse=True)
        return replace(some, anchor=anchor.astype(np.intp), anchor_ids=tuple(self.anchor_ids[k] for k in used))


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Gyro(Table):
    """The heading of a gyro, from an arbitrary zero, with its bias."""

    stamps: Floats
    """(g,) s, non-decreasing."""
    heading: Floats
    """(g,) rad, counter-clockwise, unwrapped."""

    def __post_init__(self) -> None:
        settle(self, "gyro", {"stamps": ("g",), "heading": ("g",)})


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LaserScans(Table):
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

    def __post_init__(self) -> None:
        settle(self, "scans", {"stamps": ("k",), "ranges": ("k", "b")})

    @property
    def angles(self) -> Floats:
        """(b,) angle of each ray in the laser frame, rad."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1]), dtype=np.float64)

    def hits(self, readings: NDArray[np.floating], farthest: float = np.inf) -> Bools:
        """Return which readings (...), m, ended at something up to a distance, m."""
        with np.errstate(invalid="ignore"):
            return np.asarray((readings >= self.range_min) & (readings <= min(farthest, self.range_max)))

    @property
    def duration(self) -> float:
        """Time from the first ray of a scan to its last, s."""
        return self.time_increment * max(self.ranges.shape[1] - 1, 0)

    @property
    def middles(self) -> Floats:
        """(k,) s, time of the ray in the middle of each scan."""
        return self.stamps + 0.5 * self.time_increment * self.ranges.shape[1]


@documented
@dataclass(frozen=True, slots=True, eq=False)
class SensorMounting:
    """Mounting of the sensors on the base."""

    T_base_laser: Floats = field(default_factory=lambda: np.zeros(se2.POSE))
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
    laser_is_base: bool = False
    """The log's poses are those of the laser: each scan came with its pose and the robot's, and these are the same. The laser
    is then where it is said to be, and the wheels may measure the motion of another point."""

    def __post_init__(self) -> None:
        settle(self, "mounting", {"T_base_laser": se2.POSE, "tag_position": (3,), "more_tags": ("t", 3)})

    @property
    def tags(self) -> Floats:
        """(1 + t, 3) x, y, z of all tags on the base, m."""
        return np.concatenate([self.tag_position[None], self.more_tags])

    def height_difference(self, anchor_id: str) -> float | None:
        """Height of an anchor above the tag, m; None where none is given."""
        height = self.anchor_heights.get(anchor_id, self.anchor_height)
        return None if height is None else height - float(self.tag_position[2])


_PLACE = re.compile(r"(.+?)(?:@(\d+))?(?:#(\d+))?", re.DOTALL)
"""``ID@2``: the second place within a recording; ``ID#2``: the second one of several recordings."""


def _parts(name: str, names: Collection[str]) -> tuple[str, int, int]:
    """Return the radio's name of an anchor, and the numbers of its place in the order of time.

    A radio may be called ``ID@2`` itself: that is another place of ``ID`` only where there is an ``ID``.
    """
    match = _PLACE.fullmatch(name)
    if match is None or match[1] not in names:
        return name, 1, 1
    return match[1], int(match[3] or 1), int(match[2] or 1)


def name_and_number(name: str) -> tuple[str, int]:
    """Return the name of an anchor in its recording and which of its places there is meant: ``ID`` is 1, ``ID@2`` is 2 ..."""
    base, mark, number = name.rpartition("@")
    return (base, int(number)) if mark and number.isdigit() else (name, 1)


def place_name(radio: str, number: int, recording: int) -> str:
    """Return the name of a radio's place, the first, second ... (1, 2, ...) of those that it has in a recording (0, 1, ...).

    Of the first recording in which it is heard, which has the number 0 here, the recording is not named.
    """
    return radio + (f"@{number}" if number > 1 else "") + (f"#{recording + 1}" if recording else "")


def first_place(anchor: str) -> str:
    """Return the name of an anchor where the first of several recordings has it: ``ID@2`` of ``ID@2#3``."""
    return re.sub(r"#\d+$", "", anchor)


def radio_name(anchor: str) -> str:
    """Return the radio's name of an anchor, given the name of one of its places, such as ``5C0B@2#3``."""
    return re.sub(r"(@\d+)?(#\d+)?$", "", anchor)


def last_places(names: Collection[str]) -> dict[str, str]:
    """Return of each anchor of a map, by its radio's name, the name of its last place."""
    return {_parts(name, names)[0]: name for name in sorted(names, key=lambda n: _parts(n, names)[1:])}
