"""A sensor's clock against the odometry's: where either jumps while both continue, the sensor's stamps are shifted by the
jump."""

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")

JUMP = 0.5
"""s by which a stamp, or a lead, must differ from its usual value for a jump; messages are late by less."""
_CONFIRMED = 4
"""Measurements, each after another odometry, that show that a jump lasts."""
_LEARNT = 0.1
"""Share of a new lead in the usual one."""
_LONGEST = 5.0
"""s; steps of a sensor that are longer were silences."""


class SensorClock(Generic[T]):
    """From a sensor's stamps to those of the odometry's clock.

    When measurements arrive, their lead over the odometry is nearly constant. It changes slowly where a
    device is silent or its messages become late; where a stamp jumps, the sensor's or the odometry's, and the
    lead has another value from then on, a clock has jumped. Until that is clear, measurements wait.

    Parameters
    ----------
    on_time : from a stamp, s, to a time that never goes back.
    """

    def __init__(self, on_time: Callable[[float], float]) -> None:
        self._on_time = on_time
        self._shift, self._lead = 0.0, np.nan
        self._last = self._now = -np.inf
        self._longest, self._silences = 0.0, 0
        self._pending: list[tuple[float, float, float, T]] = []
        """Stamp, lead, last odometry and measurement."""

    def take(self, stamp: float, now: float, silences: int, what: T) -> list[tuple[float, T]]:
        """Return the measurements that may be used, each with its time on the odometry's clock, s.

        Parameters
        ----------
        stamp : s, of the measurement. now : s, of the last odometry. silences : how often the odometry's stamps have leapt.
        """
        at = self._time(stamp)
        lead = at - now
        if not np.isfinite(lead):
            return [(at, what)]
        leapt = silences != self._silences or not -JUMP <= at - self._last <= self._longest + JUMP
        self._pending.append((stamp, lead, now, what))
        if abs(lead - self._lead) > JUMP and (leapt or len(self._pending) > 1):
            leads, nows = np.array([(h[1], h[2]) for h in self._pending]).T
            if np.ptp(leads) <= JUMP:
                if len(np.unique(nows)) < _CONFIRMED:
                    return []
                self._shift -= float(np.median(leads)) - self._lead
        elif np.isnan(self._lead):
            self._lead = lead
        elif now > self._now:
            self._lead += _LEARNT * (lead - self._lead)
        free, self._pending = [(self._time(h[0]), h[3]) for h in self._pending], []
        self._longest = max(0.9 * self._longest, min(free[-1][0] - self._last, _LONGEST) if np.isfinite(self._last) else 0.0)
        self._last, self._now, self._silences = free[-1][0], now, silences
        return free

    def _time(self, stamp: float) -> float:
        return self._on_time(stamp) + self._shift
