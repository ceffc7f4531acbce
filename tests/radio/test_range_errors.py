"""Errors of a map's ranges, interpolated over the floor."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import plain_ranges, relative_edges

from uwblite import se2
from uwblite.graph.calibration import UnknownKey
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.marginals import marginals
from uwblite.graph.solver import optimize
from uwblite.radio.range_errors import HARMONICS, PATTERN_SIGMA, pattern_waves, range_errors, without_pattern

WHITE = 0.04


def wandering(rng, count, size=8.0):
    """Return places (n, 2) all over a square floor, m, and directions (n,) of the anchor in the robot's frame, rad."""
    return rng.uniform(0.0, size, (count, 2)), rng.uniform(-np.pi, np.pi, count)


def bumpy(places):
    """Return the error (n,), m, that stays with places."""
    return 0.12 * np.sin(places[:, 0] / 1.5) * np.cos(places[:, 1] / 1.5)


def test_errors_that_stay_with_a_place_are_found_again_there():
    rng = np.random.default_rng(1)
    tags, bearings = wandering(rng, 800)
    anchor = rng.integers(0, 2, 800)
    measured = np.where(anchor == 0, bumpy(tags), 0.07) + WHITE * rng.standard_normal(800)
    measured[::20] += rng.exponential(2.0, 40)
    one, other = range_errors(anchor, tags, bearings, measured, 2)
    again, _ = wandering(rng, 400, 7.0)
    again += 0.5
    # Some ten ranges to an anchor lie within the length over which errors are alike: white noise of 0.04 m leaves about 0.015.
    assert np.sqrt(np.mean((one.at(again) - bumpy(again)) ** 2)) < 0.035 < 0.6 * np.std(bumpy(again))
    assert np.sqrt(np.mean((other.at(again) - 0.07) ** 2)) < 0.025


def test_what_the_robot_itself_makes_of_a_direction_is_not_the_places():
    rng = np.random.default_rng(2)
    tags, bearings = wandering(rng, 600)
    body = 0.15 * np.maximum(np.cos(bearings - np.pi), 0.0)
    facing = bearings.copy()
    facing[tags[:, 0] > 4.0] = np.pi
    measured = 0.15 * np.maximum(np.cos(facing - np.pi), 0.0) + WHITE * rng.standard_normal(600)
    (found,) = range_errors(np.zeros(600, np.intp), tags, facing, measured, 1)
    halves = [found.at(np.column_stack([np.full(50, x), np.linspace(1.0, 7.0, 50)])).mean() for x in (2.0, 6.0)]
    # The half in which the robot always stood between differs by 0.15 - mean(body) = 0.10 m where nothing is taken off.
    assert abs(halves[1] - halves[0]) < 0.5 * (0.15 - body.mean())


def test_far_from_the_path_the_mean_error_remains():
    rng = np.random.default_rng(3)
    tags, bearings = wandering(rng, 300)
    (found,) = range_errors(np.zeros(300, np.intp), tags, bearings, 0.2 + bumpy(tags), 1)
    np.testing.assert_allclose(found.at(np.array([[500.0, 0.0]])), 0.2, atol=0.03)


def test_ranges_of_one_square_are_averaged_and_long_recordings_stay_small():
    rng = np.random.default_rng(4)
    tags, bearings = wandering(rng, 4000, 40.0)
    (found,) = range_errors(np.zeros(4000, np.intp), tags, bearings, bumpy(tags), 1)
    assert found.table.size <= 10_500
    (standing,) = range_errors(np.zeros(50, np.intp), np.full((50, 2), 1.1), bearings[:50], np.full(50, 0.1), 1)
    peak = standing.origin + standing.cell * np.array(np.unravel_index(standing.table.argmax(), standing.table.shape))
    np.testing.assert_allclose(peak, 1.1, atol=standing.cell)


def test_no_ranges_no_errors():
    (found,) = range_errors(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), np.zeros(0), 1)
    np.testing.assert_array_equal(found.at(np.zeros((3, 2))), 0.0)


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


def test_a_pattern_is_beforehand_about_as_large_as_those_that_were_measured():
    """0.06 m in radiation patterns, 0.1 m behind a body (rms over all directions)."""
    usual = PATTERN_SIGMA * np.sqrt(np.sum(pattern_waves(np.linspace(-np.pi, np.pi, 360, endpoint=False)) ** 2, axis=1))
    np.testing.assert_allclose(usual, usual[0])
    assert 0.06 < usual[0] < 0.1


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
