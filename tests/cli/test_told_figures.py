"""What a command says in words is what it says as JSON and what is in the files: every number, name, path and exit code."""

import argparse
import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import loop
from helpers.results import small_folder, small_log, small_result

from uwblite.cli import check, main, memory
from uwblite.cli import map as map_verb
from uwblite.cli.making import Made
from uwblite.findings import doubt, warning
from uwblite.io.carmen import read_log, write_log
from uwblite.io.formats import write_graph
from uwblite.io.graph_file import GraphFile
from uwblite.report.printable import anchor_line, calibration_text, signed


def figures_of(capsys, *words, code=0):
    """Return the text and the JSON of a command that is run twice."""
    assert main([*words]) == code
    text = capsys.readouterr().out
    assert main([*words, "--json"]) == code
    return text, json.loads(capsys.readouterr().out)


def made(**changes):
    return Made([small_log()], replace(small_result(), **changes), ["map.png", "report.html"], 0.125)


ARGS = argparse.Namespace(out="maps/my map")


def test_a_map_is_summed_up_in_words():
    result = small_result()
    scale, delay = result.calibration
    findings = (
        warning("odometry-gap", "a gap"),
        replace(doubt("untied-parts", "two parts"), cure="drive more", stretches=((1001.0, 1004.0),), recording=1),
        replace(warning("few-ranges", "few ranges"), explained_by=("untied-parts",)),
    )
    lines = map_verb.summary_lines(ARGS, made(findings=findings, calibration=(scale, replace(delay, state="estimated"))))
    assert lines == [
        "mapped 11.5 s of driving in 0.1 s (92 times real time): 10.0 x 8.0 m at 0.1 m, 24 keyframes, 1 of 3 loop closures",
        *map(anchor_line, result.anchors),
        calibration_text("odometry_scale", -0.012, 0.002, "1", "error of travelled distance"),
        "warning: a gap",
        "DOUBT: two parts",
        "  drive more",
        "  explains warning: few ranges",
        "the rest of the map is as good as it states; map.png marks the stretches that are not",
        "files: maps/my map/map.png maps/my map/report.html",
        "next: open 'maps/my map/report.html' in a browser, or: uwblite view 'maps/my map'",
    ]
    sound = map_verb.summary_lines(ARGS, made(findings=(), grid=None))
    assert sound[0] == "mapped 11.5 s of driving in 0.1 s (92 times real time)"
    assert not [line for line in sound if "DOUBT" in line or "rest of the map" in line]


def test_a_map_is_summed_up_for_programs():
    result = small_result()
    summary = map_verb.summary_json(ARGS, made())
    peak = summary.pop("peak_rss_bytes")
    assert peak > 10_000_000
    assert summary == {
        "out": "maps/my map",
        "files": ["maps/my map/map.png", "maps/my map/report.html"],
        "trusted": True,
        "doubts": [],
        "warnings": [result.findings[0].record()],
        "anchors": {
            "5C0B": {"x": 4.0, "y": 3.0, "bias": 0.46, "ranges": 24, "status": "ok"},
            "91A3": {"x": -4.0, "y": -3.0, "bias": 0.1, "ranges": 24, "status": "mirror-ambiguous"},
        },
        "closures": {"accepted": 1, "candidates": 3},
        "calibration": {"odometry_scale": -0.012},
        "seconds": 0.125,
        "exit_code": 0,
    }
    doubted = map_verb.summary_json(ARGS, made(findings=(doubt("few-closures", "few"),)))
    assert (doubted["trusted"], doubted["exit_code"], doubted["doubts"][0]["kind"]) == (False, 3, "few-closures")


def test_laser_messages_without_a_pose_are_counted_beside_the_corrected_log(tmp_path, capsys):
    log = small_log()
    write_log(tmp_path / "run.log", log)
    with open(tmp_path / "run.log", "a") as file:
        file.write("FLASER 3 1.0\nFLASER 1 2.0 0 0 0 0 0 0 2000.0 r 2000.0\n")
    args = argparse.Namespace(corrected_log=str(tmp_path / "out.log"), logs=[str(tmp_path / "run.log")])
    map_verb._write_corrected_log(args, made())
    assert capsys.readouterr().err == (
        f"uwblite: {tmp_path / 'out.log'} has 24 scans; 2 laser messages are broken or outside the trajectory's time and were"
        " left out\n"
    )


@pytest.fixture
def graph(tmp_path):
    graph = loop(3, n=60, anchors=3)[0]
    steps, closures, ranges = graph.edges
    closures = replace(closures, T_i_j=closures.T_i_j + np.array([0.05, 0.0, 0.0]))
    names = tuple(f"A{k}" for k in range(60)), tuple(f"L{k}" for k in range(3))
    file = GraphFile(replace(graph, edges=(steps, closures, ranges)), *names, np.arange(60.0))
    write_graph(str(tmp_path / "graph.pyfg"), file)
    return str(tmp_path / "graph.pyfg")


def test_an_optimised_graph_is_told_in_figures(graph, tmp_path, capsys):
    out, path = tmp_path / "out.g2o", tmp_path / "path.tum"
    text, figures = figures_of(capsys, "optimize", graph, "--out", str(out), "--trajectory", str(path), "--force")
    lines = text.splitlines()
    edges = ", ".join(f"{count} {name}" for name, count in figures["edges"].items())
    assert lines[0] == f"60 poses, 3 anchors, {edges}"
    assert lines[1] == (
        f"chi2 {figures['chi2_initial']:.6g} -> {figures['chi2']:.9g} ({figures['chi2_per_dof']:.3f} per degree of freedom)"
        f" in {figures['iterations']} iterations: {figures['reason']}"
    )
    assert figures["chi2_initial"] > figures["chi2"] > 0.0
    assert figures["chi2_per_dof"] == pytest.approx(figures["chi2"] / figures["dof"])
    assert (figures["poses"], figures["anchors"], figures["chains"], figures["exit_code"]) == (60, 3, 1, 0)
    assert lines[-1] == f"files: {out} {path}"
    assert main(["optimize", graph]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "nothing written; --out and --trajectory name files"


def test_settings_of_the_solver_and_the_kernel_reach_it(graph, capsys):
    def chi2(*words, code=0):
        assert main(["optimize", graph, "--json", *words]) == code
        return json.loads(capsys.readouterr().out)

    plain, wide, narrow = chi2(), chi2("--kernel", "huber", "--kernel-scale", "0.5"), chi2("--kernel", "huber")
    assert chi2("--kernel", "huber", "--kernel-scale", "2")["chi2"] == narrow["chi2"]
    assert plain["chi2"] > narrow["chi2"] > wide["chi2"]
    assert chi2("--set", "max_iterations=1", code=3)["iterations"] == 1
    assert chi2("--set", "max_iterations=1", code=3)["exit_code"] == 3


def test_further_anchors_are_told_in_figures_and_in_the_table(tmp_path, capsys):
    small_folder(tmp_path / "map")
    out = tmp_path / "plan"
    words = ["plan-anchors", "--map", str(tmp_path / "map"), "--out", str(out), "--reach", "5", "--force"]
    text, figures = figures_of(capsys, *words)
    assert figures["files"] == [f"{out}.csv", f"{out}.png"]
    assert (figures["map"], figures["reach"], figures["today"]["anchors"]) == (str(tmp_path / "map"), 5.0, 2)
    about = "expected error of a position {mean_error:.2f} m, in 95 % of the free space below {error_95:.2f} m"
    lines = [f"2 anchors today: {about.format(**figures['today'])}"]
    for each in figures["anchors"]:
        lines.append(f"{each['id']}: x {signed(each['x'])} m, y {signed(each['y'])} m: {about.format(**each)}")
    assert text.splitlines() == [*lines, f"files: {out}.csv {out}.png"]
    (row,) = csv.DictReader((tmp_path / "plan.csv").read_text().splitlines())
    (planned,) = figures["anchors"]
    assert row.pop("id") == planned.pop("id") == "new1"
    assert {name: float(value) for name, value in row.items()} == pytest.approx(planned, abs=5.1e-4)
    assert planned["mean_error"] < figures["today"]["mean_error"]
    assert planned["error_95"] >= planned["mean_error"]


def test_a_recording_is_summed_up_in_figures(short_log, capsys):
    text, summary = figures_of(capsys, "check", str(short_log))
    figures, cost = summary["figures"], summary["expected cost of map"]
    odometry, uwb, lidar = figures["odometry"], figures["uwb"], figures["lidar"]
    assert text.splitlines()[0] == (
        f"{short_log}: {odometry['duration s']:.1f} s, {odometry['path m']:.1f} m by {odometry['count']} odometry readings"
        f" ({odometry['rate Hz']:.1f} Hz), {uwb['count']} ranges to 4 anchors, {lidar['count']} scans of {lidar['beams']} beams"
        f" over {lidar['field of view deg']:.0f} deg ({lidar['rate Hz']:.1f} Hz, {100 * lidar['share of beams that hit']:.0f} %"
        " hit)"
    )
    for name, a in uwb["anchors"].items():
        assert (
            f"\nanchor {name}: {a['count']} ranges ({a['rate Hz']:.2f} Hz) of {a['nearest m']:.2f} to {a['farthest m']:.2f} m,"
            f" noise {a['noise m']:.3f} m, {a['zeros']} zero, {a['absurd']} absurd, {a['spikes']} spikes" in text
        )
    reached = ", ".join(f"{name} {100 * share:.0f} %" for name, share in uwb["coverage"].items())
    assert f"\nanchors in reach: {reached}\n" in text
    assert (
        f"\nexpected cost: about {cost['seconds']:.0f} s, {cost['megabytes']:.0f} MB, a map of {cost['map width m']:.0f} x"
        f" {cost['map height m']:.0f} m\n" in text
    )
    assert "\nonly a map tells: " in text
    assert text.endswith(f"\nnext: uwblite map {short_log} --out map/\n")
    log = read_log(short_log)
    assert (odometry["count"], uwb["count"], lidar["count"]) == tuple(
        len(sensor.stamps) for sensor in (log.odometry, log.ranges, log.scans)
    )


def test_findings_of_a_check_stand_under_their_cause_with_their_cure():
    diagnosis = argparse.Namespace(
        figures={"odometry": {"duration s": 1.0, "path m": 2.0, "count": 3, "rate Hz": 4.0}, "uwb": {"count": 5, "anchors": {
            "A": {"count": 5}}}, "radio calibration": {"bias guess m": {"A": {"bias": 0.5, "sigma": 0.25}}}},
        findings=(
            replace(doubt("clock", "its clock stands"), cure="set it", sensor="radio"),
            replace(warning("few", "few ranges"), explained_by=("clock",)),
            doubt("other", "another"),
        ),
        doubts=(1, 2),
    )  # fmt: skip
    assert check.report_lines("x.log", diagnosis, {}, mapped=True) == [
        "x.log: 1.0 s, 2.0 m by 3 odometry readings (4.0 Hz), 5 ranges to 1 anchor",
        "",
        "DOUBT    radio: its clock stands",
        "         -> set it",
        "         explains warning: few ranges",
        "DOUBT    another",
        "",
        "anchor A: 5 ranges, bias guess +0.50 ±0.25 m",
        "fix the 2 doubts first",
    ]
    assert check.report_lines("x.log", diagnosis, {}, mapped=False)[-2].startswith("only a map tells")
    diagnosis.doubts = (1,)
    assert check.report_lines("x.log", diagnosis, {}, mapped=True)[-1] == "fix the 1 doubt first"
    assert check.summary_json("x.log", diagnosis, {"seconds": 1.0})["exit_code"] == 3


def test_the_cost_of_several_maps_is_told_for_each_and_all(short_log, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(memory, "limits", lambda: [])
    other = tmp_path / "other.log"
    write_log(other, read_log(short_log).crop(0.0, 9.0))
    text, summary = figures_of(capsys, "map", str(short_log), str(other), "--dry-run")
    costs = {row["log"]: row["expected cost of map"] for row in summary["recordings"]}
    costs["all together"] = summary["expected cost of map"]
    assert list(costs) == [str(short_log), str(other), "all together"]
    assert text.splitlines() == [
        f"{name}: about {cost['seconds']:.0f} s of a desktop computer, {cost['megabytes']:.0f} MB"
        + (f", a map of {cost['map width m']:.0f} x {cost['map height m']:.0f} m" if "map cells" in cost else "")
        for name, cost in costs.items()
    ]
    assert ["map cells" in cost for cost in costs.values()] == [True, True, False]
    assert summary["exit_code"] == 0
    one, two, both = (costs[name]["seconds"] for name in costs)
    assert both > one > two


def test_the_headings_of_a_gyro_are_counted_and_their_unit_is_an_angle_s(tmp_path, capsys):
    lines = [f"ODOM {0.1 * k} 0 {0.1 * k} 0 0 0 {k}.0 r {k}.0\nGYRO {0.1 * k} 0 {k}.5 r {k}.5" for k in range(5)]
    (tmp_path / "run.log").write_text("\n".join(["# CARMEN Logfile", *lines]) + "\n")
    words = ["convert", str(tmp_path / "run.log"), str(tmp_path / "out.log"), "--angle-unit", "0.5", "--force"]
    text, summary = figures_of(capsys, *words)
    counts = {"odometry readings": 5, "ranges": 0, "scans": 0, "headings of the gyro": 5}
    assert summary["counts"] == counts
    assert (summary["out"], summary["note"], summary["exit_code"]) == (str(tmp_path / "out.log"), "", 0)
    assert text == (
        f"{tmp_path / 'out.log'}: {', '.join(f'{count} {name}' for name, count in counts.items())}\n"
        f"next: uwblite check {tmp_path / 'out.log'}\n"
    )
    before, after = read_log(tmp_path / "run.log"), read_log(tmp_path / "out.log")
    np.testing.assert_allclose(after.odometry.poses, before.odometry.poses * [1.0, 1.0, 0.5], atol=1e-6)


def test_topics_of_a_bag_are_listed_with_what_becomes_of_them(tmp_path, capsys):
    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    write_log(tmp_path / "run.log", small_log())
    assert main(["convert", str(tmp_path / "run.log"), str(tmp_path / "run.mcap"), "-q"]) == 0
    capsys.readouterr()
    text, summary = figures_of(capsys, "convert", str(tmp_path / "run.mcap"), "--list")
    rows = {row["topic"]: row for row in summary["topics"]}
    assert {row["role"] for row in rows.values()} >= {"odometry", "scans", "ranges"}
    assert (summary["unread"], summary["exit_code"]) == ([], 0)
    listed = [re.fullmatch(r" *(\d+)  (\S+) +(\S+)(?:  <- (.+))?", line).groups() for line in text.splitlines()]
    assert listed == [(str(row["messages"]), row["topic"], row["type"], row["role"]) for row in summary["topics"]]
    assert len({len(line.rpartition(row["type"])[0]) for line, row in zip(text.splitlines(), rows.values(), strict=True)}) == 1
