"""A constant scale of turns is a calibration; one that a bad turn made is not used, and a map that rests on one is doubted.
Slip in turns does not bend the lidar's mounting, nor do crooked ways to the side turn it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.told import warned

from uwblite import se2
from uwblite.assessment.drift_tests import check_turn_scales
from uwblite.graph.calibration import (
    OMNI,
    CalibrationConfig,
    block,
    odometry_indices,
    prior_edges,
    scan_indices,
    unknowns,
    with_free,
)
from uwblite.graph.graph import Graph
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.solver import optimize
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.turn_checks import with_constant_turn_scales, with_slip_in_turns
from uwblite.sensor_log import SensorMounting

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
    stages.findings.extend(check_turn_scales(Estimate(graph.with_edges(wheels, steps), wheels, None, ()), task))
    return guarded.calibration.values[INDEX], bool(guarded.fixed_calibration[INDEX]), stages


@pytest.mark.parametrize("true", [0.0, 0.4])
def test_a_constant_scale_is_left_to_the_estimate(true):
    value, fixed, stages = judged(true, true + 0.02)
    assert (value, fixed, warned(stages), stages.doubts) == (true + 0.02, False, [], [])


def test_a_lidar_that_asks_for_the_larger_correction_is_doubted_only():
    value, fixed, stages = judged(-0.8, 0.0)
    assert (value, fixed, warned(stages)) == (0.0, False, [])
    assert [n.kind for n in stages.doubts] == ["turn-scale"]


@pytest.mark.parametrize("used", [0.25, 1.81, -0.3])
def test_a_scale_that_single_turns_made_is_replaced_and_a_map_with_it_doubted(used):
    value, fixed, stages = judged(0.05, used)
    assert value == pytest.approx(0.05, abs=0.02)
    assert fixed
    assert [n.kind for n in warned(stages)] == ["turn-scale"]
    assert [n.kind for n in stages.doubts] == ["turn-scale"]
    assert stages.doubts[0].figures["by_all"] == used
    figures = warned(stages)[0].figures
    assert (figures["name"], figures["by_steps"]) == ("heading_scale", value)
    assert 0.0 < figures["sigma"] < 0.02


def slipping(slip, mounted, given=True):
    """Return an estimate before and after, and true poses, of wheels that turn about (-slip, 0) under a lidar mounted so far
    ahead of its place; the true poses are as the wheels count but for the slip."""
    rng = np.random.default_rng(5)
    listed = unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool))
    motion = np.column_stack([np.full(STEPS, 0.2), np.zeros(STEPS), rng.uniform(-0.35, 0.35, STEPS)])
    half = 0.5 * motion[:, 2:]
    aside = np.hstack([-np.sin(half), np.cos(half)]) * 2.0 * slip * np.sin(half)
    truth = se2.chain(np.zeros(3), motion + np.column_stack([aside, np.zeros(STEPS)]))
    lidar = se2.compose(truth, np.array([mounted, 0.0, 0.0]))
    wheels = replace(chained(truth, (0.005, 0.005, 0.005)), motion=motion + 0.005 * rng.standard_normal((STEPS, 3)))
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    i, none = np.arange(STEPS), np.zeros((STEPS, 3))
    seen = se2.between(lidar[:-1], lidar[1:]) + 0.003 * rng.standard_normal((STEPS, 3))
    steps = ScanEdges(i, i + 1, seen, np.tile(np.eye(3) / 0.003, (STEPS, 1, 1)), none, none, scan_indices(CALIBRATION))
    graph = Graph(truth, edges=(prior_edges(listed),), calibration=CALIBRATION)
    graph = with_free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), "laser_x", "laser_y")
    estimate = Estimate(graph, wheels, None, (), steps=steps)
    estimate = estimate.with_estimates_of(optimize(estimate.problem)[0])
    mounting = SensorMounting(np.array([0.2 * given, 0.0, 0.0]))
    recording = SimpleNamespace(has_scans=True, log=SimpleNamespace(mounting=mounting))
    task = SimpleNamespace(recordings=SimpleNamespace(each=[recording]), config=MappingConfig())
    return estimate, with_slip_in_turns(estimate, task), truth


@pytest.mark.parametrize("slip", [0.12, -0.2])
def test_slip_in_turns_does_not_bend_a_given_mounting(slip):
    before, after, truth = slipping(slip, 0.0)
    assert before.graph.calibration.get("laser_x") == pytest.approx(slip, abs=0.01)
    assert after.graph.calibration.get("sideways_per_turn") == pytest.approx(slip, abs=0.03)
    assert after.graph.calibration.get("laser_x") == pytest.approx(0.0, abs=0.03)
    off = after.graph.poses - truth
    covariance = marginals(after.problem).covariances.poses
    whitened = np.einsum("ni,ni->n", off[1:], np.linalg.solve(covariance[1:], off[1:, :, None])[:, :, 0])
    assert whitened.mean() < 6.0


@pytest.mark.parametrize(("offset", "share"), [(0.02, 0.12), (0.05, 0.27), (0.12, 0.83)])
def test_what_slip_and_mounting_explain_alike_is_shared_by_their_odds_and_stated_so(offset, share):
    """The share of a normal value of 0.15 m, half as likely beforehand as one of 0.03 m or, one in ten, 0.1 m. Neither has a
    prior narrower than a centimetre."""
    _, after, _ = slipping(0.0, offset)
    calibration = after.graph.calibration
    slip, mounting = (max(np.sqrt(part) * offset, 0.01) for part in (share, 1.0 - share))
    most = np.hypot(slip, mounting)
    assert calibration.get("sideways_per_turn") == pytest.approx(offset * (slip / most) ** 2, abs=0.004)
    assert calibration.get("laser_x") == pytest.approx(offset * (mounting / most) ** 2, abs=0.004)
    both = [calibration.index("laser_x"), calibration.index("sideways_per_turn")]
    sigma = marginals(after.problem).covariances.calibration[both]
    np.testing.assert_allclose(sigma, slip * mounting / most, rtol=0.1)


@pytest.mark.parametrize(("slip", "given"), [(0.0, True), (0.1, False)])
def test_a_robot_that_turns_about_its_origin_or_has_none_keeps_its_estimate(slip, given):
    before, after, _ = slipping(slip, 0.0, given)
    assert after is before


@pytest.mark.parametrize("crooked", [0.02, -0.02])
def test_wheels_that_go_crooked_to_the_side_do_not_turn_the_lidar(crooked):
    """Ways ahead and to the side that are crooked by different angles; one angle and a turned lidar explain both as well."""
    rng = np.random.default_rng(6)
    listed = unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool))
    truth = se2.chain(np.zeros(3), np.column_stack([rng.uniform(-0.3, 0.3, (STEPS, 2)), np.zeros(STEPS)]))
    motion = se2.between(truth[:-1], truth[1:])
    motion[:, 0] += crooked * motion[:, 1]
    wheels = replace(chained(truth, (0.005, 0.005, 0.005)), motion=motion + 0.005 * rng.standard_normal((STEPS, 3)))
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    i, none = np.arange(STEPS), np.zeros((STEPS, 3))
    seen = se2.between(truth[:-1], truth[1:]) + 0.003 * rng.standard_normal((STEPS, 3))
    steps = ScanEdges(i, i + 1, seen, np.tile(np.eye(3) / 0.003, (STEPS, 1, 1)), none, none, scan_indices(CALIBRATION))
    graph = Graph(truth, edges=(prior_edges(listed),), calibration=CALIBRATION)
    graph = replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool))
    graph = with_free(graph, *OMNI, "laser_theta").with_edges(wheels, steps)
    solved, _ = optimize(graph)
    sigma = marginals(solved).covariances.calibration[CALIBRATION.index("laser_theta")]
    assert abs(solved.calibration.get("laser_theta")) < 2.0 * sigma
    # Which part of the angle is the lidar's, the priors alone say.
    assert 0.5 < sigma / (CalibrationConfig().ahead_per_sideways / np.sqrt(2.0)) < 1.1
