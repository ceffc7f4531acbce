"""The likelihood of ranges at a pose: the factors' gradient, and moments that hold the truth."""

from dataclasses import replace

import numpy as np

from uwblite import se2
from uwblite.localization import range_model
from uwblite.localization.range_model import Ranges
from uwblite.radio.nlos_mixture import RangeMixture
from uwblite.radio.range_errors import RangeErrors
from uwblite.radio.range_noise import RangeNoise


def some_ranges(seed):
    rng = np.random.default_rng(seed)
    places, tags = rng.uniform(-5, 5, (12, 2)), rng.uniform(-1, 1, (12, 2))
    pose = np.array([0.3, -0.4, 0.7])
    true = np.hypot(*(pose[:2] + se2.rotate(pose[2], tags) - places).T)
    noise = rng.uniform(0.1, 0.3, 12), np.arange(12.0), np.full(12, 0.08), np.full(12, 1.5)
    return pose, Ranges(np.arange(12) % 3, places, tags, true + rng.normal(0, 0.2, 12), *noise)


def test_factors_of_ranges_are_the_numeric_gradient_of_their_cost():
    for seed in range(3):
        pose, ranges = some_ranges(seed)
        pose = pose + np.array([0.1, -0.05, 0.03])

        def cost(x, ranges=ranges):
            error = range_model.range_errors(x[None], ranges)[0][0]
            share = range_model.series(ranges).share
            return 2.0 * (share * np.log1p(np.square(error / (2.0 * ranges.sigma)))).sum()

        steps = np.eye(3) * 1e-6
        gradient = [(cost(pose + s) - cost(pose - s)) / 2e-6 for s in steps]
        np.testing.assert_allclose(range_model.range_factors(pose[None], ranges)[1][0], gradient, rtol=1e-4, atol=1e-5)


def test_likelihoods_in_single_precision_are_those_in_double_to_a_thousandth():
    pose, ranges = some_ranges(6)
    poses = pose + np.random.default_rng(6).normal(0.0, 2.0, (200, 3))
    error = range_model.range_errors(poses, ranges)[0]
    # Of all, a fifth has a detour, 0.03 are an echo's, and 0.03 anything.
    parts = (0.2, 0.5, 0.06, 120.0), (1.0, 4.0, 0.0, 1.0)
    detours, echoes = ([RangeMixture(0.0, sigma, *part) for sigma in ranges.sigma] for part in parts)
    densities = [d.density(e) + 0.03 * m.density(e) for d, m, e in zip(detours, echoes, error.T, strict=True)]
    terms = np.stack(densities, axis=1) * ranges.sigma * np.sqrt(2.0 * np.pi)
    # One after another: the error stays what it was, or is drawn anew.
    chain = range_model.series(ranges)
    for k in range(3, 12):
        jump, stay = (error[:, k] - error[:, k - 3]) / chain.change[k], chain.stay[k]
        terms[:, k] = (1.0 - stay) * terms[:, k] + stay * ranges.sigma[k] / chain.change[k] * np.exp(-0.5 * jump**2)
    expected = np.log(terms).sum(axis=1)
    np.testing.assert_allclose(range_model.range_likelihood(poses, ranges), expected, rtol=1e-3, atol=0.01)


def test_an_error_that_lasts_costs_once_and_one_that_jumps_costs_each_time():
    pose, ranges = some_ranges(3)
    near = replace(ranges, way=0.1 * np.arange(12), tags=np.zeros((12, 2)), values=np.hypot(*(pose[:2] - ranges.places).T))
    costs = []
    for times in ((0,), (0, 3, 6, 9), (3, 9)):
        late = np.isin(np.arange(12), times) * 0.8
        costs.append(float(range_model.range_likelihood(pose[None], replace(near, values=near.values + late))[0]))
    exact = float(range_model.range_likelihood(pose[None], near)[0])
    # It comes and goes once; it comes once; it comes and goes twice.
    once, lasting, twice = (exact - cost for cost in costs)
    assert 0.0 < lasting < once < 0.6 * twice


def test_the_stay_is_the_renewal_law_whatever_the_steps_are():
    """The probability that an error has lasted over several ranges is that over their whole way, less gross errors."""
    _, ranges = some_ranges(1)
    still = replace(ranges, tags=np.zeros((12, 2)))
    many = range_model.series(still).stay[3::3].prod()
    one = range_model.series(still.rows(np.array([0, 9]))).stay[1]
    np.testing.assert_allclose(many / 0.97**3, one / 0.97, rtol=1e-9)
    first = range_model.series(replace(still, way=0.1 * still.way))
    np.testing.assert_array_equal(first.before[:4], [0, 1, 2, 0])
    np.testing.assert_array_equal(first.share[:3], 1.0)
    assert (first.share[3:] < 1.0).all()


def test_two_tags_that_measure_at_once_are_two_places():
    _, ranges = some_ranges(1)
    two = replace(ranges.rows(np.array([0, 3])), way=np.zeros(2), tags=np.array([[0.0, 0.0], [0.4, 0.0]]))
    np.testing.assert_allclose(range_model.series(two).stay[1], 0.97 * np.exp(-0.4 / 1.5))


def test_errors_that_the_map_s_own_ranges_had_at_a_place_are_expected_there():
    pose, ranges = some_ranges(8)
    exact = np.hypot(*(pose[:2] + se2.rotate(pose[2], ranges.tags) - ranges.places).T)
    rng = np.random.default_rng(9)
    noise = RangeNoise(0.05, 0.08, 2.0)
    fields = tuple(RangeErrors(np.array([-3.0, -3.0]), 0.5, rng.normal(0.1, 0.2, (15, 15)), noise) for _ in range(3))
    poses = pose + np.array([[0.0, 0.0, 0.0], [0.7, -0.2, 1.0]])
    expected = range_model.expected_errors(poses, ranges, fields)
    tags = pose[:2] + se2.rotate(pose[2], ranges.tags)
    one_by_one = [float(fields[a].at(tag)) for a, tag in zip(ranges.anchor, tags, strict=True)]
    np.testing.assert_allclose(expected[0], one_by_one, atol=1e-12)
    late = replace(ranges, values=exact + one_by_one)
    best = range_model.range_likelihood(pose[None], late, expected=expected[:1])
    none = range_model.range_likelihood(pose[None], replace(ranges, values=exact), expected=np.zeros((1, 12)))
    np.testing.assert_allclose(best, none, rtol=1e-4)
    assert best[0] > range_model.range_likelihood(pose[None], late)[0] + 1.0


def test_an_echo_of_metres_is_likelier_than_a_range_that_is_as_much_too_short_or_far_too_long():
    errors = np.array([6.0, -6.0, 25.0])
    _, (long, short, far) = range_model.mixture(errors, np.full(3, 0.17))
    assert long > 3.0 * short
    assert long > 3.0 * far
