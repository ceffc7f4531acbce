"""Covariances among chosen poses against those of all."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import calibrated_loop, dense_covariance, dense_system, loop, relative_edges

from uwblite import se2
from uwblite.errors import SolverError
from uwblite.graph import marginals
from uwblite.graph.graph import Graph
from uwblite.graph.marginals import JointCovariance, calibration_covariance


@pytest.mark.parametrize("chosen", [np.arange(0, 60, 7), np.array([40, 3, 17]), np.array([5]), np.array([0]), np.arange(60)])
def test_joint_covariances_of_chosen_poses_are_those_of_the_dense_inverse(chosen):
    graph, _ = calibrated_loop()
    i, j = (ends.ravel() for ends in np.meshgrid(chosen, chosen))
    covariance = dense_covariance(graph)
    for a, b, relative in zip(i, j, JointCovariance(graph, chosen).relative(i, j), strict=True):
        J = np.hstack(se2.between_jacobians(graph.poses[a], graph.poses[b]))
        joint = np.block([[covariance("poses", p, "poses", q) for q in (a, b)] for p in (a, b)])
        np.testing.assert_allclose(relative, J @ joint @ J.T, rtol=1e-5, atol=1e-12)


def test_relative_covariance_of_neighbours_is_that_of_their_odometry():
    truth = np.cumsum(np.full((5, 3), 0.2), axis=0)
    sigma = np.array([0.1, 0.05, 0.02])
    graph = Graph(truth, edges=(relative_edges(truth, range(4), range(1, 5), sigma),))
    relative = JointCovariance(graph, np.arange(5)).relative([1, 2, 3], [2, 3, 4])
    # The edge's error Z^-1 (Xi^-1 Xj) stands in the frame of pose j, which is turned by 0.2 against that of pose i.
    c, s = np.cos(0.2), np.sin(0.2)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(relative, np.tile(turn @ np.diag(sigma**2) @ turn.T, (3, 1, 1)), atol=1e-12)


def test_joint_covariances_where_something_is_not_measured():
    graph, _, _ = loop(2)
    lonely = Graph(graph.poses, np.vstack([graph.anchors, [9.0, 9.0]]), graph.edges)
    i, j = np.array([3, 5]), np.array([5, 9])
    found, expected = (JointCovariance(g, np.array([9, 3, 5])).relative(i, j) for g in (lonely, graph))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def test_a_pair_has_the_same_bits_among_few_others_and_among_many():
    joint, chosen = JointCovariance(calibrated_loop()[0], np.arange(60)), np.arange(0, 60, 3)
    i, j = (ends.ravel() for ends in np.meshgrid(chosen, chosen))
    many = joint.relative(np.tile(i, 100), np.tile(j, 100)).reshape(100, len(i), 3, 3)
    assert np.all(many == joint.relative(i, j))
    assert joint.relative(i[:0], j[:0]).shape == (0, 3, 3)


@pytest.mark.parametrize("fixed", [[False, False], [False, True], [True, False], [True, True]])
def test_the_covariance_of_the_calibration_is_that_of_the_dense_inverse(fixed):
    graph = replace(calibrated_loop()[0], fixed_calibration=np.array(fixed))
    H, _, number = dense_system(graph)
    padded = np.zeros((len(H) + 1, len(H) + 1))
    padded[:-1, :-1] = np.linalg.inv(H)
    expected = padded[np.ix_(number["calibration"][:, 0], number["calibration"][:, 0])]
    np.testing.assert_allclose(calibration_covariance(graph), expected, rtol=1e-6, atol=1e-15)


def test_a_calibration_with_a_direction_that_nothing_measures_has_no_covariance(monkeypatch):
    graph, _ = calibrated_loop()
    normal = marginals.filled(graph)
    normal.values = -normal.values
    monkeypatch.setattr(marginals, "filled", lambda graph: normal)
    with pytest.raises(SolverError, match="singular"):
        calibration_covariance(graph)


def test_of_many_pairs_little_more_is_in_memory_than_their_covariances():
    graph, _ = calibrated_loop()
    joint, (i, j) = JointCovariance(graph, np.arange(60)), np.random.default_rng(0).integers(0, 60, (2, 300_000))
    tracemalloc.start()
    found = joint.relative(i, j)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.8 * found.nbytes
