"""Hits and misses: counts of the cells in which rays end and through which they pass, scan by scan."""

from copy import copy
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from ..errors import DataError
from .bresenham import mark_rays
from .geometry import GridGeometry

Counts = NDArray[np.int32]

WEIGHT_UNIT = 16
"""Misses are counted in sixteenths, so that weak ones stay integers."""
_SCRATCH_CELLS = 1 << 22
"""Cells of working memory: scans are traced in batches whose windows fit into it."""
_LONGEST_RAY = 1 << 14
"""Cells; a longer ray would need a window of more than 256 MB."""


class RayCounter:
    """Counts hits and misses of rays in the cells of one grid; the counts of two counters of one grid add up.

    Parameters
    ----------
    geometry : the grid; rays may leave it.
    clear_weight : weight of a ray without a hit against one with a hit, 0..1, rounded to 1 / WEIGHT_UNIT.
    """

    def __init__(self, geometry: GridGeometry, clear_weight: float = 0.5) -> None:
        self.geometry = geometry
        self._weak = round(clear_weight * WEIGHT_UNIT)
        self.hits: Counts = np.zeros((geometry.rows, geometry.cols), dtype=np.int32)
        self.misses: Counts = np.zeros((geometry.rows, geometry.cols), dtype=np.int32)
        self._scratch = np.zeros(0, dtype=np.uint8)

    def insert_rays(
        self, origins: Floats, endpoints: Floats, hit: Bools, scan: Ints | None = None, walls: Bools | None = None
    ) -> None:
        """Trace rays; within one scan every cell counts once.

        Parameters
        ----------
        origins : (r, 2) where the laser was, m, map frame.
        endpoints : (r, 2) where the rays end, m, map frame.
        hit : (r,) whether something is there; a ray without a hit clears with clear_weight.
        scan : (r,) number of the scan of each ray, non-decreasing; None = all rays are of one scan.
        walls : (rows, cols) cells before which rays without a hit end.
        """
        if origins.shape != endpoints.shape or hit.shape != origins.shape[:1]:
            raise DataError(f"rays of shapes {origins.shape}, {endpoints.shape} and {hit.shape} do not belong together")
        if len(hit) == 0:
            return
        if walls is not None and walls.shape != self.hits.shape:
            raise DataError(f"walls of shape {walls.shape} do not fit a grid of {self.hits.shape}")
        slot = np.zeros(len(hit), dtype=np.int64)
        if scan is not None:
            slot[1:] = np.cumsum(np.diff(scan) != 0)
        cells = np.stack([*self.geometry.cell_of(origins), *self.geometry.cell_of(endpoints)])
        changed = np.empty(len(hit), dtype=np.bool_)
        changed[0] = True
        changed[1:] = slot[1:] != slot[:-1]
        for column in (hit, *cells):
            changed[1:] |= column[1:] != column[:-1]
        slot, hit, cells = slot[changed], hit[changed], cells[:, changed]
        self._trace(slot, hit, cells, walls)

    def _trace(self, slot: Ints, hit: Bools, cells: Ints, walls: Bools | None) -> None:
        """Trace the rays of scans 0..n-1, as many scans at a time as working memory allows."""
        starts = np.searchsorted(slot, np.arange(slot[-1] + 2))
        rows, cols = np.minimum(cells[0], cells[2]), np.minimum(cells[1], cells[3])
        low = np.stack([np.minimum.reduceat(rows, starts[:-1]), np.minimum.reduceat(cols, starts[:-1])], axis=1)
        rows, cols = np.maximum(cells[0], cells[2]), np.maximum(cells[1], cells[3])
        high = np.stack([np.maximum.reduceat(rows, starts[:-1]), np.maximum.reduceat(cols, starts[:-1])], axis=1)
        size = high - low + 1
        if size.max() > _LONGEST_RAY:
            raise DataError(f"a ray of {size.max()} cells is too long to trace; set a smaller max_range")
        first = 0
        while first < len(low):
            area = np.maximum.accumulate(size[first:], axis=0).prod(axis=1) * np.arange(1, len(low) - first + 1)
            last = first + max(1, int(np.searchsorted(area, _SCRATCH_CELLS, "right")))
            rays = slice(starts[first], starts[last])
            self._trace_batch(slot[rays] - first, hit[rays], cells[:, rays], low[first:last], size[first:last], walls)
            first = last

    def _trace_batch(self, slot: Ints, hit: Bools, cells: Ints, low: Ints, size: Ints, walls: Bools | None) -> None:
        """Trace each scan into a window of its own, then add the windows to the grid."""
        height, width = size.max(axis=0).tolist()
        window = height * width
        if len(self._scratch) < len(low) * window:
            self._scratch = np.empty(len(low) * window, dtype=np.uint8)
        marks = self._scratch[: len(low) * window]
        marks[:] = 0
        begin, end = cells[:2] - low[slot].T, cells[2:] - low[slot].T
        start = slot * window + begin[0] * width + begin[1]
        step = end - begin
        stops = None if walls is None else self._windows_of(walls, low, height, width)
        # Stronger observations are written later and overwrite weaker ones.
        for rays, weight, stop in ((~hit, self._weak, stops), (hit, WEIGHT_UNIT, None)):
            if weight:
                mark_rays(marks, start[rays], step[0, rays], step[1, rays], width, weight, stop)
        ends = np.sort((slot * window + end[0] * width + end[1])[hit])
        ends = ends[np.diff(ends, prepend=-1) > 0]
        marks[ends] = 0
        self._add_hits(ends, low, window, width)
        for scan, (row, col) in enumerate(low.tolist()):
            rows, cols = size[scan].tolist()
            self._add_window(marks[scan * window : (scan + 1) * window].reshape(height, width)[:rows, :cols], row, col)

    def _add_hits(self, ends: Ints, low: Ints, window: int, width: int) -> None:
        """Count the cells in which rays ended, sorted and each once per scan, given by place in the scans' windows."""
        scan, cell = np.divmod(ends, window)
        row, col = low[scan, 0] + cell // width, low[scan, 1] + cell % width
        inside = self.geometry.inside(row, col)
        flat, cell = self.hits.reshape(-1), (row * self.geometry.cols + col)[inside]
        bounds = np.searchsorted(scan[inside], np.arange(len(low) + 1)).tolist()
        for begin, end in pairwise(bounds):
            flat[cell[begin:end]] += 1

    def _add_window(self, marks: NDArray[np.uint8], row: int, col: int) -> None:
        """Add the misses of one scan, its window's first cell at (row, col); cells outside the grid are dropped."""
        top, left = max(-row, 0), max(-col, 0)
        part = marks[top : max(self.geometry.rows - row, 0), left : max(self.geometry.cols - col, 0)]
        if part.size:
            rows, cols = part.shape
            self.misses[row + top : row + top + rows, col + left : col + left + cols] += part

    def _windows_of(self, cells: Bools, low: Ints, height: int, width: int) -> Bools:
        """Return the scans' windows (flat) onto a grid of flags; outside the grid nothing is set."""
        windows = np.zeros((len(low), height, width), dtype=np.bool_)
        for window, (row, col) in zip(windows, low.tolist(), strict=True):
            top, left = max(-row, 0), max(-col, 0)
            part = cells[max(row, 0) : max(row + height, 0), max(col, 0) : max(col + width, 0)]
            window[top : top + part.shape[0], left : left + part.shape[1]] = part
        return windows.reshape(-1)

    def cropped(self, margin: int = 2) -> "RayCounter":
        """Return the same counts in the smallest grid that holds all of them and a margin of cells."""
        seen = (self.hits > 0) | (self.misses > 0)
        rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows) == 0:
            return self
        top, left = max(int(rows[0]) - margin, 0), max(int(cols[0]) - margin, 0)
        window = slice(top, int(rows[-1]) + margin + 1), slice(left, int(cols[-1]) + margin + 1)
        counter = copy(self)
        counter.hits, counter.misses = self.hits[window], self.misses[window]
        counter.geometry = self.geometry.window(top, left, *counter.hits.shape)
        return counter

    def add(self, hits: Counts, misses: Counts) -> None:
        """Add the counts of other scans in the same grid."""
        self.hits += hits
        self.misses += misses
