"""Which pairs of sub-maps are tried: the best partners of each."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.loop_closure.candidates import (
    _among,
    _near,
    any_uncertain,
    best_per_submap,
    overlap_probability,
)
from uwblite.loop_closure.closures import LoopClosureConfig


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


@pytest.mark.parametrize("seed", range(3))
def test_pairs_that_may_be_tried_are_those_of_a_loop(seed):
    """Near enough to be matched or searched for, and no neighbours in time of one recording."""
    rng, config = np.random.default_rng(seed), LoopClosureConfig()
    poses = rng.uniform(-15.0, 15.0, (30, 3))
    recording = np.sort(rng.integers(0, 3, 30))
    expected = []
    for a in range(30):
        for b in range(a + 1, 30):
            apart = np.hypot(*(poses[a, :2] - poses[b, :2]))
            if apart < config.reach + config.search_limit and (b - a > 1 or recording[a] != recording[b]):
                expected.append((a, b, pytest.approx(apart)))
    assert list(zip(*(part.tolist() for part in _near(poses, recording, config)), strict=True)) == expected


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


@pytest.mark.parametrize(("sigma", "found"), [(8.0 / 3.0 + 1e-6, True), (8.0 / 3.0 - 1e-6, False)])
def test_places_are_uncertain_from_three_sigma_in_the_worst_direction(sigma, found):
    """Of places alone, not headings, and of pairs alone that are no neighbours."""
    axes = np.array([[0.6, -0.8], [0.8, 0.6]])
    covariance = np.diag([0.0, 0.0, 90.0])
    covariance[:2, :2] = axes @ np.diag([sigma**2, 1e-4]) @ axes.T
    joint = SimpleNamespace(relative=lambda i, j: np.tile(covariance, (len(i), 1, 1)))
    poses = np.column_stack([[0.0, 1.0, 0.5, 900.0], np.zeros(4), np.zeros(4)])
    graph, recording = SimpleNamespace(poses=poses), np.zeros(4, dtype=np.intp)
    assert any_uncertain(graph, joint, np.array([0, 1, 2]), recording, LoopClosureConfig()) is found
    assert any_uncertain(graph, joint, np.array([0, 1]), recording, LoopClosureConfig()) is False
