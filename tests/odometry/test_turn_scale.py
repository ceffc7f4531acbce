"""The scale of turns by steps: recovered where it is constant, not bent by one bad turn, and reported where it varies."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained

from uwblite import se2
from uwblite.graph.calibration import CalibrationConfig, block, odometry_indices, scan_indices, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.odometry.turn_scale import _independent, _neighbours, _scale, turn_scales

STEPS, NOISE = 400, 0.01
CALIBRATION = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
INDEX = CALIBRATION.index("heading_scale")


def found(scale, *, missed=(), frozen=(), seed=0, turned_round=False, same_way=1):
    """Compare wheels whose turns are to be multiplied by 1 + scale (number or one per step) with exact scans.

    missed, frozen : steps of which the wheels count no turn, or nothing. turned_round : every other edge measures i from j.
    same_way : steps in a row that turn the same way.
    """
    rng = np.random.default_rng(seed)
    motion = np.column_stack([np.full(STEPS, 0.2), np.zeros(STEPS), rng.uniform(-0.35, 0.35, STEPS)])
    motion[:, 2] = np.abs(motion[:, 2]) * np.repeat(np.sign(motion[::same_way, 2]), same_way)
    truth = np.zeros((STEPS + 1, 3))
    for k, step in enumerate(motion):
        truth[k + 1] = se2.compose(truth[k], step)
    wheels = chained(truth, np.full(3, NOISE))
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    wheels.motion[:, 2] = wheels.motion[:, 2] / (1.0 + scale) + NOISE * rng.standard_normal(STEPS)
    wheels.motion[list(missed), 2] = 0.0
    wheels.motion[list(frozen)] = 0.0
    i, j = np.arange(STEPS), np.arange(1, STEPS + 1)
    if turned_round:
        i, j = np.where(i % 2, j, i), np.where(i % 2, i, j)
    none = np.zeros((STEPS, 3))
    seen = ScanEdges(i, j, se2.between(truth[i], truth[j]), none[:, None] + np.eye(3), none, none, scan_indices(CALIBRATION))
    return turn_scales(wheels, seen, Graph(truth, calibration=CALIBRATION))[INDEX]


@pytest.mark.parametrize("scale", [-0.3, 0.0, 0.1, 0.8])
@pytest.mark.parametrize("turned_round", [False, True])
def test_a_constant_scale_is_recovered(scale, turned_round):
    scales = [found(scale, seed=seed, turned_round=turned_round) for seed in range(5)]
    for one in scales:
        assert abs(one.value - scale) < 4.0 * one.sigma
        assert one.sigma < 0.02 * (1.0 + scale) ** 2
        assert np.abs(one.stretches - scale).max() < 5.0 * one.stretch_sigma
        assert not one.contradicts(scale)
        assert one.contradicts(scale + 0.2)
        assert not one.varies


def test_turns_the_other_way_have_a_scale_of_minus_two():
    assert found(-2.0).value == pytest.approx(-2.0, abs=0.02)


def test_turns_that_the_wheels_missed_do_not_bend_the_scale():
    bad = found(0.05, missed=range(100, 120))
    assert abs(bad.value - 0.05) < 4.0 * bad.sigma + 0.01
    assert not bad.varies


def test_wheels_that_freeze_have_no_other_scale():
    frozen = found(0.05, frozen=range(100, 300))
    assert abs(frozen.value - 0.05) < 4.0 * frozen.sigma
    assert not frozen.varies


def test_a_scale_that_differs_between_stretches_varies():
    assert found(np.where(np.arange(STEPS) < STEPS // 2, 0.0, 0.5)).varies


def test_few_turns_show_nothing():
    truth = np.zeros((30, 3))
    wheels = chained(truth, np.full(3, NOISE))
    none = np.zeros((0, 3))
    steps = ScanEdges(np.zeros(0, int), np.zeros(0, int), none, np.zeros((0, 3, 3)), none, none, scan_indices(CALIBRATION))
    assert turn_scales(wheels, steps, Graph(truth, calibration=CALIBRATION)) == {}


@pytest.mark.parametrize("alike", [0.0, 0.3, 0.9])
def test_steps_of_a_turn_whose_errors_are_alike_count_for_fewer(alike):
    """The variance of a mean over turns of eight steps is that of as many independent ones, by 4,000 drawn means."""
    rng, turns, steps = np.random.default_rng(3), 60, 8
    shape = (4000, turns, 1)
    errors = np.sqrt(alike) * rng.standard_normal(shape) + np.sqrt(1.0 - alike) * rng.standard_normal((4000, turns, steps))
    turn, ones = np.repeat(np.arange(turns), steps), np.ones(turns * steps)
    counts = [_independent(one.ravel(), ones, turn) for one in errors[:50]]
    assert np.median(counts) == pytest.approx(1.0 / errors.mean(axis=(1, 2)).var(), rel=0.1)


def test_turns_that_slip_each_by_another_amount_are_no_change_of_the_scale():
    """Forty steps turn the same way each time, by a factor of its own that scatters by 0.2: ten turns in all."""
    for seed in range(5):
        slip = np.repeat(np.random.default_rng(seed).normal(0.0, 0.2, STEPS // 40), 40)
        one = found(slip, seed=seed, same_way=40)
        assert not one.varies
        assert abs(one.value) < 4.0 * one.sigma


def test_noise_of_single_steps_is_not_taken_for_errors_that_last_a_turn():
    """However long the turns are, the standard deviation is that of single steps: 0.2 up to the scatter of a correlation."""
    sigma = {n: np.median([found(0.3, seed=seed, same_way=n).sigma for seed in range(9)]) for n in (1, 8)}
    assert sigma[8] == pytest.approx(sigma[1], rel=0.3)


def test_stretches_of_different_scales_scatter_as_a_sample_of_four():
    """Without noise of steps: the standard deviation of the mean of four directions, by the slope of the tangent there."""
    scales = np.array([0.9, 1.2, 1.0, 1.05])
    wheels = np.tile([0.2, -0.3], 200)
    found = _scale(np.repeat(scales, 100) * wheels, wheels, np.arange(400))
    np.testing.assert_allclose(found.stretches, scales - 1.0, atol=1e-12)
    middle = np.arctan(1.0 + found.value)
    error = np.sqrt(np.sum((np.arctan(scales) - np.arctan(scales).mean()) ** 2) / 3.0 / 4.0)
    assert found.sigma == pytest.approx(error * (1.0 + np.tan(middle) ** 2))


def test_drifts_by_way_and_time_are_no_scale():
    """Wheels that turn by so much per metre and second besides, which the calibration knows, have the scale of their turns."""
    rng = np.random.default_rng(4)
    motion = np.column_stack([rng.uniform(0.0, 0.4, STEPS), np.zeros(STEPS), rng.uniform(0.1, 0.35, STEPS)])
    truth = se2.chain(np.zeros(3), motion)
    wheels = chained(truth, np.full(3, NOISE))
    duration = rng.uniform(0.1, 2.0, STEPS)
    stated = motion[:, 2] / 1.1 - 0.2 * wheels.length - 0.05 * duration
    wheels = replace(wheels, motion=np.column_stack([motion[:, :2], stated]), duration=duration)
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    values = np.zeros(len(CALIBRATION.values))
    values[wheels.calibration[0, 2:4]] = 0.2, 0.05
    none = np.zeros((STEPS, 3))
    k = np.arange(STEPS)
    seen = ScanEdges(k, k + 1, motion, none[:, None] + np.eye(3), none, none, scan_indices(CALIBRATION))
    scale = turn_scales(wheels, seen, Graph(truth, calibration=replace(CALIBRATION, values=values)))[INDEX]
    assert scale.value == pytest.approx(0.1, abs=1e-9)
    np.testing.assert_allclose(scale.stretches, 0.1)


def test_steps_that_scans_measure_as_well_are_found_up_to_the_last():
    """Of edges either way round, between consecutive keyframes alone, in the order of the odometry; none beyond its end."""
    wheels = chained(np.zeros((8, 3)), np.full(3, NOISE)).rows(np.array([0, 1, 3, 5, 6]))
    i, j = np.array([6, 4, 0, 1, 5, 2, 3]), np.array([7, 3, 2, 2, 6, 3, 2])
    turn = 0.1 * np.arange(1.0, 8.0)
    none = np.zeros((7, 3))
    steps = ScanEdges(i, j, np.column_stack([none[:, :2], turn]), none[:, None] + np.eye(3), none, none, np.full(4, -1))
    row, turned = _neighbours(wheels, steps)
    assert row.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(turned, [0.4, -0.2, 0.5, 0.1])
