"""Corrected logs: the lines of the input with poses of the map, readable as logs again."""

import gzip
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite import se2
from uwblite.graph.graph import Calibration
from uwblite.io.carmen import read_log
from uwblite.io.corrected_log import poses_of_scans, write_corrected_log
from uwblite.sensor_log import LaserScans, SensorMounting

MOUNT = np.array([0.2, -0.1, 0.3])


def robot_at(stamps):
    return np.column_stack([stamps * 2.0, stamps - 1.0, 0.1 * stamps])


def poses_at(stamps):
    robot = robot_at(stamps)
    robot[stamps > 90.0] = np.nan
    return se2.compose(robot, MOUNT), robot


LINES = """\
# recorded somewhere
PARAM robot_front_laser_max 40.0 0 r 0
ODOM 9 9 9 0 0 0 0.5 robot 0.5
UWB A1 3.0 100 0.6 robot 0.6
FLASER 3 1.00 2.0 3.000 7 8 0.5 6.9 8 0.4 1.5 robot 1.5
ROBOTLASER1 0 -1 2 1 8 0.01 0 3 1.0 2.0 3.0 2 77 78 1 2 3 4 5 0.6 0.1 0.2 0.3 0.4 1 2.5 robot 2.6
FLASER 3 1.0 2.0
FLASER 3 1.0 2.0 3.0 7 8 0.5 6.9 8 0.4 95 robot 95
"""


@pytest.mark.parametrize("name", ["in.log", "in.log.gz"])
def test_laser_lines_get_the_poses_of_the_map_and_all_else_of_them_stays(tmp_path, name):
    source, out = tmp_path / name, tmp_path / "out.log"
    source.write_bytes(gzip.compress(LINES.encode()) if name.endswith("gz") else LINES.encode())
    assert write_corrected_log(out, str(source), poses_at) == (2, 2)
    comment, param, flaser, robotlaser = out.read_text().splitlines()
    assert (comment, param) == tuple(LINES.splitlines()[:2])
    words = flaser.split()
    assert words[:5] == ["FLASER", "3", "1.00", "2.0", "3.000"]
    assert words[8:] == ["6.9", "8", "0.4", "1.5", "robot", "1.5"]
    np.testing.assert_allclose(np.array(words[5:8], dtype=float), se2.compose(robot_at(np.array([1.5]))[0], MOUNT), atol=1e-6)
    words = robotlaser.split()
    assert words[:15] == ["ROBOTLASER1", "0", "-1", "2", "1", "8", "0.01", "0", "3", "1.0", "2.0", "3.0", "2", "77", "78"]
    assert words[21:] == ["0.1", "0.2", "0.3", "0.4", "1", "2.5", "robot", "2.6"]
    laser, robot = (np.array(words[k : k + 3], dtype=float) for k in (15, 18))
    np.testing.assert_allclose(robot, robot_at(np.array([2.5]))[0], atol=1e-6)
    np.testing.assert_allclose(se2.between(robot, laser), MOUNT, atol=3e-6)


def test_a_corrected_log_is_a_log_with_the_same_mounting(tmp_path):
    scan = "ROBOTLASER1 0 -1 2 1 8 0.01 0 3 1.0 2.0 3.0 0 {0} 0 0 {0} 0 0 0 0 0 0 0 {0} robot {0}\n"
    (tmp_path / "in.log").write_text("".join(scan.format(k) for k in range(5)))
    write_corrected_log(tmp_path / "out.log.gz", str(tmp_path / "in.log"), poses_at)
    log = read_log(tmp_path / "out.log.gz")
    np.testing.assert_allclose(log.odometry.poses, robot_at(np.arange(5.0)), atol=1e-6)
    np.testing.assert_allclose(log.mounting.T_base_laser, MOUNT, atol=3e-6)
    assert log.scans.ranges.shape == (5, 3)


def test_poses_are_asked_in_the_middle_of_the_scan_at_the_lidars_clock():
    stamps = np.arange(0.0, 10.0, 0.1)
    result = SimpleNamespace(stamps=stamps, trajectory=robot_at(stamps), graph=SimpleNamespace(calibration=Calibration()))
    scans = LaserScans(np.zeros(1), np.zeros((1, 21), dtype=np.float32), 0.0, 0.1, 0.01, 0.0, 9.0)
    log = SimpleNamespace(scans=scans, mounting=SensorMounting(T_base_laser=MOUNT))
    laser, robot = poses_of_scans(result, log, np.array([2.0, 30.0]))
    np.testing.assert_allclose(robot[0], robot_at(np.array([2.1]))[0], atol=1e-3)
    np.testing.assert_allclose(se2.between(robot[0], laser[0]), MOUNT, atol=1e-9)
    assert np.isnan(robot[1]).all()


def test_raw_scans_become_scans_with_poses_where_the_log_has_no_others(tmp_path):
    raw = "RAWLASER1 0 -1 2 1 8 0.01 0 3 1.0 2.0 3.0 1 7 {0} robot {0}\n"
    lines = ["PARAM robot_frontlaser_offset 0.2 0 r 0\n", *(raw.format(k) for k in range(5)), "RAWLASER1 0 -1\n"]
    (tmp_path / "in.log").write_text("".join(lines))
    assert write_corrected_log(tmp_path / "out.log", str(tmp_path / "in.log"), poses_at) == (5, 1)
    log = read_log(tmp_path / "out.log")
    np.testing.assert_allclose(log.odometry.poses, robot_at(np.arange(5.0)), atol=1e-6)
    np.testing.assert_allclose(log.mounting.T_base_laser, MOUNT, atol=3e-6)
    np.testing.assert_allclose(log.scans.ranges, np.broadcast_to([1.0, 2.0, 3.0], (5, 3)))
    (tmp_path / "in.log").write_text("".join([LINES, *lines]))
    assert write_corrected_log(tmp_path / "out.log", str(tmp_path / "in.log"), poses_at) == (2, 2)
    assert "RAWLASER1" not in (tmp_path / "out.log").read_text()
