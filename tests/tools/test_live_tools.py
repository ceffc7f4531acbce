"""The tools that measure the live pose: what they count, on a world small enough to be counted by hand."""

import copy

import grounds
import localization
import navigation
import numpy as np
import pytest

from uwblite import se2

ROOM = grounds.Place("room", 7, 1, easy=True)


@pytest.fixture(scope="module")
def made():
    """A robot that stands in the room; drawing its world takes a second."""
    return navigation.Robot(ROOM, 1, np.array([3.0, 3.0, 0.0]))


@pytest.fixture
def robot(made):
    return copy.deepcopy(made)


def test_pursuit_drives_along_a_path_and_stops_at_its_end():
    path = np.column_stack([np.linspace(0, 3, 61), np.zeros(61)])
    pose, rest = np.array([0.0, 0.2, 0.3]), np.inf
    for _ in range(1000):
        before, rest = rest, float(np.hypot(*(path[-1] - pose[:2])))
        if rest < navigation.CLOSE and rest >= before:
            break
        speed, turn = navigation.pursued(path, pose, rest)
        assert 0 <= speed <= navigation.SPEED
        assert abs(turn) <= navigation.TURN
        pose = se2.compose(pose, se2.exp([speed * navigation.STEP, 0.0, turn * navigation.STEP]))
    # A step at the end is 3 mm.
    assert rest < 0.005
    assert abs(pose[1]) < 0.005


def test_the_rim_of_a_robot_is_nearer_than_its_middle(robot):
    robot.put(np.array([1.0, 0.5, 0.0]))
    assert robot.clearance() <= 0.5 - navigation.RADIUS + 1e-12
    robot.pose = np.array([1.0, 0.1, 0.0])
    assert robot.clearance() < 0


def test_wheels_err_and_the_robot_moves_as_reported(robot):
    for _ in range(100):
        robot.drive(0.2, 0.0)
    true, output = robot.pose[0] - 3.0, robot.odometry[0]
    assert true == pytest.approx(0.2 * 100 * navigation.STEP, abs=0.05)
    # A fifth of the scale error's 2.5 % and the noise of one metre.
    assert 0 < abs(output - true) < 0.1


def test_a_sweep_of_a_standing_robot_sees_the_walls(robot):
    readings = robot.scan()
    seen = readings[np.isfinite(readings)]
    assert len(seen) > 300
    assert seen.min() > 0.1


def test_every_world_has_a_plan():
    assert set(localization.WORLDS) | set(navigation.WORLDS) <= set(navigation.PLANS)
