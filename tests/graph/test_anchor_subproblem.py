"""Anchors at given poses: what is free and counts there, and steps that anchors with ranges along a line would forbid."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, plain_ranges, random_poses, relative_edges

from uwblite.graph.anchor_subproblem import anchor_subproblem, with_anchors_solved
from uwblite.graph.graph import Graph, edge_costs, linearize
from uwblite.graph.solver import SolverConfig, optimize
from uwblite.graph.unknowns import free_unknowns


def mixed(seed=0):
    """Return a graph with odometry, scan edges, ranges and priors, a trial at other estimates, and its linearisation."""
    graph, kinds = every_kind(seed)
    edges = tuple(kinds[name] for name in ("odometry", "scan", "range", "prior on calibration"))
    graph, rng = replace(graph, edges=edges), np.random.default_rng(seed)
    values = graph.calibration.values
    trial = graph.updated(random_poses(rng, len(graph.poses)), graph.anchors + 1.0, values + rng.uniform(0.1, 0.2, len(values)))
    return graph, trial, linearize(trial)


def test_only_anchors_and_what_their_edges_alone_touch_are_free():
    graph, trial, linearized = mixed()
    problem = anchor_subproblem(graph, trial, linearized, [2, 3])
    free = free_unknowns(problem)
    assert not free["poses"].any()
    assert free["anchors"].all()
    # Four values of the wheels and four of the laser first, then six of the ranges; last, slip of the wheels.
    np.testing.assert_array_equal(np.flatnonzero(free["calibration"]), np.arange(8, 14))
    np.testing.assert_array_equal(problem.poses, trial.poses)
    np.testing.assert_array_equal(problem.anchors, graph.anchors)
    expected = np.where(free["calibration"], graph.calibration.values, trial.calibration.values)
    np.testing.assert_array_equal(problem.calibration.values, expected)
    assert problem.edges == graph.edges[2:]


@pytest.mark.parametrize("fixed", ["fixed_poses", "fixed_anchors"])
def test_without_free_poses_or_anchors_there_is_no_such_problem(fixed):
    graph, trial, linearized = mixed()
    count = len(graph.poses if fixed == "fixed_poses" else graph.anchors)
    held = replace(graph, **{fixed: np.ones(count, dtype=bool)})
    assert anchor_subproblem(held, trial, linearized, [2, 3]) is None


def test_a_trial_that_its_other_edges_forbid_stays_as_it_is():
    graph, trial, linearized = mixed()
    elsewhere = [sum(e.residuals(g).ravel() @ e.residuals(g).ravel() for e in g.edges[:2]) for g in (graph, trial)]
    assert elsewhere[1] > elsewhere[0]
    before = edge_costs(graph, linearize(graph))
    assert with_anchors_solved(graph, before, trial, linearized, pytest.fail) == (trial, linearized)


def along_a_line(seed=0):
    """Return a robot's way along a line, stretched, and an anchor 60 cm off the line that is thought to be on it."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 20.0, 81)
    truth = np.stack([x, 0.02 * np.sin(x), np.zeros(81)], axis=1)
    anchor, heard = np.array([10.0, 0.6]), np.arange(0, 81, 2)
    distance = np.hypot(*(truth[heard, :2] - anchor).T) + 0.03 * rng.standard_normal(len(heard))
    edges = (
        relative_edges(truth, np.arange(80), np.arange(1, 81), [0.002, 0.002, 0.001]),
        plain_ranges(heard, np.zeros(len(heard), dtype=np.intp), distance, 0.03),
    )
    stretched = truth + np.outer(x / 20.0, [0.3, 0.0, 0.0])
    return Graph(stretched, np.array([[10.0, 0.03]]), edges)


def test_a_trial_with_anchors_solved_keeps_its_poses_and_its_linearisation_is_its_own():
    graph = along_a_line()
    trial = graph.updated(graph.poses, graph.anchors + np.array([0.0, -3.0]), graph.calibration.values)
    before = edge_costs(graph, linearize(graph))
    solved, linearized = with_anchors_solved(graph, before, trial, linearize(trial), lambda g: optimize(g)[0])
    np.testing.assert_array_equal(solved.poses, trial.poses)
    assert solved.edges[1].residuals(solved).ravel() @ solved.edges[1].residuals(solved).ravel() < graph.chi2()
    for found, expected in zip(linearized, linearize(solved), strict=True):
        np.testing.assert_array_equal(found.residuals, expected.residuals)
        for (_, _, a), (_, _, b) in zip(found.blocks, expected.blocks, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("seed", range(3))
def test_an_anchor_on_a_line_does_not_hold_the_poses(seed):
    graph = along_a_line(seed)
    solved, summary = optimize(graph, SolverConfig(max_iterations=4))
    best = optimize(graph)[1].chi2
    assert summary.chi2 < best + 1.0
    steps = np.diff(solved.poses[:, 0])
    assert abs(steps.sum() - 20.0) < 4 * 0.002 * np.sqrt(80)
