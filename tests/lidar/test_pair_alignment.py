"""Alignment of many pairs at once: one step as the matches say, none too long, and where it ends."""

import numpy as np
import pytest
from helpers.laser_walks import ROOM, scanned

from uwblite import se2
from uwblite.lidar.pair_alignment import align_pairs
from uwblite.lidar.scan_matching import match, pair_points, rasterize, trusted_step

TRUTH = np.array([[0.0, 0.0, 0.3], [0.5, -0.4, 0.9], [-0.6, 0.2, -2.0]])
I, J = np.array([0, 0, 2]), np.array([1, 2, 1])


@pytest.fixture(scope="module")
def world():
    """Clouds, their raster, the points of each pair and the true poses of the pairs."""
    clouds = scanned(TRUTH, ROOM, 0.005, 1)
    return clouds, rasterize(clouds, 0.05, 0.8), pair_points(clouds, J, 200), se2.between(TRUTH[I], TRUTH[J])


def test_one_iteration_is_one_step_of_the_matches(world):
    clouds, raster, points, exact = world
    guess = exact + np.array([0.05, -0.04, 0.03])
    step = trusted_step(match(clouds, raster, I, guess, points, 0.3, 0.15))[0]
    assert 0.01 < np.abs(step).max() < 0.15
    found = align_pairs(clouds, raster, I, J, guess, points, 0.3, 0.3, iterations=1)
    np.testing.assert_allclose(se2.between(found.pose, guess + step), 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.factors.matched, match(clouds, raster, I, found.pose, points, 0.3, 0.15).matched)


def test_no_step_is_longer_than_allowed(world):
    """0.3 m and 0.15 rad; a longer one keeps its direction."""
    clouds, raster, points, exact = world
    guess = exact + np.array([0.6, 0.5, 0.1])
    step = trusted_step(match(clouds, raster, I, guess, points, 0.8, 0.4))[0]
    found = align_pairs(clouds, raster, I, J, guess, points, 0.8, 0.8, iterations=1)
    taken = found.pose - guess
    taken[:, 2] = se2.wrap_angle(taken[:, 2])
    long = (np.hypot(step[:, 0], step[:, 1]) > 0.3) | (np.abs(step[:, 2]) > 0.15)
    assert long.any()
    ratio = np.maximum(np.hypot(taken[:, 0], taken[:, 1]) / 0.3, np.abs(taken[:, 2]) / 0.15)
    np.testing.assert_allclose(ratio[long], 1.0)
    np.testing.assert_allclose(np.cross(taken, step), 0.0, atol=1e-9)


def test_motions_are_recovered_and_told_apart_from_guesses(world):
    clouds, raster, points, exact = world
    found = align_pairs(clouds, raster, I, J, exact + np.array([0.15, -0.1, 0.08]), points, 0.5, 0.1)
    error = se2.between(exact, found.pose)
    # Points err by 5 mm and are means in cells of 2 cm; some 150 of them hold a pose.
    assert np.abs(error[:, :2]).max() < 0.01
    assert np.abs(error[:, 2]).max() < 0.005
    assert found.share.min() > 0.4
    assert found.rms.max() < 0.02
