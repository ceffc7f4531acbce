"""The likelihood of ranges at a pose: the factors' gradient, and moments that hold the truth."""

import numpy as np
from scipy.special import ndtr

from uwblite import se2
from uwblite.localization import range_likelihood
from uwblite.localization.window import Ranges


def some_ranges(seed):
    rng = np.random.default_rng(seed)
    places, tags = rng.uniform(-5, 5, (12, 2)), rng.uniform(-1, 1, (12, 2))
    pose = np.array([0.3, -0.4, 0.7])
    true = np.hypot(*(pose[:2] + se2.rotate(pose[2], tags) - places).T)
    return pose, Ranges(np.arange(12) % 3, places, tags, true + rng.normal(0, 0.2, 12), rng.uniform(0.1, 0.3, 12))


def test_factors_of_ranges_are_the_numeric_gradient_of_their_cost():
    for seed in range(3):
        pose, ranges = some_ranges(seed)
        pose = pose + np.array([0.1, -0.05, 0.03])

        def cost(x, ranges=ranges):
            error = range_likelihood.range_errors(x[None], ranges)[0][0]
            return 2.0 * range_likelihood._INDEPENDENT * np.log1p(np.square(error / (2.0 * ranges.sigma))).sum()

        steps = np.eye(3) * 1e-6
        gradient = [(cost(pose + s) - cost(pose - s)) / 2e-6 for s in steps]
        np.testing.assert_allclose(range_likelihood.range_factors(pose[None], ranges)[1][0], gradient, rtol=1e-4, atol=1e-5)


def test_moments_are_wide_where_the_ranges_say_little_and_hold_the_truth():
    pose, ranges = some_ranges(4)
    mean, covariance = range_likelihood.range_moments(range_likelihood.refined_by_ranges(pose[None], ranges)[0], ranges)
    off = mean - pose
    assert off @ np.linalg.solve(covariance, off) < 16.0
    near = np.abs(ranges.anchor) == 0
    less = range_likelihood.range_moments(pose, ranges.rows(np.flatnonzero(near)))[1]
    assert np.trace(less) > 2.0 * np.trace(covariance)


def test_the_errors_alone_are_those_of_the_factors():
    pose, ranges = some_ranges(5)
    poses = pose + np.random.default_rng(5).normal(0.0, 1.0, (20, 3))
    np.testing.assert_allclose(
        range_likelihood._misfits(poses, ranges), range_likelihood.range_errors(poses, ranges)[0], atol=1e-12
    )


def test_likelihoods_in_single_precision_are_those_in_double_to_a_hundredth():
    pose, ranges = some_ranges(6)
    poses = pose + np.random.default_rng(6).normal(0.0, 2.0, (200, 3))
    error = range_likelihood._misfits(poses, ranges)
    z = error / ranges.sigma
    terms = 0.7 * np.exp(-0.5 * z**2) + 0.3 * np.exp(-np.maximum(error, 0.0) / 0.5) * ndtr(z) + 0.02
    expected = range_likelihood._INDEPENDENT * np.log(terms).sum(axis=1)
    np.testing.assert_allclose(range_likelihood.range_likelihood(poses, ranges), expected, atol=0.01)
