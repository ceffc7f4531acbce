"""Point-to-line matching of many pairs of clouds at once.

Nearest neighbours come from one raster per cloud. A pair's matches are condensed into the quadratic form of its relative
pose (3 x 3), which is all that the graph needs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated
from .cloud_rasters import NOBODY, CloudRasters, look_up
from .clouds import Clouds
from .degeneracy import MEASURED, relative_eigen

_AT_ONCE = 16384
"""Points looked up at once, so that they fit into the processor's cache; it also bounds the memory."""
_PAIRS_AT_ONCE = 4096
"""Pairs whose points are listed at once; a bound on the memory."""
_SAME_FACING = float(np.sqrt(0.5))
"""Least cosine between the normals of two matched points."""


@dataclass(frozen=True, slots=True, eq=False)
class PairFactors(Table):
    """Matches of pairs (e) of clouds, condensed about their relative poses."""

    hessian: Floats
    """(e, 3, 3) sum of w J^T J of the point-to-line distances by T_i_j (x, y, theta), 1/m^2-like, unscaled by noise."""
    spurious: Floats
    """(e, 3, 3) spurious part of it, by the scatter of the normals alone, see degeneracy."""
    gradient: Floats
    """(e, 3) sum of w J^T r."""
    matched: Ints
    """(e,) number of points with a match."""
    asked: Ints
    """(e,) number of points looked up."""
    squared: Floats
    """(e,) sum of w r^2, m^2."""
    weight: Floats
    """(e,) sum of w."""


@dataclass(frozen=True, slots=True, eq=False)
class PairPoints(Table):
    """The points that pairs look up: those of cloud j with a normal, thinned."""

    row: NDArray[np.int32]
    """(e, n) rows in the clouds' arrays, a pair's own in front; -1 behind them where a pair has fewer than others."""

    def of(self, pair: int) -> Ints:
        """Return the rows of one pair."""
        rows = self.row[pair]
        return np.asarray(rows[rows >= 0], dtype=np.intp)


def pair_points(clouds: Clouds, j: Ints, limit: int) -> PairPoints:
    """List up to `limit` evenly spaced points with normals of the source cloud j (e,) of each pair."""
    usable = np.any(clouds.normals != 0.0, axis=1)
    ranks = np.concatenate([[0], np.cumsum(usable)])
    rows = np.append(np.flatnonzero(usable), NOBODY).astype(np.int32)
    begin, end = ranks[clouds.offsets[j]], ranks[clouds.offsets[j + 1]]
    take = np.minimum(end - begin, limit)
    rank = np.arange(take.max(initial=0))
    row = np.empty((len(j), len(rank)), dtype=np.int32)
    for first in range(0, len(j), _PAIRS_AT_ONCE):
        part = slice(first, first + _PAIRS_AT_ONCE)
        number, taken = (end - begin)[part, None], take[part, None]
        picked = begin[part, None] + (rank * number) // np.maximum(taken, 1)
        row[part] = rows[np.where(rank < taken, picked, len(rows) - 1)]
    return PairPoints(row)


def match(
    clouds: Clouds, raster: CloudRasters, i: Ints, T_i_j: Floats, points: PairPoints, gate: float | Floats,
    scale: float | Floats, weight: Floats | None = None,
) -> PairFactors:
    """Match the listed points of each pair's source cloud to lines of its target cloud i.

    Parameters
    ----------
    i : (e,) target clouds. T_i_j : (e, 3) present relative poses.
    points : what to look up, see pair_points.
    gate : matches farther apart, and with normals more than 45 degrees apart, do not count, m; of all pairs or each (e,).
    scale : width of the Geman-McClure kernel on the point-to-line distance, m; of all pairs or each (e,).
    weight : (p,) of the clouds' points as source points; None = 1 each.

    Returns
    -------
    PairFactors. Residual r = n . (T_i_j p - q); its Jacobian by (x, y, theta) is (n, n . (d/dtheta R p)).
    """
    root = None if weight is None else np.sqrt(weight)
    found = correspondences(clouds, raster, i, T_i_j, points, gate)
    scale = np.broadcast_to(scale, len(i))
    return concatenated(
        [condensed(clouds, some, scale[some.pairs, None], None if root is None else root.take(some.row)) for some in found]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points (e, n) of the source clouds of some pairs, and their matches in the target clouds."""

    pairs: slice
    """Which of the pairs these are."""
    row: Ints
    """Rows of the points in the clouds' arrays; -1 where there is none."""
    target: Ints
    """Rows of their matches; arbitrary where there is none."""
    good: Bools
    """Whether it is a match."""
    distance: Floats
    """m, point to line."""
    normal: tuple[Floats, Floats]
    """x and y of the line's, frame of the target cloud."""
    arm: tuple[Floats, Floats]
    """x and y of the points as the relative pose turns them, m."""


def correspondences(
    clouds: Clouds, raster: CloudRasters, i: Ints, T_i_j: Floats, points: PairPoints, gate: float | Floats
) -> Iterator[Correspondences]:
    """Yield the matches of all pairs, a bounded number of pairs at a time; for the parameters see match."""
    # Each coordinate of points and normals in one piece.
    surface = [np.ascontiguousarray(column) for column in (*clouds.points.T, *clouds.normals.T)]
    at_once = max(_AT_ONCE // max(points.row.shape[1], 1), 1)
    square = np.broadcast_to(np.square(gate), len(i))[:, None]
    for first in range(0, max(len(i), 1), at_once):
        part = slice(first, first + at_once)
        yield _looked_up(clouds, surface, raster, part, i[part], T_i_j[part], points.row[part], square[part])


def _looked_up(
    clouds: Clouds, surface: Sequence[Floats], raster: CloudRasters, pairs: slice, i: Ints, T_i_j: Floats,
    row: NDArray[np.int32], square: Floats,
) -> Correspondences:
    """Look up the points of some pairs (e,), whose squared gates are columns (e, 1) as other per-pair values are."""
    rows = row.astype(np.intp)  # Once, and not at every use.
    c, s = (v[:, None] for v in se2.cos_sin(T_i_j[:, 2]))
    px, py, sx, sy = (column.take(rows) for column in surface)
    rx, ry = c * px - s * py, s * px + c * py
    x, y = rx + T_i_j[:, :1], ry + T_i_j[:, 1:2]
    found = look_up(raster, i, x, y)
    near = found >= 0
    target = found + clouds.offsets[i, None]
    target *= near
    qx, qy, nx, ny = (column.take(target) for column in surface)
    dx, dy = x - qx, y - qy
    facing = nx * (c * sx - s * sy) + ny * (s * sx + c * sy)
    good = near & (dx * dx + dy * dy <= square) & (facing > _SAME_FACING) & (rows >= 0)
    return Correspondences(pairs, rows, target, good, nx * dx + ny * dy, (nx, ny), (rx, ry))


def condensed(
    clouds: Clouds, found: Correspondences, scale: float | Floats, root_weight: Floats | None = None
) -> PairFactors:
    """Condense the matches of each pair into the quadratic form of its relative pose; roots of weights are (e, n)."""
    row, good, r, (nx, ny), (rx, ry) = found.row, found.good, found.distance, found.normal, found.arm
    root = good / (1.0 + np.square(r * (1.0 / scale)))
    if root_weight is not None:
        root *= root_weight
    weighted = np.empty((len(row), 4, row.shape[1]))
    wx, wy = np.multiply(root, nx, out=weighted[:, 0]), np.multiply(root, ny, out=weighted[:, 1])
    weighted[:, 2] = wy * rx - wx * ry
    weighted[:, 3] = root * r
    summed = weighted @ weighted.transpose(0, 2, 1)
    # The tangent (-ny, nx) replaces the normal; the variance of the normal is a further weight.
    tangent = np.empty((len(row), 3, row.shape[1]))
    np.negative(wy, out=tangent[:, 0])
    tangent[:, 1] = wx
    np.add(wx * rx, wy * ry, out=tangent[:, 2])
    scatter = clouds.normal_variance.take(found.target) + clouds.normal_variance.take(row)
    spurious = (tangent * scatter[:, None]) @ tangent.transpose(0, 2, 1)
    return PairFactors(
        hessian=summed[:, :3, :3],
        spurious=spurious,
        gradient=summed[:, :3, 3],
        matched=good.sum(axis=1),
        asked=(row >= 0).sum(axis=1),
        squared=summed[:, 3, 3],
        weight=np.einsum("en,en->e", root, root),
    )


def nondegenerate_step(factors: PairFactors) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step (e, 3) in directions that were measured, none in the others, and L (e, 3, 3) with
    L^T L the information in those directions (unscaled by noise).

    In the basis B that diagonalises both, spurious = B B^T and hessian = B V diag(l) V^T B^T; l must exceed a multiple
    of 1, see degeneracy.
    """
    basis, inverse, values, vectors = relative_eigen(factors.hessian, factors.spurious)
    kept = np.maximum(values - MEASURED, 0.0)
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
    step, root = nondegenerate_step(factors)
    z = T_i_j + step
    z[:, 2] = se2.wrap_angle(z[:, 2])
    c, s = se2.cos_sin(z[:, 2])
    turn = np.zeros((len(z), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0] = -s, s
    turn[:, 2, 2] = 1.0
    return z, root @ turn / np.sqrt(variance)[:, None, None]
