"""What a recording holds survives every format in which recordings are written, field by field."""

from dataclasses import fields, replace

import numpy as np
import pytest

from uwblite.io.carmen import read_log, write_log
from uwblite.io.csv_folder import read_csv_folder, write_csv_folder
from uwblite.io.formats import read_recording
from uwblite.io.rosbag_writer import write_bag
from uwblite.sensor_log import Gyro, LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges

PRECISION = 1e-3
"""m, rad and s in which all of them write; quality is of whole numbers."""


def recording(tags: int) -> SensorLog:
    """Return a recording no field of which has its default, with so many tags."""
    rng = np.random.default_rng(5)
    stamps = 1.6e9 + 0.1 * np.arange(40)
    readings = rng.uniform(0.5, 5.0, (20, 12)).astype(np.float32).round(3)
    readings[1, 2] = np.inf
    more = np.array([[-0.2, 0.1, 0.5]]) if tags > 1 else np.zeros((0, 3))
    mounting = SensorMounting(
        np.array([0.1, -0.05, 0.3]), False, np.array([0.02, 0.03, 0.4]), 2.0, {"5C0B": 1.5, "91A3": 2.5}, more_tags=more
    )
    anchor, tag = np.arange(30) % 2, (np.arange(30) // 3) % tags if tags > 1 else None
    radio = UwbRanges(stamps[:30], anchor, rng.uniform(1, 9, 30).round(3), 70.0 + anchor, ("5C0B", "91A3"), tag=tag)
    scans = LaserScans(stamps[::2], readings, -1.5, 0.25, 2e-3, 0.06, 7.5)
    walk = np.cumsum(rng.uniform(-0.1, 0.1, (40, 3)), axis=0).round(4)
    gyro = Gyro(stamps[2:38], np.linspace(0.5, 1.5, 36).round(4))
    return SensorLog(Odometry(stamps, walk), radio, scans, mounting, gyro=gyro)


def assert_alike(one: object, other: object, name: str) -> None:
    """Compare every field of two records of one kind."""
    assert type(one) is type(other), name
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        where = f"{name}.{field.name}"
        if isinstance(a, np.ndarray | float):
            np.testing.assert_allclose(a, b, atol=PRECISION, err_msg=where)
        else:
            assert a == b, where


def survives(before: SensorLog, after: SensorLog, sensors: tuple[str, ...]) -> None:
    for name in sensors:
        assert_alike(getattr(before, name), getattr(after, name), name)


ALL = ("odometry", "ranges", "scans", "gyro", "mounting")


@pytest.mark.parametrize("tags", [1, 2])
@pytest.mark.parametrize("name", ["run.log", "run.log.gz"])
def test_a_log_keeps_every_field(tmp_path, tags, name):
    before = recording(tags)
    write_log(tmp_path / name, before)
    survives(before, read_log(tmp_path / name), ALL)


def test_a_folder_of_tables_keeps_every_field_of_a_robot_with_one_tag(tmp_path):
    before = recording(1)
    write_csv_folder(tmp_path / "tables", before)
    survives(before, read_csv_folder(tmp_path / "tables"), ALL)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_keeps_every_field_of_odometry_ranges_and_scans(tmp_path, storage):
    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    before = recording(1)
    # Its messages of ranges have no quality.
    before = replace(before, ranges=replace(before.ranges, quality=np.full(30, 100.0)))
    write_bag(tmp_path / "bag", before, storage=storage)
    after = read_recording(str(tmp_path / "bag"))
    survives(before, after, ("odometry", "ranges", "scans"))
    for name in ("T_base_laser", "tag_position", "laser_flipped"):
        np.testing.assert_allclose(getattr(after.mounting, name), getattr(before.mounting, name), atol=PRECISION, err_msg=name)
