"""A constant scale of turns is a calibration; one that a bad turn made is not used, and a map that rests on one is doubted."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained

from uwblite import se2
from uwblite.graph.calibration import CalibrationConfig, block, odometry_indices, scan_indices, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.turn_checks import check_turn_scales, with_constant_turn_scales

CALIBRATION = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
INDEX = CALIBRATION.index("heading_scale")
STEPS = 200


def judged(true, used):
    """Return the value and its state, warnings and doubts for wheels of a true scale and an estimate that uses another."""
    rng = np.random.default_rng(3)
    motion = np.column_stack([np.full(STEPS, 0.2), np.zeros(STEPS), rng.uniform(-0.35, 0.35, STEPS)])
    truth = np.zeros((STEPS + 1, 3))
    for k, step in enumerate(motion):
        truth[k + 1] = se2.compose(truth[k], step)
    wheels = chained(truth, np.full(3, 0.01))
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    wheels.motion[:, 2] = wheels.motion[:, 2] / (1.0 + true) + 0.005 * rng.standard_normal(STEPS)
    i, none = np.arange(STEPS), np.zeros((STEPS, 3))
    root = np.zeros((STEPS, 3, 3)) + np.eye(3)
    steps = ScanEdges(i, i + 1, se2.between(truth[:-1], truth[1:]), root, none, none, scan_indices(CALIBRATION))
    values = CALIBRATION.values.copy()
    values[INDEX] = used
    free = np.zeros(len(values), dtype=bool)
    graph = Graph(truth, calibration=CALIBRATION, fixed_calibration=free).updated(truth, np.zeros((0, 2)), values)
    stages = Stages(None, None)
    task = SimpleNamespace(stages=stages)
    guarded = with_constant_turn_scales(Estimate(graph, wheels, None, (), steps=steps), task).graph
    check_turn_scales(Estimate(graph.with_edges(wheels, steps), wheels, None, ()), task)
    return guarded.calibration.values[INDEX], bool(guarded.fixed_calibration[INDEX]), stages


@pytest.mark.parametrize("true", [0.0, 0.4])
def test_a_constant_scale_is_left_to_the_estimate(true):
    value, fixed, stages = judged(true, true + 0.02)
    assert (value, fixed, stages.warnings, stages.doubts) == (true + 0.02, False, [], [])


def test_a_lidar_that_asks_for_the_larger_correction_is_doubted_only():
    value, fixed, stages = judged(-0.8, 0.0)
    assert (value, fixed, stages.warnings) == (0.0, False, [])
    assert [n.kind for n in stages.doubts] == ["turn-scale"]


@pytest.mark.parametrize("used", [0.25, 1.81, -0.3])
def test_a_scale_that_single_turns_made_is_replaced_and_a_map_with_it_doubted(used):
    value, fixed, stages = judged(0.05, used)
    assert value == pytest.approx(0.05, abs=0.02)
    assert fixed
    assert [n.kind for n in stages.warnings] == ["turn-scale"]
    assert [n.kind for n in stages.doubts] == ["turn-scale"]
    assert stages.doubts[0].figures["by_all"] == used
    figures = stages.warnings[0].figures
    assert (figures["name"], figures["by_steps"]) == ("heading_scale", value)
    assert 0.0 < figures["sigma"] < 0.02
