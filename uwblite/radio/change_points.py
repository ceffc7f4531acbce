"""Anchors that were moved during a recording: two places explain ranges that one place cannot explain.

With the path of the tag known well enough, either one place explains all ranges to an anchor, or one place explains those until
some time and another place those from that or a later time on: an anchor that is carried is at neither meanwhile. The
alternative to a move is a change of the constant error: a robot that drives towards an anchor from afar, with a rack in between
or a path that is wrong by some decimetres, has ranges that a place metres away explains as well. So two places must explain
clearly more ranges than one place with another constant error from then on, and than one place high above the tag. Obstacles
make ranges longer, never shorter: a range that is too long is weaker evidence of a move than one that is too short.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from .trilateration import AnchorHypothesis, TrilaterationConfig, trilaterate_each

_SPLITS = 7
"""Number of times tried first, evenly spread over the ranges."""
_PROMISING = 0.5
"""Share of the gain that every other one of them must show before the rest is tried; moments are then not yet the best."""
_LIKELY = 2
"""Number of the best of them from which the search is continued."""
_ROUNDS = 6
"""Most alternations between finding places and finding the time; two or three are usual."""
_LEAST_MOVE = 0.8
"""Shorter moves cannot be distinguished from a blocked line of sight, m; the difference of the constant errors of both places
is subtracted."""
_FEWEST = 6.5
"""Number of ranges that two places must explain and one place does not; of 600 unmoved anchors in rooms with lasting errors,
one had more than 6.1."""
_WAY = 0.3
"""Largest share of ranges made while the anchor is carried; two places that leave out more explain too little."""
_WORST_BIAS = 1.0
"""Largest constant error of ranges to a place, m, above that of the worst radios; with a larger one no anchor stood there."""
_STEP = 0.5
"""Change of a constant error that a line of sight blocked from some moment on explains, m."""
_HEIGHTS, _LEAST_LEVEL = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 0.1
"""Heights that nobody gave, m, and the least level distance below an anchor, m: an anchor passed nearby and seen from afar at
another time seems to have two places."""
_LIKE_HEIGHT = 0.5
"""Share of the least gain that is enough against one place with a height, which has fewer unknowns than two places."""
_WIDTH = 4.0
"""Ranges farther from a place than so many of their standard deviations are not explained by it."""
_LATE, _LATE_BY = 0.4, 0.2
"""A range that is late by e metres is unexplained by no more than _LATE + _LATE_BY e. The ratio of likelihoods: the normal
core, one range in seven late, by 0.5 m on the mean and exponentially distributed, and gross errors, as early ranges are."""
_CARRIED = 0.5
"""Cost of a range made between both places, in unexplained ranges; a range with a larger cost was made while it was carried."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Conditions for a move, by how well the trajectory is known."""

    ranges: int
    """Ranges before the first time tried and after the last. A time at one of these ends is no minimum: the minimum lies
    beyond, or a bent path looks like a move; both places would have ranges of each other."""
    share: float
    """Part of all ranges that two places must explain and one place does not."""


ON_GIVEN_PATH = Evidence(8, 0.05)
"""Along a trajectory that other measurements determine: so many ranges determine a place."""
ON_OWN_PATH = Evidence(20, 0.1)
"""Along a trajectory that ranges determine, and that may be bent for a dozen of them; with blocked lines of sight for minutes,
unmoved anchors reached 0.09."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """An anchor at two places."""

    left: float
    """Time of the first range that is no longer from the first place, s."""
    stamp: float
    """Time of the first range from the second place, s; the same, where no range was measured while the anchor was carried."""
    first: AnchorHypothesis
    second: AnchorHypothesis

    @property
    def before(self) -> Floats:
        """First place (2,), m."""
        return self.first.position

    @property
    def after(self) -> Floats:
        """Second place (2,), m."""
        return self.second.position

    @property
    def distance(self) -> float:
        """How far it was moved, m."""
        return float(np.hypot(*(self.after - self.before)))


def find_moves(
    path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig, needed: Evidence = ON_GIVEN_PATH
) -> list[Move]:
    """Find all moves of an anchor, in the order of time; parameters as for find_move.

    Binary segmentation; of three places, the first split may fall into the second one's time, so every moment is found
    again between its neighbours.
    """
    moves = _parted(path, ranges, stamps, sigma, config, needed)
    for k in range(len(moves)) if len(moves) > 1 else ():
        since = moves[k - 1].stamp if k else -np.inf
        until = moves[k + 1].stamp if k + 1 < len(moves) else np.inf
        own = (stamps >= since) & (stamps < until)
        moves[k] = find_move(path[own], ranges[own], stamps[own], sigma, config, needed) or moves[k]
    ends = [*(move.left for move in moves[1:]), np.inf][: len(moves)]
    parts = [(stamps >= move.stamp) & (stamps < end) for move, end in zip(moves, ends, strict=True)]
    width = _width(sigma)
    returns = [_returned(path[own], ranges[own], stamps[own], m, width) for own, m in zip(parts, moves, strict=True)]
    return [move for pair in zip(moves, returns, strict=True) for move in pair if move is not None]


def _returned(path: Floats, ranges: Floats, stamps: Floats, move: Move, width: float) -> Move | None:
    """Return the move back to the place before, None where there is none; a known place needs few ranges.

    Parameters
    ----------
    path, ranges, stamps : of the ranges since a move, up to the next; none where one follows another at once.
    """
    if len(ranges) == 0:
        return None
    gain = _misfit(path, ranges, move.second, width) - _misfit(path, ranges, move.first, width)
    until_end = np.cumsum(gain[::-1])[::-1]
    first = int(np.argmax(until_end))
    if until_end[first] < _FEWEST or first == 0:
        return None
    return Move(float(stamps[first]), float(stamps[first]), move.second, move.first)


def _width(sigma: float) -> float:
    return _WIDTH * max(sigma, 0.05)


def _parted(
    path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig, needed: Evidence
) -> list[Move]:
    move = find_move(path, ranges, stamps, sigma, config, needed)
    if move is None:
        return []
    parts = (stamps < move.stamp, stamps >= move.stamp)
    before, after = (_parted(path[own], ranges[own], stamps[own], sigma, config, needed) for own in parts)
    return [*before, move, *after]


def find_move(
    path: Floats, ranges: Floats, stamps: Floats, sigma: float, config: TrilaterationConfig, needed: Evidence = ON_GIVEN_PATH
) -> Move | None:
    """Find whether and when an anchor was moved; None where one place explains its ranges, or two do not explain more.

    Parameters
    ----------
    path : (m, 2) tag at the ranges, m. ranges : (m,) level distances, m. stamps : (m,) s, in the order of time.
    sigma : short-term standard deviation of the ranges, m.
    """
    least = needed.ranges
    if len(ranges) < 2 * least:
        return None
    width, gain = _width(sigma), max(needed.share * len(ranges), _FEWEST)
    alone = float(_misfit(path, ranges, _fitted([(path, ranges)], width, config)[0], width).sum())
    if alone < gain:
        return None
    starts = np.unique(np.linspace(least, len(ranges) - least, _SPLITS).astype(np.intp)).tolist()
    tried = _splits(path, ranges, [(k, k) for k in starts[1::2] or starts], width, config, least)
    if alone - min(found.unexplained for found in tried.values()) < _PROMISING * gain:
        return None
    tried |= _splits(path, ranges, [(k, k) for k in starts[::2]], width, config, least)
    likely = sorted(tried, key=lambda at: tried[at].cost)[:_LIKELY]
    best = min((_converged(path, ranges, at, width, config, least, tried) for at in likely), key=lambda found: found.cost)
    if best.left == least or best.moment == len(ranges) - least:
        return None
    move = Move(float(stamps[best.left]), float(stamps[best.moment]), best.before, best.after)
    # Place and constant error are correlated; the constant error of a radio does not change when the radio is moved.
    beyond = move.distance - abs(move.second.bias - move.first.bias)
    if alone - best.unexplained < gain or beyond <= _LEAST_MOVE or best.moment - best.left > _WAY * len(ranges):
        return None
    if max(abs(move.first.bias), abs(move.second.bias)) > _WORST_BIAS:
        return None
    if _with_step(path, ranges, best, width, config) - best.unexplained < gain:
        return None
    return move if _with_height(path, ranges, width, config) - best.unexplained >= _LIKE_HEIGHT * gain else None


@dataclass(frozen=True, slots=True, eq=False)
class _Split:
    """The places that fit the ranges before and after some times best, and the times that fit these places best."""

    before: AnchorHypothesis
    after: AnchorHypothesis
    left: int
    """First range that is no longer from the first place."""
    moment: int
    """First range from the second place."""
    cost: float
    """Cost by which the times were chosen: ranges that their place does not explain, and those made between the places."""
    unexplained: float
    """Number of ranges that the two places leave unexplained; ranges made between them count by the better place."""


def _converged(
    path: Floats, ranges: Floats, at: tuple[int, int], width: float, config: TrilaterationConfig, least: int,
    tried: dict[tuple[int, int], _Split],
) -> _Split:
    """Find places and moments in turn, from first moments on (k-means with two clusters in a row).

    Parameters
    ----------
    tried : moments split at before; searches from several first moments meet. New ones are added.
    """
    for _ in range(_ROUNDS):
        if at not in tried:
            tried |= _splits(path, ranges, [at], width, config, least)
        found = tried[at]
        if (found.left, found.moment) == at:
            break
        at = found.left, found.moment
    return found


def _splits(
    path: Floats, ranges: Floats, moments: list[tuple[int, int]], width: float, config: TrilaterationConfig, least: int
) -> dict[tuple[int, int], _Split]:
    """Fit places to the ranges before and after several pairs of times."""
    parts = [part for left, first in moments for part in (slice(0, left), slice(first, None))]
    places = _fitted([(path[part], ranges[part]) for part in parts], width, config)
    each = zip(moments, places[::2], places[1::2], strict=True)
    return {at: _split(path, ranges, before, after, width, least) for at, before, after in each}


def _split(
    path: Floats, ranges: Floats, before: AnchorHypothesis, after: AnchorHypothesis, width: float, least: int
) -> _Split:
    """Choose the times that fit two places best; the costs of all follow from running sums."""
    low, high = least, len(ranges) - least
    by_one, by_other = (_misfit(path, ranges, place, width) for place in (before, after))
    until, since = (np.concatenate([[0.0], np.cumsum(by - _CARRIED)])[low : high + 1] for by in (by_one, by_other))
    best = int(np.argmin(np.minimum.accumulate(until) - since))
    start, end = low + int(np.argmin(until[: best + 1])), low + best
    cost = until[start - low] - since[best] + float(np.sum(by_other - _CARRIED)) + _CARRIED * len(ranges)
    unexplained = by_one[:start].sum() + np.minimum(by_one, by_other)[start:end].sum() + by_other[end:].sum()
    return _Split(before, after, start, end, float(cost), float(unexplained))


def _with_step(path: Floats, ranges: Floats, split: _Split, width: float, config: TrilaterationConfig) -> float:
    """Return how many ranges one place leaves unexplained whose constant error changes at the moment of a split."""
    late = np.arange(len(ranges)) >= split.moment
    unexplained = []
    for place, others in ((split.before, late), (split.after, ~late)):
        off = ranges - np.hypot(*(place.position - path).T) - place.bias
        level = ranges - others * np.clip(np.median(off[others]), -_STEP, _STEP)
        places = (place, *_fitted([(path, level)], width, config))
        unexplained.append(min(float(_misfit(path, level, at, width).sum()) for at in places))
    return min(unexplained)


def _with_height(path: Floats, ranges: Floats, width: float, config: TrilaterationConfig) -> float:
    """Return how many ranges one place leaves unexplained that is higher above the tag than the horizontal distances assume."""
    level = [np.sqrt(np.maximum(ranges**2 - height**2, _LEAST_LEVEL**2)) for height in _HEIGHTS]
    places = _fitted([(path, each) for each in level], width, config)
    unexplained = []
    for height, place in zip(_HEIGHTS, places, strict=True):
        slant = np.hypot(np.hypot(*(place.position - path).T), height) + place.bias
        unexplained.append(float(_unexplained(ranges - slant, width).sum()))
    return min(unexplained)


def _fitted(
    stretches: Sequence[tuple[Floats, Floats]], width: float, config: TrilaterationConfig
) -> list[AnchorHypothesis]:
    """Return the place that leaves the fewest ranges unexplained, for each stretch of path (m, 2) and ranges (m,)."""
    return [
        min(found[:3], key=lambda place: float(_misfit(path, ranges, place, width).sum()))
        for (path, ranges), found in zip(stretches, trilaterate_each(stretches, config), strict=True)
    ]


def _misfit(path: Floats, ranges: Floats, place: AnchorHypothesis, width: float) -> Floats:
    """Return how far each range (m,) is from being explained by a place: 0 wholly, 1 not at all."""
    return _unexplained(ranges - np.hypot(*(place.position - path).T) - place.bias, width)


def _unexplained(off: Floats, width: float) -> Floats:
    """Return the same of ranges that are longer than the distance by so much (m,), m."""
    most = np.where(off > 0.0, np.minimum(_LATE + _LATE_BY * off, 1.0), 1.0)
    return np.minimum((off / width) ** 2, most)
