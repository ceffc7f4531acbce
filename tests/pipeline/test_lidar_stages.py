"""When the lidar's stages repeat themselves and when they end; when a map contradicts itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import loop
from helpers.told import doubted

from uwblite.graph.graph import Calibration, UnknownKey
from uwblite.pipeline import lidar_stages
from uwblite.pipeline.estimate import Estimate, ScanClouds
from uwblite.pipeline.lidar_stages import check_map_consistency
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages


@pytest.mark.parametrize(("share", "visits", "said"), [(0.051, 5, True), (0.05, 5, False), (0.9, 4, False), (0.0, 9, False)])
def test_a_map_is_doubted_from_a_share_of_points_in_free_space_and_some_visits(monkeypatch, share, visits, said):
    """More than 5 % of the points, on five visits at least."""
    monkeypatch.setattr(lidar_stages.visibility, "free_space_violation", lambda *args: (share, visits))
    stages = Stages(None, None)
    estimate = SimpleNamespace(lidar=SimpleNamespace(clouds=None), graph=SimpleNamespace(poses=None))
    task = SimpleNamespace(recordings=SimpleNamespace(path=None, of_keyframe=None), stages=stages)
    assert check_map_consistency(estimate, task) is estimate
    assert [n.kind for n in doubted(stages)] == (["free-space-violation"] if said else [])
    assert stages.done[0].figures == {"visits": visits, "free_space_violation": share}


def test_clouds_are_made_and_their_points_counted(monkeypatch):
    """The laser's mounting and clock are free from then on."""
    scans = ScanClouds(SimpleNamespace(points=np.zeros((7, 2))), None, 0.0)
    monkeypatch.setattr(lidar_stages.scan_clouds, "make", lambda *_: scans)
    calibration = Calibration((UnknownKey("laser_x"), UnknownKey("odometry_scale")), np.zeros(2))
    graph = replace(loop()[0], calibration=calibration, fixed_calibration=np.ones(2, dtype=bool))
    stages = Stages(None, None)
    made = lidar_stages.make_clouds(
        Estimate(graph, graph.edges[0], None, ()), SimpleNamespace(recordings=None, config=None, stages=stages)
    )
    assert [(s.name, s.figures) for s in stages.done] == [("clouds", {"points": 7})]
    assert made.scans is scans
    assert made.graph.fixed_calibration.tolist() == [False, True]


@pytest.mark.parametrize("placed", ["elsewhere", "given"])
def test_wheels_may_turn_about_another_point_where_the_place_of_the_laser_is_given(monkeypatch, placed):
    """Both explain the same residuals."""
    monkeypatch.setattr(lidar_stages.scan_clouds, "make", lambda *_: ScanClouds(SimpleNamespace(points=()), None, 0.0))
    keys = ("sideways_per_turn", *(("laser_x",) if placed == "elsewhere" else ()))
    graph = replace(loop()[0], calibration=Calibration(tuple(map(UnknownKey, keys)), np.zeros(len(keys))))
    graph = replace(graph, fixed_calibration=np.ones(len(keys), dtype=bool))
    task = SimpleNamespace(recordings=None, config=None, stages=Stages(None, None))
    made = lidar_stages.make_clouds(Estimate(graph, graph.edges[0], None, ()), task)
    assert made.graph.fixed_calibration.tolist() == ([True, False] if placed == "elsewhere" else [False])


@pytest.mark.parametrize(("moved", "done"), [
    ((0.0005, 0.0005), "noise quick pattern"), ((0.039, 0.039), "noise quick noise pattern"),
    ((0.041, 0.0005), "noise quick match noise quick pattern"),
    ((0.041, 0.002), "noise quick match noise quick noise pattern"),
])  # fmt: skip
def test_clouds_are_matched_again_where_ranges_move_the_poses_by_four_centimetres(monkeypatch, moved, done):
    """Once; ranges show another noise where poses moved by a millimetre; all is solved roughly, since surfaces follow.

    What ranges err alike by direction is taken off last, and the adjustment to surfaces solves with that.
    """
    made, shifts = [], iter(moved)
    task = SimpleNamespace(config=MappingConfig(), stages=SimpleNamespace(report=lambda *_: None))
    estimate = SimpleNamespace(graph=SimpleNamespace(poses=None), ranges=0, joint=0, moved_since=lambda before: next(shifts))

    def solved(solver, optimizer=None):
        assert solver.relative_decrease > task.config.solver.relative_decrease
        made.append("quick")
        return estimate, None

    estimate.solved = solved

    def matched(*given):
        assert given == (estimate, moved[0], task)
        made.append("match")
        return estimate

    monkeypatch.setattr(lidar_stages, "with_range_noise", lambda estimate, config: made.append("noise") or estimate)
    monkeypatch.setattr(lidar_stages, "_without_pattern", lambda estimate, task: made.append("pattern") or estimate)
    monkeypatch.setattr(lidar_stages, "_matched_once_more", matched)
    assert lidar_stages.solve_by_own_errors(estimate, task) is estimate
    assert " ".join(made) == done


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
    kept = lidar_stages._pairs(estimate, graph, settings, task)
    assert list(zip(*(part.tolist() for part in kept), strict=True)) == [(0, 1), (4, 5), (0, 9)]
    estimate.rejected = None
    assert len(lidar_stages._pairs(estimate, graph, settings, task)[0]) == len(i)
