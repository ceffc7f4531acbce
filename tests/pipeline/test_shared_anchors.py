"""Anchors that two recordings have in common: which agree under their joint covariances, and what both together know."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges, random_poses

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.joint_covariance import anchor_covariance
from uwblite.graph.marginals import marginals
from uwblite.pipeline.shared_anchors import Places, agreement, fitted, places_of, together

MOTION = np.array([30.0, -12.0, 2.1])
"""T_placed_found."""
WORLD = np.array([[2.0, 1.0], [25.0, -3.0], [60.0, 20.0], [55.0, -30.0], [90.0, 5.0]])


def swinging(names, at, heading, sigma=0.1):
    """Return places of which each is known to sigma (m), and all but for the first pose's heading (rad, standard deviation)."""
    swing = heading * se2.rotate(0.5 * np.pi, at).ravel()
    return Places(tuple(names), at, sigma**2 * np.eye(at.size) + np.outer(swing, swing))


def seen_twice(off=(), swung=0.06):
    """Return places of a recording, turned by its heading's error, and those of others; of the former, some are off (m)."""
    found = se2.transform(se2.inverse(MOTION), WORLD)
    found = se2.rotate(swung, found)
    for k, metres in off:
        found[k] += metres
    return swinging("ABCDE", found, 0.05), swinging("ABCDE", WORLD, 0.05)


def test_places_that_swing_by_metres_together_agree_and_the_motion_takes_it_out():
    found, placed = seen_twice()
    motion, pairs = agreement(found, placed)
    assert pairs == [(k, k) for k in range(5)]
    np.testing.assert_allclose(se2.transform(motion, found.at), WORLD, atol=1e-6)
    assert fitted(found, placed, pairs)[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("off", "left"), [
    ([(2, (2.0, 0.5))], "ABDE"), ([(0, (0.0, -1.6)), (3, (-4.0, 0.0))], "BCE"), ([(4, (0.4, 0.3))], "ABCDE"),
])  # fmt: skip
def test_an_anchor_that_was_moved_by_less_than_its_own_sigma_does_not_agree(off, left):
    """At 60 m a heading of 0.05 rad makes a sigma of 3 m; beside the others it is known to 0.3 m."""
    found, placed = seen_twice(off)
    motion, pairs = agreement(found, placed)
    assert "".join(found.names[k] for k, _ in pairs) == left
    if len(left) < 5:
        agree = [k for k, _ in pairs]
        np.testing.assert_allclose(se2.transform(motion, found.at[agree]), WORLD[agree], atol=1e-6)


def test_chi2_is_that_of_the_distance_where_two_places_are_compared():
    """0.2^2 of each of the two ends in either recording, and 0.25^2 at each end that both ranges err by: along the line."""
    placed = Places(("A", "B"), np.array([[0.0, 0.0], [9.0, 0.0]]), 0.04 * np.eye(4))
    found = Places(("A", "B"), np.array([[1.0, 1.0], [1.0, 11.2]]), 0.04 * np.eye(4))
    motion, chi2 = fitted(found, placed, [(0, 0), (1, 1)])
    assert chi2 == pytest.approx(1.2**2 / (4 * 0.04 + 2 * 0.25**2))
    np.testing.assert_allclose(se2.transform(motion, found.at), [[-0.6, 0.0], [9.6, 0.0]], atol=1e-9)


def test_two_recordings_together_know_each_anchor_as_their_least_squares_does():
    """Anchors of either alone, too; a rigid motion of the second says nothing, what it knows of distances counts."""
    rng = np.random.default_rng(2)
    found, placed = swinging("BCX", rng.uniform(-9.0, 9.0, (3, 2)), 0.02), swinging("ABC", rng.uniform(-9.0, 9.0, (3, 2)), 0.02)
    union = together(placed, found, found.names)
    assert union.names == ("A", "B", "C", "X")
    shift = np.array([0.3, -0.2])
    shifted = together(placed, found.moved(np.append(shift, 0.0)), found.names)
    np.testing.assert_allclose(shifted.at[:3], union.at[:3], atol=1e-4)
    before, after = (np.trace(p.covariance[2:6, 2:6]) for p in (placed, union))
    assert after < before
    np.testing.assert_allclose(union.covariance, union.covariance.T, atol=1e-9)
    sigma_x = np.sqrt(np.trace(union.covariance[6:, 6:]))
    assert 0.1 < sigma_x < 2.0


def test_places_have_the_joint_covariance_of_the_graph_and_open_ones_some_metres():
    """Two anchors with ranges from many poses, of which the last has none: any place is as good."""
    rng = np.random.default_rng(0)
    poses, anchors = random_poses(rng, 60, 6.0), np.array([[8.0, 1.0], [-7.0, 2.0], [3.0, 3.0]])
    anchor = np.repeat(np.arange(2), 30)
    distance = np.hypot(*(poses[:, :2] - anchors[anchor]).T)
    graph = Graph(poses, anchors, fixed_poses=np.ones(60, dtype=bool))
    ranges = plain_ranges(np.arange(60), anchor, distance, 0.1)
    full = anchor_covariance(graph.with_edges(ranges), np.array([0, 1]))
    blocks = marginals(graph.with_edges(ranges)).covariances.anchors
    np.testing.assert_allclose([full[:2, :2], full[2:, 2:]], blocks[:2], rtol=1e-9)
    bootstrap = SimpleNamespace(ambiguous=np.zeros(3, dtype=bool))
    estimate = SimpleNamespace(
        graph=graph, placed=np.ones(3, dtype=bool), odometry_and_ranges=(ranges,), anchor_ids=("A", "B", "C"),
        bootstrap=bootstrap,
    )  # fmt: skip
    places = places_of(estimate)
    np.testing.assert_allclose(places.covariance[:2, :2], full[:2, :2], rtol=1e-3)
    np.testing.assert_allclose(np.diag(places.covariance)[4:], 25.0, rtol=0.05)
    assert places_of(SimpleNamespace(bootstrap=None)).names == ()
