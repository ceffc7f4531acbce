"""Parts of a graph that nothing holds."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import loop

from uwblite.errors import SolverError
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.problem_checks import floating_components
from uwblite.graph.solver import optimize


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


@pytest.mark.parametrize(("value", "root", "why"), [
    (np.nan, 1.0, r"edge 1 of PriorEdges \(1 in all\), its value is \[nan, 0.0, 0.0\]; remove"),
    (1e250, 1e250, r"edge 1 of PriorEdges \(1 in all\); remove such measurements"),
    (1.0, 1e200, "although every residual is: weights or residuals are too large"),
])  # fmt: skip
def test_what_makes_a_cost_no_number_is_named(value, root, why):
    """A value that is none, finite ones whose residual overflows, residuals whose squares do."""
    values = np.zeros((3, 3))
    values[1, 0] = value
    priors = PriorEdges("poses", np.arange(3), values, root * np.tile(np.eye(3), (3, 1, 1)))
    with pytest.raises(SolverError, match=why), np.errstate(all="ignore"):
        optimize(Graph(np.zeros((3, 3)), edges=(priors,)))
