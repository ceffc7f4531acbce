"""CSV folders: round trips and clear errors."""

import contextlib
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.errors import ConfigError, FormatError, UwbliteError
from uwblite.io.carmen import read_log, write_log
from uwblite.io.csv_folder import read_csv_folder, write_csv_folder
from uwblite.sensor_log import Gyro, LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges


def recording():
    rng = np.random.default_rng(5)
    stamps = 1.6e9 + 0.1 * np.arange(30)
    readings = rng.uniform(0.5, 5.0, (10, 8)).astype(np.float32).round(4)
    readings[1, 2], readings[2, 3] = np.inf, np.nan
    mounting = SensorMounting(np.array([0.1, -0.05, 0.3]), True, np.array([0.02, 0.03, 0.4]), 2.0, {'a,"b': 1.5})
    return SensorLog(
        Odometry(stamps, rng.uniform(-3, 3, (30, 3)).round(6)),
        UwbRanges(stamps[:20], np.arange(20) % 2, rng.uniform(1, 9, 20).round(4), np.full(20, 87.0), ("5C0B", 'a,"b')),
        LaserScans(stamps[::3], readings, -1.5, 0.1, 1e-4, 0.02, 5.6),
        mounting,
        gyro=Gyro(stamps[5:] + 0.02, np.linspace(3.0, 9.0, 25)),
    )


def test_a_recording_survives_a_folder(tmp_path):
    write_csv_folder(tmp_path / "t", recording())
    read, log = read_csv_folder(tmp_path / "t"), recording()
    np.testing.assert_allclose(read.odometry.stamps, log.odometry.stamps, atol=1e-6)
    np.testing.assert_array_equal(read.odometry.poses, log.odometry.poses)
    assert read.ranges.anchor_ids == log.ranges.anchor_ids
    for name in ("anchor", "ranges", "quality"):
        np.testing.assert_array_equal(getattr(read.ranges, name), getattr(log.ranges, name))
    np.testing.assert_array_equal(read.scans.ranges, log.scans.ranges)
    for name in ("angle_min", "angle_increment", "time_increment", "range_min", "range_max"):
        assert getattr(read.scans, name) == getattr(log.scans, name), name
    assert read.mounting.laser_flipped is True
    assert read.mounting.anchor_heights == {'a,"b': 1.5}
    np.testing.assert_array_equal(read.mounting.T_base_laser, log.mounting.T_base_laser)
    np.testing.assert_allclose(read.gyro.heading, log.gyro.heading, atol=1e-6)
    np.testing.assert_allclose(read.gyro.stamps, log.gyro.stamps, atol=1e-6)
    with pytest.raises(ConfigError, match="`force`"):
        write_csv_folder(tmp_path / "t", log)
    write_csv_folder(tmp_path / "t", log, force=True)
    (tmp_path / "t" / "sensors.toml").write_text("[scans]\n# of my own\n")
    with pytest.raises(ConfigError, match="was not written by uwblite"):
        write_csv_folder(tmp_path / "t", log, force=True)
    assert "of my own" in (tmp_path / "t" / "sensors.toml").read_text()


def test_odometry_alone_is_enough_and_order_does_not_matter(tmp_path):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n2,1,0,0\n\n1,0,0,0\n")
    log = read_csv_folder(tmp_path)
    assert log.odometry.stamps.tolist() == [1, 2]
    assert log.ranges is None
    assert log.scans is None


def test_a_sensor_with_a_header_alone_was_not_there(tmp_path):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / "gyro.csv").write_text("stamp,heading\n")
    (tmp_path / "ranges.csv").write_text("stamp,anchor,range\n")
    log = read_csv_folder(tmp_path)
    assert log.gyro is None
    assert log.ranges is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("odometry.csv", "stamp,x,y,theta\n1,2,3\n", r"odometry\.csv:2: 3 columns, expected 4"),
        ("odometry.csv", "stamp,theta,x\n1,2,3\n", r"odometry\.csv:1: 3 columns, expected stamp,x,y,theta"),
        ("odometry.csv", "stamp,yaw,x,y\n1,2,3,4\n", r"odometry\.csv:1: 4 columns, expected stamp,x,y,theta"),
        ("odometry.csv", "stamp;x;y;theta\n1;2;3;4\n", r"odometry\.csv:1: 1 columns, expected stamp,x,y,theta"),
        ("odometry.csv", "stamp,x,y,theta\n1,2,3,nan\n", r"odometry\.csv:2: 'nan' is not a finite number"),
        ("odometry.csv", "stamp,x,y,theta\n", r"odometry\.csv: there are no rows"),
        ("odometry.csv", "", "empty"),
        ("odometry.csv", "stamp\n\0\n", "binary"),
        ("ranges.csv", "stamp,anchor,range,quality\n1,A,x,1\n", r"ranges\.csv:2: 'x'"),
        ("scans.csv", "stamp,r0,r1\n1,2,3\n1,2\n", r"scans\.csv:3: 1 beams, the first scan has 2"),
        ("scans.csv", "stamp,r0\n1,two\n", r"scans\.csv:2: a reading is not a number"),
        ("scans.csv", "stamp\n1\n2\n", r"scans\.csv:2: a stamp without readings"),
        ("scans.csv", "stamp,r0\n1,2\n", r"scans\.csv: scans need their geometry"),
        ("sensors.toml", "[scans]\nangle_mn = 1\n", "did you mean 'scans.angle_min'"),
    ],
)
def test_wrong_files_are_named(tmp_path, name, text, message):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / name).write_text(text)
    with pytest.raises(UwbliteError, match=message):
        read_csv_folder(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "stamp,x,y,theta\n1,2,3,4\n5,6,7,8\n", "theta,stamp,y,x\n4,1,3,2\n8,5,7,6\n", "1,2,3,4\n5,6,7,8\n",
        "\ufeff1,2,3,4\n5,6,7,8\n", "Stamp, X, Y, speed, Theta\r\n1, 2, 3, 99, 4\r\n5, 6, 7, 99, 8\r\n",
        "t,x,y,yaw\n1,2,3,4\n5,6,7,8\n",
    ],
)  # fmt: skip
def test_columns_are_found_by_their_names_or_their_order(tmp_path, text):
    """Sorted by another program, with more columns, with a byte order mark, without a header: no row is lost or misread."""
    (tmp_path / "odometry.csv").write_text(text)
    odometry = read_csv_folder(tmp_path).odometry
    assert np.column_stack([odometry.stamps, odometry.poses]).tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]


@pytest.mark.parametrize("text", ["stamp,anchor,range\n1,A,2\n2,7,3\n", "1,A,2\n2,7,3\n", "range,anchor,stamp\n2,A,1\n3,7,2\n"])
def test_the_quality_of_ranges_may_be_missing(tmp_path, text):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / "ranges.csv").write_text(text)
    ranges = read_csv_folder(tmp_path).ranges
    assert [ranges.anchor_ids[k] for k in ranges.anchor] == ["A", "7"]
    assert (ranges.stamps.tolist(), ranges.ranges.tolist(), ranges.quality.tolist()) == ([1, 2], [2, 3], [100, 100])


def test_scans_without_a_header_lose_none(tmp_path):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / "sensors.toml").write_text("\ufeff[scans]\nangle_min = -0.1\nangle_increment = 0.1\n", encoding="utf-8")
    (tmp_path / "scans.csv").write_text("1,2,,nan\n2,2,3,4\n")
    scans = read_csv_folder(tmp_path).scans
    assert scans.stamps.tolist() == [1, 2]
    assert scans.ranges[0, :2].tolist() == [2, np.inf]


def test_a_folder_without_odometry_is_no_recording(tmp_path):
    with pytest.raises(FormatError, match=r"odometry\.csv"):
        read_csv_folder(tmp_path)


@given(st.binary(max_size=300), st.sampled_from(["odometry.csv", "ranges.csv", "scans.csv", "sensors.toml"]))
def test_any_bytes_do_no_worse_than_an_error(tmp_path_factory, data, name):
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (folder / name).write_bytes(data)
    with contextlib.suppress(UwbliteError):
        read_csv_folder(folder)


@pytest.mark.parametrize("name", ['"B 1 1 h 1\nODOM 9 9 9"', "=1+2", "\x1b[2J", "x" * 65, '""'])
def test_an_id_that_would_tear_a_log_apart_is_refused(tmp_path, name):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / "ranges.csv").write_text(f"stamp,anchor,range,quality\n1,A,2,90\n2,{name},2,90\n")
    with pytest.raises(FormatError, match=r"ranges\.csv:[34]: the anchor's id ") as caught:
        read_csv_folder(tmp_path)
    assert str(caught.value).isprintable()


def test_blanks_in_ids_become_underscores(tmp_path):
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n1,0,0,0\n")
    (tmp_path / "ranges.csv").write_text("stamp,anchor,range,quality\n1,hall west,2,90\n2,B,3,90\n3, hall  west,4,90\n")
    ranges = read_csv_folder(tmp_path).ranges
    assert ranges.anchor_ids == ("B", "hall_west")
    assert ranges.anchor.tolist() == [1, 0, 1]


@pytest.mark.slow
def test_tables_of_millions_of_rows_take_little_more_memory_than_their_numbers(tmp_path):
    rows = 60_000
    (tmp_path / "odometry.csv").write_text("stamp,x,y,theta\n" + "1,0,0,0\n" * rows)
    (tmp_path / "scans.csv").write_text("stamp,r0\n" + "1,2\n" * rows)
    (tmp_path / "sensors.toml").write_text("[scans]\nangle_increment = 0.1\n")
    tracemalloc.start()
    read_csv_folder(tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 5 * 8 * 4 * rows + 1.2e6
    tracemalloc.stop()


@pytest.mark.parametrize("most", ["inf", "nan", "0.0"])
def test_a_reach_that_is_not_stated_is_the_largest_reading(tmp_path, most):
    """And what is written of it is read again."""
    write_csv_folder(tmp_path / "t", recording())
    file = tmp_path / "t" / "sensors.toml"
    file.write_text(re.sub("range_max = .*", f"range_max = {most}", file.read_text()))
    log = read_csv_folder(tmp_path / "t")
    assert log.scans.range_max == pytest.approx(float(np.nanmax(log.scans.ranges[np.isfinite(log.scans.ranges)])) + 0.01)
    assert sum("the scans state no reach" in w for w in log.notes.warnings) == 1
    write_log(tmp_path / "x.log", replace(log, ranges=None))
    again = read_log(tmp_path / "x.log")
    assert again.notes.broken == 0
    np.testing.assert_allclose(again.scans.ranges, log.scans.ranges, atol=6e-4)


def test_a_stamp_of_zero_among_others_was_never_set(tmp_path):
    """In every table it takes the place of its row."""
    write_csv_folder(tmp_path / "t", recording())
    for name in ("odometry.csv", "ranges.csv", "scans.csv", "gyro.csv"):
        rows = (tmp_path / "t" / name).read_text().splitlines()
        rows[4] = "0.000000," + rows[4].split(",", 1)[1]
        (tmp_path / "t" / name).write_text("\n".join(rows) + "\n")
    read, log = read_csv_folder(tmp_path / "t"), recording()
    for sensor in ("odometry", "ranges", "scans", "gyro"):
        np.testing.assert_allclose(getattr(read, sensor).stamps, getattr(log, sensor).stamps, atol=1e-3)
    np.testing.assert_array_equal(read.odometry.poses, log.odometry.poses)
    assert read.notes.warnings[0].startswith("1 of 30 odometry messages have a stamp that no clock gives (the first is 0 s in")
    assert len(read.notes.warnings) == 4
