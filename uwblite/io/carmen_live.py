"""A CARMEN log as it is being written: the measurements of each piece of text, in the order of their times."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..sensor_log import LaserScans, SensorMounting
from .carmen import LogReader
from .carmen_stamps import AS_WRITTEN


@dataclass(frozen=True, slots=True, eq=False)
class _Measurement:
    """One measurement of any kind."""

    stamp: float
    """s, of a scan that of its first ray."""
    order: float
    """s; when it is complete."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveOdometry(_Measurement):
    """One pose of the base."""

    pose: Floats
    """(3,) m, m, rad; drifting frame."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveRange(_Measurement):
    """One range."""

    anchor_id: str
    range: float
    """m."""
    tag: int
    """Which of the robot's tags."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveScan(_Measurement):
    """One scan."""

    scans: LaserScans
    """The scan and its geometry: one row."""


@dataclass(frozen=True, slots=True, eq=False)
class LiveGyro(_Measurement):
    """One reading of a gyro."""

    heading: float
    """rad; from any zero, its bias in it."""


Measured = LiveOdometry | LiveRange | LiveScan | LiveGyro

_MOST_PENDING = 1 << 20
"""Bytes of a line without an end."""


class LiveReader:
    """Turn pieces of a log into measurements; broken lines are counted and skipped."""

    def __init__(self) -> None:
        self._rest = b""
        self._reader = LogReader("live log", 1, 1.0)
        self._heading: list[tuple[float, float]] = []
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
        if len(self._rest) > _MOST_PENDING:
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
        found: list[Measured] = [LiveOdometry(float(row[0]), float(row[0]), row[1:]) for row in poses]
        found += [*self._ranges(reader), *self._scans(reader), *(LiveGyro(t, t, heading) for t, heading in turns)]
        return sorted(found, key=lambda measured: measured.order)

    def _ranges(self, reader: LogReader) -> list[LiveRange]:
        names = {number: name.decode() for name, number in reader.uwb_ids.items()}
        rows = np.array(reader.uwb).reshape(-1, 6)[:, :5].tolist()
        reader.tags = max([reader.tags, *(int(row[4]) + 1 for row in rows)])
        return [LiveRange(t, t, names[int(anchor)], metres, int(tag)) for t, anchor, metres, _, tag in rows]

    def _scans(self, reader: LogReader) -> list[LiveScan]:
        scans, mounted = reader.laser.finish(reader.params, {}, [], {}, AS_WRITTEN)
        if scans is None:
            return []
        if self._T_base_laser is None:
            self._T_base_laser = mounted
        sweep = scans.time_increment * (scans.ranges.shape[1] - 1)
        return [LiveScan(t, t + sweep, scans.rows(slice(k, k + 1))) for k, t in enumerate(scans.stamps.tolist())]
