"""Noise of wheels and errors of patches of floor: learnt from planted ones, and their equations against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted import chain

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.normal_equations import filled
from uwblite.graph.pose_edges import OdometryEdges
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


def test_the_certainty_of_poses_is_turned_into_their_own_frames():
    rng = np.random.default_rng(2)
    poses = rng.uniform(-3.0, 3.0, (5, 3))
    root = rng.standard_normal((5, 3, 3))
    certainty = root @ root.transpose(0, 2, 1) + np.eye(3)
    for found, pose, information in zip(floor._pose_variance(Graph(poses), certainty), poses, certainty, strict=True):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        own = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        np.testing.assert_allclose(found, np.diag(own @ np.linalg.inv(information) @ own.T), rtol=5e-3)
