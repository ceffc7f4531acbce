"""Equations of rays on walls and columns: numeric derivatives, sums over keyframes and surfaces, noise along the ray."""

from dataclasses import fields

import numpy as np
import pytest
from helpers.planted_rays import POSES, SURFACES, linearized, rays_that_end

from uwblite import se2
from uwblite.lidar.ray_equations import noise_of, weighted_sums
from uwblite.lidar.surface_rays import MeasuredSurfaces, RayNoise, SurfaceRays, Surfaces


def residuals(rays, surfaces, poses):
    return linearized(rays, surfaces, poses, poses).residual


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
    assert sum(getattr(rays.packed(), f.name).nbytes for f in fields(rays)) <= 36 * len(rays.keyframe)
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


def test_noise_is_learnt_from_the_rays_of_each_place_on_a_surface():
    """On a wall of 8 m, of which every metre stands off by its own error, half as large as the noise of a ray."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-4.0, 4.0, 4000)
    bent = 0.5 * rng.standard_normal(8)[np.floor(x + 4.0).astype(int)]
    y = 2.0 + 0.02 * (np.sqrt(0.75) * rng.standard_normal(4000) + bent)
    way, nothing = np.column_stack([np.zeros(4000), np.ones(4000)]), np.zeros(4000, dtype=np.intp)
    rays = SurfaceRays(nothing, nothing, np.column_stack([x, y]), way, np.full(4000, 0.02), np.arange(4000))
    wall = Surfaces(np.array([False]), np.array([[0.0, 2.0]]), np.array([-np.pi / 2]), np.zeros(1), np.ones(1))
    noise = noise_of(rays, wall, np.zeros((1, 3)), np.zeros((1, 3)))
    assert noise.ratio == pytest.approx(1.0, abs=0.15)
    place = np.floor(x).astype(int)
    sums = [((y - 2.0)[place == k] / 0.02).sum() ** 2 for k in range(-4, 4)]
    assert noise.alike[0] == pytest.approx(8 / 6 * np.sum(sums) / np.sum(((y - 2.0) / 0.02) ** 2), rel=0.15)
    assert noise.alike[0] > 20.0


def test_sums_are_those_of_single_rays():
    """Every product of derivatives and residuals, robustly weighted, with walls and columns in parts of one keyframe each."""
    rays, noise = rays_that_end(0.01).by_keyframe(SURFACES), RayNoise(0.8, np.array([2.0, 5.0]))
    mounted, kernel = se2.compose(POSES, np.array([0.1, 0.05, 0.02])), 2.5
    lines = linearized(rays, SURFACES, mounted, POSES)
    root = 1.0 / ((1.0 + (lines.residual / (kernel * noise.ratio)) ** 2) * noise.ratio * np.sqrt(noise.alike[rays.surface]))
    by_pose, by_surface, residual = lines.by_pose * root[:, None], lines.by_surface * root[:, None], lines.residual * root
    found = weighted_sums(MeasuredSurfaces(SURFACES, rays, noise), mounted, POSES, kernel)
    assert len(found.keyframe) == 4
    for k in range(2):
        own = rays.keyframe == k
        np.testing.assert_allclose(found.poses[k], by_pose[own].T @ by_pose[own], rtol=1e-9)
        np.testing.assert_allclose(found.pose_slope[k], by_pose[own].T @ residual[own], rtol=1e-9)
        own = rays.surface == k
        scale = np.abs(found.surfaces[k]).max()
        np.testing.assert_allclose(found.surfaces[k], by_surface[own].T @ by_surface[own], rtol=1e-9, atol=1e-12 * scale)
        np.testing.assert_allclose(found.surface_slope[k], by_surface[own].T @ residual[own], rtol=1e-9, atol=1e-9)
    for keyframe, surface, across in zip(found.keyframe, found.surface, found.across, strict=True):
        own = (rays.keyframe == keyframe) & (rays.surface == surface)
        expected = by_surface[own].T @ by_pose[own]
        np.testing.assert_allclose(across, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_a_thousand_times_the_rays_say_a_thousand_times_as_much():
    """So many that they are summed in parts, some of which end among the rays of one keyframe on one surface."""
    rays = rays_that_end(0.01).by_keyframe(SURFACES)
    many = rays.rows(np.tile(np.arange(len(rays.keyframe)), 2001)).by_keyframe(SURFACES)
    few, all_ = (
        weighted_sums(MeasuredSurfaces(SURFACES, each, RayNoise(1.0, np.ones(2))), POSES, POSES, 3.0) for each in (rays, many)
    )
    assert len(all_.keyframe) > len(few.keyframe)
    for name in ("poses", "pose_slope", "surfaces", "surface_slope", "across"):
        one, other = getattr(all_, name), 2001 * getattr(few, name)
        if name == "across":
            one, other = one.sum(axis=0), other.sum(axis=0)
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12 * np.abs(other).max())
    part = many.rows(slice(None, None, 4))
    ratio, other = (noise_of(each, SURFACES, POSES, POSES).ratio for each in (many, part))
    assert ratio == pytest.approx(other, rel=1e-3)
