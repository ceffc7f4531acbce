"""Beams that see the robot itself are left out; walls that a robot follows are not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.told import told

from uwblite.screening.own_body import without_own_body
from uwblite.sensor_log import LaserScans, Odometry, SensorLog

BEAMS = 72


def rounds(turns=1.0, metres=10.0, seconds=100.0):
    """A robot that drives in a circle."""
    stamps = np.arange(0.0, seconds + 0.05, 0.1)
    heading = np.linspace(0.0, 2.0 * np.pi * turns, len(stamps))
    radius = metres / max(2.0 * np.pi * turns, 1e-9)
    return Odometry(stamps, np.column_stack([radius * np.sin(heading), radius * (1.0 - np.cos(heading)), heading]))


def seen(odometry, readings):
    stamps = odometry.stamps[:: len(odometry.stamps) // len(readings)][: len(readings)]
    scans = LaserScans(stamps, np.asarray(readings, dtype=np.float32), -np.pi, 2.0 * np.pi / BEAMS, 0.0, 0.05, 8.0)
    return SensorLog(odometry, None, scans)


def walls(rng, count=200):
    return rng.uniform(0.3, 6.0, (count, BEAMS))


@pytest.mark.parametrize(("distance", "noise", "found"), [(0.25, 0.01, True), (0.25, 0.08, False), (1.2, 0.01, False)])
def test_a_post_of_the_robot_is_left_out(distance, noise, found):
    rng = np.random.default_rng(0)
    readings = walls(rng)
    readings[:, 10:14] = distance + noise * rng.standard_normal((200, 4))
    readings[::25, 12] = np.inf  # a lost echo now and then
    log = seen(rounds(), readings)
    done, facts = without_own_body(log)
    remarks = told(facts)
    assert len(remarks) == found
    if not found:
        assert done is log
        return
    assert remarks[0].text.startswith("4 of 72 beams of the lidar (at -130 to -115 degrees)")
    assert remarks[0].severity == "warning"
    assert np.isnan(done.scans.ranges[:, 10:14]).all()
    np.testing.assert_array_equal(np.delete(done.scans.ranges, np.s_[10:14], 1), np.delete(log.scans.ranges, np.s_[10:14], 1))


@pytest.mark.parametrize(("odometry"), [rounds(turns=0.3), rounds(metres=2.0)])
def test_a_robot_that_hardly_turns_or_drives_shows_nothing(odometry):
    readings = walls(np.random.default_rng(1))
    readings[:, 10:14] = 0.25
    log = seen(odometry, readings)
    assert without_own_body(log) == (log, [])


def test_a_wall_beside_a_corridor_stays():
    """Up and down a corridor, the wall at 0.6 m to the right but for the turns at its ends."""
    stamps = np.arange(0.0, 200.0, 0.1)
    turning = (stamps % 50.0) > 44.0
    heading = np.concatenate([[0.0], np.cumsum(np.where(turning, np.pi / 60.0, 0.0))[1:]])
    xy = np.cumsum(np.where(turning, 0.0, 0.05)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    odometry = Odometry(stamps, np.column_stack([xy, heading]))
    rng = np.random.default_rng(2)
    readings = walls(rng, len(stamps))
    readings[~turning, 17:20] = 0.6 + 0.01 * rng.standard_normal((int((~turning).sum()), 3))
    log = seen(odometry, readings)
    assert without_own_body(log) == (log, [])
    empty = replace(log, scans=replace(log.scans, stamps=np.zeros(0), ranges=np.zeros((0, BEAMS), dtype=np.float32)))
    assert without_own_body(empty) == (empty, [])
    assert without_own_body(log.without(lidar=True))[1] == []
