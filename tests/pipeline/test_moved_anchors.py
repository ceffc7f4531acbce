"""When two recordings' places of an anchor are not the same."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges

from uwblite.graph.graph import Graph
from uwblite.pipeline import moved_anchors
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.moved_anchors import _LEAST_MOVE, _MOVED, _differ, separate_moved_anchors
from uwblite.pipeline.progress import Stages
from uwblite.radio.bootstrap import BootstrapResult


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
    monkeypatch.setattr(moved_anchors, "refine_jointly", lambda estimate, task: estimate)
    yes = np.ones(2, dtype=bool)
    graph = Graph(np.zeros((3, 3)), np.array([[0.0, 0.0], [5.0, 0.0]]))
    ranges = plain_ranges(recording, anchor, np.ones(6), 0.1)
    bootstrap = BootstrapResult(graph, yes, (("a",), ("b",)), ~yes)
    recordings = type("Recordings", (), {"of_keyframe": np.arange(3), "__len__": lambda self: 3})()
    stages = Stages(None, None)
    task = SimpleNamespace(recordings=recordings, config=MappingConfig(), stages=stages)
    estimate = separate_moved_anchors(Estimate(graph, None, ranges, ("A", "B"), bootstrap), task)
    assert estimate.anchor_ids == ("A", "B", "B#2")
    assert estimate.ranges.anchor.tolist() == [0, 1, 0, 2, 0, 2]
    np.testing.assert_array_equal(estimate.graph.anchors, [[0.0, 0.0], [5.0, 0.0], [9.0, 0.0]])
    assert (estimate.bootstrap.hypotheses, estimate.placed.tolist()) == ((("a",), ("b",), ()), [True] * 3)
    assert [(w.figures["anchor"], w.figures["recording"], w.figures["new_id"]) for w in stages.warnings] == [
        ("B", 2, "B#2"), ("B", 3, "B#2"),
    ]  # fmt: skip
