"""What the robot's own body and antenna make of ranges: planted, and found again."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import plain_ranges, relative_edges

from uwblite import se2
from uwblite.graph.calibration import UnknownKey
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.marginals import marginals
from uwblite.graph.solver import optimize
from uwblite.radio.tag_pattern import HARMONICS, pattern_waves, without_pattern

NOISE = 0.04
ANCHORS = np.array([[-6.0, 10.0], [7.0, 9.0], [0.0, -4.0]])


def drive(seed, pattern):
    """Return a solved graph of two rounds of an eight, its 400 ranges, and by how much they are late in their direction."""
    rng, n = np.random.default_rng(seed), 400
    angle = np.arange(n) * 4.0 * np.pi / n
    heading = np.arctan2(8.0 * np.cos(2.0 * angle), 6.0 * np.cos(angle))
    truth = np.column_stack([6.0 * np.sin(angle), 4.0 * np.sin(2.0 * angle), heading])
    pose, anchor = np.arange(n), rng.integers(len(ANCHORS), size=n, dtype=np.intp)
    way = ANCHORS[anchor] - truth[:, :2]
    late = pattern(se2.wrap_angle(se2.bearing(way) - truth[:, 2]))
    ranges = plain_ranges(pose, anchor, np.hypot(*way.T) + late + NOISE * rng.standard_normal(n), NOISE)
    steps = relative_edges(truth, pose[:-1], pose[1:], [0.003, 0.003, 0.002], rng)
    fixed = np.arange(n) == 0
    graph = optimize(Graph(truth, ANCHORS, (steps, ranges), fixed_poses=fixed))[0]
    return graph, ranges, late


def shadow(angle):
    """Return a delay of up to 0.15 m behind the robot."""
    return 0.15 * np.maximum(-np.cos(angle), 0.0) ** 2


def test_the_shadow_of_the_body_is_found():
    """Six coefficients from 400 ranges: 0.04 sqrt(6 / 400) = 0.005 m; as much again for what three harmonics cannot show."""
    graph, ranges, late = drive(1, shadow)
    found = without_pattern(ranges, graph, marginals(graph))
    np.testing.assert_array_equal(found.ranges, ranges.ranges)
    off = found.late - late
    assert np.std(off) < 0.010 < 0.2 * np.ptp(late)
    np.testing.assert_allclose(found.corrected, ranges.ranges - found.late)


def test_without_a_pattern_next_to_nothing_is_taken_off():
    graph, ranges, _ = drive(2, np.zeros_like)
    assert np.std(without_pattern(ranges, graph, marginals(graph)).late) < 0.010


def test_what_is_left_comes_on_top():
    """The second time finds what the prior held back the first time, and no more of it."""
    graph, ranges, late = drive(3, shadow)
    once = without_pattern(ranges, graph, marginals(graph))
    graph = optimize(replace(graph, edges=(graph.edges[0], once)))[0]
    twice = without_pattern(once, graph, marginals(graph))
    assert np.std(twice.late - once.late) < 0.25 * np.std(once.late)
    assert np.std(twice.late - late) < 0.010


def test_each_recording_has_its_own_pattern():
    """The same ranges as of two tags, in turn: one late behind the robot, the other as much too early there."""
    graph, ranges, _ = drive(4, np.zeros_like)
    second = np.arange(len(ranges)) % 2 == 1
    way = ANCHORS[ranges.anchor] - graph.poses[ranges.pose, :2]
    late = np.where(second, -1.0, 1.0) * shadow(se2.bearing(way) - graph.poses[ranges.pose, 2])
    calibration = ranges.calibration.copy()
    calibration[:, 3] = second
    tags = Calibration((UnknownKey("tag_x"), UnknownKey("tag_x", recording=1)), np.zeros(2))
    graph = replace(graph, calibration=tags, fixed_calibration=np.ones(2, dtype=bool))
    spoilt = replace(ranges, ranges=ranges.ranges + late)
    graph = optimize(replace(graph, edges=(graph.edges[0], spoilt)))[0]
    around = marginals(graph)
    apart = without_pattern(replace(spoilt, calibration=calibration), graph, around)
    # The harmonics have no mean: that is the tag's bias.
    assert all(np.std((apart.late - late)[of_tag]) < 0.015 for of_tag in (second, ~second))
    assert np.std(without_pattern(spoilt, graph, around).late) < 0.015


def test_waves_are_the_harmonics():
    angle = np.array([0.0, 0.5, -2.0])
    waves = pattern_waves(angle)
    assert waves.shape == (3, 2 * HARMONICS)
    np.testing.assert_allclose(waves[:, 0] ** 2 + waves[:, HARMONICS] ** 2, 1.0)
    np.testing.assert_allclose(waves[:, 2], np.cos(3 * angle))
