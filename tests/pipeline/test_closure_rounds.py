"""Rounds of loop closing: loops that no search can decide are a doubt."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, chained, returned
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.told import doubted

from uwblite.graph.graph import Graph
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.lidar.submaps import SubmapConfig, of_pieces
from uwblite.loop_closure.candidates import cut
from uwblite.loop_closure.closures import no_closures
from uwblite.pipeline import closure_rounds
from uwblite.pipeline.closure_rounds import _check_open_loops


@pytest.mark.parametrize(("far", "kinds"), [(1.0, []), (4.0, ["open-loops"]), (40.0, ["open-loops"])])
def test_places_too_uncertain_for_a_search_are_doubted(far, kinds):
    """A way back known to 1 m is within a search; one known to 40 m is beyond any, and says so as well."""
    truth, graph, path, clouds = returned(CORRIDOR, far, [1.0, 0.0, 0.0])
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = of_pieces(clouds, graph.poses, *cut(path, recording), SubmapConfig())
    task = task_of(recordings_of(truth, 100.0 + np.arange(len(truth))))
    stages = task.stages
    _check_open_loops(graph, no_closures(), pieces, False, task)
    assert [notice.kind for notice in doubted(stages)] == kinds
    for notice in doubted(stages):
        assert abs(notice.figures["sigma"] - far) < 0.5 * far
        assert 0.0 <= notice.figures["first"] < notice.figures["second"] < len(truth)  # since the beginning, s


@pytest.mark.parametrize(("far", "tried"), [(0.0, False), (1.0, True), (6.0, True)])
def test_long_stretches_are_tried_where_ends_are_uncertain_and_said_where_they_were(far, tried):
    """Wherever a search is needed; between bare walls no match holds, so all pairs are tried once and nothing moves."""
    truth, graph, _, clouds = returned(CORRIDOR, max(far, 1.0), [1.0, 0.0, 0.0])
    graph = graph if far else Graph(truth, edges=(chained(truth, np.full(3, 1e-4)),))
    task = task_of(recordings_of(truth))
    estimate = estimate_of(graph, scans=ScanClouds(clouds, rasterize(clouds, 0.1, 1.0), 0.0))
    base, found, pieces = closure_rounds._with_long_stretches_tied(graph, estimate, task)
    assert base is graph
    assert len(found.edges) == 0
    assert (pieces is not None) == tried
    assert [(s.name, s.figures["accepted"]) for s in task.stages.done] == [("long stretches", 0)] * tried
    if tried:
        pairs = {(closure.i, closure.j) for closure in found.candidates}
        assert len(pairs) == len(found.candidates) == task.stages.done[0].figures["candidates"] > 0
