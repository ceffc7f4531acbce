"""Two wheels to a pose: encoder counts, with the heading of a gyro where there is one; and what such bases share."""

import math

from .events import Action, Note, Pose
from .session import ByteProtocol, Driver, Identity


def wrapped(difference: float, modulus: int) -> float:
    """Return a difference of counters that wrap at a modulus (0 = they do not)."""
    return (difference + modulus // 2) % modulus - modulus // 2 if modulus else difference


def way_of(ticks: tuple[int, int], modulus: int, tick: float) -> float:
    """Return how far the wheels turned at least, m, by differences of their counters that wrap at a modulus."""
    return max(abs(wrapped(difference, modulus)) for difference in ticks) * tick


class WheelOdometer:
    """Integrate two wheels: each step a chord along the mean of both headings (Borenstein).

    Parameters
    ----------
    tick : m per tick. base : m between the wheels. modulus : the counters wrap there, 0 = they do not.
    start : x, y, theta; m, m, rad.
    """

    def __init__(self, tick: float, base: float, modulus: int, start: Pose) -> None:
        self.pose = start
        self._tick, self._base, self._modulus = tick, base, modulus
        self._last: tuple[float, float, float | None] | None = None

    def update(self, left: float, right: float, heading: float | None = None, *, still: bool = False) -> tuple[float, float]:
        """Take both counters; return travel, m, and turn, rad, since the last time.

        Parameters
        ----------
        heading : rad, of a gyro, from any zero; None = the turn is the wheels'.
        still : what the counters did is unknown: the wheels count as still, a gyro does not.
        """
        last, self._last = self._last, (left, right, heading)
        if last is None:
            return 0.0, 0.0
        a, b = (wrapped(now - then, self._modulus) * self._tick for now, then in ((left, last[0]), (right, last[1])))
        travel, turn = (0.0, 0.0) if still else ((a + b) / 2, (b - a) / self._base if self._base else 0.0)
        if heading is not None and last[2] is not None:
            turn = math.remainder(heading - last[2], 2 * math.pi)
        x, y, theta = self.pose
        middle = theta + turn / 2
        theta = math.remainder(theta + turn, 2 * math.pi)
        self.pose = (x + travel * math.cos(middle), y + travel * math.sin(middle), theta)
        return travel, turn

    @property
    def started(self) -> bool:
        return self._last is not None

    def place(self, x: float, y: float, theta: float) -> None:
        """Take a pose that the base computes itself; m, m, rad."""
        self.pose, self._last = (x, y, math.remainder(theta, 2 * math.pi)), (0.0, 0.0, None)

    def forget(self) -> None:
        """Hold the pose over a gap: what wheels and gyro did meanwhile is unknown."""
        self._last = None


class BaseDriver(Driver):
    """A base with two wheels, switches that show a wheel in the air, and a battery that is low below so many V."""

    def __init__(self, protocol: ByteProtocol, title: str, odometer: WheelOdometer, low: float) -> None:
        super().__init__(protocol, title)
        self._odometer, self._low = odometer, low
        self._voltage: float | None = None
        self._wheel_drop = 0

    def state(self, wheel_drop: int, voltage: float) -> list[Action]:
        """Note wheels in the air (bits) and the battery, V; return what must be reported."""
        lifted, self._wheel_drop, self._voltage = wheel_drop and not self._wheel_drop, wheel_drop, voltage
        text = "odometry: a wheel hangs in the air; travel is not to be trusted"
        return [Note("warning", "wheel-drop", text)] if lifted else []

    def gap(self, what: str) -> Note:
        """Return what to say of a base that sent nothing for a while."""
        return Note("warning", "odometry-gap", f"odometry: the base {what} meanwhile is unknown")

    def identity(self) -> Identity:
        if self._voltage is None:
            return Identity(self.title)
        findings = []
        if self._wheel_drop:
            findings.append(Note("warning", "wheel-drop", "a wheel hangs in the air: travel will be wrong"))
        if 0 < self._voltage < self._low:
            text = f"the battery is low ({self._voltage:.1f} V): charge it before a recording"
            findings.append(Note("warning", "low-battery", text))
        return Identity(self.title, (("battery", f"{self._voltage:.1f} V"),), tuple(findings))
