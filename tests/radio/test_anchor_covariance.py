"""Covariances of anchors whose ranges err alike: those of the estimates that such errors make, by sampling them."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite import se2
from uwblite.graph.calibration import BIAS, CalibrationConfig, block, prior_edges, range_indices, unknowns, with_free
from uwblite.graph.graph import Graph, edge_weights
from uwblite.graph.marginals import marginals
from uwblite.graph.range_edges import RangeEdges
from uwblite.radio.anchor_covariance import _STEADY, _shown, by_alike_errors
from uwblite.radio.range_noise import RangeNoiseConfig

PLACES = np.array([[2.0, 1.0], [9.0, 14.0]])
COUNT = 160
CONFIG = RangeNoiseConfig(steady=0.01)
WHOLE = np.array([[[0.5, 0.1], [0.1, 0.2]], [[0.01, 0.0], [0.0, 0.03]]])


def known_world(count=COUNT):
    """Return a graph of fixed poses, two anchors with unknown biases, and exact ranges to them as its last edges."""
    rng, ids = np.random.default_rng(3), ("1", "2")
    poses = np.concatenate([rng.uniform(0.0, 10.0, (count, 2)), np.zeros((count, 1))], axis=1)
    anchor = np.repeat([0, 1], count)
    listed = unknowns(CalibrationConfig(range_bias=0.2), ids, np.ones(2, dtype=bool))
    calibration, still = block(listed), np.zeros(2 * count)
    graph = Graph(poses, PLACES, (), calibration, fixed_poses=np.ones(count, dtype=bool))
    graph = with_free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), BIAS)
    edges = RangeEdges(
        np.tile(np.arange(count), 2), anchor, still, np.full(2 * count, 0.02), np.zeros((2 * count, 2)), still,
        np.zeros((2 * count, 2)), np.zeros(2), still, range_indices(calibration, anchor, ids),
        weights=np.where(np.tile(poses[:, 0] > 6.0, 2), 0.02, 0.2),
    )  # fmt: skip
    return graph.with_edges(prior_edges(listed)), replace(edges, ranges=edges.distances(graph))


def alike(offsets):
    """Return the correlations (m, m) of errors at offsets (m, 2) from an anchor."""
    reach = np.hypot(*offsets.T)
    polar = np.stack([*(offsets.T / reach), np.log(reach)], axis=1)
    distance = np.linalg.norm(polar[:, None] - polar[None], axis=2)
    return _STEADY * np.exp(-distance / 0.5) + (1.0 - _STEADY) * np.eye(len(offsets))


def system(graph, edges, anchor):
    """Return J (m, 3) by place and bias, in m, W (m,) and the prior information (3, 3) of one anchor's ranges."""
    own = edges.rows(edges.anchor == anchor)
    towards = (graph.anchors[anchor] - graph.poses[own.pose, :2]) / own.distances(graph)[:, None]
    return np.column_stack([towards, np.ones(len(own))]), edge_weights(own, graph) / own.sigma**2, np.diag([0.0, 0.0, 25.0])


def test_the_stated_covariance_is_that_of_estimates_from_errors_that_are_alike():
    """Planted errors have a scatter of their own, which only residuals show; the weights do not count it.

    A variance from n draws scatters by sqrt(2 / n). The median of few independent residuals and places binned to a quarter of
    the correlation length change the stated one by up to a fifth; that of the weights is off by several times.
    """
    graph, exact = known_world()
    rng, draws, plain = np.random.default_rng(5), 200, marginals(graph.with_edges(exact)).anchors
    for anchor, size in enumerate((0.1, 0.4)):
        jacobian, weights, prior = system(graph, exact, anchor)
        gain = np.linalg.solve(
            jacobian.T @ (weights[:, None] * jacobian) + prior, np.column_stack([jacobian.T * weights, [0, 0, 5]])
        )
        root = size * np.linalg.cholesky(alike(graph.poses[:, :2] - PLACES[anchor]))
        found, stated = np.zeros((draws, 2)), np.zeros((2, 2))
        for k in range(draws):
            errors = np.zeros(2 * COUNT)
            errors[exact.anchor == anchor] = root @ rng.standard_normal(COUNT)
            moved = gain @ np.append(errors[exact.anchor == anchor], rng.standard_normal())
            found[k] = moved[:2]
            if k % 20 == 0:
                # The residuals are linear in the errors, and all that the answer depends on.
                residual = errors.copy()
                residual[exact.anchor == anchor] -= jacobian @ moved
                edges = replace(exact, ranges=exact.ranges + residual)
                stated += by_alike_errors(graph.with_edges(edges), edges, plain, CONFIG)[anchor] / (draws / 20)
        ratio = np.linalg.eigvals(np.linalg.solve(stated, found.T @ found / draws)).real
        np.testing.assert_allclose(ratio, 1.0, atol=3.0 * np.sqrt(2.0 / draws) + 0.2)
        by_weights = np.linalg.eigvals(np.linalg.solve(plain[anchor], found.T @ found / draws)).real
        assert np.abs(np.log(by_weights)).max() > np.log(2.0)


def test_what_residuals_show_is_the_trace_of_what_least_squares_leaves():
    graph, edges = known_world(30)
    jacobian, weights, prior = system(graph, edges, 1)
    errors = alike(graph.poses[:, :2] - PLACES[1])
    factors = weights[:, None] * jacobian
    inverse = np.linalg.inv(jacobian.T @ factors + prior)
    left = np.eye(30) - jacobian @ inverse @ factors.T
    expected = np.trace(left @ errors @ left.T) / 30
    assert _shown(inverse, jacobian, factors, errors @ factors) == pytest.approx(expected, rel=1e-9)


def test_an_anchor_that_is_given_and_one_without_ranges_stay_as_they_are():
    graph, edges = known_world()
    graph = replace(graph, fixed_anchors=np.array([True, False]))
    first = edges.rows(np.flatnonzero(edges.anchor == 0))
    np.testing.assert_array_equal(by_alike_errors(graph.with_edges(first), first, WHOLE, CONFIG), WHOLE)


def test_few_ranges_and_open_directions_change_nothing():
    """Ranges from one place leave the direction open: the inverse there is round-off, and a product with it still is."""
    graph, edges = known_world()
    few = edges.rows(np.arange(29))
    np.testing.assert_array_equal(by_alike_errors(graph.with_edges(few), few, WHOLE, CONFIG), WHOLE)
    standing = replace(edges, pose=np.zeros_like(edges.pose))
    standing = replace(standing, ranges=standing.distances(graph))
    np.testing.assert_array_equal(by_alike_errors(graph.with_edges(standing), standing, WHOLE, CONFIG), WHOLE)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.2])
def test_errors_of_the_poses_come_on_top_and_never_below(turn):
    """A covariance of the whole graph that was linearised elsewhere may be smaller than that of the anchors alone."""
    graph, edges = known_world()
    problem = graph.with_edges(edges)
    alone, turned = marginals(problem).anchors, se2.rotation(turn)[:2, :2]
    alike = by_alike_errors(problem, edges, alone, CONFIG)
    larger, smaller = turned @ np.diag([0.3, 0.1]) @ turned.T, turned @ np.diag([0.3, -10.0]) @ turned.T
    np.testing.assert_allclose(by_alike_errors(problem, edges, alone + larger, CONFIG), alike + larger, atol=1e-9)
    kept = turned @ np.diag([0.3, 0.0]) @ turned.T
    np.testing.assert_allclose(by_alike_errors(problem, edges, alone + smaller, CONFIG), alike + kept, atol=1e-9)
