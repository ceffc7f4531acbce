"""Scans that a queue delivered late are given the poses at which they were taken."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import planted
from helpers.told import told

from uwblite import se2
from uwblite.screening.late_scans import displaced, with_late_scans_placed

ROOM = np.concatenate([planted.box(9.0, 6.0), np.array([[1.0, 1.0, 2.0, 1.0], [-3.0, -1.0, -3.0, 0.5]])])
LATE = (20, 33, 60)


@pytest.fixture(scope="module")
def turning():
    """Return a recording of 125 scans of a robot that turns and drives, with three scans from 0.4 s before, and the true poses
    at the scans: of these as they were taken."""
    rng = np.random.default_rng(1)
    stamps, truth = planted.drive([(0.15, 0.0, 0.6), (0.3, 0.0, -0.4)], [12.0, 13.5])
    lidar = planted.scans(stamps, truth, ROOM, sweep=0.0, noise=0.01, rng=rng)
    seen, taken = lidar.ranges.copy(), lidar.stamps.copy()
    for k in LATE:
        seen[k], taken[k] = lidar.ranges[k - 2] + 0.01 * rng.standard_normal(180), lidar.stamps[k - 2]
    wheels = planted.odometry(stamps, truth, rng, noise=0.002, turn_noise=0.002)
    queue = np.ceil(lidar.stamps / 1.1) * 1.1 + 0.001 * (np.arange(len(taken)) % 7)
    wheels = replace(wheels, stamps=np.sort(queue), poses=wheels.at(lidar.stamps))
    log = planted.recording(wheels, lidar=replace(lidar, stamps=np.sort(queue), ranges=seen))
    return log, se2.interpolate_trajectory(stamps, truth, taken)


def test_late_scans_alone_get_the_poses_that_they_show(turning):
    log, taken = turning
    done, facts = with_late_scans_placed(log)
    remarks = told(facts)
    assert [r.kind for r in remarks] == ["late-scans"]
    assert f"{len(LATE)} of {len(taken)} scans" in remarks[0].text
    others = np.setdiff1d(np.arange(len(taken)), LATE)
    np.testing.assert_array_equal(done.odometry.poses[others], log.odometry.poses[others])
    np.testing.assert_array_equal(done.odometry.stamps, log.odometry.stamps)
    before, late = (done.odometry.poses[np.array(LATE) - back] for back in (1, 0))
    true = se2.between(taken[np.array(LATE) - 1], taken[np.array(LATE)])
    np.testing.assert_allclose(se2.between(before, late), true, atol=0.02)


def test_scans_with_times_are_left_alone(turning):
    log, _ = turning
    steady = np.arange(len(log.scans.stamps)) * 0.2
    even = replace(log, scans=replace(log.scans, stamps=steady), odometry=replace(log.odometry, stamps=steady))
    assert with_late_scans_placed(even) == (even, [])
    assert with_late_scans_placed(log.without(lidar=True))[1] == []


def test_a_slip_and_steps_that_are_off_in_a_row_are_no_late_scan():
    """A slip is not taken back; what is taken back over two steps, or by half, is not of one scan."""
    off = 0.01 * np.random.default_rng(2).standard_normal((60, 3))
    off[10] = [0.3, 0.0, 0.2]
    off[20], off[22] = [0.0, 0.0, 0.4], [0.0, 0.0, -0.4]
    off[30], off[31] = [0.3, 0.0, 0.0], [-0.1, 0.0, 0.0]
    off[40], off[41] = [0.3, 0.0, 0.1], [-0.29, 0.01, -0.11]
    assert np.flatnonzero(displaced(off)).tolist() == [40]
