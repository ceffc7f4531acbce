"""Edges that close loops: told from successive poses, given a kernel, bounded by a threshold."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, random_poses, relative_edges

from uwblite.graph.gnc import outlier_thresholds
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.loop_edges import closing, with_kernel
from uwblite.graph.robust import SQUARED, Kernel

I, J = np.array([0, 2, 1, 1, 3, 0]), np.array([1, 1, 2, 2, 0, 3])


@pytest.fixture
def graph():
    rng = np.random.default_rng(0)
    poses = random_poses(rng, 5)
    edges = relative_edges(poses, I, J, [0.1, 0.1, 0.1], rng)
    last = relative_edges(poses, np.array([3]), np.array([4]), [0.1, 0.1, 0.1], rng)
    return Graph(poses, edges=(edges, edges.rows(np.array([0, 1])), last))


def test_all_but_the_first_between_successive_poses_close_loops(graph):
    one, again, other = closing(graph)
    np.testing.assert_array_equal(one, [False, False, True, True, True, True])
    assert again.all()
    assert not other.any()


def test_only_loops_and_what_is_no_relative_pose_get_the_kernel(graph):
    kernel = Kernel("huber", 2.0)
    changed = with_kernel(graph, kernel)
    assert [(len(e), e.kernel) for e in changed.edges] == [(2, SQUARED), (4, kernel), (2, kernel), (1, SQUARED)]
    assert with_kernel(graph, SQUARED).chi2() == pytest.approx(graph.chi2())
    weighted = replace(graph, edges=(replace(graph.edges[0], weights=np.arange(6.0)),))
    assert [e.weights.tolist() for e in with_kernel(weighted, kernel).edges] == [[0.0, 1.0], [2.0, 3.0, 4.0, 5.0]]


def test_one_good_edge_in_a_thousand_lies_beyond_its_threshold():
    from scipy.stats import chi2

    graph, kinds = every_kind(1)
    graph = graph.with_edges(*kinds.values())
    thresholds = outlier_thresholds(graph)
    suspects = [k for k, e in enumerate(graph.edges) if k in thresholds]
    assert suspects
    assert not any(isinstance(graph.edges[k], PriorEdges) for k in suspects)
    for k in suspects:
        assert chi2.sf(thresholds[k] ** 2, graph.edges[k].residuals(graph).shape[1]) == pytest.approx(1e-3, rel=0.15)
