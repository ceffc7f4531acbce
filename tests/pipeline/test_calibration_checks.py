"""A constant scale of turns is a calibration; one that a bad turn made is not used, and a map that rests on one is doubted.
Slip in turns does not bend the lidar's mounting, nor do crooked ways to the side turn it. Units of wheels; a clock's offset."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted_tasks import estimate_of, log_of, recordings_of, standing, task_of
from helpers.told import doubted, warned

from uwblite import se2
from uwblite.constraints import Constraints, GivenAnchor
from uwblite.graph.calibration import (
    LASER,
    OMNI,
    CalibrationConfig,
    block,
    indices,
    odometry_indices,
    prior_edges,
    unknowns,
    with_free,
)
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.solver import optimize
from uwblite.lidar.cloud_rasters import ScanClouds
from uwblite.pipeline import calibration_checks
from uwblite.pipeline.calibration_checks import (
    odometry_unit_factors,
    with_constant_turn_scales,
    with_slip_in_turns,
    with_units_checked,
    without_known_calibration,
)
from uwblite.pipeline.estimate import Estimate, OtherHeights
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.sensor_log import OdometryBreaks, Screening, SensorMounting

STANDING, MOMENTS = np.zeros((2, 3)), np.array([0.0, 1.0])


def screened(ratio):
    """Return the screening of a recording whose lidar measures so many times the wheels' distance; None = not screened."""
    return None if ratio is None else Screening((), OdometryBreaks.none(), lidar_by_wheels=ratio)


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
    steps = ScanEdges(i, i + 1, se2.between(truth[:-1], truth[1:]), root, none, none, indices(CALIBRATION, *LASER))
    values = CALIBRATION.values.copy()
    values[INDEX] = used
    free = np.zeros(len(values), dtype=bool)
    graph = Graph(truth, calibration=CALIBRATION, fixed_calibration=free).updated(truth, np.zeros((0, 2)), values)
    task = task_of(recordings_of(truth))
    stages = task.stages
    guarded = with_constant_turn_scales(Estimate(graph, wheels, None, ()), steps, task).graph
    return guarded.calibration.values[INDEX], bool(guarded.fixed_calibration[INDEX]), stages


@pytest.mark.parametrize("true", [0.0, 0.4])
def test_a_constant_scale_is_left_to_the_estimate(true):
    value, fixed, stages = judged(true, true + 0.02)
    assert (value, fixed, warned(stages), stages.doubts) == (true + 0.02, False, [], [])


def test_a_lidar_that_asks_for_the_larger_correction_changes_nothing():
    value, fixed, stages = judged(-0.8, 0.0)
    assert (value, fixed, warned(stages)) == (0.0, False, [])


@pytest.mark.parametrize("used", [0.25, 1.81, -0.3])
def test_a_scale_that_single_turns_made_is_replaced(used):
    value, fixed, stages = judged(0.05, used)
    assert value == pytest.approx(0.05, abs=0.02)
    assert fixed
    assert [n.kind for n in warned(stages)] == ["turn-scale"]
    figures = warned(stages)[0].figures
    assert (figures["name"], figures["by_steps"]) == ("heading_scale", value)
    assert 0.0 < figures["sigma"] < 0.02


def slipping(slip, mounted, given=True, noise=0.003):
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
    seen = se2.between(lidar[:-1], lidar[1:]) + noise * rng.standard_normal((STEPS, 3))
    steps = ScanEdges(i, i + 1, seen, np.tile(np.eye(3) / noise, (STEPS, 1, 1)), none, none, indices(CALIBRATION, *LASER))
    graph = Graph(truth, edges=(prior_edges(listed),), calibration=CALIBRATION)
    graph = with_free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), "laser_x", "laser_y")
    estimate = Estimate(graph, wheels, None, (), steps=steps)
    estimate = estimate.with_estimates_of(optimize(estimate.problem)[0])
    mounting = SensorMounting(np.array([0.2 * given, 0.0, 0.0]))
    task = task_of(recordings_of(truth, lidar=True, each=[{"mounting": mounting}]))
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


def test_an_offset_that_may_be_noise_says_nothing_of_slip():
    """Of two that are as large as the noise of the same steps allows and does not allow."""
    before, after, _ = slipping(0.0, 0.03, noise=0.05)
    assert abs(before.graph.calibration.get("laser_x")) > 0.01
    assert after is before
    before, after, _ = slipping(0.0, 0.15, noise=0.05)
    assert after is not before


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
    steps = ScanEdges(i, i + 1, seen, np.tile(np.eye(3) / 0.003, (STEPS, 1, 1)), none, none, indices(CALIBRATION, *LASER))
    graph = Graph(truth, edges=(prior_edges(listed),), calibration=CALIBRATION)
    graph = replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool))
    graph = with_free(graph, *OMNI, "laser_theta").with_edges(wheels, steps)
    solved, _ = optimize(graph)
    sigma = marginals(solved).covariances.calibration[CALIBRATION.index("laser_theta")]
    assert abs(solved.calibration.get("laser_theta")) < 2.0 * sigma
    # Which part of the angle is the lidar's, the priors alone say.
    assert 0.5 < sigma / (CalibrationConfig().ahead_per_sideways / np.sqrt(2.0)) < 1.1


@pytest.mark.parametrize(("errors", "factors"), [
    ([0.11], [1.0]), ([0.17], [1.17]), ([-0.13], [0.87]), ([None], [1.0]), ([0.05, 0.5], [1.0, 1.5]),
])  # fmt: skip
def test_wheels_are_in_another_unit_from_an_eighth_on(errors, factors):
    """Of several recordings the one is named; no factor where the scale is no unknown."""
    known = {UnknownKey("odometry_scale", recording=n): error for n, error in enumerate(errors) if error is not None}
    graph = Graph(np.zeros((2, 3)), calibration=Calibration(tuple(known), np.array([*known.values()])))
    task = task_of(standing(len(errors), each=[{"name": f"{n}.log"} for n in range(len(errors))]))
    stages = task.stages
    assert odometry_unit_factors(estimate_of(graph), task).tolist() == factors
    wrong = [n for n, factor in enumerate(factors) if factor != 1.0]
    assert [w.figures for w in warned(stages)] == [{"recording": n + 1, "factor": factors[n]} for n in wrong]
    named = [w.text.startswith(f"recording {n + 1} ({n}.log): ") for n, w in zip(wrong, warned(stages), strict=True)]
    assert named == [len(errors) > 1] * len(wrong)


@pytest.mark.parametrize(
    ("factor", "lidar", "given", "height", "warnings", "doubts"),
    [
        (1.1, None, 0, None, 0, 0),
        (1.41, None, 0, None, 1, 0),
        (2.06, None, 0, None, 0, 1),
        (0.515, None, 0, None, 0, 1),
        (0.515, 1.0, 0, None, 1, 0),
        (0.515, None, 2, None, 1, 0),
        (4.0, None, 0, None, 1, 0),
        (1.13, None, 0, None, 0, 1),
        (1.13, 1.0, 0, None, 1, 0),
        (1.13, None, 2, None, 1, 0),
        (1.1, None, 0, 4.7, 0, 0),
        (1.41, 1.0, 0, 4.7, 0, 1),
        (1.41, float("nan"), 0, 4.7, 0, 1),
        (1.41, 1.35, 0, 4.7, 1, 0),
        (0.7, None, 0, 4.7, 0, 1),
    ],
)
def test_a_factor_that_nothing_else_decides_is_a_doubt(factor, lidar, given, height, warnings, doubts):
    """Twice, half and yards may be the radio's; anchors that hang high may look like either unit, where no lidar sees the ways.

    lidar: its ways by those of the wheels, nan where it shows none, None without.
    """
    calibration = Calibration((UnknownKey("odometry_scale", recording=0),), np.array([factor - 1.0]))
    given = Constraints(anchors=tuple(GivenAnchor(name, (0.0, 0.0)) for name in "AB"[:given]))
    task = task_of(standing(lidar=lidar is not None, each=[{"screening": screened(lidar)}]), constraints=given)
    stages, other = task.stages, None if height is None else OtherHeights(height, taken=False, apart=1.0)
    estimate = estimate_of(Graph(np.zeros((2, 3)), calibration=calibration), other_heights=other)
    factors = odometry_unit_factors(estimate, task)
    assert factors == pytest.approx([factor if warnings or doubts else 1.0])
    assert (len(warned(stages)), len(doubted(stages))) == (warnings, doubts)
    assert all(("4.7 m above the tag" in notice.text) == (height is not None) for notice in doubted(stages))


@pytest.mark.parametrize(("ways", "checked"), [
    ([1.1], True), ([0.9], True), ([1.13], False), ([0.23], False), ([None], False), ([float("nan")], False),
    ([1.0, 0.95], True), ([1.0, float("nan")], False), ([1.0, 1.3], False),
])  # fmt: skip
def test_wheels_whose_ways_a_lidar_measures_are_in_metres_whatever_the_ranges_say(ways, checked):
    """None: a recording that was not screened."""
    logs = [log_of(STANDING, MOMENTS, screening=screened(way)) for way in ways]
    config = MappingConfig()
    found = with_units_checked(config, logs)
    assert (found.calibration.odometry_unit < 0.15) == checked
    assert replace(found, calibration=config.calibration) == config
    if not checked:
        assert found is config
    # What is known of the wheels the ranges do not change.
    graph = Graph(np.zeros((2, 3)), calibration=Calibration((UnknownKey("odometry_scale", recording=0),), np.array([0.4])))
    task = replace(task_of(standing()), config=found)
    assert odometry_unit_factors(estimate_of(graph), task).tolist() == ([1.0] if checked else [1.4])
    assert bool(task.stages.facts) != checked


@pytest.mark.parametrize(("late", "radio", "lidar"), [
    ([()], 0.1, 0.1), ([("scans",)], 0.1, 0.0), ([("odometry",)], 0.0, 0.0), ([(), ("odometry", "scans")], 0.0, 0.0),
])  # fmt: skip
def test_against_stamps_of_receipt_no_clock_has_an_offset(late, radio, lidar):
    logs = [log_of(STANDING, MOMENTS, lidar=True, screening=Screening((), OdometryBreaks.none(), in_bursts=s)) for s in late]
    config = MappingConfig()
    found = without_known_calibration(config, logs)
    expected = replace(config.calibration, range_delay=radio, laser_delay=lidar)
    assert found == replace(config, calibration=expected)


@pytest.mark.parametrize(("is_base", "fixed"), [([True], True), ([True, False], False), ([True, None], True), ([None], False)])
def test_a_laser_whose_poses_the_log_gives_is_where_it_is_said_to_be(is_base, fixed):
    """None: a recording without lidar."""
    mountings = [SensorMounting(laser_is_base=bool(b)) for b in is_base]
    logs = [log_of(STANDING, MOMENTS, lidar=b is not None, mounting=m) for b, m in zip(is_base, mountings, strict=True)]
    assert without_known_calibration(MappingConfig(), logs).calibration.laser_offset == (0.0 if fixed else 0.1)


WALKED, PERIOD = 400, 0.3
LISTED = unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool))
LISTED_BLOCK = block(LISTED)


def walked(offsets, made_with=0.0, noise=0.002):
    """Return the estimate of a winding walk with clouds that are late by offsets (WALKED + 1,), s, and its task."""
    rng = np.random.default_rng(4)
    turn = 0.8 * np.sin(np.arange(WALKED) / 4.0) + 0.3 * rng.standard_normal(WALKED)
    twist = np.column_stack([np.full(WALKED, 0.5), np.zeros(WALKED), turn])
    truth = se2.chain(np.zeros(3), se2.exp(PERIOD * twist))
    velocity = np.concatenate([twist, twist[-1:]])
    wheels = replace(chained(truth, (0.004, 0.004, 0.004)), motion=PERIOD * twist + 0.004 * rng.standard_normal((WALKED, 3)))
    wheels = replace(wheels, motion=se2.between(truth[:-1], truth[1:]) + 0.004 * rng.standard_normal((WALKED, 3)))
    object.__setattr__(wheels, "calibration", odometry_indices(LISTED_BLOCK, WALKED))
    seen = se2.compose(truth, se2.exp(velocity * (offsets - made_with)[:, None]))
    i = np.arange(WALKED)
    steps = ScanEdges(
        i, i + 1, se2.between(seen[:-1], seen[1:]) + noise * rng.standard_normal((WALKED, 3)),
        np.tile(np.eye(3) / noise, (WALKED, 1, 1)), velocity[:-1], velocity[1:], indices(LISTED_BLOCK, *LASER), made_with,
    )  # fmt: skip
    free = np.array([u.key.kind not in ("laser_delay", "heading_scale", "odometry_scale") for u in LISTED])
    graph = Graph(truth, edges=(prior_edges(LISTED),), calibration=LISTED_BLOCK, fixed_calibration=free)
    scans = ScanClouds(None, None, made_with)
    estimate = Estimate(graph, wheels, None, (), steps=steps, scans=scans)
    estimate = estimate.with_estimates_of(optimize(estimate.problem)[0])
    return estimate, task_of(recordings_of(truth, PERIOD * np.arange(WALKED + 1.0), lidar=True))


@pytest.mark.parametrize("offset", [0.02, -0.09, 0.15])
def test_a_constant_offset_is_taken(offset):
    late = calibration_checks.late(*walked(np.full(WALKED + 1, offset)))
    assert late == pytest.approx(offset, abs=0.1 * abs(offset) + 0.003)


def test_what_is_left_of_it_is_counted_from_that_with_which_clouds_were_made():
    assert calibration_checks.late(*walked(np.full(WALKED + 1, 0.08), made_with=0.06)) == pytest.approx(0.02, abs=0.004)
    assert calibration_checks.late(*walked(np.full(WALKED + 1, 0.08), made_with=0.08)) == 0.0


@pytest.mark.parametrize("changing", ["halves", "parts", "drift"])
def test_an_offset_that_changes_is_none(changing):
    parts = np.arange(WALKED + 1) * 8 // (WALKED + 1)
    offsets = {
        "halves": np.where(parts < 4, 0.1, 0.0),
        "parts": np.array([0.1, -0.05, 0.02, 0.12, -0.1, 0.03, 0.08, -0.06])[parts],
        "drift": np.linspace(-0.1, 0.14, WALKED + 1),
    }
    assert calibration_checks.late(*walked(offsets[changing])) == 0.0


def test_noise_and_a_clock_that_is_fixed_have_none():
    estimate, task = walked(np.zeros(WALKED + 1), noise=0.02)
    assert calibration_checks.late(estimate, task) == 0.0
    estimate, task = walked(np.full(WALKED + 1, 0.1))
    graph = replace(estimate.graph, fixed_calibration=np.ones(len(LISTED), dtype=bool))
    assert calibration_checks.late(replace(estimate, graph=graph), task) == 0.0
