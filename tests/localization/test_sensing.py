"""Measurements that wait for the odometry, and the rays of a scan taken while the robot moves."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.localization import Scanner
from uwblite.localization.sensing import LEAD, TRACK_RAYS, Range, Scan, Waiting, scan_rays
from uwblite.odometry.odometer import Odometer
from uwblite.sensor_log import SensorMounting

MOUNTING = SensorMounting(T_base_laser=np.array([0.2, 0.05, 0.1]))


def a_range(k=0):
    return Range(k, 3.0, 0)


def odometer_of(stamps, poses):
    odometer = Odometer()
    for t, pose in zip(stamps, poses, strict=True):
        odometer.add(float(t), np.asarray(pose, dtype=float))
    return odometer


def test_what_the_odometry_has_reached_comes_out_in_the_order_of_time():
    waiting = Waiting()
    for until, k in ((3.0, 3), (1.0, 1), (2.0, 2), (9.0, 9)):
        waiting.add(until, a_range(k))
    assert [entry.anchor for _, entry in waiting.reached(3.0)] == [1, 2, 3]
    assert [entry.anchor for _, entry in waiting.reached(9.0)] == [9]
    assert waiting.reached(99.0) == []
    assert waiting.refused == 0


def test_what_comes_too_late_or_too_far_ahead_is_counted():
    waiting = Waiting()
    waiting.add(1.0, a_range())
    assert waiting.reached(1.0 + LEAD + 0.1) == []
    waiting.add(20.0, a_range())
    waiting.refuse(20.0 - LEAD - 0.1)
    assert waiting.reached(30.0) == []
    assert waiting.refused == 2
    waiting.add(np.nan, a_range())
    assert waiting.reached(99.0) == []


def test_four_stamps_far_ahead_say_that_the_odometry_was_silent():
    waiting = Waiting()
    for k in range(3):
        waiting.add(100.0 + k, a_range())
    assert waiting.latest(50.0) == -np.inf
    waiting.add(103.0, a_range())
    assert waiting.latest(50.0) == 100.0
    waiting.add(52.0, a_range())
    assert waiting.latest(50.0) == 52.0
    assert waiting.latest(200.0) == -np.inf


@pytest.mark.parametrize("flipped", [False, True])
def test_rays_of_a_robot_that_moves_end_on_the_point_that_all_of_them_see(flipped):
    """Each ray is cast from where the laser truly was at its own time; all ends are one place in the frame of the end."""
    step, count, dt = np.array([0.04, 0.0, 0.05]), 21, 0.1 / 20
    poses = [np.zeros(3)]
    for _ in range(3):
        poses.append(se2.compose(poses[-1], step))
    odometer = odometer_of([0.0, 0.1, 0.2, 0.3], poses)
    mounting = SensorMounting(T_base_laser=MOUNTING.T_base_laser, laser_flipped=flipped)
    point = np.array([3.0, 0.6])
    lasers = se2.compose(odometer.at(0.1 + dt * np.arange(count)), mounting.T_base_laser)
    seen = se2.transform(se2.inverse(lasers), np.tile(point, (count, 1)))
    bearings = np.arctan2(seen[:, 1], seen[:, 0]) * (-1.0 if flipped else 1.0)
    for k in range(count):
        readings = np.full(count, np.nan)
        readings[k] = np.hypot(*seen[k])
        rays = scan_rays(odometer, mounting, Scan(0.1, readings, Scanner(bearings[k] - 0.01 * k, 0.01, dt)))
        # The sweep is taken as linear in x, y and heading: off by 0.05 * 0.04 / 8 m at most.
        np.testing.assert_allclose(se2.transform(odometer.pose, rays.ends), point[None], atol=3e-4)
        assert rays.hit.all()


def test_rays_that_saw_nothing_are_clear_for_three_metres_and_error_codes_are_no_rays():
    odometer = odometer_of([0.0], [np.zeros(3)])
    readings = np.array([np.inf, 9.0, 2.0, 0.01, np.nan])
    rays = scan_rays(odometer, SensorMounting(), Scan(0.0, readings, Scanner(0.0, 0.1, 0.0, 0.02, 5.6)))
    assert rays.hit.tolist() == [False, False, True]
    np.testing.assert_allclose(np.hypot(*rays.ends.T), [3.0, 3.0, 2.0])
    np.testing.assert_array_equal(rays.origins, np.zeros((3, 2)))


def test_a_scan_of_many_rays_is_thinned():
    odometer = odometer_of([0.0], [np.zeros(3)])
    rays = scan_rays(odometer, SensorMounting(), Scan(0.0, np.full(1081, 2.0), Scanner(-2.0, 0.0037)))
    assert TRACK_RAYS / 2 < len(rays.hit) <= TRACK_RAYS


def test_a_scan_ends_with_its_last_ray_whichever_way_it_is_played():
    readings = np.ones(11)
    assert Scan(5.0, readings, Scanner(0.0, 0.1, 0.01)).end == pytest.approx(5.1)
    assert Scan(5.0, readings, Scanner(0.0, 0.1, -0.01)).end == 5.0
