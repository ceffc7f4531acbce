"""Anchors that were moved while they were heard: two places explain what one place cannot.

With the path of the tag known well enough, all ranges to an anchor are explained by one place, or those until some moment
by one place and those after it by another. The second explanation has three numbers and the moment more, and must be
worth them.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from .trilateration import TrilaterationConfig, trilaterate

_SPLITS = 7
"""Moments tried first, evenly spread over the ranges."""
_FINER = 3
"""Times the neighbourhood of the best moment is looked at more closely."""
_LEAST_RANGES = 20
"""Ranges on either side of a moment."""
_LEAST_MOVE = 0.8
"""Shorter moves are told from blocked sight by nothing, m."""
_SIGMAS = 5.0
"""Standard deviations of the two places, together, that a move must exceed."""
_WORSE = 0.3
"""Share of ranges that one place must leave unexplained before two are tried."""
_EXPLAINED = 0.5
"""Share of those that two places must explain."""
_WIDTH = 4.0
"""Ranges farther from a place than so many of their standard deviations are not explained by it."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """An anchor at two places."""

    stamp: float
    """First range from the second place, s."""
    before: Floats
    """(2,) m."""
    after: Floats
    """(2,) m."""

    @property
    def distance(self) -> float:
        """How far it was moved, m."""
        return float(np.hypot(*(self.after - self.before)))


def find_move(path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig) -> Move | None:
    """Find whether and when an anchor was moved; None where one place explains its ranges, or two do not explain more.

    Parameters
    ----------
    path : (m, 2) tag at the ranges, m. ranges : (m,) level distances, m. stamps : (m,) s, in the order of time.
    sigma : short-term standard deviation of the ranges, m.
    """
    if len(ranges) < 2 * _LEAST_RANGES:
        return None
    width = _WIDTH * max(sigma, 0.05)
    alone = _unexplained(path, ranges, width, config)[0]
    if alone < _WORSE * len(ranges):
        return None
    best, split = np.inf, 0
    low, high = _LEAST_RANGES, len(ranges) - _LEAST_RANGES
    for _ in range(1 + _FINER):
        tried = np.unique(np.linspace(low, high, _SPLITS).astype(np.int64))
        costs = [
            _unexplained(path[:k], ranges[:k], width, config)[0] + _unexplained(path[k:], ranges[k:], width, config)[0]
            for k in tried.tolist()
        ]
        if min(costs) < best:
            best, split = min(costs), int(tried[int(np.argmin(costs))])
        step = max(int((high - low) / (_SPLITS - 1)), 1)
        low, high = max(split - step, _LEAST_RANGES), min(split + step, len(ranges) - _LEAST_RANGES)
    if best > (1.0 - _EXPLAINED) * alone:
        return None
    (_, before, own), (_, after, other) = (
        _unexplained(path[part], ranges[part], width, config) for part in (slice(0, split), slice(split, None))
    )
    move = Move(float(stamps[split]), before, after)
    return move if move.distance > max(_LEAST_MOVE, _SIGMAS * np.hypot(own, other)) else None


def _unexplained(path: Floats, ranges: Floats, width: float, config: TrilaterationConfig) -> tuple[float, Floats, float]:
    """Return how many ranges the best place leaves unexplained, that place (2,), and its standard deviation, m."""
    found = trilaterate(path, ranges, config)
    if not found:
        return float(len(ranges)), np.full(2, np.nan), np.inf
    left = [
        float(np.sum(np.minimum(np.abs(ranges - np.hypot(*(h.position - path).T) - h.bias) / width, 1.0) ** 2))
        for h in found[:3]
    ]
    best = int(np.argmin(left))
    return left[best], found[best].position, found[best].position_sigma
