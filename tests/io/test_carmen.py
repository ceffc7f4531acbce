import gzip
import hashlib
import io
import math
import sys
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import FormatError, UwbliteError
from uwblite.io.carmen import read_log, write_log
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges

ODOM = "ODOM {x} 0 0 0 0 0 {t} robot {t}\n"


def read(tmp_path, text, **options):
    (tmp_path / "a.log").write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_log(tmp_path / "a.log", **options)


def odometry(count=3):
    return "".join(ODOM.format(x=k, t=0.1 * k) for k in range(count))


def robotlaser(readings, stamp=0.0, laser="0.1 0 0", robot="0 0 0", maximum="5.6", head="2 -1.5 3.0 0.005", remissions=" 0"):
    return (
        f"ROBOTLASER1 {head} {maximum} 0.01 0 {len(readings)} {' '.join(readings)}{remissions} {laser} {robot} "
        f"0 0 0 0 0 {stamp} robot {stamp}\n"
    )


READINGS = ["1.000", "5.600", "0.000", "2.345", "5.599"]


def random_log(seed=0, beams=31, scans=23, range_max=12.0):
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.uniform(1e9, 1e9 + 10, 40))
    poses = np.stack([*np.cumsum(rng.normal(scale=0.1, size=(2, 40)), axis=1), rng.uniform(-3, 3, 40)], axis=1)
    ranges = np.round(rng.uniform(0.05, range_max - 0.1, (scans, beams)), 3).astype(np.float32)
    ranges[rng.random(ranges.shape) < 0.2] = np.inf
    ranges[rng.random(ranges.shape) < 0.1] = np.nan
    range_stamps, distances = np.sort(rng.uniform(1e9, 1e9 + 10, 30)), rng.uniform(0, 20, 30)
    uwb = UwbRanges(range_stamps, np.arange(30) % 3, distances, rng.integers(0, 101, 30).astype(float), ("1151", "5C0B", "A-1"))
    laser = LaserScans(np.sort(rng.uniform(1e9, 1e9 + 10, scans)), ranges, -2.0, 0.13, 1e-4, 0.03, range_max)
    heights = {"5C0B": 2.25, "A-1": 0.75}
    mounting = SensorMounting(np.array([0.1, -0.02, 3.0]), True, np.array([0.05, 0.01, 0.3]), 1.5, heights)
    return SensorLog(Odometry(stamps, poses), uwb, laser, mounting)


def assert_same(a, b):
    np.testing.assert_allclose(a.odometry.stamps, b.odometry.stamps, atol=1e-6)
    np.testing.assert_allclose(a.odometry.poses, b.odometry.poses, atol=1e-6)
    assert a.ranges.anchor_ids == b.ranges.anchor_ids
    np.testing.assert_array_equal(a.ranges.anchor, b.ranges.anchor)
    np.testing.assert_allclose(a.ranges.ranges, b.ranges.ranges, atol=1e-4)
    np.testing.assert_array_equal(a.ranges.quality, b.ranges.quality)
    np.testing.assert_array_equal(a.scans.ranges, b.scans.ranges)
    assert a.scans.ranges.dtype == np.float32
    for name in ("angle_min", "angle_increment", "time_increment", "range_min", "range_max"):
        assert getattr(a.scans, name) == pytest.approx(getattr(b.scans, name), abs=1e-9)
    np.testing.assert_allclose(a.mounting.T_base_laser, b.mounting.T_base_laser, atol=2e-6)
    np.testing.assert_allclose(a.mounting.tag_position, b.mounting.tag_position, atol=1e-6)
    assert a.mounting.laser_flipped == b.mounting.laser_flipped
    assert a.mounting.anchor_height == b.mounting.anchor_height
    assert a.mounting.anchor_heights == b.mounting.anchor_heights


@pytest.mark.parametrize("range_max", [5.6, 30.0, 120.0])
@pytest.mark.parametrize("ending", [".log", ".log.gz"])
def test_what_is_written_is_read(tmp_path, range_max, ending):
    log = random_log(range_max=range_max)
    write_log(tmp_path / f"a{ending}", log)
    back = read_log(tmp_path / f"a{ending}")
    assert_same(back, log)
    assert back.notes.broken == 0
    assert back.notes.warnings == ()
    assert back.notes.sha256 == hashlib.sha256((tmp_path / f"a{ending}").read_bytes()).hexdigest()
    # What was rounded once stays as it is.
    write_log(tmp_path / f"b{ending}", back)
    write_log(tmp_path / f"c{ending}", read_log(tmp_path / f"b{ending}"))
    assert (tmp_path / f"b{ending}").read_bytes() == (tmp_path / f"c{ending}").read_bytes()


def test_a_log_may_lack_laser_and_radio(tmp_path):
    log = random_log()
    write_log(tmp_path / "a.log", log.without(uwb=True, lidar=True))
    back = read_log(tmp_path / "a.log")
    assert back.ranges is None
    assert back.scans is None
    np.testing.assert_allclose(back.odometry.poses, log.odometry.poses, atol=1e-6)


def test_readings_mean_what_the_conventions_report(tmp_path):
    log = read(tmp_path, odometry() + robotlaser([*READINGS, "0.019", "0.02", "80", "-1", "nan", "inf", "1e-3"], 0.25))
    expected = [1.0, np.inf, np.nan, 2.345, 5.599, np.nan, 0.02, np.inf, np.nan, np.nan, np.inf, np.nan]
    np.testing.assert_array_equal(log.scans.ranges[0], np.array(expected, np.float32))
    assert (log.scans.angle_min, log.scans.angle_increment, log.scans.range_max) == (-1.5, 0.005, 5.6)
    assert log.scans.stamps.tolist() == [0.25]
    np.testing.assert_allclose(log.mounting.T_base_laser, [0.1, 0, 0])


@pytest.mark.parametrize("maximum", ["5.6", "5.60", "5.600000", "4.095", "81.91", "0.3"])
def test_a_reading_of_exactly_the_maximum_saw_nothing(tmp_path, maximum):
    below = f"{float(maximum) - 0.001:.3f}"
    log = read(tmp_path, odometry() + robotlaser([f"{float(maximum):.3f}", below, "0.1"], maximum=maximum))
    assert np.isposinf(log.scans.ranges[0, 0])
    assert log.scans.ranges[0, 1] == np.float32(below)


SPELLINGS = {
    "two decimals": "1.00 5.60 0.00 2.34 5.59",
    "six decimals": "1.000000 5.600000 0.000000 2.345678 5.599000",
    "no decimals": "1 6 0 2 5",
    "mixed": "1 5.6 0 2.345 5.599",
    "wide": "10.000 5.600 0.000 123.456 5.599",
    "very wide": "1000000.000 5.600 0.000 2.345 5.599",
    "exponents": "1e0 5.6 0.0 2.345e0 5.599",
    "signed": "+1.000 5.600 -0.000 2.345 5.599",
    "many digits": "1.00000000000 5.6000000000 0.000 2.34500001 5.599",
    "no digit before the dot": ".500 5.600 .000 2.345 5.599",
    "none behind it": "1. 5.6 0. 2.345 5.599",
}


@pytest.mark.parametrize("spelling", SPELLINGS.values(), ids=SPELLINGS.keys())
@pytest.mark.parametrize("blank", [" ", "  ", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", " \n"])
def test_numbers_may_be_spelled_in_any_way(tmp_path, spelling, blank, end):
    line = robotlaser(spelling.split(), maximum="2000000").replace(" ", blank).replace("\n", end)
    values = np.array([float(word) for word in spelling.split()], np.float32)
    values[values < np.float32(0.02)] = np.nan
    log = read(tmp_path, odometry() + line)
    np.testing.assert_array_equal(log.scans.ranges[0], values)
    assert log.notes.broken == 0


@given(st.lists(st.tuples(st.integers(0, 6), st.floats(0.0, 1e6)), min_size=1, max_size=12), st.integers(1, 4))
def test_any_number_of_decimals_reads_as_float_does(tmp_path_factory, numbers, scans):
    words = [f"{value:.{digits}f}" for digits, value in numbers]
    text = odometry() + "".join(robotlaser(words, 0.1 * k, maximum="1e7", head="0 0 0.1 0.01") for k in range(scans))
    log = read(tmp_path_factory.mktemp("log"), text)
    expected = np.array([float(word) for word in words])
    expected[expected < 0.02] = np.nan
    np.testing.assert_allclose(log.scans.ranges, np.tile(expected.astype(np.float32), (scans, 1)), rtol=1e-7)


@pytest.mark.parametrize("ipc", [True, False])
@pytest.mark.parametrize("turn_axis", [True, False])
@pytest.mark.parametrize("remissions", ["", " 0", " 2 17 18"])
def test_all_forms_of_robotlaser(tmp_path, ipc, turn_axis, remissions):
    stamp = "7.25 robot 3.5" if ipc else "robot 3.5"
    tail = f"1.1 2.0 1.57 1.0 2.0 1.57 0 0 0 0{' 0.9' if turn_axis else ''} {stamp}\n"
    lines = odometry() if ipc else "ODOM 0 0 0 0 0 0 robot 1.5\nODOM 0 0 0 0 0 0 robot 2.5\n"
    scan = "ROBOTLASER1 0 -1 2 1 8 0.01 0 3 1.0 2.0 3.0"
    log = read(tmp_path, lines + scan + f"{remissions} {tail}")
    assert log.scans.stamps.tolist() == [7.25 if ipc else 3.5]
    np.testing.assert_allclose(log.mounting.T_base_laser, se2.between([1, 2, 1.57], [1.1, 2.0, 1.57]), atol=1e-6)
    assert log.notes.broken == 0


def test_ipc_timestamp_may_be_left_out_everywhere(tmp_path):
    log = read(
        tmp_path,
        "PARAM uwb_tag_height 0.5 robot 0\nODOM 1 2 3 0 0 0 robot 4.5\nUWB 5C0B 3.25 90 robot 4.75\n"
        "RAWLASER1 0 -1 2 1 8 0.01 0 3 1 2 3 0 robot 5.5\nFLASER 3 1 2 3 0 0 0 0 0 0 robot 6\nSYNC x robot 7\n",
    )
    assert log.odometry.stamps.tolist() == [4.5]
    assert log.ranges.stamps.tolist() == [4.75]
    assert log.scans.stamps.tolist() == [6.0]
    assert log.mounting.tag_position.tolist() == [0, 0, 0.5]


def test_flaser_angles_follow_the_number_of_beams(tmp_path):
    usual = ((180, -90, 1), (181, -90, 1), (360, -90, 0.5), (361, -90, 0.5), (401, -50, 0.25), (1081, -135, 0.25))
    for beams, first, step in usual:
        line = f"FLASER {beams} {' '.join(['2.00'] * beams)} 0.2 0 0 0 0 0 1 robot 1\n"
        log = read(tmp_path, odometry() + line)
        assert math.degrees(log.scans.angle_min) == pytest.approx(first)
        assert math.degrees(log.scans.angle_increment) == pytest.approx(step)
        np.testing.assert_allclose(log.mounting.T_base_laser, [0.2, 0, 0])
    line = "FLASER 5 1 2 3 90 5 0 0 0 0 0 0 1 robot 1\n"
    params = "PARAM laser_front_laser_resolution 0.5 0 r 0\nPARAM robot_front_laser_max 4.0 0 r 0\n"
    log = read(tmp_path, params + odometry() + line)
    assert math.degrees(log.scans.angle_min) == pytest.approx(-1.0)
    assert np.isinf(log.scans.ranges[0]).tolist() == [False, False, False, True, True]
    assert read(tmp_path, odometry() + line).scans.range_max == 80.0


def test_flaser_of_a_corrected_log_reports_nothing_of_the_mounting(tmp_path):
    lines = "".join(f"FLASER 3 1 2 3 {k} {k * k} 0 {k} 0 0 {k} robot {k}\n" for k in range(9))
    log = read(tmp_path, "PARAM robot_frontlaser_offset 0.3 0 r 0\n" + odometry() + lines)
    np.testing.assert_allclose(log.mounting.T_base_laser, [0.3, 0, 0])
    assert "do not fit together" in log.notes.warnings[0]


def queued(other=0.0, apart=0.1):
    """Return a log of 120 rounds of ODOM, ODOM, FLASER that arrive six rounds at a time, and the poses in its FLASER.

    Parameters
    ----------
    other : m, place of the poses in FLASER beside those of ODOM. apart : s between rounds.
    """
    lines, poses = [], []
    for k in range(120):
        t = 6 * apart * (k // 6) + 0.003 * (k % 6)
        lines += [f"ODOM {0.1 * k + x:.3f} 0 0 0 0 0 {t + x / 50:.6f} robot {t + x / 50:.6f}\n" for x in (0.03, 0.08)]
        poses.append((0.1 * k + 0.1, other, 0.01 * k))
        pose = " ".join(f"{v:.3f}" for v in poses[-1])
        lines.append(f"FLASER 3 1 2 3 {pose} {pose} {t + 0.002:.6f} robot {t + 0.002:.6f}\n")
    return "".join(lines), np.array(poses)


def test_poses_that_came_with_scans_replace_odometry_whose_stamps_are_those_of_receipt(tmp_path):
    text, poses = queued()
    log = read(tmp_path, text)
    np.testing.assert_allclose(log.odometry.poses, poses)
    np.testing.assert_array_equal(log.odometry.stamps, log.scans.stamps)
    assert "times of receipt in bursts" in log.notes.warnings[0]


def test_poses_of_another_frame_replace_nothing(tmp_path):
    assert len(read(tmp_path, queued(other=3.0)[0]).odometry.stamps) == 240


def test_a_log_whose_scans_have_the_robots_poses_is_one_of_its_laser(tmp_path):
    """By FLASER, or by the parameter with which it is written again; not where the two differ."""
    log = read(tmp_path, queued()[0])
    assert log.mounting.laser_is_base
    write_log(tmp_path / "again.log", log)
    again = read_log(tmp_path / "again.log")
    assert again.mounting.laser_is_base
    np.testing.assert_allclose(again.odometry.poses, log.odometry.poses)
    assert not read(tmp_path, odometry() + "FLASER 3 1 2 3 0.2 0 0 0 0 0 1 robot 1\n").mounting.laser_is_base
    assert not read(tmp_path, odometry() + robotlaser(READINGS, 0.7)).mounting.laser_is_base


def test_the_richest_laser_message_wins(tmp_path):
    raw = "RAWLASER1 0 -1 2 1 8 0.01 0 3 1 2 3 0 0.5 robot 1\n"
    front = "FLASER 3 1 2 3 0 0 0 0 0 0 0.6 robot 1\n"
    for lines in ([raw, front, robotlaser(READINGS, 0.7)], [robotlaser(READINGS, 0.7), raw, front]):
        log = read(tmp_path, odometry() + "".join(lines))
        assert log.scans.stamps.tolist() == [0.7]
        assert log.notes.skipped == {"FLASER": 1, "RAWLASER1": 1}
    log = read(tmp_path, odometry() + raw)
    assert (log.scans.angle_min, log.scans.angle_increment, log.scans.range_max) == (-1, 1, 8)


def test_the_commonest_geometry_wins(tmp_path):
    lines = [robotlaser(["1.000"] * 3, k) for k in range(2)] + [robotlaser(READINGS, 5 + k) for k in range(3)]
    log = read(tmp_path, odometry() + lines[0] + lines[2] + lines[3] + lines[1] + lines[4])
    assert log.scans.ranges.shape == (3, 5)
    assert log.scans.stamps.tolist() == [5, 6, 7]
    assert log.notes.skipped == {"ROBOTLASER1 of another geometry": 2}
    assert "another geometry" in log.notes.warnings[0]


def flaser(ranges, stamp):
    return f"FLASER {len(ranges)} {' '.join(f'{r:.3f}' for r in ranges)} 0 0 0 0 0 0 {stamp} robot {stamp}\n"


def test_scans_of_another_number_of_beams_are_resampled(tmp_path):
    """A SICK that interlaces sends 181 and 180 beams: these lie between those, as a wall shows."""

    def wall(beams, first):
        return 3.0 / np.cos(np.radians(first + np.arange(beams)) / 3.0)

    most, few = [flaser(wall(180, -89.5), k) for k in (0, 2, 4)], [flaser(wall(181, -90.0), k) for k in (1, 3)]
    log = read(tmp_path, odometry() + most[0] + few[0] + most[1] + few[1] + most[2])
    assert log.scans.stamps.tolist() == [0, 1, 2, 3, 4]
    assert np.degrees(log.scans.angles[[0, -1]]) == pytest.approx([-89.5, 89.5])
    np.testing.assert_allclose(log.scans.ranges, np.tile(wall(180, -89.5), (5, 1)), atol=2e-3)
    assert any("2 of 5 scans have other beams than most; they were resampled to 180" in w for w in log.notes.warnings)
    assert not log.notes.set_back
    assert not any("out of time order" in w for w in log.notes.warnings)
    log = read(tmp_path, odometry() + few[0] + most[0] + few[1])
    assert log.scans.ranges.shape == (3, 181)
    np.testing.assert_allclose(log.scans.ranges[1, 1:-1], wall(181, -90.0)[1:-1], atol=2e-3)


def test_robot_poses_stand_in_for_missing_odometry(tmp_path):
    lines = [robotlaser(READINGS, k, laser=f"{k + 0.1} 0 0", robot=f"{k} 0 0") for k in range(4)]
    log = read(tmp_path, "".join(lines))
    np.testing.assert_allclose(log.odometry.poses, [[k, 0, 0] for k in range(4)])
    assert "serve as odometry" in log.notes.warnings[0]
    thinned = read(tmp_path, "".join(lines), every_nth_scan=2)
    assert len(thinned.odometry.stamps) == 4
    assert thinned.scans.stamps.tolist() == [0, 2]


def test_a_laser_that_wobbles_is_reported(tmp_path):
    lines = [robotlaser(READINGS, k, laser=f"{0.1 + 0.05 * (k == 2)} 0 3.14159", robot="0 0 0") for k in range(5)]
    log = read(tmp_path, odometry() + "".join(lines))
    np.testing.assert_allclose(log.mounting.T_base_laser, [0.1, 0, 3.14159], atol=1e-5)
    assert "varies in 1 of 5" in log.notes.warnings[0]


def test_angles_of_the_mounting_wrap(tmp_path):
    lines = [robotlaser(READINGS, k, laser=f"0 0 {3.1415 if k % 2 else -3.1415}") for k in range(6)]
    log = read(tmp_path, odometry() + "".join(lines))
    assert abs(abs(log.mounting.T_base_laser[2]) - math.pi) < 1e-3
    assert log.notes.warnings == ()


def test_messages_out_of_order_are_sorted_and_equal_stamps_keep_their_places(tmp_path):
    lines = [ODOM.format(x=x, t=t) for x, t in ((1, 5.0), (2, 3.0), (3, 5.0), (4, 3.0))]
    uwb = "UWB b 1 100 9 r 9\nUWB a 2 100 8 r 8\nUWB b 3 100 9 r 9\n"
    scans = [robotlaser([f"{k}.000", "3.000"], t) for k, t in ((1, 2.0), (2, 1.0), (3, 2.0))]
    log = read(tmp_path, "".join(lines) + uwb + "".join(scans))
    assert log.odometry.poses[:, 0].tolist() == [2, 4, 1, 3]
    assert log.ranges.ranges.tolist() == [2, 1, 3]
    assert [log.ranges.anchor_ids[a] for a in log.ranges.anchor] == ["a", "b", "b"]
    assert log.scans.ranges[:, 0].tolist() == [2, 1, 3]
    assert [w.split(";")[0] for w in log.notes.warnings] == [
        "2 of 4 odometry messages came out of time order",
        "1 of 3 UWB messages came out of time order",
        "1 of 3 ROBOTLASER1 messages came out of time order",
    ]


@pytest.mark.parametrize(
    ("stamps", "by"),
    [
        ([5, 6, 7, 8, 1, 2, 3, 4], 0.0),  # halves swapped
        ([1, 2, 7, 8, 3, 4, 5, 6], 0.0),  # a block too early
        ([11, 12, 1, 2, 9, 10], 0.0),  # a silence within a part is none between parts
        ([1, 2, 3, 4, 2.5, 3.5, 4.5], 1.5),  # the same time twice
        ([30, 31, 32, 1, 2, 3], 31.0),  # a clock set back long before the time that it had counted
    ],
)
def test_parts_in_another_order_are_no_clock_that_was_set_back(tmp_path, stamps, by):
    log = read(tmp_path, "".join(ODOM.format(x=0.1 * t, t=t) for t in stamps))
    assert log.odometry.stamps.tolist() == sorted(stamps)
    assert log.notes.set_back == {"odometry": by}
    assert any("came out of time order" in w for w in log.notes.warnings)


def test_params_set_the_mounting(tmp_path):
    params = {
        "uwb_tag_offset_x": 0.05, "uwb_tag_offset_y": -0.1, "uwb_tag_height": 0.3, "uwb_anchor_height": 2,
        "uwb_anchor_height_5C0B": 1.5, "laser_flipped": "on", "laser_time_increment": 1e-4, "laser_range_min": 0.5,
        "foreign_thing": "some words here",
    }  # fmt: skip
    text = "".join(f"PARAM {name} {value} 0 robot 0\n" for name, value in params.items())
    log = read(tmp_path, text + odometry() + robotlaser(READINGS) + "PARAM uwb_tag_height 0.4 9 robot 9\n")
    assert log.mounting.tag_position.tolist() == [0.05, -0.1, 0.4]
    assert log.mounting.anchor_height == 2
    assert log.mounting.anchor_heights == {"5C0B": 1.5}
    assert log.mounting.laser_flipped
    assert (log.scans.time_increment, log.scans.range_min) == (1e-4, 0.5)


def test_the_sweep_of_a_urg_is_known(tmp_path):
    def increment(period, maximum="5.6", beams=682):
        head = f"2 -2.0862 4.18 {2 * math.pi / 1024}"
        scans = [robotlaser(["1.000"] * beams, period * k, maximum=maximum, head=head) for k in range(6)]
        return read(tmp_path, odometry() + "".join(scans)).scans.time_increment

    assert increment(0.1) == pytest.approx(0.1 / 1024)
    assert increment(0.3) == pytest.approx(0.1 / 1024)
    assert increment(0.1, maximum="30") == 0.0
    assert increment(0.025) == 0.0
    assert increment(0.1, beams=500) == 0.0


def test_thinning_keeps_every_nth(tmp_path):
    scans = "".join(robotlaser([f"{k / 10 + 1:.3f}", "3.000"], k) for k in range(7))
    log = read(tmp_path, odometry() + scans, every_nth_scan=3)
    np.testing.assert_allclose(log.scans.ranges[:, 0], [1.0, 1.3, 1.6])
    assert log.notes.skipped == {"ROBOTLASER1 thinned out": 4}
    with pytest.raises(UwbliteError, match="every_nth_scan"):
        read(tmp_path, odometry(), every_nth_scan=0)


def test_other_messages_are_counted_by_name(tmp_path):
    others = "SYNC a 1 r 1\nCOMMENT b c d 1 r 1\nSYNC a 1 r 1\nMY_SENSOR-2 5 1 r 1\n"
    log = read(tmp_path, "# comment\n\n   \n" + others + odometry())
    assert log.notes.skipped == {"COMMENT": 1, "MY_SENSOR-2": 1, "SYNC": 2}
    assert log.notes.broken == 0
    assert log.notes.lines == 10


BROKEN = {
    "ODOM 1 2 3 0 0 0": "ODOM has 7 fields, expected 10",
    "ODOM 1 2 x 0 0 0 1 r 1": "not a number: b'x'",
    "ODOM 1 2 nan 0 0 0 1 r 1": "not finite",
    "ODOM 1 inf 3 0 0 0 1 r 1": "not finite",
    "ODOM 1 2 3 0 0 0 nan r 1": "stamp is not finite",
    "UWB a 1 100": "UWB has 4 fields",
    "UWB a nan 100 1 r 1": "not finite",
    "UWB a far 100 1 r 1": "not a number",
    "UWB " + "a" * 65 + " 1 100 1 r 1": "anchor_id",
    "UWB a\x1b[31m 1 100 1 r 1": "anchor_id",
    "UWB \xff 1 100 1 r 1": "decode",
    "PARAM uwb_tag_height high 0 r 0": "not a number",
    "PARAM laser_flipped perhaps 0 r 0": "on or off",
    "PARAM x": "PARAM needs",
    "ROBOTLASER1 0 0": "far too few",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 500 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 1 r 1": "500 readings",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 999999999999 1 2 3": "readings",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 -3 1 2 3": "readings",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 2.5 1 2 3": "invalid literal",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1 r 1": "announces 0 readings",
    "ROBOTLASER1 0 0 1 9 8 0 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 1 r 1": "more than a turn",
    "ROBOTLASER1 0 nan 1 0.1 8 0 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 1 r 1": "not finite",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 3 1 x 3 0 0 0 0 0 0 0 0 0 0 0 0 1 r 1": "x",
    "ROBOTLASER1 0 0 1 0.1 8 0 0 3 1 2 3 0 0 0 0 0 0 0": "fields behind its readings",
    "RAWLASER1 0 0 1 0.1 8 0 0 3 1 2 3 0 0 0 0 1 r 1": "fields behind its readings",
    "FLASER 3 1 2 3 0 0 0 1 r 1": "fields behind its readings",
    "FLASER 3 1.000 2.000 3.x00 0 0 0 0 0 0 1 r 1": "3.x00",
    "odom 1 2 3": "no CARMEN message",
    " ODOM 1 2 3 0 0 0 1 r 1": "begins with a blank",
    "\x00\x01": "begins with a blank",
}


@pytest.mark.parametrize(("line", "why"), BROKEN.items(), ids=range(len(BROKEN)))
def test_a_broken_line_is_skipped_counted_and_named(tmp_path, line, why):
    good = "".join(ODOM.format(x=k, t=k) for k in range(500))
    log = read(tmp_path, (good + line + "\n" + good).encode("latin1"))
    assert log.notes.broken == 1
    ((number, distances),) = log.notes.broken_lines
    assert number == 501
    assert why in distances
    assert distances.isprintable()
    assert len(distances) <= 100
    assert len(log.odometry.stamps) == 1000


def test_the_first_twenty_broken_lines_are_kept(tmp_path):
    text = "".join(ODOM.format(x=k, t=k) + ("ODOM x\n" if k % 4 == 0 else "") for k in range(200))
    log = read(tmp_path, text, max_broken_share=0.3)
    assert log.notes.broken == 50
    assert [n for n, _ in log.notes.broken_lines] == [5 * k + 2 for k in range(20)]
    with pytest.raises(FormatError, match=r"a\.log:2: 50 of 250 messages are broken \(allowed: 5%\)"):
        read(tmp_path, text)


def test_many_broken_lines_within_the_allowed_share_are_counted_not_refused(tmp_path):
    """Reading stops early only where nearly all lines are broken; 20,500 of 41,000 are many, and half."""
    log = read(tmp_path, (ODOM.format(x=1, t=1) + "ODOM x\n") * 20_500, max_broken_share=0.5)
    assert (log.notes.broken, log.notes.lines, len(log.odometry.stamps)) == (20_500, 41_000, 20_500)
    with pytest.raises(FormatError, match=r"a\.log:2: 20500 of 41000 messages are broken \(allowed: 49%\)"):
        read(tmp_path, (ODOM.format(x=1, t=1) + "ODOM x\n") * 20_500, max_broken_share=0.49)


def test_reading_stops_early_where_nearly_all_lines_are_broken(tmp_path):
    text = odometry(10) + "ODOM x\n" * 200_000
    with pytest.raises(FormatError, match=r"a\.log:11: \d+ of \d+ messages are broken") as refused:
        read(tmp_path, text)
    counted = int(str(refused.value).split()[1])
    assert 20_000 < counted < 100_000


def test_a_last_line_cut_off_in_the_middle_is_no_reason_to_refuse(tmp_path):
    log = read(tmp_path, odometry(3) + "ODOM 3 0 0")
    assert log.notes.broken == 1
    assert len(log.odometry.stamps) == 3


def test_a_tail_of_zero_bytes_is_no_reason_to_refuse(tmp_path):
    log = read(tmp_path, (odometry(200)).encode() + bytes(3_000_000))
    assert len(log.odometry.stamps) == 200
    assert log.notes.broken == 1


@pytest.mark.parametrize(
    ("data", "outputs"),
    [
        (b"", "the file is empty"),
        (bytes(range(256)) * 40, "binary data"),
        (b"\x89PNG\r\n\x1a\n\0\0", "binary data"),
        (b"#ROSBAG V2.0\n\1\2", "bags are read from files"),
        (b"\x89MCAP0\r\n", "bags are read from files"),
        (b"SQLite format 3\0", "bags are read from files"),
        (gzip.compress(b"ODOM 0 0 0 0 0 0 1 r 1\n" * 9999, mtime=0)[:60], "cut off"),
        (gzip.compress(b"", mtime=0), "empty"),
        (b"\x1f\x8b garbage that is no gzip", "damaged|cut off"),
        (gzip.compress(b"ODOM 0 0 0 0 0 0 1 r 1\n" * 9999, mtime=0)[:-6] + b"xxxxxx", "damaged"),
        (b"# only a comment\n", "no odometry in 1 lines"),
        (b"hello world\nhow are you\n", "2 of 2 messages are broken"),
        (b"SYNC a 1 r 1\n", "no odometry"),
    ],
)
def test_files_that_are_no_logs_get_one_clear_line(tmp_path, data, outputs):
    with pytest.raises(FormatError, match=outputs) as caught:
        read(tmp_path, data)
    assert "\n" not in str(caught.value)
    assert "a.log" in str(caught.value)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(FormatError, match="No such file"):
        read_log(tmp_path / "none.log")
    with pytest.raises(FormatError, match="directory"):
        read_log(tmp_path)
    with pytest.raises(FormatError, match="null"):
        read_log("a\0b")


def test_standard_input(monkeypatch):
    class Stdin:
        buffer = io.BytesIO(gzip.compress(odometry().encode()))

    monkeypatch.setattr(sys, "stdin", Stdin)
    log = read_log("-")
    assert len(log.odometry.stamps) == 3
    assert log.notes.source == "stdin"


def test_a_byte_order_mark_is_ignored(tmp_path):
    assert len(read(tmp_path, b"\xef\xbb\xbf" + odometry().encode()).odometry.stamps) == 3


@pytest.mark.parametrize("size", [1, 7, 100, 1000])
def test_blocks_may_end_anywhere(tmp_path, monkeypatch, size):
    log = random_log()
    write_log(tmp_path / "a.log", log)
    broken = (tmp_path / "a.log").read_bytes().replace(b"UWB A-1", b"UWB ", 2)
    (tmp_path / "b.log").write_bytes(broken)
    whole = read_log(tmp_path / "b.log", max_broken_share=0.2)
    monkeypatch.setattr("uwblite.io.source.TextSource.blocks.__defaults__", (size,))
    parts = read_log(tmp_path / "b.log", max_broken_share=0.2)
    assert parts.notes == whole.notes or parts.notes.broken_lines == whole.notes.broken_lines
    assert parts.notes.broken == whole.notes.broken == 2
    assert_same(parts, whole)


def test_memory_is_bounded_whatever_the_file_claims(tmp_path):
    with (tmp_path / "a.log").open("wb") as stream:
        stream.write(odometry(50).encode())
        for _ in range(32):
            stream.write(b"ROBOTLASER1 0 0 1 0.1 8 0 0 3 " + b"1 " * (1 << 20))
        stream.write(b"\n" + b"ROBOTLASER1 0 0 1 0.000001 8 0 0 99999 1 2 3\n")
    tracemalloc.start()
    log = read_log(tmp_path / "a.log")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert log.notes.broken == 2
    assert "longer than a megabyte" in log.notes.broken_lines[0][1]
    assert peak < 40e6


@pytest.mark.parametrize(
    "filling", [b"\n", b"A", *(pytest.param(x, marks=pytest.mark.slow) for x in (b"# c\n", b"ODOM 0 0 0 0 0 0 1.0 h 1\n"))]
)
def test_what_is_packed_to_fill_the_memory_is_refused(tmp_path, filling):
    with gzip.open(tmp_path / "a.log.gz", "wb", compresslevel=1) as stream:
        for _ in range(24):
            stream.write(filling * ((1 << 20) // len(filling)))
    with pytest.raises(FormatError, match="unpacks to more than 100 times"):
        read_log(tmp_path / "a.log.gz")


def test_blank_lines_count_as_lines(tmp_path):
    (tmp_path / "a.log").write_text("\n\n" + odometry(50) + "\nBROKEN!\n\n")
    log = read_log(tmp_path / "a.log")
    assert log.notes.lines == 50 + 5
    assert [number for number, _ in log.notes.broken_lines] == [54]


def test_memory_is_what_the_scans_take(tmp_path):
    scan = robotlaser(["3.210"] * 682)
    (tmp_path / "a.log").write_text(odometry() + scan * 2000)
    tracemalloc.start()
    log = read_log(tmp_path / "a.log")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.3 * log.scans.ranges.nbytes + 12e6


MESSAGES = st.sampled_from(
    [
        ODOM.format(x=1, t=1).strip(),
        robotlaser(READINGS).strip(),
        "UWB a 3.5 100 2 r 2",
        "FLASER 3 1.00 2.00 3.00 0 0 0 0 0 0 1 r 1",
        "RAWLASER1 0 -1 2 1 8 0.01 0 3 1 2 3 0 0.5 robot 1",
        "PARAM laser_flipped on 0 r 0",
    ]
)
JUNK = st.sampled_from(["nan", "-", "1e999", "0x10", "", " ", "\t", "\r", "\x00", "\x85", "é", "1_0", "3", "-1", "9" * 400])


@st.composite
def mangled(draw):
    words = draw(MESSAGES).split(" ")
    for _ in range(draw(st.integers(0, 3))):
        words[draw(st.integers(0, len(words) - 1))] = draw(JUNK)
    return " ".join(words[: draw(st.integers(1, len(words)))] if draw(st.booleans()) else words)


@given(st.lists(mangled(), max_size=12).map("\n".join).map(str.encode) | st.binary(max_size=300), st.booleans())
def test_anything_is_a_log_or_a_format_error(tmp_path_factory, data, packed):
    path = tmp_path_factory.mktemp("log") / "a.log"
    path.write_bytes(gzip.compress(data, mtime=0) if packed else data)
    try:
        log = read_log(path, max_broken_share=0.9)
    except FormatError:
        return
    assert np.isfinite(log.odometry.poses).all()
    if log.scans is not None:
        assert not np.isneginf(log.scans.ranges).any()


RECORDINGS = {
    "kasdorf_2017-11-17-12-31-28": (1130, 1011, 846, 811),
    "mines_exp1": (756, 0, 756, 682),
    "plaza1": (9657, 3529, 0, 0),
    "labyrinth": (233, 233, 0, 0),
    "intel_raw": (2725, 0, 2725, 180),
    "carmen/freiburg-101": (292, 0, 292, 360),
    "carmen/belgioioso": (395, 0, 395, 361),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_public_recordings(shared_data, tmp_path, name):
    log = read_log(shared_data / name / "run.log.gz")
    poses, ranges, scans, beams = RECORDINGS[name]
    assert len(log.odometry.stamps) == poses
    assert (len(log.ranges.stamps) if log.ranges else 0) == ranges
    assert (log.scans.ranges.shape if log.scans else (0, 0)) == (scans, beams)
    assert log.notes.broken == 0
    assert log.notes.skipped == {}
    assert log.notes.warnings == ()
    write_log(tmp_path / "a.log", log)
    back = read_log(tmp_path / "a.log")
    np.testing.assert_allclose(back.odometry.poses, log.odometry.poses, atol=1e-9)
    if log.scans:
        np.testing.assert_array_equal(back.scans.ranges, log.scans.ranges)
        np.testing.assert_allclose(back.mounting.T_base_laser, log.mounting.T_base_laser, atol=1e-9)


def test_what_is_known_of_public_recordings(shared_data):
    kasdorf = read_log(shared_data / "kasdorf_2017-11-17-12-31-28" / "run.log.gz")
    assert kasdorf.mounting.tag_position.tolist() == [0.05, 0, 0.2]
    first = [kasdorf.ranges.ranges[kasdorf.ranges.anchor == a][0] for a in range(3)]
    assert first == [0, 0, 0]
    mines = read_log(shared_data / "mines_exp1" / "run.log.gz")
    assert np.isfinite(mines.scans.ranges).mean() == pytest.approx(0.45, abs=0.01)
    assert mines.scans.time_increment == pytest.approx(0.1 / 1024)


@pytest.mark.parametrize("line", ["ODOM 1e308 0 0 0 0 0 0.15 h 1", "ODOM 0 0 0 0 0 0 1e300 h 1", "UWB A 1e200 100 0.1 h 1"])
def test_a_line_that_nobody_measured_is_broken(tmp_path, line):
    (tmp_path / "a.log").write_text(odometry(60) + line + "\n")
    log = read_log(tmp_path / "a.log")
    assert (log.notes.broken, len(log.odometry.stamps)) == (1, 60)


def test_a_laser_line_that_breaks_off_behind_its_readings_is_broken(tmp_path):
    whole = robotlaser(["1.0", "2.0", "3.0"])
    (tmp_path / "a.log").write_text(odometry(60) + whole + whole[: whole.index("3.0") + 3] + "\n")
    log = read_log(tmp_path / "a.log")
    assert (log.notes.broken, len(log.scans.stamps)) == (1, 1)


@pytest.mark.parametrize("short", ["UWB A 3.0 100 robot 9.5", "GYRO 0.1 0 robot 9.5"])
def test_where_one_kind_of_message_has_ipc_timestamp_another_one_without_it_is_broken(tmp_path, short):
    """However many lines are read at once."""
    lines = [f"ODOM {k} 0 0 0 0 0 {k}.5 robot {k}.5" for k in range(9)]
    (tmp_path / "run.log").write_text("\n".join([*lines, short]) + "\n")
    notes = read_log(tmp_path / "run.log", max_broken_share=0.5).notes
    fields = len(short.split())
    assert notes.broken_lines == ((10, f"{short.split()[0]} has {fields} fields, expected {fields + 1}"),)
