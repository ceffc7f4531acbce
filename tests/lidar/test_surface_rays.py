"""Rays on walls and columns: numeric derivatives, noise along the ray, bundles."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.laser_walks import scanned

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.surface_rays import (
    SurfaceRays,
    Surfaces,
    around_columns,
    as_rays,
    bundled,
    linearized,
    noise_of,
    on_columns,
    points_on,
    stretch_of,
)
from uwblite.lidar.walls import find_walls, stretches
from uwblite.odometry.attached import ScanPoints

POSES = np.array([[0.3, -0.2, 0.4], [1.1, 0.3, -2.0]])
SURFACES = Surfaces(
    np.array([False, True]),
    np.array([[3.0, 0.5], [-1.5, 1.0]]),
    np.array([2.9, 0.0]),
    np.array([0.02, -0.01]),
    np.array([1.0, 0.4]),
)


def rays_that_end(extra=0.0):
    """Rays from both poses to both surfaces, too long by the offsets of these and something extra."""
    keyframe, surface = np.repeat([0, 1], 20), np.tile(np.repeat([0, 1], 10), 2)
    origin, spread = POSES[keyframe, :2], np.tile(np.linspace(-0.2, 0.2, 10), 4)
    to = SURFACES.place[surface] - origin
    angle = np.arctan2(to[:, 1], to[:, 0]) + spread * np.where(surface == 1, 0.6, 1.0)
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    normal = np.array([np.cos(2.9), np.sin(2.9)])
    flat = ((SURFACES.place[0] - origin) @ normal) / (way @ normal)
    middle = (to * way).sum(axis=1)
    curved = middle - np.sqrt(np.maximum(0.16 - (to**2).sum(axis=1) + middle**2, 0.0))
    reach = np.where(surface == 0, flat, curved) + SURFACES.offset[surface] + extra
    local = se2.rotate(-POSES[keyframe, 2], way)
    return SurfaceRays(keyframe, surface, reach[:, None] * local, local, np.full(40, 0.01))


def residuals(rays, surfaces, poses):
    """In metres: what weighs them by incidence is divided out, which derivatives leave alone."""
    at = linearized(rays, surfaces, poses, poses)
    return at.residual


def test_derivatives_are_those_of_the_residuals():
    rays = rays_that_end()
    found = linearized(rays, SURFACES, POSES, POSES)
    np.testing.assert_allclose(found.residual, 0.0, atol=1e-9)
    small = 1e-6
    for k in range(3):
        ends = []
        for sign in (1.0, -1.0):
            moved = POSES.copy()
            moved[:, k] += sign * small
            ends.append(residuals(rays, SURFACES, moved))
        np.testing.assert_allclose(found.by_pose[:, k], (ends[0] - ends[1]) / (2.0 * small), atol=1e-3)
    for k in range(4):
        step = np.zeros((2, 4))
        step[:, k] = small
        ends = [residuals(rays, SURFACES.moved(sign * step), POSES) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(found.by_surface[:, k], (ends[0] - ends[1]) / (2.0 * small), atol=1e-3)


def test_packed_rays_say_the_same_to_some_micrometres():
    rays = rays_that_end(0.01)
    whole, packed = (linearized(r, SURFACES, POSES, POSES) for r in (rays, rays.packed()))
    assert sum(getattr(rays.packed(), f.name).nbytes for f in fields(rays)) == 28 * len(rays.keyframe)
    for name in ("residual", "by_pose", "by_surface"):
        scale = np.abs(getattr(whole, name)).max()
        np.testing.assert_allclose(getattr(packed, name), getattr(whole, name), atol=max(5e-6 / 0.01, 1e-6 * scale))


def test_noise_along_a_ray_does_not_change_its_lever_arm():
    exact, late = (linearized(rays_that_end(extra), SURFACES, POSES, POSES) for extra in (0.0, 0.03))
    assert np.abs(late.residual - exact.residual).min() > 1.0
    np.testing.assert_allclose(late.by_pose, exact.by_pose, atol=1e-6 * np.abs(exact.by_pose).max())


def test_a_mounting_moves_rays_but_they_turn_about_the_base():
    mounted = se2.compose(POSES, np.array([0.1, 0.05, 0.02]))
    rays, small = rays_that_end(), 1e-6
    found = linearized(rays, SURFACES, mounted, POSES)
    turned = POSES + np.array([0.0, 0.0, small])
    after = linearized(rays, SURFACES, se2.compose(turned, np.array([0.1, 0.05, 0.02])), turned)
    wall = rays.surface == 0
    # Where the residual is not 0 the derivative is that at the place where the ray should end.
    np.testing.assert_allclose(found.by_pose[wall, 2], (after.residual - found.residual)[wall] / small, rtol=0.3, atol=1.0)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_rays_of_a_wall_are_bundled_and_lie_on_it(noise):
    walls, beams = np.array([[-9.0, 1.0, 9.0, 1.0]]), 720
    clouds = scanned(np.zeros((1, 3)), walls, beams=beams, reach=4.0)
    bearing = np.linspace(0.5, 2.6, 300)
    way = np.column_stack([np.cos(bearing), np.sin(bearing)])
    reach = 1.0 / way[:, 1] + noise * np.random.default_rng(3).standard_normal(300)
    nothing = np.zeros(300, dtype=np.int64)
    rays = ScanPoints(nothing, reach[:, None] * way, np.zeros((300, 2)), np.arange(300), nothing)
    stretch = stretch_of(rays, clouds, rasterize(clouds, 0.1, 0.3), stretches(clouds))
    on = np.flatnonzero(stretch >= 0)
    found = bundled(as_rays(rays).rows(on), stretch[on], rays.scan[on], rays.ray[on])
    assert 60 <= len(found.keyframe) <= 76
    off = found.points[:, 1] - 1.0
    assert np.abs(off).max() < max(4.0 * 0.5 * noise, 2e-3)
    # The mean of four rays of 1 cm.
    assert np.median(found.sigma) == pytest.approx(0.0053, abs=0.0005)


def test_noise_is_learnt_from_the_rays_of_each_place_on_a_surface():
    """On a wall of 8 m, of which every metre stands off by its own error, half as large as the noise of a ray."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-4.0, 4.0, 4000)
    bent = 0.5 * rng.standard_normal(8)[np.floor(x + 4.0).astype(int)]
    y = 2.0 + 0.02 * (np.sqrt(0.75) * rng.standard_normal(4000) + bent)
    way, nothing = np.column_stack([np.zeros(4000), np.ones(4000)]), np.zeros(4000, dtype=np.int64)
    rays = SurfaceRays(nothing, nothing, np.column_stack([x, y]), way, np.full(4000, 0.02))
    wall = Surfaces(np.array([False]), np.array([[0.0, 2.0]]), np.array([-np.pi / 2]), np.zeros(1), np.ones(1))
    noise = noise_of(rays, wall, np.zeros((1, 3)), np.zeros((1, 3)))
    assert noise.relative(np.array([2.5]))[0] == pytest.approx(1.0, abs=0.15)
    place = np.floor(x).astype(int)
    sums = [((y - 2.0)[place == k] / 0.02).sum() ** 2 for k in range(-4, 4)]
    assert noise.alike[0] == pytest.approx(8 / 6 * np.sum(sums) / np.sum(((y - 2.0) / 0.02) ** 2), rel=0.15)
    assert noise.alike[0] > 20.0


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
    scan = ScanPoints(rays.keyframe, rays.points, np.zeros((40, 2)), np.arange(40), np.zeros(40, dtype=np.int64))
    columns = np.array([[-1.5, 1.0, 0.4]])
    every = as_rays(scan)
    near = every.rows(around_columns(every, POSES, columns))
    assert np.all(np.isin(near.points, rays.points[rays.surface == 1]))
    found = on_columns(near, POSES, columns, 7)
    assert 0 < len(found.keyframe) <= 20
    assert np.all(found.surface == 7)
    far = on_columns(replace(near, points=near.points + 0.3 * near.directions), POSES, columns, 7)
    assert len(far.keyframe) == 0
