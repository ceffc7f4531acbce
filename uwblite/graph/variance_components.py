"""Variances of errors that measurements have in common: by restricted maximum likelihood, with a prior.

Measurements with the residuals r = J x + S u + e leave, once the unknowns x are estimated, the part P r of r, where
P = W - W J (J^T W J)^-1 J^T W. All of its information about the common errors u is in y = S^T P r, for which, with A = S^T P S,

    y ~ N(0, n A + A G A),    G = diag of the variance g of each error's kind,    n = variance of e relative to W^-1

(H. D. Patterson, R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 1971). The
logarithms of n and g are found by Fisher scoring. Where y has no information about a kind, its variance keeps the prior.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..arrays import Floats, Ints

_FACTOR = np.log(4.0)
"""Prior standard deviation of the logarithm of a kind's variance: its size is known within a factor of two."""
_NOISE = np.log(10.0)
"""The same of the scale of the noise, whose variances are conservative guesses."""
_UNSEEN = 1e-9
"""Eigenvalue of A, or share of a largest one above 1, below which a direction counts as unmeasured: it is the information about
an error of the assumed size relative to the noise."""
_ROUNDS, _NEGLIGIBLE, _LONGEST = 50, 1e-3, 1.0
"""Most rounds; change of all logarithms that ends them; longest step in a logarithm."""


def variances_of_kinds(y: Floats, a: Floats, kind: Ints) -> Floats:
    """Return the expected variance (g,) of each kind of common errors, relative to the one assumed.

    Parameters
    ----------
    y : (k,) S^T P r of the errors, each scaled to the variance assumed.
    a : (k, k) S^T P S.
    kind : (k,) of each error, counted from 0.
    """
    kinds = int(kind.max(initial=-1)) + 1
    values, vectors = np.linalg.eigh(a)
    seen = values > _UNSEEN * values.max(initial=1.0)
    if not seen.any():
        return np.ones(kinds)
    root = np.sqrt(values[seen])
    z = vectors[:, seen].T @ y / root
    columns = root[:, None] * vectors[:, seen].T
    parts = np.stack([np.eye(len(z)), *(columns[:, kind == g] @ columns[:, kind == g].T for g in range(kinds))])
    width = np.append(_NOISE, np.full(kinds, _FACTOR))
    # The mean of a variance whose logarithm is normal about -width^2 / 2 is the one assumed.
    mean = np.append(0.0, -0.5 * width[1:] ** 2)
    logs = mean.copy()
    for _ in range(_ROUNDS):
        slope, curvature = _slope(z, parts * np.exp(logs)[:, None, None])
        precision = curvature + np.diag(width**-2.0)
        step = -np.linalg.solve(precision, slope + (logs - mean) / width**2)
        logs = logs + step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
        if np.all(np.abs(step) < _NEGLIGIBLE):
            break
    spread = np.diagonal(np.linalg.inv(precision))
    return np.exp(logs[1:] + 0.5 * spread[1:])


def _slope(z: Floats, parts: Floats) -> tuple[Floats, Floats]:
    """Return the slope (p,) and expected curvature (p, p) of -log N(z; 0, sum of parts (p, m, m)) by the parts' logarithms."""
    factor = cho_factor(parts.sum(axis=0))
    whitened = np.stack([cho_solve(factor, part) for part in parts])
    explained = cho_solve(factor, z)
    slope = 0.5 * (np.trace(whitened, axis1=1, axis2=2) - np.einsum("i,pij,j->p", explained, parts, explained))
    return slope, 0.5 * np.einsum("pij,qji->pq", whitened, whitened)
