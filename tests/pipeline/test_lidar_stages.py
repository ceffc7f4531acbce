"""When the lidar's stages repeat themselves and when they end; when a map contradicts itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import loop

from uwblite.graph.graph import Calibration, UnknownKey
from uwblite.pipeline import lidar_stages
from uwblite.pipeline.estimate import Estimate, ScanClouds
from uwblite.pipeline.lidar_stages import check_map_consistency
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages


@pytest.mark.parametrize(("share", "visits", "doubted"), [(0.051, 5, True), (0.05, 5, False), (0.9, 4, False), (0.0, 9, False)])
def test_a_map_is_doubted_from_a_share_of_points_in_free_space_and_some_visits(monkeypatch, share, visits, doubted):
    """More than 5 % of the points, on five visits at least."""
    monkeypatch.setattr(lidar_stages.visibility, "free_space_violation", lambda *args: (share, visits))
    stages = Stages(None, None)
    estimate = SimpleNamespace(lidar=SimpleNamespace(clouds=None), graph=SimpleNamespace(poses=None))
    task = SimpleNamespace(recordings=SimpleNamespace(path=None, of_keyframe=None), stages=stages)
    assert check_map_consistency(estimate, task) is estimate
    assert [n.kind for n in stages.doubts] == (["free-space-violation"] if doubted else [])
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


@pytest.mark.parametrize(("clock", "made", "sigma", "late"), [
    (0.0139, 0.01, 0.0001, 0.0), (0.0141, 0.01, 0.001, 0.0041), (-0.02, 0.0, 0.006, -0.02), (-0.02, 0.0, 0.007, 0.0),
])  # fmt: skip
def test_a_clock_is_late_beyond_a_tolerance_and_three_standard_deviations(monkeypatch, clock, made, sigma, late):
    """Of 4 ms, against the offset with which the clouds were made."""
    calibration = Calibration((UnknownKey("laser_x"), UnknownKey("laser_delay")), np.array([9.0, clock]))
    covariances = SimpleNamespace(calibration=np.array([0.0, sigma]))
    monkeypatch.setattr(lidar_stages, "marginals", lambda graph: SimpleNamespace(covariances=covariances))
    graph = replace(loop()[0], calibration=calibration)
    estimate = Estimate(graph, graph.edges[0], None, (), scans=ScanClouds(None, None, made))
    assert lidar_stages._late(estimate) == pytest.approx(late)


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

    def solved(estimate, solver, optimizer=None):
        assert solver.relative_decrease > task.config.solver.relative_decrease
        made.append("quick")
        return estimate

    def matched(*given):
        assert given == (estimate, moved[0], task)
        made.append("match")
        return estimate

    monkeypatch.setattr(lidar_stages, "with_range_noise", lambda estimate, config: made.append("noise") or estimate)
    monkeypatch.setattr(lidar_stages, "_without_pattern", lambda estimate, task: made.append("pattern") or estimate)
    monkeypatch.setattr(lidar_stages, "solved", solved)
    monkeypatch.setattr(lidar_stages, "_matched_once_more", matched)
    assert lidar_stages.solve_by_own_errors(estimate, task) is estimate
    assert " ".join(made) == done
