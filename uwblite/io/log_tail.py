"""A log that grows, followed: how often each sensor reports, which anchors, and where the odometry is.

The reader keeps its place and reads what is new, whole lines only: the line that is being written now is left for the
next time. Parts of a recording are followed in their order. A log that has become shorter, or that another file has taken
the place of, is read from its beginning.
"""

import os
from array import array
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Floats
from ..errors import FormatError
from .carmen_live import LiveReader
from .log_parts import GrowingFile

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
        if self._file is None or self._replaced():
            if not os.path.isfile(self.path):
                return b""
            opened = GrowingFile(self.path, whole=True)
            if self._file is not None:
                self._file.close()
                self._restart()
            self._file, self._first = opened, os.stat(self.path)
        before, data = self._file.restarts, self._file.read()
        if self._file.restarts > before:
            self._restart()
            self._first = os.stat(self.path)
        return data

    def _restart(self) -> None:
        self.restarts += 1
        self._begin()

    def _replaced(self) -> bool:
        """Return whether the first part is another file than before, while a later one is read."""
        if self._file is None or os.fspath(self._file.path) == self.path or not os.path.isfile(self.path):
            return False
        return not os.path.samestat(os.stat(self.path), self._first)

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
