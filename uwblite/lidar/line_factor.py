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

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ..arrays import Bools, Floats
from ..config import setting
from ..graph.robust import Kernel
from .nearest import NearestRaster
from .point_cloud import PointCloud

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


@dataclass(frozen=True, slots=True, eq=False)
class LineFactor:
    """Gauss-Newton system of one pair by the coordinates x, y, theta of T_target_source."""

    information: Floats
    """(3, 3) H."""
    gradient: Floats
    """(3,) g, half the derivative of chi2 by the pose."""
    feigned: Floats
    """(3, 3) N, the information that the scatter of the normals alone would feign."""
    matched: int
    """How many points found a partner."""


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
    pose: Floats,
    config: LineFactorConfig,
    two_sided: bool,
) -> LineRows:
    """Associate source points with the target's lines and linearise.

    Parameters
    ----------
    target, raster : the cloud and its table of nearest points.
    source : (4, m) see source_rows.
    pose : (3,) T_target_source.
    two_sided : normals may also be opposite; for clouds without viewpoints.
    """
    tx, ty, theta = pose.tolist()
    c, s = math.cos(theta), math.sin(theta)
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
    return LineRows(
        jacobian=np.stack([line_x, line_y, line_y * arm_x - line_x * arm_y]),
        tangent=np.stack([-line_y, line_x, line_x * arm_x + line_y * arm_y]),
        normal_variance=variance,
        residual=residual,
        weight=config.kernel.weight(np.square(residual * (1.0 / config.sigma))) * matched,
        matched=matched,
    )


def line_system(rows: LineRows, config: LineFactorConfig) -> LineFactor:
    """Sum rows to a Gauss-Newton system, nothing taken away."""
    scale = config.sigma**-2
    weighted = rows.jacobian * (rows.weight * scale)
    return LineFactor(
        information=weighted @ rows.jacobian.T,
        gradient=weighted @ rows.residual,
        feigned=(rows.tangent * (rows.weight * rows.normal_variance * scale)) @ rows.tangent.T,
        matched=int(np.count_nonzero(rows.matched)),
    )


def trusted_part(information: Floats, feigned: Floats, degeneracy: float) -> Floats:
    """Take from an information matrix what the scatter of the normals may have feigned.

    In the basis that diagonalises both, H = B B^T diag(l) and N = B B^T, the eigenvalue l becomes
    max(l - degeneracy, 0); the result does not depend on units or on the frame.

    Parameters
    ----------
    information, feigned : (3, 3) H and N.
    degeneracy : multiple of N that H must exceed.

    Returns
    -------
    (3, 3), positive semi-definite, at most H.
    """
    if degeneracy == 0.0:
        return information
    basis, _, values, vectors = relative_eigen(information, feigned)
    left = basis @ vectors
    return np.asarray((left * np.maximum(values - degeneracy, 0.0)) @ left.T)


def trusted_step(information: Floats, feigned: Floats, gradient: Floats, degeneracy: float) -> Floats:
    """Return the Gauss-Newton step (3,) in trusted directions, none in the others; see trusted_part.

    With V that diagonalises both, V^T N V = 1 and V^T H V = diag(l), the step is -V diag(1 / l) V^T g over the trusted l.
    """
    values, vectors, failed = lapack.dsygv(information, feigned + np.diag(_floor(information)))
    if failed:
        return np.zeros(3)
    divisor = np.where(values > max(degeneracy, _SOLVABLE), values, np.inf)
    return np.asarray(-vectors @ ((vectors.T @ gradient) / divisor))


_FLOOR = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * _FEIGNED_FLOOR
"""Sums x and y, whatever the frame."""


def _floor(information: Floats) -> Floats:
    """Return what keeps the diagonal (..., 3) of N from vanishing."""
    return np.asarray(np.diagonal(information, axis1=-2, axis2=-1) @ _FLOOR + _TINY)


def relative_eigen(information: Floats, feigned: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return (..., 3, 3) B, its inverse, eigenvalues and eigenvectors of B^-1 H B^-T where N = B B^T, N kept from vanishing."""
    basis = np.asarray(np.linalg.cholesky(feigned + _floor(information)[..., None] * np.eye(3)), dtype=np.float64)
    inverse = np.asarray(np.linalg.inv(basis), dtype=np.float64)
    values, vectors = np.linalg.eigh(inverse @ information @ np.swapaxes(inverse, -1, -2))
    return basis, inverse, values, vectors
