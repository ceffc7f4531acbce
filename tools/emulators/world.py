"""What emulated sensors measure: a CARMEN log played back, or a built-in room. Times in s since the world's start."""

import gzip
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import count, islice
from pathlib import Path

FIRST_STEP, LAST_STEP, FRONT_STEP, RESOLUTION = 44, 725, 384, 1024
STEPS = LAST_STEP - FIRST_STEP + 1
MAX_MM = 5600


@dataclass(frozen=True)
class Scan:
    """One sweep."""

    time: float
    """s, first ray."""
    values: list[int]
    """mm per step 44..725; 0 = nothing seen, 7 = invalid."""


@dataclass(frozen=True)
class Epoch:
    """One ranging round."""

    time: float
    readings: list[tuple[int, int, int]]
    """(short address, mm, quality) of at most four anchors."""


@dataclass(frozen=True)
class Pose:
    """Odometry of the base."""

    time: float
    x: float
    y: float
    theta: float


class LogWorld:
    """Plays a CARMEN log; each kind of message is read by its own pass over the file, so memory stays small.

    Parameters
    ----------
    path : run.log or run.log.gz.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._looking: Feed | None = None
        first = islice(self._lines("ODOM", "ROBOTLASER1", "UWB"), 50)
        self._zero = min(float(line.split()[-3]) for line in first)

    def _lines(self, *names: str) -> Iterator[str]:
        opener = gzip.open if self._path.suffix == ".gz" else open
        with opener(self._path, "rt", encoding="ascii", errors="replace") as file:
            for line in file:
                if line.startswith(names):
                    yield line

    def scans(self) -> Iterator[Scan]:
        """Yield the scans, resampled to the steps of a URG-04LX."""
        for line in self._lines("ROBOTLASER1 "):
            fields = line.split()
            count = int(fields[8])
            start, step, limit = float(fields[2]), float(fields[4]), float(fields[5])
            yield Scan(float(fields[-3]) - self._zero, _to_steps(fields[9 : 9 + count], start, step, limit))

    def look(self, times: list[float], bearings: list[float]) -> list[int]:
        """Return what the log's laser saw last at world times `times`, mm, at bearings in turns clockwise; 0 = nothing."""
        if self._looking is None:
            self._looking = Feed(self._lines("ROBOTLASER1 "))
            self._view: tuple[float, float, list[str]] = (0.0, 1.0, [])
        while self._looking.head is not None and float(self._looking.head.split()[-3]) - self._zero <= times[-1]:
            fields = self._looking.pop().split()
            self._view = (float(fields[2]), float(fields[4]), fields[9 : 9 + int(fields[8])])
            self._limit = 1000 * float(fields[5])
        start, step, ranges = self._view
        seen = []
        for bearing in bearings:
            index = round((-2 * math.pi * bearing - start) % (2 * math.pi * math.copysign(1, step)) / step)
            mm = round(1000 * float(ranges[index])) if index < len(ranges) else 0
            seen.append(mm if 20 <= mm < self._limit else 0)
        return seen

    def epochs(self) -> Iterator[Epoch]:
        """Yield the ranges, those within 20 ms together, at most four at a time as a DWM1001 has it."""
        time, readings = -1.0, []
        for line in self._lines("UWB "):
            fields = line.split()
            stamp = float(fields[-3]) - self._zero
            reading = (_address(fields[1]), max(0, round(1000 * float(fields[2]))), round(float(fields[3])))
            full = len(readings) == 4 or reading[0] in [r[0] for r in readings]
            if readings and (full or stamp - time > 0.020):
                yield Epoch(time, readings)
                readings = []
            if not readings:
                time = stamp
            readings.append(reading)
        if readings:
            yield Epoch(time, readings)

    def poses(self) -> Iterator[Pose]:
        """Yield the odometry."""
        for line in self._lines("ODOM "):
            fields = line.split()
            yield Pose(float(fields[-3]) - self._zero, *(float(field) for field in fields[1:4]))

    def length(self) -> float:
        """Return the time of the last message, s."""
        return max(float(line.split()[-3]) for line in self._lines("ODOM", "UWB")) - self._zero


def _to_steps(texts: list[str], start: float, step: float, limit: float) -> list[int]:
    """Convert readings in metres at `start` + i `step` rad to mm per step of the URG-04LX."""
    values = []
    for text in texts:
        millimetres = round(1000 * float(text))
        seen = 20 <= millimetres < min(1000 * limit, MAX_MM)
        values.append(millimetres if seen else 0 if millimetres >= 20 else 7)
    turn = 2 * math.pi / RESOLUTION
    if len(values) == STEPS and abs(start - (FIRST_STEP - FRONT_STEP) * turn) < turn / 2 and abs(step - turn) < 1e-6:
        return values
    indices = [round(((FIRST_STEP + i - FRONT_STEP) * turn - start) / step) for i in range(STEPS)]
    return [values[i] if 0 <= i < len(values) else 19 for i in indices]


def _address(name: str) -> int:
    """Return a short address for an anchor's name; names that are not hexadecimal get one made of their letters."""
    try:
        return int(name, 16) & 0xFFFF
    except ValueError:
        return sum((i + 1) * 251 * ord(c) for i, c in enumerate(name)) & 0xFFFF


class RoomWorld:
    """A room of 8 x 6 m with four anchors; the robot drives a circle of 1.5 m radius at 0.2 m/s, for ever."""

    WALLS = (-4.0, -3.0, 4.0, 3.0)
    ANCHORS = ((0xC0DE, -3.9, -2.9), (0x1A2B, 3.9, -2.9), (0x0D05, 3.9, 2.9), (0x9F3C, -3.9, 2.9))
    RADIUS, SPEED = 1.5, 0.2

    def pose(self, time: float) -> Pose:
        """Return where the robot is."""
        angle = max(0.0, time) * self.SPEED / self.RADIUS
        x, y = self.RADIUS * math.sin(angle), -self.RADIUS * math.cos(angle)
        return Pose(time, x, y, math.remainder(angle, 2 * math.pi))

    def scans(self) -> Iterator[Scan]:
        """Yield ten sweeps a second."""
        for k in count():
            yield Scan(0.1 * k, list(_sweep(k)))

    def look(self, times: list[float], bearings: list[float]) -> list[int]:
        """Return what a laser on the base sees at world times `times`, mm, at bearings in turns clockwise."""
        seen, rate = [], self.SPEED / self.RADIUS
        left, bottom, right, top = self.WALLS
        for time, bearing in zip(times, bearings, strict=True):
            theta = max(0.0, time) * rate
            angle = theta - 2 * math.pi * bearing
            cos, sin = math.cos(angle), math.sin(angle)
            along_x = ((right if cos > 0 else left) - self.RADIUS * math.sin(theta)) / cos if cos else math.inf
            along_y = ((top if sin > 0 else bottom) + self.RADIUS * math.cos(theta)) / sin if sin else math.inf
            seen.append(round(1000 * (along_x if along_x < along_y else along_y)))
        return seen

    def epochs(self) -> Iterator[Epoch]:
        """Yield ten rounds a second."""
        k = 0
        while True:
            pose = self.pose(0.1 * k)
            readings = [(a, round(1000 * math.hypot(x - pose.x, y - pose.y)), 100) for a, x, y in self.ANCHORS]
            yield Epoch(0.1 * k + 0.037, readings)
            k += 1

    def poses(self) -> Iterator[Pose]:
        """Yield odometry twenty times a second."""
        k = 0
        while True:
            yield self.pose(0.05 * k)
            k += 1


@lru_cache(1200)
def _sweep(k: int) -> tuple[int, ...]:
    """Return a sweep of the room, mm, 0 = nothing: every emulated lidar sees the same."""
    times = [0.1 * k + 0.1 * i / RESOLUTION for i in range(STEPS)]
    values = RoomWorld().look(times, [(FRONT_STEP - FIRST_STEP - i) / RESOLUTION for i in range(STEPS)])
    return tuple([value if value < MAX_MM else 0 for value in values])


class Feed:
    """An iterator with a look ahead.

    Parameters
    ----------
    items : anything with a `time`, in order of time.
    """

    def __init__(self, items: Iterator) -> None:
        self._items = items
        self.head = next(items, None)

    def pop(self):
        """Return the next item and move on."""
        item, self.head = self.head, next(self._items, None)
        return item


class WorldClock:
    """World time from host time: it stands still at zero until started, then runs at `speed`.

    Parameters
    ----------
    speed : world seconds per host second.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self.origin: float | None = None

    def start(self, now: float) -> None:
        """Let the world run from host time `now`, s."""
        if self.origin is None:
            self.origin = now

    def world(self, now: float) -> float:
        """Return world time at host time `now`; below zero before the start."""
        return -1.0 if self.origin is None else (now - self.origin) * self.speed

    def host(self, time: float) -> float:
        """Return the host time of world time `time`; infinite before the start."""
        return math.inf if self.origin is None else self.origin + time / self.speed
