"""Advice that names a command is carried out on the fault that provokes it, and the recording is better afterwards."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite.assessment.recording import diagnose
from uwblite.cli import main
from uwblite.cli.options import name_options
from uwblite.errors import DataError
from uwblite.io.carmen import write_log
from uwblite.io.formats import read_recording
from uwblite.screening.screen import screen


@pytest.fixture(scope="module")
def sound():
    poses = two_rounds()
    return recording(poses[: len(poses) // 2])


def lengths(log, sensor, unit):
    """Return the recording with one sensor's lengths written in another unit, m."""
    if sensor == "odometry":
        return replace(log, odometry=replace(log.odometry, poses=log.odometry.poses / (unit, unit, 1.0)))
    if sensor == "ranges":
        return replace(log, ranges=replace(log.ranges, ranges=log.ranges.ranges / unit))
    s = log.scans
    scaled = {name: getattr(s, name) / unit for name in ("range_min", "range_max")}
    return replace(log, scans=replace(s, ranges=(s.ranges / unit).astype(np.float32), **scaled))


FAULTS = {
    "wheels in millimetres": lambda log: lengths(log, "odometry", 0.001),
    "wheels in centimetres": lambda log: lengths(log, "odometry", 0.01),
    "ranges in millimetres": lambda log: lengths(log, "ranges", 0.001),
    "ranges in centimetres": lambda log: lengths(log, "ranges", 0.01),
    "ranges in feet": lambda log: lengths(log, "ranges", 0.3048),
    "scans in millimetres": lambda log: lengths(log, "scans", 0.001),
    "scans in centimetres": lambda log: lengths(log, "scans", 0.01),
    "stamps in milliseconds": lambda log: log.with_time_unit(1e3),
    "stamps in microseconds": lambda log: log.with_time_unit(1e6),
    "headings in degrees": lambda log: replace(
        log, odometry=replace(log.odometry, poses=log.odometry.poses * (1.0, 1.0, 180.0 / np.pi))
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_unit_that_is_named_is_the_one_that_mends_the_recording(tmp_path, sound, fault):
    """The command of the message, word for word, gives back the recording that was spoiled."""
    spoiled = FAULTS[fault](sound)
    if fault == "ranges in feet":
        spoiled = spoiled.without(lidar=True)
    with pytest.raises(DataError) as refused:
        screen(spoiled)
    command = re.search(r"uwblite convert (--[a-z]+-unit)=(\S+?)`", name_options(str(refused.value)))
    assert command, str(refused.value)
    write_log(tmp_path / "spoiled.log", spoiled)
    assert main(["convert", str(tmp_path / "spoiled.log"), str(tmp_path / "mended.log"), *command.groups(), "-q"]) == 0
    mended = read_recording(str(tmp_path / "mended.log"))
    np.testing.assert_allclose(np.ptp(mended.odometry.stamps), np.ptp(sound.odometry.stamps), rtol=1e-3)
    np.testing.assert_allclose(mended.odometry.travelled[-1], sound.odometry.travelled[-1], rtol=0.02)
    np.testing.assert_allclose(np.median(mended.ranges.ranges), np.median(sound.ranges.ranges), rtol=1e-2)
    if mended.scans is not None:
        seen = [s.ranges[np.isfinite(s.ranges)] for s in (mended.scans, sound.scans)]
        np.testing.assert_allclose(*map(np.median, seen), rtol=1e-2)
    assert not [f for f in diagnose(mended).doubts if "look like" in f.text]


def test_figures_are_printed_as_a_person_reads_them(tmp_path, sound, capsys):
    """Stamps that are no times (8.5e-72 s apart) give no rate of forty digits."""
    t = np.arange(400) * 0.1
    lines = [f"ODOM {0.03 * k} 0 0 0 0 0 {t[k]:.1f} h 0" for k in range(400)]
    lines[10:10] = [f"ODOM {0.3 + 1e-9 * k} 0 0 0 0 0 {k}e-72 h 0" for k in range(1, 4)]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    main(["check", str(tmp_path / "x.log")])
    out = capsys.readouterr().out
    assert "(10.0 Hz)" in out
    assert not re.search(r"\d{9,}", out.replace(str(tmp_path), ""))
    assert "only a map tells: scales" in out
