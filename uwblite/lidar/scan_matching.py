"""Point-to-line matching of many pairs of clouds at once.

Nearest neighbours come from one raster per cloud. A pair's matches are condensed into the quadratic form of its relative
pose (3 x 3), which is all that the graph needs.

Degenerate directions are those in which only the scatter of the normals seems to constrain a pose: scattered normals of a wall
add spurious information about the motion along it. With the variance v of a normal's angle and the Jacobian J_t of the tangent,
N = sum w v J_t^T J_t is the information of scatter alone. In the basis B that diagonalises both, H = B V diag(l) V^T B^T and
N = B B^T, a direction was measured where its l exceeds a multiple of 1. That depends neither on units nor on the frame.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import CHUNK, TINY, Bools, Floats, Ints, Table, chunks, concatenated
from .cloud_rasters import NOBODY, CloudRasters, look_up
from .clouds import Clouds


class PairPolicy:
    """Matches and descent."""

    points: int = 150
    """Points looked up per pair."""
    fewest: int = 30
    """Clouds with fewer points with a normal measure nothing."""
    reach: float = 0.5
    """Farthest match at the beginning of a descent, m; the reach of the rasters."""
    gate: float = 0.15
    """The same at its end, m."""
    good_share: float = 0.75
    """Share of matching points from which on a pair needs no further search."""
    correlation: float = 8.0
    """Matches that together weigh as one: errors of neighbouring rays are correlated."""
    same_facing: float = float(np.sqrt(0.5))
    """Least cosine between the normals of two matched points."""
    measured: float = 2.0
    """Multiple of the spurious information that a direction must exceed to have been measured."""
    farthest: tuple[float, float] = (2.0 * gate, gate)
    """Longest step of one iteration, m and rad."""
    shrink: float = 0.8
    """Gate of an iteration as a share of the one before, at most."""
    gate_per_step: float = 10.0
    """Largest ratio of the next gate to a step, the larger of m and rad: points 10 m away move by ten times the angle."""
    converged: float = 1e-3
    """Steps below this end the descent, m or rad."""
    iterations: int = 20


_LEAST = float(np.finfo(np.float32).tiny)
SINGULAR = TINY
"""Share of the largest information below which a direction has none."""
_FLOOR = SINGULAR * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
"""N is at least this share of H's diagonal: without any scatter a direction is measured up to the inverse of it. Sums x
and y, whatever the frame."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudPairs(Table):
    """Pairs (e) of clouds, and the points of the sources that are looked up in the targets."""

    i: Ints
    """(e,) targets."""
    j: Ints
    """(e,) sources."""
    points: NDArray[np.int32]
    """(e, n) rows in the clouds' arrays, a pair's own in front; -1 behind them where a pair has fewer than others."""

    def __len__(self) -> int:
        return len(self.i)

    @property
    def asked(self) -> Bools:
        """(e, n) which of the points are a pair's own."""
        return self.points != NOBODY


@dataclass(frozen=True, slots=True, eq=False)
class PairFactors(Table):
    """Matches of pairs (e) of clouds, condensed about their relative poses."""

    hessian: Floats
    """(e, 3, 3) sum of w J^T J of the point-to-line distances by T_i_j (x, y, theta), 1/m^2-like, unscaled by noise."""
    spurious: Floats
    """(e, 3, 3) spurious part of it, by the scatter of the normals alone."""
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

    @property
    def quadratic(self) -> tuple[Floats, Floats, Floats]:
        """Hessian, the spurious part of it, and gradient."""
        return self.hessian, self.spurious, self.gradient

    @property
    def share(self) -> Floats:
        """(e,) share of the points looked up that match, 0..1."""
        return self.matched / np.maximum(self.asked, 1)

    @property
    def variance(self) -> float:
        """m^2, mean squared distance of the matches of all pairs."""
        return float(self.squared.sum() / max(self.weight.sum(), 1.0))


def pairs_of(clouds: Clouds, i: Ints, j: Ints, limit: int = PairPolicy.points) -> CloudPairs:
    """Return pairs of targets i (e,) and sources j (e,), with up to `limit` evenly spread points with a normal of each."""
    usable = clouds.lines
    ranks = np.concatenate([[0], np.cumsum(usable)])
    rows = np.append(np.flatnonzero(usable), NOBODY).astype(np.int32)
    begin, end = ranks[clouds.offsets[j]], ranks[clouds.offsets[j + 1]]
    take = np.minimum(end - begin, limit)
    rank = np.arange(take.max(initial=0))
    points = np.empty((len(j), len(rank)), dtype=np.int32)
    for part in chunks(len(j)):
        number, taken = (end - begin)[part, None], take[part, None]
        picked = begin[part, None] + (rank * number) // np.maximum(taken, 1)
        points[part] = rows[np.where(rank < taken, picked, len(rows) - 1)]
    return CloudPairs(i, j, points)


def match(
    raster: CloudRasters, pairs: CloudPairs, T_i_j: Floats, gate: float | Floats, scale: float | Floats,
    weight: Floats | None = None,
) -> PairFactors:
    """Match the listed points of each pair's source cloud to lines of its target cloud.

    Parameters
    ----------
    T_i_j : (e, 3) present relative poses.
    gate : matches farther apart, and with normals more than 45 degrees apart, do not count, m; of all pairs or each (e,).
    scale : width of the Geman-McClure kernel on the point-to-line distance, m; of all pairs or each (e,).
    weight : (p,) of the clouds' points as source points; None = 1 each.

    Returns
    -------
    PairFactors. Residual r = n . (T_i_j p - q); its Jacobian by (x, y, theta) is (n, n . (d/dtheta R p)).
    """
    root = None if weight is None else np.sqrt(weight)
    scale = np.full(len(pairs), scale)
    found = correspondences(raster, pairs, T_i_j, gate)
    return concatenated(
        [
            condensed(raster.clouds, some, scale[some.pairs, None], None if root is None else root.take(some.row))
            for some in found
        ]
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
    raster: CloudRasters, pairs: CloudPairs, T_i_j: Floats, gate: float | Floats
) -> Iterator[Correspondences]:
    """Yield the matches of all pairs, a bounded number of pairs at a time; for the parameters see match."""
    # Each coordinate of points and normals in one piece.
    surface = [np.ascontiguousarray(column) for column in (*raster.clouds.points.T, *raster.clouds.normals.T)]
    gate = np.full(len(pairs), gate)
    for part in chunks(max(len(pairs), 1), max(CHUNK // max(pairs.points.shape[1], 1), 1)):
        yield _looked_up(surface, raster, part, pairs.rows(part), T_i_j[part], gate[part])


def _looked_up(
    surface: Sequence[Floats], raster: CloudRasters, part: slice, pairs: CloudPairs, T_i_j: Floats, gate: Floats
) -> Correspondences:
    """Look up the points of some pairs (e,) with gates (e,)."""
    rows, square = pairs.points.astype(np.intp), np.square(gate)[:, None]  # Once, and not at every use.
    c, s = (v[:, None] for v in se2.cos_sin(T_i_j[:, 2]))
    px, py, sx, sy = (column.take(rows) for column in surface)
    rx, ry = c * px - s * py, s * px + c * py
    x, y = rx + T_i_j[:, :1], ry + T_i_j[:, 1:2]
    found = look_up(raster, pairs.i, x, y)
    near = found >= 0
    target = found + raster.clouds.offsets[pairs.i, None]
    target *= near
    qx, qy, nx, ny = (column.take(target) for column in surface)
    dx, dy = x - qx, y - qy
    facing = nx * (c * sx - s * sy) + ny * (s * sx + c * sy)
    good = near & (dx * dx + dy * dy <= square) & (facing > PairPolicy.same_facing) & (rows >= 0)
    return Correspondences(part, rows, target, good, nx * dx + ny * dy, (nx, ny), (rx, ry))


def condensed(clouds: Clouds, found: Correspondences, scale: float | Floats, root_weight: Floats | None) -> PairFactors:
    """Condense the matches of each pair into the quadratic form of its relative pose; roots of weights are (e, n)."""
    row, good, r, (nx, ny), (rx, ry) = found.row, found.good, found.distance, found.normal, found.arm
    root = good / (1.0 + np.square(r * (1.0 / scale)))
    if root_weight is not None:
        root *= root_weight
    weighted = np.empty((len(row), 4, row.shape[1]))
    wx, wy = np.multiply(root, nx, out=weighted[:, 0]), np.multiply(root, ny, out=weighted[:, 1])
    weighted[:, 2] = wy * rx - wx * ry
    weighted[:, -1] = root * r
    summed = weighted @ weighted.transpose(0, 2, 1)
    # The tangent (-ny, nx) replaces the normal; the variance of the normal is a further weight.
    tangent = np.empty_like(weighted[:, :-1])
    np.negative(wy, out=tangent[:, 0])
    tangent[:, 1] = wx
    np.add(wx * rx, wy * ry, out=tangent[:, 2])
    scatter = clouds.normal_variance.take(found.target) + clouds.normal_variance.take(row)
    spurious = (tangent * scatter[:, None]) @ tangent.transpose(0, 2, 1)
    return PairFactors(
        hessian=summed[:, :-1, :-1],
        spurious=spurious,
        gradient=summed[:, :-1, -1],
        matched=good.sum(axis=1),
        asked=(row >= 0).sum(axis=1),
        squared=summed[:, -1, -1],
        weight=np.einsum("en,en->e", root, root),
    )


def _relative_eigen(information: Floats, spurious: Floats) -> tuple[Floats, Floats, Floats]:
    """Return (..., 3, 3) B V, its inverse, and the eigenvalues (..., 3) of B^-1 H B^-T, N kept from vanishing."""
    basis = np.asarray(np.linalg.cholesky(_floored(information, spurious)), dtype=np.float64)
    inverse = _inverse(basis)
    values, vectors = np.linalg.eigh(inverse @ information @ np.swapaxes(inverse, -1, -2))
    return basis @ vectors, np.swapaxes(vectors, -1, -2) @ inverse, values


def _floored(information: Floats, spurious: Floats) -> Floats:
    """Return spurious information (..., 3, 3) that does not vanish."""
    floor = np.diagonal(information, axis1=-2, axis2=-1) @ _FLOOR + _LEAST
    return np.asarray(spurious + floor[..., None] * np.eye(information.shape[-1]))


def _inverse(lower: Floats) -> Floats:
    """Return the inverse of lower triangular matrices (..., 3, 3), in a tenth of the time of a general one."""
    x, y, z = (1.0 / lower[..., k, k] for k in range(lower.shape[-1]))
    inverse = np.zeros_like(lower)
    inverse[..., 0, 0], inverse[..., 1, 1], inverse[..., 2, 2] = x, y, z
    inverse[..., 1, 0], inverse[..., 2, 1] = -lower[..., 1, 0] * x * y, -lower[..., 2, 1] * y * z
    inverse[..., 2, 0] = (lower[..., 1, 0] * lower[..., 2, 1] * y - lower[..., 2, 0]) * x * z
    return inverse


def nondegenerate_step(information: Floats, spurious: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step (e, 3) in directions that were measured, none in the others, and L (e, 3, 3) with L^T L the
    information in those directions, unscaled by noise: of each the share 1 - m / l, with the multiple m of scatter alone."""
    basis, inverse, values = _relative_eigen(information, spurious)
    kept = np.maximum(values - PairPolicy.measured, 0.0)
    divisor = np.where(kept > 0.0, values, np.inf)
    step = -np.einsum("eji,ej->ei", inverse, np.einsum("eij,ej->ei", inverse, gradient) / divisor)
    return step, np.sqrt(kept)[:, :, None] * np.swapaxes(basis, 1, 2)


def measured_part(information: Floats, spurious: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Return L^T L (e, 3, 3) and the step (e, 3) of nondegenerate_step: where all directions were measured, as mostly, H - m N
    and the step of Gauss and Newton."""
    part = information - PairPolicy.measured * _floored(information, spurious)
    (a, b), c = part[:, 0, :2].T, part[:, 1, 1]
    lacking = ~((a > 0.0) & (a * c > b * b) & (np.linalg.det(part) > 0.0))
    if not lacking.any():
        return part, np.asarray(-np.linalg.solve(information, gradient[..., None])[..., 0], dtype=np.float64)
    step = np.empty_like(gradient)
    step[~lacking] = -np.linalg.solve(information[~lacking], gradient[~lacking, :, None])[..., 0]
    step[lacking], root = nondegenerate_step(information[lacking], spurious[lacking], gradient[lacking])
    part[lacking] = np.swapaxes(root, 1, 2) @ root
    return part, step


def measured(factors: PairFactors, T_i_j: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Turn factors into relative-pose measurements.

    Parameters
    ----------
    T_i_j : (e, 3) poses about which the factors were made. variance : (e,) m^2, of one match.

    Returns
    -------
    Z (e, 3) and sqrt_information (e, 3, 3) in the chart e = Z^-1 T; zero along what cannot be seen.
    """
    step, root = nondegenerate_step(*factors.quadratic)
    z = T_i_j + step
    z[:, 2] = se2.wrap_angle(z[:, 2])
    return z, root @ se2.rotation(z[:, 2]) / np.sqrt(variance)[:, None, None]


def squared_distance(error: Floats, covariance: Floats, sqrt_information: Floats) -> Floats:
    """Return the squared Mahalanobis distance (e,) between measured relative poses and others, in measured directions alone.

    With a measurement's root L of information, its error e and the covariance C of the other pose, whitened errors L e have the
    covariance 1 + L C L^T; a direction without information adds nothing to either.

    Parameters
    ----------
    error : (e, 3) of the other poses, seen from the measured ones. covariance : (e, 3, 3) of the other poses, in the same
        frames. sqrt_information : (e, 3, 3) L, in these frames.
    """
    whitened = np.einsum("eij,ej->ei", sqrt_information, error)
    joint = np.eye(error.shape[1]) + sqrt_information @ covariance @ np.swapaxes(sqrt_information, 1, 2)
    return np.einsum("ei,ei->e", whitened, np.linalg.solve(joint, whitened[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class Aligned(Table):
    """Final relative poses of pairs."""

    pose: Floats
    """(e, 3) T_i_j."""
    factors: PairFactors
    """Of the last matches."""

    @property
    def share(self) -> Floats:
        """(e,) share of the points looked up that match, 0..1."""
        return self.factors.share

    @property
    def rms(self) -> Floats:
        """(e,) root mean square distance of the matches, m."""
        return np.sqrt(self.factors.squared / np.maximum(self.factors.weight, _LEAST))


def limited(step: Floats) -> Floats:
    """Return steps (e, 3), m, m, rad, none of them longer than those of one iteration."""
    distance, turn = PairPolicy.farthest
    reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / distance, np.abs(step[:, 2]) / turn)
    return np.asarray(step / np.maximum(reach, 1.0)[:, None])


def align_pairs(
    raster: CloudRasters, pairs: CloudPairs, guess: Floats, first_gate: float, last_gate: float,
    iterations: int = PairPolicy.iterations,
) -> Aligned:
    """Align many pairs of clouds at once, each on its own: point-to-line ICP with a gate that shrinks with its steps.

    A pair that no longer moves at the last gate is finished.

    Parameters
    ----------
    guess : (e, 3) start poses of the source clouds. first_gate, last_gate : farthest match in the first and last iteration, m.
    """
    c, pose, gate, moving = PairPolicy, guess.copy(), np.full(len(guess), first_gate), np.arange(len(guess))
    finished: list[tuple[Ints, PairFactors]] = []
    for _ in range(iterations):
        factors = match(raster, pairs, pose[moving], gate, gate / 2.0)
        step = measured_part(*factors.quadratic)[1]
        length = np.abs(step).max(axis=1)
        pose[moving] += limited(step)
        left = (length >= c.converged) | (gate > last_gate)
        gate = np.maximum(np.minimum(c.shrink * gate, c.gate_per_step * length), last_gate)
        if not left.all():
            finished.append((moving[~left], _after(factors.rows(~left), step[~left])))
            moving, gate, pairs = moving[left], gate[left], pairs.rows(left)
        if not len(moving):
            break
    if len(moving) or not finished:
        finished.append((moving, match(raster, pairs, pose[moving], last_gate, last_gate / 2.0)))
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    order = np.argsort(np.concatenate([which for which, _ in finished]))
    return Aligned(pose, concatenated([factors for _, factors in finished]).rows(order))


def _after(factors: PairFactors, step: Floats) -> PairFactors:
    """Return the factors after steps (e, 3) so short that every point keeps its match."""
    change = np.einsum("eij,ej->ei", factors.hessian, step)
    squared = factors.squared + np.einsum("ei,ei->e", 2.0 * factors.gradient + change, step)
    return replace(factors, gradient=factors.gradient + change, squared=squared)
