"""Alternatives are compared by their evidence: against integrals of linear problems, and where several explain the same."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from uwblite import se2
from uwblite.errors import SolverError
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.solver import optimize
from uwblite.problem.alternatives import EvidencePolicy, apart, compared, explanations
from uwblite.problem.evidence import log_density


def problem(widths, measured, noise=0.3):
    """Return the solved problem of some values about 0, each measured several times with the same noise."""
    count, times = measured.shape
    index = np.arange(count)
    root = np.ones((1, 1, 1))
    prior = PriorEdges("calibration", index, np.zeros((count, 1)), root / np.asarray(widths)[:, None, None])
    seen = PriorEdges(
        "calibration", np.repeat(index, times), measured.reshape(-1, 1), np.tile(root / noise, (measured.size, 1, 1))
    )
    calibration = Calibration(tuple(UnknownKey("bias", str(k)) for k in range(count)), np.zeros(count))
    graph = Graph(np.zeros((1, 3)), edges=(prior, seen), calibration=calibration)
    return replace(graph, fixed_poses=np.ones(1, dtype=bool))


def solved(graph):
    return optimize(graph)[0]


@pytest.mark.parametrize("seed", range(2))
def test_odds_are_those_of_the_integrals_over_the_unknowns(seed):
    """Values of which one prior says that they are small and another one that they may be large."""
    rng = np.random.default_rng(seed)
    narrow, wide, noise = np.array([0.1, 0.2]), np.array([1.0, 2.0]), 0.3
    measured = rng.normal(size=(2, 1)) * 0.5 + noise * rng.normal(size=(2, 3))
    usual, other = solved(problem(narrow, measured)), problem(wide, measured)
    # The measurements as an edge of the prior's kind count in the density as the prior does, the same in both.

    def evidence(graph):
        from uwblite.problem.evidence import laplace_marginal_likelihood, prior_sigma

        alone = replace(graph, edges=graph.edges[:1])
        return laplace_marginal_likelihood(graph) + float(np.log(prior_sigma(graph)).sum() - np.log(prior_sigma(alone)).sum())

    found = explanations(usual, lambda at: [other] if at is usual else [], solved, evidence)
    odds = next(each.log_odds for each in found if each.graph is not usual)

    def direct(width):
        return sum(
            multivariate_normal.logpdf(row, np.zeros(3), w**2 * np.ones((3, 3)) + noise**2 * np.eye(3))
            for row, w in zip(measured, width, strict=True)
        )

    assert odds == pytest.approx(direct(wide) - direct(narrow), abs=1e-6)
    assert [each.log_odds for each in found] == sorted((each.log_odds for each in found), reverse=True)


def path(bend):
    """Return a problem whose only pose but the first is pulled to a place, at x = bend."""
    ends = np.array([[0.0, 0.0, 0.0], [bend, 0.0, 0.0], [bend, 5.0, 0.0]])
    prior = PriorEdges("poses", np.arange(3), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    return Graph(ends, edges=(prior,))


def test_rivals_are_compared_with_each_other_and_those_of_the_likely_lead_to_more():
    """A walk from each explanation to the next; nothing is proposed from a hopeless one."""
    nats = {0.0: 0.0, 1.0: 2.0, 2.0: 4.0, 3.0: -2.0, 4.0: -19.0, 5.0: 9.0}
    asked = []

    def propose(at):
        here = at.poses[1, 0]
        asked.append(here)
        return [replace(at, poses=path(here + 1.0).poses)] if here + 1.0 in nats else []

    start = path(0.0)
    found = explanations(start, propose, lambda graph: graph, lambda graph: nats[graph.poses[1, 0]])
    assert [each.graph.poses[1, 0] for each in found] == [2.0, 1.0, 0.0, 3.0, 4.0]
    assert asked == [0.0, 1.0, 2.0, 3.0]
    assert [each.open for each in found] == [True, True, True, True, False]
    assert EvidencePolicy.positive < 2.0 < EvidencePolicy.very_strong < 6.0


def test_an_optimum_that_is_known_is_no_other_and_one_that_is_open_is_none():
    start = path(1.0)
    moved = replace(start, poses=se2.compose(np.array([3.0, -1.0, 0.4]), start.poses))
    again = explanations(start, lambda at: [moved], lambda graph: graph, log_density)
    assert [each.graph for each in again] == [start]
    # An anchor at another place beside the same path is one.
    beside = replace(start, anchors=np.array([[0.0, 2.0]]), fixed_anchors=np.zeros(1, dtype=bool))
    image = replace(beside, anchors=np.array([[0.0, -2.0]]))
    assert len(explanations(beside, lambda at: [image], lambda graph: graph, log_density)) == 2
    # The same path by another problem is another explanation.
    other = replace(moved, edges=())
    assert len(explanations(start, lambda at: [other] if at is start else [], lambda graph: graph, log_density)) == 2

    def fails(graph):
        raise SolverError("open")

    assert len(explanations(start, lambda at: [path(7.0)], fails, log_density)) == 1
    with pytest.raises(SolverError):
        explanations(start, lambda at: [], solved, fails)
    assert compared(start, path(7.0), fails, log_density) is None
    assert compared(start, path(7.0), lambda graph: graph, fails) is None
    assert compared(start, moved, lambda graph: graph, log_density) is None
    assert compared(start, path(7.0), lambda graph: graph, log_density).log_odds == pytest.approx(-48.0)


def test_paths_are_apart_by_their_shapes():
    one = path(1.0)
    moved = replace(one, poses=se2.compose(np.array([3.0, -1.0, 0.4]), one.poses))
    assert apart(one, moved) == pytest.approx(0.0, abs=1e-12)
    assert apart(one, path(2.0)) > 0.1
