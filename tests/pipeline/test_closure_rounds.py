"""Rounds of loop closing: long stretches come first where ends are uncertain."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, chained, returned
from helpers.planted_tasks import estimate_of, recordings_of, task_of

from uwblite.graph.graph import Graph
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.pipeline import closure_rounds


@pytest.mark.parametrize(("far", "tried"), [(0.0, False), (1.0, True), (6.0, True)])
def test_long_stretches_are_tried_where_ends_are_uncertain_and_said_where_they_were(far, tried):
    """Wherever a search is needed; between bare walls no match holds, so all pairs are tried once and nothing moves."""
    truth, graph, _, clouds = returned(CORRIDOR, max(far, 1.0), [1.0, 0.0, 0.0])
    graph = graph if far else Graph(truth, edges=(chained(truth, np.full(3, 1e-4)),))
    task = task_of(recordings_of(truth))
    estimate = estimate_of(graph, scans=ScanClouds(clouds, rasterize(clouds, 0.1, 1.0), 0.0))
    base, found = closure_rounds._with_long_stretches_tied(graph, estimate, task)
    assert base is graph
    assert len(found.edges) == 0
    assert [(s.name, s.figures["accepted"]) for s in task.stages.done] == [("long stretches", 0)] * tried
    if tried:
        pairs = {(closure.i, closure.j) for closure in found.candidates}
        assert len(pairs) == len(found.candidates) == task.stages.done[0].figures["candidates"] > 0
