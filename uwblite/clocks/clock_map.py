"""The map from a device's clock to the host's: the lower envelope of arrivals.

The delay of a frame is often near its minimum, so the host time of a device stamp is the lower envelope of (device time,
arrival) up to a constant: the edge of their lower convex hull below the middle of the window (Moon, Skelly, Towsley 1999,
"Estimation and removal of clock skew from network delay measurements"). Scheduling jitter of the host drops out.
"""

import math
from collections import deque
from itertools import pairwise

MAX_SKEW = 1e-3
"""Largest believable relative error of a crystal; a tenth of it is usual."""
LEAST_EXCESS = 1e-4
"""s; the smallest delays of two buckets are not alike to less than that."""


class ClockMap:
    """Map device seconds to host seconds by the lower envelope of arrivals.

    Delays above the envelope are taken for exponential, and the skew of a crystal for normal about 0; the line is the
    most probable one. Without that prior the slope of a short or noisy window would be extrapolated to its end.

    Parameters
    ----------
    window : s of device time that the envelope looks back.
    bucket : s; one minimum is kept per bucket, so memory is bounded by window / bucket.
    max_skew : share by which the rate of the device's clock may be wrong; a tenth of it is usual.
    """

    def __init__(self, window: float = 120.0, bucket: float = 1.0, max_skew: float = MAX_SKEW) -> None:
        self._bucket, self._max_skew = bucket, max_skew
        self._minima: deque[tuple[float, float]] = deque(maxlen=max(2, round(window / bucket)))
        self._index: int | None = None
        self._offset = 0.0
        self.skew = 0.0
        """Relative rate of the host clock against the device clock, minus one."""
        self.excess = 0.0
        """s, mean of the smallest delays of the buckets above the envelope: it is known to twice that, at its ends too."""

    @property
    def full(self) -> bool:
        """The envelope begins to drop old frames."""
        return len(self._minima) == self._minima.maxlen

    def add(self, device: float, host: float) -> None:
        """Take one frame: stamped at `device` s by the device, arrived at `host` s."""
        if self._minima and device < self._minima[-1][0]:
            return
        delay, index = host - device, int(device // self._bucket)
        if index != self._index or not self._minima:
            self._minima.append((device, delay))
        elif delay < self._minima[-1][1]:
            self._minima[-1] = device, delay
        else:
            return
        self._index = index
        self._fit()

    def host(self, device: float) -> float:
        """Return the host time of device time `device`, s, late by the smallest delay that occurs."""
        return device + self._offset + self.skew * device

    def _fit(self) -> None:
        points, hull = self._minima, _lower_hull(self._minima)
        count, middle = len(points), sum(x for x, _ in points) / len(points)
        # The line through a corner of the hull has the log probability count * excess(slope) / mean + (slope / usual)^2 / 2:
        # its slope grows until that pays no more, or until the line lies on the next edge.
        usual = (0.1 * self._max_skew) ** 2 * count / max(self.excess, LEAST_EXCESS) if count > 2 else 0.0
        slopes = [(y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in pairwise(hull)]
        before, slope = -math.inf, 0.0
        for (x, _), following in zip(hull, [*slopes, math.inf], strict=True):
            slope = max(before, usual * (middle - x))
            if slope <= following:
                break
            before = following
        self.skew = max(-self._max_skew, min(self._max_skew, slope))
        over = [y - self.skew * x for x, y in points]
        self._offset = min(over)
        self.excess = (sum(over) - count * self._offset) / max(count - 2, 1)  # a line has two parameters


def rhythm_map() -> ClockMap:
    """Return the map from a count of frames, or of readings, to host time: their rate is stated within a few percent only."""
    return ClockMap(window=4.0, bucket=0.05, max_skew=0.1)


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
