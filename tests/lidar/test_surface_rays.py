"""Rays on walls and columns: bundles, order, and the points of clouds that lie on both."""

from dataclasses import replace

import numpy as np
from helpers.laser_walks import scanned
from helpers.planted_rays import POSES, rays_that_end
from helpers.wall_rays import seen

from uwblite import se2
from uwblite.lidar.clouds import Clouds
from uwblite.lidar.columns import around_columns, on_columns, rim_distances
from uwblite.lidar.surface_rays import UNLEARNT, MeasuredSurfaces, SurfaceRays, as_rays, surfaces_of
from uwblite.lidar.walls import find_walls, points_on, straight_pieces
from uwblite.odometry.attached import ScanPoints


def test_points_of_clouds_are_told_walls_columns_and_the_rest():
    """A box, a column and a wall too short to be one."""
    poses = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)])
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    ring = np.array([0.0, 1.2]) + 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    box = [[-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 2.5], [3.0, 2.5, -3.0, 2.5], [-3.0, 2.5, -3.0, -2.0]]
    walls = np.concatenate([box, [[1.55, -1.0, 1.63, -1.0]], np.column_stack([ring[:-1], ring[1:]])])
    clouds = scanned(poses, walls, beams=720, reach=5.0)
    pieces, on = straight_pieces(seen(walls, poses, beams=720))
    straight = find_walls(
        pieces,
        poses,
        np.isinf(rim_distances(np.array([[0.0, 1.2, 0.3]]), se2.transform_each(poses, pieces.keyframe, pieces.centre), 0.06)),
    )
    surfaces = surfaces_of(straight.centre, straight.normal, np.array([[0.0, 1.2, 0.3]]))
    kind = points_on(clouds, MeasuredSurfaces(surfaces, on.renumbered(straight.of_piece), UNLEARNT), poses)
    at = se2.transform_each(poses, clouds.owner, clouds.points.astype(float))
    round_one = np.abs(np.hypot(at[:, 0], at[:, 1] - 1.2) - 0.3) < 0.02
    assert np.all(kind[round_one] == 1)
    assert np.all(kind[(np.abs(at[:, 1] + 1.0) < 0.02) & (np.abs(at[:, 0] - 1.6) < 0.1)] == -1)
    flat = (np.abs(at[:, 1] + 2.0) < 0.02) & (np.abs(at[:, 0]) < 2.0)
    assert np.mean(kind[flat] == 0) > 0.9


def test_every_place_where_a_ray_ends_on_a_wall_is_on_it_and_none_beyond():
    """Single rays a metre apart on a wall along x; beside where they end nothing shows it."""
    x = np.arange(200.0) + 0.06 * np.random.default_rng(0).random(200)
    at, zero = np.column_stack([x, np.zeros(200)]), np.zeros(200, dtype=np.intp)
    wall = surfaces_of(np.zeros((1, 2)), np.array([[0.0, 1.0]]), np.zeros((0, 3)))
    rays = SurfaceRays(zero, zero, at, np.tile([0.0, -1.0], (200, 1)), np.full(200, 0.01), np.arange(200))
    points = np.concatenate([at, at + np.array([0.5, 0.0]), at + np.array([0.0, 0.1])])
    clouds = Clouds(np.array([0, 600]), points, 0.0 * points, np.zeros(600, dtype=np.intp), np.ones(600))
    kind = points_on(clouds, MeasuredSurfaces(wall, rays, UNLEARNT), np.zeros((1, 3)))
    assert kind.tolist() == [0] * 200 + [-1] * 400


def test_only_rays_that_face_a_column_count():
    rays = rays_that_end()
    scan = ScanPoints(rays.keyframe, rays.points, np.zeros((40, 2)), np.arange(40), np.zeros(40, dtype=np.intp))
    columns = np.array([[-1.5, 1.0, 0.4]])
    every = as_rays(scan)
    near = around_columns(every, POSES, columns)
    assert np.all(np.isin(near.points, rays.points[rays.surface == 1]))
    found = on_columns(near, POSES, columns, 7)
    assert 0 < len(found.keyframe) <= 20
    assert np.all(found.surface == 7)
    far = on_columns(replace(near, points=near.points + 0.3 * near.directions), POSES, columns, 7)
    assert len(far.keyframe) == 0


def test_coarse_rays_on_a_column_lie_on_it():
    """Beams of a degree at 5 m: the mean of four neighbours would lie 14 mm behind a column of 0.35 m."""
    bearing = np.deg2rad(np.arange(-3.0, 4.0))
    way = np.column_stack([np.cos(bearing), np.sin(bearing)])
    along = 5.0 * way[:, 0]
    reach = along - np.sqrt(0.35**2 - 25.0 + along**2)
    zero = np.zeros(7, dtype=np.intp)
    rays = as_rays(ScanPoints(zero, reach[:, None] * way, np.zeros((7, 2)), np.arange(7), zero))
    found = on_columns(rays, np.zeros((1, 3)), np.array([[5.0, 0.0, 0.35]]), 0)
    assert len(found.keyframe) >= 5
    np.testing.assert_allclose(np.hypot(*(found.points - [5.0, 0.0]).T), 0.35, atol=1e-9)
