"""Covariances among chosen poses against those of all."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import calibrated_loop, dense_system, loop

from uwblite.errors import SolverError
from uwblite.graph import joint_covariance
from uwblite.graph.graph import Graph
from uwblite.graph.joint_covariance import JointCovariance, calibration_covariance
from uwblite.graph.marginals import marginals


@pytest.mark.parametrize("chosen", [np.arange(0, 60, 7), np.array([40, 3, 17]), np.array([5]), np.array([0]), np.arange(60)])
def test_joint_covariances_of_chosen_poses_are_those_of_all(chosen):
    graph, _ = calibrated_loop()
    i, j = np.meshgrid(chosen, chosen)
    i, j = i.ravel(), j.ravel()
    joint = JointCovariance(graph, chosen)
    np.testing.assert_allclose(joint.relative(i, j), marginals(graph).relative(i, j), rtol=1e-6, atol=1e-12)


def test_joint_covariances_where_something_is_not_measured():
    graph, _, _ = loop(2)
    lonely = Graph(graph.poses, np.vstack([graph.anchors, [9.0, 9.0]]), graph.edges)
    i, j = np.array([3, 5]), np.array([5, 9])
    found, expected = (JointCovariance(g, np.array([9, 3, 5])).relative(i, j) for g in (lonely, graph))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def test_pieces_of_the_work_change_no_bit(monkeypatch):
    """Pairs, and columns of the factor, some at a time."""
    graph, _ = calibrated_loop()
    chosen = np.arange(0, 60, 3)
    i, j = (ends.ravel() for ends in np.meshgrid(chosen, chosen))
    whole = JointCovariance(graph, chosen).relative(i, j)
    monkeypatch.setattr(joint_covariance, "_PAIRS_AT_ONCE", 7)
    monkeypatch.setattr(joint_covariance, "_COLUMNS_AT_ONCE", 7)
    assert JointCovariance(graph, chosen).relative(i, j).tobytes() == whole.tobytes()
    assert JointCovariance(graph, chosen).relative(i[:0], j[:0]).shape == (0, 3, 3)


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
    normal = joint_covariance.filled(graph)
    normal.values = -normal.values
    monkeypatch.setattr(joint_covariance, "filled", lambda graph: normal)
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
