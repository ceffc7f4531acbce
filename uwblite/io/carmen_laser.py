"""The laser messages of a CARMEN log: found line by line, their readings decoded for a whole block of lines at a time."""

import math
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints
from ..sensor_log import LaserScans
from .carmen_stamps import LineClock, time_order
from .carmen_words import HEAD, RANK, BrokenLine, Layout, Params, kinds_of, numbers, parse_head, split_tail
from .readings import DEFAULT_REACH, ScanGeometry, beams_lie_between, clean, resampled, resampling_warning

DEFAULT_RANGE_MIN = 0.02
"""m; smaller readings of a scanner are error codes (URG-04LX: 0..19 mm). PARAM laser_range_min has priority."""
POSE_TOLERANCE = 0.01
"""m or rad; a laser whose pose on the robot varies more than this is reported."""

_LAYOUTS_KEPT = 1000
_URG_PERIOD = 0.1
"""s; time of one turn of a URG-04LX."""


Bytes = NDArray[np.uint8]


class Pending(NamedTuple):
    """One message of the block at hand, parsed but for its readings."""

    number: int
    first: int
    """Index into the gaps of the gap behind the first reading."""
    stamp: float


@dataclass(slots=True, eq=False)
class Block:
    """Some whole lines of a log."""

    text: bytes
    """The lines, each with its line end."""
    array: Bytes
    """The same."""
    gaps: Ints
    """Index of every blank, tab or line end in the text."""

    @staticmethod
    def of(text: bytes) -> "Block":
        """Return the block of a text, its words parted by single blanks."""
        if b"  " in text or b"\t" in text:
            text = re.sub(rb"(?<=[^\n])[ \t]+", b" ", text)
        array = np.frombuffer(text, dtype=np.uint8)
        return Block(text, array, np.flatnonzero(array <= 32))

    def decode_rows(self, beams: int, pending: list[Pending]) -> tuple[NDArray[np.float32], list[ValueError | None]]:
        """Return the readings (k, beams) of messages, and by message what is wrong with it."""
        errors: list[ValueError | None] = [None] * len(pending)
        first = np.array([p.first for p in pending], dtype=np.intp)
        begins, ends = self.gaps[np.maximum(first - 1, 0)] + 1, self.gaps[first + beams - 1]
        values = np.empty((len(pending), beams), dtype=np.float32)
        word = self.text[begins[0] : self.gaps[first[0]]]
        width, decimals = len(word), len(word) - 1 - word.find(b".")
        quick = (ends - begins == beams * (width + 1) - 1) & (1 <= decimals <= 6) & (decimals + 2 <= width <= 9)
        if quick.any():
            values[quick], quick[quick] = decode_equal_widths(self.array, begins[quick], beams, width, decimals)
        for row in np.flatnonzero(~quick):
            try:
                readings = np.array(self.text[begins[row] : ends[row]].split(), dtype=np.float64)
                if len(readings) != beams:
                    raise BrokenLine("readings are parted unevenly")
                values[row] = np.clip(readings, -1.0, 1e30)
            except ValueError as error:
                errors[row] = error
        return values, errors


def decode_equal_widths(
    text: Bytes, begins: Ints, count: int, width: int, decimals: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Decode rows of numbers that all have the same width, ``0.123 4.567 8.900``, by columns of digits: five times as fast.

    Parameters
    ----------
    begins : (k,) index of each row's first character. count : numbers in a row.
    width : characters of each number; one blank stands between numbers and behind the last.
    decimals : digits behind the dot, 1..6.

    Returns
    -------
    The numbers (k, count), and whether every number of the row has that form (k,); the values of other rows mean nothing.
    """
    span = count * (width + 1)
    characters = np.empty((len(begins), count, width + 1), dtype=np.uint8)
    for row, begin in zip(characters, begins.tolist(), strict=True):
        row.reshape(-1)[:] = text[begin : begin + span]
    characters ^= ord("0")
    dot = width - decimals - 1
    plain = (characters[:, :, dot] == ord(".") ^ ord("0")).all(axis=1)
    plain &= (characters[:, :, width] ^ ord("0") <= ord(" ")).all(axis=1)
    total = np.zeros(characters.shape[:2], dtype=np.uint32)
    for column in (c for c in range(width) if c != dot):
        digit = characters[:, :, column]
        plain &= digit.max(axis=1) <= 9
        total *= 10
        total += digit
    return (total / 10.0**decimals).astype(np.float32), plain


@dataclass(slots=True, eq=False)
class _Scans:
    """All scans of one layout."""

    ranges: "array[float]" = field(default_factory=lambda: array("f"))
    """Readings of all scans, one behind the other."""
    stamps: "array[float]" = field(default_factory=lambda: array("d"))
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    """Line of each scan: layouts take turns in one log."""
    seen: int = 0
    pending: list[Pending] = field(default_factory=list)


class LaserMessages:
    """Collects the scans of one log; `begin` a block, `take` its lines, `decode` the block, `finish` the log."""

    def __init__(self, every_nth_scan: int, message: str = "") -> None:
        self.kinds = kinds_of(message)
        """Names of the messages that are read -> their kind."""
        self.ipc_left_out = False
        """Whether the log leaves out ipc_timestamp; decides where a line alone does not."""
        self._every_nth = every_nth_scan
        self._kind = b""
        self._counts = dict.fromkeys(RANK, 0)
        self._layouts: dict[bytes, Layout] = {}
        self._scans: dict[Layout, _Scans] = {}
        self._between = set[Layout]()
        """Layouts whose beams lie between those of another one."""
        self._poses = array("d")
        """stamp, laser pose (3), robot pose (3) of every message that gives them."""
        self._pose_lines = array("q")

    def begin(self, block: Block) -> None:
        """Start a block of lines."""
        self._block = block

    def take(self, name: bytes, number: int, start: int, end: int, gap: int) -> None:
        """Take line `number`, block[start:end], whose name ends at gaps[gap], as a message of kind `name`."""
        self._counts[name] += 1
        if name != self._kind:
            if self._kind and RANK[name] < RANK[self._kind]:
                return
            self._kind = name
            self._scans, self._poses, self._pose_lines, self._layouts = {}, array("d"), array("q"), {}
        text, gaps, what, head = self._block.text, self._block.gaps, name.decode(), gap + HEAD[name] - 1
        if head >= len(gaps) or gaps[head] > end:
            raise BrokenLine(f"{what} has {len(text[start:end].split())} fields, far too few")
        layout = self._layout(name, text[start : gaps[head]])
        last = head + layout.beams
        if last >= len(gaps) or gaps[last] >= end:
            raise BrokenLine(f"{what} announces {layout.beams} readings but the line is too short for them")
        stamp = self._tail(name, number, text[gaps[last] + 1 : end].split())
        self._queue(layout, Pending(number, head + 1, stamp))

    def _queue(self, layout: Layout, pending: Pending) -> None:
        scans = self._scans.get(layout) or self._scans.setdefault(layout, _Scans())
        if scans.seen % self._every_nth == 0:
            scans.pending.append(pending)
        scans.seen += 1

    def _layout(self, name: bytes, head: bytes) -> Layout:
        layout = self._layouts.get(head) or parse_head(name, head.split())
        if len(self._layouts) < _LAYOUTS_KEPT:
            self._layouts[head] = layout
        return layout

    def _tail(self, name: bytes, number: int, tail: list[bytes]) -> float:
        """Read what follows the readings; remember the poses, return the stamp."""
        poses, stamp = split_tail(name, tail, self.ipc_left_out)
        if name != b"RAWLASER1":
            self._poses.extend((stamp, *numbers(tail[poses : poses + 6], name.decode(), 6)))
            self._pose_lines.append(number)
        return stamp

    def decode(self) -> Iterator[tuple[int, ValueError]]:
        """Decode the readings of the block; yield (line number, error) of lines whose readings are broken."""
        for layout, scans in self._scans.items():
            if scans.pending:
                pending, scans.pending = scans.pending, []
                values, errors = self._block.decode_rows(layout.beams, pending)
                keep = np.array([e is None for e in errors])
                if keep.any():
                    scans.ranges.frombytes(np.ascontiguousarray(values if keep.all() else values[keep]).data.cast("B"))
                sound = [p for p, error in zip(pending, errors, strict=True) if error is None]
                scans.stamps.extend(p.stamp for p in sound)
                scans.numbers.extend(p.number for p in sound)
                yield from ((p.number, e) for p, e in zip(pending, errors, strict=True) if e is not None)

    def robot_poses(self) -> tuple[Floats, Ints]:
        """Return stamp and pose of the robot (k, 4) of every message that gives them, and its line (k,)."""
        return np.array(self._poses).reshape(-1, 7)[:, [0, 4, 5, 6]], np.array(self._pose_lines, dtype=np.intp)

    def poses_are_the_robots(self, T_base_laser: Floats | None) -> bool:
        """Return whether the messages are FLASER, whose poses of laser and robot are the same."""
        return self._kind == b"FLASER" and T_base_laser is not None and not T_base_laser.any()

    def finish(
        self, params: Params, skipped: dict[str, int], warnings: list[str], set_back: dict[str, float], clock: LineClock
    ) -> tuple[LaserScans | None, Floats | None]:
        """Return the scans in the geometry of most of them, sorted by time, and T_base_laser where the messages give it."""
        for name, count in self._counts.items():
            if count and name != self._kind:
                skipped[name.decode()] = count
        kept = max(self._scans, key=lambda layout: self._scans[layout].seen, default=None)
        if kept is None or not len(self._scans[kept].stamps):
            return None, None
        self._between = {layout for layout in self._scans if self._lies_between(layout, params)}
        what, geometry = self._kind.decode(), self._geometry(kept, params)
        range_min = params.get("laser_range_min")
        range_min = DEFAULT_RANGE_MIN if range_min is None else range_min
        range_max = self._reach(kept, params)
        stamps, ranges, lines = self._merged(kept, params, range_min, skipped, warnings)
        as_written = np.argsort(lines)
        stamps[as_written] = clock.sound(lines[as_written], stamps[as_written], what, warnings)
        order = as_written[time_order(stamps[as_written], what, warnings, set_back)]
        time_increment = params.get("laser_time_increment")
        if time_increment is None:
            time_increment = _sweep_of_urg(geometry, range_max, stamps[order], self._every_nth)
        if np.any(np.diff(order) != 1):
            ranges = ranges[order]
        angles = geometry.angle_min, geometry.angle_increment
        laser = LaserScans(stamps[order], ranges, *angles, time_increment, range_min, range_max)
        return laser, self._mounting(what, warnings)

    def _geometry(self, layout: Layout, params: Params) -> ScanGeometry:
        """Return where the beams of messages of a layout point."""
        if self._kind != b"FLASER":
            return ScanGeometry(layout.angle_min, layout.angle_increment, layout.beams)
        first, step = params.guess_scanner(layout.beams)
        return ScanGeometry(first + (0.5 * step if layout in self._between else 0.0), step, layout.beams)

    def _lies_between(self, layout: Layout, params: Params) -> bool:
        """Return whether the beams of a layout lie between those of another one, as of a SICK that interlaces."""
        longer = Layout(layout.beams + 1)
        if self._kind != b"FLASER" or longer not in self._scans:
            return False
        reach = self._reach(layout, params)
        seen, lines = [], []
        for each in (longer, layout):
            readings = np.array(self._scans[each].ranges).reshape(-1, each.beams)
            with np.errstate(invalid="ignore"):
                seen.append(np.where((readings > 0.0) & (readings < reach), readings, np.nan))
            lines.append(np.array(self._scans[each].numbers, dtype=np.intp))
        return beams_lie_between(seen[0], seen[1], (lines[0], lines[1]))

    def _reach(self, layout: Layout, params: Params) -> float:
        """Return the range, m, from which a reading saw nothing; PARAM robot_front_laser_max where the message gives none."""
        stated = params.get("robot_front_laser_max", "laser_front_laser_max_range")
        return layout.range_max or stated or DEFAULT_REACH

    def _merged(
        self, kept: Layout, params: Params, range_min: float, skipped: dict[str, int], warnings: list[str]
    ) -> tuple[Floats, NDArray[np.float32], Ints]:
        """Return stamps (k,), cleaned readings (k, b) and lines (k,) of all scans of the lidar, in one layout's geometry."""
        what, want = self._kind.decode(), self._geometry(kept, params)
        stamps, lines, parts, thinned, others, resized = [], [], [], 0, 0, 0
        for layout in sorted(self._scans, key=lambda layout: layout != kept):
            scans, have = self._scans.pop(layout), self._geometry(layout, params)
            if not want.is_of_one_lidar_with(have):
                others += scans.seen
                continue
            thinned += scans.seen - len(scans.stamps)
            cleaned = np.frombuffer(scans.ranges, dtype=np.float32).reshape(-1, layout.beams)
            clean(cleaned, range_min, self._reach(layout, params))
            if have != want:
                resized += len(cleaned)
                cleaned = resampled(cleaned, have, want)
            stamps.append(np.array(scans.stamps))
            lines.append(np.array(scans.numbers))
            parts.append(cleaned)
        if others:
            skipped[f"{what} of another geometry"] = others
            warnings.append(f"{others} {what} messages have another geometry than the commonest and are not used")
        if resized:
            warnings.append(resampling_warning(resized, sum(map(len, stamps)), kept.beams))
        if thinned and self._every_nth > 1:
            skipped[f"{what} thinned out"] = thinned
        ranges = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return np.concatenate(stamps), ranges, np.concatenate(lines)

    def _mounting(self, what: str, warnings: list[str]) -> Floats | None:
        rows = np.array(self._poses).reshape(-1, 7)
        if len(rows) == 0:
            return None
        T = se2.between(rows[:, 4:7], rows[:, 1:4])
        T[:, 2] = T[0, 2] + se2.wrap_angle(T[:, 2] - T[0, 2])
        middle = np.median(T, axis=0)
        middle[2] = se2.wrap_angle(middle[2])
        off = np.abs(T - np.median(T, axis=0)).max(axis=1) > POSE_TOLERANCE
        if what == "FLASER" and (off.mean() > 0.1 or np.hypot(middle[0], middle[1]) > 2.0):
            warnings.append(
                "FLASER: laser and odometry poses do not fit together (a corrected log?); the laser's place on the robot "
                "is unknown, taken from PARAM robot_frontlaser_offset or as the robot's middle"
            )
            return None
        if off.any():
            warnings.append(
                f"the laser's pose on the robot varies in {off.sum()} of {len(off)} {what} messages; the median is used"
            )
        # The poses are written to the micrometre; more digits would be noise.
        return np.round(middle, 6)


def _sweep_of_urg(geometry: ScanGeometry, range_max: float, stamps: Floats, every_nth: int) -> float:
    """Return the time between rays, s: that of a URG-04LX (240 degrees, 5.6 m) where it looks like one, else 0."""
    beams = geometry.beams
    fov = math.degrees(abs(geometry.angle_increment) * (beams - 1))
    if not (238.0 < fov < 242.0 and 680 <= beams <= 684 and range_max < 6.0 and len(stamps) > 1):
        return 0.0
    period = float(np.median(np.diff(stamps))) / every_nth
    return _URG_PERIOD / 1024 if period > 0.9 * _URG_PERIOD else 0.0
