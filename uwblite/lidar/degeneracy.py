"""Degenerate directions of a registration: those in which only the scatter of the normals seems to constrain a pose.

Scattered normals of a wall add spurious information about the motion along it. With the variance v of a normal's
angle and the Jacobian J_t of the tangent, N = sum w v J_t^T J_t is the spurious information of scatter alone. In
the basis B that diagonalises both, H = B V diag(l) V^T B^T and N = B B^T, a direction was measured where its l exceeds
a multiple of 1. That depends neither on units nor on the frame.
"""

import numpy as np

from ..arrays import Floats

_FLOOR = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-9
"""N is at least this share of H's diagonal: without any scatter a direction is measured up to the inverse of it. Sums x
and y, whatever the frame."""
_TINY = 1e-30
MEASURED = 2.0
"""Multiple of the spurious information that a direction must exceed to have been measured."""


def relative_eigen(information: Floats, spurious: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return (..., 3, 3) B, its inverse, eigenvalues and eigenvectors of B^-1 H B^-T where N = B B^T, N kept from vanishing."""
    basis = np.asarray(np.linalg.cholesky(spurious + _floor(information)[..., None] * np.eye(3)), dtype=np.float64)
    inverse = _inverse(basis)
    values, vectors = np.linalg.eigh(inverse @ information @ np.swapaxes(inverse, -1, -2))
    return basis, inverse, values, vectors


def measured_part(information: Floats, spurious: Floats, gradient: Floats) -> tuple[Floats, Floats]:
    """Return information (..., 3, 3) and gradient (..., 3) without the part that the scatter of the normals may have added.

    A direction keeps its Gauss-Newton step with the share 1 - MEASURED / l of its information, none where l is below MEASURED.
    """
    basis, inverse, values, vectors = relative_eigen(information, spurious)
    kept = np.maximum(1.0 - MEASURED / np.maximum(values, _TINY), 0.0)
    share = (basis @ vectors * kept[..., None, :]) @ (np.swapaxes(vectors, -1, -2) @ inverse)
    return share @ information, (share @ gradient[..., None])[..., 0]


def _inverse(lower: Floats) -> Floats:
    """Return the inverse of lower triangular matrices (..., 3, 3), in a tenth of the time of a general one."""
    x, y, z = (1.0 / lower[..., k, k] for k in range(3))
    inverse = np.zeros_like(lower)
    inverse[..., 0, 0], inverse[..., 1, 1], inverse[..., 2, 2] = x, y, z
    inverse[..., 1, 0], inverse[..., 2, 1] = -lower[..., 1, 0] * x * y, -lower[..., 2, 1] * y * z
    inverse[..., 2, 0] = (lower[..., 1, 0] * lower[..., 2, 1] * y - lower[..., 2, 0]) * x * z
    return inverse


def _floor(information: Floats) -> Floats:
    """Return what keeps the diagonal (..., 3) of N from vanishing."""
    return np.asarray(np.diagonal(information, axis1=-2, axis2=-1) @ _FLOOR + _TINY)
