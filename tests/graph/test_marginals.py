"""Covariances of unknowns, of the shape of a path, and of unknowns that a model lacks."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import calibrated_loop, dense_covariance, dense_system, loop, relative_edges
from scipy import sparse

from uwblite import se2
from uwblite.graph.graph import Graph, edge_weights
from uwblite.graph.marginals import JointCovariance, MarginalsPolicy, about_best_fit, added_unknown, marginals, shape_error
from uwblite.graph.solver import optimize


@pytest.mark.parametrize("n", [8, 60, 300])
def test_marginals_are_blocks_of_the_dense_inverse(n):
    graph, _ = calibrated_loop(n=n)
    covariance, found = dense_covariance(graph), marginals(graph)
    for i in range(n):
        np.testing.assert_allclose(found.covariances.poses[i], covariance("poses", i, "poses", i), rtol=1e-6, atol=1e-14)
    for a in range(3):
        np.testing.assert_allclose(found.covariances.anchors[a], covariance("anchors", a, "anchors", a), rtol=1e-6)
    sigmas = [np.sqrt(covariance("calibration", c, "calibration", c)[0, 0]) for c in range(2)]
    np.testing.assert_allclose(found.covariances.calibration, sigmas, rtol=1e-6)


def test_fixed_unknowns_have_no_covariance():
    graph, _ = calibrated_loop()
    is_fixed = replace(graph, fixed_poses=np.arange(60) % 7 == 0, fixed_anchors=np.array([False, True, False]))
    covariance, found = dense_covariance(is_fixed), marginals(is_fixed)
    assert not found.covariances.poses[7].any()
    assert not found.covariances.anchors[1].any()
    np.testing.assert_allclose(found.covariances.poses[8], covariance("poses", 8, "poses", 8), rtol=1e-6)
    np.testing.assert_allclose(found.covariances.anchors[2], covariance("anchors", 2, "anchors", 2), rtol=1e-6)


@pytest.mark.slow
def test_covariances_are_those_of_repeated_experiments():
    """300 graphs that differ by their noise: errors over predicted sigmas have mean square 1 to sqrt(2 / 300) each."""
    sums, repeats = np.zeros(3), 300
    for seed in range(repeats):
        graph, truth, anchors = loop(1, n=16)
        rng = np.random.default_rng(1000 + seed)
        odometry, closures, ranges = graph.edges
        odometry = relative_edges(truth, odometry.i, odometry.j, [0.05, 0.02, 0.02], rng)
        closures = relative_edges(truth, closures.i, closures.j, [0.03, 0.03, 0.01], rng)
        distance = np.hypot(*(truth[ranges.pose, :2] - anchors[ranges.anchor]).T)
        ranges = replace(ranges, ranges=distance + rng.normal(scale=0.1, size=len(ranges)))
        graph, _ = optimize(Graph(truth, anchors, (odometry, closures, ranges)))
        found = marginals(graph)
        error = graph.poses[8] - truth[8]
        error[2] = se2.wrap_angle(error[2])
        across = se2.between(graph.poses[3], graph.poses[12]) - se2.between(truth[3], truth[12])
        away = graph.anchors[0] - anchors[0]
        sums += [
            error @ np.linalg.solve(found.covariances.poses[8], error) / 3,
            across @ np.linalg.solve(JointCovariance(graph, np.array([3, 12])).relative([3], [12])[0], across) / 3,
            away @ np.linalg.solve(found.covariances.anchors[0], away) / 2,
        ]
    np.testing.assert_allclose(sums / repeats, 1.0, atol=4.0 * np.sqrt(2.0 / 2 / repeats))


def test_what_nothing_measures_is_infinitely_uncertain():
    graph, _, _ = loop(2)
    lonely = Graph(np.vstack([graph.poses, np.zeros(3)]), np.vstack([graph.anchors, [9.0, 9.0]]), graph.edges)
    found, without = marginals(lonely), marginals(graph)
    assert np.all(np.isinf(np.diag(found.covariances.poses[-1])))
    assert np.all(np.isinf(np.diag(found.covariances.anchors[-1])))
    np.testing.assert_allclose(found.covariances.poses[:-1], without.covariances.poses, rtol=1e-6, atol=1e-14)


def test_a_floating_part_is_very_uncertain_and_the_rest_is_not():
    graph, _, _ = loop(3, anchors=0)
    n = len(graph.poses)
    apart = relative_edges(graph.poses + 1.0, [0, 1], [1, 2], [0.1, 0.1, 0.1])
    joined = Graph(
        np.vstack([graph.poses, graph.poses[:3] + 1.0]), edges=(*graph.edges[:2], replace(apart, i=apart.i + n, j=apart.j + n))
    )
    found, without = marginals(joined), marginals(replace(graph, edges=graph.edges[:2]))
    assert np.all(np.sqrt(np.diagonal(found.covariances.poses[n:], axis1=1, axis2=2)) > 1e3)
    np.testing.assert_allclose(found.covariances.poses[:n], without.covariances.poses, rtol=1e-5, atol=1e-14)


def test_an_anchor_seen_from_one_place_is_uncertain_along_the_circle_only():
    graph, truth, _ = loop(4, anchors=1)
    ranges = graph.edges[2]
    first = replace(ranges, weights=(ranges.pose == 0).astype(float))
    found = marginals(replace(graph, poses=truth, edges=(*graph.edges[:2], first)))
    towards = graph.anchors[0] - truth[0, :2]
    towards /= np.linalg.norm(towards)
    along = np.array([-towards[1], towards[0]])
    assert towards @ found.covariances.anchors[0] @ towards == pytest.approx(0.1**2, rel=1e-3)
    assert along @ found.covariances.anchors[0] @ along > 1e3


def dense_jacobian(graph):
    """Return J (m, u) and r (m,) of all edges, whitened and weighted, and the rows of each table of edges."""
    H, _, number = dense_system(graph)
    rows, residuals, parts, first = [], [], [], 0
    for edges in graph.edges:
        lin, root = edges.linearize(graph), np.sqrt(edge_weights(edges, graph))
        own = np.zeros((*lin.residuals.shape, len(H) + 1))
        for name, index, jacobian in lin.blocks:
            for e, numbers in enumerate(number[name][index]):
                own[e][:, numbers] += root[e] * jacobian[e]
        rows.append(own.reshape(-1, len(H) + 1)[:, :-1])
        residuals.append((root[:, None] * lin.residuals).ravel())
        parts.append(slice(first, first + lin.residuals.size))
        first += lin.residuals.size
    return np.concatenate(rows), np.concatenate(residuals), parts


@pytest.mark.parametrize(("table", "count"), [(0, 40), (1, 8)], ids=["odometry", "robust closures"])
def test_common_errors_are_unknowns_of_the_size_that_the_residuals_show(table, count):
    """Against the dense normal equations with the errors among the unknowns, and their evidence. The last edge has none."""
    graph, _ = calibrated_loop(n=40)
    graph = replace(graph, poses=graph.poses + 0.01 * np.random.default_rng(1).normal(size=graph.poses.shape))
    edges, rng = graph.edges[table], np.random.default_rng(0)
    edge, error = np.repeat(np.arange(len(edges) - 1), 2), rng.permutation(2 * len(edges) - 2) % count
    assert len(np.unique(error)) == count
    shift = rng.normal(size=(len(edge), 3))
    jacobian, residuals, parts = dense_jacobian(graph)
    shifts = np.zeros((len(edges), 3, count))
    np.add.at(shifts, (edge, slice(None), error), shift)
    common = sparse.csr_matrix(shifts.reshape(-1, count))
    shifts *= np.sqrt(edge_weights(edges, graph))[:, None, None]
    whole = np.zeros((len(residuals), count))
    whole[parts[table]] = shifts.reshape(-1, count)
    both, size = np.hstack([jacobian, whole]), jacobian.shape[1]
    worth, values = [], []
    for variance in MarginalsPolicy.variances.ravel():
        information, slope = both.T @ both, both.T @ residuals
        information[np.arange(size, size + count), np.arange(size, size + count)] += 1.0 / variance
        step = -np.linalg.solve(information, slope)
        worth.append(-0.5 * (slope @ step + np.linalg.slogdet(information)[1] + count * np.log(variance)))
        values.append(step[size:])
    likely = np.exp(np.array(worth) - max(worth))
    expected = likely @ np.array(values) / likely.sum()
    found = marginals(graph).estimated(edges, common)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)
    assert np.abs(found).max() > 1e-3


def test_the_error_of_a_shape_is_what_alignment_leaves_of_many_draws():
    """Errors drawn from a covariance of no structure, small beside the path; a similarity is z -> a z + b."""
    rng = np.random.default_rng(2)
    poses = rng.normal(loc=[40.0, -20.0, 0.0], scale=10.0, size=(7, 3))
    root = 1e-3 * rng.normal(size=(21, 21))
    errors = (root @ rng.normal(size=(21, 4000))).reshape(7, 3, -1)
    path, drawn = poses[:, 0] + 1j * poses[:, 1], errors[:, 0] + 1j * errors[:, 1]
    fit = np.column_stack([path, np.ones(7)])
    left = drawn - fit @ np.linalg.lstsq(fit, drawn, rcond=None)[0]
    # Of a mean of 4,000 squares that scatter by about themselves.
    expected = pytest.approx(np.mean(np.abs(left) ** 2), rel=4 / np.sqrt(4000))
    assert shape_error(poses, root @ root.T) ** 2 == expected


def test_moves_turns_and_growth_of_the_whole_are_no_error_of_its_shape():
    poses = np.random.default_rng(3).normal(scale=5.0, size=(9, 3))
    modes = np.zeros((4, 9, 3))
    modes[0, :, 0] = modes[1, :, 1] = 1.0
    modes[2, :, 0], modes[2, :, 1] = -poses[:, 1], poses[:, 0]
    modes[3] = poses
    modes = modes.reshape(4, -1).T
    assert shape_error(poses, modes @ modes.T) == pytest.approx(0.0, abs=1e-6)
    assert shape_error(poses, np.eye(27)) == pytest.approx(np.sqrt((18 - 4) / 9))


def test_covariances_about_the_best_fit_are_those_of_many_draws_that_were_fitted():
    rng = np.random.default_rng(5)
    poses = rng.normal(loc=[40.0, -20.0, 0.0], scale=10.0, size=(6, 3))
    root = 1e-3 * rng.normal(size=(18, 18))
    errors = (root @ rng.normal(size=(18, 4000))).T.reshape(-1, 6, 3)
    fits = np.array([se2.align(poses[:, :2] + e[:, :2], poses[:, :2]) for e in errors])
    left = np.array([se2.compose(fit, poses + e) - poses for fit, e in zip(fits, errors, strict=True)])
    left[..., 2] = se2.wrap_angle(left[..., 2])
    drawn = np.einsum("nki,nkj->kij", left, left) / len(left)
    stated = about_best_fit(poses, root @ root.T)
    scale = np.sqrt(np.einsum("kii->ki", stated))
    both = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(drawn / both, stated / both, atol=0.1)


def test_a_move_of_the_whole_bends_it_nowhere():
    poses = np.random.default_rng(3).normal(scale=5.0, size=(9, 3))
    modes = np.tile(np.eye(3), (9, 1, 1))
    modes[:, 0, 2], modes[:, 1, 2] = -poses[:, 1], poses[:, 0]
    modes = modes.reshape(27, 3)
    np.testing.assert_allclose(about_best_fit(poses, modes @ modes.T), 0.0, atol=1e-9)


def test_each_is_as_if_solved_for_with_all_others():
    graph = optimize(loop()[0])[0]
    ranges, rng = graph.edges[2], np.random.default_rng(1)
    shifts = rng.normal(size=(3, len(ranges), 1))
    values, sigmas = added_unknown(graph, ranges, shifts)
    assert [len(none) for none in added_unknown(graph, ranges, shifts[:0])] == [0, 0]
    normal, gradient, number = dense_system(graph)
    lin, weights = ranges.linearize(graph), edge_weights(ranges, graph)
    for shift, value, sigma in zip(shifts, values, sigmas, strict=True):
        column = np.zeros(len(normal) + 1)
        for e in range(len(ranges)):
            for name, index, jacobian in lin.blocks:
                np.add.at(column, number[name][index[e]], weights[e] * jacobian[e].T @ shift[e])
        column = column[:-1, None]
        own = np.sum(weights[:, None] * shift**2)
        bordered = np.block([[normal, column], [column.T, np.array([[own]])]])
        right = np.append(gradient, np.sum(weights[:, None] * shift * lin.residuals))
        # The frame is free in the loop: the least solution, and a covariance without its directions.
        inverse = np.linalg.pinv(bordered, hermitian=True)
        np.testing.assert_allclose([value, sigma], [-(inverse @ right)[-1], np.sqrt(inverse[-1, -1])], rtol=1e-5)


def test_a_planted_one_is_found():
    graph = optimize(loop()[0])[0]
    ranges = graph.edges[2]
    pattern = np.sin(np.arange(len(ranges)))[:, None]
    before, _ = added_unknown(graph, ranges, pattern[None])
    longer = replace(ranges, ranges=ranges.ranges - 0.5 * pattern[:, 0] * ranges.sigma)
    changed = optimize(replace(graph, edges=(*graph.edges[:2], longer)))[0]
    after, sigma = added_unknown(changed, changed.edges[2], pattern[None])
    # All residuals grew by half of the pattern: half of a unit less is what takes it off.
    np.testing.assert_allclose(before - after, 0.5, rtol=0.02)
    assert sigma[0] > 0.0
