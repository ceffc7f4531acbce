"""Hits and misses: counts of the cells in which rays end and through which they pass, scan by scan.

Rays are drawn in lockstep by Bresenham's line (Algorithm for computer control of a digital plotter, 1965): after k of n
steps along its longer axis a ray has moved floor((2 k d + n) / (2 n)) cells along the other, of length d <= n. With rays sorted
by length, the unfinished ones are a prefix of the array.
"""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from ..errors import DataError
from .geometry import GridGeometry

Counts = NDArray[np.int32] | NDArray[np.uint16]
_Marks = NDArray[np.uint8] | NDArray[np.uint16]

WEIGHT_UNIT = 16
"""Misses are counted in sixteenths, so that weak ones stay integers."""
_SCRATCH_CELLS = 1 << 24
"""Cells of working memory: scans are traced in batches whose windows fit into it, and so does the area around all of these."""
_HIT = 128
"""Mark of a cell in which a ray of a scan ended, 1 = through which one passed; those of up to _MOST_SCANS add up in 16 bits."""
_MOST_SCANS = _HIT - 1
_SPARSE = 0.1
"""Share of the cells of a window up to which they are added one by one, in as much time for each as ten in a row take."""
_MARGIN = 2
"""Cells around all that rays met."""
_LONGEST_RAY = 1 << 14
"""Cells; a longer ray would need a window of more than 256 MB."""
_MANY = np.iinfo(np.uint16).max
"""Scans whose hits 16 bits just hold."""


class RayCounter:
    """Counts hits and misses of rays in the cells of one grid.

    Parameters
    ----------
    geometry : the grid; rays may leave it.
    clear_weight : weight of a ray without a hit against one with a hit, 0..1, rounded to 1 / WEIGHT_UNIT.
    most : scans at most; of fewer than 65,536, hits are of 16 bits.
    """

    def __init__(self, geometry: GridGeometry, clear_weight: float = 0.5, most: int = _MANY + 1) -> None:
        self.geometry = geometry
        self._weak = round(clear_weight * WEIGHT_UNIT)
        shape = (geometry.rows, geometry.cols)
        self.hits: Counts = np.zeros(shape, np.uint16) if most <= _MANY else np.zeros(shape, np.int32)
        self.misses: Counts = np.zeros(shape, dtype=np.int32)
        self._scratch = np.zeros(0, dtype=np.uint8)

    def insert_rays(self, origins: Floats, endpoints: Floats, scan: Ints | None = None, walls: Bools | None = None) -> None:
        """Trace rays; within one scan every cell counts once, as a hit if a ray ended there.

        Parameters
        ----------
        origins : (r, 2) where the laser was, m, map frame.
        endpoints : (r, 2) where the rays end, m, map frame.
        scan : (r,) number of the scan of each ray, non-decreasing; None = all rays are of one scan.
        walls : (rows, cols) the rays saw nothing: they clear with clear_weight, and end before these cells. None = something
            is where they end.
        """
        if origins.shape != endpoints.shape or (scan is not None and scan.shape != origins.shape[:1]):
            raise DataError(f"rays from {origins.shape} to {endpoints.shape} do not belong together, or not to their scans")
        if len(origins) == 0:
            return
        if walls is not None and walls.shape != self.hits.shape:
            raise DataError(f"walls of shape {walls.shape} do not fit a grid of {self.hits.shape}")
        slot = np.zeros(len(origins), dtype=np.intp)
        if scan is not None:
            slot[1:] = np.cumsum(np.diff(scan) != 0)
        cells = np.stack([*self.geometry.cell_of(origins), *self.geometry.cell_of(endpoints)])
        changed = np.ones(len(slot), dtype=np.bool_)
        changed[1:] = (np.diff(cells) != 0).any(axis=0) | (np.diff(slot) != 0)
        rows = np.flatnonzero(changed)
        self._trace(slot[rows], cells.take(rows, axis=1), walls)

    def _trace(self, slot: Ints, cells: Ints, walls: Bools | None) -> None:
        """Trace the rays of scans 0..n-1, as many scans at a time as working memory allows."""
        starts = np.searchsorted(slot, np.arange(slot[-1] + 2))
        low, high = (
            np.stack([ends.reduceat(ends(cells[k], cells[k + 2]), starts[:-1]) for k in range(2)], axis=1)
            for ends in (np.minimum, np.maximum)
        )
        size = high - low + 1
        if size.max() > _LONGEST_RAY:
            raise DataError(f"a ray of {size.max()} cells is too long to trace; set a smaller max_range")
        first = 0
        while first < len(low):
            some = slice(first, first + _MOST_SCANS)
            windows = np.maximum.accumulate(size[some], axis=0).prod(axis=1)
            around = np.maximum.accumulate(high[some], axis=0) - np.minimum.accumulate(low[some], axis=0) + 1
            cells_of = np.maximum(windows * np.arange(1, len(windows) + 1), around.prod(axis=1, dtype=np.float64))
            last = first + max(1, int(np.searchsorted(cells_of, _SCRATCH_CELLS, "right")))
            rays = slice(starts[first], starts[last])
            self._trace_batch(slot[rays] - first, cells[:, rays], low[first:last], size[first:last], walls)
            first = last

    def _trace_batch(self, slot: Ints, cells: Ints, low: Ints, size: Ints, walls: Bools | None) -> None:
        """Trace each scan into a window of its own, add the windows up, and their sum to the grid."""
        height, width = size.max(axis=0).tolist()
        window = height * width
        if len(self._scratch) < len(low) * window:
            self._scratch = np.empty(len(low) * window, dtype=np.uint8)
        marks = self._scratch[: len(low) * window]
        marks[:] = 0
        start = (np.arange(len(low)) * window - low[:, 0] * width - low[:, 1]).take(slot) + cells[0] * width + cells[1]
        rows, cols = cells[2:] - cells[:2]
        mark_rays(marks, start, rows, cols, width, None if walls is None else self._windows_of(walls, low, height, width))
        if walls is None:
            marks[start + rows * width + cols] = _HIT
        first = low.min(axis=0)
        total: _Marks = marks[:window].reshape(height, width)
        if len(low) > 1:
            total = np.zeros((low + size).max(axis=0) - first, dtype=np.uint16)
            places = zip(marks.reshape(-1, height, width), (low - first).tolist(), size.tolist(), strict=True)
            for marked, (row, col), (tall, wide) in places:
                total[row : row + tall, col : col + wide] += marked[:tall, :wide]
        row, col = first.tolist()
        self._add_window(total, row, col, WEIGHT_UNIT if walls is None else self._weak)

    def _add_window(self, total: _Marks, row: int, col: int, weight: int) -> None:
        """Add hits and misses in a window whose first cell is (row, col); cells outside the grid are dropped."""
        top, left = max(-row, 0), max(-col, 0)
        part = total[top : max(self.geometry.rows - row, 0), left : max(self.geometry.cols - col, 0)]
        window = slice(row + top, row + top + part.shape[0]), slice(col + left, col + left + part.shape[1])
        met = part != 0
        if np.count_nonzero(met) < _SPARSE * part.size:
            # A few long rays: memory of cells that none of them meets is not touched.
            some = np.flatnonzero(met)
            marks = part.reshape(-1)[some].astype(np.uint16)
            down, across = np.divmod(some, part.shape[1])
            place = (row + top + down) * self.geometry.cols + (col + left) + across
            self.hits.reshape(-1)[place] += marks // _HIT
            self.misses.reshape(-1)[place] += marks % _HIT * weight
        else:
            self.hits[window] += part // _HIT
            self.misses[window] += (part & (_HIT - 1)).astype(np.uint16) * weight

    def _windows_of(self, cells: Bools, low: Ints, height: int, width: int) -> Bools:
        """Return the scans' windows (flat) onto a grid of flags; outside the grid nothing is set."""
        windows = np.zeros((len(low), height, width), dtype=np.bool_)
        for window, (row, col) in zip(windows, low.tolist(), strict=True):
            top, left = max(-row, 0), max(-col, 0)
            part = cells[max(row, 0) : max(row + height, 0), max(col, 0) : max(col + width, 0)]
            window[top : top + part.shape[0], left : left + part.shape[1]] = part
        return windows.reshape(-1)

    def seen(self, rows: slice) -> Bools:
        """Return which cells of some rows a ray met."""
        return (self.hits[rows] > 0) | (self.misses[rows] > 0)

    def cropped(self) -> "RayCounter":
        """Return the same counts in the smallest grid that holds all of them and a margin of cells."""
        in_rows, in_cols = (np.zeros(size, dtype=np.bool_) for size in self.hits.shape)
        for some in self.geometry.strips():
            seen = self.seen(some)
            in_rows[some] = seen.any(axis=1)
            in_cols |= seen.any(axis=0)
        rows, cols = np.flatnonzero(in_rows), np.flatnonzero(in_cols)
        if len(rows) == 0:
            return self
        top, left = max(int(rows[0]) - _MARGIN, 0), max(int(cols[0]) - _MARGIN, 0)
        window = slice(top, int(rows[-1]) + _MARGIN + 1), slice(left, int(cols[-1]) + _MARGIN + 1)
        counter = copy(self)
        counter.hits, counter.misses = self.hits[window], self.misses[window]
        counter.geometry = self.geometry.window(top, left, *counter.hits.shape)
        return counter


_HALF = 0.5 + 1e-7
"""Ties are raised; values k d / n that are none are at least 1 / (2 n) from one, more than the rounding errors of their sum."""


def mark_rays(
    marks: NDArray[np.uint8], start: Ints, d_row: Ints, d_col: Ints, stride: int, walls: Bools | None = None
) -> None:
    """Mark every cell of the rays with 1, first cell included, last cell excluded.

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
    short = steps.max(initial=0) <= np.iinfo(np.int16).max
    order = np.argsort(-steps.astype(np.int16) if short else -steps, kind="stable")
    if walls is not None:
        order = order[~walls[start[order]]]
    shorter_by = -steps[order]
    if len(order) == 0 or shorter_by[0] == 0:
        return
    here, d_row, d_col = start[order].astype(np.int32), d_row[order], d_col[order]
    steep, row_step, col_step = np.abs(d_row) > np.abs(d_col), np.sign(d_row) * stride, np.sign(d_col)
    along, across = (np.where(one, row_step, col_step).astype(np.int32) for one in (steep, ~steep))
    slope = np.abs(np.where(steep, d_col, d_row)) / np.maximum(-shorter_by, 1)
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
        marks[cell[:r]] = 1
        moved[:r] += slope[:r]
        here[:r] += along[:r]
