"""Which poses hang together with the next one."""

import numpy as np
from helpers.planted_graphs import random_poses, relative_edges

from uwblite.graph.graph import Graph, linearize
from uwblite.graph.unknowns import linked_poses

POSES = random_poses(np.random.default_rng(5), 5)


def linked(*ends):
    """Return which of five poses are linked by these kinds of edges."""
    edges = tuple(relative_edges(POSES, np.array(i), np.array(j), np.ones(3)) for i, j in ends)
    return linked_poses(5, linearize(Graph(POSES, np.zeros((0, 2)), edges))).tolist()


def test_linked_are_poses_that_share_an_edge_with_the_next_one():
    """Some files tell steps backwards."""
    assert linked(([0, 1, 3], [1, 3, 4])) == [True, False, False, True]
    assert linked(([0, 1, 3, 2], [1, 3, 4, 1])) == [True, True, False, True]
    assert linked(([1, 2, 4], [0, 1, 3]), ([2, 3], [3, 0])) == [True, True, False, True]


def test_where_odometry_is_a_chain_only_its_links_count():
    """Two recordings, of three and two poses, and clouds matched within and across them."""
    assert linked(([0, 1, 3], [1, 2, 4]), ([2, 0, 1], [3, 4, 2])) == [True, True, False, True]


def test_a_single_pose_is_linked_with_none():
    assert linked_poses(1, []).shape == linked_poses(0, []).shape == (0,)
