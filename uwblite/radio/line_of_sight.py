"""Which ranges were measured through obstacles that the lidar has mapped (NLOS).

Obstacles between tag and anchor make ranges longer, never shorter. Where such ranges occur in the same directions repeatedly,
no residual distinguishes the delay from another place of the anchor; the map does.
"""

import numpy as np

from ..arrays import Bools, Floats, Ints

_CELL = 0.2
"""Side of a cell of the map, m; a wall is about as thick."""
LEAST_POINTS = 3
"""Least number of points of clouds in a cell with a surface: people who pass cause fewer."""
_NEAR_TAG = 0.4
"""Length at the tag that does not count, m: it lies within the robot."""
_NEAR_ANCHOR = 1.0
"""Length at the anchor that does not count, m: an anchor is mounted on a wall, and its place is not known better than this
yet."""
_MOST_CELLS = 100_000_000
"""A larger map (2 x 2 km) gets coarser cells; a bound on the memory."""
_SAMPLES_AT_ONCE = 1 << 18
"""Places looked up at once."""


def blocked(tags: Floats, anchors: Floats, surfaces: Floats) -> Bools:
    """Return which straight lines (m,) from a tag to an anchor pass through a surface.

    Parameters
    ----------
    tags, anchors : (m, 2) both ends of each way, m, map frame.
    surfaces : (p, 2) points of all clouds, m, map frame.
    """
    if not len(surfaces) or not len(tags):
        return np.zeros(len(tags), dtype=bool)
    low, cell, occupied = _occupied(surfaces)
    way = anchors - tags
    length = np.hypot(way[:, 0], way[:, 1])
    first, count = _over_map(tags - low, way / np.maximum(length, 1e-9)[:, None], length, cell, cell * np.array(occupied.shape))
    through = np.zeros(len(tags), dtype=bool)
    for part in np.array_split(np.arange(len(tags)), 1 + int(count.sum()) // _SAMPLES_AT_ONCE):
        row = np.repeat(part, count[part])
        begins = np.cumsum(count[part]) - count[part]
        along = _NEAR_TAG + 0.5 * cell * (np.arange(len(row)) + np.repeat(first[part] - begins, count[part]))
        along /= length.take(row)
        x, y = (tag.take(row) + ahead.take(row) * along for tag, ahead in zip(tags.T, way.T, strict=True))
        through[row[_look_up(x, y, low, cell, occupied)]] = True
    return through


def _over_map(start: Floats, ahead: Floats, length: Floats, cell: float, size: Floats) -> tuple[Ints, Ints]:
    """Return the first place (m,) of each way that is looked up and how many are: those half a cell apart over the map.

    The estimate of an anchor may be kilometres away; the map ends at the farthest wall of the lidar.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        edges = (-cell - start) / ahead, (size + cell - start) / ahead  # a cell around the map: no rounding matters
    enter = np.fmin(np.fmax.reduce([np.full(len(length), _NEAR_TAG), *np.fmin(*edges).T]), length)
    leave = np.fmin.reduce([length - _NEAR_ANCHOR, *np.fmax(*edges).T])
    first, last = (np.ceil((at - _NEAR_TAG) / (0.5 * cell)) for at in (enter, leave))
    return first.astype(np.intp), np.maximum(last - first, 0.0).astype(np.intp)


def _occupied(surfaces: Floats) -> tuple[Floats, float, Bools]:
    """Return the lower corner (2,) of the map, the side of its cells and which of them (x, y) hold a surface."""
    blocks = [slice(first, first + _SAMPLES_AT_ONCE) for first in range(0, len(surfaces), _SAMPLES_AT_ONCE)]
    ends = [(block.min(axis=1), block.max(axis=1)) for block in (np.ascontiguousarray(surfaces[b].T) for b in blocks)]
    low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
    cell = max(_CELL, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    shape = tuple(int(_cells(high[axis], low[axis], cell)) + 1 for axis in (0, 1))
    number = np.empty(len(surfaces), dtype=np.intp)
    for block in blocks:
        x, y = surfaces[block].T
        number[block] = _cells(x, low[0], cell) * shape[1] + _cells(y, low[1], cell)
    hits = np.bincount(number, minlength=shape[0] * shape[1])
    return low, cell, (hits >= LEAST_POINTS).reshape(shape)


def _cells(places: Floats, low: float, cell: float) -> Ints:
    return np.floor((places - low) / cell).astype(np.intp)


def _look_up(x: Floats, y: Floats, low: Floats, cell: float, occupied: Bools) -> Bools:
    """Return which places x, y (s,) lie in a cell with a surface."""
    column, row = _cells(x, low[0], cell), _cells(y, low[1], cell)
    inside = (column >= 0) & (row >= 0) & (column < occupied.shape[0]) & (row < occupied.shape[1])
    return np.asarray(inside & occupied[np.where(inside, column, 0), np.where(inside, row, 0)])
