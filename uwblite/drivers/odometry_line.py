"""Odometry of other bases: one text line per sample, columns by configuration. Sans-I/O.

There is no standard for what hobby controllers print, so the columns are told: ``t,x,y,theta`` or ``t,left,right``
(encoder ticks) in any order, ``-`` for a column to skip. A line that does not fit is Corrupt.
"""

import math
import re
import sys
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from ..errors import ConfigError
from .clock import DeviceClock
from .events import Action, Corrupt, Lost, Note, OdometryPose, Pose, corrupt
from .framing import LineReader
from .session import Driver, Identity, Script, Wait

_Number = TypeVar("_Number", int, float)

MAX_LINE = 256
LEAP_SPEED, LEAP_TURN = 3.0, 10.0
"""m/s and rad/s that no base of this kind reaches: a line that asks for more is damaged, or the base began anew."""
LEAST_STEP = 0.1
"""s; over shorter times rounded numbers may seem faster."""
LEAP_TIME = 1.0
"""s by which the base's clock may run ahead of the arrivals between two lines."""
COLUMNS = ("t", "x", "y", "theta", "left", "right", "speed", "turn_rate", "-")


@dataclass(frozen=True, slots=True)
class LineFormat:
    """How to read a line; see `parse_format` for the text form."""

    columns: tuple[str, ...] = ("t", "x", "y", "theta")
    """Names from COLUMNS, in the order printed. ``t`` may be missing: then the arrival stamps the sample."""
    time_unit: float = 1.0
    """s per unit of column t (0.001 for milliseconds)."""
    length_unit: float = 1.0
    """m per unit of x and y."""
    angle_unit: float = 1.0
    """rad per unit of theta (0.017453 for degrees)."""
    tick: float = 0.0
    """m of wheel travel per encoder tick; needed with left and right."""
    wheel_base: float = 0.0
    """m between the wheels; needed with left and right, unless theta is printed as well."""
    tick_modulus: int = 0
    """The tick counters wrap at this number; 0 = they do not wrap."""
    prefix: str = ""
    """Text at the start of the lines to read; others are ignored."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One good line."""

    stamp: float
    """s, arrival of its first byte."""
    values: tuple[tuple[str, float], ...]
    """(column, number) in the order printed, units as printed."""


def parse_format(options: dict[str, str]) -> LineFormat:
    """Build a LineFormat from text options.

    Parameters
    ----------
    options : for example ``{"columns": "t,left,right", "tick": "1.2e-4", "wheel_base": "0.23"}``.

    Returns
    -------
    LineFormat

    Raises
    ------
    ConfigError : an unknown name, a bad number, or columns that make no pose.
    """
    values: dict[str, object] = {}
    for name, text in options.items():
        try:
            if name == "columns":
                values[name] = tuple(column.strip() for column in text.split(","))
            elif name == "prefix":
                values[name] = text
            elif name == "tick_modulus":
                values[name] = _sensible(int(text), 0, 1 << 64)
            elif name in ("tick", "wheel_base"):
                values[name] = _sensible(float(text), 0.0)
            elif name == "time_unit":
                values[name] = _sensible(float(text), _TINY)
            elif name in ("length_unit", "angle_unit"):
                # Below 0 for an axis or a heading that counts the other way.
                _sensible(abs(float(text)), _TINY)
                values[name] = float(text)
            else:
                known = "columns, prefix, time_unit, length_unit, angle_unit, tick, wheel_base, tick_modulus"
                raise ConfigError(f"odometry line: unknown option {name!r}; known are {known}")
        except ValueError:
            raise ConfigError(f"odometry line: {name}={text!r} is not a number that makes sense here") from None
    spec = LineFormat(**values)  # type: ignore[arg-type]
    names = [column for column in spec.columns if column != "-"]
    unknown = [column for column in names if column not in COLUMNS]
    if unknown or len(set(names)) < len(names):
        raise ConfigError(f"odometry line: columns {spec.columns} must be different names of {', '.join(COLUMNS)}")
    ticks = {"left", "right"} <= set(names)
    if not ticks and not {"x", "y", "theta"} <= set(names):
        raise ConfigError("odometry line: columns must hold x,y,theta or left,right")
    if ticks and (spec.tick <= 0 or (spec.wheel_base <= 0 and "theta" not in names)):
        raise ConfigError("odometry line: left,right need tick=<m per tick> and wheel_base=<m>")
    return spec


def _sensible(value: _Number, least: float, most: float = sys.float_info.max) -> _Number:
    """Return a number within bounds, else raise ValueError."""
    if not least <= value <= most:
        raise ValueError
    return value


_TINY = 1e-12


class OdometryLineProtocol:
    """Bytes in, Sample and Corrupt out. Holds at most one line of MAX_LINE bytes.

    Parameters
    ----------
    line_format : columns and units.
    """

    def __init__(self, line_format: LineFormat) -> None:
        self._format = line_format
        self._lines = LineReader(MAX_LINE)

    def feed(self, data: bytes, stamp: float) -> list[Sample | Corrupt]:
        """Take bytes that arrived at `stamp` s and return the events they complete, in the order of the bytes."""
        events: list[Sample | Corrupt] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
            elif line.data.strip() and not line.cut:
                events += self._take_line(line.data.strip(), line.marks[0][1])
        return events

    def _take_line(self, line: bytes, stamp: float) -> list[Sample | Corrupt]:
        text = line.decode("ascii", "replace")
        prefix = self._format.prefix
        if prefix:
            at = text.rfind(prefix)
            if at < 0:
                return []
            text = text[at + len(prefix) :]
        fields = re.split(r"[,;\s]+", text.strip(" ,;\t"))
        if len(fields) != len(self._format.columns):
            return [corrupt(line, f"{len(fields)} columns instead of {len(self._format.columns)}")]
        values = []
        for name, field in zip(self._format.columns, fields, strict=True):
            if name == "-":
                continue
            if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", field) or not math.isfinite(float(field)):
                return [corrupt(line, f"column {name} is not a number")]
            values.append((name, float(field)))
        return [Sample(stamp, tuple(values))]


class LineOdometer:
    """Turn Samples into poses.

    Parameters
    ----------
    line_format : columns and units.
    start : pose at the first sample when it is made from ticks; m, m, rad.
    """

    def __init__(self, line_format: LineFormat, start: Pose = (0.0, 0.0, 0.0)) -> None:
        self._format = line_format
        self._x, self._y, self._theta = start
        self._last: dict[str, float] | None = None

    def update(self, sample: Sample) -> OdometryPose:
        """Take one sample; its stamp is the arrival.

        Parameters
        ----------
        sample : from OdometryLineProtocol.

        Returns
        -------
        OdometryPose
        """
        spec, values = self._format, dict(sample.values)
        theta = values["theta"] * spec.angle_unit if "theta" in values else None
        if "left" in values:
            self._from_ticks(values, theta)
        else:
            assert theta is not None
            self._x, self._y = values["x"] * spec.length_unit, values["y"] * spec.length_unit
            self._theta = math.remainder(theta, 2 * math.pi)
        self._last = values
        speed = values.get("speed", 0.0) * spec.length_unit
        return OdometryPose(sample.stamp, self._x, self._y, self._theta, speed, values.get("turn_rate", 0.0) * spec.angle_unit)

    def _from_ticks(self, values: dict[str, float], theta: float | None) -> None:
        spec, last = self._format, self._last
        if last is None:
            self._theta = self._theta if theta is None else theta
            return
        left, right = (_difference(spec, values[name] - last[name]) * spec.tick for name in ("left", "right"))
        turn = (right - left) / spec.wheel_base if theta is None else math.remainder(theta - self._theta, 2 * math.pi)
        middle = self._theta + turn / 2
        self._x += (left + right) / 2 * math.cos(middle)
        self._y += (left + right) / 2 * math.sin(middle)
        self._theta = math.remainder(self._theta + turn, 2 * math.pi)


def _difference(spec: LineFormat, ticks: float) -> float:
    """Return a difference of tick counters that may have wrapped in between."""
    wrap = spec.tick_modulus
    return (ticks + wrap / 2) % wrap - wrap / 2 if wrap else ticks


class LineDriver(Driver):
    """A base that prints text lines.

    Parameters
    ----------
    line_format : columns and units.
    baud : bit/s.
    start : pose at the first line, where the lines hold ticks; m, m, rad.
    """

    def __init__(self, line_format: LineFormat, baud: int = 115200, start: Pose = (0.0, 0.0, 0.0)) -> None:
        super().__init__()
        self.baud = baud
        self._format = line_format
        self._protocol = OdometryLineProtocol(line_format)
        self._odometer = LineOdometer(line_format, start)
        self._clock = DeviceClock(line_format.time_unit, proven=False)
        self._last: Sample | None = None
        self._doubtful: Sample | None = None

    def begin(self) -> None:
        """Forget half a line."""
        self._protocol = OdometryLineProtocol(self._format)
        self._doubtful = None

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return Sample and Corrupt."""
        return self._protocol.feed(data, now)

    def script(self) -> Script[None]:
        """Pass over the first line, of which the port may have shown only the end; then listen."""
        yield Wait(None)
        yield from super().script()

    def take(self, event: Sample) -> list[Action]:
        """Turn a line into a pose. Lines have no sum: one that leaps counts only if the next one goes on from it."""
        self.ready = True
        doubtful, self._doubtful = self._doubtful, None
        if self._last is None or self._follows(self._last, event):
            dropped: list[Action] = [Corrupt(b"", "line that leaps away and back")] if doubtful else []
            return dropped + self._pose(event)
        if doubtful and self._follows(doubtful, event):
            return self._pose(doubtful) + self._pose(event)
        self._doubtful = event
        return [Corrupt(b"", "line that leaps away and back")] if doubtful else []

    def _follows(self, before: Sample, after: Sample) -> bool:
        """Tell whether a base can have moved so, and its clock have gone on so."""
        spec, old, new = self._format, dict(before.values), dict(after.values)
        waited = max(after.stamp - before.stamp, 0.0)
        elapsed = (new["t"] - old["t"]) * spec.time_unit if "t" in new else waited
        if self._clock.proven and self._clock.rate is None and not -1e-9 <= elapsed <= waited + LEAP_TIME:
            return False
        seconds = max(elapsed if self._clock.proven else waited, LEAST_STEP)
        ways = [abs(_difference(spec, new[name] - old[name])) * spec.tick for name in ("left", "right") if name in new]
        ways += [abs(new[name] - old[name]) * abs(spec.length_unit) for name in ("x", "y") if name in new]
        turn = abs(math.remainder((new["theta"] - old["theta"]) * spec.angle_unit, 2 * math.pi)) if "theta" in new else 0.0
        return max(ways) <= LEAP_SPEED * seconds and turn <= LEAP_TURN * seconds

    def _pose(self, event: Sample) -> list[Action]:
        self._last = event
        time = dict(event.values).get("t")
        if time is None:
            return [self._odometer.update(event)]
        reading = self._clock.read(time, event.stamp)
        if reading.elapsed == 0:
            return [Corrupt(b"", "line sent twice")]
        actions: list[Action] = [Lost(reading.stamp, reading.missing)] if reading.missing else []
        if self._clock.rate is not None:
            actions += self.say_once(self._wrong_unit(self._clock.rate))
        elif reading.reset:
            actions.append(Note("warning", "odometry-clock", "odometry: its clock leapt; time mapping starts anew"))
        return [*actions, replace(self._odometer.update(event), stamp=reading.stamp)]

    def _wrong_unit(self, rate: float) -> Note:
        text = "odometry: column t does not count seconds as time_unit says"
        if math.isfinite(rate) and rate > 0:
            text += f", it runs {rate:.4g} times too fast: say time_unit={self._format.time_unit / rate:.1g}"
        return Note("error", "odometry-time-unit", text + "; until then lines are stamped with their arrival")

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity("base that prints lines")
