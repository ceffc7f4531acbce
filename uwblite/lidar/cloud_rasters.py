"""A raster for every cloud in which each cell names the nearest point: a look-up of a million points needs no tree."""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from ..arrays import CHUNK, WIDE, Floats, Ints, chunks
from ..graph.work import LOOK_UPS
from .clouds import CLOUDS_AT_ONCE, Clouds

_MOST_NARROW = np.iinfo(np.int16).max
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
    shape: NDArray[np.int32]
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


def rasterize(clouds: Clouds, cell: float, reach: float, targets: Ints | None = None) -> CloudRasters:
    """Build rasters with cells of a size, m, of all clouds or of targets alone: each point with a normal writes its number into
    those within reach, m, the nearest last."""
    many, margin, offsets = len(clouds), reach + cell, _offsets(reach / cell)
    kind = np.dtype(np.int16 if clouds.counts.max(initial=0) <= _MOST_NARROW else np.int32)
    writes = clouds.lines
    if targets is not None:
        wanted = np.zeros(many, dtype=bool)
        wanted[targets] = True
        writes &= wanted.take(clouds.owner)
    origin, shape, start = np.zeros((many, 2)), np.zeros((many, 2), dtype=np.int32), np.empty(many, dtype=np.int32)
    run, kept = [np.zeros(1, dtype=np.int32)], [np.full((1, _RUN), NOBODY, dtype=kind)]
    runs = named_runs = 1
    for some in chunks(many, CLOUDS_AT_ONCE):
        begin, end = clouds.offsets[some.start], clouds.offsets[some.stop]
        usable = begin + np.flatnonzero(writes[begin:end])
        owner, place = clouds.owner[usable], clouds.points.T.take(usable, axis=1).astype(np.float64)
        count = np.bincount(owner - some.start, minlength=some.stop - some.start)
        begins = (np.cumsum(count) - count)[count > 0]
        if len(begins):
            shown = owner[begins]
            origin[shown] = np.minimum.reduceat(place, begins, axis=1).T - margin
            high = np.maximum.reduceat(place, begins, axis=1).T
            shape[shown] = np.ceil((high + margin - origin[shown]) / cell).astype(np.int32) + 1
        wide, tall = shape[some, 0].astype(np.intp), -(-shape[some, 1].astype(np.intp) // _RUN)
        ends = np.cumsum(wide * tall)
        start[some] = runs + ends - wide * tall
        block = np.full((int(ends[-1]), _RUN), NOBODY, dtype=kind)
        stride = (tall * _RUN)[owner - some.start]
        cx, cy = ((place - origin.T.take(owner, axis=1)) / cell).astype(np.intp)
        base = (start[owner].astype(np.intp) - runs) * _RUN + cx * stride + cy
        _claim_cells(block.reshape(-1), base, stride, (usable - clouds.offsets[owner]).astype(kind), offsets)
        # All bits of -1 are set: the words of a run that names no point are -1 together, too.
        named = np.flatnonzero(reduce(np.bitwise_and, block.view(WIDE).T) != NOBODY)
        cells = np.zeros(len(block), dtype=np.int32)
        cells[named] = (named_runs + np.arange(len(named))) * _RUN
        run.append(cells)
        kept.append(block[named])
        runs, named_runs = runs + len(block), named_runs + len(named)
    return CloudRasters(clouds, cell, origin, shape, start, np.concatenate(run), np.concatenate(kept).reshape(-1))


def _offsets(reach: float) -> Ints:
    """Return the cells (m, 2) within reach of one, cells, the farthest first."""
    cells = np.argwhere(np.ones((2 * int(reach) + 1,) * 2)) - int(reach)
    square = np.sum(cells**2, axis=1)
    order = np.argsort(-square, kind="stable")
    return cells[order][square[order] <= reach * reach]


def _claim_cells(
    cells: NDArray[np.signedinteger], base: Ints, stride: Ints, number: NDArray[np.signedinteger],
    offsets: Ints,
) -> None:
    """Write the numbers of points into the cells at offsets from their own, base; later offsets overwrite earlier ones."""
    cells[base] = number
    last = cells[base] == number
    base, stride, number = base[last], stride[last], number[last]
    # Of few points many cells are claimed by one call.
    for some in chunks(len(offsets), max(CHUNK // max(len(base), 1), 1)):
        dx, dy = offsets[some].T[:, :, None]
        place = dx * stride + dy + base
        cells[place.ravel()] = np.broadcast_to(number, place.shape).ravel()


def look_up(raster: CloudRasters, i: Ints, x: Floats, y: Floats) -> NDArray[np.signedinteger]:
    """Return the number (e, n) of the point of cloud i (e,) nearest to each x, y (e, n), m; -1 where none is near."""
    raster.clouds.work[LOOK_UPS] += x.size
    per_cell = 1.0 / raster.cell
    # Truncation puts coordinates up to a cell below the raster into its rim, which names no point.
    cx = ((x - raster.origin[i, :1]) * per_cell).astype(np.int32)
    cy = ((y - raster.origin[i, 1:]) * per_cell).astype(np.int32)
    shape = raster.shape[i]
    inside = (cx.view(np.uint32) < shape[:, :1].view(np.uint32)) & (cy.view(np.uint32) < shape[:, 1:].view(np.uint32))
    run = cx * -(-shape[:, 1:] // _RUN)
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
