"""From keyframes to edges of ranges: tied to the right unknowns, noise estimated per anchor."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import ranges, wander
from helpers.planted_graphs import expected_ranges

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.radio.range_measurements import learn_noise, log_densities, range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.sensor_log import LONGEST_RANGE, Odometry, SensorMounting

MOUNTING = SensorMounting(tag_position=np.array([0.2, -0.1, 0.4]), anchor_height=2.4)


def world(seed, metres=40.0, anchors=3, **settings):
    """Return stamps, truth, keyframes, places of anchors and edges of a path with exact odometry."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, metres)
    places = rng.uniform(-6, 6, (anchors, 2))
    radio = ranges(rng, stamps, truth, places, tag=MOUNTING.tag_position[:2], **settings)
    wheels = Odometry(stamps, truth)
    frames = select(wheels, KeyframeConfig())
    attached = attach_ranges(radio, wheels, frames, MOUNTING)
    edges = range_edges(attached, radio.anchor_ids, MOUNTING, Calibration(), RangeNoiseConfig(0.3), LONGEST_RANGE)
    return stamps, truth, frames, places, radio, edges


def test_range_edges_measure_the_slant_distance_of_tag_and_anchor():
    stamps, truth, frames, places, radio, edges = world(1, sigma=0.0)
    height = MOUNTING.height_difference(radio.anchor_ids[0])
    tag = se2.transform(se2.interpolate_trajectory(stamps, truth, radio.stamps), MOUNTING.tag_position[:2])
    np.testing.assert_allclose(edges.tag_positions(truth[frames.index]), tag, atol=1e-9)
    expected = np.hypot(np.hypot(*(tag - places[radio.anchor]).T), height)
    np.testing.assert_allclose(expected_ranges(edges, Graph(truth[frames.index], places)), expected, atol=1e-9)
    np.testing.assert_array_equal(edges.sigma, 0.3)
    np.testing.assert_array_equal(edges.stamps, radio.stamps)


def test_readings_that_cannot_be_distances_weigh_nothing():
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 10.0)
    radio, wheels = ranges(rng, stamps, truth, np.zeros((1, 2))), Odometry(stamps, truth)
    radio.ranges[:4] = [0.0, -1.0, 1e6, 0.001]
    attached = attach_ranges(radio, wheels, select(wheels, KeyframeConfig()), MOUNTING)
    edges = range_edges(attached, radio.anchor_ids, MOUNTING, Calibration(), RangeNoiseConfig(0.1), LONGEST_RANGE)
    assert edges.weights.tolist() == [0.0] * 4 + [1.0] * (len(radio.ranges) - 4)


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_each_anchor_gets_the_noise_of_its_own(outliers):
    """White noise of 0.05 and 0.25 m. A fifth of the tag's places is visited again and again, so sigma may exceed the noise
    of one range by the slow part that pure chance shows; it never falls below it, and outliers do not swell it."""
    _, truth, frames, places, _, edges = world(4, 150.0, 2, sigma=0.0, rate=4.0)
    rng = np.random.default_rng(5)
    noise = np.array([0.05, 0.25])[edges.anchor] * rng.standard_normal(len(edges))
    noise += np.where(rng.random(len(edges)) < outliers, rng.uniform(2, 6, len(edges)), 0.0)
    graph = Graph(truth[frames.index], places)
    noisy = replace(edges, ranges=expected_ranges(edges, graph) + noise)
    learnt, noises = learn_noise(noisy, graph, 2, RangeNoiseConfig())
    # 30 % outliers shift the quartiles: 1.4826 MAD grows by up to a factor 1.7, and those beyond thrice that are left out.
    assert [n.sigma for n in noises] == [pytest.approx(s, rel=0.12 + outliers) for s in (0.05, 0.25)]
    for k, sigma in enumerate((0.05, 0.25)):
        assert np.all(learnt.sigma[learnt.anchor == k] > (0.85 - outliers / 2) * sigma)
    assert np.median(learnt.sigma[learnt.anchor == 1]) > 2 * np.median(learnt.sigma[learnt.anchor == 0])


def test_an_anchor_with_hardly_any_range_keeps_the_assumption():
    _, truth, frames, places, _, edges = world(8, 40.0, 2)
    weights = np.where(edges.anchor == 0, 1.0, 0.0)
    weights[np.flatnonzero(edges.anchor == 1)[:3]] = 1.0
    config = RangeNoiseConfig(sigma=0.4)
    _, noises = learn_noise(replace(edges, weights=weights), Graph(truth[frames.index], places), 2, config)
    assert noises[1].sigma == pytest.approx(0.4)


def test_a_range_is_an_outlier_by_what_one_range_scatters():
    """A hundred alike ranges weigh little each, yet one that is 10 sigma off hardly pulls."""
    rng = np.random.default_rng(6)
    stamps, truth = wander(rng, 60.0, half_width=2.0)
    places = np.array([[8.0, 0.0]])
    radio = ranges(rng, stamps, truth, places, sigma=0.05, rate=8.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    attached = attach_ranges(radio, Odometry(stamps, truth), frames, SensorMounting())
    noise = RangeNoiseConfig(0.3)
    edges = range_edges(attached, radio.anchor_ids, SensorMounting(), Calibration(), noise, LONGEST_RANGE)
    slow = 0.15 * np.sin(edges.tag_positions(truth[frames.index]).sum(axis=1))
    edges = replace(edges, ranges=edges.ranges + slow + np.where(np.arange(len(edges)) == 40, 2.0, 0.0))
    graph = Graph(truth[frames.index], places)
    learnt, (noise,) = learn_noise(edges, graph, 1, RangeNoiseConfig())
    np.testing.assert_allclose(learnt.sigma, noise.sigma)
    assert np.median(learnt.weights) < 0.3
    assert learnt.weights[40] < 0.05 * np.median(learnt.weights)


def test_late_ranges_pull_less_than_early_ones():
    _, truth, frames, places, _, edges = world(9, 150.0, 1, sigma=0.0, rate=4.0)
    rng, graph = np.random.default_rng(7), Graph(truth[frames.index], places)
    late = np.where(rng.random(len(edges)) < 0.3, rng.exponential(0.6, len(edges)), 0.0)
    noisy = replace(edges, ranges=expected_ranges(edges, graph) + 0.05 * rng.standard_normal(len(edges)) + late)
    learnt, _ = learn_noise(noisy, graph, 1, RangeNoiseConfig())
    off = noisy.ranges - expected_ranges(edges, graph)
    mean = learnt.weights @ off / learnt.weights.sum()
    assert abs(mean) < 0.03 < np.median(off) + 0.01 < np.mean(off)
    # What is late by two or three sigmas is in part a delay; what is early by as much is noise.
    spans = ((-0.03, 0.03), (0.1, 0.15), (-0.15, -0.1))
    prompt, late, early = (np.median(learnt.weights[(off > a) & (off < b)]) for a, b in spans)
    assert late < 0.7 * prompt
    assert early == pytest.approx(prompt, rel=0.05)
    plain, _ = learn_noise(noisy, graph, 1, RangeNoiseConfig(learn=False))
    assert plain.weights @ off / plain.weights.sum() > 0.1


def test_ranges_of_weight_zero_teach_no_noise():
    _, truth, frames, places, _, edges = world(10, metres=80.0, anchors=2, sigma=0.05)
    edges = replace(edges, height=np.zeros(len(edges)))
    graph = Graph(truth[frames.index], places)
    wrong = places + np.array([[2.0, -1.0], [0.0, 0.0]])
    agreeing = replace(edges, ranges=expected_ranges(edges, graph.updated(graph.poses, wrong, np.zeros(0))))
    off = np.arange(len(edges)) % 4 != 0
    mixed = replace(edges, ranges=np.where(off, agreeing.ranges, edges.ranges), weights=np.where(off, 0.0, 1.0))
    learnt, noises = learn_noise(mixed, graph, 2, RangeNoiseConfig())
    rest, alone = learn_noise(edges.rows(np.flatnonzero(~off)), graph, 2, RangeNoiseConfig())
    assert [(n.white, n.slow, n.length) for n in noises] == [(n.white, n.slow, n.length) for n in alone]
    np.testing.assert_array_equal(learnt.weights[off], 0.0)
    np.testing.assert_array_equal(learnt.sigma[off], edges.sigma[off])
    np.testing.assert_array_equal(learnt.weights[~off], rest.weights)
    nothing = replace(edges, weights=np.zeros(len(edges)))
    silent, unknown = learn_noise(nothing, graph, 2, RangeNoiseConfig(sigma=0.4))
    assert [n.sigma for n in unknown] == pytest.approx([0.4, 0.4])
    assert not silent.weights.any()


def test_what_is_steady_does_not_depend_on_where_the_map_frame_lies():
    _, truth, frames, places, _, edges = world(12)
    config = RangeNoiseConfig(learn=False, slow_share=0.0)
    one, other = (
        learn_noise(edges, Graph(truth[frames.index] + [*away, 0.0], places + away), 3, config, steady=True)[0].weights
        for away in (np.zeros(2), np.array([5.0, -7.0]))
    )
    np.testing.assert_allclose(one, other, rtol=1e-9)
    assert np.ptp(one) > 0.01


def test_ranges_through_something_weigh_together_as_one_draw_of_their_delay():
    _, truth, frames, places, _, edges = world(11, 150.0, 1, sigma=0.0, rate=4.0)
    rng, graph = np.random.default_rng(8), Graph(truth[frames.index], places)
    through = edges.tag_positions(graph.poses)[:, 0] > 0.0
    late = np.where(through, 0.4, 0.0)
    noisy = replace(edges, ranges=expected_ranges(edges, graph) + 0.05 * rng.standard_normal(len(edges)) + late)
    learnt, (noise,) = learn_noise(noisy, graph, 1, RangeNoiseConfig(), steady=True, blocked=through)
    information = learnt.weights / learnt.sigma**2
    assert 0.3 < through.mean() < 0.7
    assert noise.sigma < 0.1
    # Their common delay of 0.4 m, spread() of which is 1.4826 times as much, at the least.
    assert information[through].sum() < 1.0 / 0.4**2
    poses, _ = learn_noise(noisy, graph, 1, RangeNoiseConfig(), blocked=through)
    for_poses = poses.weights / poses.sigma**2
    assert information[through].sum() < for_poses[through].sum() < 0.2 * for_poses[~through].sum()
    none, _ = learn_noise(noisy, graph, 1, RangeNoiseConfig(), blocked=np.zeros(len(edges), dtype=bool))
    plain, _ = learn_noise(noisy, graph, 1, RangeNoiseConfig())
    np.testing.assert_array_equal(none.weights, plain.weights)


@pytest.mark.parametrize(("clear", "least", "most"), [(30, 0.0, 0.2), (29, 0.5, 2.0)])
def test_noise_is_learnt_from_clear_ranges_where_there_are_thirty(clear, least, most):
    """Of others, that went through something, the delays scatter by a metre; where fewer are clear, all count."""
    _, truth, frames, places, _, edges = world(9, 150.0, 1, sigma=0.0, rate=4.0)
    rng, graph = np.random.default_rng(7), Graph(truth[frames.index], places)
    blocked = np.ones(len(edges), dtype=bool)
    blocked[np.linspace(0, len(edges) - 1, clear).astype(int)] = False
    error = np.where(blocked, rng.normal(0.0, 1.0, len(edges)), rng.normal(0.0, 0.06, len(edges)))
    noisy = replace(edges, ranges=expected_ranges(edges, graph) + error)
    _, (noise,) = learn_noise(noisy, graph, 1, RangeNoiseConfig(), blocked=blocked)
    assert least < noise.sigma < most


def test_densities_of_ranges_are_normalised_and_counted_once_where_errors_last():
    """By what is expected of normal errors, -log(sigma) - log(2 pi e) / 2 each; a range without weight counts for nothing."""
    config = RangeNoiseConfig()
    _, truth, frames, places, _, edges = world(1, metres=150.0, sigma=0.0)
    graph = Graph(truth[frames.index], places)
    edges = replace(edges, ranges=expected_ranges(edges, graph) + 0.1 * np.random.default_rng(6).standard_normal(len(edges)))
    learnt = learn_noise(edges, graph, 3, config)[0]
    density, share = log_densities(learnt, graph, config.min_sigma)
    assert density.mean() == pytest.approx(-np.log(0.1) - 0.5 * np.log(2.0 * np.pi * np.e), abs=0.1)
    assert np.all((share > 0.0) & (share <= 1.0))
    # An error that is the same for all ranges nearby.
    lasting = replace(edges, ranges=edges.ranges + 0.2 * np.sin(graph.poses[edges.pose, 0] / 1.5))
    assert log_densities(learn_noise(lasting, graph, 3, config)[0], graph, config.min_sigma)[1].sum() < 0.5 * share.sum()
    weights = learnt.own_weights * (np.arange(len(learnt)) >= 10)
    density, share = log_densities(replace(learnt, weights=weights), graph, config.min_sigma)
    assert not share[:10].any()
    assert not density[:10].any()
    assert share[10:].all()
