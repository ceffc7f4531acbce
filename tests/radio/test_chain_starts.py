"""Robots that only range to each other find their places, from their odometry alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges, relative_edges

from uwblite import se2
from uwblite.cli import main
from uwblite.errors import FormatError
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.distance_edges import PointDistanceEdges
from uwblite.graph.graph import Graph
from uwblite.graph.solver import optimize
from uwblite.io.graph_file import chained_poses
from uwblite.io.pyfg import read_pyfg, write_pyfg
from uwblite.radio import chain_starts
from uwblite.radio.chain_starts import _BEND, _converged, _places, place_chains

ROBOTS, STEPS = 3, 80


def planted(seed, *, landmarks_only=False, wrong=0.0):
    """Return a graph of three robots in frames of their own, its chains, and the true poses."""
    rng = np.random.default_rng(seed)
    chains = np.repeat(np.arange(ROBOTS), STEPS)
    truth = []
    for _ in range(ROBOTS):
        start = np.array([*rng.uniform(-5.0, 5.0, 2), rng.uniform(-np.pi, np.pi)])
        steps = np.column_stack([np.full(STEPS, 0.2), np.zeros(STEPS), np.cumsum(rng.normal(0.0, 0.05, STEPS))])
        for step in steps:
            truth.append(start)
            start = se2.compose(start, step)
    truth = np.array(truth)
    i = np.concatenate([np.arange(k * STEPS, (k + 1) * STEPS - 1) for k in range(ROBOTS)])
    odometry = relative_edges(truth, i, i + 1, [0.005, 0.005, 0.003], rng)
    poses = truth.copy()
    for k in range(ROBOTS):
        mine = chains == k
        poses[mine] = chained_poses(
            np.where(np.arange(STEPS)[:, None] == 0, truth[0] if k == 0 else 0.0, np.nan) * np.ones(3),
            *(v[chains[i] == k] - k * STEPS * (n < 2) for n, v in enumerate((odometry.i, odometry.j, odometry.T_i_j))),
        )
    where = rng.uniform(-6.0, 6.0, (4, 2))
    if landmarks_only:
        pose, anchor = np.repeat(np.arange(len(truth)), 4)[::3], np.tile(np.arange(4), len(truth))[::3]
        distance = np.hypot(*(truth[pose, :2] - where[anchor]).T) + rng.normal(0.0, 0.05, len(pose))
        ranges = plain_ranges(pose, anchor, distance, 0.05)
        return Graph(poses, np.full((4, 2), np.nan), (odometry, ranges)), chains, truth
    one, other = rng.integers(0, len(truth), (2, 400))
    one, other = one[chains[one] != chains[other]], other[chains[one] != chains[other]]
    distance = np.hypot(*(truth[one, :2] - truth[other, :2]).T) + rng.normal(0.0, 0.05, len(one))
    distance[rng.random(len(one)) < wrong] += 3.0
    none = np.zeros((len(one), 2))
    met = PointDistanceEdges(one, other, none, none, distance, np.full(len(one), 0.05))
    return Graph(poses, np.zeros((0, 2)), (odometry, met)), chains, truth


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("ties", [{}, {"wrong": 0.1}, {"landmarks_only": True}], ids=["ranges", "wrong ranges", "landmarks"])
def test_chains_find_their_places(seed, ties):
    graph, chains, truth = planted(seed, **ties)
    errors = [np.hypot(*(g.poses[:, :2] - truth[:, :2]).T).max() for g in place_chains(graph, chains)]
    # Odometry of 80 steps bends by some decimetres over 16 m.
    assert min(errors) < 1.0
    assert len(place_chains(replace(graph, poses=truth), np.zeros(len(truth), dtype=np.intp))) == 1


@pytest.mark.parametrize("seed", range(3))
def test_optimize_is_as_good_as_from_the_truth(tmp_path, seed, capsys):
    graph, chains, truth = planted(seed)
    names = [f"{'ABC'[c]}{100 + k}" for k, c in enumerate(chains.tolist())]
    write_pyfg(tmp_path / "robots.pyfg", graph, pose_ids=names)
    words = ["--from-odometry", "--out", str(tmp_path / "out.pyfg"), "--json"]
    assert main(["optimize", str(tmp_path / "robots.pyfg"), *words]) == 0
    stated = json.loads(capsys.readouterr().out)
    best = optimize(replace(graph, poses=truth))[1].chi2
    assert stated["chi2"] <= 1.01 * best
    assert stated["chains"] == ROBOTS
    assert stated["chi2_lower_bound"] <= stated["chi2"]
    assert read_pyfg(tmp_path / "out.pyfg").pose_ids == tuple(names)


def test_a_chain_that_nothing_ties_is_named(tmp_path):
    graph, _, _ = planted(0)
    apart = replace(graph, edges=graph.edges[:1])
    write_pyfg(tmp_path / "robots.pyfg", apart)
    with pytest.raises(FormatError, match="pose A80 is not connected to the first one"):
        read_pyfg(tmp_path / "robots.pyfg", from_odometry=True)


@pytest.mark.slow
def test_four_robots_of_tiers_from_their_odometry(shared_data, tmp_path):
    path = shared_data / "pose_graphs" / "tiers.pyfg.gz"
    whole = read_pyfg(path)
    local = optimize(whole.graph)[0].poses
    assert main(["optimize", str(path), "--from-odometry", "--out", str(tmp_path / "out.pyfg"), "-q"]) == 0
    found = read_pyfg(tmp_path / "out.pyfg").graph.poses
    number = np.arange(len(found), dtype=np.float64)

    def ate(poses):
        return evaluate_trajectory(number, poses, number, whole.graph.poses, max_gap=1.5).ate.rmse

    assert ate(found) <= 1.05 * ate(local)


def test_the_best_places_of_a_chain_are_four_a_tenth_apart_the_cheapest_first(monkeypatch):
    """By distance or by heading; of places nearer to each other than that only the cheapest counts."""
    found = [(3.0, 0.0, 0.11), (1.0, 0.0, 0.0), (2.0, 0.09, 0.09), (9.0, 0.5, 0.0), (4.0, 0.12, 0.0), (5.0, 0.3, 0.0)]
    ends = iter([(cost, np.array([x, 0.0, theta])) for cost, x, theta in found])
    monkeypatch.setattr(chain_starts, "_starts", lambda *_: found)
    monkeypatch.setattr(chain_starts, "_converged", lambda *_: next(ends))
    assert [cost for cost, _ in _places(np.zeros((4, 2)), np.zeros((4, 2)), np.ones(4))] == [1.0, 3.0, 4.0, 5.0]
    ((cost, place),) = _places(np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3))
    assert (cost, place.tolist()) == (0.0, [0.0] * 3)


def test_from_everywhere_the_search_goes_down():
    """The cost is sum log(1 + (error / bend)^2); a step that would raise it is tried again, shorter."""
    rng = np.random.default_rng(7)
    there, own, place = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (20, 2)), np.array([1.0, -2.0, 0.5])
    ranges = np.hypot(*(se2.transform(place, own) - there).T) + rng.normal(0.0, 0.05, 20)

    def cost(T):
        return np.log1p(((np.hypot(*(se2.transform(T, own) - there).T) - ranges) / _BEND) ** 2).sum()

    starts = np.column_stack([rng.uniform(-8, 8, (20, 2)), rng.uniform(-3, 3, 20)])
    found = [_converged(start, there, own, ranges) for start in starts]
    for start, (least, T) in zip(starts, found, strict=True):
        assert least == pytest.approx(cost(T))
        assert least < cost(start) - 1.0
    assert np.abs(se2.between(place, min(found, key=lambda f: f[0])[1])).max() < 0.1
