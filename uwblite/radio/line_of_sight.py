"""Which ranges were measured through obstacles that the lidar has mapped (NLOS).

Obstacles between tag and anchor make ranges longer, never shorter. Where such ranges occur in the same directions repeatedly,
no residual distinguishes the delay from another place of the anchor; the map does.
"""

import numpy as np

from ..arrays import CHUNK, Bools, Floats, Ints, chunks, numbered

CELL = 0.2
"""Least side of a cell of the map, m; a wall is about as thick."""
_LEAST_POINTS = 3
"""Least number of points of clouds in a cell with a surface: people who pass cause fewer."""
_NEAR_TAG, _NEAR_ANCHOR = 0.4, 1.0
"""Lengths at both ends that do not count, m: within the robot, and to the wall on which an anchor is mounted, whose place is
not known better than this yet."""
_MOST_CELLS = 100_000_000
"""A larger map (2 x 2 km) gets coarser cells; a bound on the memory."""


def blocked(tags: Floats, anchors: Floats, surfaces: Floats, least: int = _LEAST_POINTS) -> Bools:
    """Return which straight lines (m,) from a tag to an anchor pass through a surface.

    Parameters
    ----------
    tags, anchors : (m, 2) both ends of each way, m, map frame.
    surfaces : (p, 2) points of all clouds, m, map frame. least : number of them in a cell 0.2 m wide that is a surface.
    """
    through = np.zeros(len(tags), dtype=bool)
    if not len(surfaces) or not len(tags):
        return through
    low, cell, occupied = _occupied(surfaces, least)
    way = anchors - tags
    length = np.hypot(way[:, 0], way[:, 1])
    # An anchor may be taken for kilometres away: no map is longer than its diagonal and what lies before it.
    diagonal = cell * float(np.hypot(*occupied.shape))
    first = np.hypot(*np.maximum(np.maximum(low - tags, tags - low - cell * np.array(occupied.shape)), 0.0).T)
    last = np.minimum(length - _NEAR_ANCHOR, first + diagonal)
    first = np.maximum(first, _NEAR_TAG)
    count = np.ceil(np.maximum(last - first, 0.0) / (0.5 * cell)).astype(np.intp)
    for part in np.array_split(np.arange(len(tags)), 1 + int(count.sum()) // CHUNK):
        way_of, step = numbered(count[part])
        row = part[way_of]
        along = (first.take(row) + 0.5 * cell * step) / length.take(row)
        places = [tag.take(row) + ahead.take(row) * along for tag, ahead in zip(tags.T, way.T, strict=True)]
        through[row[_look_up(np.stack(places), low, cell, occupied)]] = True
    return through


def _occupied(surfaces: Floats, least: int) -> tuple[Floats, float, Bools]:
    """Return the lower corner (2,) of the map, the side of its cells and which of them (x, y) hold a surface."""
    low, size = surfaces.min(axis=0), np.ptp(surfaces, axis=0)
    cell = max(CELL, float(np.sqrt(np.prod(size) / _MOST_CELLS)))
    # Points on a raster of as wide cells lie in their middles.
    low, shape = low - 0.5 * cell, tuple((size / cell + 0.5).astype(np.intp) + 1)
    number = np.empty(len(surfaces), dtype=np.intp)
    for block in chunks(len(surfaces)):
        number[block] = np.ravel_multi_index(tuple(_cells(surfaces[block].T, low, cell)), shape)
    hits = np.bincount(number, minlength=shape[0] * shape[1])
    return low, cell, (hits >= least).reshape(shape)


def _cells(places: Floats, low: Floats, cell: float) -> Ints:
    return np.floor((places - low[:, None]) / cell).astype(np.intp)


def _look_up(places: Floats, low: Floats, cell: float, occupied: Bools) -> Bools:
    """Return which places (2, s) lie in a cell with a surface."""
    column, row = _cells(places, low, cell)
    inside = (column >= 0) & (row >= 0) & (column < occupied.shape[0]) & (row < occupied.shape[1])
    return np.asarray(inside & occupied[np.where(inside, column, 0), np.where(inside, row, 0)])
