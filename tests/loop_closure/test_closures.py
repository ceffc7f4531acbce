"""Collections of closures: joined, and with some rejected."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import random_poses, relative_edges

from uwblite.graph.robust import Kernel
from uwblite.loop_closure.closures import Closures, merged, no_closures
from uwblite.map_result import LoopClosure


def some(outcomes, seed=0):
    """Return closures of candidates with these outcomes."""
    rng = np.random.default_rng(seed)
    kept = [k for k, outcome in enumerate(outcomes) if outcome == "accepted"]
    edges = relative_edges(random_poses(rng, 20), np.array(kept, int), np.array(kept, int) + 9, [0.1, 0.2, 0.3], rng)
    records = tuple(LoopClosure(k, k + 9, np.zeros(3), np.eye(3), 0.01, 0.8, o, "") for k, o in enumerate(outcomes))
    return Closures(edges, records)


def same(one, other):
    for name in ("i", "j", "T_i_j", "sqrt_information"):
        np.testing.assert_array_equal(getattr(one.edges, name), getattr(other.edges, name))
    assert one.candidates == other.candidates


def test_nothing_joined_to_a_collection_changes_nothing():
    one = some(["accepted", "not-found", "accepted"])
    same(merged(one, no_closures()), one)
    same(merged(no_closures(), one), one)
    assert len(no_closures().edges) == 0
    robust = replace(one, edges=replace(one.edges, kernel=Kernel("cauchy", 3.0)))
    assert merged(robust, no_closures()).edges.kernel == robust.edges.kernel


def test_one_collection_stands_behind_the_other():
    one, other = some(["accepted", "not-found"]), some(["accepted", "accepted"], 1)
    both = merged(one, other)
    np.testing.assert_array_equal(both.edges.i, [0, 0, 1])
    np.testing.assert_array_equal(both.edges.j, [9, 9, 10])
    np.testing.assert_array_equal(both.edges.T_i_j, np.concatenate([one.edges.T_i_j, other.edges.T_i_j]))
    assert both.candidates == one.candidates + other.candidates
    assert both.edges.kernel == other.edges.kernel


def test_what_is_rejected_later_keeps_its_record_and_says_why():
    one = some(["accepted", "not-found", "accepted", "accepted"])
    left = one.without(np.array([True, False, True]), "inconsistent", ["a", "b", "c"])
    np.testing.assert_array_equal(left.edges.i, [0, 3])
    assert [(c.outcome, c.reason) for c in left.candidates] == [
        ("accepted", ""), ("not-found", ""), ("inconsistent", "b"), ("accepted", ""),
    ]  # fmt: skip
