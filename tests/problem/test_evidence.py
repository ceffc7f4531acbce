"""Evidence: the formula for another prior against an integral, and Laplace's against that of linear measurements."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from uwblite.problem.evidence import log_marginal_likelihood, log_odds_by_parts, log_odds_of_constant, without_prior


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


PRIOR = 0.1


def test_without_scatter_they_are_the_bayes_factor():
    """Scatters far below the noise change nothing: N(y; 0, S + D^2) against N(y; 0, S)."""
    rng = np.random.default_rng(2)
    sigmas = rng.uniform(0.5, 2.0, 4)
    values = rng.normal(size=4) * sigmas
    factor = multivariate_normal.logpdf(values, cov=np.diag(sigmas**2) + 1e-6) - multivariate_normal.logpdf(
        values, cov=np.diag(sigmas**2)
    )
    assert log_odds_by_parts(values, sigmas, 1e-3) == pytest.approx(factor, abs=0.01)


def test_scatter_is_integrated_out_with_a_uniform_prior_of_its_logarithm():
    values, sigmas = np.array([0.06, 0.09, 0.02]), np.array([0.01, 0.02, 0.01])
    low, high = 0.01 * 0.01, 10.0 * PRIOR

    def likelihood(logarithm, constant):
        variance = sigmas**2 + np.exp(logarithm) ** 2
        return multivariate_normal.pdf(values, cov=np.diag(variance) + constant * PRIOR**2)

    with_it, without = (quad(likelihood, np.log(low), np.log(high), args=(c,), limit=200)[0] for c in (1.0, 0.0))
    assert log_odds_by_parts(values, sigmas, PRIOR) == pytest.approx(np.log(with_it / without), abs=0.1)


def test_odds_of_a_constant_are_what_they_say():
    """Of planted pairs, with and without a constant of the prior's size, those of odds 9 have one nine times in ten."""
    rng = np.random.default_rng(3)
    planted = rng.random(3000) < 0.5
    sigma = np.full(8, 0.02)
    odds = np.array([
        log_odds_of_constant(PRIOR * rng.normal() * there + rng.normal(size=8) * sigma, sigma, PRIOR) for there in planted
    ])  # fmt: skip
    sure = odds > np.log(9.0)
    assert sure.sum() > 300
    assert planted[sure].mean() > 0.97
    assert planted[odds < 0.0].mean() < 0.3


@pytest.mark.parametrize(("values", "taken"), [
    (np.full(8, 0.05), True), (np.repeat([0.1, 0.0], 4), False), (np.tile([0.1, -0.1], 4), False), (np.zeros(8), False),
    (0.09 + 0.02 * np.cos(np.arange(8)), True), (np.array([0.4, *np.zeros(7)]), False),
])  # fmt: skip
def test_a_value_that_changes_with_the_parts_or_the_halves_is_no_constant(values, taken):
    """Each part shows it to 5 ms; the prior is 0.1 s."""
    assert (log_odds_of_constant(values, np.full(8, 0.005), PRIOR) > np.log(3.0)) == taken


def test_parts_that_show_nothing_do_not_count():
    values, sigmas = np.full(8, 0.05), np.full(8, 0.005)
    with_blind = log_odds_of_constant(np.append(values, [0.0, 0.0]), np.append(sigmas, [np.inf, np.inf]), PRIOR)
    assert with_blind > np.log(3.0)
    assert log_odds_of_constant(np.zeros(4), np.full(4, np.inf), PRIOR) == pytest.approx(0.0, abs=1e-6)


def test_the_prior_is_taken_out_of_an_estimate():
    """A product of normal densities is one: that of measurement and prior, parted again."""
    value, sigma = 0.07, 0.04
    precision = sigma**-2.0 + PRIOR**-2.0
    both = np.array([value * sigma**-2.0 / precision]), np.array([precision**-0.5])
    np.testing.assert_allclose(np.concatenate(without_prior(*both, PRIOR)), [value, sigma])
    nothing = without_prior(np.zeros(1), np.array([PRIOR]), PRIOR)
    assert (nothing[0][0], nothing[1][0]) == (0.0, np.inf)
