"""Which hypothesis about the heights of anchors is taken, and when the other one is a doubt."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.planted import NOMINAL, drive, odometry, ranges
from helpers.planted_graphs import loop
from helpers.planted_tasks import estimate_of, task_of
from helpers.told import doubted, warned

from uwblite import se2
from uwblite.arrays import rms_length
from uwblite.constraints import Constraints
from uwblite.graph.calibration import HEIGHT
from uwblite.graph.graph import Graph
from uwblite.graph.solver import Optimizer
from uwblite.pipeline import radio_stages, range_alternatives
from uwblite.pipeline.estimate import Estimate, OtherHeights, Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.range_alternatives import check_heights
from uwblite.pipeline.recordings import gather
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.sensor_log import SensorLog


@pytest.mark.parametrize(("apart", "lidar", "doubts"), [(None, False, 0), (0.39, False, 0), (0.41, False, 1), (0.41, True, 0)])
@pytest.mark.parametrize("taken", [False, True])
def test_heights_that_make_another_trajectory_are_a_doubt_without_a_lidar(apart, lidar, taken, doubts):
    task = task_of(lidar=lidar)
    stages, other = task.stages, None if apart is None else OtherHeights(4.7, taken, apart)
    check_heights(estimate_of(Graph(np.zeros((2, 3))), other_heights=other), task)
    assert [d.kind for d in doubted(stages)] == ["anchor-heights"] * doubts
    assert not warned(stages)
    for doubt in doubted(stages):
        assert "4.7 m above the tag" in doubt.text
        assert ("taken as high" in doubt.text) == taken


PLACES = np.array([[9.0, 14.0], [-8.0, 2.0], [3.0, -4.0]])


def round_trip(height: float, unit: float) -> tuple[SensorLog, np.ndarray]:
    """Return a drive on a circle of 8 m radius past three anchors, wheels in units of so many metres, and the truth."""
    rng = np.random.default_rng(3)
    stamps, truth = drive([[0.7, 0.0, 0.7 / 8.0]], [72.0])
    radio = ranges(rng, stamps, truth, PLACES, rate=1.0, sigma=0.05)
    radio = replace(radio, ranges=np.hypot(radio.ranges, height))
    return SensorLog(odometry(stamps, truth, rng, scale=1.0 / unit, noise=0.01, turn_noise=0.01), radio, None, NOMINAL), truth


@pytest.mark.slow
@pytest.mark.parametrize(("height", "unit"), [(4.5, 1.0), (6.0, 1.0), (0.0, 1.0), (1.0, 1.3), (0.0, 1.5)])
def test_anchors_that_hang_high_are_told_from_wheels_in_another_unit(height, unit):
    """On a round the ranges' curvature alone tells them apart: the path has the right size, and low anchors stay low."""
    config = MappingConfig()
    log, truth = round_trip(height, unit)
    task = Task(gather([log], config.keyframes), config, Constraints(), Stages(None, None))
    estimate = radio_stages.first_optimisation(task)
    cal, found = estimate.graph.calibration, estimate.graph.poses[:, :2]
    true = np.column_stack([np.interp(task.recordings.stamps, log.odometry.stamps, column) for column in truth[:, :2].T])
    assert rms_length(se2.transform(se2.align(found, true), found) - true) < 0.15
    assert cal.get("odometry_scale") == pytest.approx(unit - 1.0, abs=0.02)
    heights = np.sqrt(cal.values[cal.of_kinds(HEIGHT)])
    if height > 1.0:
        assert heights == pytest.approx(np.full(3, height), abs=0.5)
        assert estimate.other_heights is None or estimate.other_heights.taken
    else:
        assert np.all(heights < 1.5)
        assert estimate.other_heights is None


def test_without_heights_to_find_nothing_is_compared():
    graph = loop()[0]
    estimate = Estimate(graph, graph.edges[0], None, ())
    assert range_alternatives.choose_heights(estimate, MappingConfig()) is estimate


@cache
def alone(height: float) -> Estimate:
    """Return the estimate of the round trip alone, at its optimum by low anchors."""
    config, (log, truth) = MappingConfig(), round_trip(height, 1.0)
    task = task_of(gather([log], config.keyframes))
    wheels = radio_stages.dead_reckoning(task.recordings.each[0], config)
    true = se2.interpolate_trajectory(log.odometry.stamps, truth, task.recordings.stamps)
    graph, yes = replace(wheels.graph, poses=true, anchors=PLACES), np.ones(3, dtype=bool)
    return replace(wheels, graph=graph, bootstrap=BootstrapResult(graph, yes, ((),) * 3, ~yes)).solved(config.solver)[0]


@pytest.mark.parametrize(("heights", "ids", "refuted"), [
    ([0.0], ["ABC"], False),
    ([0.0] * 4, ["ABC", "DEF", "GHI", "JKL"], True),
    ([0.0] * 4, ["ABC", "DEF", "GHI", "ABC"], True),
    ([0.0] * 4, ["ABC", "ABC", "BCA", "AB"], False),
    ([0.0] * 4 + [4.5], ["ABC", "DEF", "GHI", "JKL", "MNO"], False),
])  # fmt: skip
def test_recordings_refute_high_anchors_together_each_that_has_other_anchors(heights, ids, refuted):
    """Three low anchors of one round are no proof: the odds of recordings of other anchors are multiplied."""
    log_odds = [range_alternatives._high_anchors(alone(h), MappingConfig(), Optimizer()).log_odds for h in (0.0, 4.5)]
    assert -15.0 < log_odds[0] < -5.0 < 20.0 < log_odds[1]
    each = [replace(alone(height), anchor_ids=tuple(own)) for height, own in zip(heights, ids, strict=True)]
    assert range_alternatives._refuted(each, MappingConfig()) is refuted
    assert not range_alternatives._refuted([replace(own, ranges=None) for own in each], MappingConfig())


def test_lengths_that_a_wrong_unit_stretched_are_scaled_back_where_anchors_are_raised():
    graph = alone(0.0).problem
    scales = graph.calibration.of_kinds("odometry_scale")
    values = np.where(scales, 0.25, graph.calibration.values)
    stretched = graph.updated(graph.poses * np.array([1.25, 1.25, 1.0]), 1.25 * graph.anchors, values)
    raised = range_alternatives.raise_anchors(stretched, MappingConfig().calibration)
    np.testing.assert_allclose(raised.poses, graph.poses, atol=1e-12)
    np.testing.assert_allclose(raised.anchors, graph.anchors, atol=1e-12)
    assert not raised.calibration.values[scales].any()
