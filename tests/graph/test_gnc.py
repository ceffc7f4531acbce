from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.planted_graphs import at_random, every_kind, loop, random_poses, relative_edges

from uwblite import se2
from uwblite.errors import SolverError
from uwblite.graph.gnc import (
    closing_edges,
    optimize_gnc,
    optimize_tightening,
    outlier_thresholds,
    truncated_weight,
    with_kernel,
)
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.robust import SQUARED, Kernel
from uwblite.graph.solver import SolverConfig, optimize

ODOMETRY, CLOSURES, RANGES = 0, 1, 2
THRESHOLDS = {CLOSURES: 4.0, RANGES: 3.5}


def spoilt(seed, share=0.3):
    """Return a loop with a share of false closures and of gross range errors, which those are, and the clean graph."""
    clean, truth, _ = loop(seed, n=200)
    rng = np.random.default_rng(seed)
    odometry, closures, ranges = clean.edges
    count = int(len(closures) * share / (1.0 - share))
    i = rng.integers(0, 90, count)
    j = i + rng.integers(20, 100, count)
    false = relative_edges(truth, i, j, [0.03, 0.03, 0.01])
    measured = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(-np.pi, np.pi, count)])
    mixed = RelativePoseEdges(
        np.concatenate([closures.i, i]),
        np.concatenate([closures.j, j]),
        np.concatenate([closures.T_i_j, measured]),
        np.concatenate([closures.sqrt_information, false.sqrt_information]),
    )
    bad = rng.random(len(ranges)) < share
    off = np.where(rng.random(len(ranges)) < 0.7, 1.0, -1.0) * rng.uniform(1.0, 8.0, len(ranges))
    graph = replace(clean, edges=(odometry, mixed, replace(ranges, ranges=ranges.ranges + off * bad)))
    return graph, np.arange(len(mixed)) >= len(closures), bad, clean, truth


def ate(poses, truth):
    """Return the rms distance after the best rigid alignment, m."""
    a, b = poses[:, :2] - poses[:, :2].mean(axis=0), truth[:, :2] - truth[:, :2].mean(axis=0)
    dot, cross = np.sum(a * b), np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.sqrt(np.mean(np.sum((se2.rotate(np.arctan2(cross, dot), a) - b) ** 2, axis=1)))


@pytest.mark.parametrize("seed", range(2))
def test_false_closures_and_ranges_do_not_bend_the_map(seed):
    graph, false, bad, clean, truth = spoilt(seed)
    reference = ate(optimize(clean)[0].poses, truth)
    found, summary, weights = optimize_gnc(graph, THRESHOLDS)
    assert summary.converged
    assert not weights[CLOSURES][false].any()
    assert weights[CLOSURES][~false].mean() > 0.97
    assert weights[RANGES][bad].mean() < 0.03
    assert weights[RANGES][~bad].mean() > 0.97
    assert ate(found.poses, truth) <= 1.2 * reference
    assert ate(optimize(graph)[0].poses, truth) > 3.0 * reference
    assert 0.8 < summary.chi2_per_dof < 1.2


def test_the_returned_edges_carry_the_weights():
    graph, _, _, _, _ = spoilt(0)
    own = np.linspace(0.5, 1.0, len(graph.edges[CLOSURES]))
    closures = replace(graph.edges[CLOSURES], weights=own, kernel=Kernel("cauchy", 1.0))
    found, _, weights = optimize_gnc(replace(graph, edges=(graph.edges[0], closures, graph.edges[2])), {CLOSURES: 4.0})
    assert set(weights) == {CLOSURES}
    np.testing.assert_array_equal(found.edges[CLOSURES].weights, own * weights[CLOSURES])
    assert found.edges[CLOSURES].kernel.name == "none"
    assert found.edges[RANGES] is graph.edges[RANGES]
    assert graph.edges[CLOSURES].weights is None


def test_clean_graphs_keep_nearly_every_edge():
    """A threshold of 4 leaves out 1.1e-3 of Gaussian closures, 3.5 leaves out 4.7e-4 of ranges."""
    clean, _, _ = loop(5, n=200)
    plain, _ = optimize(clean)
    found, _, weights = optimize_gnc(clean, THRESHOLDS)
    assert weights[CLOSURES].sum() >= len(clean.edges[CLOSURES]) - 2
    assert weights[RANGES].sum() >= len(clean.edges[RANGES]) - 5
    np.testing.assert_allclose(found.poses, plain.poses, atol=0.02)


def test_weights_follow_the_truncated_square():
    s = np.linspace(0.0, 4.0, 2001)
    for mu in (1e-3, 0.1, 1.0, 30.0):
        weight = truncated_weight(s, mu)
        assert np.all(np.diff(weight) <= 1e-15)
        assert np.all(weight[s <= mu / (mu + 1.0)] == 1.0)
        assert np.all(weight[s >= (mu + 1.0) / mu] == 0.0)
        # The weight minimises w s + mu (1 - w) / (mu + w), Yang et al.'s penalty.
        w = np.linspace(0.0, 1.0, 4001)
        k = np.searchsorted(s, 1.0 + 0.3 / (1.0 + mu))
        best = w[np.argmin(w * s[k] + mu * (1.0 - w) / (mu + w))]
        assert weight[k] == pytest.approx(best, abs=5e-4)
    np.testing.assert_array_equal(truncated_weight(np.array([0.5, 2.0]), 1e6), [1.0, 0.0])


def test_progress_is_reported():
    calls = []
    graph, _, _, _, _ = spoilt(1)
    optimize_gnc(graph, THRESHOLDS, progress=lambda done, most: calls.append((done, most)))
    assert calls[-1][0] == calls[-1][1]
    assert len({most for _, most in calls}) == 1
    assert all(a[0] < b[0] for a, b in pairwise(calls))
    assert calls[0][0] == 1
    assert len(calls) > 2


def test_results_are_the_same_every_time():
    graph, _, _, _, _ = spoilt(2)
    first, second = (optimize_gnc(graph, THRESHOLDS)[0] for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()


@pytest.mark.parametrize("optimise", [
    lambda graph: optimize_gnc(graph, THRESHOLDS), lambda graph: optimize_tightening(graph, [CLOSURES], (4.0,), SolverConfig()),
])  # fmt: skip
def test_problems_that_are_none_are_refused_before_any_step(optimise):
    graph, _, _ = loop(0)
    with pytest.raises(SolverError, match="nothing to optimise"):
        optimise(replace(graph, fixed_poses=np.ones(60, dtype=bool), fixed_anchors=np.ones(3, dtype=bool)))
    with pytest.raises(SolverError, match=r"starting values are not finite: anchors\[1\]"):
        optimise(replace(graph, anchors=graph.anchors * [[1.0], [np.nan], [1.0]]))


def test_kernels_that_tighten_are_not_drawn_by_false_closures():
    """Those of the chosen kinds have the last scale in the end, and the odometry its own, which was wider before."""
    graph, _, _, clean, truth = spoilt(0)
    wheels, *others = graph.edges
    graph = replace(graph, edges=(replace(wheels, kernel=Kernel("cauchy", 5.0)), *others))
    found = optimize_tightening(graph, [CLOSURES, RANGES], (30.0, 10.0, 4.0), SolverConfig(), together=True)
    assert [e.kernel for e in found.edges] == [graph.edges[0].kernel, *[Kernel("geman-mcclure", 4.0)] * 2]
    assert ate(found.poses, truth) <= 1.2 * ate(optimize(clean)[0].poses, truth)
    at_once = optimize_tightening(graph, [CLOSURES, RANGES], (4.0,), SolverConfig())
    assert found.chi2() < at_once.chi2()


def test_the_end_of_all_steps_is_reported_behind_the_last_one():
    """Where weights stay between 0 and 1 until the last step that is planned."""
    graph, _, _, _, _ = spoilt(1)
    calls = []
    norms = np.sqrt(np.sum(graph.edges[RANGES].residuals(graph) ** 2, axis=1))
    optimize_gnc(graph, {RANGES: float(norms.max())}, progress=lambda done, most: calls.append((done, most)))
    assert [done for done, _ in calls] == [*range(1, len(calls)), calls[-1][1]]
    assert len(calls) <= calls[-1][1]


def test_the_work_allowed_bounds_the_steps_and_what_follows():
    """Half of it for the steps; a step takes a factorisation."""
    graph, calls = at_random(300, 600), []
    most = SolverConfig(max_iterations=1)
    once = optimize(graph, most)[1].work
    _, summary, weights = optimize_gnc(graph, {0: 300.0}, most, lambda done, _: calls.append(done), allowed=8.0 * once)
    whole = optimize_gnc(graph, {0: 300.0}, most)[1]
    assert calls[:-1] == [1, 2, 3, 4]
    assert summary.work == 5.0 * once < whole.work
    assert set(np.unique(weights[0])) <= {0.0, 1.0}


I, J = np.array([0, 2, 1, 1, 3, 0]), np.array([1, 1, 2, 2, 0, 3])


@pytest.fixture
def graph():
    rng = np.random.default_rng(0)
    poses = random_poses(rng, 5)
    edges = relative_edges(poses, I, J, [0.1, 0.1, 0.1], rng)
    last = relative_edges(poses, np.array([3]), np.array([4]), [0.1, 0.1, 0.1], rng)
    return Graph(poses, edges=(edges, edges.rows(np.array([0, 1])), last))


def test_all_but_the_first_between_successive_poses_close_loops(graph):
    one, again, other = closing_edges(graph)
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
