"""Random functions of the place: smooth, so that neighbours get nearly the same value."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def smooth_field(rng: np.random.Generator, points: Floats, length: float, waves: int = 48) -> Floats:
    """Return a Gaussian random field (n,) of unit variance at points (n, 2), correlated over `length` m."""
    k = rng.standard_normal((waves, 2)) / length
    phase = rng.uniform(0.0, 2.0 * np.pi, waves)
    return np.sqrt(2.0 / waves) * np.cos(points @ k.T + phase).sum(axis=1)
