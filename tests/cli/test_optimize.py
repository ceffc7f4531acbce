"""`uwblite optimize` on hard graphs: odometry that bends too far, false loop closures and ranges."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.planted_graphs import at_random, lawn, loop

from uwblite import se2
from uwblite.cli import main
from uwblite.graph.graph import PriorEdges
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.point_edges import LandmarkEdges
from uwblite.graph.solver import SolverConfig, optimize
from uwblite.io.formats import write_graph
from uwblite.io.g2o import read_g2o
from uwblite.io.graph_file import GraphFile


def written(path, graph):
    """Write a graph of poses A0, A1 ... and anchors L0, L1 ... to a file."""
    poses = tuple(f"A{k}" for k in range(len(graph.poses)))
    anchors = tuple(f"L{k}" for k in range(len(graph.anchors)))
    write_graph(str(path), GraphFile(graph, poses, anchors, np.arange(len(poses), dtype=float)))
    return str(path)


def figures(capsys, *words, code=0):
    assert main(["optimize", *words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_incremental_reaches_the_minimum_that_all_at_once_misses(tmp_path, capsys):
    graph = lawn(0)[0]
    path = written(tmp_path / "bent.pyfg", graph)
    found = figures(capsys, path, "--incremental", "--trajectory", str(tmp_path / "t.tum"))
    # dof is about 4,500: chi2 over dof scatters by 0.02.
    assert found["chi2_per_dof"] == pytest.approx(1.0, abs=0.1)
    assert main(["optimize", path, "--from-odometry", "--json"]) in (0, 3)
    assert json.loads(capsys.readouterr().out)["chi2_per_dof"] > 2.0


def test_headings_from_anywhere_end_in_the_minimum_from_the_truth(tmp_path, capsys):
    graph = loop(3, n=400, anchors=0)[0]
    rng = np.random.default_rng(3)
    poses = graph.poses + rng.normal(scale=[3.0, 3.0, 1.5], size=graph.poses.shape) * (np.arange(400) > 0)[:, None]
    bent = replace(graph, poses=poses, edges=graph.edges[:2])
    best = optimize(replace(graph, edges=graph.edges[:2]))[1].chi2
    assert optimize(bent)[1].chi2 > 2.0 * best
    assert figures(capsys, written(tmp_path / "bent.g2o", bent))["chi2"] == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("seed", [4, 12])
def test_anchors_that_start_far_away_end_in_the_minimum_from_the_truth(tmp_path, capsys, seed):
    graph, truth, where = loop(seed, anchors=4)
    best = optimize(replace(graph, poses=truth, anchors=where))[1].chi2
    rng = np.random.default_rng(seed)
    far = replace(graph, anchors=where + rng.normal(scale=100.0, size=where.shape))
    assert optimize(far)[1].chi2 > 1.01 * best
    assert figures(capsys, written(tmp_path / "far.pyfg", far))["chi2"] == pytest.approx(best, rel=1e-5)


@pytest.mark.parametrize("seed", [3])
def test_worthless_estimates_do_not_keep_the_search_from_the_minimum_from_the_truth(tmp_path, capsys, seed):
    graph, truth, where = loop(seed, n=200, anchors=4)
    graph = replace(graph, edges=(graph.edges[0], graph.edges[2]))
    best = optimize(replace(graph, poses=truth, anchors=where))[1].chi2
    rng = np.random.default_rng(seed)
    poses = graph.poses + rng.normal(scale=3.0, size=graph.poses.shape) * (np.arange(200) > 0)[:, None]
    worthless = replace(graph, poses=poses, anchors=np.zeros((4, 2)))
    assert optimize(worthless)[1].chi2 > 1.5 * best
    # Both searches end where a step gains less than a share of chi2.
    assert figures(capsys, written(tmp_path / "zero.g2o", worthless))["chi2"] == pytest.approx(best, rel=1e-4)


@pytest.mark.parametrize(
    ("given", "known", "options"),
    [(True, "fixed", []), (True, "priors", ["--from-odometry"]), (False, "fixed", ["--from-odometry"]), (False, "priors", [])],
)
def test_known_anchors_say_where_the_odometry_lies(tmp_path, capsys, given, known, options):
    """The vertices, where there are any, are the odometry's: in another frame than the anchors, half a turn off."""
    graph, truth, where = loop(7, n=80, anchors=4)
    graph = replace(graph, edges=(graph.edges[0], graph.edges[2]), anchors=where, fixed_poses=np.zeros(80, dtype=bool))
    if known == "fixed":
        graph = replace(graph, fixed_anchors=np.ones(4, dtype=bool))
    else:
        graph = graph.with_edges(PriorEdges("anchors", np.arange(4), where, np.tile(100.0 * np.eye(2), (4, 1, 1))))
    best, summary = optimize(replace(graph, poses=truth))
    away = replace(graph, poses=se2.compose(np.array([30.0, -20.0, 2.8]), graph.poses))
    path = written(tmp_path / "away.g2o", away)
    if not given:
        lines = (tmp_path / "away.g2o").read_text().splitlines(keepends=True)
        (tmp_path / "away.g2o").write_text("".join(line for line in lines if not line.startswith("VERTEX_SE2")))
    out = str(tmp_path / "out.g2o")
    assert figures(capsys, path, *options, "--out", out)["chi2"] == pytest.approx(summary.chi2, rel=1e-5)
    found = read_g2o(out).graph
    np.testing.assert_allclose(found.poses, best.poses, atol=1e-3)
    np.testing.assert_allclose(found.anchors, best.anchors, atol=1e-3)


def test_robots_that_see_the_same_landmarks_are_tied_by_them(tmp_path, capsys):
    graph, truth, _ = loop(8, n=80, anchors=0)
    rng = np.random.default_rng(8)
    where = rng.uniform(-5.0, 5.0, (4, 2))
    pose, anchor = np.repeat(np.arange(80), 4)[::3], np.tile(np.arange(4), 80)[::3]
    seen = se2.rotate(-truth[pose, 2], where[anchor] - truth[pose, :2]) + rng.normal(scale=0.05, size=(len(pose), 2))
    landmarks = LandmarkEdges(pose, anchor, seen, np.tile(20.0 * np.eye(2), (len(pose), 1, 1)))
    odometry = graph.edges[0].rows(np.flatnonzero(graph.edges[0].i != 39))
    whole = replace(graph, edges=(odometry, landmarks), anchors=where)
    best = optimize(replace(whole, poses=truth))[1].chi2
    written(tmp_path / "two.g2o", whole)
    lines = (tmp_path / "two.g2o").read_text().splitlines(keepends=True)
    (tmp_path / "two.g2o").write_text("".join(line for line in lines if not line.startswith("VERTEX")))
    found = figures(capsys, str(tmp_path / "two.g2o"))
    assert found["chains"] == 2
    assert found["chi2"] == pytest.approx(best, rel=1e-5)


def test_an_anchor_that_cannot_be_placed_has_no_place_in_the_file(tmp_path, capsys):
    graph = loop(3, n=80, anchors=3)[0]
    ranges = graph.edges[2]
    few = ranges.rows(np.flatnonzero((ranges.anchor != 1) | (np.cumsum(ranges.anchor == 1) <= 1)))
    path = written(tmp_path / "few.pyfg", replace(graph, edges=(*graph.edges[:2], few)))
    out = tmp_path / "out.pyfg"
    assert figures(capsys, path, "--from-odometry", "--out", str(out))["unplaced_anchors"] == ["L1"]
    assert " L1 " not in out.read_text()


def test_robust_leaves_out_a_false_second_measurement_of_a_step(tmp_path, capsys):
    graph = loop(3, n=100, anchors=0)[0]
    steps, closures = graph.edges[:2]
    again = replace(steps.rows(np.arange(40, 42)), T_i_j=steps.T_i_j[40:42] + np.array([[3.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    graph = replace(graph, edges=(steps, closures, again))
    found = figures(capsys, written(tmp_path / "false.g2o", graph), "--robust")
    assert found["outliers"] == {"RelativePoseEdges": 1}
    assert found["chi2_per_dof"] == pytest.approx(1.0, abs=0.3)


def test_robust_names_the_false_ranges_and_leaves_them_out(tmp_path, capsys):
    graph = loop(3, n=200)[0]
    rng = np.random.default_rng(3)
    edges = list(graph.edges)
    bad = rng.random(len(edges[2])) < 0.2
    edges[2] = replace(edges[2], ranges=edges[2].ranges + 4.0 * bad)
    path = written(tmp_path / "false.pyfg", replace(graph, edges=tuple(edges)))
    found = figures(capsys, path, "--robust", "--out", str(tmp_path / "out.pyfg"))
    # What was left out is no property of the measurements: the file keeps them all.
    before, after = (Counter(re.findall(r"^EDGE_\w+", Path(name).read_text(), re.M)) for name in (path, tmp_path / "out.pyfg"))
    assert before == after
    # One good range in a thousand lies beyond the threshold.
    assert bad.sum() <= found["outliers"]["RangeEdges"] <= bad.sum() + 5
    assert found["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)
    assert figures(capsys, path)["chi2_per_dof"] > 2.0
    assert main(["optimize", path, "--robust"]) == 0
    out = capsys.readouterr().out
    assert "outliers left out: " in out


def test_lines_of_kinds_that_are_not_used_are_said(tmp_path, capsys):
    path = tmp_path / "a.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_BEARING_SE2_XY 0 5 0.5 100\n")
    assert main(["optimize", str(path)]) == 0
    assert "warning: lines of other kinds were not used: 1 EDGE_BEARING_SE2_XY" in capsys.readouterr().out


@pytest.mark.parametrize("way", [[], ["--from-odometry", "--incremental"], ["--kernel", "huber"]])
def test_closures_at_random_end_with_the_work_allowed_and_are_named(tmp_path, capsys, monkeypatch, way):
    """They are tried for as many multiplications as are allowed, whatever the way, and what is reached is written."""
    graph = at_random(200, 400)
    once = optimize(graph, SolverConfig(max_iterations=1))[1].work
    monkeypatch.setattr("uwblite.cli.optimize._WORK", 12.0 * once)
    done = []
    step = NormalEquations.factor
    monkeypatch.setattr(NormalEquations, "factor", lambda self, damping: (done.append(self.work), step(self, damping))[1])
    path, out = written(tmp_path / "random.g2o", graph), str(tmp_path / "out.g2o")
    assert main(["optimize", path, "--out", out, *way]) == 3
    printed = capsys.readouterr().out
    assert 12.0 * once <= sum(done) < 16.0 * once
    assert "DOUBT: not converged within the work that is allowed for a graph of its size; " in printed
    assert len(read_g2o(out).graph.poses) == 200
    assert " of 400 loop closures are more than 4 standard deviations off, that of poses " in printed


@pytest.mark.parametrize("way", [[], ["--from-odometry", "--incremental"]])
def test_what_does_not_converge_is_the_same_bytes_again(tmp_path, monkeypatch, way):
    monkeypatch.setattr("uwblite.cli.optimize._WORK", 1e6)
    path, out = written(tmp_path / "random.g2o", at_random(100, 200)), tmp_path / "out.g2o"
    assert main(["optimize", path, "--out", str(out), *way]) == 3
    first = out.read_bytes()
    assert main(["optimize", path, "--out", str(out), "--force", *way]) == 3
    assert out.read_bytes() == first


def test_robust_says_that_nothing_was_left_of_the_closures(tmp_path, capsys):
    path = written(tmp_path / "random.g2o", at_random(150, 300))
    found = figures(capsys, path, "--robust", code=0)
    assert found["outliers"] == {"RelativePoseEdges": 300}
    assert (found["closures"]["far_off"], found["closures"]["contradict"]) == (300, True)


def test_whoever_sets_the_iterations_gets_as_many(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("uwblite.cli.optimize._WORK", 1.0)
    path = written(tmp_path / "random.g2o", at_random(150, 300))
    assert figures(capsys, path, code=3)["iterations"] == 1
    found = figures(capsys, path, "--set", "max_iterations=7", code=3)
    assert (found["iterations"], found["reason"]) == (7, "iterations used up")


def test_closures_that_hold_are_not_accused(tmp_path, capsys):
    path = written(tmp_path / "good.g2o", loop(3, n=200, anchors=0)[0])
    assert not figures(capsys, path)["closures"]["contradict"]


def test_several_robots_are_not_placed_one_pose_after_the_other(tmp_path, capsys):
    lines = [f"VERTEX_SE2 {k} {name}{k} {k} {y} 0" for name, y in (("A", 0), ("B", 3)) for k in range(3)]
    lines += [f"EDGE_SE2 {k} {name}{k} {name}{k + 1} 1 0 0 1e-4 0 0 1e-4 0 1e-4" for name in "AB" for k in range(2)]
    lines += [f"EDGE_RANGE {k} {name}{k} L0 {np.hypot(k - 1, 1.5):.4f} 0.0025" for name in "AB" for k in range(3)]
    (tmp_path / "two.pyfg").write_text("\n".join(lines) + "\n")
    assert main(["optimize", str(tmp_path / "two.pyfg"), "--incremental"]) == 1
    assert "--incremental places the poses of one robot; " in (said := capsys.readouterr().err)
    assert "has 2 chains of odometry" in said
