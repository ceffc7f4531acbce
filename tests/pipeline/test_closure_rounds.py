"""Rounds of loop closing: loops that no search can decide are a doubt."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, returned
from helpers.told import doubted

from uwblite.graph.pose_edges import OdometryEdges
from uwblite.lidar.joint_refinement import RefinementConfig
from uwblite.lidar.submaps import SubmapConfig, of_pieces
from uwblite.loop_closure.closures import LoopClosureConfig, no_closures
from uwblite.loop_closure.long_stretches import cut
from uwblite.pipeline import closure_rounds
from uwblite.pipeline.closure_rounds import _check_open_loops
from uwblite.pipeline.estimate import Estimate, ScanClouds
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages


@pytest.mark.parametrize(("far", "kinds"), [(1.0, []), (4.0, ["open-loops"]), (40.0, ["open-loops"])])
def test_places_too_uncertain_for_a_search_are_doubted(far, kinds):
    """A way back known to 1 m is within a search; one known to 40 m is beyond any, and says so as well."""
    truth, graph, path, clouds = returned(CORRIDOR, far, [1.0, 0.0, 0.0])
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = of_pieces(clouds, graph.poses, *cut(path, recording), SubmapConfig())
    recordings = SimpleNamespace(stamps=100.0 + np.arange(len(truth)), of_keyframe=recording)
    stages = Stages(None, None)
    task = SimpleNamespace(recordings=recordings, config=SimpleNamespace(loop_closure=LoopClosureConfig()), stages=stages)
    _check_open_loops(graph, no_closures(), pieces, False, task)
    assert [notice.kind for notice in doubted(stages)] == kinds
    for notice in doubted(stages):
        assert abs(notice.figures["sigma"] - far) < 0.5 * far
        assert 0.0 <= notice.figures["first"] < notice.figures["second"] < len(truth)  # since the beginning, s


@pytest.mark.parametrize(("far", "tried"), [(1.0, False), (6.0, True)])
def test_long_stretches_are_tried_where_ends_are_uncertain_and_said_where_they_were(monkeypatch, far, tried):
    """Of a way back known to 6 m; no match holds, so all pairs are tried once and nothing moves."""
    truth, graph, path, clouds = returned(CORRIDOR, far, [1.0, 0.0, 0.0])
    recording, asked = np.zeros(len(truth), dtype=np.intp), []

    def find(pairs, *others):
        asked.append(pairs.names(LoopClosureConfig()))
        return no_closures()

    monkeypatch.setattr(closure_rounds.verification, "find", find)
    stages = Stages(None, None)
    recordings = SimpleNamespace(stamps=np.arange(len(truth)), of_keyframe=recording, path=path)
    task = SimpleNamespace(
        recordings=recordings, config=MappingConfig(), stages=stages, executor=None,
        allowed=lambda i, j: np.ones(len(i), dtype=bool),
    )  # fmt: skip
    estimate = SimpleNamespace(lidar=SimpleNamespace(clouds=clouds), ranges=None)
    base, found, pieces = closure_rounds._with_long_stretches_tied(graph, no_closures(), estimate, task)
    assert base is graph
    assert len(found.edges) == 0
    assert (pieces is not None) == bool(asked) == tried
    assert [(s.name, s.figures["candidates"], s.figures["accepted"]) for s in stages.done] == (
        [("long stretches", len(set().union(*asked)), 0)] if tried else []
    )
    assert sum(map(len, asked)) == len(set().union(*asked))


def rounds_and_sub_maps_made(monkeypatch, certain, by, config):
    """Return how many rounds are made, and sub-maps, where each moves every other keyframe aside by so much, m.

    A way back is known to 1 m and 0.03 rad; where it is certain, to a hundredth of that.
    """
    truth, graph, path, clouds = returned(CORRIDOR, 1.0, [0.0, 0.0, 0.0])
    if certain:
        graph.edges[0].sqrt_information[74] *= 100.0
    made, build = [], closure_rounds.submaps.build
    monkeypatch.setattr(closure_rounds.submaps, "build", lambda *given: made.append(given) or build(*given))
    again = SimpleNamespace(edges=np.zeros(3), candidates=())

    def reconciled(graph, *_):
        poses = graph.poses.copy()
        poses[::2, 1] += by
        return graph.updated(poses, graph.anchors, graph.calibration.values), no_closures()

    monkeypatch.setattr(closure_rounds, "_verified", lambda *_: again)
    monkeypatch.setattr(closure_rounds.closure_candidates, "missed", lambda *_: set())
    monkeypatch.setattr(closure_rounds.closures, "merged", lambda found, new: found)
    monkeypatch.setattr(closure_rounds.verification, "reconcile", reconciled)
    recordings = SimpleNamespace(stamps=np.arange(len(truth)), of_keyframe=np.zeros(len(truth), dtype=np.intp), path=path)
    task = SimpleNamespace(recordings=recordings, config=config, stages=Stages(None, None), executor=None)
    odometry = next(e for e in graph.edges if isinstance(e, OdometryEdges))
    estimate = Estimate(graph, odometry, None, (), scans=ScanClouds(clouds, None, 0.0))
    closure_rounds.close_loops(estimate, task)
    return len(task.stages.done), len(made)


WITHOUT_REFINEMENT = replace(MappingConfig(), refinement=RefinementConfig(rounds=0))


@pytest.mark.parametrize(("by", "built"), [(0.003, 1), (0.1, 4)])
def test_sub_maps_are_made_again_where_closures_bent_them(monkeypatch, by, built):
    assert rounds_and_sub_maps_made(monkeypatch, False, by, WITHOUT_REFINEMENT) == (4, built)


@pytest.mark.parametrize(
    ("certain", "by", "config", "rounds"),
    [
        (True, 0.003, MappingConfig(), 1),
        (True, 0.003, WITHOUT_REFINEMENT, 4),
        (True, 1.0, MappingConfig(), 4),
        (False, 0.003, MappingConfig(), 2),
    ],
)
def test_one_round_is_enough_where_the_joint_refinement_matches_the_rest(monkeypatch, certain, by, config, rounds):
    """Not where there is none, where poses move by more than its gate, or where pairs had to be searched for."""
    assert rounds_and_sub_maps_made(monkeypatch, certain, by, config)[0] == rounds
