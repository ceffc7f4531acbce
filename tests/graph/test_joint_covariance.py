"""Covariances among chosen poses against those of all."""


import numpy as np
import pytest
from helpers.planted_graphs import calibrated_loop, loop

from uwblite.graph.graph import Graph
from uwblite.graph.joint_covariance import JointCovariance
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
