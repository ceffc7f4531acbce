"""Which pairs of sub-maps are tried: the best partners of each."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.loop_closure.candidates import (
    Candidates,
    _among,
    best_per_submap,
    overlap_probability,
    propose,
)
from uwblite.loop_closure.closures import LoopClosureConfig

CONFIG = LoopClosureConfig()


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_every_submap_keeps_its_best_partners(seed, limit):
    """By a loop over sub-maps; a pair stays when it is among the best of either end, and is worth anything."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    a, b = rng.integers(0, 6, (2, count))
    worth = rng.permutation(count) - rng.integers(0, count + 1)
    kept = set()
    for one in (a, b):
        for submap in range(6):
            own = np.flatnonzero(one == submap)
            kept |= set(own[np.argsort(-worth[own])][:limit].tolist())
    assert best_per_submap(a, b, worth, limit).tolist() == sorted(k for k in kept if worth[k] > 0.0)


@given(st.integers(0, 10_000), st.sampled_from([2, 3]))
def test_pairs_tried_before_are_found_as_by_a_loop(seed, width):
    rng = np.random.default_rng(seed)
    columns = rng.integers(0, 5, (width, int(rng.integers(0, 30))))
    names = {tuple(row) for row in rng.integers(0, 7, (int(rng.integers(0, 30)), width)).tolist()}
    assert _among(columns, names).tolist() == [tuple(column) in names for column in columns.T.tolist()]


def proposed(poses, recording, covariance, config, *, constrained=True):
    """Return the candidates among sub-maps, one for each of poses (s, 3), whose relative poses have a covariance (3, 3)."""
    joint = SimpleNamespace(relative=lambda i, j: np.tile(covariance, (len(i), 1, 1)))
    submaps = SimpleNamespace(reference=np.arange(len(poses)))
    return propose(SimpleNamespace(poses=poses), joint, submaps, recording, set(), constrained, config)


@pytest.mark.parametrize("sigma", [0.01, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_pairs_that_may_be_tried_are_those_of_a_loop(seed, sigma):
    """Near enough to overlap within three sigma, and no neighbours in time of one recording; the likeliest ones come first."""
    rng, config = np.random.default_rng(seed), LoopClosureConfig(partners=99)
    poses = rng.uniform(-15.0, 15.0, (30, 3))
    recording = np.sort(rng.integers(0, 3, 30))
    expected = set()
    for a in range(30):
        for b in range(a + 1, 30):
            apart = np.hypot(*(poses[a, :2] - poses[b, :2]))
            if apart < config.reach + 3.0 * sigma and (b - a > 1 or recording[a] != recording[b]):
                expected.add((a, b))
    found = proposed(poses, recording, sigma**2 * np.eye(3), config)
    assert set(zip(found.target.tolist(), found.source.tolist(), strict=True)) == expected
    np.testing.assert_allclose(found.spread, 3.0 * sigma)
    distance = np.hypot(*found.guess[:, :2].T)
    assert np.all(np.diff(distance) >= 0.0)


def test_without_ranges_a_search_is_twice_as_wide_as_the_covariance_says():
    """Biases of steps are not in it; which pairs are tried is another question."""
    poses = np.column_stack([np.linspace(0.0, 20.0, 12), np.zeros(12), np.zeros(12)])
    recording, covariance = np.zeros(12, dtype=np.intp), np.diag([1.0, 0.25, 0.01])
    sure, unsure = (proposed(poses, recording, covariance, CONFIG, constrained=held) for held in (True, False))
    np.testing.assert_array_equal(sure.target, unsure.target)
    np.testing.assert_allclose(unsure.spread, 2.0 * sure.spread)
    np.testing.assert_allclose(unsure.covariance, 4.0 * sure.covariance)


def test_an_overlap_is_told_by_the_distance_and_its_uncertainty():
    """Sub-maps overlap where their middles are 7.5 m apart; a spread of 6 m is three sigma."""
    distance, spread = np.array([7.4, 7.6, 9.4, 9.6]), np.array([0.0, 0.0, 6.0, 6.0])
    guess = np.column_stack([0.6 * distance, 0.8 * distance, np.ones(4)])
    pairs = Candidates(np.arange(4), np.arange(4) + 9, guess, np.zeros((4, 3, 3)), spread, False)
    assert pairs.overlapping(1.0, CONFIG).tolist() == [True, False, True, False]
    assert pairs.overlapping(3.0, CONFIG).tolist() == [True, False, True, True]


@pytest.mark.parametrize("seed", range(5))
def test_the_probability_of_an_overlap_is_about_the_share_of_draws_within_reach(seed):
    """Where the uncertainty is larger than the reach, which is where it orders the pairs; likelier ones come first."""
    rng, reach = np.random.default_rng(seed), 15.0
    root = np.diag(rng.uniform(15.0, 40.0, 2)) @ rng.standard_normal((2, 2))
    covariance = np.zeros((2, 3, 3))
    covariance[:, :2, :2] = root @ root.T + 100.0 * np.eye(2)
    guess = np.column_stack([rng.uniform(-40.0, 40.0, (2, 2)), np.zeros(2)])
    draws = rng.multivariate_normal(np.zeros(2), covariance[0, :2, :2], 20_000)
    shares = [np.mean(np.hypot(*(draws + g[:2]).T) < reach) for g in guess]
    np.testing.assert_allclose(overlap_probability(guess, covariance, reach), shares, rtol=0.25, atol=0.02)


def test_the_overlap_of_a_certain_pair_is_certain():
    near = overlap_probability(np.array([[1.0, 0.0, 0.5], [60.0, 0.0, 0.0]]), np.tile(1e-4 * np.eye(3), (2, 1, 1)), 15.0)
    assert near[0] > 0.98
    assert near[1] < 1e-6


def test_places_are_as_uncertain_as_three_sigma_in_the_worst_direction():
    """Of places alone, not headings."""
    axes = np.array([[0.6, -0.8], [0.8, 0.6]])
    covariance = np.diag([0.0, 0.0, 90.0])
    covariance[:2, :2] = axes @ np.diag([4.0, 1e-4]) @ axes.T
    found = proposed(np.zeros((3, 3)), np.zeros(3, dtype=np.intp), covariance, CONFIG)
    assert found.spread == pytest.approx([6.0])
