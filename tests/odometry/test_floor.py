"""Noise of wheels and errors of patches of floor: learnt from planted ones, and their equations against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted import chain
from scipy.signal import lfilter

from uwblite import se2
from uwblite.graph.calibration import scan_indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.normal_equations import filled
from uwblite.graph.pose_edges import OdometryEdges, ScanEdges
from uwblite.graph.robust import SQUARED
from uwblite.graph.solver import optimize
from uwblite.odometry import floor

ASSUMED = np.array([0.01, 0.01, 0.004])
SURE = np.diag([1e8, 1e8, 1e10])


def driven(steps, noise, way, turn, seed=0, curves=0.05):
    """Return true poses and wheels on them whose steps err by noise (3,), and whose patches by shares of the way and turns."""
    rng = np.random.default_rng(seed)
    truth = chain(np.zeros(3), np.column_stack([np.full(steps, 0.3), np.zeros(steps), curves * rng.standard_normal(steps)]))
    wheels = chained(truth, ASSUMED)
    patch = np.arange(steps) // 10
    share, bend = way * rng.standard_normal(patch[-1] + 1)[patch], turn * rng.standard_normal(patch[-1] + 1)[patch]
    off = rng.standard_normal((steps, 3)) * noise
    motion = wheels.motion + off + 0.3 * np.column_stack([share, np.zeros(steps), bend])
    motion[:, :2] = se2.rotate(0.5 * (motion[:, 2] - wheels.motion[:, 2]), motion[:, :2])
    return truth, replace(wheels, motion=motion, length=np.full(steps, 0.3))


def relative_noise(wheels: OdometryEdges):
    return (1.0 / np.einsum("eii->ei", wheels.sqrt_information) / ASSUMED)[0]


@pytest.mark.parametrize(("noise", "way", "turn"), [((0.4, 0.5, 0.8), 0.02, 0.01), ((1.0, 1.0, 1.0), 0.0, 0.0)])
def test_noise_of_steps_and_of_patches_is_learnt_apart(noise, way, turn):
    truth, wheels = driven(3000, ASSUMED * noise, way, turn)
    found, patches = floor.learnt(wheels, Graph(truth), np.tile(SURE, (len(truth), 1, 1)))
    # Medians of 3,000 steps scatter by 2 %, those of 300 independent sums by 7 %; what stays makes a step noisier, too.
    more = np.array([np.hypot(noise[0], 0.3 * way / ASSUMED[0]), noise[1], np.hypot(noise[2], 0.3 * turn / ASSUMED[2])])
    np.testing.assert_allclose(relative_noise(found), more, rtol=0.15)
    scatter = ASSUMED[[0, 2]] / 0.3 * np.sqrt(0.1 * 0.3)
    assert np.all(np.abs(patches.sigma - [way, turn]) < 0.35 * np.array([way, turn]) + scatter)


def test_poses_that_err_themselves_are_reckoned_with():
    """Poses that rays hold to 4 mm, and that follow the wheels as far as the assumed noise lets them."""
    truth, wheels = driven(4000, ASSUMED * [0.5, 0.3, 1.0], 0.0, 0.0, seed=3)
    own = np.diag([0.004, 0.004, 0.001]) ** 2
    held = truth + np.random.default_rng(4).standard_normal(truth.shape) * np.sqrt(np.diag(own))
    found, _ = floor.learnt(wheels, Graph(held), np.tile(np.linalg.inv(own), (len(truth), 1, 1)))
    # Not drawn towards the wheels here, so their residuals are the larger, by 1 + v / s at most: never too small a noise.
    assert np.all(relative_noise(found) > 0.9 * np.array([0.5, 0.3, 1.0]))
    assert np.all(relative_noise(found) < 1.5)


def test_where_nothing_holds_the_poses_the_noise_stays():
    truth, wheels = driven(300, ASSUMED * 0.3, 0.0, 0.0)
    found, patches = floor.learnt(wheels, Graph(truth), np.zeros((len(truth), 3, 3)))
    np.testing.assert_array_equal(found.sqrt_information, wheels.sqrt_information)
    np.testing.assert_array_equal(patches.sigma, 0.0)
    few = driven(20, ASSUMED, 0.0, 0.0)
    found, _ = floor.learnt(few[1], Graph(few[0]), np.tile(SURE, (21, 1, 1)))
    np.testing.assert_array_equal(found.sqrt_information, few[1].sqrt_information)


def test_equations_are_those_of_wheels_with_unknown_patches():
    """The slope is that of half the sum of squares, by numeric derivatives; an even floor adds nothing."""
    truth, wheels = driven(25, ASSUMED, 0.02, 0.01, seed=5)
    graph = Graph(truth).with_edges(wheels)
    normal = filled(graph, subtrees=True)
    patches = replace(
        floor.even(wheels), value=np.array([[0.01, -0.02], [0.0, 0.01], [-0.03, 0.0]]), sigma=np.array([0.02, 0.01])
    )
    found = floor.equations(wheels, patches, graph, normal.unknowns)

    def cost(value, graph=graph):
        root = np.einsum("eii->ei", wheels.sqrt_information)
        residual = wheels.residuals(graph)
        residual[:, [0, 2]] += 0.3 * root[:, [0, 2]] * value[np.arange(25) // 10]
        return 0.5 * np.sum(residual**2) + 0.5 * np.sum((value / patches.sigma) ** 2)

    small = 1e-6
    for p in range(3):
        for k in range(2):
            step = np.zeros((3, 2))
            step[p, k] = small
            slope = (cost(patches.value + step) - cost(patches.value - step)) / (2.0 * small)
            assert found.own_slope[p, k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
    slope = found.slope + normal.gradient
    for number, pose, k in ((normal.unknowns.number["poses"][7, c], 7, c) for c in range(3)):
        ends = []
        for sign in (1.0, -1.0):
            poses = truth.copy()
            poses[pose, k] += sign * small
            ends.append(cost(patches.value, replace(graph, poses=poses)))
        assert slope[number] == pytest.approx((ends[0] - ends[1]) / (2.0 * small), rel=1e-4, abs=1e-2)
    even = floor.equations(wheels, floor.even(wheels), graph, normal.unknowns)
    np.testing.assert_array_equal(even.slope, 0.0)
    assert abs(even.among).sum() == 0.0


@pytest.mark.parametrize(("alike", "factor"), [(0.0, 1.0), (0.5, 2.4)])
def test_floors_inflate_what_adds_up(alike, factor):
    """White errors and those of a floor whose correlation falls to 1 / e over ten steps: the sum over many steps has
    0.75 + 0.25 * (1 + r) / (1 - r) = 5.75 times the variance of independent ones, with r = exp(-1 / 10)."""
    rng, n = np.random.default_rng(3), 8000
    correlation = np.exp(-0.1)
    carpet = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], rng.standard_normal(n))
    turn = 0.01 * (np.sqrt(1.0 - alike**2) * rng.standard_normal(n) + alike * carpet)
    steps = np.tile([0.3, 0.0, 0.0], (n, 1))
    truth = np.column_stack([0.3 * np.arange(n + 1), np.zeros(n + 1), np.zeros(n + 1)])
    wheels = chained(truth, (0.01, 0.01, 0.01))
    wheels = replace(wheels, motion=steps + turn[:, None] * [0.0, 0.0, 1.0])
    root, still = np.tile(1e4 * np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    seen = ScanEdges(np.arange(n), np.arange(1, n + 1), steps, root, still, still, scan_indices(Calibration()))
    graph = Graph(truth).with_edges(wheels, seen)
    inflated = floor.with_noise_shown(graph)
    assert inflated.poses is graph.poses
    ratio = wheels.sqrt_information[0].diagonal() / inflated.edges[0].sqrt_information[0].diagonal()
    np.testing.assert_allclose(ratio, [1.0, 1.0, factor], atol=0.25)
    assert np.all(ratio >= 1.0)


def test_steps_that_the_lidar_measured_say_nothing_of_how_errors_add_up_where_it_saw_nothing():
    """Every fourth step is measured, exactly, and the pose after forty: no ten in a row. Single errors are a quarter of what is
    stated, and all alike over forty steps, which add up to forty times theirs."""
    n = 1600
    truth = np.column_stack([0.3 * np.arange(n + 1), np.zeros(n + 1), np.zeros(n + 1)])
    exact, rng = chained(truth, (0.02, 0.02, 0.02)), np.random.default_rng(6)
    alike = 0.005 * np.repeat(rng.standard_normal(n // 40), 40)
    wheels = replace(exact, motion=exact.motion + alike[:, None] * [0.0, 0.0, 1.0], kernel=SQUARED)
    near, far = np.arange(0, n, 4), np.arange(0, n, 40)
    i, j = np.concatenate([near, far]), np.concatenate([near + 1, far + 40])
    root, still = np.tile(1e4 * np.eye(3), (len(i), 1, 1)), np.zeros((len(i), 3))
    pairs = ScanEdges(i, j, se2.between(truth[i], truth[j]), root, still, still, scan_indices(Calibration()))
    graph = Graph(truth, fixed_poses=np.arange(n + 1) == 0).with_edges(wheels, pairs)
    shown = floor.with_noise_shown(optimize(graph)[0])
    ratio = wheels.sqrt_information[0].diagonal() / shown.edges[0].sqrt_information[0].diagonal()
    assert ratio[2] == pytest.approx(0.25 * np.sqrt(30.0), rel=0.3)


@pytest.mark.parametrize("true", [0.4, 1.0, 2.5])
def test_steps_that_no_lidar_measured_err_as_their_residuals_show(true):
    """Steps that err so many times as much as stated, every second pose measured exactly: half of the residuals is checked."""
    rng, n = np.random.default_rng(4), 400
    truth = np.column_stack([0.3 * np.arange(n + 1), np.zeros(n + 1), np.zeros(n + 1)])
    exact = chained(truth, (0.02, 0.01, 0.01))
    wheels = replace(exact, motion=exact.motion + true * rng.standard_normal((n, 3)) * [0.02, 0.01, 0.01], kernel=SQUARED)
    i, still = np.arange(0, n, 2), np.zeros((n // 2, 3))
    steps, root = se2.between(truth[i], truth[i + 2]), np.tile(1e4 * np.eye(3), (n // 2, 1, 1))
    pairs = ScanEdges(i, i + 2, steps, root, still, still, scan_indices(Calibration()))
    graph = Graph(truth, fixed_poses=np.arange(n + 1) == 0).with_edges(wheels, pairs)
    shown = floor.with_noise_shown(optimize(graph)[0])
    ratio = wheels.sqrt_information[0].diagonal() / shown.edges[0].sqrt_information[0].diagonal()
    # 200 squares, of half of the variance each: known to a tenth, three times that is allowed.
    np.testing.assert_allclose(ratio, true, rtol=0.15)


def test_steps_that_nothing_checks_err_as_assumed():
    truth = np.column_stack([0.3 * np.arange(41), np.zeros(41), np.zeros(41)])
    wheels = chained(truth, (0.02, 0.01, 0.01))
    shown = floor.with_noise_shown(Graph(truth, fixed_poses=np.arange(41) == 0).with_edges(wheels))
    np.testing.assert_allclose(shown.edges[0].sqrt_information, wheels.sqrt_information, rtol=1e-6)


def test_an_even_floor_is_not_shown_where_the_lidar_sees_nothing_along_the_way():
    """A corridor with features along a tenth of it: in the rest poses follow the wheels, and residuals are none.

    Ten steps on one or two patches: 0.09 + 10 * 2 / 3 * 0.36 = 2.5 times the assumed variance; many, by three times the
    correlated part, some 6.6 times. Known from 21 sums, which alone scatter by a third.
    """
    truth, wheels = driven(3000, ASSUMED * 0.3, 0.02, 0.0, seed=7, curves=0.0)
    i, still = np.arange(3000), np.zeros((3000, 3))
    root = np.tile(1e4 * np.eye(3), (3000, 1, 1))
    root[i % 300 >= 30, 0, 0] = 0.0
    seen = ScanEdges(i, i + 1, se2.between(truth[:-1], truth[1:]), root, still, still, scan_indices(Calibration()))
    graph = Graph(truth, fixed_poses=np.arange(3001) == 0).with_edges(replace(wheels, kernel=SQUARED), seen)
    shown = floor.with_noise_shown(optimize(graph)[0])
    ratio = wheels.sqrt_information[0].diagonal() / shown.edges[0].sqrt_information[0].diagonal()
    assert ratio[0] ** 2 == pytest.approx(6.6, rel=0.6)
