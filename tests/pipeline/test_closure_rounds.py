"""Rounds of loop closing: loops that no search can decide are a doubt."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, chained, returned
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.told import doubted

from uwblite.graph.graph import Graph
from uwblite.graph.marginals import JointCovariance
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.lidar.submaps import SubmapConfig, build, overlapping
from uwblite.pipeline import closure_rounds
from uwblite.pipeline.closure_rounds import _check_open_loops


@pytest.mark.parametrize(("far", "kinds"), [(1.0, []), (4.0, ["open-loops"]), (40.0, ["open-loops"])])
def test_places_too_uncertain_for_a_search_are_doubted(far, kinds):
    """A way back known to 1 m is within a search; one known to 40 m is beyond any, and says so as well."""
    truth, graph, path, clouds = returned(CORRIDOR, far, [1.0, 0.0, 0.0])
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = build(clouds, graph.poses, path, recording, SubmapConfig(), overlapping)
    task = task_of(recordings_of(truth, 100.0 + np.arange(len(truth))))
    stages = task.stages
    _check_open_loops(graph, JointCovariance(graph, pieces.reference), pieces, task)
    assert [notice.kind for notice in doubted(stages)] == kinds
    for notice in doubted(stages):
        assert abs(notice.figures["sigma"] - far) < 0.5 * far
        assert 0.0 <= notice.figures["first"] < notice.figures["second"] < len(truth)  # since the beginning, s


@pytest.mark.parametrize("far", [0.0, 1.0, 6.0])
def test_pairs_are_tried_once_each_and_what_does_not_match_moves_nothing(far):
    """Between bare walls no match holds."""
    truth, graph, _, clouds = returned(CORRIDOR, max(far, 1.0), [1.0, 0.0, 0.0])
    graph = graph if far else Graph(truth, edges=(chained(truth, np.full(3, 1e-4)),))
    task = task_of(recordings_of(truth))
    estimate = estimate_of(graph, scans=ScanClouds(clouds, rasterize(clouds, 0.1, 1.0), 0.0))
    closed = closure_rounds.close_loops(estimate, task)
    np.testing.assert_array_equal(closed.graph.poses, graph.poses)
    assert len(closed.closures.edges) == 0
    pairs = {(closure.i, closure.j) for closure in closed.closures.candidates}
    tried = [s.figures["candidates"] for s in task.stages.done]
    assert len(pairs) == len(closed.closures.candidates) == sum(tried) > 0
    assert [s.figures["accepted"] for s in task.stages.done] == [0] * len(tried)
