"""Optimisations one after another are those of each alone, whatever changes in between; only new patterns are analysed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import loop

from uwblite.errors import SolverError
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.solver import Optimizer, SolverConfig, optimize

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
def test_each_is_solved_as_alone_and_what_has_the_same_pattern_is_analysed_once(other, analysed):
    several, config, made = Optimizer(), SolverConfig(), []
    for graph in (GRAPH, other):
        solved, summary = several.optimize(graph, config)
        alone, expected = optimize(graph, config)
        made += [several._normal] if several._normal not in made else []
        np.testing.assert_allclose(solved.poses, alone.poses, atol=1e-12)
        np.testing.assert_allclose(solved.anchors, alone.anchors, atol=1e-12)
        assert summary.chi2 == pytest.approx(expected.chi2)
    assert len(made) == analysed


def test_a_graph_without_measurements_is_refused():
    with pytest.raises(SolverError, match="no edges"):
        Optimizer().optimize(replace(GRAPH, edges=()), SolverConfig())


def test_pairs_of_more_poses_than_the_root_of_what_32_bits_hold_are_told_apart():
    """A pair is sorted as one number, low * count + high, which is 3.6e9 here."""
    many = 60_000
    low, high = np.array([0, 59_998, 40_000, 59_998]), np.array([1, 59_999, 50_000, 59_999])
    touched = [[(low, False), (high, False)]]
    pairs, (which,) = NormalEquations._pairs(SimpleNamespace(_values=many), touched, many)
    assert pairs[many:].tolist() == [[0, 1], [40_000, 50_000], [59_998, 59_999]]
    assert pairs[which].tolist() == np.stack([low, high], axis=1).tolist()
    assert pairs.dtype == which.dtype == np.intp
