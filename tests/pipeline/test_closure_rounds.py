"""Rounds of loop closing: long stretches come first where ends are uncertain, and when nothing is left to find."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, HALL, chained, drifted, returned, walked
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of

from uwblite.graph.graph import Graph
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.pipeline import closure_rounds
from uwblite.pipeline.mapping_config import MappingConfig


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


@pytest.mark.parametrize(("refined", "ranges", "settled"), [(True, False, True), (False, False, False), (True, True, False)])
def test_rounds_end_early_only_where_a_joint_refinement_ties_whatever_they_would(refined, ranges, settled):
    """A walk whose poses are known to centimetres: its second round still finds closures. The joint refinement matches all that
    they would tie, but none follows where it is switched off, and none is certain where ranges alone hold the path."""
    truth, _, clouds = walked(3, HALL)
    start = drifted(np.random.default_rng(0), truth, np.array([0.006, 0.006, 0.0015]))
    anchors, pose = np.array([[-9.0, 8.0], [9.0, 7.0], [0.0, -9.0]]), np.arange(len(truth))
    anchor = pose % 3
    exact = plain_ranges(pose, anchor, np.hypot(*(truth[:, :2] - anchors[anchor]).T), 0.1)
    scans = ScanClouds(clouds, rasterize(clouds, 0.1, 1.0), 0.0)
    graph = Graph(start.poses, anchors) if ranges else Graph(start.poses)
    estimate = estimate_of(graph, odometry=start.edges[0], ranges=exact if ranges else None, scans=scans)
    config = MappingConfig()
    config = config if refined else replace(config, refinement=replace(config.refinement, rounds=0))
    task = task_of(recordings_of(truth), config)
    found = closure_rounds.close_loops(estimate, task)
    rounds = [stage.figures["accepted"] for stage in task.stages.done]
    assert rounds[0] > 20
    assert (len(rounds) == 1) is settled
    assert len(found.closures.edges) == sum(rounds)
