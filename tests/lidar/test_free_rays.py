"""Rays on short walls that their own scans did not show."""

import numpy as np

from uwblite.arrays import concatenated
from uwblite.lidar.free_rays import rays_near, with_free_rays
from uwblite.lidar.ray_noise import UNLEARNT
from uwblite.lidar.surface_rays import MeasuredSurfaces, SurfaceRays, Surfaces

POSES = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.linspace(-0.5, 0.5, 9)])
SURFACES = Surfaces(
    np.zeros(2, dtype=bool),
    np.array([[0.0, 2.0], [0.15, 2.5]]),
    np.array([-np.pi / 2, np.pi]),
    np.array([0.01, 0.0]),
    np.ones(2),
)
"""The front of a pier, 0.3 m wide, of which ranges are 1 cm too long, and a wall behind its corner."""


def rays_to(ends, surface, bundle=None):
    """Rays from all poses to points (m, 2), 1 cm too long."""
    keyframe, ends = np.repeat(np.arange(len(POSES)), len(ends)), np.tile(ends, (len(POSES), 1))
    away = ends - POSES[keyframe, :2]
    reach = np.hypot(*away.T)
    turned = away / reach[:, None]
    c, s = np.cos(POSES[keyframe, 2]), np.sin(POSES[keyframe, 2])
    local = np.column_stack([c * turned[:, 0] + s * turned[:, 1], c * turned[:, 1] - s * turned[:, 0]])
    number = np.arange(len(reach)) if bundle is None else keyframe * 100 + np.tile(bundle, len(POSES))
    return SurfaceRays(
        keyframe, np.full(len(reach), surface), (reach + 0.01)[:, None] * local, local, np.full(len(reach), 0.01), number
    )


def on_front(x):
    return np.column_stack([x, np.full(len(x), 2.0)])


def known():
    """The pier's front, shown up to 5 cm from either end, and the wall behind its corner."""
    behind = np.column_stack([np.full(30, 0.15), np.linspace(2.2, 3.0, 30)])
    rays = concatenated([rays_to(on_front(np.linspace(-0.099, 0.099, 20)), 0), rays_to(behind, 1)])
    return MeasuredSurfaces(SURFACES, rays.packed().by_keyframe(SURFACES), UNLEARNT)


SHORT = np.array([True, False])


def test_free_rays_take_the_place_of_those_known_before_and_are_bundled():
    free = rays_to(on_front(np.linspace(-0.095, 0.095, 40)), -1, np.arange(40) // 4)
    found = with_free_rays(known(), SHORT, free, POSES)
    own = found.rays.surface == 0
    assert np.count_nonzero(own) == 9 * 10
    np.testing.assert_allclose(found.rays.sigma[own], 0.005, rtol=1e-6)
    assert np.count_nonzero(~own) == np.count_nonzero(known().rays.surface == 1)
    again = found.rays.by_keyframe(SURFACES)
    np.testing.assert_array_equal(found.rays.points, again.points)


def test_rays_off_the_wall_or_beyond_what_was_seen_of_it_stay_free():
    off = np.array([[0.0, 2.05], [0.05, 1.94], [0.3, 2.0], [-0.2, 2.0]])
    found = with_free_rays(known(), SHORT, rays_to(off, -1), POSES)
    assert not np.any(found.rays.surface == 0)


def test_rays_on_long_walls_are_left_to_these():
    free = rays_to(np.array([[0.15, 2.4], [0.15, 2.6]]), -1)
    before = known()
    found = with_free_rays(before, SHORT, free, POSES)
    assert np.count_nonzero(found.rays.surface == 1) == np.count_nonzero(before.rays.surface == 1)


def test_without_short_walls_or_free_rays_nothing_changes():
    before, free = known(), rays_to(on_front(np.zeros(1)), -1)
    assert with_free_rays(before, np.zeros(2, dtype=bool), free, POSES) is before
    assert with_free_rays(before, SHORT, free.rows(slice(0)), POSES) is before


def test_rays_near_short_walls_are_kept_and_no_others():
    free = rays_to(np.array([[0.0, 2.02], [0.9, 2.0], [0.0, 1.2]]), -1)
    kept = rays_near(free, known().rays.rows(known().rays.surface == 0), POSES)
    assert len(kept.keyframe) == 9
    np.testing.assert_array_equal(kept.bundle % 3, 0)


def test_short_walls_that_few_rays_show_in_any_one_place_take_no_free_rays():
    before, free = known(), rays_to(on_front(np.zeros(5)), -1)
    few = before.rays.rows(np.r_[np.flatnonzero(before.rays.surface == 0)[:2], np.flatnonzero(before.rays.surface == 1)])
    found = with_free_rays(MeasuredSurfaces(SURFACES, few, UNLEARNT), SHORT, free, POSES)
    assert set(found.rays.surface.tolist()) == {1}
