"""Errors of a map's ranges, interpolated over the floor."""

import numpy as np

from uwblite.radio.range_errors import range_errors

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
    assert len(found.places) <= 400
    (standing,) = range_errors(np.zeros(50, np.intp), np.full((50, 2), 1.1), bearings[:50], np.full(50, 0.1), 1)
    np.testing.assert_allclose(standing.places, [[1.1, 1.1]])


def test_no_ranges_no_errors():
    (found,) = range_errors(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), np.zeros(0), 1)
    np.testing.assert_array_equal(found.at(np.zeros((3, 2))), 0.0)
