"""Optimisations one after another are those of each alone, whatever changes in between; only new patterns are analysed."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import loop

from uwblite.errors import SolverError
from uwblite.graph import optimizer
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.optimizer import Optimizer
from uwblite.graph.solver import SolverConfig, optimize

GRAPH = loop()[0]
FIXED = replace(GRAPH, fixed_anchors=np.arange(len(GRAPH.anchors)) == 1)
ELSEWHERE = replace(GRAPH, edges=(*GRAPH.edges[:2], replace(GRAPH.edges[2], anchor=(GRAPH.edges[2].anchor + 1) % 3)))


@pytest.mark.parametrize(
    ("other", "analysed"),
    [
        (GRAPH, 1),
        (replace(GRAPH, edges=(*GRAPH.edges[:2], replace(GRAPH.edges[2], sigma=2.0 * GRAPH.edges[2].sigma))), 1),
        (replace(GRAPH, poses=GRAPH.poses + 0.01), 1),
        (FIXED, 2),
        (ELSEWHERE, 2),
        (replace(GRAPH, edges=GRAPH.edges[:2]), 2),
    ],
    ids=["same", "sigma", "poses", "fixed", "anchors", "fewer"],
)
def test_each_is_solved_as_alone_and_what_has_the_same_pattern_is_analysed_once(monkeypatch, other, analysed):
    made = []
    monkeypatch.setattr(optimizer, "NormalEquations", lambda *given: made.append(1) or NormalEquations(*given))
    several, config = Optimizer(), SolverConfig()
    for graph in (GRAPH, other):
        solved, summary = several.optimize(graph, config)
        alone, expected = optimize(graph, config)
        np.testing.assert_allclose(solved.poses, alone.poses, atol=1e-12)
        np.testing.assert_allclose(solved.anchors, alone.anchors, atol=1e-12)
        assert summary.chi2 == pytest.approx(expected.chi2)
    assert len(made) == analysed


def test_a_graph_without_measurements_is_refused():
    with pytest.raises(SolverError, match="no edges"):
        Optimizer().optimize(replace(GRAPH, edges=()), SolverConfig())
