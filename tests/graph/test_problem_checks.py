"""Parts of a graph that nothing holds."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import loop

from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.problem_checks import floating_components


def twice(seed=1):
    """Return two graphs in one, tied by nothing."""
    graph = loop(seed, anchors=0)[0]
    relative = graph.edges[:2]
    apart = tuple(replace(e, i=e.i + 60, j=e.j + 60) for e in relative)
    return Graph(np.concatenate([graph.poses, graph.poses + 5.0]), edges=relative + apart)


def test_the_second_part_floats_until_a_prior_holds_it():
    graph = twice()
    np.testing.assert_array_equal(floating_components(graph), np.repeat([-1, 60], 60))
    prior = PriorEdges("poses", np.array([90]), graph.poses[90:91], np.eye(3)[None])
    assert (floating_components(graph.with_edges(prior)) == -1).all()
    free = replace(graph, fixed_poses=np.zeros(120, dtype=bool))
    np.testing.assert_array_equal(floating_components(free), np.repeat([0, 60], 60))
    ranged = loop(0)[0]
    assert (floating_components(ranged) == -1).all()
