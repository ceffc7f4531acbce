"""Straight pieces instead of the staircase that a search over cells leaves, and poses along them.

Candidates of shortcuts join corners that are 1, 2, 4, 8 ... apart; those that keep the clearance are steps of a graph
whose cheapest path is the new line. It is cut into short pieces and shortened again until that gains nothing. A shortcut is
compared by its cost and not by its length, so that the line stays as far from obstacles as the search wanted.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from .. import se2
from ..arrays import TINY, WIDE, Bools, Floats, Ints, numbered
from .clearance import AT_ONCE, ClearanceMap

_SAMPLES_PER_CELL = 2
"""Where clearance and cost of a line are looked up."""
_STARTS_PER_SHORTCUT = 4
"""Shortcuts of the same reach that overlap."""
_PLACES_PER_OCTAVE = 8
"""Places on a straight piece between one distance from its nearer end and twice that distance."""
_SIEVES = 4
"""How often a shortcut is halved, at whose parts' ends it is looked up first: most of the long ones lead through obstacles."""
_GAIN = 1e-3
"""Relative; a round that gains less is the last."""
_CORNER = _GAIN
"""m; a corner costs so much that of equal lines the one with fewest is taken."""
_MOST_ROUNDS = 6


class Lines(NamedTuple):
    """What was found along straight lines."""

    costs: Floats
    """(n,) in metres of open space."""
    clear: Bools
    """(n,) whether every point of the line keeps the robot's radius from all obstacles."""
    open: Bools
    """(n,) whether it is clear, and a metre costs no more than one of open space: no other way is as cheap."""
    crossing: Bools
    """(n,) whether the line leads through an obstacle's cell."""


def along_lines(clearance: ClearanceMap, begin: Floats, end: Floats) -> Lines:
    """Look up clearance and cost along straight lines between places (n, 2) and (n, 2), m, map frame."""
    lengths = np.hypot(*(end - begin).T)
    pieces = np.ceil(lengths * _SAMPLES_PER_CELL / clearance.geometry.resolution).astype(np.intp) + 1
    parts = np.split(np.arange(len(lengths)), np.flatnonzero(np.diff(np.cumsum(pieces + 1) // AT_ONCE)) + 1)
    found = [_along(clearance, begin[part], end[part], lengths[part], pieces[part]) for part in parts]
    return Lines(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _along(clearance: ClearanceMap, begin: Floats, end: Floats, lengths: Floats, pieces: Ints) -> Lines:
    """Look up lines (n,) at the ends of so many equal pieces (n,) of each."""
    owner, number = numbered(pieces + 1)
    points = begin[owner] + (number / pieces[owner])[:, None] * (end - begin)[owner]
    squared, cost = clearance.at(points)
    step, first = lengths / pieces, np.flatnonzero(number == 0)
    clear = clearance.keeps(points, squared, (clearance.radius**2 + (0.5 * step) ** 2)[owner], owner)
    last = first + pieces
    costs = step * (np.add.reduceat(cost, first) - 0.5 * (cost[first] + cost[last]))
    open_ = clear & (np.maximum.reduceat(cost, first) <= 1.0)
    return Lines(costs, clear, open_, np.logical_or.reduceat(clearance.is_obstacle(points), first))


def smoothed(clearance: ClearanceMap, line: Floats) -> Floats:
    """Return the corners (k, 2) of a cheaper line with the same ends as a line (n, 2) of clear pieces, m."""
    cost = np.inf
    for _ in range(_MOST_ROUNDS):
        line, now = _shortened(clearance, _straightened(line))
        if not now < cost * (1.0 - _GAIN):
            break
        cost = now
    return line


def _shortened(clearance: ClearanceMap, line: Floats) -> tuple[Floats, float]:
    """Return the cheapest line (k, 2) by shortcuts between places on a line (n, 2), and its cost."""
    places, piece = _graded(line, clearance.geometry.resolution)
    begin, end = _shortcuts(len(places))
    steps = along_lines(clearance, places[:-1], places[1:]).costs
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    costs = driven[end] - driven[begin]
    across = np.flatnonzero(piece[begin] != piece[end - 1])
    across = across[_likely(clearance, places[begin[across]], places[end[across]])]
    along = along_lines(clearance, places[begin[across]], places[end[across]])
    costs[across] = along.costs
    kept = piece[begin] == piece[end - 1]
    kept[across] = along.clear
    graph = csr_matrix((costs[kept] + _CORNER, (begin[kept], end[kept])), shape=(len(places), len(places)))
    totals, before = dijkstra(graph, indices=0, return_predecessors=True)
    return places[walk_back(before, 0, len(places) - 1)], float(totals[-1])


def _likely(clearance: ClearanceMap, begin: Floats, end: Floats) -> Bools:
    """Return which lines (m,) keep the clearance at a few places at least: at the middle, at quarters ..."""
    left = np.arange(len(begin))
    for parts in 2 ** np.arange(1, _SIEVES + 1):
        for k in range(1, parts, 2):
            places = begin[left] + k / parts * (end - begin)[left]
            left = left[clearance.bounds(places) >= clearance.radius**2]
    return np.bincount(left, minlength=len(begin)) > 0


def _shortcuts(corners: int) -> tuple[Ints, Ints]:
    """Return first and last corner (m,) of every candidate."""
    pairs, reach = [np.array([corners - 1], dtype=WIDE)], 1  # the whole in one, as 0 * corners + its end
    while reach < corners:
        begin = np.arange(0, corners - reach, max(reach // _STARTS_PER_SHORTCUT, 1), dtype=WIDE)
        pairs.append(begin * corners + begin + reach)
        reach *= 2
    begin, end = np.divmod(np.unique(np.concatenate(pairs)), corners)
    return begin.astype(np.intp), end.astype(np.intp)


def walk_back(before: Ints, first: int, last: int) -> Ints:
    """Return the nodes (k,) from the first to the last along a tree of predecessors (n,)."""
    chain = [last]
    while chain[-1] != first:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _cuts(line: Floats, step: float) -> tuple[Ints, Ints, Ints]:
    """Return, of all equal cuts (k,) of a line's pieces, the piece, the cut's number in it, and how many it is cut into."""
    cuts = np.maximum(np.ceil(np.hypot(*np.diff(line, axis=0).T) / step - TINY), 1).astype(np.intp)
    piece, number = numbered(cuts)
    return piece, number, cuts[piece]


def _at(line: Floats, piece: Ints, share: Floats) -> Floats:
    """Return places (k + 1, 2) by shares (k,) of some pieces of a line, and its end."""
    return np.concatenate([line[piece] + share[:, None] * np.diff(line, axis=0)[piece], line[-1:]])


def _straightened(line: Floats) -> Floats:
    """Return a line (n, 2) without the corners at which it does not turn."""
    ways = np.diff(line, axis=0)
    before, after = ways[:-1], ways[1:]
    turns = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > TINY
    return line[np.concatenate([[True], turns, [True]])]


def _graded(line: Floats, step: float) -> tuple[Floats, Ints]:
    """Divide a line (n, 2) at about the step near its corners, and ever more coarsely between them.

    Return the places (k, 2), m, and the line's piece (k - 1,) on which the way to the next place lies.
    """
    piece, number, cuts = _cuts(line, step)
    away = np.minimum(number, cuts - number)
    coarseness = 2 ** np.log2(np.maximum(away / _PLACES_PER_OCTAVE, 1.0)).astype(np.intp)
    kept = away % coarseness == 0
    return _at(line, piece[kept], (number / cuts)[kept]), piece[kept]


def sampled(line: Floats, step: float, heading: float | None = None) -> tuple[Floats, Floats]:
    """Return poses (k, 3) along a line, and how far (k,) from its start they are, m.

    Parameters
    ----------
    line : (n, 2) corners, m; all are among the poses.
    step : largest distance between poses, m.
    heading : of the first pose, rad; None = along the line. Others are those of the piece that begins there, at the end of the
        one that ends.
    """
    piece, number, cuts = _cuts(line, step)
    points = _at(line, piece, number / cuts)
    ways = np.diff(points, axis=0)
    lengths = np.hypot(*ways.T)
    headings = np.arctan2(ways[:, 1], ways[:, 0])
    headings = np.concatenate([headings, headings[-1:]]) if len(headings) else np.zeros(1)
    if heading is not None:
        headings[0] = se2.wrap_angle(heading)
    return np.column_stack([points, headings]), np.concatenate([[0.0], np.cumsum(lengths)])
