"""Rounds of loop closing: pairs of sub-maps are tried once, the likeliest first."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, chained, returned
from helpers.planted_tasks import estimate_of, recordings_of, task_of

from uwblite.graph.graph import Graph
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.pipeline import closure_rounds


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
