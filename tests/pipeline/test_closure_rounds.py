"""Rounds of loop closing: loops that no search can decide are a doubt."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, returned
from helpers.told import doubted

from uwblite.lidar.submaps import SubmapConfig, of_pieces
from uwblite.loop_closure.closures import LoopClosureConfig, no_closures
from uwblite.loop_closure.long_stretches import cut
from uwblite.pipeline import closure_rounds
from uwblite.pipeline.closure_rounds import _check_open_loops
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


@pytest.mark.parametrize(("far", "direct", "tried"), [(1.0, 20.0, False), (1.0, 0.5, True), (6.0, 0.5, True)])
def test_long_stretches_are_tried_where_ends_are_uncertain_and_said_where_they_were(monkeypatch, far, direct, tried):
    """Wherever a search is needed; no match holds, so all pairs are tried once and nothing moves."""
    truth, graph, path, clouds = returned(CORRIDOR, far, [1.0, 0.0, 0.0])
    recording, asked = np.zeros(len(truth), dtype=np.intp), []

    def find(pairs, *others):
        asked.append(pairs.names(LoopClosureConfig()))
        return no_closures()

    monkeypatch.setattr(LoopClosureConfig, "direct", direct)
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
