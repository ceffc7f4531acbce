"""Anchors that were moved during a recording: two places explain what one place cannot.

With the path of the tag known well enough, all ranges to an anchor are explained by one place, or those until some moment
by one place and those after it by another. The second explanation has three numbers and the moment more, and must be
worth them.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from .trilateration import AnchorHypothesis, TrilaterationConfig, trilaterate

_SPLITS = 7
"""Moments tried first, evenly spread over the ranges."""
_ROUNDS = 6
"""Times, at most, that places and moment are found in turn; two or three are usual."""
_LEAST_RANGES = 20
"""Ranges on either side of a moment."""
_LEAST_MOVE = 0.8
"""Shorter moves cannot be distinguished from a blocked line of sight, m."""
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


def find_moves(path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig) -> list[Move]:
    """Find all moves of an anchor, in the order of time; parameters as for find_move.

    Binary segmentation; of three places, the first split may fall into the second one's time, so every moment is found
    again between its neighbours.
    """
    moves = _parted(path, ranges, stamps, sigma, config)
    for k in range(len(moves)) if len(moves) > 1 else ():
        since = moves[k - 1].stamp if k else -np.inf
        until = moves[k + 1].stamp if k + 1 < len(moves) else np.inf
        own = (stamps >= since) & (stamps < until)
        moves[k] = find_move(path[own], ranges[own], stamps[own], sigma, config) or moves[k]
    return moves


def _parted(path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig) -> list[Move]:
    move = find_move(path, ranges, stamps, sigma, config)
    if move is None:
        return []
    parts = (stamps < move.stamp, stamps >= move.stamp)
    before, after = (_parted(path[own], ranges[own], stamps[own], sigma, config) for own in parts)
    return [*before, move, *after]


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
    alone = float(_misfit(path, ranges, _fitted(path, ranges, width, config), width).sum())
    if alone < _WORSE * len(ranges):
        return None
    starts = np.unique(np.linspace(_LEAST_RANGES, len(ranges) - _LEAST_RANGES, _SPLITS).astype(np.int64)).tolist()
    tried: dict[int, _Split] = {}
    best = min((_converged(path, ranges, k, width, config, tried) for k in starts), key=lambda found: found.unexplained)
    if best.unexplained > (1.0 - _EXPLAINED) * alone:
        return None
    move = Move(float(stamps[best.moment]), best.before.position, best.after.position)
    sigma = np.hypot(best.before.position_sigma, best.after.position_sigma)
    return move if move.distance > max(_LEAST_MOVE, _SIGMAS * sigma) else None


@dataclass(frozen=True, slots=True, eq=False)
class _Split:
    """The places that suit the ranges before and after a moment, and the moment that suits these places best."""

    before: AnchorHypothesis
    after: AnchorHypothesis
    moment: int
    """First range from the second place."""
    unexplained: float
    """How many ranges the two places leave unexplained with it."""


def _converged(
    path: Floats, ranges: Floats, first: int, width: float, config: TrilaterationConfig, tried: dict[int, _Split]
) -> _Split:
    """Find places and moment in turn, from a first moment on (k-means with two clusters in a row).

    Parameters
    ----------
    tried : moments split at before; searches from several first moments meet. New ones are added.
    """
    for _ in range(_ROUNDS):
        if first not in tried:
            tried[first] = _split(path, ranges, first, width, config)
        if (found := tried[first]).moment == first:
            break
        first = found.moment
    return found


def _split(path: Floats, ranges: Floats, first: int, width: float, config: TrilaterationConfig) -> _Split:
    """Fit places to the ranges before and after a moment; the cost of every other moment follows from running sums."""
    low, high = _LEAST_RANGES, len(ranges) - _LEAST_RANGES
    before, after = (_fitted(path[part], ranges[part], width, config) for part in (slice(0, first), slice(first, None)))
    by_one, by_other = (_misfit(path, ranges, place, width) for place in (before, after))
    cost = np.concatenate([[0.0], np.cumsum(by_one - by_other)])[low : high + 1] + by_other.sum()
    best = int(np.argmin(cost))
    return _Split(before, after, low + best, float(cost[best]))


def _fitted(path: Floats, ranges: Floats, width: float, config: TrilaterationConfig) -> AnchorHypothesis:
    """Return the place that leaves the fewest ranges unexplained."""
    found = trilaterate(path, ranges, config)[:3]
    return min(found, key=lambda place: float(_misfit(path, ranges, place, width).sum()))


def _misfit(path: Floats, ranges: Floats, place: AnchorHypothesis, width: float) -> Floats:
    """Return how far each range (m,) is from being explained by a place: 0 wholly, 1 not at all."""
    off = np.abs(ranges - np.hypot(*(place.position - path).T) - place.bias) / width
    return np.minimum(off, 1.0) ** 2
