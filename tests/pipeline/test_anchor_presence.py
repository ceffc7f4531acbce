"""Anchors of some recordings alone."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.told import warned

from uwblite.graph.graph import Graph
from uwblite.graph.range_edges import RangeEdges
from uwblite.pipeline.anchor_places import name_new_and_absent_anchors

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
    return estimate_of(graph, ranges=ranges, anchor_ids=ids), task_of(recordings_of(poses, None, recording))


def said(beginnings, heard, ids=("A", "B")):
    estimate, task = estimate_and_task(beginnings, heard, ids)
    assert name_new_and_absent_anchors(estimate, task) is estimate
    return [(w.kind, w.figures["anchor"], w.figures["recording"], w.figures["silent"]) for w in warned(task.stages)]


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
    return list(warned(task.stages))


def test_readings_without_a_distance_are_no_hearing_and_ranges_without_weight_are():
    """Of a recording that has too few ranges to an anchor to place it, these have no weight."""
    estimate, task = estimate_and_task([HERE, HERE], ["A", "AB"])
    first = estimate.ranges.pose < STEPS
    of_a = first & (estimate.ranges.anchor == 0)
    estimate = replace(estimate, ranges=replace(estimate.ranges, weights=np.where(of_a, 0.0, 1.0)))
    assert [w.figures["anchor"] for w in named(estimate, task)] == ["B"]
    task.stages.facts.clear()
    estimate = replace(estimate, ranges=replace(estimate.ranges, ranges=np.where(of_a, 0.0, 1.0)))
    name_new_and_absent_anchors(estimate, task)
    assert sorted(w.figures["anchor"] for w in warned(task.stages)) == ["A", "B"]
    assert "anchor B has ranges only from recording 2 on: recording 1 drove within its reach" in warned(task.stages)[1].text
