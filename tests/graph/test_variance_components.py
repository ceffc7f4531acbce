"""Sizes of common errors: against planted ones, the prior, and numeric derivatives."""

import numpy as np
import pytest
from scipy.optimize import minimize

from uwblite.graph.variance_components import _slope, variances_of_kinds


def seen(rng, variances, noise, measurements=300, unknowns=30, each=40):
    """Return y, A and kinds of a linear problem J x + S u + e with errors of these variances by kind."""
    kind = np.repeat(np.arange(len(variances)), each)
    jacobian, shifts = rng.normal(size=(measurements, unknowns)), rng.normal(size=(measurements, len(kind)))
    errors = shifts @ (np.sqrt(np.asarray(variances)[kind]) * rng.standard_normal(len(kind)))
    data = jacobian @ rng.normal(size=unknowns) * 10.0 + errors + np.sqrt(noise) * rng.standard_normal(measurements)
    projection = np.eye(measurements) - jacobian @ np.linalg.pinv(jacobian)
    return shifts.T @ projection @ data, shifts.T @ projection @ shifts, kind


@pytest.mark.parametrize("noise", [0.05, 1.0])
@pytest.mark.parametrize("variances", [(1.0,), (0.1, 0.5), (2.0, 0.02)])
def test_planted_variances_are_found(variances, noise):
    """40 errors of a kind show their variance to sqrt(2 / 40) = 22 %: the mean over ten draws to 7 %, and the prior, of 1.4 in
    the logarithm, draws it by 2.5 % of its own distance."""
    rng = np.random.default_rng(1)
    found = np.mean([variances_of_kinds(*seen(rng, variances, noise)) for _ in range(10)], axis=0)
    np.testing.assert_allclose(found, variances, rtol=0.3)


def test_what_is_not_seen_is_as_assumed():
    """No direction at all; one kind of two of which nothing is seen; and errors far below the noise."""
    np.testing.assert_array_equal(variances_of_kinds(np.zeros(3), np.zeros((3, 3)), np.array([0, 1, 1])), 1.0)
    y, a, kind = seen(np.random.default_rng(2), (0.3, 0.3), 0.1)
    y[kind == 1], a[kind == 1], a[:, kind == 1] = 0.0, 0.0, 0.0
    assert variances_of_kinds(y, a, kind)[1] == pytest.approx(1.0, rel=1e-6)
    assert variances_of_kinds(1e-4 * y, 1e-8 * a, kind)[0] == pytest.approx(1.0, rel=0.01)


def test_slope_is_that_of_the_likelihood():
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(3, 5, 5))
    parts, z = roots @ roots.transpose(0, 2, 1), rng.normal(size=5)

    def cost(logs):
        covariance = np.tensordot(np.exp(logs), parts, axes=1)
        return 0.5 * (np.linalg.slogdet(covariance)[1] + z @ np.linalg.solve(covariance, z))

    slope, curvature = _slope(z, parts)
    numeric = [(cost(step) - cost(-step)) / 2e-5 for step in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(slope, numeric, rtol=1e-6, atol=1e-8)
    # Scaling all parts together is one direction of curvature m / 2 whatever they are.
    assert curvature.sum() == pytest.approx(2.5)


@pytest.mark.parametrize("seed", range(3))
def test_variances_are_the_means_about_the_most_likely_logarithms(seed):
    """Few errors, so that the priors count: against a minimiser of likelihood and priors that knows no derivatives."""
    y, a, kind = seen(np.random.default_rng(seed), (0.2, 3.0), 0.5, measurements=20, unknowns=4, each=3)
    values, vectors = np.linalg.eigh(a)
    root, basis = np.sqrt(values), vectors.T
    z, columns = basis @ y / root, root[:, None] * basis
    parts = np.stack([np.eye(len(z)), *(columns[:, kind == g] @ columns[:, kind == g].T for g in range(2))])
    width = np.log([10.0, 4.0, 4.0])
    mean = np.array([0.0, *(-0.5 * width[1:] ** 2)])

    def cost(logs):
        covariance = np.tensordot(np.exp(logs), parts, axes=1)
        fit = np.linalg.slogdet(covariance)[1] + z @ np.linalg.solve(covariance, z)
        return 0.5 * (fit + np.sum(((logs - mean) / width) ** 2))

    best = minimize(cost, mean, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-10, "maxiter": 5000}).x
    curvature = _slope(z, parts * np.exp(best)[:, None, None])[1]
    spread = np.diag(np.linalg.inv(curvature + np.diag(width**-2)))
    # The rounds end where no logarithm changes by a thousandth.
    np.testing.assert_allclose(variances_of_kinds(y, a, kind), np.exp(best + 0.5 * spread)[1:], rtol=5e-3)
