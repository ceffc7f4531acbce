"""When two recordings' places of an anchor are not the same; anchors of some recordings alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges, random_poses

from uwblite.constraints import Constraints
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import SolverConfig
from uwblite.pipeline import moved_anchors
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.moved_anchors import (
    _LEAST_MOVE,
    _MOVED,
    _differ,
    _places_by_recording,
    name_new_and_absent_anchors,
    separate_moved_anchors,
)  # fmt: skip
from uwblite.pipeline.progress import Stages
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.radio.range_noise import RangeNoiseConfig


@pytest.mark.parametrize(("metres", "sigmas", "differ"), [(1.01, 1.01, True), (0.99, 1.01, False), (1.01, 0.99, False)])
def test_places_differ_by_distance_and_by_their_uncertainty(metres, sigmas, differ):
    """More than the least move, and more than its Mahalanobis distance, along the less certain direction."""
    direction = np.array([0.6, 0.8])
    along = (metres * _LEAST_MOVE) ** 2 / (sigmas**2 * _MOVED)
    across = np.array([-0.8, 0.6])
    covariance = along * np.outer(direction, direction) + 0.01 * along * np.outer(across, across)
    assert _differ(metres * _LEAST_MOVE * direction, covariance) is differ


def test_an_anchor_that_stands_elsewhere_in_a_recording_is_another_one_there(monkeypatch):
    """Two anchors, three recordings: B is moved before the second one and stays where it is in the third."""
    anchor, recording = np.array([0, 1, 0, 1, 0, 1]), np.array([0, 0, 1, 1, 2, 2])
    places = {(0, 0): 0.0, (0, 1): 0.1, (0, 2): 0.0, (1, 0): 5.0, (1, 1): 9.0, (1, 2): 9.1}
    pairs = np.array(list(places))
    place = np.column_stack([list(places.values()), np.zeros(6)])
    found = place, np.tile(0.01 * np.eye(2), (6, 1, 1)), pairs
    monkeypatch.setattr(moved_anchors, "_places_by_recording", lambda *args: found)
    monkeypatch.setattr(moved_anchors, "_solved_again", lambda estimate, task: estimate)
    yes = np.ones(2, dtype=bool)
    graph = Graph(np.zeros((3, 3)), np.array([[0.0, 0.0], [5.0, 0.0]]))
    ranges = plain_ranges(recording, anchor, np.ones(6), 0.1)
    bootstrap = BootstrapResult(graph, yes, (("a",), ("b",)), ~yes)
    recordings = type("Recordings", (), {"of_keyframe": np.arange(3), "__len__": lambda self: 3})()
    stages = Stages(None, None)
    task = SimpleNamespace(recordings=recordings, config=MappingConfig(), stages=stages, given=Constraints())
    estimate = separate_moved_anchors(Estimate(graph, None, ranges, ("A", "B"), bootstrap), task)
    assert estimate.anchor_ids == ("A", "B", "B#2")
    assert estimate.ranges.anchor.tolist() == [0, 1, 0, 2, 0, 2]
    np.testing.assert_array_equal(estimate.graph.anchors, [[0.0, 0.0], [5.0, 0.0], [9.0, 0.0]])
    assert (estimate.bootstrap.hypotheses, estimate.placed.tolist()) == ((("a",), ("b",), ()), [True] * 3)
    names = ("anchor", "recording", "new_id", "distance")
    assert [[w.figures[name] for name in names] for w in stages.warnings] == [["B", 2, "B#2", 4.0], ["B", 3, "B#2", 4.1]]


def united(monkeypatch, places, *given, variance=0.01):
    """Three recordings that were joined with a second place of A in the second one; places (3,) as the poses show them."""
    found = np.column_stack([places, np.zeros(3)]), np.tile(variance * np.eye(2), (3, 1, 1)), np.array([[0, 0], [0, 2], [2, 1]])
    monkeypatch.setattr(moved_anchors, "_places_by_recording", lambda *args: found)
    monkeypatch.setattr(moved_anchors, "_solved_again", lambda estimate, task: estimate)
    yes = np.ones(3, dtype=bool)
    graph = Graph(np.zeros((3, 3)), np.array([[0.0, 0.0], [5.0, 0.0], [27.0, 0.0]]))
    ranges = plain_ranges(np.array([0, 0, 1, 2]), np.array([0, 1, 2, 0]), np.ones(4), 0.1)
    bootstrap = BootstrapResult(graph, yes, (("a",), ("b",), ("c",)), ~yes)
    recordings = type("Recordings", (), {"of_keyframe": np.arange(3), "__len__": lambda self: 3})()
    stages = Stages(None, None)
    stages.warn("moved-anchor", "", new_id="A#2", distance=27.0)
    stages.warn("moved-anchor", "from its earlier place")
    task = SimpleNamespace(recordings=recordings, config=MappingConfig(), stages=stages, given=Constraints(given))
    estimate = separate_moved_anchors(Estimate(graph, None, ranges, ("A", "B", "A#2"), bootstrap), task)
    return estimate, [w.figures.get("distance") for w in stages.warnings]


def test_an_anchor_that_stands_where_it_stood_was_not_moved(monkeypatch):
    """The bootstrap of one recording found its mirror image, so that joining gave it a second place."""
    estimate, distances = united(monkeypatch, [0.0, 0.1, 0.1])
    assert (estimate.anchor_ids, distances) == (("A", "B"), [None])
    assert estimate.ranges.anchor.tolist() == [0, 1, 0, 0]
    assert (estimate.bootstrap.hypotheses, len(estimate.graph.anchors)) == ((("a",), ("b",)), 2)


def test_an_anchor_that_was_moved_keeps_both_places_and_the_way_between_them_is_said_anew(monkeypatch):
    estimate, distances = united(monkeypatch, [0.0, 0.1, 3.0])
    assert (estimate.anchor_ids, distances) == (("A", "B", "A#2"), [None, 3.0])
    assert estimate.ranges.anchor.tolist() == [0, 1, 2, 0]


@pytest.mark.parametrize(("off", "ids"), [(0.84, ("A", "B")), (0.89, ("A", "B", "A#2"))])
def test_places_that_were_apart_stay_so_beyond_what_joining_allows(monkeypatch, off, ids):
    """With variances of 0.0081 and 0.0081 of either place: 0.5 m and twice the standard deviation of both, 0.18 m."""
    monkeypatch.setattr(moved_anchors, "_MOVED", 100.0)
    assert united(monkeypatch, [0.0, 0.1, off], variance=0.0081)[0].anchor_ids == ids


def test_places_that_the_user_names_stay(monkeypatch):
    assert united(monkeypatch, [0.0, 0.1, 0.1], SimpleNamespace(id="A#2"))[0].anchor_ids == ("A", "B", "A#2")


@pytest.mark.parametrize("wild", [0.0, 0.1])
def test_each_recording_s_ranges_determine_its_anchors_with_the_poses_fixed(wild):
    """Three anchors heard in three recordings, one of them not in the last; the second is moved by 4 m in between."""
    rng = np.random.default_rng(3)
    poses = random_poses(rng, 240, 6.0)
    recording, anchor = np.repeat(np.arange(3), 80), rng.integers(0, 3, 240)
    stood = np.tile([[0.0, 9.0], [7.0, -4.0], [-8.0, 1.0]], (3, 1, 1))
    stood[1:, 1] += [0.0, -4.0]
    heard = (anchor < 2) | (recording < 2)
    pose = np.flatnonzero(heard)
    distance = np.hypot(*(poses[pose, :2] - stood[recording[pose], anchor[pose]]).T)
    off = 0.05 * rng.standard_normal(len(pose)) + np.where(rng.random(len(pose)) < wild, 3.0, 0.0)
    bias, free = Calibration((UnknownKey("bias", "A"),), np.array([0.7])), np.zeros(1, dtype=bool)
    graph = Graph(poses, stood[0] + rng.normal(size=(3, 2)), (), bias, fixed_calibration=free)
    yes, ranges = np.ones(3, dtype=bool), plain_ranges(pose, anchor[pose], distance + off, 0.05)
    estimate = Estimate(graph, None, ranges, ("A", "B", "C"), BootstrapResult(graph, yes, ((),) * 3, ~yes))
    place, covariance, pairs = _places_by_recording(estimate, recording[pose], SolverConfig(), RangeNoiseConfig())
    assert pairs.tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2], [2, 0], [2, 1]]
    error = place - stood[pairs[:, 1], pairs[:, 0]]
    # Sixteen degrees of freedom: chi2 of 40 or more by chance in one of 1,000 worlds.
    assert np.einsum("ki,kij,kj->", error, np.linalg.inv(covariance), error) < 40.0
    # 27 ranges of 5 cm at all bearings know a coordinate to 0.05 sqrt(2 / 27) = 1.4 cm; the errors in common assumed add 4 cm.
    np.testing.assert_allclose(np.sqrt(np.einsum("kii->k", covariance) / 2.0), 0.043, rtol=0.2)


STEPS = 40
"""Keyframes of each recording, 0.3 m apart along x."""


def estimate_and_task(beginnings, heard, ids=("A", "B")):
    """Recordings that begin at places (r, 2), each with a range from every keyframe to the anchors it hears, at (6, 3) each."""
    way = np.column_stack([0.3 * np.arange(STEPS), np.zeros((STEPS, 2))])
    poses = np.concatenate([way + np.array([*place, 0.0]) for place in beginnings])
    recording = np.repeat(np.arange(len(beginnings)), STEPS)
    pose, anchor = np.nonzero(np.array([[name in heard[n] for name in ids] for n in recording]))
    none = np.zeros((len(pose), 2))
    ranges = RangeEdges(
        pose, anchor, np.ones(len(pose)), np.ones(len(pose)), none, none[:, 0], none, np.zeros(2), none[:, 0],
        np.full((len(pose), 6), -1), weights=np.ones(len(pose)),
    )  # fmt: skip
    graph = Graph(poses, np.tile([6.0, 3.0], (len(ids), 1)))
    estimate = SimpleNamespace(ranges=ranges, graph=graph, anchor_ids=ids, placed=np.ones(len(ids), dtype=bool))
    return estimate, SimpleNamespace(recordings=_Recordings(recording, len(beginnings)), stages=Stages(None, None))


class _Recordings(SimpleNamespace):
    def __init__(self, of_keyframe, number):
        super().__init__(of_keyframe=of_keyframe, number=number)

    def __len__(self):
        return self.number


def said(beginnings, heard, ids=("A", "B")):
    estimate, task = estimate_and_task(beginnings, heard, ids)
    assert name_new_and_absent_anchors(estimate, task) is estimate
    return [(w.kind, w.figures["anchor"], w.figures["recording"], w.figures["silent"]) for w in task.stages.warnings]


HERE, FAR = (0.0, 0.0), (0.0, 50.0)


def test_an_anchor_that_was_replaced_is_named_as_gone_and_as_new():
    found = said([HERE] * 4, ["A", "A", "B", "B"])
    assert found == [("absent-anchor", "A", 2, [3, 4]), ("new-anchor", "B", 3, [1, 2])]


@pytest.mark.parametrize(
    ("beginnings", "heard"),
    [([HERE, HERE], ["AB", "AB"]), ([HERE, FAR], ["AB", "A"]), ([HERE, HERE, HERE], ["AB", "A", "AB"]), ([HERE], ["A"])],
    ids=["heard by all", "nobody came near", "silent in between", "one recording"],
)
def test_an_anchor_is_not_named_where(beginnings, heard):
    assert said(beginnings, heard) == []


@pytest.mark.parametrize("other", ["A#2", "A@2", "A@2#2"])
def test_the_second_place_of_a_moved_anchor_is_no_new_anchor(other):
    """Moved between recordings, while one was recorded, or both."""
    assert said([HERE, HERE], [("A",), (other,)], ("A", other)) == []


def named(estimate, task):
    name_new_and_absent_anchors(estimate, task)
    return list(task.stages.warnings)


def test_readings_without_a_distance_are_no_hearing_and_ranges_without_weight_are():
    """Of a recording that has too few ranges to an anchor to place it, these have no weight."""
    estimate, task = estimate_and_task([HERE, HERE], ["A", "AB"])
    first = estimate.ranges.pose < STEPS
    of_a = first & (estimate.ranges.anchor == 0)
    estimate.ranges = replace(estimate.ranges, weights=np.where(of_a, 0.0, 1.0))
    assert [w.figures["anchor"] for w in named(estimate, task)] == ["B"]
    task.stages.warnings.clear()
    estimate.ranges = replace(estimate.ranges, ranges=np.where(of_a, 0.0, 1.0))
    name_new_and_absent_anchors(estimate, task)
    assert sorted(w.figures["anchor"] for w in task.stages.warnings) == ["A", "B"]
    assert "anchor B has ranges only from recording 2 on: recording 1 drove within its reach" in task.stages.warnings[1].text
