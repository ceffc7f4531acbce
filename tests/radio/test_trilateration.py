"""First positions of anchors: planted ones are found among false ranges, mirrors are named."""

import numpy as np
import pytest
from helpers.planted import wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.arrays import OUTLIER
from uwblite.radio.trilateration import (
    AnchorHypothesis,
    TrilaterationConfig,
    _raster_search,
    _refine,
    _scored,
    ambiguous,
    path_placements,
    trilaterate,
    trilaterate_each,
)

CONFIG = TrilaterationConfig()


def measured(rng, path, anchor, sigma=0.05, bias=0.0, outliers=0.0):
    """Return ranges (m,) from a path to an anchor; outliers are 0.5 to 8 m off, four fifths of them long."""
    stated = np.hypot(*(path - anchor).T) + bias + sigma * rng.standard_normal(len(path))
    wild = rng.uniform(0.5, 8.0, len(path)) * np.where(rng.random(len(path)) < 0.8, 1.0, -1.0)
    return np.abs(stated + np.where(rng.random(len(path)) < outliers, wild, 0.0))


def loop_path(rng, count=150, metres=60.0):
    """Return (count, 2) places of a tag that wanders about."""
    return wander(rng, metres)[1][np.linspace(0, metres / 0.05, count).astype(int), :2]


def expected_sigma(path, anchor, sigma, outliers, samples):
    """Return the larger standard deviation (m) of the position, its bias unknown, from the clean ranges that are used."""
    away = anchor - path
    jacobian = np.column_stack([away / np.hypot(*away.T)[:, None], np.ones(len(path))])
    normal = jacobian.T @ jacobian * min(1.0, samples / len(path)) * (1.0 - outliers)
    return sigma * np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[:2, :2])[-1])


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.3, 0.4]), st.floats(-0.3, 1.5))
def test_planted_anchors_are_found_among_false_ranges(seed, outliers, bias):
    rng = np.random.default_rng(seed)
    path = loop_path(rng)
    anchor = rng.uniform(-9, 9, 2)
    found = trilaterate(path, measured(rng, path, anchor, 0.05, bias, outliers), CONFIG)
    # A weak prior pulls the bias towards 0 by less than its own uncertainty; a kernel that drops outliers costs a half.
    tolerance = 5 * 1.5 * expected_sigma(path, anchor, 0.05, outliers, CONFIG.samples)
    assert np.hypot(*(found[0].position - anchor)) < max(tolerance, 0.05)
    assert abs(found[0].bias - bias) < max(tolerance, 0.05)
    assert found[0].cost <= min(h.cost for h in found)


def test_position_sigma_shows_the_scatter():
    rng = np.random.default_rng(1)
    path, anchor = loop_path(rng), np.array([7.0, -3.0])
    found = [trilaterate(path, measured(rng, path, anchor, 0.1), CONFIG)[0] for _ in range(60)]
    scatter = np.sqrt(np.linalg.eigvalsh(np.cov(np.array([h.position for h in found]).T))[-1])
    # Sixty draws know a standard deviation to 9 %; the robust kernel and its 1.4826 MAD add their own.
    assert np.median([h.position_sigma for h in found]) == pytest.approx(scatter, rel=0.5)
    assert np.median([h.sigma for h in found]) == pytest.approx(0.1, rel=0.2)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.floats(1.5, 8.0), st.floats(-np.pi, np.pi))
def test_a_straight_path_leaves_two_mirrored_places(seed, aside, heading):
    rng = np.random.default_rng(seed)
    path = np.column_stack([np.linspace(-8, 8, 160), 0.005 * rng.standard_normal(160)])
    anchor = np.array([rng.uniform(-5, 5), aside])
    turn = np.array([rng.uniform(-5, 5), rng.uniform(-5, 5), heading])
    found = trilaterate(se2.transform(turn, path), measured(rng, path, anchor, 0.05, 0.3), CONFIG)
    assert ambiguous(found, CONFIG)
    both = se2.transform(turn, np.array([anchor, anchor * [1, -1]]))
    gap = np.hypot(*(both[:, None] - np.array([h.position for h in found[:2]])[None]).transpose(2, 0, 1))
    # Each of the two true places has its hypothesis; the distance from the line, with an unknown bias, is what is least sure.
    assert np.all(gap.min(axis=1) < 1.0)
    assert gap.argmin(axis=1).tolist() in ([0, 1], [1, 0])


@settings(max_examples=20)
@given(st.integers(0, 1000), st.booleans())
def test_a_corner_in_the_path_resolves_the_mirror_ambiguity(seed, left):
    rng = np.random.default_rng(seed)
    leg = np.linspace(0, 8, 80)
    path = np.concatenate([np.column_stack([leg, 0 * leg]), np.column_stack([8 + 0 * leg, leg if left else -leg])])
    anchor = np.array([rng.uniform(0, 6), rng.choice([-1, 1]) * rng.uniform(2, 6)])
    found = trilaterate(path, measured(rng, path, anchor, 0.05, 0.2), CONFIG)
    assert not ambiguous(found, CONFIG)
    assert np.hypot(*(found[0].position - anchor)) < 5 * expected_sigma(path, anchor, 0.05, 0.0, CONFIG.samples)


def test_the_outcome_turns_with_the_path():
    rng = np.random.default_rng(3)
    path, anchor = loop_path(rng), np.array([3.0, 6.0])
    stated, move = measured(rng, path, anchor), np.array([100.0, -50.0, 2.0])
    here, there = trilaterate(path, stated, CONFIG)[0], trilaterate(se2.transform(move, path), stated, CONFIG)[0]
    np.testing.assert_allclose(there.position, se2.transform(move, here.position), atol=0.01)


def test_a_path_that_drifts_counts_as_far_as_it_drifts():
    """A path bent by 0.4 m still gives a place near the anchor, and no second one within the drift."""
    rng = np.random.default_rng(4)
    path, anchor = loop_path(rng), np.array([4.0, -7.0])
    stated = measured(rng, path, anchor)
    bent = path + 0.4 * np.linspace(0, 1, len(path))[:, None] * [0.7, 0.7]
    found = trilaterate(bent, stated, CONFIG, drift=0.4)
    assert np.hypot(*(found[0].position - anchor)) < 0.4
    assert not ambiguous(found, CONFIG)


@pytest.mark.parametrize(("ratio", "open_"), [(8.0, True), (12.0, False)])
def test_a_second_place_is_dismissed_at_a_likelihood_ratio_of_about_e_to_the_10(ratio, open_):
    """Costs are means over the samples of squared residuals, twice the negative logarithm of the likelihood."""
    costs = 1.0 + np.array([0.0, 2.0 * ratio / CONFIG.samples])
    places = [AnchorHypothesis(np.array([0.0, 1.0 - 2 * k]), 0.0, 0.05, float(cost), 0.1) for k, cost in enumerate(costs)]
    assert ambiguous(places, CONFIG) == open_


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_ranges_place_nothing(count):
    assert trilaterate(np.zeros((count, 2)), np.ones(count), CONFIG) == []
    assert not ambiguous([], CONFIG)


def test_a_robot_that_stands_places_nothing_for_sure():
    rng = np.random.default_rng(5)
    found = trilaterate(np.zeros((50, 2)), 4.0 + 0.05 * rng.standard_normal(50), CONFIG)
    assert len(found) > 1
    assert ambiguous(found, CONFIG)


@pytest.mark.parametrize("length", [0.0, 0.2, 1.0])
def test_every_place_found_from_a_short_path_is_as_far_away_as_its_ranges_say(length):
    """Whatever the direction that so short a path does not show: range less bias, give or take half the path."""
    for seed in range(25):
        rng = np.random.default_rng(seed)
        path = np.column_stack([np.linspace(0, length, 60), 0.002 * rng.standard_normal(60) * (length > 0.0)])
        stated = measured(rng, path, rng.uniform(-9, 9, 2), 0.05)
        for found in trilaterate(path, stated, CONFIG):
            away = np.hypot(*(found.position - path.mean(axis=0))) + found.bias
            assert abs(away - stated.mean()) < 0.5 * length + 0.05


def test_hypotheses_are_distinct_and_in_order():
    rng = np.random.default_rng(6)
    path = loop_path(rng, metres=12.0)
    found = trilaterate(path, measured(rng, path, np.array([5.0, 5.0]), 0.2, outliers=0.3), CONFIG)
    costs = [h.cost for h in found]
    assert costs == sorted(costs)
    places = np.array([h.position for h in found])
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 99.0 * np.eye(len(places))
    assert apart.min() > 0.06


@pytest.mark.parametrize("seed", range(5))
def test_the_search_starts_at_ten_places_at_least_two_cells_apart(seed):
    rng = np.random.default_rng(seed)
    path = np.column_stack([np.linspace(-8, 8, 160), 0.005 * rng.standard_normal(160)])
    stated = measured(rng, path, np.array([1.0, 5.0]), 0.1)
    starts, _, step = _raster_search(path, stated, CONFIG)
    apart = np.abs(starts[:, None] - starts[None]).max(axis=2) + 99.0 * np.eye(len(starts))
    assert len(starts) == 10
    # Cells are whole steps apart: nearer than two of them lie only neighbours.
    assert apart.min() > 1.5 * step
    for place in ([1.0, 5.0], [1.0, -5.0]):
        assert np.abs(starts - place).max(axis=1).min() < 1.5 * step


def test_equal_neighbours_do_not_crowd_out_the_mirrored_place():
    """On a path that is straight to a millimetre both sides come back, whatever the raster; each once."""
    rng = np.random.default_rng(8)
    path = np.column_stack([np.linspace(-8, 8, 160), 0.001 * rng.standard_normal(160)])
    found = trilaterate(path, measured(rng, path, np.array([2.0, 4.0]), 0.02), TrilaterationConfig(raster=120))
    assert sorted(round(float(h.position[1])) for h in found[:2]) == [-4, 4]


def test_the_score_of_a_place_is_its_truncated_cost_with_that_of_its_bias():
    """Errors of 0.1, -0.2 and 4 m at a sigma of 0.1 m: (1 + 4 + outlier^2) / 3, and the bias by its prior."""
    path, state = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]), np.array([3.0, 4.0, 0.3])
    ranges = np.array([5.0, 4.0, 3.0]) + 0.3 + [0.1, -0.2, 4.0]
    covariance = np.array([[0.04, 0.0, 9.0], [0.0, 0.01, 9.0], [9.0, 9.0, 99.0]])
    scored = _scored(path, ranges, (state[None], covariance[None], np.array([0.5])), 0.1, CONFIG)[0]
    assert scored.cost == pytest.approx((5.0 + OUTLIER**2) / 3.0 + (0.3 / CONFIG.bias_sigma) ** 2 / 3.0)
    assert (scored.sigma, scored.bias) == (0.5, 0.3)
    assert scored.position_sigma == pytest.approx(0.5 * 0.2)
    assert _scored(path, ranges, (state[None], -covariance[None], np.array([0.5])), 0.1, CONFIG)[0].position_sigma == 0.0


def test_stretches_searched_together_have_the_places_of_each_alone():
    """Of 100 ranges at most, of fewer, and of too few."""
    rng = np.random.default_rng(6)
    stretches = []
    for count in (300, 60, 7, 150, 60, 100):
        path = loop_path(rng, count=count)
        stretches.append((path, measured(rng, path, rng.uniform(-6.0, 6.0, 2), 0.1, 0.2, 0.1)))
    each = trilaterate_each(stretches, CONFIG, 0.1)
    assert each[2] == []
    for (path, ranges), together in zip(stretches, each, strict=True):
        alone = trilaterate(path, ranges, CONFIG, 0.1)
        assert len(together) == len(alone)
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_allclose(one.position, other.position, atol=1e-9)
            assert one.cost == pytest.approx(other.cost)


def test_covariances_are_those_of_least_squares_with_the_bias_under_its_prior():
    """Of exact ranges, weighed fully: J^T J, the prior of a bias whose sigma is a multiple of the noise, and a thousandth."""
    rng, drift = np.random.default_rng(4), 0.3
    path, anchor = loop_path(rng), np.array([4.0, -2.5])
    ranges, start = np.hypot(*(path - anchor).T), np.array([[4.2, -2.6, 0.0]])
    state, covariance, _ = _refine(path[None], ranges[None], start, np.array([0.5]), drift, CONFIG)
    np.testing.assert_allclose(state, [[*anchor, 0.0]], atol=1e-3)
    away = anchor - path
    jacobian = np.column_stack([away / np.hypot(*away.T)[:, None], np.ones(len(path))])
    normal = jacobian.T @ jacobian
    normal[2, 2] += (drift / CONFIG.bias_sigma) ** 2
    normal += 1e-3 * np.diag(np.diag(normal))
    np.testing.assert_allclose(covariance[0], np.linalg.inv(normal), rtol=1e-3, atol=1e-6)


def test_a_rigid_path_is_placed_among_known_points_by_ranges_some_of_which_are_false():
    """The cost is half of sum c^2 log(1 + (error / c)^2) with c = 2.5 standard deviations; no motion nearby is cheaper."""
    rng = np.random.default_rng(7)
    points, tags, truth = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (20, 2)), np.array([1.0, -2.0, 0.5])
    ranges = np.hypot(*(se2.transform(truth, tags) - points).T) + rng.normal(0.0, 0.05, 20)
    ranges[:2] += 3.0
    roots = np.full(20, 5.0)

    def cost(motion, size=np.inf):
        errors = np.append(roots * (np.hypot(*(se2.transform(motion, tags) - points).T) - ranges), motion / size)
        return 0.5 * 2.5**2 * np.log1p((errors / 2.5) ** 2).sum()

    for size in (np.inf, 1.0):
        best, *others = path_placements(points, tags, ranges, roots, size)
        assert best.cost == pytest.approx(cost(best.motion, size))
        assert all(best.cost <= other.cost for other in others)
        assert all(cost(best.motion + step, size) > best.cost for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]))
        assert np.abs(se2.between(truth, best.motion)).max() < 0.1
    assert np.linalg.eigvalsh(best.information).min() > 1.0
