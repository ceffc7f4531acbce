"""Gauss-Newton steps with eliminated blocks: against the whole system solved at once."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import loop
from scipy import sparse

from uwblite.graph.eliminated import BlockEquations, BlockFactor, factor, jacobian_rows, sum_of_blocks
from uwblite.graph.graph import edge_weights
from uwblite.graph.marginals import Marginals
from uwblite.graph.normal_equations import filled


def planted(n=12):
    """Return a graph of n poses, its normal equations, blocks, and the matrix and gradient of the whole system."""
    rng = np.random.default_rng(5)
    graph = loop(n=n)[0]
    normal = filled(graph, last=())
    size, count, k, m = normal.unknowns.size, 3, 4, 60
    by_graph = rng.standard_normal((m, size)) * (rng.random((m, size)) < 0.2)
    block = rng.integers(count, size=m)
    by_block = np.zeros((m, count * k))
    by_block[np.arange(m)[:, None], block[:, None] * k + np.arange(k)] = rng.standard_normal((m, k))
    residual, prior = rng.standard_normal(m), np.tile(np.diag([1.0, 2.0, 3.0, 4.0]), (count, 1, 1))
    slope = rng.standard_normal((count, k))
    own = by_block.T @ by_block
    blocks = BlockEquations(
        sparse.csr_matrix(by_graph.T @ by_graph),
        sparse.csr_matrix(by_block.T @ by_graph),
        prior + np.stack([own[b * k : (b + 1) * k, b * k : (b + 1) * k] for b in range(count)]),
        by_graph.T @ residual,
        slope + (by_block.T @ residual).reshape(count, k),
    )
    whole, jacobian = np.zeros((size + count * k,) * 2), np.hstack([by_graph, by_block])
    whole[:size, :size] = normal.matrix.toarray()
    for b in range(count):
        own = slice(size + b * k, size + (b + 1) * k)
        whole[own, own] += prior[b]
    whole += jacobian.T @ jacobian
    return graph, normal, blocks, whole, np.concatenate([normal.gradient, slope.ravel()]) + jacobian.T @ residual


def test_the_step_is_that_of_the_whole_system():
    """In the order of elimination that it finds, and again in the order that it is given."""
    _, normal, blocks, whole, gradient = planted()
    n, order = normal.unknowns.size, None
    expected = -np.linalg.solve(whole, gradient)
    for _ in range(2):
        found = factor(normal, blocks, order)
        (x, s), order = found.step(normal, blocks), found.order
        np.testing.assert_allclose(x, expected[:n], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(s.ravel(), expected[n:], rtol=1e-9, atol=1e-12)


def test_covariances_are_those_of_the_whole_system():
    graph, normal, blocks, whole, _ = planted()
    found = Marginals(graph, normal, among=np.array([2, 7]), further=blocks)
    inverse = np.linalg.inv(whole)
    for name, covariances in (("poses", found.covariances.poses), ("anchors", found.covariances.anchors)):
        for number, covariance in zip(normal.unknowns.number[name], covariances, strict=True):
            free = number >= 0
            expected = inverse[np.ix_(number[free], number[free])]
            np.testing.assert_allclose(covariance[np.ix_(free, free)], expected, rtol=1e-9, atol=1e-15)
    chosen = normal.unknowns.number["poses"][[2, 7]].ravel()
    np.testing.assert_allclose(found.covariances.among, inverse[np.ix_(chosen, chosen)], rtol=1e-9, atol=1e-15)
    right = np.random.default_rng(1).standard_normal((normal.unknowns.size, 3))
    np.testing.assert_allclose(found.solve(right), inverse[: len(right), : len(right)] @ right, rtol=1e-9, atol=1e-12)


def test_the_factor_is_in_an_order_with_contiguous_subtrees():
    """Else the selected inverse hands on the rows of unrelated columns, which takes far more memory and time."""
    _, normal, blocks, whole, _ = planted(60)
    found = BlockFactor(normal, blocks, np.zeros(normal.unknowns.size))
    lower, n = found.L.toarray(), len(whole)
    np.testing.assert_array_equal(found.perm_r, found.perm_c)
    order = np.argsort(found.perm_c)
    np.testing.assert_allclose(lower @ found.U.toarray(), whole[np.ix_(order, order)], rtol=1e-9, atol=1e-9)
    assert not np.triu(lower, 1).any()
    size, deepest = np.ones(n, dtype=int), np.arange(n)
    for column in range(n):
        below = np.flatnonzero(lower[column + 1 :, column])
        if len(below):
            parent = column + 1 + below[0]
            size[parent] += size[column]
            deepest[parent] = min(deepest[parent], deepest[column])
    np.testing.assert_array_equal(np.arange(n) - deepest + 1, size)


def test_what_nothing_measures_stays():
    """An anchor without ranges, as where a tag has measured nothing."""
    graph = loop(n=6)[0]
    anchors = np.concatenate([graph.anchors, [[9.0, 9.0]]])
    graph = replace(graph, anchors=anchors, fixed_anchors=np.append(graph.fixed_anchors, False))
    normal = filled(graph, last=())
    size = normal.unknowns.size
    nothing = BlockEquations(
        sparse.csr_matrix((size, size)), sparse.csr_matrix((4, size)), np.eye(4)[None], np.zeros(size), np.zeros((1, 4))
    )
    x, _ = factor(normal, nothing).step(normal, nothing)
    assert np.all(np.isfinite(x))
    np.testing.assert_array_equal(x[normal.unknowns.number["anchors"][-1]], 0.0)


def test_blocks_add_up_and_what_is_fixed_is_left_out():
    rows, columns = np.array([[0, 2], [2, 0], [1, -1]]), np.array([[0, 1, -1], [1, -1, 0], [-1, 0, 1]])
    values = np.random.default_rng(0).standard_normal((3, 2, 3))
    expected = np.zeros((4, 4))
    for row, column, value in zip(rows, columns, values, strict=True):
        # The last row and column take what is fixed.
        expected[row[:, None], column] += value
    np.testing.assert_allclose(sum_of_blocks(rows, columns, values, (3, 3)).toarray(), expected[:3, :3], rtol=1e-12)


def test_rows_of_edges_make_the_normal_equations():
    graph, normal, *_ = planted()
    matrix, slope = np.zeros((normal.unknowns.size,) * 2), np.zeros(normal.unknowns.size)
    for edges in graph.edges:
        linearized = edges.linearize(graph)
        weight = np.repeat(edge_weights(edges, graph), linearized.residuals.shape[1])
        rows = jacobian_rows(linearized, normal.unknowns).toarray()
        matrix += rows.T @ (weight[:, None] * rows)
        slope += rows.T @ (weight * linearized.residuals.ravel())
    np.testing.assert_allclose(matrix, normal.matrix.toarray(), rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    np.testing.assert_allclose(slope, normal.gradient, rtol=1e-9, atol=1e-9 * np.abs(slope).max())
