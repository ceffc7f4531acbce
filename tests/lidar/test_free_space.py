"""Seen free space contradicts what would stand in it, and nothing else."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.lidar.visibility import contradiction, free_space, seen_beyond

INCREMENT = np.deg2rad(1.0)
BEARINGS = np.deg2rad(np.arange(-179.5, 180.0))
VIEW = np.abs(BEARINGS) < np.deg2rad(120.0)


def _square_room(pose, half=2.0):
    """Return ranges (b,) from a pose in a square room about the origin."""
    angle = BEARINGS + pose[2]
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(angle) > 0, half - pose[0], -half - pose[0]) / np.cos(angle)
        y = np.where(np.sin(angle) > 0, half - pose[1], -half - pose[1]) / np.sin(angle)
    return np.where(VIEW, np.minimum(np.abs(x), np.abs(y)), np.inf)


def _free(*poses):
    poses = np.array(poses, dtype=float)
    return free_space(poses, np.stack([_square_room(p) for p in poses]))


def _walls(half=2.0):
    side = np.linspace(-half, half, 81)
    ends = [np.full_like(side, end) for end in (-half, half)]
    return np.vstack([np.stack(xy, axis=-1) for end in ends for xy in ((side, end), (end, side))])


def test_the_same_room_does_not_contradict_itself():
    for pose in ([0.0, 0.0, 0.0], [0.7, -1.1, 2.0], [-1.5, 1.5, -3.0]):
        share, seen = contradiction(_free(pose), _walls(), 0.1)
        assert share == 0.0
        # Near a corner much of the nearest walls is seen at a grazing angle only.
        assert seen > 0.3


def test_a_wall_through_the_room_contradicts():
    inner = np.stack([np.full(40, 1.0), np.linspace(-1.0, 1.0, 40)], axis=-1)
    share, seen = contradiction(_free([0.0, 0.0, 0.0]), inner, 0.1)
    assert share == seen == 1.0


def test_what_is_hidden_or_out_of_view_shows_nothing():
    behind_wall = np.stack([np.full(40, 3.0), np.linspace(-1.0, 1.0, 40)], axis=-1)
    behind_back = np.stack([np.full(40, -1.0), np.linspace(-0.2, 0.2, 40)], axis=-1)
    for points in (behind_wall, behind_back):
        assert contradiction(_free([0.0, 0.0, 0.0]), points, 0.1) == (0.0, 0.0)


def test_the_margin_forgives_small_errors_of_the_pose():
    walls = se2.transform([0.08, -0.05, 0.02], _walls())
    assert contradiction(_free([0.0, 0.0, 0.0]), walls, 0.2)[0] == 0.0
    assert contradiction(_free([0.0, 0.0, 0.0]), se2.transform([-1.0, 0.0, 0.0], _walls()), 0.2)[0] > 0.2


def test_shares_equal_a_loop_over_points_and_scans():
    rng = np.random.default_rng(0)
    poses = np.array([[0.3, 0.2, 0.5], [-1.0, 0.4, 2.9]])
    free, points, margin = _free(*poses), rng.uniform(-3.0, 3.0, (300, 2)), 0.15
    bad = seen = 0
    for point in points:
        votes, visible = 0, False
        for pose, ranges in zip(poses, free.ranges, strict=True):
            x, y = se2.transform(se2.inverse(pose), point)
            reach = ranges[int(np.rint((np.arctan2(y, x) - BEARINGS[0]) / INCREMENT))]
            votes += np.hypot(x, y) < reach - margin
            visible |= reach > 0.0 and np.hypot(x, y) < reach + margin
        seen += visible
        bad += votes >= 1
    assert contradiction(free, points, margin) == pytest.approx((bad / seen, seen / len(points)))


def test_where_no_surface_was_seen_nothing_is_known():
    points = np.array([[1.0, 0.0], [3.0, 0.0]])
    for missing in (np.inf, np.nan):
        assert contradiction(free_space(np.zeros((1, 3)), np.full((1, 360), missing)), points, 0.1) == (0.0, 0.0)


def test_one_point_is_enough_and_what_is_near_an_unknown_bearing_is_not_in_view():
    free = free_space(np.zeros((1, 3)), np.where(VIEW, 2.0, np.inf)[None])
    assert contradiction(free, np.array([[1.0, 0.0]]), 0.1) == (1.0, 1.0)
    assert contradiction(free, np.array([[-0.05, 0.0]]), 0.1) == (0.0, 0.0)


def test_straight_behind_is_one_direction():
    behind = free_space(np.zeros((1, 3)), np.where(np.arange(360) < 2, 2.0, np.inf)[None])
    assert seen_beyond(behind, np.array([[-1.0, 0.0], [-1.0, 1e-9]]), 0.1)[0].tolist() == [1, 0]


def test_a_bearing_is_free_only_as_far_as_its_neighbours():
    ranges = np.array([[4.0, 4.0, 1.0, 4.0, 4.0, np.nan]])
    assert free_space(np.zeros((1, 3)), ranges).ranges.tolist() == [[4.0, 1.0, 1.0, 1.0, 0.0, 0.0]]


def test_nothing_contradicts_nothing():
    assert contradiction(_free([0.0, 0.0, 0.0]), np.zeros((0, 2)), 0.1) == (0.0, 0.0)
    assert contradiction(free_space(np.zeros((0, 3)), np.zeros((0, 5))), np.ones((3, 2)), 0.1) == (0.0, 0.0)
