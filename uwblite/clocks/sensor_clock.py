"""A sensor's clock against the odometry's: where either was reset while both continue, the sensor's stamps are shifted by as
much."""

from collections.abc import Callable
from math import inf, isfinite
from typing import Generic, TypeVar

from .clock_map import ClockMap

T = TypeVar("T")

JUMP = 0.5
"""s by which a stamp, or a delay, must differ from its usual value for a reset; messages are late by less."""
_CONFIRMED = 4
"""Measurements, each after another odometry, that show that a reset lasts."""
_WINDOW, _BUCKET = 5.0, 0.5
"""s that the clock map looks back, and of one minimum: a link that becomes slower is a usual one after that time, and longer
steps of a sensor were silences."""


class SensorClock(Generic[T]):
    """From a sensor's stamps to those of the odometry's clock.

    When a measurement arrives, the odometry has reached a time that differs from its stamp by the link's delay. That delay
    changes slowly where a device is silent or its messages become late; where a stamp jumps, the sensor's or the
    odometry's, and the delay has another value from then on, a clock was reset. Until that is clear, measurements wait.

    Parameters
    ----------
    on_time : from a stamp, s, to a time that never goes back.
    """

    def __init__(self, on_time: Callable[[float], float]) -> None:
        self._on_time, self._shift = on_time, 0.0
        self._map: ClockMap | None = None
        """From the sensor's time, with the shift, to the odometry's."""
        self._last = self._now = -inf
        self._longest, self._silences = 0.0, 0
        self._pending: list[tuple[float, float, float, T]] = []
        """Stamp, difference from the usual delay, last odometry and measurement."""

    def take(self, stamp: float, now: float, silences: int, what: T) -> list[tuple[float, T]]:
        """Return the measurements that may be used, each with its time on the odometry's clock, s.

        Parameters
        ----------
        stamp : s, of the measurement. now : s, of the last odometry. silences : how often the odometry's stamps have leapt.
        """
        at = self._time(stamp)
        if not isfinite(at - now):
            return [(at, what)]
        if self._map is None:
            self._map = ClockMap(_WINDOW, _BUCKET)
            self._map.add(at, now)
        leapt = silences != self._silences or not -JUMP <= at - self._last <= self._longest + JUMP
        late = now - self._map.host(at)
        self._pending.append((stamp, late, now, what))
        if abs(late) > JUMP and (leapt or len(self._pending) > 1):
            lates = [entry[1] for entry in self._pending]
            if max(lates) - min(lates) <= JUMP:
                if len({entry[2] for entry in self._pending}) < _CONFIRMED:
                    return []
                self._shift += min(lates)
        free, self._pending = [(self._time(entry[0]), entry[3]) for entry in self._pending], []
        last = free[-1][0]
        if now > self._now:  # while the odometry is silent its clock stands
            self._map.add(last, now)
        self._longest = max(0.9 * self._longest, min(last - self._last, _WINDOW) if isfinite(self._last) else 0.0)
        self._last, self._now, self._silences = last, now, silences
        return free

    def _time(self, stamp: float) -> float:
        return self._on_time(stamp) + self._shift
