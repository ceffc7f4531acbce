"""Heights that anchors have in common, along a corridor that shows few of them."""

import numpy as np
import pytest
from helpers.planted import ranges

from uwblite.graph.calibration import HEIGHT, CalibrationConfig, block, prior_edges, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.solver import optimize
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.radio.prior_selection import _common, with_alike_heights
from uwblite.radio.range_measurements import range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.sensor_log import LONGEST_RANGE, Odometry, SensorMounting, UwbRanges

PLACES = np.array([[3.0, -1.0], [30.0, -1.0], [61.0, 3.0], [61.0, 20.0], [57.0, 41.0], [30.0, 41.0], [3.0, 41.0], [-1.0, 20.0]])
"""Those near corners are seen from two sides."""


def around():
    """Return stamps and poses of a drive along the four corridors of a block of 60 by 40 m."""
    corners = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0], [0.0, 0.0]])
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    at = np.arange(0.0, lengths.sum(), 0.05)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    side = np.minimum(np.searchsorted(ends, at, "right") - 1, 3)
    x, y = (np.interp(at, ends, corners[:, k]) for k in range(2))
    return at / 0.5, np.column_stack([x, y, (np.pi / 2.0) * side])


def solved(seed, heights, anchors=slice(None)):
    """Return the graph of the drive, its poses known, solved for anchors, biases and heights under priors of 0."""
    rng, places, heights = np.random.default_rng(seed), PLACES[anchors], np.asarray(heights)[anchors]
    stamps, truth = around()
    radio = ranges(rng, stamps, truth, places, rate=0.5, sigma=0.0)
    slant = np.hypot(radio.ranges, heights[radio.anchor]) + 0.15 * rng.standard_normal(len(radio.ranges))
    heard = radio.ranges < 18.0
    radio = UwbRanges(radio.stamps[heard], radio.anchor[heard], slant[heard], radio.quality[heard], radio.anchor_ids)
    wheels, level = Odometry(stamps, truth), SensorMounting()
    frames, ids = select(wheels, KeyframeConfig()), radio.anchor_ids
    listed = unknowns(CalibrationConfig(), ids, np.zeros(len(ids), dtype=bool))
    attached = attach_ranges(radio, wheels, frames, level)
    edges = range_edges(attached, ids, level, block(listed), RangeNoiseConfig(0.15), LONGEST_RANGE)
    constant = np.array([u.key.kind not in (HEIGHT, "bias") for u in listed])
    fixed = np.ones(len(frames), dtype=bool)
    graph = Graph(frames.odometry, places.copy(), (prior_edges(listed),), block(listed), fixed, fixed_calibration=constant)
    return optimize(graph.with_edges(edges))[0], places


def off(graph, places):
    return float(np.sqrt(np.mean(np.sum((graph.anchors - places) ** 2, axis=1))))


@pytest.mark.parametrize("height", [2.0, 3.5])
def test_anchors_as_high_as_each_other_come_nearer_to_their_places(height):
    """High ones, of which independent priors say that they stand farther from the corridor; the more so the higher they are."""
    before, after = [], []
    for seed in range(4):
        graph, places = solved(seed, np.full(8, height))
        before.append(off(graph, places))
        after.append(off(optimize(with_alike_heights(graph))[0], places))
    assert np.mean(after) < 0.25 * np.mean(before)


def test_anchors_of_different_heights_keep_what_their_ranges_say():
    """Low ones and one on the ceiling: the heights' spread is learnt, so that none is drawn to the others' mean."""
    graph, places = solved(1, np.array([0.3, 4.0, 0.2, 0.4, 4.5, 0.3, 0.5, 0.2]))
    after = optimize(with_alike_heights(graph))[0]
    assert off(after, places) < 1.2 * off(graph, places) + 0.02


def test_two_anchors_have_nothing_in_common():
    graph, _ = solved(0, np.full(8, 2.0), slice(2))
    assert with_alike_heights(graph) is graph


@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_the_common_mean_is_that_of_well_measured_heights(spread):
    """Of many heights that ranges show well, mean and spread are theirs."""
    rng = np.random.default_rng(3)
    true = 2.0 + spread * rng.standard_normal(40)
    covariance = np.diag(1.0 / (0.05**-2.0 + 2.25**-2.0) * np.ones(40))
    values = covariance @ (true / 0.05**2)
    mean, width = _common(values, covariance, np.full(40, 2.25))
    assert mean == pytest.approx(true.mean(), abs=0.05)
    assert width == pytest.approx(np.hypot(true.std(), true.std() / np.sqrt(40)), rel=0.35)
