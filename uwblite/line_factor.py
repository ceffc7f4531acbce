"""The point-to-line factor: how well points of one cloud lie on the lines of another, linearised by their relative pose.

For a source point s, matched with a target point whose line has normal n and centre c, the residual is

    r = n . (T s - c)        T = T_target_source

and by the coordinates (x, y, theta) of T, which add, its Jacobian is J = [n_x, n_y, n . perp(R s)]. With weights w of
a robust kernel the factor is the Gauss-Newton system H = sum w J^T J / sigma^2, g = sum w J^T r / sigma^2: the step d
solves H d = -g.

Source points and lines' centres are both means over a neighbourhood of the same radius. That takes most of the noise
out, and where a surface is curved both means lie off it by the same amount.

Normals scatter, and a wall whose normals scatter seems to resist being slid along. With the variance v of a normal's
angle and the Jacobian J_t of the tangent, N = sum w v J_t^T J_t / sigma^2 is the information that scatter alone would
feign; in directions where H does not exceed a multiple of N nothing was measured, and trusted_part says nothing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .config import setting
from .nearest import NearestRaster
from .point_cloud import PointCloud
from .robust import Kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

CAUCHY = Kernel("cauchy", 2.0)

_FEIGNED_FLOOR = 1e-9
"""Of H's diagonal: lines without any scatter are trusted up to the inverse of that."""
_SOLVABLE = 1e-3
"""Smallest eigenvalue relative to N that is divided by."""
_TINY = 1e-30


@dataclass(frozen=True, slots=True)
class LineFactorConfig:
    """Which pairs count and how much."""

    gate: float = setting(0.3, above=0.0)
    """m; points farther apart are no pair."""
    sigma: float = setting(0.02, above=0.0)
    """m, standard deviation of a raw point about a line by the noise of both clouds. (The residuals of means are
    smaller, but neighbouring ones share their noise: in sum they tell as much as raw points do.)"""
    kernel: Kernel = CAUCHY
    """On residual / sigma."""
    max_normal_angle: float = 0.8
    """rad; points whose normals differ by more are no pair; nor are the two sides of a wall."""
    degeneracy: float = 2.0
    """Multiple of the information feigned by the scatter of the normals that a direction must exceed; 0 trusts all."""


@dataclass(frozen=True, slots=True, eq=False)
class LineFactor:
    """Gauss-Newton system of one pair, or of k pairs, by the coordinates x, y, theta of T_target_source."""

    information: Floats
    """(..., 3, 3) H."""
    gradient: Floats
    """(..., 3) g, half the derivative of chi2 by the pose."""
    chi2: Floats
    """(...) robust sum of squares of residual / sigma over the matched points."""
    matched: Ints
    """(...) how many points found a partner."""


@dataclass(frozen=True, slots=True, eq=False)
class LineRows:
    """Residuals of m matched points before they are summed up; all zero where a point has no partner."""

    jacobian: Floats
    """(3, m) of the residual by x, y, theta; 1, 1, m."""
    tangent: Floats
    """(3, m) the same for the line's tangent instead of its normal."""
    normal_variance: Floats
    """(m,) rad^2."""
    residual: Floats
    """(m,) m; zero where the partner has no line."""
    weight: Floats
    """(m,) of the robust kernel, 0..1."""
    cost: Floats
    """(m,) robust square of residual / sigma."""
    matched: Bools
    """(m,)."""


def source_rows(points: Floats, normals: Floats | None = None) -> Floats:
    """Return x, y and normal x, y (4, m) of source points (m, 2); a normal of zero is none."""
    rows = np.zeros((4, len(points)))
    rows[:2] = points.T
    if normals is not None:
        rows[2:] = normals.T
    return rows


def line_rows(
    target: PointCloud,
    raster: NearestRaster,
    source: Floats,
    pose: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike],
    config: LineFactorConfig,
    two_sided: bool,
) -> LineRows:
    """Associate source points with the target's lines and linearise.

    Parameters
    ----------
    target, raster : the cloud and its table of nearest points.
    source : (4, m) see source_rows.
    pose : cos theta, sin theta, x, y of T_target_source; each a number, or (m,) one for every point.
    two_sided : normals may also be opposite; for clouds without viewpoints.
    """
    c, s, tx, ty = pose
    px, py, nx, ny = source
    arm_x, arm_y = c * px - s * py, s * px + c * py
    x, y = arm_x + tx, arm_y + ty
    line_x, line_y, offset, qx, qy, variance, has_line = target.surface.take(raster.lookup(x, y), axis=1)
    agreement = (c * nx - s * ny) * line_x + (s * nx + c * ny) * line_y
    if two_sided:
        agreement = np.abs(agreement)
    # A missing normal is a zero vector and has no say.
    least = np.cos(config.max_normal_angle) * has_line * (nx * nx + ny * ny)
    dx, dy = x - qx, y - qy
    matched = (dx * dx + dy * dy <= config.gate**2) & (agreement >= least)
    residual = (line_x * x + line_y * y - offset) * matched
    squared = (residual / config.sigma) ** 2
    return LineRows(
        jacobian=np.stack([line_x, line_y, line_y * arm_x - line_x * arm_y]),
        tangent=np.stack([-line_y, line_x, line_x * arm_x + line_y * arm_y]),
        normal_variance=variance,
        residual=residual,
        weight=config.kernel.weight(squared) * matched,
        cost=config.kernel.rho(squared),
        matched=matched,
    )


def _outer_sum(rows: Floats, weight: Floats, starts: Ints | None) -> Floats:
    """Return sum of weight * rows rows^T of rows (3, m): (3, 3), or (k, 3, 3) by segments."""
    weighted = rows * weight
    if starts is None:
        return np.asarray(weighted @ rows.T)
    products = (weighted[:, None, :] * rows[None, :, :]).reshape(9, -1)
    return np.add.reduceat(products, starts, axis=1).T.reshape(-1, 3, 3)


def _sum(rows: Floats, starts: Ints | None) -> Floats:
    return np.asarray(rows.sum(axis=-1) if starts is None else np.add.reduceat(rows, starts, axis=-1))


def line_system(rows: LineRows, config: LineFactorConfig, starts: Ints | None = None) -> tuple[LineFactor, Floats]:
    """Sum rows to a Gauss-Newton system.

    Parameters
    ----------
    starts : (k,) where each pair's rows start, strictly increasing; None: all rows belong to one pair.

    Returns
    -------
    factor : nothing taken away.
    feigned : (..., 3, 3) N, the information that the scatter of the normals alone would feign.
    """
    scale = config.sigma**-2
    gradient = _sum(rows.jacobian * (rows.weight * rows.residual), starts).T * scale
    factor = LineFactor(
        information=_outer_sum(rows.jacobian, rows.weight, starts) * scale,
        gradient=gradient,
        chi2=_sum(rows.cost, starts),
        matched=_sum(rows.matched.astype(np.float64), starts).astype(np.int64),
    )
    return factor, _outer_sum(rows.tangent, rows.weight * rows.normal_variance, starts) * scale


def trusted_part(information: Floats, feigned: Floats, degeneracy: float) -> tuple[Floats, Floats]:
    """Take from an information matrix what the scatter of the normals may have feigned.

    In the basis that diagonalises both, H = B B^T diag(l) and N = B B^T, the eigenvalue l becomes
    max(l - degeneracy, 0); the result does not depend on units or on the frame.

    Parameters
    ----------
    information, feigned : (..., 3, 3) H and N.
    degeneracy : multiple of N that H must exceed.

    Returns
    -------
    trusted : (..., 3, 3), positive semi-definite, at most H.
    projector : (..., 3, 3) P that takes the gradient g to P g, so that trusted and P g have the step of H and g in
        trusted directions and none in the others.
    """
    if degeneracy == 0.0:
        return information, np.broadcast_to(np.eye(3), information.shape)
    basis, inverse, values, vectors = relative_eigen(information, feigned)
    kept = np.maximum(values - degeneracy, 0.0)
    left = basis @ vectors
    trusted = (left * kept[..., None, :]) @ np.swapaxes(left, -1, -2)
    share = kept / np.maximum(values, _TINY)
    return trusted, (left * share[..., None, :]) @ np.swapaxes(vectors, -1, -2) @ inverse


def trusted_step(information: Floats, feigned: Floats, gradient: Floats, degeneracy: float) -> Floats:
    """Return the Gauss-Newton step (3,) in trusted directions, none in the others; see trusted_part."""
    _, inverse, values, vectors = relative_eigen(information, feigned)
    divisor = np.where(values > max(degeneracy, _SOLVABLE), values, np.inf)
    return np.asarray(-inverse.T @ (vectors @ ((vectors.T @ (inverse @ gradient)) / divisor)))


def relative_eigen(information: Floats, feigned: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return B, its inverse, eigenvalues and eigenvectors of B^-1 H B^-T where N = B B^T, N kept from vanishing."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    xy = diagonal[..., 0] + diagonal[..., 1]
    floor = np.stack([xy, xy, diagonal[..., 2]], axis=-1) * _FEIGNED_FLOOR + _TINY
    basis = np.asarray(np.linalg.cholesky(feigned + floor[..., None] * np.eye(3)), dtype=np.float64)
    inverse = np.asarray(np.linalg.inv(basis), dtype=np.float64)
    values, vectors = np.linalg.eigh(inverse @ information @ np.swapaxes(inverse, -1, -2))
    return basis, inverse, values, vectors


def pair_factor(
    target: PointCloud, source: PointCloud, T_target_source: Floats, config: LineFactorConfig
) -> LineFactor:
    """Associate one source with a target once and linearise; see pair_factors."""
    batch = pair_factors(
        target, source.centers, source.normals, np.array([len(source)]), np.asarray(T_target_source)[None], config,
        two_sided=not source.oriented,
    )
    return LineFactor(batch.information[0], batch.gradient[0], batch.chi2[0], batch.matched[0])


def pair_factors(
    target: PointCloud,
    points: Floats,
    normals: Floats | None,
    counts: Ints,
    transforms: Floats,
    config: LineFactorConfig,
    two_sided: bool = False,
) -> LineFactor:
    """Associate k sources with one target once and linearise each pair.

    Parameters
    ----------
    target : cloud with lines.
    points : (m, 2) the sources' points (best: their centers) one source after the other, m, each in its own frame.
    normals : (m, 2) their normals, zero where a point has none; None: none has.
    counts : (k,) points of each source.
    transforms : (k, 3) T_target_source.
    config : which pairs count.
    two_sided : the sources' normals do not tell the sides of a wall.

    Returns
    -------
    LineFactor with leading axis k; without what the scatter of the normals feigns.
    """
    counts, transforms = np.asarray(counts), np.asarray(transforms, dtype=np.float64)
    k = len(counts)
    factor = LineFactor(np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros(k), np.zeros(k, np.int64))
    some = np.flatnonzero(counts)
    if len(some) == 0:
        return factor
    each = np.stack([np.cos(transforms[:, 2]), np.sin(transforms[:, 2]), transforms[:, 0], transforms[:, 1]])
    c, s, x, y = np.repeat(each, counts, axis=1)
    starts = (np.cumsum(counts) - counts)[some]
    rows = line_rows(
        target, target.raster(config.gate), source_rows(points, normals), (c, s, x, y), config,
        two_sided or not target.oriented,
    )
    system, feigned = line_system(rows, config, starts)
    trusted, projector = trusted_part(system.information, feigned, config.degeneracy)
    factor.information[some] = trusted
    factor.gradient[some] = (projector @ system.gradient[:, :, None])[:, :, 0]
    factor.chi2[some], factor.matched[some] = system.chi2, system.matched
    return factor
