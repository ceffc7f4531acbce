"""`uwblite optimize` on hard graphs: odometry that bends too far, false loop closures and ranges."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import lawn, loop

from uwblite.cli import main
from uwblite.cli.formats import write_graph
from uwblite.graph.solver import optimize
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


def test_headings_from_anywhere_end_in_the_certified_minimum(tmp_path, capsys):
    graph = loop(3, n=400, anchors=0)[0]
    rng = np.random.default_rng(3)
    poses = graph.poses + rng.normal(scale=[3.0, 3.0, 1.5], size=graph.poses.shape) * (np.arange(400) > 0)[:, None]
    bent = replace(graph, poses=poses, edges=graph.edges[:2])
    best = optimize(replace(graph, edges=graph.edges[:2]))[1].chi2
    assert optimize(bent)[1].chi2 > 2.0 * best
    found = figures(capsys, written(tmp_path / "bent.g2o", bent))
    assert found["chi2"] == pytest.approx(best, rel=1e-6)
    assert found["certificate"] == "global minimum"
    assert best - 2e-3 < found["chi2_lower_bound"] <= best
    wrong = figures(capsys, str(tmp_path / "bent.g2o"), "--kernel", "huber")
    assert wrong["certificate"] == "none: the robust kernel huber has no relaxation"


@pytest.mark.parametrize("seed", [4, 6, 12])
def test_anchors_that_start_far_away_end_in_the_minimum_from_the_truth(tmp_path, capsys, seed):
    graph, truth, where = loop(seed, anchors=4)
    best = optimize(replace(graph, poses=truth, anchors=where))[1].chi2
    rng = np.random.default_rng(seed)
    far = replace(graph, anchors=where + rng.normal(scale=100.0, size=where.shape))
    assert optimize(far)[1].chi2 > 1.01 * best
    assert figures(capsys, written(tmp_path / "far.pyfg", far))["chi2"] == pytest.approx(best, rel=1e-5)


def test_robust_names_the_false_ranges_and_leaves_them_out(tmp_path, capsys):
    graph = loop(3, n=200)[0]
    rng = np.random.default_rng(3)
    edges = list(graph.edges)
    bad = rng.random(len(edges[2])) < 0.2
    edges[2] = replace(edges[2], ranges=edges[2].ranges + 4.0 * bad)
    path = written(tmp_path / "false.pyfg", replace(graph, edges=tuple(edges)))
    found = figures(capsys, path, "--robust", "--out", str(tmp_path / "out.pyfg"))
    # One good range in a thousand lies beyond the threshold.
    assert bad.sum() <= found["outliers"]["RangeEdges"] <= bad.sum() + 5
    assert found["chi2_per_dof"] == pytest.approx(1.0, abs=0.2)
    assert figures(capsys, path)["chi2_per_dof"] > 2.0
    assert main(["optimize", path, "--robust"]) == 0
    assert "outliers left out: " in capsys.readouterr().out


def test_the_two_ways_exclude_one_another(tmp_path, capsys):
    path = written(tmp_path / "g.pyfg", loop(3, n=50)[0])
    assert main(["optimize", path, "--robust", "--incremental"]) == 2
    assert "not allowed with" in capsys.readouterr().err
