"""From keyframes to edges of odometry: noise that grows as stated, and is what measured steps show."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted import chain, drive, odometry, wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.graph.calibration import LASER, CalibrationConfig, block, indices, odometry_indices, unknowns
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import RelativePoseEdges, ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import SQUARED
from uwblite.graph.solver import optimize
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.odometry.slips import with_slips
from uwblite.odometry.wheels import (
    OdometryNoiseConfig,
    _neighbours,
    _scale,
    by_stamps,
    displaced,
    drift_time,
    noise_at,
    redundancy,
    reestimate_wheel_noise,
    sideways_priors,
    stamp_jitter,
    turn_scales,
    variance_factors,
    wheel_edges,
)
from uwblite.sensor_log import Odometry

NOISE = OdometryNoiseConfig(distance=0.02, heading_per_metre=0.01, heading_per_turn=0.05, standing=0.001)


def test_wheel_edges_hold_the_chain_and_name_the_calibration():
    rng = np.random.default_rng(0)
    stamps, truth = wander(rng, 20.0)
    frames = select(odometry(stamps, truth, rng, noise=0.02), KeyframeConfig())
    calibration = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
    edges = wheel_edges(frames, NOISE, calibration)
    assert edges.i.tolist() == list(range(len(frames) - 1))
    np.testing.assert_array_equal(edges.j, edges.i + 1)
    graph = Graph(frames.odometry, calibration=calibration)
    np.testing.assert_allclose(edges.residuals(graph), 0.0, atol=1e-8)
    assert edges.calibration.shape == (len(edges), 8)


@pytest.mark.parametrize(("twist", "sigma"), [
    ((0.0, 0.0, 0.0), (0.001, 0.001)), ((0.5, 0.0, 0.0), (0.0200, 0.0100)), ((0.0, 0.0, 1.0), (0.001, 0.0707)),
    ((-0.5, 0.0, 1.0), (0.0200, 0.0714)),
])  # fmt: skip
def test_standard_deviations_are_those_stated(twist, sigma):
    """One edge of 2 s: over 0 or 1 m, 0 or 2 rad; 0.02 m and 0.01 rad after a metre, 0.05 rad times the root of 2 rad."""
    frames = select(Odometry(*drive([twist], [2.0])), KeyframeConfig(distance=10.0, angle=10.0))
    (root,) = wheel_edges(frames, NOISE, Calibration()).sqrt_information
    np.testing.assert_allclose(root, np.diag(np.diag(root)))
    np.testing.assert_allclose(1.0 / np.diag(root), [sigma[0], sigma[0], sigma[1]], rtol=0.01)


@settings(max_examples=25)
@given(st.integers(0, 1000))
def test_the_wheels_variance_adds_up_along_the_way(seed):
    """Variances of stretches add to that of the whole but for the standing part: cutting the way otherwise changes nothing."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 12.0)
    wheels = Odometry(stamps, truth)
    totals = []
    for distance in (0.2, 0.5):
        edges = wheel_edges(select(wheels, KeyframeConfig(distance=distance)), NOISE, Calibration())
        variance = 1.0 / np.einsum("eii->ei", edges.sqrt_information) ** 2
        totals.append((variance - NOISE.standing**2).sum(axis=0))
    np.testing.assert_allclose(totals[0], totals[1], rtol=1e-6)
    assert totals[0][0] == pytest.approx(NOISE.distance**2 * 12.0, rel=1e-3)


@pytest.mark.parametrize(("position", "heading"), [(3.0, 0.8), (1.0, 5.0), (100.0, 1.0)])
def test_the_wheels_noise_is_what_measured_steps_show(position, heading):
    """Wheels that err so many times as much as stated; most steps are measured, exactly, and some of those are outliers."""
    rng = np.random.default_rng(1)
    stamps, truth = wander(rng, 300.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    exact = wheel_edges(frames, NOISE, Calibration())
    sigma = 1.0 / np.einsum("eii->ei", exact.sqrt_information)
    wrong = se2.compose(exact.motion, rng.standard_normal((len(exact), 3)) * sigma * [position, position, heading])
    wheels, graph = replace(exact, motion=wrong), Graph(frames.odometry)
    some = np.sort(rng.permutation(len(exact))[: len(exact) // 2])
    steps_measured = exact.motion[some] + (rng.random(len(some)) < 0.1)[:, None] * np.array([0.5, 0.5, 0.3])
    steps = RelativePoseEdges(some, some + 1, steps_measured, np.tile(1e4 * np.eye(3), (len(some), 1, 1)))
    learnt = reestimate_wheel_noise(wheels, steps, graph)
    factor = np.einsum("eii->ei", exact.sqrt_information / learnt.sqrt_information.clip(1e-12))
    # Medians of 500 steps are known to 5 %; a tenth of outliers moves them by 12 %.
    assert np.median(factor[:, 0]) == pytest.approx(np.clip(position, 0.5, 10.0), rel=0.3)
    assert np.median(factor[:, 2]) == pytest.approx(np.clip(heading, 0.5, 10.0), rel=0.3)
    few = RelativePoseEdges(some[:5], some[:5] + 1, steps_measured[:5], steps.sqrt_information[:5])
    assert reestimate_wheel_noise(wheels, few, graph) is wheels


def ranged(seed, times, steps=300):
    """Return the optimum of wheels whose noise is so many times (3,) the assumed one, and of ranges to four known anchors."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 2.0 * steps)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    exact = wheel_edges(frames, replace(NOISE, kernel=SQUARED), Calibration())
    noise = rng.standard_normal((len(exact), 3)) * times / np.einsum("eii->ei", exact.sqrt_information)
    wheels = replace(exact, motion=exact.motion + noise)
    poses, anchors = frames.odometry, np.array([[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 25.0]])
    pose, anchor = (each.ravel() for each in np.meshgrid(np.arange(len(poses)), np.arange(4), indexing="ij"))
    none, sigma = np.zeros((len(pose), 2)), np.full(len(pose), 0.02)
    measured = np.hypot(*(poses[pose, :2] - anchors[anchor]).T) + rng.normal(0.0, sigma)
    ranges = RangeEdges(pose, anchor, measured, sigma, none, 0.0 * sigma, none, np.zeros(2), 0.0 * sigma,
                        np.full((len(pose), 6), -1))  # fmt: skip
    graph = Graph(poses, anchors, (wheels, ranges), fixed_anchors=np.ones(4, dtype=bool))
    return optimize(graph)[0], exact


def test_redundancy_of_wheels_is_the_trace_of_what_ranges_show_of_them():
    graph, _ = ranged(1, np.ones(3), steps=60)
    wheels, lin = graph.edges[0], [edges.linearize(graph) for edges in graph.edges]
    jacobian = np.zeros((sum(each.residuals.size for each in lin), 3 * len(graph.poses)))
    row = 0
    for each in lin:
        for name, index, columns in each.blocks:
            for e, (pose, part) in enumerate(zip(index, columns, strict=True)):
                if name == "poses":
                    first = row + e * part.shape[0]
                    jacobian[first : first + part.shape[0], 3 * pose : 3 * pose + 3] += part
        row += each.residuals.size
    own = jacobian[: 3 * len(wheels)]
    left = 1.0 - np.einsum("ri,ri->r", own @ np.linalg.inv(jacobian.T @ jacobian), own)
    expected = left.reshape(-1, 3).sum(axis=0)
    assert redundancy(graph, wheels, np.ones(len(wheels))) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("times", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0), (1.0, 2.0, 4.0), (0.6, 1.0, 0.6)])
def test_ranges_show_the_noise_of_wheels(times):
    """From any assumption, round by round; wheels that slip a few times, and are known to, are not noisy for that."""
    graph, exact = ranged(2, np.array(times))
    wheels, ranges = graph.edges
    slips = np.zeros(len(wheels))
    slips[::25] = 1.0
    slipping = replace(wheels, motion=wheels.motion + slips[:, None] * [0.3, 0.0, 0.5])
    factors = np.ones(3)
    for _ in range(6):
        own = replace(slipping, sqrt_information=exact.sqrt_information / np.sqrt(factors))
        graph = optimize(replace(graph, edges=(with_slips(own, slips), ranges)))[0]
        factors = variance_factors(graph, graph.edges[0], 1.0 - slips, factors)
    assert np.sqrt(factors) == pytest.approx(times, rel=0.2)


def test_errors_that_telescope_are_not_the_wheels():
    """Clouds that are turned each by itself, four times the wheels' noise of a step, are in two steps with opposite signs."""
    factors = []
    for seed in range(1, 5):
        rng = np.random.default_rng(seed)
        stamps, truth = wander(rng, 300.0)
        frames = select(Odometry(stamps, truth), KeyframeConfig())
        exact = wheel_edges(frames, NOISE, Calibration())
        sigma = 1.0 / np.einsum("eii->ei", exact.sqrt_information)
        noise = rng.standard_normal((len(exact), 3)) * [0.0, 0.0, 4.0 * np.median(sigma[:, 2])]
        turned = np.concatenate([np.zeros((1, 3)), noise])
        wheels = replace(exact, motion=se2.compose(exact.motion, rng.standard_normal((len(exact), 3)) * sigma))
        steps = RelativePoseEdges(exact.i, exact.j, exact.motion + np.diff(turned, axis=0), 10.0 * exact.end_sqrt_information)
        learnt = reestimate_wheel_noise(wheels, steps, Graph(frames.odometry))
        factors.append([np.einsum("eii->ei", e.sqrt_information)[0] for e in (exact, learnt)])
    # Of the sum over eight steps, two of 4 sigma are left of the clouds: a variance of 8 + 32 for 8.
    ratio = np.divide(*np.mean(factors, axis=0))
    assert ratio == pytest.approx([1.0, 1.0, np.sqrt(5.0)], rel=0.2)


@pytest.mark.parametrize(("jitter", "outliers"), [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)])
def test_jitter_of_stamps_shows_in_the_turns(jitter, outliers):
    """Scans at a slow rate in curves, some steps with a slip; without jitter the noise of the wheels shows hardly any."""
    rng = np.random.default_rng(7)
    stamps, truth = drive([(0.3, 0.0, 0.6), (0.3, 0.0, -0.6)] * 15, [10.0] * 30)
    wheels = wheel_edges(select(Odometry(stamps, truth), KeyframeConfig(distance=0.15)), NOISE, Calibration())
    rate = wheels.motion[:, 2] / wheels.duration
    late = rng.standard_normal(len(wheels) + 1) * jitter
    turned = np.append(rate, rate[-1]) * late
    noise = rng.standard_normal(len(wheels)) * 0.01 + (rng.random(len(wheels)) < outliers) * rng.standard_normal(len(wheels))
    measured = wheels.motion + np.column_stack([np.zeros((len(wheels), 2)), np.diff(turned) + noise])
    steps = RelativePoseEdges(wheels.i, wheels.j, measured, 10.0 * wheels.end_sqrt_information)
    assert stamp_jitter(wheels, steps, Graph(np.zeros((len(wheels) + 1, 3)))) == pytest.approx(jitter, rel=0.2, abs=0.01)


def test_jitter_that_few_steps_leave_open_is_not_ruled_out():
    """Beside noise of the turns that is as large: never none, and never far too much."""
    found = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        rate = 0.5 * np.ones(40)
        late = rng.standard_normal(41) * 0.1
        wheels = replace(chained(np.zeros((41, 3)), np.full(3, 0.01)), motion=rate[:, None] * [0.0, 0.0, 1.0])
        off = 0.5 * np.diff(late) + 0.1 * rng.standard_normal(40)
        steps = RelativePoseEdges(wheels.i, wheels.j, wheels.motion + off[:, None] * [0, 0, 1], wheels.sqrt_information)
        found.append(stamp_jitter(wheels, steps, Graph(np.zeros((41, 3)))))
    assert min(found) > 0.02
    assert 0.08 < np.sqrt(np.mean(np.square(found))) < 0.15


def test_late_stamps_change_steps_by_the_motion_at_both_ends():
    """A robot that changes its motion at every other scan; the covariance of 400 draws is right to about a tenth."""
    rng, jitter = np.random.default_rng(3), 0.05
    kinds = np.array([[0.4, 0.0, 0.9], [0.3, 0.0, -0.9], [0.0, 0.0, 0.6], [0.5, 0.0, 0.0]])
    twists = kinds[np.repeat(rng.integers(0, 4, 20), 2)]
    path = se2.chain(np.zeros(3), se2.exp(twists))

    def at(stamps):
        """Return poses (k, 3) where the twist is constant between whole seconds."""
        whole = np.clip(np.floor(stamps).astype(int), 0, 39)
        return se2.compose(path[whole], se2.exp(twists[whole] * (stamps - whole)[:, None]))

    stamps = np.arange(1.0, 40.0)
    wheels = replace(chained(at(stamps), np.full(3, 0.01)), duration=np.ones(38))
    stated = by_stamps(wheels, Graph(at(stamps)), jitter)
    exact, off = se2.between(at(stamps)[:-1], at(stamps)[1:]), np.zeros((400, 38, 3))
    for draw in off:
        late = at(stamps + jitter * rng.standard_normal(39))
        draw[:] = se2.between(late[:-1], late[1:]) - exact
    found = np.einsum("nei,nej->eij", off, off) / len(off)
    # Of the first step and the last, one neighbour is unknown.
    trace = np.einsum("eii->e", stated[1:-1])[:, None, None] + 1e-4 * jitter**2
    np.testing.assert_allclose((found - stated)[1:-1] / trace, 0.0, atol=0.25)
    total = stated.sum(axis=0)
    np.testing.assert_allclose(found.sum(axis=0), total, atol=0.03 * np.trace(total))
    assert by_stamps(wheels.rows(slice(0, 0)), Graph(np.zeros((1, 3))), jitter).shape == (0, 3, 3)


def test_a_slip_and_steps_that_are_off_in_a_row_are_no_late_scan():
    """A slip is not taken back; what is taken back over two steps, or by half, is not of one scan."""
    off = 0.01 * np.random.default_rng(2).standard_normal((60, 3))
    off[10] = [0.3, 0.0, 0.2]
    off[20], off[22] = [0.0, 0.0, 0.4], [0.0, 0.0, -0.4]
    off[30], off[31] = [0.3, 0.0, 0.0], [-0.1, 0.0, 0.0]
    off[40], off[41] = [0.3, 0.0, 0.1], [-0.29, 0.01, -0.11]
    assert np.flatnonzero(displaced(off)).tolist() == [40]


@pytest.mark.parametrize(("turned", "found"), [(0.22, [40]), (0.28, [])])
def test_a_displaced_scan_leaves_half_of_its_way_at_most_and_a_turn_counts_two_metres_away(turned, found):
    """A metre into it and back, and a turn that is left."""
    off = 1e-3 * np.random.default_rng(0).standard_normal((90, 3))
    off[40:42] += [[1.0, 0.0, 0.0], [-1.0, 0.0, turned]]
    assert np.flatnonzero(displaced(off)).tolist() == found


def test_directions_that_steps_do_not_see_teach_nothing_about_the_wheels():
    """Steps in a corridor repeat what the wheels count along it; across and in heading the wheels err four times as much."""
    rng = np.random.default_rng(2)
    stamps, truth = wander(rng, 300.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    exact = wheel_edges(frames, NOISE, Calibration())
    sigma = 1.0 / np.einsum("eii->ei", exact.sqrt_information)
    off = rng.standard_normal((len(exact), 3)) * sigma * 4.0
    wheels = replace(exact, motion=se2.compose(exact.motion, off))
    steps_measured = se2.compose(wheels.motion, np.column_stack([np.zeros(len(off)), se2.inverse(off)[:, 1:]]))
    blind = np.tile(np.diag([0.0, 100.0, 100.0]), (len(exact), 1, 1))
    learnt = reestimate_wheel_noise(wheels, RelativePoseEdges(exact.i, exact.j, steps_measured, blind), Graph(frames.odometry))
    factor = np.einsum("eii->ei", exact.sqrt_information)[0] / np.einsum("eii->ei", learnt.sqrt_information)[0]
    assert factor == pytest.approx([1.0, 4.0, 4.0], rel=0.2)


@pytest.mark.parametrize(("times", "factor"), [(2.0, 4.0), (20.0, 1.0)])
def test_steps_measured_much_worse_than_by_the_wheels_teach_nothing_about_these(times, factor):
    """Steps along a wall that ends out of sight differ from the wheels by their own errors."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 300.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    wheels = wheel_edges(frames, NOISE, Calibration())
    off = rng.standard_normal((len(wheels), 3)) * 4.0 / np.einsum("eii->ei", wheels.sqrt_information) * [1.0, 0.0, 0.0]
    root = wheels.end_sqrt_information / times
    steps = RelativePoseEdges(wheels.i, wheels.j, se2.compose(wheels.motion, off), root)
    learnt = reestimate_wheel_noise(wheels, steps, Graph(frames.odometry))
    along = wheels.sqrt_information[0, 0, 0] / learnt.sqrt_information[0, 0, 0]
    assert along == pytest.approx(factor, rel=0.2)


def test_steps_that_differ_more_the_worse_they_are_measured_count_where_they_are_good():
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 300.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    wheels = wheel_edges(frames, NOISE, Calibration())
    good = np.arange(len(wheels)) % 3 == 0
    times = np.where(good, 4.0, 40.0)[:, None]
    off = rng.standard_normal((len(wheels), 3)) * times / np.einsum("eii->ei", wheels.sqrt_information) * [1.0, 0.0, 0.0]
    root = wheels.end_sqrt_information / np.where(good, 2.0, 10.0)[:, None, None]
    steps = RelativePoseEdges(wheels.i, wheels.j, se2.compose(wheels.motion, off), root)
    learnt = reestimate_wheel_noise(wheels, steps, Graph(frames.odometry))
    along = wheels.sqrt_information[0, 0, 0] / learnt.sqrt_information[0, 0, 0]
    assert along == pytest.approx(4.0, rel=0.2)


@pytest.mark.parametrize("calibration", [(0.04, 0.06), (-0.05, -0.3)])
def test_noise_does_not_draw_the_wheels_scale(calibration):
    """Errors in variables: the noise of a step is as large as the step. Fitted to the true poses, scale and turn come out
    within four standard deviations of what was planted, sigma / sqrt(sum of squared steps)."""
    scale, turn = calibration
    rng = np.random.default_rng(8)
    stamps, truth = wander(rng, 600.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    names = unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool))
    exact = wheel_edges(frames, OdometryNoiseConfig(distance=0.3, heading_per_metre=0.5), block(names))
    sigma = 1.0 / np.einsum("eii->ei", exact.sqrt_information)
    noise = rng.standard_normal((len(exact), 3)) * sigma
    wheels = replace(exact, motion=exact.motion / [1 + scale, 1 + scale, 1 + turn] + noise)
    graph = Graph(truth[frames.index], calibration=block(names), fixed_poses=np.ones(len(frames), dtype=bool))
    fixed = ~graph.calibration.of_kinds("odometry_scale", "heading_scale")
    solved, _ = optimize(replace(graph, fixed_calibration=fixed).with_edges(replace(wheels, kernel=SQUARED)))
    reach = sigma[0] / np.sqrt((wheels.motion**2).sum(axis=0))
    assert solved.calibration.get("odometry_scale") == pytest.approx(scale, abs=4 * reach[0])
    assert solved.calibration.get("heading_scale") == pytest.approx(turn, abs=4 * reach[2])


@pytest.mark.parametrize("scale", [0.04, -0.05])
def test_sideways_motion_that_wheels_do_not_count_is_no_scale(scale):
    """A robot that is displaced to the side by as much as it drives ahead, whose wheels count its way without noise: the scale
    comes out within four standard deviations of what was planted."""
    rng = np.random.default_rng(8)
    stamps, truth = wander(rng, 600.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    names = unknowns(sideways_priors(Odometry(stamps, truth), CalibrationConfig()), (), np.zeros(0, dtype=bool))
    exact = wheel_edges(frames, OdometryNoiseConfig(distance=0.3, heading_per_metre=0.5), block(names))
    sigma = 1.0 / np.einsum("eii->ei", exact.sqrt_information)
    aside = np.column_stack([np.zeros(len(exact)), sigma[:, 1] * rng.standard_normal(len(exact)), np.zeros(len(exact))])
    poses = se2.chain(truth[frames.index[0]], se2.compose(exact.motion, aside))
    wheels = replace(exact, motion=exact.motion / [1 + scale, 1 + scale, 1.0])
    graph = Graph(poses, calibration=block(names), fixed_poses=np.ones(len(frames), dtype=bool))
    graph = replace(graph, fixed_calibration=~graph.calibration.of_kinds("odometry_scale"))
    solved, _ = optimize(graph.with_edges(replace(wheels, kernel=SQUARED)))
    reach = sigma[0, 0] / np.sqrt((wheels.motion[:, 0] ** 2).sum())
    assert solved.calibration.get("odometry_scale") == pytest.approx(scale, abs=4 * reach)


@pytest.mark.parametrize(("sideways", "counted"), [(0.0, False), (0.02, False), (0.045, True), (-0.4, True)])
def test_ways_to_the_side_are_calibrated_where_the_odometry_counts_some(sideways, counted):
    """A robot in curves, whose readings a second apart hold arcs and not ways to the side, drives none."""
    stamps, truth = drive([(0.3, sideways, 0.4), (0.3, sideways, -0.5)], [10.0, 10.0])
    priors = sideways_priors(Odometry(stamps[::10], truth[::10]), CalibrationConfig())
    kinds = (priors.sideways_scale, priors.sideways_per_metre, priors.ahead_per_sideways)
    assert [sigma > 0.0 for sigma in kinds] == [counted] * 3
    assert replace(priors, sideways_scale=0.1, sideways_per_metre=0.015, ahead_per_sideways=0.015) == CalibrationConfig()


def test_a_heading_drifts_for_one_second_of_a_pause():
    """Steps whose heading may have slipped count one second at most, all others their whole time."""
    slack, duration = np.zeros((4, 3)), np.array([0.4, 3600.0, 0.4, 3600.0])
    slack[:2, 2], slack[2:, 0] = 0.1, 0.1
    assert drift_time(SimpleNamespace(slack=slack, duration=duration)).tolist() == [0.4, 1.0, 0.4, 3600.0]


def test_the_slack_of_a_step_adds_to_its_variance():
    rng = np.random.default_rng(5)
    frames = select(Odometry(*wander(rng, 10.0)), KeyframeConfig())
    slack = rng.uniform(0.0, 0.3, (len(frames) - 1, 3))
    edges = (wheel_edges(f, NOISE, Calibration()) for f in (frames, replace(frames, slack=slack)))
    plain, loose = (1.0 / np.einsum("eii->ei", e.sqrt_information) ** 2 for e in edges)
    np.testing.assert_allclose(loose, plain + slack**2)


STEPS, NOISE_OF_TURNS = 400, 0.01
CALIBRATION = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
INDEX = CALIBRATION.index("heading_scale")


def found(scale, *, missed=(), frozen=(), seed=0, turned_round=False, same_way=1, calibration=CALIBRATION):
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
    wheels = chained(truth, np.full(3, NOISE_OF_TURNS))
    object.__setattr__(wheels, "calibration", odometry_indices(calibration, STEPS))
    wheels.motion[:, 2] = wheels.motion[:, 2] / (1.0 + scale) + NOISE_OF_TURNS * rng.standard_normal(STEPS)
    wheels.motion[list(missed), 2] = 0.0
    wheels.motion[list(frozen)] = 0.0
    i, j = np.arange(STEPS), np.arange(1, STEPS + 1)
    if turned_round:
        i, j = np.where(i % 2, j, i), np.where(i % 2, i, j)
    none = np.zeros((STEPS, 3))
    seen = ScanEdges(i, j, se2.between(truth[i], truth[j]), none[:, None] + np.eye(3), none, none, indices(calibration, *LASER))
    return turn_scales(wheels, seen, Graph(truth, calibration=calibration))[calibration.index("heading_scale")]


@pytest.mark.parametrize("scale", [-0.3, 0.0, 0.1, 0.8])
@pytest.mark.parametrize("turned_round", [False, True])
def test_a_constant_scale_is_recovered(scale, turned_round):
    scales = [found(scale, seed=seed, turned_round=turned_round) for seed in range(5)]
    for one in scales:
        assert abs(one.value - scale) < 4.0 * one.sigma
        assert one.sigma < 0.02 * (1.0 + scale) ** 2
        assert not one.contradicts(scale)
        assert one.contradicts(scale + 0.2)


def test_a_scale_alone_in_the_calibration_is_recovered():
    alone = block([u for u in unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)) if u.key.kind == "heading_scale"])
    assert len(alone.values) == 1
    one = found(0.1, calibration=alone)
    assert abs(one.value - 0.1) < 4.0 * one.sigma


def test_turns_the_other_way_have_a_scale_of_minus_two():
    assert found(-2.0).value == pytest.approx(-2.0, abs=0.02)


def test_turns_that_the_wheels_missed_do_not_bend_the_scale():
    bad = found(0.05, missed=range(100, 120))
    assert abs(bad.value - 0.05) < 4.0 * bad.sigma + 0.01


def test_wheels_that_freeze_have_no_other_scale():
    frozen = found(0.05, frozen=range(100, 300))
    assert abs(frozen.value - 0.05) < 4.0 * frozen.sigma


def test_few_turns_show_nothing():
    truth = np.zeros((30, 3))
    wheels = chained(truth, np.full(3, NOISE_OF_TURNS))
    none = np.zeros((0, 3))
    steps = ScanEdges(np.zeros(0, int), np.zeros(0, int), none, np.zeros((0, 3, 3)), none, none, indices(CALIBRATION, *LASER))
    assert turn_scales(wheels, steps, Graph(truth, calibration=CALIBRATION)) == {}


def test_turns_that_slip_each_by_another_amount_are_no_change_of_the_scale():
    """Forty steps turn the same way each time, by a factor of its own that scatters by 0.2: ten turns in all."""
    for seed in range(5):
        slip = np.repeat(np.random.default_rng(seed).normal(0.0, 0.2, STEPS // 40), 40)
        one = found(slip, seed=seed, same_way=40)
        assert abs(one.value) < 4.0 * one.sigma


def test_parts_of_different_scales_scatter_as_a_sample_of_them():
    """Without noise of steps: the standard deviation of the mean of eight directions, by the slope of the tangent there."""
    scales = np.array([0.9, 1.2, 1.0, 1.05, 0.95, 1.1, 1.02, 0.98])
    wheels = np.tile([0.2, -0.3], 200)
    found = _scale(np.repeat(scales, 50) * wheels, wheels)
    error = np.sqrt(np.sum((np.arctan(scales) - np.arctan(scales).mean()) ** 2) / 7.0 / 8.0)
    assert found.sigma == pytest.approx(error * (1.0 + (1.0 + found.value) ** 2))


def test_drifts_by_way_and_time_are_no_scale():
    """Wheels that turn by so much per metre and second besides, which the calibration knows, have the scale of their turns."""
    rng = np.random.default_rng(4)
    motion = np.column_stack([rng.uniform(0.0, 0.4, STEPS), np.zeros(STEPS), rng.uniform(0.1, 0.35, STEPS)])
    truth = se2.chain(np.zeros(3), motion)
    wheels = chained(truth, np.full(3, NOISE_OF_TURNS))
    duration = rng.uniform(0.1, 2.0, STEPS)
    stated = motion[:, 2] / 1.1 - 0.2 * wheels.length - 0.05 * duration
    wheels = replace(wheels, motion=np.column_stack([motion[:, :2], stated]), duration=duration)
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    values = np.zeros(len(CALIBRATION.values))
    values[wheels.calibration[0, 2:4]] = 0.2, 0.05
    none = np.zeros((STEPS, 3))
    k = np.arange(STEPS)
    seen = ScanEdges(k, k + 1, motion, none[:, None] + np.eye(3), none, none, indices(CALIBRATION, *LASER))
    scale = turn_scales(wheels, seen, Graph(truth, calibration=replace(CALIBRATION, values=values)))[INDEX]
    assert scale.value == pytest.approx(0.1, abs=1e-9)
    assert scale.sigma < 1e-9


def test_steps_that_scans_measure_as_well_are_found_up_to_the_last():
    """Of edges either way round, between consecutive keyframes alone, in the order of the odometry; none beyond its end."""
    wheels = chained(np.zeros((8, 3)), np.full(3, NOISE_OF_TURNS)).rows(np.array([0, 1, 3, 5, 6]))
    i, j = np.array([6, 4, 0, 1, 5, 2, 3]), np.array([7, 3, 2, 2, 6, 3, 2])
    turn = 0.1 * np.arange(1.0, 8.0)
    none = np.zeros((7, 3))
    steps = ScanEdges(i, j, np.column_stack([none[:, :2], turn]), none[:, None] + np.eye(3), none, none, np.full(4, -1))
    row, turned = _neighbours(wheels, steps)
    assert row.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(turned, [0.4, -0.2, 0.5, 0.1])


ASSUMED = np.array([0.01, 0.01, 0.004])
SURE = np.diag([1e8, 1e8, 1e10])


def driven(steps, noise, way, turn, seed=0):
    """Return true poses and wheels on them whose steps err by noise (3,), and whose patches by shares of the way and turns."""
    rng = np.random.default_rng(seed)
    truth = chain(np.zeros(3), np.column_stack([np.full(steps, 0.3), np.zeros(steps), 0.05 * rng.standard_normal(steps)]))
    wheels = chained(truth, ASSUMED)
    patch = np.arange(steps) // 10
    share, bend = way * rng.standard_normal(patch[-1] + 1)[patch], turn * rng.standard_normal(patch[-1] + 1)[patch]
    off = rng.standard_normal((steps, 3)) * noise
    motion = wheels.motion + off + 0.3 * np.column_stack([share, np.zeros(steps), bend])
    motion[:, :2] = se2.rotate(0.5 * (motion[:, 2] - wheels.motion[:, 2]), motion[:, :2])
    return truth, replace(wheels, motion=motion, length=np.full(steps, 0.3))


def relative_noise(wheels):
    return (1.0 / np.einsum("eii->ei", wheels.sqrt_information) / ASSUMED)[0]


@pytest.mark.parametrize(("noise", "way", "turn"), [((0.4, 0.5, 0.8), 0.02, 0.01), ((1.0, 1.0, 1.0), 0.0, 0.0)])
def test_noise_of_steps_and_what_patches_of_floor_add_to_it_is_learnt(noise, way, turn):
    """Sums over ten steps, which begin anywhere on patches of ten, hold two thirds of the variance that whole patches have."""
    truth, wheels = driven(3000, ASSUMED * noise, way, turn)
    found = noise_at(Graph(truth), wheels, np.tile(SURE, (len(truth), 1, 1)))
    patches = 10.0 / 1.5 * (0.3 * np.array([way, 0.0, turn]) / ASSUMED) ** 2
    np.testing.assert_allclose(relative_noise(found), np.sqrt(np.square(noise) + patches), rtol=0.2)


def test_poses_that_err_themselves_are_reckoned_with():
    """Poses that rays hold to 4 mm, and that follow the wheels as far as the assumed noise lets them."""
    truth, wheels = driven(4000, ASSUMED * [0.5, 0.3, 1.0], 0.0, 0.0, seed=3)
    own = np.diag([0.004, 0.004, 0.001]) ** 2
    held = truth + np.random.default_rng(4).standard_normal(truth.shape) * np.sqrt(np.diag(own))
    found = noise_at(Graph(held), wheels, np.tile(np.linalg.inv(own), (len(truth), 1, 1)))
    # Not drawn towards the wheels here, so their residuals are the larger, by 1 + v / s at most: never too small a noise.
    assert np.all(relative_noise(found) > 0.9 * np.array([0.5, 0.3, 1.0]))
    assert np.all(relative_noise(found) < 1.5)


def test_where_nothing_holds_the_poses_the_noise_stays():
    truth, wheels = driven(300, ASSUMED * 0.3, 0.0, 0.0)
    found = noise_at(Graph(truth), wheels, np.zeros((len(truth), 3, 3)))
    np.testing.assert_array_equal(found.sqrt_information, wheels.sqrt_information)
    for steps in (5, 20):
        truth, wheels = driven(steps, ASSUMED, 0.0, 0.0)
        found = noise_at(Graph(truth), wheels, np.tile(SURE, (len(truth), 1, 1)))
        np.testing.assert_array_equal(found.sqrt_information, wheels.sqrt_information)


def test_stamps_that_are_nearly_the_same_add_no_more_than_the_motion():
    """Scans of a burst are a microsecond apart; the steps between them are as large as others."""
    poses = np.column_stack([np.arange(9) * 0.2, np.zeros(9), np.zeros(9)])
    wheels = replace(chained(poses, np.full(3, 0.01)), duration=np.where(np.arange(8) % 2, 1e-6, 1.0))
    covariance = by_stamps(wheels, Graph(poses), 0.05)
    assert covariance[:, 0, 0].max() <= 2.0 * 0.2**2
    assert covariance[:, 0, 0].min() > 0.0
    assert not by_stamps(wheels, Graph(poses), 0.0).any()
