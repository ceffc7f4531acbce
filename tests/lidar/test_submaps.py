"""Sub-maps: cut by travelled distance, merged in the middle keyframe's frame, both sides of a wall kept apart."""

import numpy as np
import pytest
from helpers.laser_walks import ROOM, in_map, scanned
from helpers.planted import box, wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.lidar.clouds import Clouds
from uwblite.lidar.submaps import SubmapConfig, build, cut, of_pieces

KEEP = SubmapConfig(epsilon=2.0, voxel=0.08, std_ratio=1e6, min_neighbours=0)
"""No filter but the voxels."""


@settings(max_examples=25)
@given(st.integers(0, 1000), st.floats(0.05, 20.0), st.integers(1, 80))
def test_pieces_are_no_longer_than_epsilon_and_of_one_recording(seed, epsilon, n):
    rng = np.random.default_rng(seed)
    path = 7.0 + np.cumsum(rng.uniform(0, 0.6, n))
    recording = np.sort(rng.integers(0, 3, n))
    first, last, _ = cut(path, recording, epsilon)
    assert first[0] == 0
    assert last[-1] == n
    np.testing.assert_array_equal(first[1:], last[:-1])
    assert np.all(first < last)
    for a, b in zip(first, last, strict=True):
        assert path[b - 1] - path[a] <= epsilon + 1e-9
        assert len(np.unique(recording[a:b])) == 1
    # No more pieces than the way and the recordings ask for.
    assert len(first) <= (path[-1] - path[0]) / epsilon + 1 + len(np.unique(recording)) - 1


def test_epsilon_of_zero_makes_every_keyframe_a_sub_map():
    first, last, _ = cut(np.array([0.0, 0.0, 0.3, 5.0]), np.zeros(4, dtype=int), 0.0)
    assert first.tolist() == [0, 1, 2, 3]
    assert last.tolist() == [1, 2, 3, 4]


def test_a_sub_map_holds_the_points_of_its_keyframes_in_the_middle_one_s_frame():
    _, truth = wander(np.random.default_rng(1), 8.0, half_width=1.5)
    poses = truth[::6]
    clouds = scanned(poses, ROOM)
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    made = build(clouds, poses, path, np.zeros(len(poses), dtype=np.intp), KEEP)
    assert len(made) == len(made.clouds) == len(made.reference)
    for k in range(len(made)):
        assert made.first[k] <= made.reference[k] < made.last[k]
        points, normals = made.clouds.cloud(k)
        at = se2.transform(poses[made.reference[k]], points)
        own = (clouds.owner >= made.first[k]) & (clouds.owner < made.last[k])
        every = in_map(clouds, poses)[0][own]
        # A mean of a cell lies within the cell of a point that it is made of, and every point's cell has its mean.
        gap = np.hypot(*(every[:, None] - at[None]).transpose(2, 0, 1))
        assert gap.min(axis=0).max() <= 0.08 * np.sqrt(2)
        assert gap.min(axis=1).max() <= 0.08 * np.sqrt(2)
        assert len(points) < own.sum()
        clear = np.any(normals != 0.0, axis=1)
        np.testing.assert_allclose(np.hypot(*normals[clear].T), 1.0)
        assert clear.mean() > 0.8


def wall_seen_from_both_sides(turn, rng) -> Clouds:
    """Return one cloud of a wall 3 cm thick along the direction turn, seen from both sides, its normals a little noisy."""
    n = 400
    along = np.linspace(-2.0, 2.0, n)
    side = np.tile([1.0, -1.0], n // 2)
    angle = np.where(side > 0, np.pi / 2, -np.pi / 2) + 0.05 * rng.standard_normal(n) + turn
    points = se2.rotate(turn, np.column_stack([along, 0.04 + 0.015 * side]))
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    return Clouds(np.array([0, n]), points, normals, np.zeros(n, dtype=np.intp), np.full(n, 1e-3))


@pytest.mark.parametrize("turn", np.linspace(0, np.pi, 13))
def test_the_two_sides_of_a_thin_wall_stay_apart_whatever_its_direction(turn):
    clouds = wall_seen_from_both_sides(turn, np.random.default_rng(2))
    made = build(clouds, np.zeros((1, 3)), np.zeros(1), np.zeros(1, dtype=np.intp), KEEP)
    points, normals = se2.rotate(-turn, made.clouds.points), se2.rotate(-turn, made.clouds.normals)
    assert np.all(np.abs(normals[:, 1]) > 0.9)
    single = 8.0 * 2.0**-23  # clouds are kept in single precision, these within 8 m
    np.testing.assert_allclose(points[:, 1], 0.04 + 0.015 * np.sign(normals[:, 1]), atol=single)


def test_lone_points_are_filtered():
    rng = np.random.default_rng(3)
    clouds = scanned(np.zeros((1, 3)), box(6, 4))
    stray = rng.uniform(-1.2, 1.2, (12, 2))
    points = np.concatenate([clouds.points, stray])
    normals = np.concatenate([clouds.normals, np.tile([1.0, 0.0], (12, 1))])
    n = len(points)
    dirty = Clouds(np.array([0, n]), points, normals, np.zeros(n, dtype=np.intp), np.zeros(n))
    made = build(dirty, np.zeros((1, 3)), np.zeros(1), np.zeros(1, dtype=np.intp), SubmapConfig())
    on_walls = np.minimum(np.abs(np.abs(made.clouds.points[:, 0]) - 3), np.abs(np.abs(made.clouds.points[:, 1]) - 2))
    assert np.sum(on_walls > 0.1) <= 2
    assert np.sum(on_walls < 0.1) > 0.9 * 20 / 0.08


def test_sub_maps_of_a_recording_without_returns_are_empty():
    empty = Clouds(np.zeros(4, dtype=np.intp), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.intp), np.zeros(0))
    made = build(empty, np.zeros((3, 3)), np.array([0.0, 3.0, 6.0]), np.zeros(3, dtype=np.intp), KEEP)
    assert len(made) == 3
    assert made.clouds.counts.tolist() == [0, 0, 0]


def test_what_moves_as_a_whole_is_not_bent():
    """Two sub-maps moved apart, and one of them bent by 3 cm at one of its five keyframes."""
    poses = np.column_stack([np.arange(10.0), np.zeros(10), np.linspace(0.0, 3.0, 10)])
    first, last = np.array([0, 5]), np.array([5, 10])
    made = of_pieces(scanned(poses, ROOM), poses, first, last, np.array([2, 7]), KEEP)
    after = poses.copy()
    for rows, motion in ((slice(0, 5), [0.3, -0.2, 0.5]), (slice(5, 10), [-1.0, 2.0, -2.0])):
        after[rows] = se2.compose(np.array(motion), poses[rows])
    assert made.bent(poses, after) < 1e-12
    after[9, :2] += [0.018, 0.024]
    assert made.bent(poses, after) == pytest.approx(0.03 / np.sqrt(10.0), rel=1e-6)
