"""A gyro or IMU that prints lines: its yaw rate, or its yaw. Sans-I/O; the lines are read as those of a base."""

import math

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .events import Action, Corrupt, GyroHeading
from .odometry_line import LEAP_TURN, LEAST_STEP, LineFormat, values_by
from .text_lines import Line, LineDriver, LineProtocol

MAX_STEP = 0.25
"""s between two readings over which a rate is not integrated: what the robot did meanwhile is not known."""
LEAP_RATE, LEAP_ACCELERATION = 1.0, 50.0
"""rad/s by which two readings may differ by vibration, and rad/s^2 that no robot reaches: more is a damaged digit."""


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


class GyroLineDriver(LineDriver):
    """A gyro that prints lines. Nothing is ever sent.

    A heading that the gyro sends is taken; a rate is integrated with the trapezoidal rule. Where readings are missing
    the heading stays: the mapper sees the gap by the stamps.

    Parameters
    ----------
    line_format : columns and units. baud : bit/s.
    """

    def __init__(self, line_format: LineFormat, baud: int = 115200) -> None:
        unit = line_format.time_unit
        clock = DeviceClock(unit, proven=False)
        super().__init__(LineProtocol(values_by(line_format)), "gyro that prints lines", baud, clock, unit)
        self._angle_unit, self._heading = line_format.angle_unit, 0.0
        self._last: tuple[float, float] | None = None

    def begin(self) -> None:
        """Discard half a line, and the motion of the gyro meanwhile."""
        super().begin()
        self._last = None

    def time_of(self, content: dict[str, float]) -> float | None:
        """Return the gyro's time in a line, its own unit; None = there is none."""
        return content.get("t")

    def follows(self, before: Line, after: Line) -> bool:
        """Return whether a robot can have turned so meanwhile."""
        step = {name: (after.content[name] - before.content[name]) * self._angle_unit for name in after.content}
        seconds = max(after.stamp - before.stamp, 0.0)
        rate, turn = step.get("turn_rate", 0.0), math.remainder(step.get("theta", 0.0), 2 * math.pi)
        smooth = abs(rate) <= LEAP_RATE + LEAP_ACCELERATION * seconds and abs(turn) <= LEAP_TURN * max(seconds, LEAST_STEP)
        return smooth and super().follows(before, after)

    def measured(self, line: Line) -> list[Action]:
        """Turn a line into a heading."""
        self.ready, values = True, line.content
        stamp, elapsed, actions = self.timed(line)
        if elapsed == 0:
            return [Corrupt(b"", "line sent twice")]
        rate = values.get("turn_rate", 0.0) * self._angle_unit
        if "theta" in values:
            self._heading += math.remainder(values["theta"] * self._angle_unit - self._heading, 2 * math.pi)
        elif self._last is not None:
            step = stamp - self._last[0] if elapsed is None else elapsed
            if 0.0 < step <= MAX_STEP:
                self._heading += 0.5 * (rate + self._last[1]) * step
        self._last = stamp, rate
        return [*actions, GyroHeading(stamp, self._heading, rate)]
