"""Rays on walls and columns: which these are, bundles, order."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import scanned
from helpers.planted_rays import POSES, rays_that_end

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.round_columns import surroundings
from uwblite.lidar.stretches import stretches
from uwblite.lidar.surface_rays import NEAR, around_columns, as_rays, on_columns, points_on, stretch_of
from uwblite.lidar.walls import find_walls
from uwblite.odometry.attached import ScanPoints


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_rays_of_a_wall_are_bundled_and_lie_on_it(noise):
    walls, beams = np.array([[-9.0, 1.0, 9.0, 1.0]]), 720
    clouds = scanned(np.zeros((1, 3)), walls, beams=beams, reach=4.0)
    bearing = np.linspace(0.5, 2.6, 300)
    way = np.column_stack([np.cos(bearing), np.sin(bearing)])
    reach = 1.0 / way[:, 1] + noise * np.random.default_rng(3).standard_normal(300)
    nothing = np.zeros(300, dtype=np.intp)
    rays = ScanPoints(nothing, reach[:, None] * way, np.zeros((300, 2)), np.arange(300), nothing)
    stretch = stretch_of(as_rays(rays), clouds, rasterize(clouds, 0.1, 0.3), stretches(clouds))
    on = np.flatnonzero(stretch >= 0)
    found = replace(as_rays(rays), surface=stretch).rows(on).bundled()
    assert 60 <= len(found.keyframe) <= 76
    off = found.points[:, 1] - 1.0
    assert np.abs(off).max() < max(4.0 * 0.5 * noise, 2e-3)
    # The mean of four rays of 1 cm.
    assert np.median(found.sigma) == pytest.approx(0.0053, abs=0.0005)


def test_points_of_clouds_are_told_walls_columns_and_the_rest():
    """A box, a column and a wall that single clouds see too little of."""
    poses = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)])
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    ring = np.array([0.0, 1.2]) + 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    box = [[-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 2.5], [3.0, 2.5, -3.0, 2.5], [-3.0, 2.5, -3.0, -2.0]]
    walls = np.concatenate([box, [[1.5, -1.0, 1.7, -1.0]], np.column_stack([ring[:-1], ring[1:]])])
    clouds = scanned(poses, walls, beams=720, reach=5.0)
    parts = stretches(clouds)
    kind = points_on(clouds, poses, find_walls(clouds, parts, poses), parts, np.array([[0.0, 1.2, 0.3]]))
    at = se2.transform_each(poses, clouds.owner, clouds.points.astype(float))
    round_one = np.abs(np.hypot(at[:, 0], at[:, 1] - 1.2) - 0.3) < 0.02
    assert np.all(kind[round_one] == 1)
    assert np.all(kind[(np.abs(at[:, 1] + 1.0) < 0.02) & (np.abs(at[:, 0] - 1.6) < 0.1)] == -1)
    flat = (np.abs(at[:, 1] + 2.0) < 0.02) & (np.abs(at[:, 0]) < 2.0)
    assert np.mean(kind[flat] == 0) > 0.9


def test_only_rays_that_face_a_column_count():
    rays = rays_that_end()
    scan = ScanPoints(rays.keyframe, rays.points, np.zeros((40, 2)), np.arange(40), np.zeros(40, dtype=np.intp))
    columns = np.array([[-1.5, 1.0, 0.4]])
    every = as_rays(scan)
    near = every.rows(around_columns(every, POSES, surroundings(columns, NEAR)))
    assert np.all(np.isin(near.points, rays.points[rays.surface == 1]))
    found = on_columns(near, POSES, columns, 7)
    assert 0 < len(found.keyframe) <= 20
    assert np.all(found.surface == 7)
    far = on_columns(replace(near, points=near.points + 0.3 * near.directions), POSES, columns, 7)
    assert len(far.keyframe) == 0
