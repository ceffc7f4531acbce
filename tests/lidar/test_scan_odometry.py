"""Motions between pairs of scans: measured where walls are seen, the guess where none are."""


import numpy as np
import pytest
from helpers.planted import box, drive, scans

from uwblite import se2
from uwblite.lidar.scan_odometry import ScanStepPolicy, _clouds, _pairs, _points, _searched, misfits, scan_steps
from uwblite.sensor_log import SensorMounting

WALLS = np.concatenate([box(9, 7), box(1, 2) + np.array([2.5, 1.5] * 2)])
FIRST, SECOND = np.array([0, 2, 1]), np.array([1, 4, 5])
NOMINAL = SensorMounting()
BEHIND = SensorMounting(laser_flipped=True, T_base_laser=np.array([-0.1, 0.05, 2.0]))


def seen(mounting=NOMINAL, **settings):
    """Return scans of a drive through a room and the true motions between pairs of them."""
    stamps, truth = drive([(0.3, 0.0, 0.2)], [3.0])
    lidar = scans(stamps, truth, WALLS, beams=360, sweep=1e-6, mounting=mounting, **settings)
    poses = se2.interpolate_trajectory(stamps, truth, lidar.stamps)
    return lidar, se2.between(poses[FIRST], poses[SECOND])


@pytest.mark.parametrize("mounting", [NOMINAL, BEHIND])
def test_motions_are_found_whatever_the_mounting(mounting):
    lidar, exact = seen(mounting, noise=0.005, rng=np.random.default_rng(1))
    found, share, information = scan_steps(lidar, mounting, FIRST, SECOND, exact + np.array([0.05, -0.04, 0.03]))
    error = se2.between(exact, found)
    assert np.abs(error[:, :2]).max() < 0.01
    assert np.abs(error[:, 2]).max() < 0.005
    assert share.min() > 0.8
    # A hundred points and more, each with its normal in some direction.
    assert np.all(np.linalg.eigvalsh(information)[:, 0] > 10.0)
    right, wrong = (misfits(lidar, mounting, FIRST, SECOND, exact + off) for off in (np.zeros(3), np.array([0.1, 0.1, 0.0])))
    assert np.all(right < 0.2 * wrong)
    away = misfits(lidar, mounting, FIRST, SECOND, exact + np.array([90.0, 0.0, 0.0]))
    np.testing.assert_allclose(away, ScanStepPolicy.reach**2)


def test_along_a_bare_corridor_a_scan_matches_the_next_one_no_better_if_the_robot_stood():
    """Readings end 6 m ahead, wherever the robot is; what one scan shows beyond the other's reach tells nothing."""
    stamps, truth = drive([(0.9, 0.0, 0.0)], [6.0])
    lidar = scans(
        stamps, truth, box(80, 3), beams=360, sweep=1e-6, range_max=6.0, noise=0.005, rng=np.random.default_rng(1)
    )  # fmt: skip
    exact = np.array([[0.9, 0.0, 0.0]])
    first = np.array([0])
    second = np.array([int(np.argmin(np.abs(lidar.stamps - lidar.stamps[0] - 1.0)))])
    moved, stood = (misfits(lidar, NOMINAL, first, second, motion) for motion in (exact, 0.0 * exact))
    assert moved < 0.02**2
    assert stood < 0.02**2


@pytest.mark.filterwarnings("error")
def test_scans_that_see_nothing_match_nothing():
    lidar, exact = seen(range_max=0.1)
    assert not np.isfinite(lidar.ranges).any()
    found, share, information = scan_steps(lidar, NOMINAL, FIRST, SECOND, exact)
    np.testing.assert_allclose(found, exact)
    assert not share.any()
    assert np.abs(information).max() < 1e-9
    assert not misfits(lidar, NOMINAL, FIRST, SECOND, exact).any()


@pytest.mark.parametrize("mounting", [NOMINAL, BEHIND])
def test_rays_are_points_in_the_frame_of_the_base_that_come_from_the_laser(mounting):
    lidar, _ = seen(mounting)
    chosen = np.array([4, 1])
    points = _points(lidar, mounting, chosen, 3.0)
    np.testing.assert_array_equal(points.origins, np.tile(mounting.T_base_laser[:2], (len(points.points), 1)))
    expected = []
    for number, scan in enumerate(chosen):
        for ray, reading in enumerate(lidar.ranges[scan].tolist()):
            if lidar.range_min <= reading <= 3.0:
                bearing = lidar.angles[ray] * (-1.0 if mounting.laser_flipped else 1.0)
                at = se2.transform(mounting.T_base_laser, reading * np.array([np.cos(bearing), np.sin(bearing)]))
                expected.append([number, ray, *at])
    assert len(expected) > 50
    found = np.column_stack([points.keyframe, points.ray, points.points])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_scan_that_sees_nothing_is_searched_in_vain():
    lidar, _ = seen()
    lidar.ranges[0] = np.inf
    raster, pairs = _pairs(*_clouds(lidar, NOMINAL, FIRST[:1], SECOND[:1]))
    assert _searched(raster, pairs, np.zeros(3))[1] == 0.0
    raster, pairs = _pairs(raster.clouds, pairs.j, pairs.j)
    assert _searched(raster, pairs, np.zeros(3))[1] > 0.9
