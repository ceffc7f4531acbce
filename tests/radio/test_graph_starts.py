"""Starts for graphs that come from elsewhere."""

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers.planted_graphs import lawn, loop, plain_ranges, relative_edges
from scipy.optimize import brentq

from uwblite import se2
from uwblite.cli import main
from uwblite.errors import FormatError
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.point_edges import PointDistanceEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.io.graph_file import chained_poses
from uwblite.io.pyfg import read_pyfg, write_pyfg
from uwblite.radio import graph_starts
from uwblite.radio.graph_starts import (
    Start,
    _places,
    place_anchors,
    place_chains,
    search_anchors,
    starts,
    starts_nearby,
    straightened,
)


def test_an_anchor_of_two_ranges_has_a_place_only_where_one_is_given():
    graph, truth, where = loop(2)
    *others, ranges = graph.edges
    few = ranges.rows(np.flatnonzero((ranges.anchor != 0) | (np.cumsum(ranges.anchor == 0) <= 2)))
    graph = replace(graph, poses=truth, anchors=np.full((3, 2), np.nan), edges=(*others, few))
    chains = np.zeros(len(truth), dtype=np.intp)
    [start] = starts(graph, chains)
    assert start.unplaced == (0,)
    assert np.isnan(start.placed(start.graph).anchors).tolist() == [[True] * 2, [False] * 2, [False] * 2]
    [again] = starts(graph, chains, np.array([[1.0, 2.0], [7.0, 7.0], [np.nan, np.nan]]))
    assert again.unplaced == ()
    # The second and third have ranges of 0.1 m from all around.
    np.testing.assert_allclose(again.graph.anchors, [[1.0, 2.0], *where[1:]], atol=0.2)
    assert again.graph.edges[-1] is few
    assert not again.graph.fixed_anchors.any()


def test_chains_that_nothing_ties_to_the_first_have_no_start():
    graph, truth, _ = loop(2, anchors=0)
    alone = replace(graph, edges=(graph.edges[0],))
    assert list(starts(alone, np.arange(len(truth)) // 30)) == []
    assert len(list(starts(alone, np.zeros(len(truth), dtype=np.intp)))) == 1


def test_starts_nearby_have_the_headings_or_the_anchors_anew():
    graph, truth, where = loop(1)
    best = optimize(replace(graph, poses=truth, anchors=where))[0]
    turned = replace(best, poses=best.poses + [0.0, 0.0, 2.0] * (np.arange(len(truth)) > 0)[:, None])
    far = replace(best, anchors=where + 50.0)
    by_headings, by_anchors = starts_nearby(Start(far, (7,)), turned)
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    # Chi2 of the relative poses within a fifth of the number of their residuals: the linear solution is near the minimum.
    assert sum(np.sum(e.residuals(by_headings.graph) ** 2) for e in relative) < 1.2 * sum(3 * len(e) for e in relative)
    assert np.abs(se2.wrap_angle(by_headings.graph.poses[:, 2] - truth[:, 2])).max() < 0.2
    np.testing.assert_allclose(by_anchors.graph.anchors, where, atol=0.3)
    assert by_headings.unplaced == by_anchors.unplaced == (7,)
    assert list(starts_nearby(Start(best, ()), replace(best, edges=best.edges[:1]))) == []


def test_anchors_far_away_are_put_where_their_ranges_cost_less():
    graph, truth, where = loop(0)
    far = replace(graph, poses=truth, anchors=where + np.array([[60.0, -80.0], [0.0, 0.0], [0.0, 50.0]]))
    found = search_anchors(far).anchors
    # Ranges of 0.1 m from all around; the second stands where it was.
    np.testing.assert_allclose(found, where, atol=0.2)
    np.testing.assert_array_equal(found[1], where[1])


@pytest.mark.parametrize(("less", "put"), [(0.015, False), (0.025, True)])
def test_another_place_must_cost_a_fiftieth_less(less, put):
    """An anchor so far off that its ranges cost so much more there than where the search finds it."""
    graph, truth, where = loop(0, anchors=1)
    best = search_anchors(replace(graph, poses=truth, anchors=where + 50.0, edges=graph.edges[-1:]))

    def moved(x):
        return replace(best, anchors=best.anchors + np.array([x, 0.0]))

    aside = brentq(lambda x: (1.0 - less) * moved(x).chi2() - best.chi2(), 0.0, 1.0)
    found = search_anchors(moved(aside))
    assert (found is not None) == put
    assert not put or np.array_equal(found.anchors, best.anchors)


def test_anchors_in_their_places_and_fixed_ones_stay():
    graph, truth, where = loop(1)
    assert search_anchors(replace(graph, poses=truth, anchors=where)) is None
    assert search_anchors(replace(graph, anchors=where + 50.0, fixed_anchors=np.ones(3, dtype=bool))) is None


@pytest.mark.parametrize("fixed", [False, True])
def test_anchors_without_a_place_are_put_where_their_ranges_cost_least(fixed):
    """The first has two ranges only: it stays at the origin, and they count no more."""
    graph, truth, where = loop(2)
    *others, ranges = graph.edges
    few = ranges.rows(np.flatnonzero((ranges.anchor != 0) | (np.cumsum(ranges.anchor == 0) <= 2)))
    anchors = np.array([[np.nan, np.nan], [np.nan, np.nan], where[2]])
    given = np.array([False, False, fixed])
    found, lost = place_anchors(replace(graph, poses=truth, anchors=anchors, edges=(*others, few), fixed_anchors=given))
    assert lost == (0,)
    np.testing.assert_array_equal(found.anchors[[0, 2]], [[0.0, 0.0], where[2]])
    np.testing.assert_allclose(found.anchors[1], where[1], atol=0.2)
    assert found.fixed_anchors.tolist() == [True, False, fixed]
    assert found.edges[-1].own_weights.tolist() == np.where(few.anchor == 0, 0.0, few.own_weights).tolist()


def test_a_graph_whose_anchors_all_have_places_is_left_alone():
    graph, _, _ = loop(2)
    found, lost = place_anchors(graph)
    assert lost == ()
    np.testing.assert_array_equal(found.anchors, graph.anchors)
    assert found.edges is graph.edges


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


@pytest.mark.parametrize(
    ("seed", "ties"), [(0, {}), (1, {"wrong": 0.1}), (2, {"landmarks_only": True})], ids=["ranges", "wrong ranges", "landmarks"]
)
def test_chains_find_their_places(seed, ties):
    graph, chains, truth = planted(seed, **ties)
    errors = [np.hypot(*(g.poses[:, :2] - truth[:, :2]).T).max() for g in place_chains(graph, chains)]
    # Odometry of 80 steps bends by some decimetres over 16 m.
    assert min(errors) < 1.0
    assert len(place_chains(replace(graph, poses=truth), np.zeros(len(truth), dtype=np.intp))) == 1


@pytest.mark.parametrize("seed", range(2))
def test_a_path_bent_by_its_odometry_is_straightened(seed):
    graph, truth, anchors = lawn(seed)
    best = optimize(replace(graph, poses=truth, anchors=anchors))
    # Descent from the odometry, and from anchors where they are, ends elsewhere.
    assert optimize(replace(graph, anchors=anchors))[1].chi2 > 2.0 * best[1].chi2
    found, summary = optimize(place_anchors(straightened(graph))[0])
    assert summary.chi2 == pytest.approx(best[1].chi2, rel=1e-5)
    np.testing.assert_allclose(found.poses[:, :2], best[0].poses[:, :2], atol=0.02)


@pytest.mark.parametrize("prior", [False, True])
def test_given_anchors_say_where_a_straightened_path_lies(prior):
    graph, truth, anchors = lawn(3, n=400)
    graph = replace(graph, anchors=anchors, fixed_anchors=np.full(16, not prior), fixed_poses=np.zeros(400, dtype=bool))
    if prior:
        graph = graph.with_edges(PriorEdges("anchors", np.arange(16), anchors, np.tile(np.eye(2) / 0.05, (16, 1, 1))))
    graph = replace(graph, poses=se2.compose([5.0, 3.0, 1.0], graph.poses))
    found = straightened(graph)
    np.testing.assert_array_equal(found.anchors, anchors)
    # Ranges of 0.1 m to three anchors.
    assert np.sqrt(np.mean(np.sum((found.poses - truth)[:, :2] ** 2, axis=1))) < 0.2


def test_a_path_without_ranges_is_not_straightened():
    graph = loop(2, anchors=0)[0]
    assert straightened(graph) is graph


def test_optimize_is_as_good_as_from_the_truth(tmp_path, capsys):
    graph, chains, truth = planted(1)
    names = [f"{'ABC'[c]}{100 + k}" for k, c in enumerate(chains.tolist())]
    write_pyfg(tmp_path / "robots.pyfg", graph, pose_ids=names)
    words = ["--from-odometry", "--out", str(tmp_path / "out.pyfg"), "--json"]
    assert main(["optimize", str(tmp_path / "robots.pyfg"), *words]) == 0
    stated = json.loads(capsys.readouterr().out)
    best = optimize(replace(graph, poses=truth))[1].chi2
    assert stated["chi2"] <= 1.01 * best
    assert stated["chains"] == ROBOTS
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


@pytest.mark.parametrize("straight", [True, False])
def test_the_best_places_of_a_chain_are_few_and_apart_the_cheapest_first(straight):
    """Of a straight path the mirror image about the line through two anchors is as good as the truth."""
    rng = np.random.default_rng(2)
    truth, along = np.array([2.0, 1.5, 0.7]), rng.uniform(0.0, 6.0, 80)
    path = np.column_stack([along, np.zeros(80) if straight else np.sin(along) + 0.2 * along])
    anchors = np.array([[0.0, 0.0], [8.0, 0.0]])[np.arange(80) % 2]
    ranges = np.hypot(*(se2.transform(truth, path) - anchors).T) + rng.normal(0.0, 0.05, 80)
    found = _places(anchors, path, ranges)
    costs, places = [cost for cost, _ in found], [place for _, place in found]
    assert costs == sorted(costs)
    assert len(found) <= 4
    assert all(np.abs(se2.between(a, b)).max() > 0.1 for a, b in combinations(places, 2))
    mirrored = truth * [1.0, -1.0, -1.0]
    right = [truth, mirrored][: 1 + straight]
    for best in places[: len(right)]:
        assert min(np.abs(se2.between(best, place)).max() for place in right) < 0.1
    assert (costs[1] < 1.01 * costs[0]) is straight
    ((cost, place),) = _places(anchors[:3], path[:3], ranges[:3])
    assert (cost, place.tolist()) == (0.0, [0.0] * 3)


def test_places_of_a_chain_that_differ_by_a_decimetre_or_a_tenth_of_a_radian_are_two(monkeypatch):
    """The best comes first, and of those that are one it stays."""
    motions = [[0.0, 0.0, 0.0], [0.09, 0.0, 0.0], [0.11, 0.0, 0.0], [0.0, 0.0, 0.09], [0.0, -0.11, 0.0], [0.0, 0.0, 0.11]]
    found = [(float(k), np.array(motion), None) for k, motion in enumerate(motions)]
    monkeypatch.setattr(graph_starts, "path_placements", lambda *_: iter(found))
    places = graph_starts._places(np.zeros((4, 2)), np.zeros((4, 2)), np.ones(4))
    assert [cost for cost, _ in places] == [0.0, 2.0, 4.0, 5.0]
    assert [cost for cost, _ in graph_starts._places(np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3))] == [0.0]
