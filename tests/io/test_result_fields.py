"""Every column of a result's tables and every field of its report has the value that the result has, and is read back."""

import csv
import hashlib
import json
import re
from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.results import small_log, small_result

from uwblite.findings import doubt, warning
from uwblite.graph.graph import UnknownKey
from uwblite.io.png import decode_png
from uwblite.io.result_text import RunRecord, base_name, settings_line
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result
from uwblite.map_result import CalibrationEstimate
from uwblite.report.drawn_map import drawn_map
from uwblite.report.picture import draw_map
from uwblite.sensor_log import Gyro

RECORD = RunRecord(
    "uwblite map run.log --out map_again", "x = 1\n", {"uwblite": "9.9", "numpy": "1.2"}, {"constraints": "cd" * 32}, "paper",
    ("grid.resolution=0.02",), 12.34567, 2.34567, 123_456_789,
)  # fmt: skip


def full_result():
    """A result of two recordings that has every kind of finding and each state of a calibration value."""
    result = small_result(each=2, seconds=1.23456)
    findings = (
        replace(doubt("untied-parts", "two parts", at=3.5), recording=2, stretches=((1002.0, 1004.5),), cure="drive"),
        replace(warning("few-ranges", "few"), explained_by=("untied-parts",), sensor="radio"),
    )
    delay = CalibrationEstimate(UnknownKey("laser_delay"), 0.0625, 0.004, "s", "clock offset", "estimated", "seen")
    anchors = (replace(result.anchors[0], since=1003.5), result.anchors[1])
    return replace(result, findings=findings, anchors=anchors, calibration=(result.calibration[0], delay))


def full_logs():
    log = small_log()
    broken = {"broken": 2, "broken_lines": ((7, "cut"), (9, "torn")), "skipped": {"SYNC": 4}, "warnings": ("one", "two")}
    notes = replace(log.notes, source="/home/robot/run.log", scans_left_out=5, **broken)
    first = replace(log, notes=notes, gyro=Gyro(log.odometry.stamps, np.zeros(24)))
    return [first, replace(small_log(name="again.log"), ranges=None, scans=None)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder, result, logs = tmp_path_factory.mktemp("fields") / "map", full_result(), full_logs()
    names = write_result(folder, logs, result, RECORD)
    return folder, result, logs, names


def columns(path):
    with open(path, newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {name: [row[name] for row in rows] for name in rows[0]}


def same(texts, values, digits):
    """Compare the texts of a column with values, of which that many decimals are written; empty = not finite."""
    numbers = [float(text) if text else np.nan for text in texts]
    np.testing.assert_allclose(numbers, np.asarray(values, dtype=float), rtol=0, atol=0.51 * 10.0**-digits)


def test_columns_of_anchors(made):
    folder, result, *_ = made
    table, anchors = columns(folder / "anchors.csv"), result.anchors
    assert table.pop("id") == [a.id for a in anchors]
    assert table.pop("status") == [a.status for a in anchors]
    assert table.pop("reason") == [a.reason for a in anchors]
    expected = {
        "x": ([a.position[0] for a in anchors], 6),
        "y": ([a.position[1] for a in anchors], 6),
        "sigma_x": ([a.covariance[0, 0] ** 0.5 for a in anchors], 6),
        "sigma_y": ([a.covariance[1, 1] ** 0.5 for a in anchors], 6),
        "ranges": ([a.ranges for a in anchors], 0),
        "used_share": ([a.used_share for a in anchors], 4),
        "bias": ([a.bias for a in anchors], 4),
        "bias_sigma": ([a.bias_sigma for a in anchors], 4),
        "residual_rms": ([a.residual_rms for a in anchors], 4),
        "covariance_xy": ([a.covariance[0, 1] for a in anchors], 9),
        "alternative_x": ([np.nan, anchors[1].alternative[0]], 6),
        "alternative_y": ([np.nan, anchors[1].alternative[1]], 6),
        "since": ([a.since for a in anchors], 6),
    }
    assert set(table) == set(expected)
    for name, (values, digits) in expected.items():
        same(table[name], values, digits)


def test_columns_of_keyframes(made):
    folder, result, *_ = made
    table, upper = columns(folder / "trajectory_covariance.csv"), result.keyframe_covariances
    same(table.pop("stamp"), result.keyframe_stamps, 6)
    same(table.pop("recording"), result.keyframe_recording + 1, 0)
    trusted = (result.keyframe_recording == 0) | (result.keyframe_stamps < 1002.0) | (result.keyframe_stamps > 1004.5)
    assert table.pop("trusted") == [str(int(sound)) for sound in trusted]
    names = ("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
    for name, i, j in zip(names, *np.triu_indices(3), strict=True):
        np.testing.assert_allclose([float(text) for text in table.pop(name)], upper[:, i, j], rtol=1e-6, atol=1e-12)
    assert not table
    table = columns(folder / "graph_stamps.csv")
    assert table["id"] == [str(k) for k in range(len(result.keyframe_stamps))]
    same(table["stamp"], result.keyframe_stamps, 6)
    same(table["recording"], result.keyframe_recording + 1, 0)


def test_columns_of_range_errors(made):
    folder, result, *_ = made
    table, ranges = columns(folder / "range_errors.csv"), result.range_table
    assert table.pop("anchor") == [result.anchors[int(k)].id for k in ranges["anchor"]]
    same(table.pop("recording"), ranges["recording"] + 1, 0)
    for name, (column, digits) in {
        "stamp": ("stamp", 6), "range": ("range", 4), "error": ("residual", 4), "weight": ("weight", 4), "x": ("x", 4),
        "y": ("y", 4), "theta": ("theta", 5),
    }.items():  # fmt: skip
        same(table.pop(name), ranges[column], digits)
    assert not table


def test_the_report_has_every_field(made):
    folder, result, _, names = made
    report = json.loads((folder / "report.json").read_text())

    def entries(name, rows, of):
        for entry, row in zip(report[name], rows, strict=True):
            assert set(entry) >= set(of)
            for field in of:
                value = getattr(row, field)
                assert entry[field] == (value if isinstance(value, str | None) else near(value)), field

    of_anchors = [field.name for field in fields(result.anchors[0]) if field.name not in ("since", "short")]
    entries("anchors", result.anchors, of_anchors)
    entries("calibration", result.calibration, ("name", "value", "sigma", "unit", "meaning", "state", "reason"))
    of_closures = ("i", "j", "T_i_j", "information", "fitness", "overlap", "accepted", "outcome", "reason")
    entries("closures", result.closures, of_closures)
    for entry, closure in zip(report["closures"], result.closures, strict=True):
        assert [entry["stamp_i"], entry["stamp_j"]] == result.keyframe_stamps[[closure.i, closure.j]].tolist()
    assert report["stages"] == [{"name": s.name, **s.figures, "work": s.work} for s in result.stages]
    assert report["doubts"] == [json.loads(json.dumps(f.record())) for f in result.doubts]
    assert report["warnings"] == [json.loads(json.dumps(f.record())) for f in result.warnings]
    assert report["doubted_stretches"] == [{"recording": 2, "start": 1002.0, "end": 1004.5}]
    grid = result.grid
    assert report["map"] == {
        "resolution": 0.1, "origin": [-5.0, -4.0], "rows": 80, "cols": 100, "scans_used": 24,
        "missing_share": pytest.approx(grid.missing_share, abs=1e-9) if np.isfinite(grid.missing_share) else None,
    }  # fmt: skip
    shape = {"poses": result.shape_poses, "covariances": result.shape_covariances}
    assert report["shape"] == {name: near(value) for name, value in shape.items()}
    step = np.hypot(*np.diff(result.trajectory[:, :2], axis=0).T)
    assert report["recording"] == {
        "duration": 23.0, "travelled": near(step.sum() - step[23]), "odometry": 48, "ranges": 24, "scans": 29,
    }  # fmt: skip
    first, second = report["inputs"]
    assert first == {
        "source": "run.log", "sha256": "ab" * 32, "lines": 72, "broken_lines": 2,
        "first_broken": [{"line": 7, "why": "cut"}, {"line": 9, "why": "torn"}], "skipped": {"SYNC": 4},
        "reader_warnings": ["one", "two"],
    }  # fmt: skip
    assert (second["source"], second["broken_lines"]) == ("again.log", 0)
    assert report["timings"] == {
        "total": 12.346, "reading": 2.346, "stages": [["first optimisation", 1.2346]], "peak_rss_bytes": 123_456_789,
    }  # fmt: skip
    given = {name: report[name] for name in ("schema", "versions", "command", "preset", "changed_settings", "given", "trusted")}
    assert given == {
        "schema": 3, "versions": RECORD.versions, "command": RECORD.command, "preset": "paper",
        "changed_settings": ["grid.resolution=0.02"], "given": RECORD.given, "trusted": False,
    }  # fmt: skip
    assert report["config_sha256"] == hashlib.sha256(b"x = 1\n").hexdigest()
    assert (folder / "config.toml").read_text() == "x = 1\n"
    others = sorted(p for p in folder.iterdir() if p.name != "report.json")
    assert report["files"] == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in others}
    assert sorted(names) == sorted(p.name for p in folder.iterdir())
    assert names[:7] == ["map.png", "report.html", "map.yaml", "map.pgm", "trajectory.tum", "anchors.csv", "report.json"]
    assert names[7:] == sorted(names[7:])


def near(value):
    """Return what lists and numbers of a report are compared with."""
    if isinstance(value, np.ndarray | list | tuple):
        return [near(part) for part in value]
    return pytest.approx(value, rel=1e-8)


def test_page_and_picture_say_what_was_driven_with_which_settings(made):
    folder, result, *_ = made
    page = (folder / "report.html").read_text()
    step = np.hypot(*np.diff(result.trajectory[:, :2], axis=0).T)
    way = step.sum() - step[23]
    assert "<title>run.log, again.log" in page
    assert f"23.0 s, {way:.1f} m, 24 ranges, 29 scans; 10.0 x 8.0 m at 0.1 m; 1 of 3 loop closures" in page
    for fact in ("ab" * 32, "paper with grid.resolution=0.02", "uwblite 9.9, numpy 1.2", RECORD.command):
        assert fact in page
    caption = f"run.log, again.log: {way:.0f} m in 23.0 s, 2 anchors, 1 closures"
    np.testing.assert_array_equal(decode_png((folder / "map.png").read_bytes()), draw_map(drawn_map(result), caption=caption))
    assert re.search(r"data:image/png;base64,", page)


def test_settings_and_names_in_a_line():
    assert settings_line("", ()) == "defaults"
    assert settings_line("paper", ("a=1", "b=2")) == "paper with a=1, b=2"
    assert [base_name(path) for path in ("a/b.log", "b.log", "a/tables/", "/")] == ["b.log", "b.log", "tables", "/"]


def test_what_is_written_is_read_back_field_by_field(made):
    folder, result, *_ = made
    stored = read_result(folder)
    assert stored.laser_delay == 0.0625
    for one, a in zip(stored.anchors, result.anchors, strict=True):
        assert (one.id, one.status) == (a.id, a.status)
        assert [one.bias, one.residual_rms] == pytest.approx([a.bias, a.residual_rms], abs=5e-5)
        np.testing.assert_allclose(one.covariance, a.covariance, atol=1e-8)
    table = result.range_table
    assert stored.ranges.anchors == tuple(result.anchors[int(k)].id for k in table["anchor"])
    np.testing.assert_allclose(stored.ranges.errors, table["residual"], atol=5.1e-5)
    np.testing.assert_allclose(stored.ranges.tags, np.column_stack([table["x"], table["y"]]), atol=5.1e-5)
    np.testing.assert_allclose(stored.ranges.headings, table["theta"], atol=5.1e-6)
    for one, closure in zip(stored.closures, result.closures, strict=True):
        ends = [closure.i, closure.j]
        assert one.stamps == tuple(result.keyframe_stamps[ends])
        assert one.recordings == tuple(result.keyframe_recording[ends] + 1)
        assert (one.accepted, one.reason) == (closure.accepted, closure.reason)
        np.testing.assert_allclose(one.pose, closure.T_i_j)
    assert stored.report["schema"] == 3
    np.testing.assert_allclose(stored.pose_at(2, result.stamps[30:31]), result.trajectory[30:31], atol=1e-5)


def test_the_trail_after_the_trajectory_goes_on_from_its_end(made):
    stored = read_result(made[0])
    known, poses = stored.trajectories[-1]
    stamps = known[-1] - 1.0 + 0.1 * np.arange(101)
    wheels = np.column_stack([0.2 * np.arange(101), np.zeros(101), np.zeros(101)])
    trail = stored.trail(stamps, wheels, 10)
    np.testing.assert_allclose(trail[0], poses[-1])
    assert 10 <= len(trail) <= 13
    np.testing.assert_allclose(np.hypot(*(trail[-1] - trail[0])[:2]), 0.2 * 90, atol=1e-6)
    np.testing.assert_allclose(trail[:, 2], poses[-1, 2])
    for early in (stamps - 100.0, stamps + 100.0):
        np.testing.assert_allclose(stored.trail(early, wheels, 10), poses[-1:])
