"""A raster for every cloud in which each cell names the nearest point: a look-up of a million points needs no tree."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from ..arrays import WIDE, Floats, Ints
from ..graph.work import LOOK_UPS
from .clouds import Clouds

_CLOUDS_AT_ONCE = 64
"""Clouds whose rasters are made at once; a bound on the memory."""
_RUN_BITS = 4
_RUN = 1 << _RUN_BITS
"""Cells in y that are kept together: a wall and the cells within reach of it are about as wide."""
NOBODY = -1
"""In place of the number of a point: there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudRasters:
    """Rasters: columns of cells are cut into runs, and only runs that name a point are kept; most cells are far from any."""

    clouds: Clouds
    cell: float
    """m."""
    origin: Floats
    """(k, 2) lower corner of each cloud's raster in its own frame, m."""
    shape: Ints
    """(k, 2) cells in x and y; the outermost ones name no point."""
    start: NDArray[np.int32]
    """(k,) first run of each raster in `run`; those in y follow each other."""
    run: NDArray[np.int32]
    """(runs,) first cell of each run in `nearest`; the first run stands for what lies outside of all rasters."""
    nearest: NDArray[np.signedinteger]
    """(cells,) number of the nearest point within its cloud, -1 = none within reach; 16 bits where they suffice. Those of the
    first run name none: they stand for all runs that name none."""

    def cells(self, k: int) -> NDArray[np.signedinteger]:
        """Return the raster (x, y) of one cloud."""
        wide, high = self.shape[k].tolist()
        runs = -(-high // _RUN)
        first = self.run[self.start[k] : self.start[k] + wide * runs]
        return self.nearest[first[:, None] + np.arange(_RUN)].reshape(wide, runs * _RUN)[:, :high]


@dataclass(frozen=True, slots=True, eq=False)
class ScanClouds:
    """The lidar of all recordings, ready for matching."""

    clouds: Clouds
    """One per keyframe."""
    raster: CloudRasters
    """Of the same clouds."""
    delay: float
    """Offset of the lidar's clock with which the clouds were made, s."""


def rasterize(clouds: Clouds, cell: float, reach: float) -> CloudRasters:
    """Build rasters with cells of a size, m: each point with a normal writes its number into those within reach, m, the nearest
    last."""
    low, high = _boxes(clouds)
    filled = np.isfinite(low[:, :1])
    margin = reach + cell
    low = np.where(filled, low - margin, 0.0)
    shape = np.where(filled, np.ceil((high + margin - low) / cell), 0.0).astype(np.intp) + filled
    runs = shape[:, 0] * -(-shape[:, 1] // _RUN)
    start = (np.concatenate([[0], np.cumsum(runs)]) + 1).astype(np.int32)
    narrow = int(clouds.counts.max(initial=0)) <= np.iinfo(np.int16).max
    kind = np.dtype(np.int16 if narrow else np.int32)
    offsets = _offsets(reach / cell)
    run, kept, count = np.zeros(start[-1], dtype=np.int32), [np.full((1, _RUN), NOBODY, dtype=kind)], 1
    for some in _blocks(clouds):
        rows = slice(start[some.start], start[some.stop])
        block = np.full((rows.stop - rows.start, _RUN), NOBODY, dtype=kind)
        usable, owner, x, y = _usable(clouds, some)
        number = (usable - clouds.offsets[owner]).astype(kind)
        stride = -(-shape[owner, 1] // _RUN) * _RUN
        cx, cy = ((x - low[owner, 0]) / cell).astype(np.intp), ((y - low[owner, 1]) / cell).astype(np.intp)
        _claim_cells(block.reshape(-1), (start[owner] - rows.start) * _RUN + cx * stride + cy, stride, number, offsets)
        # All bits of -1 are set: the words of a run that names no point are -1 together, too.
        named = np.flatnonzero(reduce(np.bitwise_and, block.view(WIDE).T) != NOBODY)
        run[rows][named] = (count + np.arange(len(named))) * _RUN
        kept.append(block[named])
        count += len(named)
    return CloudRasters(clouds, cell, low, shape, start[:-1], run, np.concatenate(kept).reshape(-1))


def _offsets(reach: float) -> list[tuple[int, int]]:
    """Return the cells within reach of one, cells, the farthest first."""
    steps = np.arange(-int(reach), int(reach) + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    square = dx * dx + dy * dy
    order = np.argsort(-square, kind="stable")
    return [*zip(*(axis[order][square[order] <= reach * reach].tolist() for axis in (dx, dy)), strict=True)]


def _blocks(clouds: Clouds) -> Iterator[slice]:
    for first in range(0, len(clouds), _CLOUDS_AT_ONCE):
        yield slice(first, min(first + _CLOUDS_AT_ONCE, len(clouds)))


def _claim_cells(
    cells: NDArray[np.signedinteger], base: Ints, stride: Ints, number: NDArray[np.signedinteger],
    offsets: list[tuple[int, int]],
) -> None:
    """Write the numbers of points into the cells at offsets from their own, base; later offsets overwrite earlier ones."""
    cells[base] = number
    last = cells[base] == number
    base, stride, number = base[last], stride[last], number[last]
    for dx, dy in offsets:
        cells[base + (dx * stride + dy)] = number


def _usable(clouds: Clouds, some: slice) -> tuple[Ints, Ints, Floats, Floats]:
    """Return rows, clouds and coordinates (p,) of the points with a normal of some clouds."""
    first, end = clouds.offsets[some.start], clouds.offsets[some.stop]
    usable = first + np.flatnonzero(np.any(clouds.normals[first:end] != 0.0, axis=1))
    x, y = clouds.points[usable].T.astype(np.float64)
    return usable, clouds.owner[usable], x, y


def _boxes(clouds: Clouds) -> tuple[Floats, Floats]:
    """Return the corners (k, 2) of a box around the points with a normal of each cloud; inf where it has none."""
    low, high = np.full((len(clouds), 2), np.inf), np.full((len(clouds), 2), -np.inf)
    for some in _blocks(clouds):
        _, owner, x, y = _usable(clouds, some)
        if len(owner):
            begins = np.flatnonzero(np.concatenate([[True], np.diff(owner) > 0]))
            low[owner[begins]] = np.minimum.reduceat(np.stack([x, y]), begins, axis=1).T
            high[owner[begins]] = np.maximum.reduceat(np.stack([x, y]), begins, axis=1).T
    return low, high


def look_up(raster: CloudRasters, i: Ints, x: Floats, y: Floats) -> NDArray[np.signedinteger]:
    """Return the number (e, n) of the point of cloud i (e,) nearest to each x, y (e, n), m; -1 where none is near."""
    raster.clouds.work[LOOK_UPS] += x.size
    per_cell = 1.0 / raster.cell
    # Truncation puts coordinates up to a cell below the raster into its rim, which names no point.
    cx = ((x - raster.origin[i, :1]) * per_cell).astype(np.int32)
    cy = ((y - raster.origin[i, 1:]) * per_cell).astype(np.int32)
    wide, high = raster.shape[i, :1].astype(np.uint32), raster.shape[i, 1:].astype(np.uint32)
    inside = (cx.view(np.uint32) < wide) & (cy.view(np.uint32) < high)
    run = cx * (-(-raster.shape[i, 1:] // _RUN)).astype(np.int32)
    run += cy >> _RUN_BITS
    run += raster.start[i, None]
    run *= inside
    cy &= _RUN - 1
    cy += raster.run.take(run)
    return raster.nearest.take(cy)


def surface_field(raster: CloudRasters, spread: float) -> NDArray[np.complex64]:
    """Return exp(-d^2 / 2 spread^2) times the nearest normal as a complex number for every cell (x, y) of cloud 0's raster, at
    the distance d from its point; 0 where it names none."""
    clouds, nearest = raster.clouds, raster.cells(0).astype(np.intp)
    cells = np.argwhere(nearest >= 0)
    own = nearest[tuple(cells.T)]
    square = np.sum((raster.origin[0] + (cells + 0.5) * raster.cell - clouds.points[own]) ** 2, axis=1)
    field = np.zeros(nearest.shape, np.complex64)
    field[tuple(cells.T)] = np.exp(-0.5 * square / spread**2) * (clouds.normals[own] @ np.array([1.0, 1j]))
    return field
