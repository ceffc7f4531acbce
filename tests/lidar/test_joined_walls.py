"""Pieces of wall that are one wall, and pieces that are not."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.arrays import concatenated
from uwblite.lidar.joined_walls import with_joined_walls
from uwblite.lidar.ray_equations import weighted_sums
from uwblite.lidar.ray_noise import RayNoise
from uwblite.lidar.surface_rays import MeasuredSurfaces, SurfaceRays, Surfaces

POSES = np.column_stack([np.linspace(-3.0, 3.0, 13), np.zeros(13), np.zeros(13)])
NOISE = RayNoise(np.ones(6), np.ones(2))


def rays_to(surface, x, y):
    """Rays from all poses to points (m, 2)."""
    keyframe = np.repeat(np.arange(len(POSES)), len(x))
    ends = np.tile(np.column_stack([x, np.broadcast_to(y, x.shape)]), (13, 1))
    away = ends - POSES[keyframe, :2]
    reach = np.hypot(*away.T)
    number = np.full(len(keyframe), surface)
    return SurfaceRays(keyframe, number, away, away / reach[:, None], np.full(len(reach), 0.01), np.arange(len(reach)))


def two_pieces(gap=1.0, step=0.0, turn=0.0, offset=0.0, behind=()):
    """A wall ahead whose middle was not seen, with the second piece elsewhere, and rays that ended behind the gap."""
    right = np.linspace(0.5 * gap, 0.5 * gap + 2.0, 40)
    rays = [
        rays_to(0, -right, 2.0),
        rays_to(1, right, 2.0 + step + turn * (right - 0.5 * gap)),
        rays_to(2, np.linspace(-4.0, 4.0, 9), -2.0),
        *(rays_to(3, np.array([x]), 4.0) for x in behind),
    ]
    middle = 1.0 + 0.5 * gap
    surfaces = Surfaces(
        np.zeros(4, dtype=bool),
        np.array([[-middle, 2.0], [middle, 2.0 + step + turn], [0.0, -2.0], [0.0, 4.0]]),
        np.array([-np.pi / 2, -np.pi / 2 + turn, np.pi / 2, -np.pi / 2]),
        np.array([0.0, offset, 0.0, 0.0]),
        np.ones(4),
    )
    return MeasuredSurfaces(surfaces, concatenated(rays).by_keyframe(surfaces), NOISE)


def joined(found):
    information = weighted_sums(found, POSES, POSES, 3.0).surfaces + np.diag([1e-6, 1e-6, 0.0156**-2.0, 1.0])
    return with_joined_walls(found, information, POSES)


@pytest.mark.parametrize("gap", [0.05, 1.0, 1.9])
def test_pieces_on_one_line_are_one_wall(gap):
    before = two_pieces(gap)
    found, number = joined(before)
    assert number.tolist() == [0, 0, 1, 2]
    assert len(found.surfaces.facing) == 3
    assert len(found.rays.keyframe) == len(before.rays.keyframe)
    # Every ray ends on the line of its wall still.
    normal = np.column_stack([np.cos(found.surfaces.facing), np.sin(found.surfaces.facing)])[found.rays.surface]
    ended = found.rays.points + POSES[found.rays.keyframe, :2]
    assert np.abs(((ended - found.surfaces.place[found.rays.surface]) * normal).sum(axis=1)).max() < 1e-9


@pytest.mark.parametrize(
    "other", [{"gap": 2.2}, {"step": 0.02}, {"turn": np.deg2rad(1.5)}, {"offset": 0.03}, {"behind": (0.0, 0.1, -0.1)}]
)
def test_pieces_apart_are_two_walls(other):
    assert joined(two_pieces(**other))[1].tolist() == [0, 1, 2, 3]


def test_what_lies_beside_or_in_front_of_a_gap_does_not_open_it():
    """Rays over the ends of the wall to what is behind it, and rays from behind."""
    found = two_pieces(behind=(-3.5, 3.5))
    beyond = found.rays.surface != 3
    across = (POSES[found.rays.keyframe, 0] + 0.5 * found.rays.points[:, 0])[~beyond]
    rows = np.concatenate([np.flatnonzero(beyond), np.flatnonzero(~beyond)[np.abs(across) > 2.6]])
    found = replace(found, rays=found.rays.rows(rows).by_keyframe(found.surfaces))
    assert np.count_nonzero(found.rays.surface == 3) >= 6
    assert joined(found)[1].tolist() == [0, 0, 1, 2]


def test_noise_decides_how_much_pieces_may_differ():
    """Half a centimetre is little where a piece has been seen once, and much where it has been seen well."""
    found = two_pieces(step=0.012)
    assert joined(found)[1].tolist() == [0, 1, 2, 3]
    seldom = (found.rays.surface != 1) | (np.arange(len(found.rays.keyframe)) % 64 == 0)
    assert joined(replace(found, rays=found.rays.rows(seldom)))[1].tolist() == [0, 0, 1, 2]
