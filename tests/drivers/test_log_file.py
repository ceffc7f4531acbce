"""The log on disk: lines that other readers understand, appending after a crash, rotation."""

import errno
import math
import os
from unittest import mock

import pytest

from uwblite.drivers.events import LaserScan, OdometryPose, RangeEpoch, RangeReading
from uwblite.drivers.log_file import LogFile, last_state, metre_text, number_text, pose_line, range_lines, scan_line
from uwblite.errors import DataError


def test_numbers():
    assert number_text(-0.0000001) == "0.000000"
    assert number_text(-1.5) == "-1.500000"
    assert [metre_text(v, 5.6) for v in (math.inf, math.nan, 1.2344, 9.0, 5.6)] == ["5.600", "0.000", "1.234", "5.600", "5.600"]
    assert metre_text(12.5, 30.0) == "12.500"


def test_lines_are_read_back_by_the_reader(tmp_path):
    from uwblite.io.carmen import read_log

    poses = [OdometryPose(100.0 + 0.05 * k, 0.01 * k, -0.5, 0.3, 0.2, 0.1) for k in range(10)]
    readings = (math.inf, math.nan, *(1.0 + 0.001 * i for i in range(680)))
    scan = LaserScan(100.1, readings, -2.0862, 0.006135923, 9.765625e-05, 5.6)
    epoch = RangeEpoch(100.2, (RangeReading("0A1B", 3.217, 98), RangeReading("C0DE", 1.5, 100)))
    lines = [
        "# CARMEN Logfile",
        "PARAM laser_time_increment 0.000097656 100.0 host 0.0",
        "PARAM laser_range_min 0.020 100.0 h 0",
    ]
    lines += [pose_line(pose, f"{pose.stamp:.6f} host 0.0") for pose in poses]
    lines += [scan_line(scan, (0.1, 0.0, 0.5), poses[2], "100.100000 host 0.1"), *range_lines(epoch, "100.200000 host 0.2")]
    path = tmp_path / "run.log"
    path.write_text("\n".join([*lines, "COMMENT 3.2 anything at all", ""]))
    log = read_log(path)
    assert log.notes.broken == 0
    assert log.odometry.poses[3].tolist() == pytest.approx([0.03, -0.5, 0.3])
    assert log.mounting.T_base_laser.tolist() == pytest.approx([0.1, 0.0, 0.5], abs=1e-5)
    assert log.ranges.ranges.tolist() == [3.217, 1.5]
    assert log.ranges.anchor_ids == ("0A1B", "C0DE")
    ranges = log.scans.ranges[0]
    assert math.isinf(ranges[0])
    assert not ranges[1] >= log.scans.range_min
    assert ranges[2:].tolist() == pytest.approx(readings[2:], abs=1e-6)
    assert log.scans.angle_min == pytest.approx(-2.0862)
    assert log.scans.angle_increment == pytest.approx(0.006135923)
    assert log.scans.time_increment == pytest.approx(9.7656e-05)


def test_an_existing_log_is_not_overwritten(tmp_path):
    path = tmp_path / "run.log"
    path.write_text("ODOM\n")
    with pytest.raises(DataError, match="`append`"):
        LogFile(path)
    assert path.read_text() == "ODOM\n"


def test_appending_closes_the_broken_line(tmp_path):
    path = tmp_path / "run.log"
    path.write_text("ODOM 1 2 3 0 0 0 10.0 h 0.0\nODOM 4 5 6 0 0")
    log = LogFile(path, append=True)
    log.write(["COMMENT goes on"])
    log.close()
    assert path.read_text().splitlines() == ["ODOM 1 2 3 0 0 0 10.0 h 0.0", "ODOM 4 5 6 0 0", "COMMENT goes on"]


def test_last_state_ignores_the_broken_line(tmp_path):
    path = tmp_path / "run.log"
    path.write_text("ODOM 1 2 3 0 0 0 10.0 h 0.0\nUWB AA 1.0 100 12.5 h 2.0\nCOMMENT x y z w 99 h 1\nODOM 4 5 6 0 0 0 13.0 h 3")
    assert last_state(path) == (12.5, (1.0, 2.0, 3.0))
    path.write_text("UWB2 AA 1.0 100 12.5 h 2.0\nGYRO 0.1 0.2 14.5 h 2.0\nPARAM x 1 99 h 0\n")
    assert last_state(path)[0] == 14.5
    path.write_text("")
    assert last_state(path) == (None, (0.0, 0.0, 0.0))


def test_rotation_keeps_every_line_and_repeats_the_head(tmp_path):
    log = LogFile(tmp_path / "run.log", rotate=1000, sync=0)
    log.head += ["# CARMEN Logfile", "PARAM a 1 0 h 0"]
    log.write(log.head)
    lines = [f"UWB AA {k} 100 {k}.0 h 0" for k in range(200)]
    for line in lines:
        log.write([line])
    log.close()
    parts = [tmp_path / "run.log", *sorted(tmp_path.glob("run.*.log"), key=lambda p: int(p.stem.split(".")[1]))]
    assert len(parts) == log.part > 3
    texts = [part.read_text().splitlines() for part in parts]
    assert [line for text in texts for line in text if line.startswith("UWB")] == lines
    assert all(text[:2] == log.head for text in texts)
    assert all(part.stat().st_size < 1200 for part in parts)
    assert "continued in run.2.log" in texts[0][-1]
    again = LogFile(tmp_path / "run.log", append=True)
    assert again.path == parts[-1]
    again.close()


def test_a_disk_that_is_full_is_one_clear_error_and_leaves_whole_lines(tmp_path):
    log = LogFile(tmp_path / "run.log", sync=60.0)
    log.write(["ODOM 1"])
    write = os.write

    def half(fd, data):
        if len(data) < 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(fd, data[:4])

    with mock.patch.object(os, "write", half), pytest.raises(DataError, match="free some space"):
        log.write(["ODOM 2"])
    log.write(["ODOM 3"])
    log.close()
    assert (tmp_path / "run.log").read_text() == "ODOM 1\nODOM 3\n"


def test_a_part_that_cannot_begin_is_one_clear_error(tmp_path):
    log = LogFile(tmp_path / "run.log", rotate=10, sync=60.0)
    (tmp_path / "run.2.log").mkdir()
    with pytest.raises(DataError, match=r"run\.2\.log: cannot begin the next part"):
        log.write(["ODOM 1 2 3 4"])
    log.close()
    assert "ODOM 1 2 3 4" in (tmp_path / "run.log").read_text()


@pytest.mark.parametrize("what", ["file", "folder"])
def test_a_log_that_is_deleted_is_written_again(tmp_path, what):
    folder = tmp_path / "logs"
    folder.mkdir()
    log = LogFile(folder / "run.log", sync=60.0)
    log.write([f"ODOM {k}" for k in range(30_000)])
    assert not log.restore()
    (folder / "run.log").unlink()
    if what == "folder":
        folder.rmdir()
    log.write(["ODOM between"])
    assert log.restore()
    assert log.free_bytes() > 0
    log.write(["ODOM after"])
    log.close()
    lines = (folder / "run.log").read_text().splitlines()
    assert lines == [*(f"ODOM {k}" for k in range(30_000)), "ODOM between", "ODOM after"]
