from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import chain
from helpers.planted_graphs import at_random, dense_system, every_kind, loop, plain_ranges, random_poses, relative_edges
from scipy.optimize import least_squares

from uwblite import se2
from uwblite.errors import Cancelled, ConfigError, SolverError
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey, edge_weights, linearize, linearized_cost
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.pose_edges import OdometryEdges, RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import (
    ALL_WORK_DONE,
    SolverConfig,
    _solve_step,
    cheaper_move,
    extrapolated,
    optimize,
    relaxed,
)
from uwblite.graph.unknowns import move_by_arcs, move_by_links

CAREFUL = SolverConfig(relative_decrease=1e-14)


def filled(graph):
    linearized = linearize(graph)
    normal = NormalEquations(graph, linearized)
    normal.fill(linearized, [edge_weights(edges, graph) for edges in graph.edges])
    return normal


def in_solver_order(normal, number):
    """Return where each scalar of the dense system stands in the solver's vector."""
    order = np.empty(normal.unknowns.size, dtype=int)
    for name, places in number.items():
        free = places >= 0
        order[places[free]] = normal.unknowns.number[name][free]
    return order


def mixed(seed, **is_fixed):
    """Return a graph with every kind of edges, robust kernels and weights, and a prior that makes it definite."""
    graph, kinds = every_kind(seed)
    rng = np.random.default_rng(seed)
    kernels = [Kernel(), Kernel("huber", 2.0), Kernel("cauchy", 3.0), Kernel("geman-mcclure", 5.0)]
    edges = [
        replace(e, kernel=kernels[k % 4], weights=None if k % 3 else rng.uniform(size=len(e)))
        for k, e in enumerate(kinds.values())
    ]
    for name, count, width in (("poses", 6, 3), ("anchors", 3, 2), ("calibration", 14, 1)):
        prior = rng.normal(size=(count, width)), np.tile(0.5 * np.eye(width), (count, 1, 1))
        edges.append(PriorEdges(name, np.arange(count), *prior))
    return replace(graph.with_edges(*edges), **is_fixed)


FIXED = [
    {},
    {"fixed_poses": np.zeros(6, dtype=bool)},
    {"fixed_poses": np.array([False, True, True, False, False, False]), "fixed_anchors": np.array([True, False, True])},
    {"fixed_anchors": np.ones(3, dtype=bool), "fixed_calibration": np.arange(18) % 2 == 0},
    {"fixed_poses": np.ones(6, dtype=bool)},
    {"fixed_poses": np.ones(6, dtype=bool), "fixed_anchors": np.ones(3, dtype=bool)},
    {"fixed_calibration": np.ones(18, dtype=bool)},
]


@pytest.mark.parametrize("is_fixed", FIXED, ids=lambda h: "+".join(h) or "default")
def test_normal_equations_equal_a_dense_assembly(is_fixed):
    graph = mixed(1, **is_fixed)
    normal = filled(graph)
    H, g, number = dense_system(graph)
    order = in_solver_order(normal, number)
    np.testing.assert_allclose(normal.gradient[order], g, atol=1e-9)
    np.testing.assert_allclose(normal.diagonal[order], np.diag(H), atol=1e-9)
    damping = np.linspace(0.1, 0.2, len(g))
    right = np.random.default_rng(0).normal(size=(len(g), 2))
    spread = np.empty_like(right)
    spread[order] = right
    in_order = np.empty_like(damping)
    in_order[order] = damping
    solved = normal.factor(in_order).solve(spread)[order]
    np.testing.assert_allclose((H + np.diag(damping)) @ solved, right, atol=1e-8)


@pytest.mark.parametrize(
    ("anchors", "closures", "kind"),
    [
        (0, 0, "BandedFactor"),
        (1, 0, "BorderedFactor"),
        (4, 0, "BorderedFactor"),
        (0, 150, "SuperLU"),
        (4, 150, "BorderedFactor"),
        (30, 150, "SuperLU"),
    ],
)
def test_every_structure_solves_like_a_dense_matrix(anchors, closures, kind):
    """Chains are banded, closures between any poses are not; few anchors and calibration are a border, many are not."""
    rng = np.random.default_rng(anchors)
    n = 90
    truth = np.cumsum(rng.normal(scale=0.3, size=(n, 3)), axis=0)
    each = np.arange(n - 1)
    graph = Graph(truth, rng.normal(scale=5.0, size=(anchors, 2)), (relative_edges(truth, each, each + 1, [0.1] * 3, rng),))
    if closures:
        i, j = rng.integers(0, n, size=(2, closures))
        graph = graph.with_edges(relative_edges(truth, i[i != j], j[i != j], [0.1] * 3, rng))
    if anchors:
        pose, anchor = np.repeat(each, anchors), np.tile(np.arange(anchors), n - 1)
        ranges = plain_ranges(pose, anchor, rng.uniform(1.0, 5.0, len(pose)), 0.1)
        ranges = replace(ranges, calibration=np.tile([0, 1, -1, -1, -1, -1], (len(pose), 1)))
        graph = replace(graph, calibration=Calibration((UnknownKey("scale"), UnknownKey("bias")), np.zeros(2))).with_edges(
            ranges
        )
    normal = filled(graph)
    H, g, number = dense_system(graph)
    order = in_solver_order(normal, number)
    damping = np.full(len(g), 0.5)
    factor = normal.factor(damping)
    assert type(factor).__name__ == kind
    np.testing.assert_allclose((H + np.diag(damping)) @ factor.solve(normal.gradient)[order], g, atol=1e-7)
    many = rng.normal(size=(len(g), 3))
    np.testing.assert_allclose(factor.solve(many)[:, 1], factor.solve(many[:, 1]), atol=1e-10)
    if kind != "SuperLU":  # which factorises indefinite matrices as well
        with pytest.raises(SolverError, match="singular"):
            normal.factor(-2.0 * normal.diagonal)


def test_an_edge_from_a_pose_to_itself_counts_both_its_jacobians():
    graph, kinds = every_kind(2)
    edges = replace(kinds["relative pose"], j=kinds["relative pose"].i)
    graph = graph.with_edges(edges, kinds["odometry"])
    H, _, number = dense_system(graph)
    normal = filled(graph)
    np.testing.assert_allclose(normal.diagonal[in_solver_order(normal, number)], np.diag(H), atol=1e-9)


def test_noiseless_measurements_give_back_the_truth():
    graph, truth, anchors = loop(1, noise=False)
    rng = np.random.default_rng(1)
    start = truth + rng.normal(size=truth.shape) * [0.2, 0.2, 0.1]
    start[0] = truth[0]
    found, summary = optimize(replace(graph, poses=start))
    assert summary.converged
    np.testing.assert_allclose(found.poses[:, :2], truth[:, :2], atol=1e-7)
    np.testing.assert_allclose(se2.wrap_angle(found.poses[:, 2] - truth[:, 2]), 0.0, atol=1e-7)
    np.testing.assert_allclose(found.anchors, anchors, atol=1e-7)


@pytest.mark.parametrize("seed", range(2))
def test_the_minimum_is_that_of_scipy(seed):
    graph, _, _ = loop(seed, n=16)
    found, summary = optimize(graph, CAREFUL)

    def residuals(x):
        poses = np.vstack([graph.poses[:1], x[:45].reshape(-1, 3)])
        at = graph.updated(poses, x[45:].reshape(-1, 2), graph.calibration.values)
        return np.concatenate([edges.residuals(at).ravel() for edges in at.edges])

    start = np.concatenate([graph.poses[1:].ravel(), graph.anchors.ravel()])
    reference = least_squares(residuals, start, method="lm", xtol=1e-14, ftol=1e-14)
    assert summary.chi2 == pytest.approx(2.0 * reference.cost, rel=1e-9)
    np.testing.assert_allclose(found.anchors.ravel(), reference.x[45:], atol=1e-5)


def test_chi2_at_the_truth_of_the_noise_model_is_its_dof():
    """chi2 of a least-squares minimum has mean dof and variance 2 dof; twelve graphs, four standard deviations."""
    summaries = [optimize(loop(seed)[0])[1] for seed in range(12)]
    dof = sum(s.dof for s in summaries)
    assert sum(s.chi2 for s in summaries) == pytest.approx(dof, abs=4.0 * np.sqrt(2.0 * dof))
    first = summaries[0]
    assert first.dof == 59 * 3 + 8 * 3 + 180 - 59 * 3 - 6
    assert first.chi2_per_dof == first.chi2 / first.dof


@pytest.mark.parametrize("name", ["huber", "cauchy", "geman-mcclure"])
def test_robust_minima_have_no_gradient(name):
    graph, _, _ = loop(3)
    closures = graph.edges[1]
    wrong = closures.T_i_j.copy()
    wrong[0] += [3.0, -2.0, 1.0]
    robust = replace(closures, T_i_j=wrong, kernel=Kernel(name, 4.0))
    graph = replace(graph, edges=(graph.edges[0], robust, graph.edges[2]))
    found, summary = optimize(graph, SolverConfig(relative_decrease=1e-13))
    assert summary.converged
    assert summary.chi2 == pytest.approx(found.chi2(), rel=1e-12)
    step = 1e-6
    for k, scalar in np.ndindex(3, 3):
        costs = []
        for sign in (step, -step):
            poses = found.poses.copy()
            poses[10 + 15 * k, scalar] += sign
            costs.append(found.updated(poses, found.anchors, found.calibration.values).chi2())
        # chi2 is 200, its second derivative 1e5: rounding 1e-13 200 / 1e-6 and a rest from the tolerance.
        assert (costs[0] - costs[1]) / (2 * step) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("name", "large"), [("none", True), ("huber", False)])
def test_a_robust_search_ends_at_a_small_decrease_any_other_where_the_next_ones_are_small(name, large):
    """Reweighting converges linearly at an unknown rate: there the last decrease itself has to be small."""
    graph, _, _ = loop(3)
    graph = replace(graph, edges=tuple(replace(e, kernel=Kernel(name, 1.5)) for e in graph.edges))
    coarse = SolverConfig(relative_decrease=2e-3)
    _, summary = optimize(graph, coarse)
    last = -np.diff(summary.chi2_history)[-1]
    assert (summary.converged, summary.reason) == (True, "chi2 no longer decreases")
    assert (last > coarse.relative_decrease * summary.chi2) == large


def test_an_outlier_bends_the_robust_minimum_less():
    graph, truth, _ = loop(4)
    closures = graph.edges[1]
    wrong = closures.T_i_j.copy()
    wrong[2] += [2.0, 2.0, 0.5]

    def error(kernel):
        edges = (graph.edges[0], replace(closures, T_i_j=wrong, kernel=kernel), graph.edges[2])
        return np.sqrt(np.mean((optimize(replace(graph, edges=edges))[0].poses - truth)[:, :2] ** 2))

    assert error(Kernel("cauchy", 2.0)) < 0.5 * error(Kernel())


def test_fixed_unknowns_stay_where_they_are():
    rng = np.random.default_rng(5)
    graph, _, _ = loop(5)
    some_poses, some_anchors = rng.random(len(graph.poses)) < 0.2, np.array([True, False, False])
    is_fixed = replace(graph, fixed_poses=some_poses, fixed_anchors=some_anchors)
    found, summary = optimize(is_fixed)
    np.testing.assert_array_equal(found.poses[some_poses], graph.poses[some_poses])
    np.testing.assert_array_equal(found.anchors[0], graph.anchors[0])
    assert np.all(np.any(found.poses[~some_poses] != graph.poses[~some_poses], axis=1))
    assert summary.chi2 < summary.chi2_initial


def test_by_default_the_first_pose_is_fixed():
    graph, _, _ = loop(6)
    np.testing.assert_array_equal(optimize(graph)[0].poses[0], graph.poses[0])


def test_the_result_does_not_depend_on_where_the_map_frame_stands():
    graph, _, _ = loop(7)
    shift = np.array([100.0, -50.0, 2.0])
    turned = graph.updated(se2.compose(shift, graph.poses), se2.transform(shift, graph.anchors), graph.calibration.values)
    (found, summary), (elsewhere, other) = optimize(graph, CAREFUL), optimize(turned, CAREFUL)
    assert other.chi2 == pytest.approx(summary.chi2, rel=1e-9)
    back = se2.compose(shift, found.poses)
    np.testing.assert_allclose(elsewhere.poses[:, :2], back[:, :2], atol=1e-5)


def test_the_same_input_gives_the_same_bytes():
    first, second = (optimize(mixed(8))[0] for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.anchors.tobytes() == second.anchors.tobytes()


def test_the_input_is_not_changed():
    graph, _, _ = loop(9)
    before = graph.poses.copy(), graph.anchors.copy()
    optimize(graph)
    np.testing.assert_array_equal(graph.poses, before[0])
    np.testing.assert_array_equal(graph.anchors, before[1])


def test_a_disconnected_anchor_and_pose_stay():
    graph, _, _ = loop(10)
    lonely = Graph(np.vstack([graph.poses, [7.0, 7.0, 1.0]]), np.vstack([graph.anchors, [9.0, 9.0]]), graph.edges)
    found, summary = optimize(lonely)
    np.testing.assert_array_equal(found.poses[-1], [7.0, 7.0, 1.0])
    np.testing.assert_array_equal(found.anchors[-1], [9.0, 9.0])
    assert summary.chi2 == pytest.approx(optimize(graph)[1].chi2, rel=1e-7)


def test_two_parts_that_nothing_joins_are_both_optimised():
    graph, _, _ = loop(11, anchors=0)
    n = len(graph.poses)
    apart = [replace(e, i=e.i + n, j=e.j + n) for e in graph.edges[:2]]
    both = Graph(np.vstack([graph.poses, graph.poses]), edges=(*graph.edges[:2], *apart))
    _, summary = optimize(both)
    assert summary.converged
    assert summary.chi2 == pytest.approx(2.0 * optimize(replace(graph, edges=graph.edges[:2]))[1].chi2, rel=1e-6)


def test_singular_information_counts_by_its_rank_and_leaves_its_direction_to_others():
    """A corridor: the scan sees across and the heading, not along."""
    truth = np.column_stack([np.arange(20) * 0.5, np.zeros(20), np.zeros(20)])
    each = np.arange(19)
    odometry = relative_edges(truth, each, each + 1, [0.05, 0.05, 0.02], np.random.default_rng(0))
    blind = RelativePoseEdges(np.array([0]), np.array([19]), np.array([[99.0, 0.0, 0.0]]), np.diag([0.0, 50.0, 100.0])[None])
    slanted = np.array([[0.0, 0.0, 0.0], [30.0, 40.0, 0.0], [60.0, 80.0, 0.0]])[None]
    second = RelativePoseEdges(np.array([0]), np.array([10]), truth[None, 10], slanted)
    found, summary = optimize(Graph(truth, edges=(odometry, blind, second)))
    assert summary.converged
    assert abs(found.poses[19, 0] - 9.5) < 1.0
    assert summary.dof == 2 + 1


def test_poses_that_only_singular_edges_measure_are_braked_not_refused():
    along = RelativePoseEdges(np.array([0]), np.array([1]), np.array([[1.0, 0.0, 0.0]]), np.diag([10.0, 0.0, 0.0])[None])
    found, summary = optimize(Graph(np.zeros((2, 3)), edges=(along,)))
    np.testing.assert_allclose(found.poses[1], [1.0, 0.0, 0.0], atol=1e-6)
    assert summary.chi2 == pytest.approx(0.0, abs=1e-10)
    assert np.isnan(summary.chi2_per_dof)


def test_edges_of_weight_zero_are_as_if_absent():
    graph, _, _ = loop(12)
    closures = graph.edges[1]
    keep = np.arange(len(closures)) % 2 == 0
    wrong = np.where(keep[:, None], closures.T_i_j, 99.0)
    off = replace(closures, T_i_j=wrong, weights=keep.astype(float))
    left = RelativePoseEdges(*(getattr(closures, f)[keep] for f in ("i", "j", "T_i_j", "sqrt_information")))
    with_weights, a = optimize(replace(graph, edges=(graph.edges[0], off, graph.edges[2])))
    without, b = optimize(replace(graph, edges=(graph.edges[0], left, graph.edges[2])))
    np.testing.assert_allclose(with_weights.poses, without.poses, atol=1e-9)
    assert (a.dof, a.chi2) == (b.dof, pytest.approx(b.chi2))


def test_edge_weights_are_the_kernels_times_their_own():
    graph, kinds = every_kind(3)
    edges = replace(kinds["range"], kernel=Kernel("cauchy", 1.0), weights=np.full(8, 0.5))
    squared = np.sum(edges.residuals(graph) ** 2, axis=1)
    np.testing.assert_allclose(edge_weights(edges, graph), 0.5 / (1.0 + squared))


def test_poses_move_along_arcs_and_headings_stay_wrapped():
    graph, _, _ = loop(13, n=8, anchors=1)
    normal = filled(graph)
    step = np.random.default_rng(0).normal(scale=2.0, size=normal.unknowns.size)
    there = move_by_arcs(graph, normal.unknowns, step)
    by = normal.unknowns.spread("poses", step)
    in_own_frame = np.column_stack([se2.rotate(-graph.poses[:, 2], by[:, :2]), by[:, 2]])
    expected = se2.compose(graph.poses, se2.exp(in_own_frame))
    np.testing.assert_allclose(there.poses, expected, atol=1e-12)
    assert np.all(np.abs(there.poses[:, 2]) <= np.pi)


@pytest.mark.parametrize("is_fixed", FIXED[:4], ids=lambda h: "+".join(h) or "default")
def test_link_by_link_is_the_same_step_to_first_order(is_fixed):
    graph = mixed(3, **is_fixed)
    normal = filled(graph)
    step = np.random.default_rng(0).normal(size=normal.unknowns.size)
    linked = np.array([True, True, False, True, True])

    def apart(scale):
        one, other = (
            move(graph, normal.unknowns, scale * step, *more) for move, more in ((move_by_arcs, ()), (move_by_links, (linked,)))
        )
        np.testing.assert_array_equal(one.anchors, other.anchors)
        np.testing.assert_array_equal(one.calibration.values, other.calibration.values)
        assert (np.abs(other.poses[:, 2]) <= np.pi).all()
        return np.abs(se2.between(one.poses, other.poses)).max()

    assert apart(1e-3) < 1e-4 * max(apart(0.1), 1e-9) * 1.1 + 1e-12


def test_link_by_link_a_turned_chain_keeps_its_shape():
    graph = mixed(3)
    normal = filled(graph)
    whole = np.zeros((6, 3))
    whole[:, 2] = 1.0
    whole[:, :2] = np.stack([-graph.poses[:, 1], graph.poses[:, 0]], axis=1) - [-graph.poses[0, 1], graph.poses[0, 0]]
    step = np.zeros(normal.unknowns.size)
    number = normal.unknowns.number["poses"]
    step[number[number >= 0]] = whole[number >= 0]
    turned = move_by_links(graph, normal.unknowns, step, np.ones(5, dtype=bool)).poses
    shapes = (se2.between(poses[1:-1], poses[2:]) for poses in (turned, graph.poses))
    np.testing.assert_allclose(*shapes, atol=1e-12)


def test_a_long_chain_takes_up_a_wrong_wheel_in_a_few_steps():
    rng = np.random.default_rng(5)
    n, wrong = 1500, 0.06
    step = np.stack([np.full(n - 1, 0.3), np.zeros(n - 1), rng.normal(scale=0.2, size=n - 1)], axis=1)
    noisy = step + rng.normal(size=step.shape) * [0.01, 0.005, 0.01]
    noisy[:, 2] -= wrong * 0.3
    noisy[:, :2] = se2.rotate(-wrong * 0.15, noisy[:, :2])
    truth, start = (np.zeros((n, 3)) for _ in range(2))
    for k in range(n - 1):
        truth[k + 1], start[k + 1] = se2.compose(truth[k], step[k]), se2.compose(start[k], noisy[k])
    i = np.arange(n - 1)
    wheels = OdometryEdges(
        i,
        i + 1,
        noisy,
        np.full(n - 1, 0.3),
        np.full(n - 1, 0.5),
        np.tile(np.diag([100.0, 200.0, 100.0]), (n - 1, 1, 1)),
        np.tile([-1, -1, 0, -1, -1, -1, -1, -1], (n - 1, 1)),
        kernel=Kernel("cauchy", 5.0),
    )
    seen = i[i % 97 != 0]
    matched = step[seen] + rng.normal(scale=0.002, size=(len(seen), 3))
    lidar = RelativePoseEdges(seen, seen + 1, matched, np.tile(500.0 * np.eye(3), (len(seen), 1, 1)))
    prior = PriorEdges("calibration", np.array([0]), np.zeros((1, 1)), np.full((1, 1, 1), 10.0))
    graph = Graph(start, np.zeros((0, 2)), (wheels, lidar, prior), Calibration((UnknownKey("heading_per_metre"),), np.zeros(1)))
    solved, summary = optimize(graph)
    assert summary.converged
    assert summary.iterations <= 12
    assert solved.calibration.values[0] == pytest.approx(wrong, abs=4 * 0.01 / 0.3 / np.sqrt(n))
    off = se2.between(se2.between(truth[:-1], truth[1:]), se2.between(solved.poses[:-1], solved.poses[1:]))
    assert np.abs(off[:, 2]).max() < 5 * 0.01


def test_the_summary_shows_what_happened():
    graph, _, _ = loop(14)
    calls = []
    _, summary = optimize(graph, progress=lambda done, most: calls.append((done, most)))
    assert summary.converged
    assert summary.reason == "chi2 no longer decreases"
    assert summary.chi2_initial == pytest.approx(graph.chi2())
    assert summary.chi2_history.shape == (summary.iterations,)
    assert summary.chi2 == min(summary.chi2_history)
    assert calls == [(k + 1, 100) for k in range(summary.iterations)]


def test_a_graph_at_its_minimum_is_left_at_once():
    graph, _, _ = loop(15, noise=False)
    truth = optimize(graph)[0]
    found, summary = optimize(truth)
    assert summary.converged
    assert summary.iterations <= 1
    np.testing.assert_allclose(found.poses, truth.poses, atol=1e-9)


def test_iterations_are_limited():
    graph, _, _ = loop(16)
    _, summary = optimize(graph, SolverConfig(max_iterations=1))
    assert (summary.converged, summary.reason, summary.iterations) == (False, "iterations used up", 1)


def test_steps_that_fail_are_dropped():
    """From scrambled poses Gauss-Newton steps overshoot; the brake grows until the cost falls, which it never fails to."""
    failed = 0
    for seed in range(4):
        graph, _, _ = loop(seed)
        graph = replace(graph, poses=random_poses(np.random.default_rng(seed), 60))
        found, summary = optimize(graph)
        best = np.minimum.accumulate(np.append(summary.chi2_initial, summary.chi2_history))
        rejected = summary.chi2_history > best[:-1]
        failed += rejected.sum()
        assert found.chi2() == pytest.approx(best[-1])
    assert failed > 0


def test_a_first_step_that_fails_is_no_sign_of_a_minimum():
    """Almost in line with all robots, the anchor's first Gauss-Newton step goes far aside; its place is found all the same."""
    poses, place = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), np.array([1.0, 3.0])
    ranges = plain_ranges(np.arange(3), np.zeros(3, int), np.hypot(*(poses[:, :2] - place).T), 0.1)
    graph = Graph(poses, np.array([[3.0, 0.01]]), (ranges,), fixed_poses=np.ones(3, dtype=bool))
    found, summary = optimize(graph)
    assert summary.chi2_history[0] > summary.chi2_initial
    assert summary.converged
    assert summary.chi2 < 1e-9
    np.testing.assert_allclose(found.anchors[0], place, atol=1e-5)


@pytest.mark.parametrize(("away", "steps"), [(0.0, 0), (1.9, 0), (-1.9, 0), (2.1, 1), (-2.1, 1)])
def test_the_gradient_is_judged_in_standard_deviations(away, steps):
    """A prior alone: the gradient over the root of its curvature is the distance from it over its standard deviation."""
    sigma = 0.01
    prior = PriorEdges("calibration", np.array([0]), np.array([[5.0]]), np.array([[[1.0 / sigma]]]))
    graph = Graph(np.zeros((1, 3)), edges=(prior,), calibration=Calibration(("bias",), np.array([5.0 + away * sigma])))
    found, summary = optimize(graph, SolverConfig(gradient_tolerance=2.0))
    assert (summary.converged, summary.reason, summary.iterations) == (True, "gradient negligible", steps)
    assert found.calibration.values[0] == pytest.approx(5.0 + (0.0 if steps else away * sigma), abs=1e-9)


def test_ill_posed_problems_are_named():
    graph, _, _ = loop(17)
    everything = replace(graph, fixed_poses=np.ones(60, dtype=bool), fixed_anchors=np.ones(3, dtype=bool))
    with pytest.raises(SolverError, match="value is fixed"):
        optimize(everything)
    with pytest.raises(SolverError, match="no edges"):
        optimize(replace(graph, edges=()))
    poses = graph.poses.copy()
    poses[7, 1] = np.nan
    with pytest.raises(SolverError, match=r"poses\[7\]"):
        optimize(replace(graph, poses=poses))
    anchors = graph.anchors.copy()
    anchors[2] = np.inf
    with pytest.raises(SolverError, match=r"anchors\[2\]"):
        optimize(replace(graph, anchors=anchors))
    ranges = graph.edges[2]
    broken = replace(ranges, ranges=np.where(np.arange(len(ranges)) == 4, np.nan, ranges.ranges))
    with pytest.raises(SolverError, match="edge 4 of RangeEdges"):
        optimize(replace(graph, edges=(broken,)))


@pytest.mark.parametrize(
    "wrong",
    [{"max_iterations": 0}, {"relative_decrease": 0.0}, {"gradient_tolerance": -1.0}],
)
def test_settings_are_checked(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        SolverConfig(**wrong)


def test_progress_may_cancel():
    def stop(done, most):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        optimize(loop(18)[0], progress=stop)


def far_anchor(seed, off, across):
    """Return a graph of fixed poses nearly in line with an anchor far off that starts a twentieth of the distance away."""
    rng = np.random.default_rng(seed)
    n, sigma = 40, 0.1
    poses = np.column_stack([np.linspace(0.0, 10.0, n), across * rng.standard_normal(n), np.zeros(n)])
    place = np.array([[off, 0.02 * off]])
    measured = np.hypot(*(poses[:, :2] - place).T) + sigma * rng.standard_normal(n)
    none, zeros = np.full((n, 6), -1), np.zeros((n, 2))
    edges = RangeEdges(
        np.arange(n),
        np.zeros(n, dtype=int),
        measured,
        np.full(n, sigma),
        zeros,
        np.zeros(n),
        zeros,
        np.zeros(2),
        np.zeros(n),
        none,
    )
    start = place + rng.normal(0.0, max(1.0, 0.05 * off), (1, 2))
    return Graph(poses, start, (edges,), fixed_poses=np.ones(n, dtype=bool))


@pytest.mark.parametrize("off", [20.0, 200.0, 1000.0])
@pytest.mark.parametrize("across", [0.0, 0.1])
def test_an_anchor_in_line_with_its_robots_is_found_from_afar(off, across):
    """The steps end at a minimum: descent by another method from there gains next to nothing."""
    for seed in range(6):
        solved, summary = optimize(far_anchor(seed, off, across))
        assert summary.converged, summary.reason
        edges = solved.edges[0]

        def residuals(place, edges=edges, poses=solved.poses):
            return (np.hypot(*(poses[:, :2] - place).T) - edges.ranges) / edges.sigma

        further = least_squares(residuals, solved.anchors[0], x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert summary.chi2 < 2.0 * further.cost + 0.1


class WrongWay(PriorEdges):
    """A prior whose Jacobian has the wrong sign: every step that it promises leads uphill."""

    __slots__ = ()

    def linearize(self, graph):
        right = PriorEdges.linearize(self, graph)
        return replace(right, blocks=tuple((name, number, -jacobian) for name, number, jacobian in right.blocks))


@pytest.mark.parametrize("config", [SolverConfig(), SolverConfig(relative_decrease=0.5)])
def test_a_search_in_which_no_step_helps_has_not_converged(config):
    """However coarse the search: what a step promised is a hundredth of chi2, the rest lies in a fixed pose."""
    constant = PriorEdges("poses", np.array([0]), np.array([[10.0, 0.0, 0.0]]), np.eye(3)[None])
    wrong = WrongWay("anchors", np.array([0]), np.zeros((1, 2)), np.eye(2)[None])
    graph = Graph(np.zeros((1, 3)), np.array([[1.0, 0.0]]), (constant, wrong))
    solved, summary = optimize(graph, config)
    assert (summary.converged, summary.reason) == (False, "no step decreases chi2")
    assert summary.chi2 == summary.chi2_initial == pytest.approx(101.0)
    assert np.array_equal(solved.anchors, graph.anchors)
    assert min(summary.chi2_history) > 101.0


@pytest.mark.parametrize("way", [move_by_arcs, move_by_links])
def test_a_step_takes_whichever_way_costs_less(way):
    """Priors lie where one of the two ways of carrying out the step ends: that one costs nothing."""
    rng = np.random.default_rng(4)
    graph = Graph(np.column_stack([np.arange(4.0), np.zeros(4), np.zeros(4)]), np.zeros((0, 2)))
    everywhere = np.tile(np.eye(3), (4, 1, 1))
    at_start = graph.with_edges(PriorEdges("poses", np.arange(4), graph.poses, everywhere))
    unknowns = NormalEquations(at_start, linearize(at_start)).unknowns
    step, linked = rng.normal(scale=0.5, size=unknowns.size), np.ones(3, dtype=bool)
    ends = {move_by_arcs: move_by_arcs(graph, unknowns, step), move_by_links: move_by_links(graph, unknowns, step, linked)}
    aimed = graph.with_edges(PriorEdges("poses", np.arange(4), ends[way].poses, everywhere))
    assert not np.allclose(ends[move_by_arcs].poses, ends[move_by_links].poses)
    trial, linearized, chi2 = cheaper_move(aimed, unknowns, step, linked, enough=0.0)
    assert np.allclose(trial.poses, ends[way].poses)
    assert chi2 == linearized_cost(trial, linearized) == pytest.approx(0.0)
    # What the first way reaches is enough: the other is not looked at.
    assert np.allclose(cheaper_move(aimed, unknowns, step, linked, np.inf)[0].poses, ends[move_by_arcs].poses)


@pytest.mark.parametrize(
    ("decrease", "last", "promised", "to_come"),
    [(0.5, 1.0, 0.5, 0.5), (0.25, 1.0, 0.25, 1 / 12), (1.0, 0.5, 1.0, np.inf), (0.1, 1.0, 0.5, 0.5), (0.3, np.inf, 0.2, 0.3)],
)
def test_the_decrease_to_come_is_the_rest_of_the_geometric_series(decrease, last, promised, to_come):
    """1/4 + 1/16 + ... of what came last; what the step promised where it kept less than half, or is the first."""
    assert extrapolated(decrease, last, promised) == pytest.approx(to_come)


@pytest.mark.parametrize(
    ("ratio", "factor"), [(0.0, 2.0), (0.25, 1.125), (0.5, 1.0), (0.75, 0.875), (1.0, 1 / 3), (1.5, 1 / 3)]
)
def test_lambda_follows_the_ratio_of_decrease_and_promise_as_nielsen_has_it(ratio, factor):
    assert relaxed(ratio) == pytest.approx(factor)


@pytest.mark.parametrize("damping", [0.0, 0.7, 30.0])
def test_a_damped_step_of_a_linear_problem_brings_what_it_promises(damping):
    rng = np.random.default_rng(6)
    prior = PriorEdges("anchors", np.array([0, 1, 1]), rng.normal(size=(3, 2)), rng.normal(size=(3, 2, 2)))
    graph = Graph(np.zeros((1, 3)), rng.normal(size=(2, 2)), (prior,))
    normal = filled(graph)
    _, step, promised = _solve_step(normal, damping * normal.diagonal, None)
    assert promised == pytest.approx(graph.chi2() - move_by_arcs(graph, normal.unknowns, step).chi2(), rel=1e-9)


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_a_search_under_a_lasting_brake_ends_where_its_steps_bring_nothing(seed):
    # Across the way, a range to an anchor on it has next to no slope: linear steps leap too far, and only braked ones help.
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 20.0, 81)
    poses = np.stack([x, 0.05 * np.sin(x), np.zeros(81)], axis=1)
    ranges = np.hypot(x - 10.0, poses[:, 1]) + 0.03 * rng.standard_normal(81) - 0.05 * (np.abs(x - 10.0) < 2.0)
    edges = plain_ranges(np.arange(81), np.zeros(81, dtype=np.intp), ranges, 0.03)
    graph = Graph(poses, np.array([[10.0, 0.3]]), (edges,), fixed_poses=np.ones(81, dtype=bool))
    _, summary = optimize(graph)
    best = least_squares(lambda a: (np.hypot(*(poses[:, :2] - a).T) - ranges) / 0.03, graph.anchors[0], xtol=1e-14)
    assert summary.iterations <= 45
    assert summary.chi2 <= 2.0 * best.cost + 1e-4


@pytest.mark.parametrize(("poses", "closures"), [(300, 600), (700, 3500)])
def test_the_work_allowed_is_counted(poses, closures):
    """On closures at random, by a factorisation and by iteration: the search ends with the step that reaches it."""
    graph = at_random(poses, closures)
    _, free = optimize(graph, SolverConfig(max_iterations=5))
    assert free.work > 0.0
    found, summary = optimize(graph, SolverConfig(max_iterations=5), allowed=0.5 * free.work)
    assert (summary.converged, summary.reason) == (False, ALL_WORK_DONE)
    assert 1 <= summary.iterations < 5
    assert 0.5 * free.work <= summary.work < free.work
    again, same = optimize(graph, SolverConfig(max_iterations=5), allowed=0.5 * free.work)
    np.testing.assert_array_equal(again.poses, found.poses)
    assert same.work == summary.work
    assert optimize(graph, SolverConfig(max_iterations=5), allowed=1.0)[1].iterations == 1


@pytest.mark.parametrize("seed", range(2))
def test_the_slope_alone_is_that_of_the_whole_and_leaves_the_rest(seed):
    """At another estimate: H is that of the one before, g is the new one's."""
    graph = mixed(seed)
    normal, further = filled(graph), replace(graph, poses=graph.poses + 0.01)
    before, linearized = normal.values.copy(), linearize(further)
    weights = [edge_weights(e, further) for e in further.edges]
    normal.fill(linearized, weights, again=False)
    np.testing.assert_array_equal(normal.values, before)
    np.testing.assert_array_equal(normal.gradient, filled(further).gradient)


@pytest.mark.parametrize("seed", [0, 2])
def test_the_last_step_of_a_search_is_as_near_as_was_asked(seed):
    """It is taken unseen where the factor of the step before predicts a negligible decrease."""
    solved, summary = optimize(mixed(seed), SolverConfig(relative_decrease=1e-3))
    assert summary.chi2 == pytest.approx(solved.chi2(), rel=1e-3)
    best = optimize(solved, SolverConfig(relative_decrease=1e-12))[1].chi2
    assert solved.chi2() == pytest.approx(best, rel=1e-3)


def test_a_step_that_a_robust_edge_alone_measures_is_not_torn_where_a_long_chain_straightens():
    """1.8 km whose wheels turn by 0.003 rad per step too much; scans correct every step but one. Damping of thousands of poses
    together would resist that they turn, and the weakest step would give way."""
    steps, alone = 6000, 600
    turn = np.zeros(steps)
    turn[100::200] = np.pi / 2.0
    truth = chain(np.zeros(3), np.column_stack([np.full(steps, 0.3), np.zeros(steps), turn]))
    each = np.arange(steps)
    wheels = relative_edges(truth, each, each + 1, [0.02, 0.01, 0.015])
    wheels = replace(wheels, T_i_j=wheels.T_i_j + np.array([0.0, 0.0, 0.003]), kernel=Kernel("cauchy", 5.0))
    pairs = np.concatenate([np.stack([each[: steps + 1 - k], each[: steps + 1 - k] + k]) for k in (1, 2, 4)], axis=1)
    scans = relative_edges(truth, *pairs[:, (pairs[0] > alone) | (pairs[1] <= alone)], [0.005, 0.005, 0.0005])
    graph = Graph(chain(np.zeros(3), wheels.T_i_j), edges=(wheels, scans))
    solved, _ = optimize(graph, SolverConfig(relative_decrease=0.5))
    off = se2.between(solved.poses[alone], solved.poses[alone + 1]) - wheels.T_i_j[alone]
    assert np.abs([off[0], off[1], se2.wrap_angle(off[2])]).max() < 1e-3
