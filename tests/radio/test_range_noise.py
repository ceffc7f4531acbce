"""Noise of ranges: white and slow part separated, and what many alike ranges weigh together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.radio.range_noise import (
    RangeNoise,
    RangeNoiseConfig,
    _covariance_by_distance,
    _fit,
    assumed,
    effective_sigma,
    learn,
    short_term_sigma,
    steady_sigma,
)

CONFIG = RangeNoiseConfig(sigma=0.2, slow_share=0.4, correlation_length=2.0, min_sigma=0.01, learn=True)


def field(rng, positions, slow, length):
    """Return a draw (m,) of the slow part: covariance slow^2 exp(-d / length)."""
    distance = np.hypot(*(positions[:, None, :] - positions[None, :, :]).transpose(2, 0, 1))
    root = np.linalg.cholesky(np.exp(-distance / length) + 1e-9 * np.eye(len(positions)))
    return slow * (root @ rng.standard_normal(len(positions)))


def test_the_assumption_has_the_stated_variance_and_share():
    noise = assumed(CONFIG)
    assert noise.sigma == pytest.approx(CONFIG.sigma)
    assert noise.slow**2 == pytest.approx(CONFIG.slow_share * CONFIG.sigma**2)
    assert noise.length == CONFIG.correlation_length


SPLITS = [(0.03, 0.08, 1.5), (0.08, 0.03, 2.0), (0.02, 0.10, 0.5)]


@pytest.mark.parametrize(("white", "slow", "length"), SPLITS)
def test_white_and_slow_part_are_recovered(white, slow, length):
    """Mean of six draws in 30 x 30 m.

    A draw holds about N = area / (2 pi length^2) independent patches, so its slow variance scatters by sqrt(2 / N); the
    pairs' products add variance^2 sqrt(2 / pairs) with thousands of pairs, which is smaller.
    """
    learnt = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        positions = rng.uniform(0, 30, (900, 2))
        errors = 0.5 + field(rng, positions, slow, length) + white * rng.standard_normal(900)
        learnt.append(learn(positions, errors, np.ones(900), CONFIG))
    patches = 6 * 900.0 / (2 * np.pi * length**2)
    scatter = slow**2 * np.sqrt(2 / patches)
    total = np.mean([n.sigma**2 for n in learnt])
    assert abs(total - white**2 - slow**2) < 3 * (scatter + white**2 * np.sqrt(2 / 5400))
    # Splitting needs the covariance near distance 0, known to a few per cent of the whole variance besides.
    assert abs(np.mean([n.slow**2 for n in learnt]) - slow**2) < 3 * scatter + 0.1 * (white**2 + slow**2)
    assert length / 2 < np.median([n.length for n in learnt]) < length * 2


def test_white_noise_alone_shows_hardly_any_slow_part():
    rng = np.random.default_rng(1)
    positions = rng.uniform(0, 20, (1200, 2))
    noise = learn(positions, 0.1 * rng.standard_normal(1200), np.ones(1200), CONFIG)
    assert noise.sigma == pytest.approx(0.1, rel=3 / np.sqrt(2 * 1200) + 0.01)
    assert noise.slow**2 < 0.15 * 0.1**2


def test_outliers_of_weight_zero_do_not_count_and_a_constant_neither():
    rng = np.random.default_rng(2)
    positions, errors = rng.uniform(0, 10, (400, 2)), 0.1 * rng.standard_normal(400)
    weights = (rng.random(400) > 0.2).astype(float)
    wild = np.where(weights > 0, errors, 50.0)
    one, other = learn(positions, errors, weights, CONFIG), learn(positions, wild + 3.0, weights, CONFIG)
    assert (one.white, one.slow, one.length) == pytest.approx((other.white, other.slow, other.length), rel=1e-9)


def test_covariances_by_distance_are_those_of_a_loop_over_pairs():
    """Places on a grid of 1 m: some pairs lie on the bounds of the bins, the last of which holds its upper one."""
    rng = np.random.default_rng(6)
    p, e, edges = rng.integers(0, 8, (60, 2)).astype(float), rng.standard_normal(60), np.array([0.0, 0.5, 1.0, 3.0, 6.0])
    first, second = np.triu_indices(60, 1)
    distance, products = np.hypot(*(p[first] - p[second]).T), e[first] * e[second]
    assert np.any(distance == 6.0)
    upper = [0.5, 1.0, 3.0, 6.0 + 1e-9]
    inside = [(distance >= a) & (distance < b) for a, b in zip(edges[:-1], upper, strict=True)]
    covariance, pairs = _covariance_by_distance(p, e, edges)
    assert pairs.tolist() == [i.sum() for i in inside]
    np.testing.assert_allclose(covariance, [products[i].sum() / max(i.sum(), 1) for i in inside])


@pytest.mark.filterwarnings("error")
def test_distances_at_which_there_is_no_pair_teach_nothing():
    """Places 4 m apart, each visited by a cluster of half a metre: pairs at 0 to 0.5 m and beyond 3 m, none between."""
    rng = np.random.default_rng(3)
    corner = 4.0 * np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2)
    place = np.repeat(np.arange(len(corner)), 8)
    positions = corner[place] + rng.uniform(-0.18, 0.18, (len(place), 2))
    errors = 0.15 * rng.standard_normal(len(corner))[place] + 0.05 * rng.standard_normal(len(place))
    noise = learn(positions, errors, np.ones(len(place)), CONFIG)
    # 144 patches know the slow variance to sqrt(2 / 144) = 12 %; what a cluster has in common is exp(-0.2 m / length).
    assert noise.slow == pytest.approx(0.15, rel=0.2)
    assert noise.white == pytest.approx(0.05, rel=0.5)


GRID = 0.7 * np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("places", [np.zeros((100, 2)), np.repeat([[0.0, 0.0], [0.4, 0.0]], 50, axis=0), GRID])
def test_too_few_distances_leave_the_assumption(places):
    """One place, two of them, and many of which none has another within half a metre."""
    noise = learn(places, 0.1 * np.random.default_rng(4).standard_normal(len(places)), np.ones(len(places)), CONFIG)
    assert (noise.white, noise.slow, noise.length) == (assumed(CONFIG).white, assumed(CONFIG).slow, assumed(CONFIG).length)


def test_thirty_ranges_are_enough():
    rng = np.random.default_rng(0)
    noise = learn(rng.uniform(0, 1, (30, 2)), rng.standard_normal(30), np.ones(30), CONFIG)
    assert noise.sigma > 2.0 * assumed(CONFIG).sigma


@pytest.mark.parametrize("count", [0, 5, 29])
def test_too_few_ranges_leave_the_assumption(count):
    rng = np.random.default_rng(0)
    noise = learn(rng.uniform(0, 1, (count, 2)), rng.standard_normal(count), np.ones(count), CONFIG)
    assert (noise.white, noise.slow, noise.length) == (assumed(CONFIG).white, assumed(CONFIG).slow, assumed(CONFIG).length)


def test_learning_can_be_switched_off():
    rng = np.random.default_rng(0)
    noise = learn(rng.uniform(0, 5, (200, 2)), rng.standard_normal(200), np.ones(200), replace(CONFIG, learn=False))
    assert noise.sigma == pytest.approx(CONFIG.sigma)


def test_no_radio_is_weighted_beyond_the_least_sigma():
    rng = np.random.default_rng(0)
    config = replace(CONFIG, min_sigma=0.05)
    noise = learn(rng.uniform(0, 10, (300, 2)), 1e-6 * rng.standard_normal(300), np.ones(300), config)
    assert noise.sigma >= 0.05 * 0.999


@given(st.integers(1, 500), st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.3, 5.0))
def test_coincident_ranges_weigh_as_one_draw_of_the_slow_part(n, white, slow, length):
    sigma = effective_sigma(np.tile([3.3, -1.7], (n, 1)), RangeNoise(white, slow, length))
    assert np.sum(sigma**-2.0) == pytest.approx(1.0 / (white**2 / n + slow**2), rel=1e-9)


@given(st.integers(0, 40), st.floats(0.3, 3.0))
def test_distant_places_count_each_for_itself(seed, length):
    places = np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) * 6.0 * length
    sigma = effective_sigma(np.repeat(places, 3, axis=0), RangeNoise(0.1, 0.2, length))
    np.testing.assert_allclose(sigma, np.sqrt(0.1**2 + 3 * 0.2**2))


@given(st.integers(0, 40))
def test_alike_ranges_are_counted_as_by_brute_force(seed):
    """Cells of length / 4 move every place by at most length / 8 in x and y: factors up to exp(sqrt(2) / 4); beyond four
    lengths, where exp(-d / length) < 0.02, nothing is counted."""
    rng = np.random.default_rng(seed)
    noise = RangeNoise(0.0, 1.0, 1.3)
    positions = rng.uniform(-4, 4, (150, 2))
    distance = np.hypot(*(positions[:, None] - positions[None]).transpose(2, 0, 1))
    counted = np.exp(-distance / noise.length).sum(axis=1)
    near = np.where(distance < 3.6 * noise.length, np.exp(-distance / noise.length), 0.0).sum(axis=1)
    variance = effective_sigma(positions, noise) ** 2
    worst = np.exp(np.sqrt(2) / 4)
    assert np.all(variance <= counted * worst)
    assert np.all(variance >= near / worst)
    assert abs(np.mean(variance / counted) - 1) < 0.05


def test_without_a_slow_part_every_range_counts_in_full():
    np.testing.assert_allclose(effective_sigma(np.zeros((5, 2)), RangeNoise(0.1, 0.0, 1.0)), 0.1)
    assert effective_sigma(np.zeros((0, 2)), RangeNoise(0.1, 0.2, 1.0)).shape == (0,)


def moving(rng, sigma, n=3000, anchors=3):
    """Return stamps, anchors and ranges of a robot that passes anchors at 0.3 m/s, ranged in turn every 0.5 s."""
    stamps = np.arange(n) * 0.5
    anchor = np.arange(n) % anchors
    tag = np.column_stack([10 * np.sin(0.03 * stamps), 8 * np.cos(0.021 * stamps)])
    places = np.array([[0, 0], [9, 7], [-8, 5]])[:anchors]
    return stamps, anchor, np.hypot(*(tag - places[anchor]).T) + sigma * rng.standard_normal(n) + 0.7 * anchor


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.6])
def test_short_term_noise_is_found_without_any_position(sigma):
    """A median absolute value of n values, three of which share a range, has a relative standard error of about
    1.17 sqrt(3 / n); the path bends a line between neighbours 1.5 s apart by a few millimetres."""
    for seed in range(3):
        stamps, anchor, ranges = moving(np.random.default_rng(seed), sigma)
        found = short_term_sigma(stamps, anchor, ranges, CONFIG)
        assert found == pytest.approx(sigma, rel=3 * 1.17 * np.sqrt(3 / 3000) + 0.01)


def test_short_term_noise_bears_outliers():
    """Ten per cent of outliers spoil up to 27 % of the triples; the median then sits at quantile 0.5 / 0.73 = 0.68 of the
    clean values, 1.0 sigma instead of 0.67 sigma: at most half as much again, never less than the clean noise."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stamps, anchor, ranges = moving(rng, 0.1)
        ranges = ranges + np.where(rng.random(len(ranges)) < 0.1, rng.uniform(-8, 8, len(ranges)), 0.0)
        assert 0.9 * 0.1 < short_term_sigma(stamps, anchor, ranges, CONFIG) < 1.55 * 0.1


def test_short_term_noise_needs_neighbours_and_keeps_its_bounds():
    assert short_term_sigma(np.zeros(0), np.zeros(0, dtype=int), np.zeros(0), CONFIG) == CONFIG.sigma
    for count, learnt in ((15, False), (21, False), (22, True)):  # two readings more than triples
        few = np.arange(count)
        sigma = short_term_sigma(few * 1.0, np.zeros(count, dtype=int), few * 1.0, CONFIG)
        assert sigma == (CONFIG.min_sigma if learnt else CONFIG.sigma)
    many = np.arange(100)
    assert short_term_sigma(many * 1.0, np.zeros(100, dtype=int), many * 0.1, CONFIG) == CONFIG.min_sigma
    assert short_term_sigma(np.zeros(100), np.zeros(100, dtype=int), many * 0.1, CONFIG) == CONFIG.sigma


def test_short_term_noise_does_not_depend_on_the_order_of_equal_anchors():
    rng = np.random.default_rng(4)
    stamps, anchor, ranges = moving(rng, 0.1, 300)
    mixed = rng.permutation(300)
    one = short_term_sigma(stamps, anchor, ranges, CONFIG)
    assert short_term_sigma(stamps[mixed], anchor[mixed], ranges[mixed], CONFIG) == one


@given(st.integers(1, 300), st.floats(0.5, 30.0), st.floats(-3.1, 3.1))
def test_ranges_from_one_place_weigh_as_one_draw_of_the_steady_part(n, distance, bearing):
    offsets = np.tile([distance * np.cos(bearing), distance * np.sin(bearing)], (n, 1))
    assert np.sum(steady_sigma(offsets, CONFIG) ** -2.0) == pytest.approx(CONFIG.steady**-2.0, rel=1e-9)


@given(st.floats(0.5, 5.0), st.floats(2.0, 20.0))
def test_what_is_steady_depends_on_directions_and_ratios_of_distances(radius, factor):
    """The same path around an anchor at any scale; errors from all sides are more draws than errors from one."""
    bearing = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    ring = radius * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    near, far = steady_sigma(ring, CONFIG), steady_sigma(factor * ring, CONFIG)
    np.testing.assert_allclose(near, far, rtol=0.1)
    side = radius * np.stack([np.cos(bearing / 20.0), np.sin(bearing / 20.0)], axis=1)
    assert np.sum(near**-2.0) > 1.5 * np.sum(steady_sigma(side, CONFIG) ** -2.0)


@pytest.mark.parametrize(("other", "apart"), [((0.0, 1.0), 2.0**0.5), ((-1.0, 0.0), 2.0), ((np.exp(0.5), 0.0), 0.5)])
def test_half_a_radian_of_direction_or_half_an_e_fold_of_distance_is_a_correlation_length(other, apart):
    """By chords of the unit circle and logarithms of distance."""
    alike = np.exp(-apart / 0.5)
    for turn in (0.0, np.pi / 2):
        first, second = steady_sigma(se2.rotate(turn, np.array([[1.0, 0.0], other])), CONFIG)
        assert first == second
        assert (first / CONFIG.steady) ** 2 - 1.0 == pytest.approx(alike)


def test_steady_errors_can_be_switched_off():
    assert not np.any(steady_sigma(np.ones((4, 2)), replace(CONFIG, steady=0.0)))
    assert len(steady_sigma(np.zeros((0, 2)), CONFIG)) == 0


@pytest.mark.parametrize("index", [3, 7, 11])
def test_exact_covariances_give_the_length_and_the_slow_part_back(monkeypatch, index):
    """At the middles of the bins; one of the lengths that are tried."""
    length, rng = np.geomspace(0.3, 8.0, 15)[index], np.random.default_rng(9)

    def exact(p, e, edges):
        return 0.06**2 * np.exp(-0.5 * (edges[1:] + edges[:-1]) / length), np.full(len(edges) - 1, 100.0)

    monkeypatch.setattr("uwblite.radio.range_noise._covariance_by_distance", exact)
    errors = 0.1 * rng.standard_normal(5000)
    noise = learn(np.zeros((5000, 2)), errors, np.ones(5000), CONFIG)
    assert noise.length == pytest.approx(length)
    assert noise.slow == pytest.approx(0.06)
    assert noise.white == pytest.approx(0.08, rel=0.03)


def test_what_is_left_of_the_variance_is_at_least_half_the_least_sigma():
    """Covariances that explain all of it."""
    config = replace(CONFIG, min_sigma=0.1)
    distance = np.array([0.1, 0.4, 0.8])
    noise = _fit(distance, 0.1**2 * np.exp(-distance), np.full(3, 100.0), 0.1**2, config)
    assert noise.white == pytest.approx(0.05)
    # The lengths that are tried are a quarter apart.
    assert noise.slow == pytest.approx(0.1 * np.sqrt(0.95), rel=5e-3)
