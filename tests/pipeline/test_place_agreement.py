"""Two places of one anchor are one where one place explains its ranges about as well."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges, random_poses

from uwblite.constraints import Constraints
from uwblite.graph.graph import Graph
from uwblite.graph.solver import SolverConfig
from uwblite.pipeline import place_agreement
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.lidar_stages import solved
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.place_agreement import _cost_of_one, _merged, _most_cost, _same, _successive, merge_places_that_agree
from uwblite.pipeline.progress import Stages
from uwblite.radio.bootstrap_attempt import BootstrapResult


def estimate(names, places, placed=None):
    """Return an estimate with anchors at places (a, 2), heard 40 times each with 0.1 m of noise from poses that are known."""
    rng = np.random.default_rng(0)
    poses = random_poses(rng, 40 * len(names), 6.0)
    anchors, anchor = np.array(places, dtype=np.float64), np.repeat(np.arange(len(names)), 40)
    distance = np.hypot(*(poses[:, :2] - anchors[anchor]).T) + 0.1 * rng.standard_normal(len(anchor))
    ranges = plain_ranges(np.arange(len(anchor)), anchor, distance, 0.1)
    yes = np.ones(len(names), dtype=bool) if placed is None else np.array(placed)
    graph = Graph(poses, anchors, fixed_poses=np.ones(len(poses), dtype=bool), fixed_anchors=~yes)
    found = BootstrapResult(graph, yes, tuple((name,) for name in names), ~yes)
    return Estimate(graph, None, ranges, tuple(names), found)


@pytest.mark.parametrize(("names", "pairs"), [
    (["A", "A@2", "B"], [(0, 1)]),
    (["A", "A@2", "A@3"], [(0, 1), (1, 2)]),
    (["A", "A@2#2", "A#2"], [(2, 1)]),
    (["A", "A@2#2"], [(0, 1)]),
    (["A", "A@3", "B@2"], []),
    (["A", "A#2"], []),
])  # fmt: skip
def test_each_place_is_compared_with_the_one_before_it_in_its_recording(names, pairs):
    assert _successive(estimate(names, [[3.0 * k, 1.0] for k in range(len(names))])) == pairs


def test_places_of_other_recordings_are_compared_where_they_are_near():
    places = [[0.0, 0.0], [0.9, 0.0], [0.5, 0.0], [0.3, 0.8], [1.5, 0.0]]
    assert _successive(estimate(["A", "A#2", "B#2", "A#3", "A#4"], places)) == [(0, 1), (0, 3), (1, 4)]


def test_a_place_that_was_not_found_is_compared_with_none():
    assert _successive(estimate(["A", "A@2"], [[0.0, 1.0], [3.0, 1.0]], placed=[True, False])) == []


def test_the_cost_of_one_place_is_what_chi2_grows_by(monkeypatch):
    """Errors of 0.1 m, 40 ranges to each of two places that are 0.3 m apart: as much as one place between them leaves."""
    one_of = replace(estimate(["A", "A@2", "B"], [[8.0, 1.0], [8.3, 1.0], [-7.0, 2.0]]))
    monkeypatch.setattr(Estimate, "problem", property(lambda self: self.graph.with_edges(self.ranges)))
    apart = solved(one_of, SolverConfig())
    along = (apart.graph.poses[:80, :2] - [8.15, 1.0]) / np.hypot(*(apart.graph.poses[:80, :2] - [8.15, 1.0]).T)[:, None]
    information = [along[part].T @ along[part] / 0.1**2 for part in (slice(0, 40), slice(40, 80))]
    off = apart.graph.anchors[1] - apart.graph.anchors[0]
    expected = off @ np.linalg.solve(sum(map(np.linalg.inv, information)), off)
    assert _cost_of_one(apart, (0, 1), SolverConfig()) == pytest.approx(expected, rel=0.05)
    assert _cost_of_one(apart, (1, 2), SolverConfig()) > 1000.0


def test_one_place_is_sought_from_either_of_both(monkeypatch):
    """Along a line a place has a mirror image: the second stretch alone, from elsewhere, tells the sides apart."""
    poses = np.column_stack([np.linspace(0.0, 20.0, 80), np.where(np.arange(80) < 60, 0.0, 3.0), np.zeros(80)])
    ranges = plain_ranges(np.arange(80), np.repeat([0, 1], [60, 20]), np.hypot(*(poses[:, :2] - [10.0, 4.0]).T), 0.1)
    yes = np.ones(2, dtype=bool)
    graph = Graph(poses, np.array([[10.0, -4.0], [10.0, 4.0]]), fixed_poses=np.ones(80, dtype=bool), fixed_anchors=~yes)
    apart = Estimate(graph, None, ranges, ("A", "A@2"), BootstrapResult(graph, yes, ((), ()), ~yes))
    monkeypatch.setattr(Estimate, "problem", property(lambda self: self.graph.with_edges(self.ranges)))
    assert _cost_of_one(apart, (0, 1), SolverConfig()) == pytest.approx(0.0, abs=1e-6)


def test_the_level_of_the_test_counts_the_moments_tried():
    """One map of twenty: -2 ln(0.05 / 50) of 400 ranges; a handful is tried once."""
    assert _most_cost(400) == pytest.approx(13.82, abs=0.01)
    assert _most_cost(4) == pytest.approx(5.99, abs=0.01)


def test_ranges_of_a_chain_of_places_go_to_the_first_one():
    before = estimate(["A", "A@2", "A@3", "B"], [[0.0, 1.0], [2.0, 1.0], [4.0, 4.0], [9.0, 9.0]])
    after = _merged(before, [(1, 2), (0, 1)])
    assert after.anchor_ids == ("A", "B")
    assert after.ranges.anchor.tolist() == [0] * 120 + [1] * 40
    np.testing.assert_allclose(after.graph.anchors, [[2.0, 2.0], [9.0, 9.0]])
    assert after.bootstrap.hypotheses == (("A",), ("B",))
    assert len(after.placed) == len(after.graph.fixed_anchors) == 2


@pytest.mark.parametrize(("cost", "given", "names"), [
    (11.0, Constraints(), ("A", "B")), (12.0, Constraints(), ("A", "A@2", "B")),
    (11.0, Constraints((SimpleNamespace(id="B"),)), ("A", "A@2", "B")),
])  # fmt: skip
def test_places_that_agree_are_one_but_beside_given_anchors(monkeypatch, cost, given, names):
    before = estimate(["A", "A@2", "B"], [[0.0, 1.0], [0.2, 1.0], [9.0, 9.0]])
    monkeypatch.setattr(Estimate, "problem", property(lambda self: self.graph.with_edges(self.ranges)))
    monkeypatch.setattr(place_agreement, "_cost_of_one", lambda *args: cost)
    task = SimpleNamespace(given=given, stages=Stages(None, None), config=MappingConfig())
    after = merge_places_that_agree(before, task)
    assert after.anchor_ids == names
    if len(names) == 2:
        # All 80 ranges place it.
        assert np.hypot(*(after.graph.anchors[0] - [0.1, 1.0])) < 0.1
        assert [stage.name for stage in task.stages.done] == ["places merged"]
    else:
        assert after is before


@pytest.mark.parametrize(("given", "merged", "asked"), [(11.0, True, 1), (100.0, True, 2), (119.0, False, 1)])
def test_poses_give_way_where_they_may_decide(monkeypatch, given, merged, asked):
    """The limit is 11.7, ten times it 117: with free poses one place costs 5."""
    before = estimate(["A", "A@2", "B"], [[0.0, 1.0], [0.2, 1.0], [9.0, 9.0]])
    before, costs = replace(before, graph=replace(before.graph, fixed_poses=np.arange(120) == 0)), []

    def cost(found, pair, solver):
        costs.append(given if found.graph.fixed_poses.all() else 5.0)
        return costs[-1]

    monkeypatch.setattr(place_agreement, "_cost_of_one", cost)
    monkeypatch.setattr(place_agreement, "solved", lambda found, solver: found)
    same = _same(before, [(0, 1)], _most_cost(120), SolverConfig())
    assert (same == [(0, 1)], len(costs)) == (merged, asked)
