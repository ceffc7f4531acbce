"""A CARMEN log as it is being written: the measurements of each piece of text, in the order of their times."""

from typing import Any, NamedTuple

import numpy as np

from ..arrays import Floats
from ..sensor_log import SensorMounting
from .carmen import LogReader
from .carmen_stamps import AS_WRITTEN
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
        """Take a piece of text and return the measurements of its whole lines, sorted by time."""
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
        self._reader, self.broken = reader, self.broken + reader.broken
        poses, turns = np.array(reader.odometry).reshape(-1, 5)[:, :4], np.array(reader.gyro).reshape(-1, 3)[:, :2].tolist()
        found = [Measured("odometry", float(row[0]), float(row[0]), row[1:]) for row in poses]
        found += [*self._ranges(reader), *self._scans(reader), *(Measured("gyro", t, t, heading) for t, heading in turns)]
        return sorted(found, key=lambda measured: measured.order)

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
        sweep = scans.time_increment * (scans.ranges.shape[1] - 1)
        return [Measured("lidar", t, t + sweep, scans.rows(slice(k, k + 1))) for k, t in enumerate(scans.stamps.tolist())]
