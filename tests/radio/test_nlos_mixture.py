"""Errors of ranges: core, detours and nonsense separated; late errors pull less than early ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.radio.nlos_mixture import RangeMixture, _densities, fit, shortest_half

shapes = st.builds(
    RangeMixture,
    st.floats(-1, 1),
    st.floats(0.02, 0.5),
    st.floats(0.0, 0.6),
    st.floats(1.0, 5.0),
    st.floats(0.0, 0.3),
    st.just(20.0),
)


def density(mixture, errors):
    """Return the density by scipy's distributions."""
    from scipy.stats import exponnorm, norm

    core = norm.pdf(errors, mixture.centre, mixture.sigma)
    late = exponnorm.pdf(errors, mixture.detour / mixture.sigma, mixture.centre, mixture.sigma)
    return (1 - mixture.tail - mixture.wild) * core + mixture.tail * late + mixture.wild / mixture.width


def draw(rng, n, tail=0.0, detour=0.3, wild=0.0, centre=0.1, sigma=0.07):
    """Return n errors of a mixture; nonsense lies between -10 and 20 m."""
    errors, kind = centre + sigma * rng.standard_normal(n), rng.random(n)
    errors = np.where(kind < tail, errors + rng.exponential(detour, n), errors)
    return np.where(kind > 1 - wild, rng.uniform(-10, 20, n), errors)


@given(shapes)
def test_the_probability_of_the_core_is_bayes(mixture):
    from scipy.stats import norm

    errors = mixture.centre + mixture.sigma * np.linspace(-5, 40, 181)
    core = (1 - mixture.tail - mixture.wild) * norm.pdf(errors, mixture.centre, mixture.sigma)
    total = density(mixture, errors)
    seen = total > 1e-200
    np.testing.assert_allclose(mixture.core(errors)[seen], (core / np.where(seen, total, 1.0))[seen], rtol=1e-6, atol=1e-9)


@given(shapes)
def test_the_density_is_that_of_its_three_parts(mixture):
    """Gross errors are as likely anywhere, and far from the core they are all that there is."""
    errors = mixture.centre + mixture.sigma * np.array([-200.0, -5.0, -1.0, 0.0, 2.0, 9.0, 400.0])
    np.testing.assert_allclose(mixture.density(errors), density(mixture, errors), rtol=1e-6, atol=1e-290)
    assert mixture.density(errors[:1])[0] == pytest.approx(mixture.wild / mixture.width, abs=1e-290)


@given(shapes)
def test_no_error_is_impossible(mixture):
    """However far from the core: of any number of ranges, one may be a gross error."""
    far = mixture.centre + mixture.sigma * np.array([-1000.0, -60.0])
    least = np.log(max(mixture.wild, 1e-3) / mixture.width)
    np.testing.assert_allclose(mixture.log_density(far), least, atol=1e-6)
    errors, floored = mixture.centre + mixture.sigma * np.linspace(-4.0, 9.0, 9), replace(mixture, wild=max(mixture.wild, 1e-3))
    np.testing.assert_allclose(mixture.log_density(errors), np.log(density(floored, errors)), atol=1e-6)


@given(st.floats(0.02, 0.5), st.floats(0.1, 5.0), st.floats(-6.0, 30.0))
def test_the_expected_detour_of_a_late_range_is_the_mean_over_all_detours(sigma, detour, error):
    """By the trapezoid over detours d: exp(-d / detour) times the core's density at what is left of the error."""
    off = error * sigma
    grid = np.linspace(0.0, max(off, 0.0) + 12.0 * sigma, 40001)
    log_weight = -grid / detour - 0.5 * ((off - grid) / sigma) ** 2
    weight = np.exp(log_weight - log_weight.max())
    expected = np.sum(weight * grid) / np.sum(weight)
    # The sum's step is sigma / 950 at most; half a step is how far its first cell errs.
    assert _densities(np.array([off]), sigma, detour)[2][0] == pytest.approx(expected, rel=5e-3, abs=2e-3 * sigma)


@given(shapes)
def test_the_mode_is_the_greatest_density(mixture):
    grid = mixture.centre + mixture.sigma * np.linspace(-1, 4, 5001)
    assert density(mixture, np.array([mixture.mode()]))[0] >= density(mixture, grid).max() * (1 - 1e-6)


@given(shapes)
def test_weights_are_the_slope_of_the_log_density(mixture):
    """Numeric derivative; near the mode the weight is its limit, and no weight leaves 0..1."""
    errors = mixture.centre + mixture.sigma * np.array([-6.0, -3.0, -1.0, 3.0, 6.0, 12.0])
    step = 1e-5 * mixture.sigma
    slope = -(np.log(density(mixture, errors + step)) - np.log(density(mixture, errors - step))) / (2 * step)
    expected = np.clip(mixture.sigma**2 * slope / (errors - mixture.mode()), 0, 1)
    np.testing.assert_allclose(mixture.weights(errors), expected, atol=2e-3)
    around = mixture.weights(mixture.mode() + mixture.sigma * np.linspace(-1e-2, 1e-2, 11))
    assert np.ptp(around) < 0.02
    assert np.all((around >= 0) & (around <= 1))


def test_without_tail_and_nonsense_every_error_counts_in_full():
    np.testing.assert_allclose(RangeMixture(0.2, 0.1, 0.0, 0.4, 0.0, 5.0).weights(np.linspace(-1, 1, 21)), 1.0)


def test_late_errors_pull_less_than_early_ones():
    mixture = RangeMixture(0.0, 0.1, 0.3, 0.5, 0.01, 10.0)
    off = np.array([0.2, 0.3, 0.5])
    assert np.all(mixture.weights(mixture.mode() + off) < 0.7 * mixture.weights(mixture.mode() - off[:1]))


@pytest.mark.parametrize(
    ("tail", "detour", "wild"), [(0.0, 0.3, 0.0), (0.3, 0.3, 0.0), (0.5, 0.8, 0.0), (0.2, 0.3, 0.3), (0.0, 0.3, 0.45)]
)
def test_the_parts_are_recovered(tail, detour, wild):
    """Mean of ten draws of 1000: shares scatter by sqrt(p (1 - p) / 10000) and are shrunk by 15 clean ranges in 1000; the
    core's mean and width by 0.07 / sqrt(5000), and a detour shorter than the core's width cannot be distinguished from it."""
    fits = [fit(draw(np.random.default_rng(k), 1000, tail, detour, wild), 0.03) for k in range(10)]
    assert np.mean([m.centre for m in fits]) == pytest.approx(0.1, abs=0.006)
    assert np.mean([m.sigma for m in fits]) == pytest.approx(0.07, abs=0.005)
    assert np.mean([m.tail for m in fits]) == pytest.approx(tail, abs=0.04)
    assert np.mean([m.wild for m in fits]) == pytest.approx(wild, abs=0.03)
    if tail:
        assert np.mean([m.detour for m in fits]) == pytest.approx(detour, rel=0.15)


@pytest.mark.parametrize(("tail", "detour", "wild"), [(0.3, 0.3, 0.0), (0.5, 0.8, 0.0), (0.2, 0.3, 0.3)])
def test_weighted_least_squares_finds_the_core_where_the_median_does_not(tail, detour, wild):
    """The mode lies a little after the core's mean, by less than 0.2 of its width."""
    errors = [draw(np.random.default_rng(k), 400, tail, detour, wild) for k in range(10)]
    weights = [fit(e, 0.03).weights(e) for e in errors]
    means = [w @ e / w.sum() for e, w in zip(errors, weights, strict=True)]
    assert abs(np.mean(means) - 0.1) < 0.2 * 0.07
    assert np.mean([np.median(e) for e in errors]) - 0.1 > 2.0 * (np.mean(means) - 0.1)


def test_outliers_of_four_tenths_are_no_part_of_the_core():
    rng = np.random.default_rng(0)
    for offset in (3.0, -3.0):
        errors = draw(rng, 300) + np.where(np.arange(300) < 120, offset, 0.0)
        mixture = fit(errors, 0.03)
        assert mixture.centre == pytest.approx(0.1, abs=0.02)
        assert np.all(mixture.weights(errors)[:120] < 0.05)


@pytest.mark.parametrize("errors", [[0.3], [0.3, 0.3], [0.1, 5.0, -2.0], [0.0] * 50])
def test_few_or_equal_errors_give_finite_answers(errors):
    mixture = fit(np.array(errors), 0.03)
    assert mixture.sigma >= 0.03
    assert np.all(np.isfinite(mixture.weights(np.array([*errors, 1e3, -1e3]))))
    assert 0.0 <= mixture.tail + mixture.wild < 1.0


def test_moving_all_errors_moves_the_core():
    errors = draw(np.random.default_rng(3), 200, 0.3)
    one, other = fit(errors, 0.03), fit(errors + 4.0, 0.03)
    assert other.centre - one.centre == pytest.approx(4.0, abs=1e-6)
    np.testing.assert_allclose(other.weights(errors + 4.0), one.weights(errors), atol=1e-6)


def test_the_shortest_half_of_a_normal_distribution_shows_its_width():
    values = 3.0 + 0.2 * np.random.default_rng(1).standard_normal(20000)
    middle, sigma = shortest_half(values)
    assert middle == pytest.approx(3.0, abs=0.05)
    assert sigma == pytest.approx(0.2, rel=0.05)
