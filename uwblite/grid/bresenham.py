"""Bresenham's line between grid cells, for many rays in lockstep.

Along its longer axis a ray of n steps advances one cell at a time; after k steps it has moved

    floor((2 k d + n) / (2 n))

cells along the other axis, where d <= n is the distance along that axis: the midpoint rule of J. E. Bresenham (Algorithm
for computer control of a digital plotter, 1965) in closed form. So step k of all rays is a few array operations; with rays
sorted by length, the unfinished ones are a prefix of the array.
"""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints

_Places = NDArray[np.int32]

_HALF = 0.5 + 1e-7
"""Values k d / n that are no ties are at least 1 / (2 n) from a tie, more than the rounding errors of their sum for rays of
thousands of steps, and ties are raised."""


def mark_rays(
    marks: NDArray[np.uint8], start: Ints, d_row: Ints, d_col: Ints, stride: int, value: int, walls: Bools | None = None
) -> None:
    """Write a value into every cell of the rays, first cell included, last cell excluded.

    Parameters
    ----------
    marks : (cells,) flat image, or several; changed in place.
    start : (r,) flat index of each ray's first cell; indices of less than 32 bits.
    d_row, d_col : (r,) rows and columns from the first to the last cell.
    stride : flat distance between rows.
    walls : (cells,) a ray ends before the first of its cells that is a wall.
    """
    steps = np.maximum(np.abs(d_row), np.abs(d_col))
    # Sorting numbers of 16 bits takes a quarter of the time.
    order = np.argsort(-steps.astype(np.int16) if len(steps) and steps.max() < 2**15 else -steps, kind="stable")
    if walls is not None:
        order = order[~walls[start[order]]]
    shorter_by = -steps[order]
    if len(order) == 0 or shorter_by[0] == 0:
        return
    here, along, across, slope = _strides(start[order], d_row[order], d_col[order], -shorter_by, stride)
    moved, aside, cell = np.full(len(order), _HALF), np.empty_like(here), np.empty(len(order), dtype=np.intp)
    for r in np.searchsorted(shorter_by, -np.arange(-shorter_by[0])).tolist():
        aside[:r] = moved[:r]
        aside[:r] *= across[:r]
        aside[:r] += here[:r]
        # Numbers of 64 bits, as indexing needs them.
        cell[:r] = aside[:r]
        if walls is not None and len(stopped := np.flatnonzero(walls[cell[:r]])):
            # A ray that has ended stays in its last cell, which is written already: cheaper than leaving it out.
            last = (moved[stopped] - slope[stopped]).astype(np.int32)
            here[stopped] += last * across[stopped] - along[stopped]
            along[stopped] = across[stopped] = 0
            cell[stopped] = here[stopped]
        marks[cell[:r]] = value
        moved[:r] += slope[:r]
        here[:r] += along[:r]


def _strides(start: Ints, d_row: Ints, d_col: Ints, steps: Ints, stride: int) -> tuple[_Places, _Places, _Places, Floats]:
    """Return the first cell, the flat steps along the longer and across to the shorter axis, and the slope d / n."""
    steep = np.abs(d_row) > np.abs(d_col)
    row_step, col_step = np.sign(d_row) * stride, np.sign(d_col)
    along = np.where(steep, row_step, col_step)
    across = np.where(steep, col_step, row_step)
    shorter = np.abs(np.where(steep, d_col, d_row))
    slope = shorter / np.maximum(steps, 1)
    return start.astype(np.int32), along.astype(np.int32), across.astype(np.int32), slope
