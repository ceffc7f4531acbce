"""A log that is being written reads as the whole one does, however it is cut up."""

import numpy as np
import pytest

from uwblite.io.carmen import read_log
from uwblite.io.carmen_live import LiveReader

READINGS = " ".join(f"{1.0 + 0.01 * k:.3f}" for k in range(9)) + " 5.600"
TEXT = (
    "# CARMEN Logfile\nPARAM laser_time_increment 0.001 0 h 0\nPARAM uwb_tag_offset_x 0.2 0 h 0\n"
    "ODOM 0 0 0 0 0 0 1.0 h 1.0\nUWB A 2.500 100 1.1 h 1.1\n"
    f"ROBOTLASER1 0 -1.0 1.8 0.2 5.6 0.01 0 10 {READINGS} 0 0.3 0 0 0.2 0 0 0 0 0 0 0 1.15 h 1.15\n"
    "GYRO 0.75 0.1 1.18 h 1.18\n"
    "ODOM 0.1 0 0.01 0 0 0 1.2 h 1.2\nODOM broken\nUWB2 B 3.5 90 1.3 h 1.3\nODOM 0.2 0 0.02 0 0 0 1.4 h 1.4\n"
).encode()


def measured(pieces):
    reader = LiveReader()
    return [m for piece in pieces for m in reader.feed(piece)], reader


@pytest.mark.parametrize("size", [1, 7, 100, len(TEXT)])
def test_pieces_of_any_size_give_what_the_whole_log_gives(tmp_path, size):
    found, reader = measured([TEXT[k : k + size] for k in range(0, len(TEXT), size)])
    (tmp_path / "run.log").write_bytes(TEXT)
    log = read_log(tmp_path / "run.log", max_broken_share=0.5)
    odometry = [m for m in found if m.sensor == "odometry"]
    np.testing.assert_array_equal([m.value for m in odometry], log.odometry.poses)
    np.testing.assert_array_equal([m.stamp for m in odometry], log.odometry.stamps)
    ranges = [(m.stamp, m.anchor_id, m.value, m.tag) for m in found if m.sensor == "uwb"]
    assert ranges == [(1.1, "A", 2.5, 0), (1.3, "B", 3.5, 1)]
    assert [(m.stamp, m.value) for m in found if m.sensor == "gyro"] == [(1.18, 0.75)]
    (scan,) = (m for m in found if m.sensor == "lidar")
    np.testing.assert_array_equal(scan.value.ranges, log.scans.ranges)
    assert (scan.value.angle_min, scan.value.time_increment) == (log.scans.angle_min, log.scans.time_increment)
    np.testing.assert_allclose(reader.mounting.T_base_laser, [0.1, 0, 0], atol=1e-9)
    assert reader.mounting.tag_position[0] == 0.2
    assert reader.broken == 1


def test_measurements_come_in_the_order_in_which_they_were_complete():
    found, _ = measured([TEXT])
    assert [m.order for m in found] == sorted(m.order for m in found)


def test_what_follows_a_clock_that_was_set_back_comes_behind_what_was_written_before():
    """One piece of a log that is followed holds both: sorted by time, the robot would drive back."""
    earlier = TEXT
    for stamp in (b"1.0", b"1.1", b"1.15", b"1.18", b"1.2", b"1.3", b"1.4"):
        earlier = earlier.replace(stamp + b" h " + stamp + b"\n", b"0.%s h 0.%s\n" % (stamp[2:], stamp[2:]))
    whole, (first, reader) = measured([TEXT])[0], measured([TEXT + b"\r\n\n" + earlier])
    assert [m.order for m in first] == [m.order for m in whole] + [pytest.approx(m.order - 1.0) for m in whole]
    assert reader.broken == 2


def test_a_line_in_pieces_is_one_line():
    reader = LiveReader()
    reader.feed(b"x" * 5)
    assert reader.feed(b"\n") == []
