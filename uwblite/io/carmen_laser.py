"""The laser messages of a CARMEN log, read line by line or, where they are written alike, a whole block of lines at a time."""

import math
from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints
from ..sensor_log import LaserScans
from .carmen_stamps import LineClock, time_order
from .carmen_words import (
    HEAD,
    RANK,
    BrokenLine,
    Layout,
    Params,
    columns_of,
    kinds_of,
    numbers,
    parse_head,
    places_behind,
    sound_columns,
    stamp_of,
)
from .readings import DEFAULT_REACH, ScanGeometry, beams_lie_between, clean, resampled, resampling_warning

DEFAULT_RANGE_MIN = 0.02
"""m; smaller readings of a scanner are error codes (URG-04LX: 0..19 mm). PARAM laser_range_min has priority."""
POSE_TOLERANCE = 0.01
"""m or rad; a laser whose pose on the robot varies more than this is reported."""

_LAYOUTS_KEPT = 1000
_URG_PERIOD = 0.1
"""s; time of one turn of a URG-04LX."""


def decode_equal_widths(text: bytes, count: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Decode rows of numbers that all have the same width, ``0.123 4.567 8.900``, by columns of digits: five times as fast.

    Parameters
    ----------
    text : the rows, one behind the other; one blank stands between numbers and behind the last.
    count : numbers in a row. width : characters of each number.

    Returns
    -------
    The numbers (k, count), and whether every number of the row has the form of the first of all (k,); the values of other rows
    mean nothing.
    """
    dot = text.find(b".", 0, width)
    decimals = width - 1 - dot
    if not (dot >= 1 and 1 <= decimals <= 6 and width <= 9):
        rows = len(text) // (count * (width + 1))
        return np.zeros((rows, count), dtype=np.float32), np.zeros(rows, dtype=bool)
    form = np.full(width + 1, ord("0"), dtype=np.uint8)
    form[[dot, width]] = ord("."), ord(" ")
    most = np.full(width + 1, 9, dtype=np.uint8)
    most[[dot, width]] = 0
    digits = np.frombuffer(text, dtype=np.uint8).reshape(-1, count * (width + 1)) - np.tile(form, count)
    plain = np.all(digits <= np.tile(most, count), axis=1)
    digits = digits.reshape(-1, count, width + 1)
    # Four digits fit into 16 bits, and seven exactly into a float of single precision, whose quotient is then the nearest one.
    total = np.zeros(digits.shape[:2], dtype=np.uint16 if width <= 5 else np.uint32)
    for column in (c for c in range(width) if c != dot):
        total *= 10
        total += digits[:, :, column]
    quotient = np.divide(total, 10.0**decimals, dtype=np.float32 if width <= 8 else np.float64)
    return quotient.astype(np.float32, copy=False), plain


@dataclass(slots=True, eq=False)
class _Scans:
    """All scans of one layout."""

    ranges: "array[float]" = field(default_factory=lambda: array("f"))
    """Readings of all scans, one behind the other."""
    stamps: "array[float]" = field(default_factory=lambda: array("d"))
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    """Line of each scan: layouts take turns in one log."""
    seen: int = 0


class LaserMessages:
    """Collects the scans of one log: `take` its lines, one by one or together, `finish` the log."""

    def __init__(self, every_nth_scan: int, message: str = "") -> None:
        self.kinds = kinds_of(message)
        """Names of the messages that are read -> their kind."""
        self.ipc_left_out = False
        """Whether the log leaves out ipc_timestamp; decides where a line alone does not."""
        self._every_nth = every_nth_scan
        self._kind = b""
        self._counts = dict.fromkeys(RANK, 0)
        self._layouts: dict[bytes, Layout] = {}
        self._head = b""
        """Of the last message, up to its first reading."""
        self._scans: dict[Layout, _Scans] = {}
        self._between = set[Layout]()
        """Layouts whose beams lie between those of another one."""
        self._poses = array("d")
        """stamp, laser pose (3), robot pose (3) of every message that gives them."""
        self._pose_lines = array("q")

    def take(self, name: bytes, number: int, words: list[bytes]) -> None:
        """Take the words of line `number` as a message of kind `name`."""
        self._counts[name] += 1
        if name != self._kind:
            if self._kind and RANK[name] < RANK[self._kind]:
                return
            self._kind = name
            self._scans, self._poses, self._pose_lines, self._layouts = {}, array("d"), array("q"), {}
        what, first = name.decode(), HEAD[name]
        if len(words) < first:
            raise BrokenLine(f"{what} has {len(words)} fields, far too few")
        layout = self._layout(name, words[:first])
        last = first + layout.beams
        if len(words) <= last:
            raise BrokenLine(f"{what} announces {layout.beams} readings but the line is too short for them")
        tail = words[last:]
        poses, place = places_behind(name, tail, self.ipc_left_out)
        stamp = stamp_of(tail[place])
        if name != b"RAWLASER1":
            self._poses.extend((stamp, *numbers(tail[poses : poses + 6], what, 6)))
            self._pose_lines.append(number)
        scans = self._scans.setdefault(layout, _Scans())
        scans.seen += 1
        if (scans.seen - 1) % self._every_nth == 0:
            readings = np.clip(np.array(words[first:last], dtype=np.float64), -1.0, 1e30)
            scans.ranges.frombytes(readings.astype(np.float32).tobytes())
            scans.stamps.append(stamp)
            scans.numbers.append(number)

    def _layout(self, name: bytes, words: list[bytes]) -> Layout:
        self._head = b" ".join(words) + b" "
        layout = self._layouts.get(self._head) or parse_head(name, words)
        if len(self._layouts) < _LAYOUTS_KEPT:
            self._layouts[self._head] = layout
        return layout

    def take_alike(self, name: bytes, lines: list[bytes], line_numbers: Ints) -> bool:
        """Take messages of kind `name` that all begin as the last one did, with readings of one width, or none; say whether."""
        layout, head = self._layouts.get(self._head), len(self._head)
        if name != self._kind or layout is None or not all(line.startswith(self._head) for line in lines):
            return False
        width = lines[0].find(b" ", head) - head
        if width < 1:
            return False
        end = head + layout.beams * (width + 1)
        tails = columns_of([line[end:] for line in lines], len(lines[0][end:].split()))
        if not tails or (name != b"FLASER" and len(set(tails[0])) > 1):
            return False
        try:
            poses, place = places_behind(name, [column[0] for column in tails], self.ipc_left_out)
        except BrokenLine:
            return False
        values = sound_columns(tails[place], tails[poses : poses + 6] if name != b"RAWLASER1" else ())
        scans = self._scans.setdefault(layout, _Scans())
        used = slice(-scans.seen % self._every_nth, None, self._every_nth)
        # Scans that are not used as well: only a line of this form has its stamp there.
        ranges, plain = decode_equal_widths(b"".join([line[head:end] for line in lines]), layout.beams, width)
        if values is None or not plain.all():
            return False
        if name != b"RAWLASER1":
            self._poses.frombytes(values.tobytes())
            self._pose_lines.extend(line_numbers.tolist())
        self._counts[name] += len(lines)
        scans.seen += len(lines)
        scans.ranges.frombytes(ranges[used].tobytes())
        scans.stamps.frombytes(values[used, 0].tobytes())
        scans.numbers.extend(line_numbers[used].tolist())
        return True

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
