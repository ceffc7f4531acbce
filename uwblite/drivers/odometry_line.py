"""Odometry of other bases, and headings of gyros that print lines: one sample a line, columns by configuration. Sans-I/O.

There is no standard for what hobby controllers print, so the columns are given: ``t,x,y,theta`` or ``t,left,right``
(encoder ticks) in any order, ``-`` for a column to skip. A line that does not fit is Corrupt.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .events import Action, Corrupt, GyroHeading, Note, OdometryPose, Pose
from .odometer import WheelOdometer, wrapped
from .text_lines import Line, LineDriver, LineProtocol, columns_of, named_columns

LEAP_SPEED, LEAP_TURN = 3.0, 10.0
"""m/s and rad/s that no base of this kind reaches: a line that asks for more is damaged, or the base restarted."""
LEAST_STEP = 0.1
"""s; over shorter times rounded numbers may seem faster."""
COLUMNS = ("t", "x", "y", "theta", "left", "right", "speed", "turn_rate")


@dataclass(frozen=True, slots=True)
class LineFormat:
    """How to read a line; see `odometry_format` for the text form."""

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


def odometry_format(columns: str = "t,x,y,theta", **units: Any) -> LineFormat:
    """Return the form of a base's lines, from column names parted by commas and other fields of LineFormat.

    Raises
    ------
    ConfigError : columns that make no pose.
    """
    names = named_columns(columns, COLUMNS, "odometry line")
    form = LineFormat(names, **units)
    ticks = {"left", "right"} <= set(names)
    if not ticks and not {"x", "y", "theta"} <= set(names):
        raise ConfigError("odometry line: columns must hold x,y,theta or left,right")
    if ticks and (form.tick <= 0 or (form.wheel_base <= 0 and "theta" not in names)):
        raise ConfigError("odometry line: left,right need tick=<m per tick> and wheel_base=<m>")
    return form


def values_by(line_format: LineFormat) -> Callable[[str], dict[str, float] | str | None]:
    """Return what reads a line as numbers by column, units as printed; a str says why the line is damaged."""
    return partial(columns_of, columns=line_format.columns, prefix=line_format.prefix)


class _ColumnDriver(LineDriver):
    """A device that prints numbers by columns, perhaps its own time among them."""

    def __init__(self, line_format: LineFormat, baud: int, title: str) -> None:
        super().__init__(LineProtocol(values_by(line_format)), title, baud, DeviceClock(line_format.time_unit, proven=False))
        self._format = line_format

    def time_of(self, content: dict[str, float]) -> float | None:
        return content.get("t")


class OdometryLineDriver(_ColumnDriver):
    """A base that prints text lines; where these hold ticks, its pose at the first one is `start`."""

    def __init__(self, line_format: LineFormat, baud: int = 115200, start: Pose = (0.0, 0.0, 0.0)) -> None:
        super().__init__(line_format, baud, "base that prints lines")
        self._odometer = WheelOdometer(line_format.tick, line_format.wheel_base, line_format.tick_modulus, start)

    def follows(self, before: Line, after: Line) -> bool:
        """Return whether a base can have moved so, and its clock have gone on so."""
        if not super().follows(before, after):
            return False
        spec, clock, old, new = self._format, self.clock, before.content, after.content
        seconds = max(after.stamp - before.stamp, LEAST_STEP)
        if "t" in new and clock.proven and clock.rate is None:
            seconds = max((new["t"] - old["t"]) * spec.time_unit, LEAST_STEP)
        step = {name: new[name] - old[name] for name in new}
        ways = [abs(wrapped(step[name], spec.tick_modulus)) * spec.tick for name in ("left", "right") if name in new]
        ways += [abs(step[name] * spec.length_unit) for name in ("x", "y") if name in new]
        turn = abs(math.remainder(step.get("theta", 0.0) * spec.angle_unit, 2 * math.pi))
        return max(ways) <= LEAP_SPEED * seconds and turn <= LEAP_TURN * seconds

    def measured(self, line: Line) -> list[Action]:
        self.ready, values, unit = True, line.content, self._format
        stamp, elapsed, actions = self.timed(line)
        if elapsed == 0:
            return [Corrupt("line sent twice")]
        if self.clock.rate is not None:
            actions += self.say_once(self._wrong_unit(self.clock.rate))
        elif elapsed is None and "t" in values and self._odometer.started:
            actions.append(Note("warning", "odometry-clock", "odometry: its clock leapt; time mapping starts again"))
        theta = values["theta"] * unit.angle_unit if "theta" in values else None
        if "left" in values:
            self._odometer.update(values["left"], values["right"], theta)
        else:
            self._odometer.place(values["x"] * unit.length_unit, values["y"] * unit.length_unit, theta or 0.0)
        speed, rate = values.get("speed", 0.0) * unit.length_unit, values.get("turn_rate", 0.0) * unit.angle_unit
        return [*actions, OdometryPose(stamp, *self._odometer.pose, speed, rate)]

    def _wrong_unit(self, rate: float) -> Note:
        text = "odometry: column t does not count seconds as time_unit states"
        if math.isfinite(rate) and rate > 0:
            text += f", it runs {rate:.4g} times too fast: say time_unit={self._format.time_unit / rate:.1g}"
        return Note("error", "odometry-time-unit", text + "; until then lines are stamped with their arrival")


MAX_STEP = 0.25
"""s between two readings over which a rate is not integrated: what the robot did meanwhile is not known."""
LEAP_RATE, LEAP_ACCELERATION = 1.0, 50.0
"""rad/s by which two readings may differ by vibration, and rad/s^2 that no robot reaches: more is a damaged digit."""


def gyro_format(columns: str, time_unit: float, angle_unit: float, prefix: str) -> LineFormat:
    """Return the form of a gyro's lines; units are s of t, rad of theta and rad/s of turn_rate, below 0 = clockwise.

    Raises
    ------
    ConfigError : other columns than t, turn_rate, theta and -, or neither rate nor heading.
    """
    names = named_columns(columns, ("t", "turn_rate", "theta"), "gyro line")
    if not {"turn_rate", "theta"} & set(names):
        raise ConfigError(f"gyro line: columns {columns!r} must hold turn_rate or theta")
    return LineFormat(names, time_unit, 1.0, angle_unit, prefix=prefix)


class GyroLineDriver(_ColumnDriver):
    """A gyro that prints lines. Nothing is ever sent.

    A heading that the gyro sends is taken; a rate is integrated with the trapezoidal rule. Where readings are missing
    the heading stays: the mapper sees the gap by the stamps.
    """

    def __init__(self, line_format: LineFormat, baud: int = 115200) -> None:
        super().__init__(line_format, baud, "gyro that prints lines")
        self._angle_unit, self._heading = line_format.angle_unit, 0.0
        self._last: tuple[float, float] | None = None

    def begin(self) -> None:
        """Discard half a line, and the motion of the gyro meanwhile."""
        super().begin()
        self._last = None

    def follows(self, before: Line, after: Line) -> bool:
        step = {name: (after.content[name] - before.content[name]) * self._angle_unit for name in after.content}
        seconds = max(after.stamp - before.stamp, 0.0)
        rate, turn = step.get("turn_rate", 0.0), math.remainder(step.get("theta", 0.0), 2 * math.pi)
        smooth = abs(rate) <= LEAP_RATE + LEAP_ACCELERATION * seconds and abs(turn) <= LEAP_TURN * max(seconds, LEAST_STEP)
        return smooth and super().follows(before, after)

    def measured(self, line: Line) -> list[Action]:
        self.ready, values = True, line.content
        stamp, elapsed, actions = self.timed(line)
        if elapsed == 0:
            return [Corrupt("line sent twice")]
        rate = values.get("turn_rate", 0.0) * self._angle_unit
        if "theta" in values:
            self._heading += math.remainder(values["theta"] * self._angle_unit - self._heading, 2 * math.pi)
        elif self._last is not None:
            step = stamp - self._last[0] if elapsed is None else elapsed
            if 0.0 < step <= MAX_STEP:
                self._heading += 0.5 * (rate + self._last[1]) * step
        self._last = stamp, rate
        return [*actions, GyroHeading(stamp, self._heading, rate)]
