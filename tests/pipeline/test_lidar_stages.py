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
from uwblite.pipeline.progress import Stages


@pytest.mark.parametrize(("share", "visits", "doubted"), [(0.051, 5, True), (0.05, 5, False), (0.9, 4, False), (0.0, 9, False)])
def test_a_map_is_doubted_from_a_share_of_points_in_free_space_and_some_visits(monkeypatch, share, visits, doubted):
    """More than 5 % of the points, on five visits at least."""
    monkeypatch.setattr(lidar_stages.visibility, "free_space_violation", lambda *args: (share, visits))
    stages = Stages(None, None)
    estimate = SimpleNamespace(scans=SimpleNamespace(clouds=None), graph=SimpleNamespace(poses=None))
    task = SimpleNamespace(recordings=SimpleNamespace(path=None, of_keyframe=None), stages=stages)
    assert check_map_consistency(estimate, task) is estimate
    assert [n.kind for n in stages.doubts] == (["free-space-violation"] if doubted else [])
    assert stages.done[0].figures == {"visits": visits, "free_space_violation": share}


@pytest.mark.parametrize(("clock", "made", "sigma", "late"), [
    (0.0139, 0.01, 0.0001, 0.0), (0.0141, 0.01, 0.001, 0.0041), (-0.02, 0.0, 0.006, -0.02), (-0.02, 0.0, 0.007, 0.0),
])  # fmt: skip
def test_a_clock_is_late_beyond_a_tolerance_and_three_standard_deviations(monkeypatch, clock, made, sigma, late):
    """Of 4 ms, against the offset with which the clouds were made."""
    calibration = Calibration((UnknownKey("laser_x"), UnknownKey("laser_delay")), np.array([9.0, clock]))
    monkeypatch.setattr(lidar_stages, "marginals", lambda graph: SimpleNamespace(calibration=np.array([0.0, sigma])))
    graph = replace(loop()[0], calibration=calibration)
    estimate = Estimate(graph, graph.edges[0], None, (), scans=ScanClouds(None, None, made))
    assert lidar_stages._late(estimate) == pytest.approx(late)
