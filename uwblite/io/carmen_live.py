"""A CARMEN log as it is being written: its measurements in the order of their times, and how often each sensor reports.

Whole lines only are read: the line that is being written now is left for the next time.
"""

import os
from array import array
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..errors import FormatError
from ..sensor_log import SensorMounting
from .carmen import LogReader
from .carmen_stamps import AS_WRITTEN
from .log_parts import GrowingFile
from .source import MAX_LINE_BYTES


class Measured(NamedTuple):
    """One measurement."""

    sensor: str
    """'odometry', 'uwb', 'lidar' or 'gyro'."""
    stamp: float
    """s, of a scan that of its first ray."""
    order: float
    """s; when it is complete."""
    value: Any
    """Pose of the base (3,), m, m, rad, in the drifting frame; range, m; one scan as LaserScans of one row; or heading of the
    gyro, rad, from any zero, its bias in it."""
    anchor_id: str = ""
    tag: int = 0
    """Of a range: which of the robot's tags."""


class LiveReader:
    """Turn pieces of a log into measurements; broken lines are counted and skipped."""

    def __init__(self) -> None:
        self._rest = b""
        self._reader = LogReader("live log", 1, 1.0)
        self._T_base_laser: Floats | None = None
        self.broken = 0
        """Lines that could not be used."""

    @property
    def mounting(self) -> SensorMounting:
        """Mounting of the sensors, as far as the log has given it."""
        return self._reader.params.mounting(self._T_base_laser, self._reader.tags)

    def feed(self, data: bytes) -> list[Measured]:
        """Take a piece of text and return the measurements of its whole lines, sorted by time as far as a clock goes on."""
        text = self._rest + data
        cut = text.rfind(b"\n") + 1
        self._rest = text[cut:]
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest, self.broken = b"", self.broken + 1
        return self._taken(text[:cut]) if cut else []

    def _taken(self, lines: bytes) -> list[Measured]:
        before = self._reader
        reader = LogReader("live log", 1, 1.0)
        reader.params, reader.tags, reader.has_ipc = before.params, before.tags, before.has_ipc
        reader.handlers[b"PARAM"] = reader.params.take
        reader.laser.ipc_left_out = before.laser.ipc_left_out
        reader.feed(lines)
        poses, turns = np.array(reader.odometry).reshape(-1, 5), np.array(reader.gyro).reshape(-1, 3)[:, :2].tolist()
        set_back = poses[1:, 4][np.diff(poses[:, 0]) < 0.0].astype(int) - 1
        if len(set_back):
            rows = lines.split(b"\n")[:-1]
            parts = pairwise([0, *set_back.tolist(), len(rows)])
            return [measured for a, b in parts for measured in self._taken(b"\n".join(rows[a:b]) + b"\n")]
        self._reader, self.broken = reader, self.broken + reader.broken
        measurements = [Measured("odometry", float(row[0]), float(row[0]), row[1:4]) for row in poses]
        measurements += [*self._ranges(reader), *self._scans(reader)]
        measurements += (Measured("gyro", t, t, heading) for t, heading in turns)
        return sorted(measurements, key=lambda measured: measured.order)

    def _ranges(self, reader: LogReader) -> list[Measured]:
        names = {number: name.decode() for name, number in reader.uwb_ids.items()}
        rows = np.array(reader.uwb).reshape(-1, 6)[:, :5].tolist()
        reader.tags = max([reader.tags, *(int(row[4]) + 1 for row in rows)])
        return [Measured("uwb", t, t, metres, names[int(anchor)], int(tag)) for t, anchor, metres, _, tag in rows]

    def _scans(self, reader: LogReader) -> list[Measured]:
        scans, mounted = reader.laser.finish(reader.params, {}, [], {}, AS_WRITTEN)
        if scans is None:
            return []
        if self._T_base_laser is None:
            self._T_base_laser = mounted
        sweep = scans.duration
        return [Measured("lidar", t, t + sweep, scans.rows(slice(k, k + 1))) for k, t in enumerate(scans.stamps.tolist())]


WINDOW = 10.0
"""s over which rates are taken."""
_MOST_STAMPS = 2000
"""Of a sensor within the window."""
_ODOMETRY_STEP = 0.2
"""s between the poses that are kept."""
_MOST_POSES = 100_000
"""Kept of the odometry: more than five hours."""
_MOST_ANCHORS = 1000


@dataclass(slots=True)
class Sensor:
    """What came of a sensor."""

    count: int = 0
    last: float = float("-inf")
    """s, latest stamp."""
    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_STAMPS))
    """s, the latest of them."""

    def received(self, stamp: float) -> None:
        """Take a message."""
        self.count += 1
        self.last = max(self.last, stamp)
        self.stamps.append(stamp)

    def rate(self, now: float) -> float:
        """Return messages per second over the window before a time of the log."""
        recent = sum(stamp > now - WINDOW for stamp in self.stamps)
        span = min(WINDOW, max(now - self.stamps[0], 1.0)) if self.stamps else WINDOW
        return recent / span


class LogTail:
    """A log that is being written.

    Parameters
    ----------
    path : its first part, which need not be there yet.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.restarts = 0
        """How often the log began again: it was replaced, or became shorter."""
        self._file: GrowingFile | None = None
        self._begin()

    def _begin(self) -> None:
        self.sensors: dict[str, Sensor] = {}
        self.anchors: dict[str, Sensor] = {}
        self.bytes = self.broken = 0
        self.first, self.last = float("inf"), float("-inf")
        self._odometry = array("d")
        self._latest: tuple[float, ...] = ()
        self._reader = LiveReader()

    @property
    def seconds(self) -> float:
        """Time from the first stamp to the last, s."""
        return max(self.last - self.first, 0.0)

    @property
    def is_file(self) -> bool:
        """Whether its path is a file or nothing, and no pipe, device or folder, which cannot be followed."""
        return os.path.isfile(self.path) or not os.path.exists(self.path)

    def odometry(self) -> tuple[Floats, Floats]:
        """Return stamps (n,), s, and poses (n, 3), m, m, rad, of the wheels, a few a second and the latest."""
        newer = self._latest if self._latest and self._latest[0] > self._odometry[-4] else ()
        table = np.array([*self._odometry, *newer]).reshape(-1, 4)
        return table[:, 0], table[:, 1:]

    def poll(self) -> bool:
        """Read what is new, up to a bound; return whether there was anything.

        A file that cannot be read now is as one that has not grown.
        """
        try:
            data = self._read()
        except (OSError, FormatError):
            return False
        self._take(data)
        return bool(data)

    def _read(self) -> bytes:
        if self._file is None:
            if not os.path.isfile(self.path):
                return b""
            self._file = GrowingFile(self.path, whole=True)
        before, data = self._file.restarts, self._file.read()
        if self._file.restarts > before:
            self.restarts += 1
            self._begin()
        return data

    def _take(self, data: bytes) -> None:
        self.bytes += len(data)
        for measured in self._reader.feed(data):
            stamp, name = measured.stamp, "radio" if measured.sensor == "uwb" else measured.sensor
            self.first, self.last = min(self.first, stamp), max(self.last, stamp)
            self.sensors.setdefault(name, Sensor()).received(stamp)
            if name == "odometry":
                self._pose(stamp, measured.value.tolist())
            elif measured.anchor_id in self.anchors or (measured.anchor_id and len(self.anchors) < _MOST_ANCHORS):
                self.anchors.setdefault(measured.anchor_id, Sensor()).received(stamp)
        self.broken = self._reader.broken

    def _pose(self, stamp: float, pose: list[float]) -> None:
        kept, self._latest = self._odometry, (stamp, *pose)
        if len(kept) < 4 * _MOST_POSES and (not kept or stamp >= kept[-4] + _ODOMETRY_STEP):
            kept.extend((stamp, *pose))
