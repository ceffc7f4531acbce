"""Covariances of anchors whose ranges err alike: those of the estimates that such errors make, by sampling them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import expected_ranges

from uwblite import se2
from uwblite.graph.calibration import BIAS, CalibrationConfig, block, prior_edges, range_indices, unknowns, with_free
from uwblite.graph.graph import Graph, edge_weights
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import optimize
from uwblite.radio.anchor_covariance import (
    _STEADY,
    _by_each_range,
    _scatter,
    _shown,
    anchors_with_correlated_errors,
    with_correlated_errors,
)
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
    return graph.with_edges(prior_edges(listed)), replace(edges, ranges=expected_ranges(edges, graph))


def alike(offsets):
    """Return the correlations (m, m) of errors at offsets (m, 2) from an anchor."""
    reach = np.hypot(*offsets.T)
    polar = np.stack([*(offsets.T / reach), np.log(reach)], axis=1)
    distance = np.linalg.norm(polar[:, None] - polar[None], axis=2)
    return _STEADY * np.exp(-distance / 0.5) + (1.0 - _STEADY) * np.eye(len(offsets))


def system(graph, edges, anchor):
    """Return J (m, 3) by place and bias, in m, W (m,) and the prior information (3, 3) of one anchor's ranges."""
    own = edges.rows(edges.anchor == anchor)
    towards = (graph.anchors[anchor] - graph.poses[own.pose, :2]) / expected_ranges(own, graph)[:, None]
    return np.column_stack([towards, np.ones(len(own))]), edge_weights(own, graph) / own.sigma**2, np.diag([0.0, 0.0, 25.0])


def test_the_stated_covariance_is_that_of_estimates_from_correlated_errors():
    """Planted errors have a scatter of their own, which only residuals show; the weights do not count it.

    A variance from n draws scatters by sqrt(2 / n). The median of few independent residuals and places binned to a quarter of
    the correlation length change the stated one by up to a fifth; that of the weights is off by several times.
    """
    graph, exact = known_world()
    rng, draws, plain = np.random.default_rng(5), 200, marginals(graph.with_edges(exact)).covariances.anchors
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
                stated += anchors_with_correlated_errors(graph.with_edges(edges), edges, plain, CONFIG)[anchor] / (draws / 20)
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
    np.testing.assert_array_equal(anchors_with_correlated_errors(graph.with_edges(first), first, WHOLE, CONFIG), WHOLE)


def test_few_ranges_and_open_directions_change_nothing():
    """Ranges from one place leave the direction open: the inverse there is round-off, and a product with it still is."""
    graph, edges = known_world()
    few = edges.rows(np.arange(29))
    np.testing.assert_array_equal(anchors_with_correlated_errors(graph.with_edges(few), few, WHOLE, CONFIG), WHOLE)
    standing = replace(edges, pose=np.zeros_like(edges.pose))
    standing = replace(standing, ranges=expected_ranges(standing, graph))
    np.testing.assert_array_equal(anchors_with_correlated_errors(graph.with_edges(standing), standing, WHOLE, CONFIG), WHOLE)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.2])
def test_errors_of_the_poses_come_on_top_and_never_below(turn):
    """A covariance of the whole graph that was linearised elsewhere may be smaller than that of the anchors alone."""
    graph, edges = known_world()
    problem = graph.with_edges(edges)
    alone, turned = marginals(problem).covariances.anchors, se2.rotation(turn)[:2, :2]
    alike = anchors_with_correlated_errors(problem, edges, alone, CONFIG)
    larger, smaller = turned @ np.diag([0.3, 0.1]) @ turned.T, turned @ np.diag([0.3, -10.0]) @ turned.T
    grown = anchors_with_correlated_errors(problem, edges, alone + larger, CONFIG)
    np.testing.assert_allclose(grown, alike + larger, atol=1e-9)
    kept = turned @ np.diag([0.3, 0.0]) @ turned.T
    np.testing.assert_allclose(anchors_with_correlated_errors(problem, edges, alone + smaller, CONFIG), alike + kept, atol=1e-9)


def driven_world(size, seed, scale=1.0):
    """Return a graph of a path among three anchors, at its optimum, and the correlations (m, m) of the errors of its ranges.

    Parameters
    ----------
    size : standard deviation of these errors, m. scale : of the odometry's standard deviations.
    """
    rng, ids, count = np.random.default_rng(seed), ("1", "2", "3"), 60
    turn = np.linspace(0.0, 2.0 * np.pi, count)
    poses = np.column_stack([5.0 * np.sin(turn), 4.0 - 4.0 * np.cos(turn), turn])
    anchors = np.array([[9.0, 3.0], [-6.0, 12.0], [-7.0, -3.0]])
    listed = unknowns(CalibrationConfig(range_bias=0.2), ids, np.ones(3, dtype=bool))
    calibration = block(listed)
    graph = Graph(poses, anchors, (), calibration, fixed_poses=np.arange(count) == 0)
    graph = with_free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), BIAS)
    i = np.arange(count - 1)
    information = np.tile(np.diag([50.0, 50.0, 200.0]) / scale, (count - 1, 1, 1))
    noise = scale * rng.standard_normal((count - 1, 3)) / [50.0, 50.0, 200.0]
    steps = RelativePoseEdges(i, i + 1, se2.between(poses[:-1], poses[1:]) + noise, information)
    pose, anchor = np.repeat(np.arange(count), 3), np.tile(np.arange(3), count)
    still, none = np.zeros(len(pose)), np.zeros((len(pose), 2))
    edges = RangeEdges(
        pose, anchor, still, np.full(len(pose), 0.05), none, still, none, np.zeros(2), still,
        range_indices(calibration, anchor, ids), weights=np.full(len(pose), 0.1),
    )  # fmt: skip
    offsets = poses[pose, :2] - anchors[anchor]
    logs = np.log(np.hypot(*offsets.T))
    by_distance = np.exp(-np.abs(logs[:, None] - logs) / 0.5)
    own = (alike(offsets) - (1.0 - _STEADY) * np.eye(len(pose))) * (anchor[:, None] == anchor)
    correlation = 0.5 * own + 0.5 * _STEADY * by_distance + (1.0 - _STEADY) * np.eye(len(pose))
    errors = size * np.linalg.cholesky(correlation) @ rng.standard_normal(len(pose))
    edges = replace(edges, ranges=expected_ranges(edges, graph) + errors)
    return optimize(graph.with_edges(prior_edges(listed), steps, edges))[0], correlation


def test_of_poses_that_rest_on_ranges_the_covariance_is_the_sandwich_of_their_correlated_errors():
    """Against dense matrices, at the size that the recording shows: the planted one, but for the scatter of some ten errors."""
    graph, correlation = driven_world(0.3, 1)
    edges, chosen = graph.edges[-1], np.arange(0, 60, 4)
    plain = marginals(graph, among=chosen)
    before = plain.covariances.poses.copy()
    found = with_correlated_errors(plain, graph, edges, RangeNoiseConfig(sigma=0.3))
    np.testing.assert_array_equal(plain.covariances.poses, before)
    size = plain.unknowns.size
    inverse = plain.columns(np.arange(size))[:-1]
    linear, jacobian = edges.linearize(graph), np.zeros((len(edges), size + 1))
    for name, index, values in linear.blocks:
        number = plain.unknowns.number[name][index]
        np.add.at(jacobian, (np.arange(len(edges))[:, None], number), values[:, 0])
    jacobian = jacobian[:, :-1] * edges.sigma[:, None]
    weights = edge_weights(edges, graph) / edges.sigma**2
    gain = inverse @ (jacobian.T * weights)

    def dense(scatter):
        return inverse + gain @ (scatter**2 * correlation - np.diag(1.0 / weights)) @ gain.T

    number = plain.unknowns.number["anchors"]
    grown, least = (np.trace(found.anchors[0]) - np.trace(dense(0.0)[np.ix_(number[0], number[0])])), dense(0.0)
    unit = np.trace(dense(1.0)[np.ix_(number[0], number[0])]) - np.trace(least[np.ix_(number[0], number[0])])
    scatter = np.sqrt(grown / unit)
    assert 0.5 * 0.3 < scatter < 2.0 * 0.3
    # Directions and distances are binned to a quarter of their correlation length.
    true = dense(scatter)
    for k, own in enumerate(number):
        np.testing.assert_allclose(found.anchors[k], true[np.ix_(own, own)], rtol=0.1, atol=0.1 * np.trace(found.anchors[k]))
    own = plain.unknowns.number["poses"][chosen[1:]].ravel()
    np.testing.assert_allclose(np.diagonal(found.among)[3:], np.diagonal(true)[own], rtol=0.15)
    for k, block_of in zip(chosen[1:], np.split(found.among[3:, 3:], len(chosen) - 1), strict=True):
        at = 3 * (np.flatnonzero(chosen == k)[0] - 1)
        np.testing.assert_allclose(found.poses[k], block_of[:, at : at + 3], rtol=1e-6, atol=1e-9 * np.trace(found.poses[k]))


def test_between_chosen_poses_the_whole_covariance_is_nearly_what_it_would_be_if_they_were_chosen():
    """Its shape as well as its size: what ranges have in common turns the ellipse of a place, and ties it to the heading."""
    graph, _ = driven_world(0.3, 1, scale=5.0)
    edges, config = graph.edges[-1], RangeNoiseConfig(sigma=0.3)
    some, every = (
        with_correlated_errors(marginals(graph, among=np.arange(0, 60, step)), graph, edges, config).poses[4:57]
        for step in (4, 1)
    )
    relative = np.linalg.eigvals(np.linalg.solve(every, some)).real
    np.testing.assert_allclose(relative, 1.0, atol=0.2)
    sigma = np.sqrt(np.einsum("nii->ni", every) / np.einsum("nii->ni", marginals(graph).covariances.poses[4:57]))
    scaled = sigma[:, :, None] * marginals(graph).covariances.poses[4:57] * sigma[:, None, :]
    assert np.abs(np.linalg.eigvals(np.linalg.solve(every, scaled)).real - 1.0).max() > 0.5


@pytest.mark.parametrize("scale", [0.1, 5.0])
def test_how_large_errors_are_is_found_whether_stiff_odometry_shows_them_or_soft_odometry_hides_half(scale):
    """A standard deviation from some 20 errors that are not alike, in each of five draws, scatters by 7 %."""
    found, seen = [], []
    for seed in range(5):
        graph, _ = driven_world(0.3, seed, scale)
        around, edges = marginals(graph, among=np.arange(3)), graph.edges[-1]
        offsets = edges.tag_positions(graph.poses) - graph.anchors[edges.anchor]
        found.append(_scatter(around, graph, edges, RangeNoiseConfig(sigma=0.3), _by_each_range(around, edges), offsets))
        seen.append(np.std(edges.residuals(graph)[:, 0] * edges.sigma))
    assert np.mean(found) == pytest.approx(0.3, rel=0.2)
    assert (np.mean(seen) < 0.2) == (scale > 1.0)


def test_where_nothing_is_assumed_to_be_steady_or_no_range_counts_covariances_stay():
    graph, _ = driven_world(0.3, 1)
    edges = graph.edges[-1]
    unused = replace(edges, weights=np.zeros(len(edges)))
    for ranges, config in ((edges, RangeNoiseConfig(steady=0.0)), (unused, RangeNoiseConfig())):
        found = marginals(graph, among=np.arange(0, 60, 4))
        assert with_correlated_errors(found, graph, ranges, config) is found.covariances
    whole = np.full((len(graph.anchors), 2, 2), 3.0)
    assert anchors_with_correlated_errors(graph, edges, whole, RangeNoiseConfig(steady=0.0)) is whole


def test_ranges_that_were_left_out_change_nothing():
    graph, edges = known_world()
    every = np.arange(len(edges)) % 5 == 0
    weighed = replace(edges, weights=np.where(every, 0.0, edges.weights), ranges=edges.ranges + 3.0 * every)
    kept = edges.rows(np.flatnonzero(~every))
    found, alone = (anchors_with_correlated_errors(graph.with_edges(each), each, WHOLE, CONFIG) for each in (weighed, kept))
    np.testing.assert_allclose(found, alone, rtol=1e-9)
    assert np.abs(found - WHOLE).max() > 1e-6
