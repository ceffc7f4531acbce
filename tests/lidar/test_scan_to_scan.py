"""Tracking: steps between neighbouring clouds are measured, slips are found by a search, blind steps left to the wheels."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import HALL, chained, scanned, walked
from helpers.planted import box

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.lidar.scan_matching import rasterize
from uwblite.lidar.scan_to_scan import TrackingConfig, follow

NOISE = np.array([0.01, 0.005, 0.006])
GATE = 0.5


def followed(truth, clouds, said):
    """Follow a chain whose wheels say the steps said (k - 1, 3)."""
    wheels = replace(chained(truth, NOISE), motion=said)
    poses = [truth[0]]
    for step in said:
        poses.append(se2.compose(poses[-1], step))
    raster = rasterize(clouds, 0.1, GATE)
    result = follow(clouds, raster, wheels, Graph(np.array(poses)), GATE, TrackingConfig())
    return result.steps, result.wheels, result.searched


@pytest.fixture(scope="module")
def walk():
    truth, _, clouds = walked(5, HALL, 30.0)
    return truth, clouds, se2.between(truth[:-1], truth[1:])


def test_steps_are_measured(walk):
    """Walls seen by a hundred points of 1 cm, alike in both clouds: a few millimetres."""
    truth, clouds, exact = walk
    rng = np.random.default_rng(1)
    steps, _, _ = followed(truth, clouds, exact + rng.standard_normal(exact.shape) * NOISE)
    np.testing.assert_array_equal(steps.j, steps.i + 1)
    # In the middle of the hall some steps see too little wall.
    assert len(steps) > 0.85 * len(exact)
    error = se2.between(exact[steps.i], steps.T_i_j)
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.005
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 0.003
    whitened = np.einsum("eij,ej->ei", steps.sqrt_information, error)
    assert np.mean(np.sum(whitened**2, axis=1)) < 6.0


def test_slips_are_found_by_a_search(walk):
    """Wheels so bad that they miss by up to 0.3 m and 0.35 rad a step: the clouds tell, and the wheels' noise is learnt."""
    truth, clouds, exact = walk
    rng = np.random.default_rng(2)
    said = exact + rng.uniform(-1, 1, exact.shape) * [0.3, 0.3, 0.35]
    steps, wheels, searches = followed(truth, clouds, said)
    error = np.abs(se2.between(exact[steps.i], steps.T_i_j))
    good = (np.hypot(error[:, 0], error[:, 1]) < 0.03) & (error[:, 2] < 0.02)
    assert searches > 0
    assert len(steps) > 0.8 * len(exact)
    assert good.mean() > 0.9
    before = chained(truth, NOISE).sqrt_information
    assert np.all(np.einsum("eii->ei", wheels.sqrt_information) < np.einsum("eii->ei", before))


def test_blind_steps_are_left_to_the_wheels():
    truth = np.column_stack([np.arange(30) * 0.3, np.zeros(30), np.zeros(30)])
    clouds = scanned(truth, box(400, 400))
    steps, wheels, searches = followed(truth, clouds, se2.between(truth[:-1], truth[1:]))
    assert len(steps) == 0
    assert searches == 0
    np.testing.assert_array_equal(wheels.sqrt_information, chained(truth, NOISE).sqrt_information)


def test_a_corridor_is_not_measured_along():
    truth = np.column_stack([np.arange(30) * 0.3 - 4.5, np.zeros(30), np.zeros(30)])
    clouds = scanned(truth, np.array([[-40.0, -1.0, 40.0, -1.0], [40.0, 1.0, -40.0, 1.0]]), 0.01, 3, reach=5.0)
    steps, _, _ = followed(truth, clouds, se2.between(truth[:-1], truth[1:]))
    information = np.swapaxes(steps.sqrt_information, 1, 2) @ steps.sqrt_information
    assert len(steps) > 20
    assert np.median(information[:, 0, 0]) < 0.02 * np.median(information[:, 1, 1])
