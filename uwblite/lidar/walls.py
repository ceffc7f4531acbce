"""Straight walls: which straight stretches of many clouds are one wall."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, Ints, connected, dots, unique_rows
from .clouds import Clouds
from .stretches import Stretches, extent, principal_axes

_EVERY = 0.5
"""Distance between the places at which stretches are compared, m."""
_REACH, _OFF, _LEAN = 0.4, 0.06, np.cos(np.deg2rad(6.0))
"""Two stretches are of one wall where places on them are nearer than this, m, each within this distance of the other's line, m,
and face the same way (cosine): more than maps err by after the joint refinement, less than objects stand off walls."""
_BENT = 0.15
"""Farthest that places of one wall lie off its line, m; a wall farther off is bent: its halves may be walls."""
_STRETCHES = 3
"""Least number of stretches of a wall."""


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Straight walls (w) of a map."""

    of_stretch: Ints
    """(s,) wall of each stretch; -1 = of none."""
    centre: Floats
    """(w, 2) m, map frame."""
    normal: Floats
    """(w, 2) unit, towards the robot."""


def find_walls(clouds: Clouds, found: Stretches, poses: Floats) -> Walls:
    """Join the straight stretches of all clouds that lie on each other, at poses (k, 3) of the clouds, to walls."""
    rows = _places(found)
    stretch, owner = found.of_point[rows], clouds.owner[rows]
    at = se2.transform(poses[owner], clouds.points[rows].astype(np.float64))
    normal = se2.rotate(poses[owner, 2], found.normal[stretch])
    number = _halved(_joined(stretch, at, normal, len(found.straight)), stretch, at, owner)
    return _judged(number, stretch, at, normal, found)


def _places(found: Stretches) -> Ints:
    """Return rows of points on straight stretches, one every so often, none near an end."""
    return np.concatenate([_places_among(found, part) for part in _parts(found.of_point)] or [np.zeros(0, dtype=np.intp)])


def _parts(of_point: Ints) -> Iterator[slice]:
    """Yield the points of whole stretches, about so many at a time; of_point (p,) is ascending."""
    first = 0
    while first < len(of_point):
        last = min(first + _POINTS_AT_ONCE, len(of_point)) - 1
        yield slice(first, first := int(np.searchsorted(of_point, of_point[last], "right")))


_POINTS_AT_ONCE = 1 << 17
"""Points among which places are chosen at once; bounds the memory."""


def _places_among(found: Stretches, part: slice) -> Ints:
    stretch, along = found.of_point[part], found.along[part]
    rows = np.flatnonzero(found.straight[stretch] & found.inside(stretch, along))
    key = np.stack([stretch[rows], np.floor(along[rows] / _EVERY).astype(np.intp)], axis=1)
    number = unique_rows(key)[1]
    return part.start + rows[np.unique(number, return_index=True)[1]]


def _joined(stretch: Ints, at: Floats, normal: Floats, many: int) -> Ints:
    """Return the number (s,) of the set of each of many stretches: those are one whose places (m, 2), with normals (m, 2), lie
    on one line and face the same way."""
    one, other = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for rows in _strips(at):
        of_place = stretch[rows]
        # Linking each place with its first neighbour joins the same sets as all of its links, of which there may be thousands.
        one.append(of_place)
        other.append(of_place[_together(at[rows], normal[rows])])
    return connected(np.concatenate(one), np.concatenate(other), many)


def _strips(at: Floats) -> Iterator[Ints]:
    """Yield rows of places (m, 2), a bounded number at a time: strips of the map that overlap by the reach."""
    order = np.argsort(at[:, 0], kind="stable")
    x = at[order, 0]
    for first in range(0, len(x), _AT_ONCE):
        last = min(first + _AT_ONCE, len(x))
        yield order[first : np.searchsorted(x, x[last - 1] + _REACH, "right")]


_AT_ONCE = 1 << 13
"""Places of a strip; bounds the memory."""


def _together(at: Floats, normal: Floats) -> Ints:
    """Return for each place (m, 2) with a normal (m, 2) the first one of its set; places that lie on one line and face the same
    way are of one set."""
    pairs = cKDTree(at).query_pairs(_REACH, output_type="ndarray")
    columns = [np.ascontiguousarray(column) for column in (*at.T, *normal.T)]
    first = each = np.arange(len(at))
    # Some of the pairs link most of the places, and few others remain to be tested.
    for tested in (pairs[::_SOME], pairs):
        links = [np.stack([each, first])]
        for begin in range(0, len(tested), _PAIRS_AT_ONCE):
            one, other = tested[begin : begin + _PAIRS_AT_ONCE].T
            apart = np.flatnonzero(first.take(one) != first.take(other))
            one, other = one[apart], other[apart]
            links.append(np.stack([one, other])[:, _on_one_line(one, other, *columns)])
        one, other = np.concatenate(links, axis=1)
        own = connected(one, other, len(at))
        first = np.unique(own, return_index=True)[1][own]
    return first


_SOME = 16
"""One in so many pairs is tested first."""
_PAIRS_AT_ONCE = 1 << 15
"""Pairs that are processed together, so that they fit into the processor's cache."""


def _on_one_line(one: Ints, other: Ints, x: Floats, y: Floats, ahead: Floats, left: Floats) -> Bools:
    """Return which pairs (e,) of places do, with coordinates and normals (m,)."""
    across, along = x.take(other) - x.take(one), y.take(other) - y.take(one)
    (ax, ay), (bx, by) = ((ahead.take(side), left.take(side)) for side in (one, other))
    good = ax * bx + ay * by > _LEAN
    for nx, ny in ((ax, ay), (bx, by)):
        good &= np.abs(nx * across + ny * along) < _OFF
    return np.asarray(good)


def _halved(number: Ints, stretch: Ints, at: Floats, owner: Ints) -> Ints:
    """Return the number (s,) of the set of each stretch, -1 = without places, with bent sets halved along their length.

    Heading errors of some mrad over a long distance bend a long wall in the map, which looks straight from each pose. Its parts
    are straight, and are joined once poses have been adjusted to them (joined_walls.py). Walls bent in one cloud stay whole.

    Parameters
    ----------
    number : (s,) set of each stretch.
    stretch, at, owner : (m,), (m, 2), (m,) of places on stretches: of which, where in the map, m, and seen in which cloud.
    """
    own, which = (np.unique(k, return_inverse=True)[1] for k in (number[stretch], stretch))
    middle = principal_axes(which, at, int(which.max(initial=-1)) + 1)[0][which]
    bent = _bent(own, at) & ~_curved(own, at, owner)
    for _ in range(_HALVINGS):
        if not bent.any():
            break
        centre, direction, _ = _lines(own, at)
        beyond = bent[own] & (dots(middle - centre[own], direction[own]) > 0.0)
        halves, own = np.unique(2 * own + beyond, return_inverse=True)
        bent = bent[halves // 2] & _bent(own, at)
    halved = np.full(len(number), -1)
    halved[stretch] = own
    return halved


_HALVINGS = 6
"""Most times that a bent set of stretches is halved."""


def _lines(own: Ints, at: Floats) -> tuple[Floats, Floats, Floats]:
    """Return centre, direction and normal (w, 2) of the line that fits each set of places (m, 2), numbered (m,)."""
    centre, direction, _ = principal_axes(own, at, int(own.max(initial=-1)) + 1)
    return centre, direction, np.stack([-direction[:, 1], direction[:, 0]], axis=1)


def _bent(own: Ints, at: Floats) -> Bools:
    """Return which sets of places (m, 2), numbered (m,), reach too far off their line."""
    centre, _, across = _lines(own, at)
    return np.asarray(extent(own, np.abs(dots(at - centre[own], across[own])), len(centre))[1] >= _BENT)


def _curved(own: Ints, at: Floats, owner: Ints) -> Bools:
    """Return which sets of places (m, 2), numbered (m,), are not straight in most of the clouds (m,) that see them."""
    seen, number = unique_rows(np.stack([own, owner], axis=1))
    off = principal_axes(number, at, len(seen))[2] > _ROUND
    return np.asarray(np.bincount(seen[:, 0], np.where(off, 1.0, -1.0)) > 0.0)


_ROUND = 0.02
"""Root mean square distance from their line from which on places in one cloud are on a curve, m."""


def _judged(number: Ints, stretch: Ints, at: Floats, normal: Floats, found: Stretches) -> Walls:
    """Fit a line to each set (s,) of stretches, see _halved, by their places (m,), and keep those that are walls."""
    own = number[stretch]
    centre, _, across = _lines(own, at)
    many = len(centre)
    across *= np.where(np.bincount(own, dots(normal, across[own]), many) < 0.0, -1.0, 1.0)[:, None]
    stretches_of = np.bincount(number[np.unique(stretch)], minlength=many)
    good = (stretches_of >= _STRETCHES) & ~_bent(own, at)
    new = np.where(good, np.cumsum(good) - 1, -1)
    return Walls(np.where(found.straight & (number >= 0), new[number], -1), centre[good], across[good])
