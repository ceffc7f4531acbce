"""A lidar of one turn a second in corridors: scans look alike along the walls, and after a fast turn show little in common."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.laser_walks import ROOM
from helpers.planted import cast

from uwblite import se2
from uwblite.screening import cuts, wheel_motion
from uwblite.sensor_log import LaserScans, Odometry, SensorLog

WIDTH, SPEED = 1.2, 0.5
BEARINGS = np.deg2rad(np.arange(-90, 90) + 0.5)


def corridor(length, seed):
    """Return the walls of a corridor along x with niches and doors on both sides."""
    rng, walls = np.random.default_rng(seed), []
    for side in (1.0, -1.0):
        x = -3.0
        while x < length:
            end, width, deep = x + rng.uniform(2.5, 9.0), rng.uniform(0.8, 1.6), rng.choice([0.1, 0.15, 0.3])
            line = [(x, 0.0), (end, 0.0), (end, deep), (end + width, deep), (end + width, 0.0)]
            line = [(a, side * (WIDTH + b)) for a, b in line]
            walls += [[*p, *q] for p, q in pairwise(line)]
            x = end + width
    return np.array(walls)


def seen(truth, walls, wheels, seed):
    """Return the recording of a robot at poses (k, 3) a second apart whose odometry says other ones."""
    owner = np.repeat(np.arange(len(truth)), len(BEARINGS))
    ranges = cast(truth[owner], np.tile(BEARINGS, len(truth)), walls).reshape(len(truth), -1)
    ranges += np.random.default_rng(seed).normal(0.0, 0.012, ranges.shape)
    stamps = np.arange(len(truth), dtype=float)
    scans = LaserScans(stamps, ranges.astype(np.float32), BEARINGS[0], np.deg2rad(1.0), 0.0, 0.05, 80.0)
    fine = np.arange(0.0, stamps[-1] + 0.01, 0.1)
    return SensorLog(Odometry(fine, se2.interpolate_trajectory(stamps, wheels, fine)), None, scans)


def along(count, speed):
    return np.column_stack([speed * np.arange(count), np.zeros((count, 2))])


@pytest.mark.parametrize("seed", [1, 2])
def test_wheels_that_count_along_a_corridor_stay_in_use(seed):
    truth = along(150, SPEED)
    pairs = wheel_motion.compare(seen(truth, corridor(100.0, seed), truth * [0.95, 1.0, 1.0], seed))
    assert pairs.measured.mean() > 0.9
    assert np.mean(np.abs(pairs.lidar[:, 0] - SPEED) > 0.1) < 0.05
    assert wheel_motion.disagreeing(pairs, 0.0) == []


def test_wheels_that_spin_on_the_spot_are_not():
    """The robot stands for 30 s of 150 at a corner of the corridor's end; its wheels count on."""
    truth = along(150, SPEED)
    stuck = truth.copy()
    stuck[60:91] = truth[60]
    stuck[91:] = truth[61:120]
    pairs = wheel_motion.compare(seen(stuck, corridor(100.0, 1), truth, 1))
    still = (pairs.start > 60.0) & (pairs.end < 90.0)
    assert np.all(np.abs(pairs.lidar[still, 0]) < 0.05)
    (doubt,) = wheel_motion.disagreeing(pairs, 0.0)
    assert doubt.kind == "wheels-against-lidar"


CORNER = np.array([
    [-9.0, -1.2, 1.2, -1.2], [1.2, -1.2, 1.2, 9.0], [-1.2, 9.0, -1.2, 1.2], [-1.2, 1.2, -9.0, 1.2],
    [1.2, 9.0, -1.2, 9.0], [-9.0, 1.2, -9.0, -1.2],
])  # fmt: skip
"""A corridor that turns to the left at the origin."""


def test_scans_before_and_after_a_fast_turn_show_little_in_common_and_are_of_one_place():
    before, after = np.arange(-8.1, -0.5, 0.5), np.arange(0.5, 8.0, 0.5)
    truth = np.array([[x, 0.0, 0.0] for x in before] + [[-0.5, y, 0.5 * np.pi] for y in (0.05, *after)])
    log, turn = seen(truth, CORNER, truth * [0.96, 0.96, 1.05], 3), np.array([len(before) - 1])
    apart, share = cuts._elsewhere(log, turn, turn + 1)
    assert share[0] < cuts.CutPolicy.same_place
    assert not apart[0]


@pytest.mark.parametrize("place", [[-1.0, -1.0, 0.0], [-2.0, 1.0, 3.0], [-3.0, -2.0, 1.0], [2.5, 2.0, -2.0]])
def test_scans_of_a_corridor_and_of_a_room_are_of_two_places(place):
    truth = np.array([[-6.0, 0.0, 0.0], [-5.5, 0.0, 0.0]])
    one, other = seen(truth, CORNER, truth, 4), seen(0.0 * truth + place, ROOM, truth, 5)
    ranges = np.concatenate([one.scans.ranges[:1], other.scans.ranges[:1]])
    log = replace(one, scans=replace(one.scans, ranges=ranges))
    assert cuts._elsewhere(log, np.array([0]), np.array([1]))[0].all()
