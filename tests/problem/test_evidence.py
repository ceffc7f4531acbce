"""Evidence: the formula for another prior against an integral, and Laplace's against that of linear measurements."""

import numpy as np
import pytest

from uwblite.problem.evidence import log_marginal_likelihood


@pytest.mark.parametrize("seed", range(6))
def test_marginal_likelihood_is_the_integral_over_the_unknowns(seed):
    """Linear measurements y = A x + noise: log N(y; 0, A D A^T + R) under either prior, and their difference."""
    rng = np.random.default_rng(seed)
    a, noise = rng.normal(size=(7, 3)), 0.3
    before, after = rng.uniform(0.3, 2.0, 3), rng.uniform(0.05, 2.0, 3)
    y = a @ (rng.normal(size=3) * after) + noise * rng.normal(size=7)
    covariance = np.linalg.inv(a.T @ a / noise**2 + np.diag(before**-2.0))
    mean = covariance @ a.T @ y / noise**2

    def direct(width):
        from scipy.stats import multivariate_normal

        return multivariate_normal.logpdf(y, np.zeros(7), a @ np.diag(width**2) @ a.T + noise**2 * np.eye(7))

    assert log_marginal_likelihood(mean, covariance, before, after) == pytest.approx(direct(after) - direct(before), abs=1e-8)


def test_the_prior_in_use_is_the_measure_of_others():
    covariance, width = np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([0.5, 0.7])
    assert log_marginal_likelihood(np.array([0.3, -0.1]), covariance, width, width) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("precision", [1.0, 0.5])
def test_a_prior_under_which_the_unknowns_are_not_determined_is_impossible(precision):
    """The prior in use is all that holds them, or more than that by roundoff; the other one says nothing."""
    assert log_marginal_likelihood(np.ones(1), np.full((1, 1), 1.0 / precision), np.ones(1), np.full(1, np.inf)) == -np.inf
