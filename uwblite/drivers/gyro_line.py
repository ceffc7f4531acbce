"""A gyro or IMU that prints lines: its yaw rate, or its yaw. Sans-I/O; the lines are read as those of a base."""

import math
from typing import Any

from ..errors import ConfigError
from .clock import DeviceClock
from .events import Action, Corrupt, GyroHeading, Lost
from .odometry_line import LineFormat, OdometryLineProtocol, Sample
from .session import Driver, Identity, Script, Wait

MAX_STEP = 0.25
"""s between two readings over which a rate is not integrated: what the robot did meanwhile is not known."""


def gyro_format(columns: str, time_unit: float, angle_unit: float, prefix: str) -> LineFormat:
    """Build the form of a gyro's lines.

    Parameters
    ----------
    columns : names of ``t``, ``turn_rate``, ``theta``, ``-``, with one of turn_rate and theta.
    time_unit : s per unit of t. angle_unit : rad per unit of theta, rad/s per unit of turn_rate; below 0 = clockwise.
    prefix : what the lines begin with.

    Raises
    ------
    ConfigError : other columns, or neither rate nor heading.
    """
    names = tuple(name.strip() for name in columns.split(","))
    used = [name for name in names if name != "-"]
    if not set(used) <= {"t", "turn_rate", "theta"} or len(set(used)) < len(used) or not {"turn_rate", "theta"} & set(used):
        raise ConfigError(f"gyro line: columns {columns!r} must hold turn_rate or theta, and may hold t and - to skip")
    return LineFormat(names, time_unit, 1.0, angle_unit, prefix=prefix)


class GyroLineDriver(Driver):
    """A gyro that prints lines. Nothing is ever sent.

    A heading that the gyro tells is taken; a rate is integrated with the trapezoidal rule. Where readings are missing
    the heading is held: the mapper sees the gap by the stamps.

    Parameters
    ----------
    line_format : columns and units. baud : bit/s.
    """

    def __init__(self, line_format: LineFormat, baud: int = 115200) -> None:
        super().__init__()
        self.baud, self._format = baud, line_format
        self._protocol = OdometryLineProtocol(line_format)
        self._clock = DeviceClock(line_format.time_unit, proven=False)
        self._heading = 0.0
        self._last: tuple[float, float] | None = None

    def begin(self) -> None:
        """Forget half a line."""
        self._protocol = OdometryLineProtocol(self._format)
        self._last = None

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return Sample and Corrupt."""
        return self._protocol.feed(data, now)

    def script(self) -> Script[None]:
        """Pass over the first line, of which the port may have shown only the end; then listen."""
        yield Wait(None)
        yield from super().script()

    def take(self, event: Sample) -> list[Action]:
        """Turn a line into a heading."""
        self.ready = True
        values, stamp, elapsed = dict(event.values), event.stamp, None
        actions: list[Action] = []
        if "t" in values:
            reading = self._clock.read(values["t"], stamp)
            if reading.elapsed == 0:
                return [Corrupt(b"", "line sent twice")]
            stamp, elapsed = reading.stamp, reading.elapsed
            if reading.missing:
                actions.append(Lost(stamp, reading.missing))
        rate = values.get("turn_rate", 0.0) * self._format.angle_unit
        if "theta" in values:
            said = values["theta"] * self._format.angle_unit
            self._heading += math.remainder(said - self._heading, 2 * math.pi)
        elif self._last is not None:
            step = stamp - self._last[0] if elapsed is None else elapsed
            if 0.0 < step <= MAX_STEP:
                self._heading += 0.5 * (rate + self._last[1]) * step
        self._last = stamp, rate
        return [*actions, GyroHeading(stamp, self._heading, rate)]

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity("gyro that prints lines")
