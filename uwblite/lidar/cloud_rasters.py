"""A raster for every cloud in which each cell names the nearest point.

Looking up a million points is a handful of array operations and no tree.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats, Ints
from .clouds import Clouds

_CLOUDS_AT_ONCE = 256
"""Clouds whose rasters are made at once."""
NOBODY = -1
"""In place of the number of a point: there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudRasters:
    """A raster for every cloud: which of its points is nearest to each cell around it."""

    cell: float
    """m."""
    origin: Floats
    """(k, 2) lower corner of each cloud's raster in its own frame, m."""
    shape: Ints
    """(k, 2) cells in x and y; the outermost ones name no point."""
    start: Ints
    """(k,) first cell of each raster in `nearest`."""
    nearest: NDArray[np.signedinteger]
    """(cells,) number of the nearest point within its cloud, -1 = none within reach; 16 bits where they suffice."""


def rasterize(clouds: Clouds, cell: float, reach: float) -> CloudRasters:
    """Build the rasters: each point with a normal claims the cells within reach, nearer cells last.

    Parameters
    ----------
    cell, reach : cell size and distance up to which a point is a neighbour, m.
    """
    low, high = _boxes(clouds)
    filled = np.isfinite(low[:, :1])
    margin = reach + cell
    low = np.where(filled, low - margin, 0.0)
    shape = np.where(filled, np.ceil((high + margin - low) / cell), 0.0).astype(np.int64) + filled
    size = shape[:, 0] * shape[:, 1]
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    narrow = int(clouds.counts.max(initial=0)) <= np.iinfo(np.int16).max
    raster = CloudRasters(cell, low, shape, start, np.full(int(size.sum()), NOBODY, dtype=np.int16 if narrow else np.int32))
    steps = int(np.floor(reach / cell))
    offsets = [(dx, dy) for dx in range(-steps, steps + 1) for dy in range(-steps, steps + 1)]
    offsets = sorted((o for o in offsets if np.hypot(*o) * cell <= reach), key=lambda o: (-(o[0] ** 2 + o[1] ** 2), o))
    for some in _blocks(clouds):
        _claim_cells(clouds, some, raster, offsets)
    return raster


def chosen_rasters(one: CloudRasters, other: CloudRasters, which: Ints) -> CloudRasters:
    """Return the rasters of some clouds (w,), those of the other numbered on behind those of the one."""
    nearest = np.concatenate([one.nearest, other.nearest])
    origin, shape = np.concatenate([one.origin, other.origin]), np.concatenate([one.shape, other.shape])
    start = np.concatenate([one.start, other.start + len(one.nearest)])
    return CloudRasters(one.cell, origin[which], shape[which], start[which], nearest)


def _blocks(clouds: Clouds) -> Iterator[slice]:
    """Yield the clouds a bounded number at a time."""
    for first in range(0, len(clouds), _CLOUDS_AT_ONCE):
        yield slice(first, min(first + _CLOUDS_AT_ONCE, len(clouds)))


def _claim_cells(clouds: Clouds, some: slice, raster: CloudRasters, offsets: list[tuple[int, int]]) -> None:
    """Let the points of some clouds claim the cells at these offsets from their own, the last offset with most right."""
    usable, owner, x, y = _usable(clouds, some)
    rows = (usable - clouds.offsets[owner]).astype(raster.nearest.dtype)
    stride, low = raster.shape[owner, 1], raster.origin[owner]
    cx, cy = ((x - low[:, 0]) / raster.cell).astype(np.int64), ((y - low[:, 1]) / raster.cell).astype(np.int64)
    base = cx * stride + cy + raster.start[owner]
    for dx, dy in offsets:
        raster.nearest[base + (dx * stride + dy)] = rows


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
    per_cell = 1.0 / raster.cell
    # Truncation takes what lies up to a cell below the raster into its rim, which names no point.
    cx = ((x - raster.origin[i, :1]) * per_cell).astype(np.int32)
    cy = ((y - raster.origin[i, 1:]) * per_cell).astype(np.int32)
    wide, high = raster.shape[i, :1].astype(np.uint32), raster.shape[i, 1:].astype(np.uint32)
    inside = (cx.view(np.uint32) < wide) & (cy.view(np.uint32) < high)
    cell = cx * raster.shape[i, 1:] + cy
    cell += raster.start[i, None]
    # The first cell of all is in the rim of a raster, as what lies outside of any.
    cell *= inside
    return raster.nearest.take(cell) if len(raster.nearest) else np.full(x.shape, NOBODY)


def surface_field(clouds: Clouds, raster: CloudRasters, spread: float) -> NDArray[np.complex64]:
    """Return exp(-d^2 / 2 spread^2) times the nearest normal as a complex number for every cell of cloud 0's raster.

    d is the distance from the cell's centre to the point that the raster names; 0 where it names none.
    """
    wide, high = raster.shape[0].tolist()
    nearest = raster.nearest[: wide * high].astype(np.int64)
    cells = np.flatnonzero(nearest >= 0)
    own = nearest[cells]
    centre = raster.origin[0] + (np.column_stack([cells // high, cells % high]) + 0.5) * raster.cell
    square = np.sum((centre - clouds.points[own]) ** 2, axis=1)
    field = np.zeros(len(nearest), np.complex64)
    field[cells] = np.exp(-0.5 * square / spread**2) * (clouds.normals[own, 0] + 1j * clouds.normals[own, 1])
    return field
