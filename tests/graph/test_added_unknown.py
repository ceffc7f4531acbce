"""One more unknown, to first order: against dense normal equations that have it."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import dense_system, loop

from uwblite.graph.added_unknown import added_unknown, added_unknown_and_moves
from uwblite.graph.graph import edge_weights
from uwblite.graph.solver import optimize


def test_each_is_as_if_solved_for_with_all_others():
    graph = optimize(loop()[0])[0]
    ranges, rng = graph.edges[2], np.random.default_rng(1)
    shifts = rng.normal(size=(3, len(ranges), 1))
    values, sigmas = added_unknown(graph, ranges, shifts)
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


def test_the_places_are_said_that_poses_would_have_with_it():
    graph = loop()[0]
    graph = optimize(replace(graph, fixed_poses=np.arange(len(graph.poses)) == 0))[0]
    ranges, odd = graph.edges[2], np.sin(np.arange(len(graph.edges[2])))[:, None]
    values, sigmas, moves = added_unknown_and_moves(graph, ranges, 2.0 * odd[None])
    np.testing.assert_array_equal(added_unknown(graph, ranges, 2.0 * odd[None]), [values, sigmas])
    with_it = replace(ranges, ranges=ranges.ranges - values[0] * 2.0 * odd[:, 0] * ranges.sigma)
    expected = (optimize(replace(graph, edges=(*graph.edges[:2], with_it)))[0].poses - graph.poses)[:, :2]
    assert np.abs(expected).max() > 5e-4
    # To first order, and with the robust weights as they stand.
    np.testing.assert_allclose(moves[0], expected, atol=0.15 * np.abs(expected).max())
