"""Hypotheses of a pose with random covariances, and derivatives by differences."""

import numpy as np

from uwblite.localization import hypotheses
from uwblite.localization.hypotheses import FIRST_ANCHOR


def a_bank(seed, anchors=2):
    rng = np.random.default_rng(seed)
    n = FIRST_ANCHOR + 2 * anchors
    root = rng.normal(size=(1, n, n)) * 0.01
    mean = np.concatenate([rng.normal(size=3), 0.02 * rng.normal(size=3), 0.05 * rng.normal(size=n - 6)])[None]
    return hypotheses.Hypotheses(mean, root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(n), np.zeros(1))


def numeric(function, x, step=1e-6):
    """Return the derivatives (m, n) of a function of x (n,)."""
    eye = np.eye(len(x)) * step
    return np.stack([(function(x + e) - function(x - e)) / (2 * step) for e in eye], axis=1)
