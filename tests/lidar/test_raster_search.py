"""The search over a small window: its best pose against a loop with nearest neighbours, maxima against a greedy choice."""

import numpy as np
import pytest
from helpers.laser_walks import HALL, scanned
from scipy.spatial import cKDTree

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.raster_search import _LEAST_SHARE, _SEPARATION, Window, _maxima, best_poses

CELL, REACH = 0.1, 0.5
WINDOW = Window(distance=0.3, angle=0.12)


def two_clouds(motion):
    """Return two clouds of the hall, the second seen from a pose (3,) in the first."""
    return scanned(np.stack([np.array([-1.0, 0.5, 0.3]), se2.compose(np.array([-1.0, 0.5, 0.3]), motion)]), HALL)


def score_of(clouds, corner, rows, pose):
    """The score by its definition; distances count from the middles of the raster's cells, as far as it reaches."""
    target, normals = clouds.cloud(0)[:2]
    middle = corner + (np.floor((se2.transform(pose, clouds.points[rows]) - corner) / CELL) + 0.5) * CELL
    distance, nearest = cKDTree(target).query(middle)
    cosine = np.sum(normals[nearest] * se2.rotate(pose[2], clouds.normals[rows]), axis=1)
    return np.sum(np.where(distance < REACH, np.exp(-0.5 * (distance / WINDOW.spread) ** 2) * cosine, 0.0))


@pytest.mark.parametrize("guess", [(0.0, 0.0, 0.0), (0.35, 0.1, 0.2)])
def test_the_best_pose_is_that_of_a_loop_over_the_grid(guess):
    clouds = two_clouds(np.array([0.2, -0.1, 0.1]))
    rows, raster = np.arange(clouds.offsets[1], clouds.offsets[2])[::9], rasterize(clouds, CELL, REACH)
    found = best_poses(clouds, raster, rows, np.array(guess), WINDOW, 1)
    steps, turns = np.arange(-3, 4) * CELL, np.arange(-3, 4) * WINDOW.angle_step
    grid = np.array([(guess[0] + x, guess[1] + y, guess[2] + t) for t in turns for x in steps for y in steps])
    scores = np.array([score_of(clouds, raster.origin[0], rows, pose) for pose in grid])
    # The raster may name a point that is a little farther than the nearest.
    assert score_of(clouds, raster.origin[0], rows, found[0]) > scores.max() - 0.005 * len(rows)
    assert np.abs(grid - found[0]).max(axis=1).min() < 1e-12


def test_the_true_pose_is_found_to_a_step():
    for motion in ([0.25, 0.2, 0.1], [-0.2, 0.05, -0.08], [0.0, 0.0, 0.0]):
        clouds = two_clouds(np.array(motion))
        rows = np.arange(clouds.offsets[1], clouds.offsets[2])
        found = best_poses(clouds, rasterize(clouds, CELL, REACH), rows, np.zeros(3), WINDOW, 3)
        # Half a step of the grid, and the half cell by which points are rounded.
        assert np.abs(found[0, :2] - motion[:2]).max() <= CELL
        assert abs(found[0, 2] - motion[2]) <= WINDOW.angle_step


def test_without_points_or_target_there_is_no_pose():
    clouds = two_clouds(np.zeros(3))
    raster = rasterize(clouds, CELL, REACH)
    assert best_poses(clouds, raster, np.zeros(0, dtype=np.intp), np.zeros(3), WINDOW, 3).shape == (0, 3)
    far = np.array([50.0, 0.0, 0.0])
    rows = np.arange(clouds.offsets[1], clouds.offsets[2])
    assert best_poses(clouds, raster, rows, far, WINDOW, 3).shape == (0, 3)


@pytest.mark.parametrize("seed", range(5))
def test_maxima_are_the_greedy_choice(seed):
    scores = np.random.default_rng(seed).random((9, 11, 8)).astype(np.float32) ** 3
    expected, left = [], scores.copy()
    for _ in range(4):
        best = max(np.ndindex(*left.shape), key=lambda k: left[k])
        if left[best] <= _LEAST_SHARE * scores.max():
            break
        expected.append(best)
        for k in np.ndindex(*left.shape):
            if all(abs(a - b) <= w for a, b, w in zip(k, best, _SEPARATION, strict=True)):
                left[k] = 0.0
    assert _maxima(scores, 4).tolist() == [list(k) for k in expected]
    assert len(_maxima(scores, 1)) == 1
