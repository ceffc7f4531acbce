"""The likelihood field of a map's walls, and its maxima over squares of cells, for branch and bound."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from .walls import Walls

CELL = 0.1
"""m; cell of the likelihood field."""
LEVELS = 3
"""Levels above the field; the coarsest has cells of 0.8 m."""
_SPREAD = 0.15
"""m; of a point about its wall: the cell, and 0.05 rad at 3 m."""
FARTHEST = 12.0
"""m; points farther away are not matched: 0.05 rad is there 0.6 m."""
_MOST_FIELD = 3_000_000
"""Cells of the field (one byte, four levels); a larger map gets coarser ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """The walls' likelihood, one byte a cell, and its maxima over squares of cells."""

    cell: float
    """m."""
    origin: Floats
    """(2,) lower left corner, m."""
    levels: tuple[NDArray[np.uint8], ...]
    """(rows, cols) each; level k holds the maximum over 2^k x 2^k cells to the upper right."""
    free: Bools
    """(rows, cols) cells in which a robot may stand."""
    margin: int
    """Cells around the map, so that points outside of it find a cell."""
    squares: Ints
    """(k, 2) row and column of the lowest cell of each of the coarsest squares in which a robot may stand."""


def field_of(walls: Walls) -> Field:
    """Return the likelihood field of walls."""
    g = walls.geometry
    size = np.array([g.cols, g.rows]) * g.resolution
    cell = max(CELL, float(np.sqrt((size[0] + 2 * FARTHEST) * (size[1] + 2 * FARTHEST) / _MOST_FIELD)))
    margin = int(np.ceil(FARTHEST / cell)) + 2 ** (LEVELS + 1)
    wide, high = (np.ceil(size / cell).astype(int) + 2 * margin).tolist()
    origin = g.origin - margin * cell
    x, y = origin[0] + (np.arange(wide) + 0.5) * cell, origin[1] + (np.arange(high) + 0.5) * cell
    likelihood, free = np.empty((high, wide), np.uint8), np.empty((high, wide), bool)
    for row in range(high):
        distance = np.minimum(walls.distances(x, np.full(wide, y[row])), 10.0)
        likelihood[row] = np.rint(255.0 * np.exp(-0.5 * np.square(distance / max(_SPREAD, cell))))
        free[row] = walls.state_at(x, np.full(wide, y[row])) == 0
    levels = [likelihood]
    for k in range(LEVELS):
        below, reach = levels[-1], 2**k
        wider = below.copy()
        wider[:, :-reach] = np.maximum(below[:, :-reach], below[:, reach:])
        higher = wider.copy()
        higher[:-reach] = np.maximum(wider[:-reach], wider[reach:])
        levels.append(higher)
    return Field(cell, origin, tuple(levels), free, margin, _squares(free))


def _squares(free: Bools) -> Ints:
    top = 2**LEVELS
    rows, cols = (n // top for n in free.shape)
    some = free[: rows * top, : cols * top].reshape(rows, top, cols, top).any(axis=(1, 3))
    return np.argwhere(some).astype(np.intp) * top
