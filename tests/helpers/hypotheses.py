"""Hypotheses of a pose with random covariances, and derivatives by differences."""

import numpy as np

from uwblite.localization import hypotheses
from uwblite.localization.hypotheses import FIRST_ANCHOR
from uwblite.localization.range_model import KnownAnchors


def a_bank(seed, anchors=2):
    rng = np.random.default_rng(seed)
    n = FIRST_ANCHOR + 2 * anchors
    root = rng.normal(size=(1, n, n)) * 0.01
    mean = np.concatenate([rng.normal(size=3), 0.02 * rng.normal(size=3), 0.05 * rng.normal(size=n - 6)])[None]
    return hypotheses.Hypotheses(mean, root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(n), np.zeros(1))


def anchors_at(places, sigma, bias_sigma=0.1, **more):
    """Return anchors at places (a, 2) that no calibration corrects, unless it is said."""
    count = len(places)
    stated = {"bias": np.zeros(count), "rise": np.zeros(count), **more}
    ids = tuple(f"A{k}" for k in range(count))
    return KnownAnchors(ids, places, sigma=np.full(count, sigma), bias_sigma=np.full(count, bias_sigma), **stated)


def numeric(function, x, step=1e-6):
    """Return the derivatives (m, n) of a function of x (n,)."""
    eye = np.eye(len(x)) * step
    return np.stack([(function(x + e) - function(x - e)) / (2 * step) for e in eye], axis=1)
