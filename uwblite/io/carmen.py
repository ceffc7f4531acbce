"""CARMEN logs, the text form of a recording: one message a line, metres, radians, seconds; docs/formats.md lists the messages.

``NAME contents ipc_timestamp ipc_hostname logger_timestamp``. UWB and GYRO are uwblite's own; other CARMEN readers skip them.
ROBOTLASER1 exists with and without num_remissions and turn_axis, and some published logs leave out ipc_timestamp.
"""

import hashlib
import os
import re
from array import array
from collections import defaultdict
from collections.abc import Callable

import numpy as np

from ..arrays import Floats, Ints
from ..errors import ConfigError, FormatError
from ..sensor_log import Gyro, LogNotes, Odometry, SensorLog, UwbRanges, fault_of_id, odometry_in_bursts
from .carmen_laser import LaserMessages
from .carmen_stamps import LineClock, judged, time_order
from .carmen_words import (
    BrokenLine,
    Params,
    columns_of,
    is_message_name,
    numbers,
    sound_columns,
    stamp_of,
    why_broken,
)
from .carmen_writer import write_log
from .log_parts import parts_of
from .readings import MOST_TAGS, ranges_of
from .source import OVERLONG_LINE, open_source

__all__ = ["read_log", "write_log"]

BROKEN_LINES_KEPT = 20
"""Broken lines reported one by one; all are counted."""
_UNUSED = frozenset(
    b"SYNC COMMENT TRUEPOS RLASER RAWLASER2 RAWLASER3 RAWLASER4 RAWLASER5 ROBOTLASER2 ROBOTLASER3 ROBOTLASER4 ROBOTLASER5 "
    b"LASER3 LASER4 LASER5 REMISSIONFLASER REMISSIONRLASER POS GPS NMEAGGA NMEARMC NMEA-GGA NMEA-RMC SONAR BUMPER IMU "
    b"VECTORMOVE ROBOTVELOCITY FOLLOWTRAJECTORY BASEVELOCITY SCANMARK PANTILT VISION".split()
)
"""Messages of CARMEN that carry nothing uwblite uses."""
_LIDARS = tuple(f"ROBOTLASER{number}" for number in range(1, 6))
_NAMES_COUNTED = 100
"""Distinct names of foreign messages counted one by one."""
_END_OF_NAME = re.compile(rb"[\x00-\x20]")
_HOPELESS = 20_000
"""Broken lines after which reading stops early when nearly all lines are broken."""


def read_log(
    path: str | os.PathLike[str], *, every_nth_scan: int = 1, max_broken_share: float = 0.05, scan_message: str = ""
) -> SensorLog:
    """Read one CARMEN log, plain or gzip; ``-`` reads standard input.

    A log that was cut into parts by `uwblite record --rotate` is read whole, whichever of its parts is named.

    Parameters
    ----------
    every_nth_scan : keep every n-th laser scan; the others are counted and not kept.
    max_broken_share : share of the messages that may be broken (0..1); each is skipped and counted in the notes.
    scan_message : the messages whose scans are read, for example ROBOTLASER2 of a second lidar; empty = the first lidar's.

    Returns
    -------
    SensorLog with messages sorted by time (equal stamps keep their order) and counts of all oddities in `notes`.

    Raises
    ------
    FormatError : it is no CARMEN log, has no odometry, or too many of its lines are broken.
    ConfigError : there are no scans of the message that was asked for.
    """
    if every_nth_scan < 1:
        raise FormatError(f"every_nth_scan is {every_nth_scan}; it must be 1 or more")
    parts, missing = parts_of(os.fspath(path))
    digest = hashlib.sha256()
    reader = LogReader("stdin" if parts[0] == "-" else ", ".join(parts), every_nth_scan, max_broken_share, scan_message)
    for part in parts:
        with open_source(part, digest) as source:
            for block in source.blocks():
                reader.feed(block)
            source.sha256()
    return reader.finish(digest.hexdigest(), missing)


class LogReader:
    """Collects the messages of one log."""

    def __init__(self, path: str, every_nth_scan: int, max_broken_share: float, scan_message: str = "") -> None:
        self.path, self.max_broken_share, self.scan_message = path, max_broken_share, scan_message
        self.params = Params(int(scan_message[-1]) if scan_message[-1:].isdigit() else 1)
        self.laser = LaserMessages(every_nth_scan, scan_message)
        self.odometry, self.uwb, self.gyro = (array("d") for _ in range(3))
        self.number = self.lines = self.messages = self.broken = 0
        self.tags, self.uwb_ids = 1, dict[bytes, int]()
        self.skipped, self.set_back = dict[str, int](), dict[str, float]()
        self.broken_lines: list[tuple[int, str]] = []
        self.ends_broken = self.has_ipc = False
        self.handlers: dict[bytes, Callable[[list[bytes]], None]] = {
            b"ODOM": self._odom,
            b"UWB": self._uwb,
            **{f"UWB{k}".encode(): self._uwb for k in range(2, MOST_TAGS + 1)},
            b"GYRO": self._gyro,
            b"PARAM": self.params.take,
        }

    def feed(self, block: bytes) -> None:
        """Take a block of whole lines: those that are written as most are by kinds, the others one by one."""
        lines, before = block.split(b"\n")[:-1], self.lines + 1
        self.lines += len(lines)
        broken: list[tuple[int, str]] = []
        for k in self._take_kinds(lines, before):
            line, self.number = lines[k], before + k
            name = line[: _END_OF_NAME.search(line + b"\n").start()]  # type: ignore[union-attr]
            try:
                handler = self.handlers.get(name)
                if handler is not None:
                    handler(line.split())
                elif name in self.laser.kinds:
                    self.laser.take(self.laser.kinds[name], self.number, line.split())
                elif not self._unused(name, line):
                    continue
            except (BrokenLine, ValueError) as error:
                broken.append((self.number, why_broken(error)))
            self.messages += 1
        self._count_broken(broken)

    def _take_kinds(self, lines: list[bytes], before: int) -> list[int]:
        """Take the messages of a kind together where all of a block are sound and written alike; return which lines are left.

        `before` is the number of the first line. Until it is known whether the log has ipc_timestamp, lines come one by one,
        and so do those of a block with tabs behind names.
        """
        kinds = defaultdict[bytes, list[int]](list)
        for k, line in enumerate(lines):
            kinds[line[: line.find(b" ")]].append(k)
        if (not self.has_ipc and any(name in self.handlers for name in kinds)) or any(b"\t" in name for name in kinds):
            return list(range(len(lines)))
        left = list[int]()
        alone = sum(name.startswith(b"UWB") for name in kinds) == 1, sum(name in self.laser.kinds for name in kinds) == 1
        for name, rows in kinds.items():
            own, line_numbers = [lines[k] for k in rows], np.array(rows) + before
            if name == b"ODOM":
                taken = self._take_odometry(own, line_numbers)
            elif name == b"UWB":
                taken = alone[0] and self._take_ranges(own, line_numbers)
            else:
                kind = self.laser.kinds.get(name)
                taken = kind is not None and alone[1] and self.laser.take_alike(kind, own, line_numbers)
            if taken:
                self.messages += len(rows)
            else:
                left += rows
        return sorted(left)

    def _take_odometry(self, lines: list[bytes], numbers: Ints) -> bool:
        words = columns_of(lines, 10)
        values = None if words is None else sound_columns(words[7], words[1:4])
        if values is None:
            return False
        self.odometry.frombytes(np.column_stack([values, numbers]).tobytes())
        return True

    def _take_ranges(self, lines: list[bytes], numbers: Ints) -> bool:
        words = columns_of(lines, 7)
        values = None if words is None else sound_columns(words[4], words[2:4])
        if values is None or words is None or not self.uwb_ids.keys() >= set(words[1]):
            return False
        anchors = [self.uwb_ids[name] for name in words[1]]
        rows = np.column_stack([values[:, 0], anchors, values[:, 1:], np.zeros(len(lines)), numbers])
        self.uwb.frombytes(rows.tobytes())
        return True

    def _unused(self, name: bytes, line: bytes) -> bool:
        """Count a message that is not used; return False for blank lines and comments."""
        if not name:
            name = line.strip().split(maxsplit=1)[0] if line.strip() else b""
            if name and not name.startswith(b"#"):
                raise BrokenLine("begins with a blank")
        if not name or name.startswith(b"#"):
            return False
        if name.startswith(OVERLONG_LINE):
            raise BrokenLine("longer than a megabyte")
        if name not in _UNUSED and not is_message_name(name):
            raise BrokenLine("is no CARMEN message")
        key = name.decode()
        if key not in self.skipped and len(self.skipped) >= _NAMES_COUNTED:
            key = "others"
        self.skipped[key] = self.skipped.get(key, 0) + 1
        return True

    def _odom(self, tokens: list[bytes]) -> None:
        x, y, theta = numbers(tokens[1:4], "ODOM", 3)
        self.odometry.extend((self._stamp(tokens, 7, "ODOM"), x, y, theta, self.number))

    def _uwb(self, tokens: list[bytes]) -> None:
        stamp = self._stamp(tokens, 4, "UWB")
        distance, quality = numbers(tokens[2:4], "UWB", 2)
        anchor = self.uwb_ids.get(tokens[1])
        if anchor is None:
            name = tokens[1].decode()
            if fault := fault_of_id(name):
                raise BrokenLine(f"UWB anchor_id {fault}")
            anchor = self.uwb_ids.setdefault(tokens[1], len(self.uwb_ids))
        self.uwb.extend((stamp, anchor, distance, quality, int(tokens[0][3:] or b"1") - 1, self.number))

    def _gyro(self, tokens: list[bytes]) -> None:
        heading, _ = numbers(tokens[1:3], "GYRO", 2)
        self.gyro.extend((self._stamp(tokens, 3, "GYRO"), heading, self.number))

    def _stamp(self, tokens: list[bytes], fields: int, name: str) -> float:
        """Return ipc_timestamp behind the name and contents (`fields` tokens); logger_timestamp where it is left out."""
        # A log leaves ipc_timestamp out everywhere or nowhere: once it was seen, a short message lacks something else.
        if len(tokens) == fields + 3:
            self.has_ipc, self.laser.ipc_left_out = True, False
        elif len(tokens) == fields + 2 and not self.has_ipc:
            self.laser.ipc_left_out = True
        else:
            raise BrokenLine(f"{name} has {len(tokens)} fields, expected {fields + 3}")
        return stamp_of(tokens[fields if len(tokens) == fields + 3 else fields + 1])

    def _count_broken(self, broken: list[tuple[int, str]]) -> None:
        broken.sort()
        self.broken += len(broken)
        self.broken_lines += broken[: BROKEN_LINES_KEPT - len(self.broken_lines)]
        self.ends_broken = bool(broken) and broken[-1][0] == self.lines
        if self.broken > _HOPELESS and self.broken > max(0.9, self.max_broken_share) * self.messages:
            self._refuse()

    def _refuse(self) -> None:
        (number, why), share = self.broken_lines[0], f"{self.broken} of {self.messages} messages are broken"
        text = f"{share} (allowed: {self.max_broken_share:.0%}); the first: {why}. Is this a CARMEN log?"
        raise FormatError(text, self.path, number)

    def finish(self, sha256: str, missing: str = "") -> SensorLog:
        """Return the collected measurements, sorted by time; `missing` is a missing part of the log."""
        # A recorder that is switched off leaves half a line at the end: that one proves nothing about the rest.
        if self.broken - self.ends_broken > self.max_broken_share * self.messages:
            self._refuse()
        warnings = [f"part {missing} of this recording is not there: put it beside the others"] if missing else []
        odometry, clock = self._finish_odometry(warnings)
        ranges = self._finish_ranges(clock, warnings)
        scans, T_base_laser = self.laser.finish(self.params, self.skipped, warnings, self.set_back, clock)
        gyro = self._finish_gyro(clock, warnings)
        others = {name: self.skipped[name] for name in _LIDARS if name in self.skipped}
        if self.scan_message and scans is None:
            held = f"; it has {', '.join(others)}" if others else ""
            raise ConfigError(f"the log has no scans of {self.scan_message}{held}")
        if scans is not None and others:
            counts = ", ".join(f"{count} of {name}" for name, count in others.items())
            text = f"a map uses one lidar, here {self.scan_message or 'the first'}; scans of others are left out ({counts})"
            warnings.append(f"{text}; `topics.scan={min(others)}` would take those of another")
        notes = LogNotes(
            source=self.path,
            sha256=sha256,
            lines=self.lines,
            broken_lines=tuple(self.broken_lines),
            broken=self.broken,
            skipped=dict(sorted(self.skipped.items())),
            warnings=tuple(warnings),
            set_back=self.set_back,
            one_clock=clock.of_scans,
        )
        mounting = self.params.mounting(T_base_laser, self.tags, self.laser.poses_are_the_robots(T_base_laser))
        return SensorLog(odometry, ranges, scans, mounting, notes, gyro=gyro)

    def _finish_odometry(self, warnings: list[str]) -> tuple[Odometry, LineClock]:
        rows, (laser, laser_lines) = np.array(self.odometry).reshape(-1, 5), self.laser.robot_poses()
        rows, lines = rows[:, :4], rows[:, 4].astype(np.intp)
        if len(rows) == 0:
            rows, lines = laser, laser_lines
            if len(rows) == 0:
                what = "neither ODOM messages nor ROBOTLASER1 with robot poses. Is this a CARMEN log?"
                raise FormatError(f"no odometry in {self.lines} lines: {what}", self.path)
            warnings.append("no ODOM messages: the robot poses of the laser messages serve as odometry")
            laser, laser_lines = laser[:0], laser_lines[:0]
        rows, clock = judged(rows, lines, laser, laser_lines, warnings)
        if not clock.of_scans and len(tied := self._tied(rows)):
            rows = tied
            warnings.append(
                "the stamps of the ODOM messages are times of receipt in bursts: the robot poses of the laser messages, which "
                "are those of their scans, serve as odometry"
            )
        order = time_order(rows[:, 0], "odometry", warnings, self.set_back)
        return Odometry(rows[order, 0], rows[order, 1:]), clock

    def _tied(self, rows: Floats) -> Floats:
        """Return stamp and robot pose (k, 4) of the laser messages where those of ODOM messages (n, 4) have stamps in bursts.

        A corrected log gives poses of another frame: these are farther from the odometry than from each other.
        """
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        odometry = Odometry(rows[:, 0], rows[:, 1:])
        if not odometry_in_bursts(odometry):
            return np.zeros((0, 4))
        tied, _ = self.laser.robot_poses()
        tied = tied[np.argsort(tied[:, 0], kind="stable")]
        off, step = tied[:, 1:3] - odometry.at(tied[:, 0])[:, :2], np.diff(tied[:, 1:3], axis=0)
        one_frame = len(step) > 0 and np.median(np.hypot(*off.T)) <= np.median(np.hypot(*step.T))
        return tied if one_frame else np.zeros((0, 4))

    def _in_order(self, values: "array[float]", columns: int, what: str, clock: LineClock, warnings: list[str]) -> Floats:
        """Return rows whose first column is the stamp and whose last the line, their stamps sound, in the order of time."""
        rows = np.array(values).reshape(-1, columns)
        rows[:, 0] = clock.sound(rows[:, -1].astype(np.intp), rows[:, 0], what, warnings)
        return rows[time_order(rows[:, 0], what, warnings, self.set_back)]

    def _finish_gyro(self, clock: LineClock, warnings: list[str]) -> Gyro | None:
        if not self.gyro:
            return None
        rows = self._in_order(self.gyro, 3, "gyro", clock, warnings)
        return Gyro(rows[:, 0].copy(), np.unwrap(rows[:, 1]))

    def _finish_ranges(self, clock: LineClock, warnings: list[str]) -> UwbRanges | None:
        if not self.uwb:
            return None
        rows = self._in_order(self.uwb, 6, "UWB", clock, warnings)
        anchor, tag = rows[:, [1, 4]].astype(np.intp).T
        self.tags = int(tag.max()) + 1
        silent = [k + 1 for k in np.unique(tag[tag > 0]) if not self.params.gives_tag(k + 1)]
        if silent:
            name = f"uwb{silent[0]}_tag_offset_x"
            warnings.append(f"no PARAM {name} gives where tag {silent[0]} is; the middle of the base is taken")
        names = [name.decode() for name in self.uwb_ids]
        return ranges_of(rows[:, 0], anchor, names, rows[:, 2], rows[:, 3], tag if self.tags > 1 else None)
