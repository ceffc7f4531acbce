"""Point-to-line matching of many pairs of clouds at once.

Nearest neighbours come from one raster per cloud, painted so that each cell names the nearest point: looking up a
million points is a handful of array operations and no tree. A pair's matches are condensed into the quadratic form
of its relative pose (3 x 3), which is all that the graph needs to know of them.
"""

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from . import se2
from .clouds import Clouds
from .line_factor import relative_eigen

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_AT_ONCE = 65536
"""Points looked up at once: what fits into a processor's cache, and a bound on the memory."""
_SAME_FACING = float(np.sqrt(0.5))
"""Least cosine between the normals of two matched points."""


@dataclass(frozen=True, slots=True, eq=False)
class NearestRaster:
    """For every cell around every cloud: which of its points is nearest."""

    cell: float
    """m."""
    origin: Floats
    """(k, 2) lower corner of each cloud's raster in its own frame, m."""
    shape: Ints
    """(k, 2) cells in x and y."""
    start: Ints
    """(k,) first cell of each raster in `nearest`."""
    nearest: NDArray[np.int32]
    """(cells,) row of the nearest point in the clouds' arrays, -1 = none within reach."""


@dataclass(frozen=True, slots=True, eq=False)
class PairFactors:
    """Matches of pairs (e) of clouds, condensed about their relative poses."""

    hessian: Floats
    """(e, 3, 3) sum of w J^T J of the point-to-line distances by T_i_j (x, y, theta), 1/m^2-like, unscaled by noise."""
    feigned: Floats
    """(e, 3, 3) part of it that the scatter of the normals alone would feign, see line_factor."""
    gradient: Floats
    """(e, 3) sum of w J^T r."""
    matched: Ints
    """(e,) points with a match."""
    asked: Ints
    """(e,) points that were looked up."""
    squared: Floats
    """(e,) sum of w r^2, m^2."""
    weight: Floats
    """(e,) sum of w."""


def paint(clouds: Clouds, cell: float, reach: float) -> NearestRaster:
    """Build the rasters: each point with a normal claims the cells within reach, nearer cells last.

    Parameters
    ----------
    cell, reach : cell size and distance up to which a point is a neighbour, m.
    """
    usable = np.flatnonzero(np.any(clouds.normals != 0.0, axis=1))
    owner, points = clouds.owner[usable], clouds.points[usable]
    margin = reach + cell
    low = np.full((len(clouds), 2), np.inf)
    high = np.full((len(clouds), 2), -np.inf)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    some = np.isfinite(low[:, 0])
    low = np.where(some[:, None], low - margin, 0.0)
    shape = np.where(some[:, None], np.ceil((high + margin - low) / cell), 0.0).astype(np.int64) + some[:, None]
    size = shape[:, 0] * shape[:, 1]
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    nearest = np.full(int(size.sum()), -1, dtype=np.int32)
    at = ((points - low[owner]) / cell).astype(np.int64)
    base = start[owner] + at[:, 0] * shape[owner, 1] + at[:, 1]
    steps = int(np.floor(reach / cell))
    offsets = [(dx, dy) for dx in range(-steps, steps + 1) for dy in range(-steps, steps + 1)]
    offsets = [o for o in offsets if np.hypot(*o) * cell <= reach]
    stride = shape[owner, 1]
    rows = usable.astype(np.int32)
    for dx, dy in sorted(offsets, key=lambda o: (-(o[0] ** 2 + o[1] ** 2), o)):
        nearest[base + dx * stride + dy] = rows
    return NearestRaster(cell, low, shape, start, nearest)


@dataclass(frozen=True, slots=True, eq=False)
class PairPoints:
    """The points that pairs look up: those of cloud j with a normal, thinned, pair after pair."""

    first: Ints
    """(e,) first row of each pair."""
    pair: Ints
    """(q,) pair of each row."""
    row: Ints
    """(q,) row in the clouds' arrays."""
    points: Floats
    """(2, q) m, in the source cloud's frame."""
    normals: Floats
    """(2, q)."""

    def of(self, first: int, last: int) -> "PairPoints":
        """Return the points of the pairs [first, last)."""
        a, b = np.searchsorted(self.pair, [first, last])
        own = self.first[first:last]
        return PairPoints(own - a, self.pair[a:b] - first, self.row[a:b], self.points[:, a:b], self.normals[:, a:b])


def pair_points(clouds: Clouds, j: Ints, limit: int) -> PairPoints:
    """List up to `limit` evenly spaced points with normals of the source cloud j (e,) of each pair."""
    usable = np.any(clouds.normals != 0.0, axis=1)
    ranks = np.concatenate([[0], np.cumsum(usable)])
    rows = np.flatnonzero(usable)
    begin, end = ranks[clouds.offsets[j]], ranks[clouds.offsets[j + 1]]
    take = np.minimum(end - begin, limit)
    first = np.concatenate([[0], np.cumsum(take)[:-1]]).astype(np.int64) if len(j) else np.zeros(0, dtype=np.int64)
    pair = np.repeat(np.arange(len(j)), take)
    rank = np.arange(len(pair)) - first[pair]
    picked = begin[pair] + (rank * (end - begin)[pair]) // np.maximum(take[pair], 1)
    row = rows[picked]
    return PairPoints(first, pair, row, np.ascontiguousarray(clouds.points[row].T), np.ascontiguousarray(clouds.normals[row].T))


def match(
    clouds: Clouds, raster: NearestRaster, i: Ints, T_i_j: Floats, points: PairPoints, gate: float, scale: float
) -> PairFactors:
    """Match the listed points of each pair's source cloud to lines of its target cloud i.

    Parameters
    ----------
    i : (e,) target clouds. T_i_j : (e, 3) present relative poses.
    points : what to look up, see pair_points.
    gate : matches farther apart, and with normals more than 45 degrees apart, do not count, m.
    scale : width of the Geman-McClure kernel on the point-to-line distance, m.

    Returns
    -------
    PairFactors. Residual r = n . (T_i_j p - q); its Jacobian by (x, y, theta) is (n, n . (d/dtheta R p)).
    """
    if len(points.pair) <= _AT_ONCE or len(i) < 2:
        return _match(clouds, raster, i, T_i_j, points, gate, scale)
    cuts = np.unique([0, *np.searchsorted(points.first, np.arange(_AT_ONCE, len(points.pair), _AT_ONCE)).tolist(), len(i)])
    parts = [_match(clouds, raster, i[a:b], T_i_j[a:b], points.of(a, b), gate, scale) for a, b in pairwise(cuts)]
    return PairFactors(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PairFactors)))


def _match(
    clouds: Clouds, raster: NearestRaster, i: Ints, T_i_j: Floats, points: PairPoints, gate: float, scale: float
) -> PairFactors:
    pairs, pair = len(i), points.pair
    c, s = (v[pair] for v in se2.cos_sin(T_i_j[:, 2]))
    px, py = points.points
    rx, ry = c * px - s * py, s * px + c * py
    x, y = rx + T_i_j[:, 0][pair], ry + T_i_j[:, 1][pair]
    cx = ((x - raster.origin[i, 0][pair]) * (1.0 / raster.cell)).astype(np.int64)
    cy = ((y - raster.origin[i, 1][pair]) * (1.0 / raster.cell)).astype(np.int64)
    wide, high = raster.shape[i, 0][pair], raster.shape[i, 1][pair]
    # A raster's outer rim of one cell names no point, so that truncation of small negative numbers does no harm.
    inside = np.flatnonzero((cx >= 0) & (cy >= 0) & (cx < wide) & (cy < high))
    found = raster.nearest[raster.start[i][pair[inside]] + cx[inside] * high[inside] + cy[inside]]
    near = np.flatnonzero(found >= 0)
    inside, found = inside[near], found[near]
    nx, ny = clouds.normals[found].T
    dx, dy = x[inside] - clouds.points[found, 0], y[inside] - clouds.points[found, 1]
    sx, sy = points.normals[:, inside]
    ci, si = c[inside], s[inside]
    facing = nx * (ci * sx - si * sy) + ny * (si * sx + ci * sy)
    good = np.flatnonzero((dx * dx + dy * dy <= gate * gate) & (facing > _SAME_FACING))
    inside, found, nx, ny = inside[good], found[good], nx[good], ny[good]
    r = nx * dx[good] + ny * dy[good]
    turn = ny * rx[inside] - nx * ry[inside]
    w = 1.0 / (1.0 + (r / scale) ** 2) ** 2
    owner = pair[inside]
    starts = np.searchsorted(owner, np.arange(pairs + 1))
    some, begin = np.diff(starts) > 0, np.minimum(starts[:-1], max(len(owner) - 1, 0))

    def total(values: Floats) -> Floats:
        return np.where(some, np.add.reduceat(values, begin), 0.0) if len(values) else np.zeros(pairs)

    def outer(wx: Floats, wy: Floats, wt: Floats, jx: Floats, jy: Floats, jt: Floats) -> Floats:
        h = np.empty((pairs, 3, 3))
        h[:, 0, 0], h[:, 1, 1], h[:, 2, 2] = total(wx * jx), total(wy * jy), total(wt * jt)
        h[:, 0, 1] = h[:, 1, 0] = total(wx * jy)
        h[:, 0, 2] = h[:, 2, 0] = total(wx * jt)
        h[:, 1, 2] = h[:, 2, 1] = total(wy * jt)
        return h

    wx, wy, wt = w * nx, w * ny, w * turn
    hessian = outer(wx, wy, wt, nx, ny, turn)
    v = w * (clouds.normal_variance[found] + clouds.normal_variance[points.row[inside]])
    along = nx * rx[inside] + ny * ry[inside]
    feigned = outer(-v * ny, v * nx, v * along, -ny, nx, along)
    gradient = np.stack([total(wx * r), total(wy * r), total(wt * r)], axis=1)
    asked = np.bincount(pair, minlength=pairs).astype(np.int64)
    matched = np.diff(starts)
    return PairFactors(hessian, feigned, gradient, matched, asked, total(w * r * r), total(w))


_TRUSTED = 2.0
"""Multiple of the feigned information that a direction must exceed to have been measured."""


def trusted_step(factors: PairFactors) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step (e, 3) in directions that were measured, none in the others, and L (e, 3, 3) with
    L^T L the information in those directions (unscaled by noise).

    In the basis B that diagonalises both, feigned = B B^T and hessian = B V diag(l) V^T B^T; l must exceed a multiple
    of 1, see line_factor.trusted_part.
    """
    basis, inverse, values, vectors = relative_eigen(factors.hessian, factors.feigned)
    kept = np.maximum(values - _TRUSTED, 0.0)
    divisor = np.where(kept > 0.0, values, np.inf)
    within = np.swapaxes(vectors, 1, 2) @ inverse
    step = -np.einsum("eji,ej->ei", within, np.einsum("eij,ej->ei", within, factors.gradient) / divisor)
    return step, np.sqrt(kept)[:, :, None] * np.swapaxes(basis @ vectors, 1, 2)


def measured(factors: PairFactors, T_i_j: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Turn factors into relative-pose measurements.

    Parameters
    ----------
    T_i_j : (e, 3) poses about which the factors were made.
    variance : (e,) m^2, variance of one match.

    Returns
    -------
    Z (e, 3) and sqrt_information (e, 3, 3) in the chart e = Z^-1 T; zero along what cannot be seen.
    """
    step, root = trusted_step(factors)
    z = T_i_j + step
    z[:, 2] = se2.wrap_angle(z[:, 2])
    c, s = se2.cos_sin(z[:, 2])
    turn = np.zeros((len(z), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0] = -s, s
    turn[:, 2, 2] = 1.0
    return z, root @ turn / np.sqrt(variance)[:, None, None]
