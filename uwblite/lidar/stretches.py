"""Stretches of single clouds that are straight: neighbouring points on one line."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Floats, Ints, concatenated, dots
from .clouds import Clouds

_GAP = 0.35
"""Distance between neighbouring points that ends a stretch, m."""
_STEP = 0.04
"""Distance of a point from its neighbour's line that ends a stretch, m."""
_TURN, _SIGMAS, _MOST_TURN = np.deg2rad(12.0), 3.0, np.deg2rad(45.0)
"""Angle between near normals that ends a stretch, rad, plus so many of their standard deviations; and one that always does."""
_UNLIKE = 0.15
"""Largest root mean square angle between the normals on a stretch, away from its ends, and its own normal, rad, beyond their
noise; it is larger on columns and on points smeared over a step."""
_SPLITS = 8
"""Most rounds in which bent stretches are split where they bend most."""
_SHORTEST, _FEWEST = 0.35, 5
"""Least length, m, and number of points of a stretch that shows a direction."""
_STRAIGHT = 0.02
"""Largest root mean square distance of the points of a stretch from its line, m: the noise of distant surfaces. Bent walls
are detected from many stretches."""
TRIM = 0.1
"""Length at each end of a stretch that does not count, m: lines through corners are tilted."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Stretches (s) of neighbouring points of single clouds, and the line fitted to each."""

    of_point: Ints
    """(p,) stretch of each of the clouds' points."""
    along: Floats
    """(p,) m, where on its line each point stands, from the centre; the direction is that of the normal turned right."""
    centre: Floats
    """(s, 2) m, frame of the cloud."""
    normal: Floats
    """(s, 2) unit, towards the laser."""
    first: Floats
    """(s,) m, least `along`."""
    last: Floats
    """(s,) m, largest `along`."""
    straight: Bools
    """(s,) whether it is long and straight enough to be part of a wall."""

    def inside(self, stretch: Ints, along: Floats) -> Bools:
        """Return which places (m,) on stretches (m,) are not near their ends."""
        return (along > self.first[stretch] + TRIM) & (along < self.last[stretch] - TRIM)


def stretches(clouds: Clouds) -> Stretches:
    """Cut each cloud where neighbouring points, by bearing, are not on one line, and fit lines to the parts."""
    parts, many = [], 0
    for first in range(0, max(len(clouds), 1), _CLOUDS_AT_ONCE):
        part = _stretches_of(clouds, slice(clouds.offsets[first], clouds.offsets[min(first + _CLOUDS_AT_ONCE, len(clouds))]))
        parts.append(replace(part, of_point=part.of_point + many))
        many += len(part.first)
    return concatenated(parts)


_CLOUDS_AT_ONCE = 128
"""Clouds that are cut together: their arrays stay in the cache."""


def _stretches_of(clouds: Clouds, rows: slice) -> Stretches:
    """Return the stretches of whole clouds, whose points are these rows."""
    points, normals = clouds.points[rows].astype(np.float64), clouds.normals[rows].astype(np.float64)
    variance = clouds.normal_variance[rows].astype(np.float64)
    lined, step = np.any(normals != 0.0, axis=1), np.diff(points, axis=0)
    ends = (np.diff(clouds.owner[rows]) != 0) | ~lined[1:] | ~lined[:-1] | (np.hypot(*step.T) > _GAP)
    for side in (normals[1:], normals[:-1]):
        ends |= np.abs(dots(side, step)) > _STEP
    noise = _SIGMAS**2 * (variance[1:] + variance[:-1])
    turn = np.minimum(np.sqrt(_TURN**2 + noise), _MOST_TURN)
    ends |= dots(normals[1:], normals[:-1]) < np.cos(turn)
    begins = np.concatenate([np.ones(min(len(points), 1), dtype=bool), ends])
    _split(begins, points)
    return _fitted(_numbered(begins), points, normals, variance)


def _numbered(begins: Bools) -> Ints:
    return np.cumsum(begins, dtype=np.intp) - 1


def _split(begins: Bools, points: Floats) -> None:
    """Split bent stretches where they bend most, and their parts again; begins (p,), of the first points, gets more."""
    rows = np.arange(len(points))
    for _ in range(_SPLITS):
        number, some = _numbered(begins[rows]), points[rows]
        corners = _corners(number, some)
        if not len(corners):
            break
        begins[rows[corners]] = begins[rows[corners] + 1] = True
        # A stretch that was straight, or could not be split, is not tested again.
        rows = rows[np.isin(number, number[corners])]


def _corners(number: Ints, points: Floats) -> Ints:
    """Return the point of each bent stretch that is farthest from the chord (split and merge: T. Pavlidis and S. Horowitz,
    IEEE Transactions on Computers 23, 1974)."""
    first = np.flatnonzero(np.diff(number, prepend=-1))
    last = np.flatnonzero(np.diff(number, append=-1))
    bent = np.flatnonzero(principal_axes(number, points, len(first))[2] > _STRAIGHT)
    if not len(bent):
        return bent
    count = (last - first + 1)[bent]
    own, starts = np.repeat(np.arange(len(bent)), count), np.cumsum(count) - count
    rows = np.arange(len(own)) + (first[bent] - starts)[own]
    chord, away = points[last[bent]] - points[first[bent]], points[rows] - points[first[bent]][own]
    across = np.stack([-chord[:, 1], chord[:, 0]], axis=1) / np.maximum(np.hypot(*chord.T), 1e-9)[:, None]
    off = np.abs(dots(away, across[own]))
    at = np.flatnonzero(off == np.maximum.reduceat(off, starts)[own])
    farthest = rows[at[np.searchsorted(own[at], np.arange(len(bent)), "right") - 1]]
    return np.asarray(farthest[(farthest > first[bent]) & (farthest < last[bent])])


def _fitted(number: Ints, points: Floats, normals: Floats, variance: Floats) -> Stretches:
    many = int(number.max(initial=-1)) + 1
    count = np.bincount(number, minlength=many)
    centre, direction, across = principal_axes(number, points, many)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    facing = np.bincount(number, dots(normals, normal.take(number, axis=0)), many)
    normal *= np.where(facing < 0.0, -1.0, 1.0)[:, None]
    off, own = points - centre.take(number, axis=0), normal.take(number, axis=0)
    along = off[:, 0] * own[:, 1] - off[:, 1] * own[:, 0]
    first, last = extent(number, along, many)
    unlike = 1.0 - dots(normals, own) ** 2 - variance
    straight = (count >= _FEWEST) & (last - first >= _SHORTEST) & (across < _STRAIGHT)
    found = Stretches(number, along, centre, normal, first, last, straight)
    inner = found.inside(number, along)
    return replace(found, straight=straight & (np.bincount(number[inner], unlike[inner] - _UNLIKE**2, many) < 0.0))


def principal_axes(number: Ints, points: Floats, many: int) -> tuple[Floats, Floats, Floats]:
    """Return for each of many sets of points (p, 2), numbered (p,), its centre (m, 2), the direction (m, 2) in which it is
    long, and its rms extent across, (m,) m."""
    count = np.maximum(np.bincount(number, minlength=many), 1)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(number, values, many) / count)

    centre = np.stack([mean(points[:, 0]), mean(points[:, 1])], axis=1)
    x, y = (points - centre.take(number, axis=0)).T
    a, b, c = mean(x * x), mean(x * y), mean(y * y)
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    across = np.sqrt(np.maximum(0.5 * (a + c - np.hypot(a - c, 2.0 * b)), 0.0))
    return centre, np.stack([np.cos(angle), np.sin(angle)], axis=1), across


def extent(number: Ints, values: Floats, many: int) -> tuple[Floats, Floats]:
    """Return the least and the largest (m,) of the values (p,) of each set; inf and -inf of an empty one."""
    least, most = np.full(many, np.inf), np.full(many, -np.inf)
    np.minimum.at(least, number, values)
    np.maximum.at(most, number, values)
    return least, most
