"""What the lidar frees, which pairs of clouds it matches, and when a map contradicts itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import walked
from helpers.planted_graphs import loop
from helpers.told import doubted

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.lidar.cloud_rasters import ScanClouds
from uwblite.pipeline import lidar_stages, neighbour_matching
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.lidar_stages import check_map_consistency
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages


def test_clouds_are_made_and_their_points_counted(monkeypatch):
    """The laser's mounting and clock are free from then on."""
    scans = ScanClouds(SimpleNamespace(points=np.zeros((7, 2))), None, 0.0)
    monkeypatch.setattr(neighbour_matching.scan_clouds, "make", lambda *_: scans)
    calibration = Calibration((UnknownKey("laser_x"), UnknownKey("odometry_scale")), np.zeros(2))
    graph = replace(loop()[0], calibration=calibration, fixed_calibration=np.ones(2, dtype=bool))
    stages = Stages(None, None)
    made = neighbour_matching.make_clouds(
        Estimate(graph, graph.edges[0], None, ()), SimpleNamespace(recordings=None, config=None, stages=stages)
    )
    assert [(s.name, s.figures) for s in stages.done] == [("clouds", {"points": 7})]
    assert made.scans is scans
    assert made.graph.fixed_calibration.tolist() == [False, True]


@pytest.mark.parametrize("torn", [False, True])
def test_a_map_whose_visits_do_not_show_the_same_place_is_doubted(torn):
    """Half of a walk lies two metres aside."""
    truth, path, clouds = walked(3)
    poses = truth.copy()
    if torn:
        poses[len(truth) // 2 :] = se2.compose(np.array([2.0, 1.0, 0.0]), truth[len(truth) // 2 :])
    stages = Stages(None, None)
    recordings = SimpleNamespace(path=path, of_keyframe=np.zeros(len(truth), dtype=np.intp))
    estimate = Estimate(Graph(poses), None, None, (), scans=ScanClouds(clouds, None, 0.0))
    assert check_map_consistency(estimate, SimpleNamespace(recordings=recordings, stages=stages)) is estimate
    assert [n.kind for n in doubted(stages)] == ["free-space-violation"] * torn


@pytest.mark.parametrize("placed", ["elsewhere", "given"])
def test_wheels_may_turn_about_another_point_where_the_place_of_the_laser_is_given(monkeypatch, placed):
    """Both explain the same residuals."""
    monkeypatch.setattr(neighbour_matching.scan_clouds, "make", lambda *_: ScanClouds(SimpleNamespace(points=()), None, 0.0))
    keys = ("sideways_per_turn", *(("laser_x",) if placed == "elsewhere" else ()))
    graph = replace(loop()[0], calibration=Calibration(tuple(map(UnknownKey, keys)), np.zeros(len(keys))))
    graph = replace(graph, fixed_calibration=np.ones(len(keys), dtype=bool))
    task = SimpleNamespace(recordings=None, config=None, stages=Stages(None, None))
    made = neighbour_matching.make_clouds(Estimate(graph, graph.edges[0], None, ()), task)
    assert made.graph.fixed_calibration.tolist() == ([True, False] if placed == "elsewhere" else [False])


def test_pairs_of_one_visit_do_not_lead_across_a_step_that_clouds_measure_falsely(monkeypatch):
    """Those between visits do: their clouds are compared at the poses that everything else gives."""
    i, j = np.array([0, 2, 3, 3, 4, 0]), np.array([1, 4, 4, 5, 5, 9])
    monkeypatch.setattr(lidar_stages.joint_refinement, "choose_pairs", lambda *_: (i, j))
    rejected = np.arange(10) == 3
    estimate = SimpleNamespace(lidar=SimpleNamespace(clouds=None), rejected=rejected)
    task = SimpleNamespace(
        recordings=SimpleNamespace(path=None, of_keyframe=None), allowed=lambda i, j: np.ones(len(i), dtype=bool)
    )
    graph, settings = SimpleNamespace(poses=None), MappingConfig().refinement
    kept = lidar_stages.pairs(estimate, graph, settings, task)
    assert list(zip(*(part.tolist() for part in kept), strict=True)) == [(0, 1), (4, 5), (0, 9)]
    estimate.rejected = None
    assert len(lidar_stages.pairs(estimate, graph, settings, task)[0]) == len(i)
