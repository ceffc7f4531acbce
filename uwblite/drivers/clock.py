"""Device clocks: counters that wrap, and their time in seconds of the host.

A frame arrives at the host some time after the device stamped it. The delay is never negative and often near its
minimum, so the host time of a device stamp is the *lower envelope* of (device time, arrival) up to a constant: the
straight line below all points that lies closest to them, i.e. the edge of their lower convex hull below the middle of
the window (Moon, Skelly, Towsley 1999, "Estimation and removal of clock skew from network delay measurements").
Its slope is the skew of the device's crystal; scheduling jitter of the host drops out.
"""

from collections import deque
from itertools import pairwise

MAX_SKEW = 1e-3
"""Largest believable relative error of a crystal; anything above is a broken estimate."""
BACKWARD = 1.0
"""s; a scan may have begun before the last reading of the clock, more than that is another power-up."""
FIT_BUCKETS = 8
"""Fewer buckets than this: offset only, no skew."""


class Unwrapper:
    """Turn a wrapping counter into seconds that do not wrap.

    Parameters
    ----------
    modulus : the counter counts 0 .. modulus - 1.
    tick : seconds per count.
    """

    def __init__(self, modulus: int, tick: float) -> None:
        self._modulus, self._tick = modulus, tick
        self._tolerance = min(60.0, modulus * tick / 4)
        self._total: int | None = None
        self._count, self._now = 0, 0.0

    def unwrap(self, count: int, now: float) -> tuple[float, bool]:
        """Return the unwrapped time of a count, and whether the counter was reset since the last one.

        Parameters
        ----------
        count : the device's counter.
        now : arrival at the host, s; tells how often the counter wrapped in a long silence.

        Returns
        -------
        seconds : s since counter value 0 of the first turn; starts anew after a reset.
        reset : the counter went back or leapt: another power-up. The caller's clock map is void.
        """
        if self._total is None:
            self._total, reset = count, False
        else:
            elapsed = (now - self._now) / self._tick
            step = (count - self._count) % self._modulus
            step += self._modulus * round((elapsed - step) / self._modulus)
            reset = step * self._tick < -BACKWARD or abs(step - elapsed) * self._tick > self._tolerance
            self._total = count if reset else self._total + step
        self._count, self._now = count, now
        return self._total * self._tick, reset


class ClockMap:
    """Map device seconds to host seconds by the lower envelope of arrivals.

    Parameters
    ----------
    window : s of device time that the envelope looks back.
    bucket : s; one minimum is kept per bucket, so memory is bounded by window / bucket.
    """

    def __init__(self, window: float = 120.0, bucket: float = 1.0) -> None:
        self._bucket = bucket
        self._minima: deque[tuple[float, float]] = deque(maxlen=max(2, round(window / bucket)))
        self._index: int | None = None
        self._slope, self._origin, self._offset = 0.0, 0.0, 0.0

    @property
    def skew(self) -> float:
        """Relative rate of the host clock against the device clock, minus one."""
        return self._slope

    def add(self, device: float, host: float) -> None:
        """Take one frame: stamped at `device` s by the device, arrived at `host` s."""
        if self._minima and device < self._minima[-1][0]:
            return
        delay = host - device
        index = int(device // self._bucket)
        if index == self._index and self._minima:
            if delay >= self._minima[-1][1]:
                return
            self._minima[-1] = (device, delay)
        else:
            self._index = index
            self._minima.append((device, delay))
        self._fit()

    def host(self, device: float) -> float:
        """Return the host time of device time `device`, s, late by the smallest delay that occurs."""
        return device + self._offset + self._slope * (device - self._origin)

    def _fit(self) -> None:
        points = self._minima
        self._slope, self._origin = 0.0, points[0][0]
        if len(points) >= FIT_BUCKETS:
            hull = _lower_hull(points)
            middle = (points[0][0] + points[-1][0]) / 2
            for (x0, y0), (x1, y1) in pairwise(hull):
                if x0 <= middle <= x1:
                    self._slope = max(-MAX_SKEW, min(MAX_SKEW, (y1 - y0) / (x1 - x0)))
        self._offset = min(y - self._slope * (x - self._origin) for x, y in points)


def _lower_hull(points: deque[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the lower convex hull of points sorted by x (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append((x, y))
    return hull
