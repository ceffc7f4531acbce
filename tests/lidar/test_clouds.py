"""Clouds: averages of cells against a loop, normals that face the laser, lone points left out."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import in_map
from helpers.planted import box, cast
from helpers.registration_worlds import cloud as single_points
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.lidar.clouds import CloudConfig, build
from uwblite.odometry.attached import ScanPoints

EVERYTHING = CloudConfig(voxel=0.1, normal_radius=0.3, min_neighbours=0)
SINGLE = 2.0**-23
"""Clouds are kept in single precision."""
NO_LINES = replace(EVERYTHING, linearity=1.1)
"""Points stay the means of their cells."""


def rays_from(points, owner, origins=None) -> ScanPoints:
    """Return points (n, 2) as rays of the keyframes owner (n,), seen from the origins (0, 0 where none are given)."""
    order = np.argsort(owner, kind="stable")
    origins = np.zeros_like(points) if origins is None else origins
    nothing = np.zeros(len(points), dtype=np.intp)
    return ScanPoints(np.asarray(owner)[order], points[order], origins[order], nothing, nothing)


@settings(max_examples=25)
@given(st.integers(0, 1000), st.integers(0, 300))
def test_cells_are_averaged_as_by_a_loop(seed, n):
    rng = np.random.default_rng(seed)
    points, owner = rng.uniform(-1, 1, (n, 2)), rng.integers(0, 4, n)
    clouds = build(rays_from(points, owner), 5, NO_LINES)
    cells: dict[tuple[int, int, int], list[np.ndarray]] = {}
    for point, own in zip(points, owner, strict=True):
        cells.setdefault((int(own), *np.floor(point / 0.1).astype(int).tolist()), []).append(point)
    expected = sorted((key[0], *np.mean(members, axis=0).tolist()) for key, members in cells.items())
    got = sorted((int(own), *point.tolist()) for own, point in zip(clouds.owner, clouds.points, strict=True))
    np.testing.assert_allclose(np.array(got).reshape(-1, 3), np.array(expected).reshape(-1, 3), atol=SINGLE)


@settings(max_examples=25)
@given(st.integers(0, 1000))
def test_offsets_owner_and_bearing_agree(seed):
    rng = np.random.default_rng(seed)
    owner = rng.choice([0, 2, 3], 200)
    clouds = build(rays_from(rng.uniform(-3, 3, (200, 2)), owner), 6, NO_LINES)
    assert len(clouds) == 6
    assert clouds.offsets[0] == 0
    assert clouds.offsets[-1] == len(clouds.points)
    for k in range(6):
        points, normals = clouds.cloud(k)
        assert len(points) == len(normals) == clouds.counts[k] == np.sum(clouds.owner == k)
        assert np.all(clouds.owner[clouds.offsets[k] : clouds.offsets[k + 1]] == k)
        assert np.all(np.diff(np.arctan2(points[:, 1], points[:, 0])) >= 0)
    assert clouds.counts[[1, 4, 5]].tolist() == [0, 0, 0]


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 2, 2.5])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_normals_stand_on_the_walls_and_face_the_laser(turn, noise):
    rng = np.random.default_rng(1)
    laser = np.array([0.4, -0.3, turn])
    bearings = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    reach = cast(np.tile(laser, (720, 1)), bearings, box(6, 4)) + noise * rng.standard_normal(720)
    seen = reach[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    clouds = build(rays_from(seen, np.zeros(720, dtype=int)), 1, CloudConfig(voxel=0.05, normal_radius=0.25))
    points, normals = in_map(clouds, laser[None])
    has = np.any(normals != 0.0, axis=1)
    away_from_corners = np.minimum(np.abs(np.abs(points[:, 0]) - 3), 9) + np.minimum(np.abs(np.abs(points[:, 1]) - 2), 9) > 0.4
    assert has[away_from_corners].mean() > 0.95
    np.testing.assert_allclose(np.hypot(*normals[has].T), 1.0, atol=SINGLE)
    assert np.all(np.einsum("pi,pi->p", normals, laser[:2] - points) >= 0)
    horizontal = np.abs(np.abs(points[:, 1]) - 2) < 0.1
    expected = np.where(horizontal[:, None], [[0.0, 1.0]], [[1.0, 0.0]]) * -np.sign(points)
    aligned = np.einsum("pi,pi->p", normals, expected)[has & away_from_corners]
    # A line through points over +-0.15 m with 0.01 m of noise each turns by about 0.01 / (0.15 sqrt(5) / sqrt(3)) = 0.05.
    assert aligned.min() > np.cos(5 * 0.05 * noise / 0.01) - SINGLE


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_neighbourhood_means_take_noise_out_and_the_normals_scatter_as_stated(noise):
    rng = np.random.default_rng(4)
    x = np.arange(-7.0, 7.0, 0.05)
    seen = np.column_stack([x, 2.0 + noise * rng.standard_normal(len(x))])
    clouds = build(rays_from(seen, np.zeros(len(x), dtype=int)), 1, CloudConfig(voxel=0.05, normal_radius=0.21, linearity=0.5))
    inner = np.abs(clouds.points[:, 0]) < 6.0  # farther on, grazing rays do not show from which side they come
    # Nine points, some of which share a cell, in every neighbourhood.
    assert clouds.points[inner, 1].std() < 1.3 * noise / np.sqrt(8)
    angle = np.arctan2(clouds.normals[inner, 0], -clouds.normals[inner, 1])
    assert np.mean(angle**2) == pytest.approx(np.mean(clouds.normal_variance[inner]), rel=0.4)


def test_a_neighbourhood_that_is_no_line_has_no_normal():
    rng = np.random.default_rng(2)
    clouds = build(rays_from(rng.uniform(1.0, 2.0, (400, 2)), np.zeros(400, dtype=int)), 1, EVERYTHING)
    assert np.any(clouds.normals != 0.0, axis=1).mean() < 0.2


def test_lone_points_are_left_out_and_neighbours_are_of_the_same_keyframe():
    """Three points of keyframe 0 in a row and three of keyframe 1 at the same places: none has a fourth for company."""
    row = np.column_stack([1.0 + 0.15 * np.arange(3), np.ones(3)])
    points, owner = np.concatenate([row, row]), np.repeat([0, 1], 3)
    three = CloudConfig(voxel=0.05, normal_radius=0.5, min_neighbours=3)
    two = CloudConfig(voxel=0.05, normal_radius=0.5, min_neighbours=2)
    assert len(build(rays_from(points, owner), 2, three).points) == 0
    assert build(rays_from(points, owner), 2, two).counts.tolist() == [3, 3]


def test_a_recording_without_a_single_return():
    clouds = build(rays_from(np.zeros((0, 2)), np.zeros(0, dtype=int)), 3, CloudConfig())
    assert len(clouds) == 3
    assert clouds.counts.tolist() == [0, 0, 0]
    assert in_map(clouds, np.zeros((3, 3)))[0].shape == (0, 2)


def test_clouds_in_the_map_are_moved_by_their_own_pose():
    rng = np.random.default_rng(3)
    clouds = build(rays_from(rng.uniform(-2, 2, (300, 2)), rng.integers(0, 3, 300)), 3, EVERYTHING)
    poses = rng.uniform(-3, 3, (3, 3))
    points, normals = in_map(clouds, poses)
    for k in range(3):
        own = slice(clouds.offsets[k], clouds.offsets[k + 1])
        np.testing.assert_allclose(points[own], se2.transform(poses[k], clouds.points[own]))
        np.testing.assert_allclose(normals[own], se2.rotate(poses[k, 2], clouds.normals[own]))


def test_normals_point_to_the_viewpoint_in_any_frame():
    rng = np.random.default_rng(3)
    wall = np.stack([np.arange(0.0, 2.0, 0.04), rng.normal(0.0, 0.005, 50)], axis=-1)
    for side in (1.0, -1.0):
        pose = np.array([3.0, -2.0, 2.5])
        cloud = single_points(se2.transform(pose, wall), se2.transform(pose, np.array([1.0, side])))
        assert (se2.rotate(-pose[2], cloud.normals)[:, 1] * side > 0.9).all()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_tiny_clouds_have_no_lines(n):
    cloud = single_points(np.arange(n)[:, None] * np.array([1.0, 0.0]))
    assert cloud.offsets.tolist() == [0, n]
    assert (cloud.normals == 0.0).all()
    assert (cloud.normal_variance == 0.0).all()


def test_a_normal_faces_where_its_rays_came_from():
    """A wall along x = y, seen from two places on either side, each by a keyframe of its own."""
    along = np.linspace(4.0, 6.0, 80)
    wall, away = np.column_stack([along, along]), np.array([[9.0, 1.0], [1.0, 9.0]])
    origins = np.repeat(away, 80, axis=0)
    clouds = build(rays_from(np.tile(wall, (2, 1)), np.repeat([0, 1], 80), origins), 2, EVERYTHING)
    for k, side in enumerate(away):
        normals = clouds.cloud(k)[1]
        towards = (side - 5.0) / np.hypot(*(side - 5.0))
        np.testing.assert_allclose(normals[normals.any(axis=1)] @ towards, 1.0, atol=1e-4)
        assert normals.any(axis=1).sum() > 10
