"""Known motions recovered within noise, consistent information, named failures."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.registration_worlds import ROOM, views, wall_points
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uwblite import se2
from uwblite.config import override
from uwblite.errors import ConfigError
from uwblite.lidar.point_cloud import make_tree
from uwblite.lidar.point_to_point import IcpConfig, Registration, align, fitness_score

TRUTH = np.array([0.8, -0.5, 0.6])
POINTS = IcpConfig(max_iterations=300)


def seen(rng):
    """Return the tree of one view of a room and the points of another."""
    target, source = views(ROOM, TRUTH, rng)
    return make_tree(target), source


def _off(x, y, theta):
    """Return the truth put out by so much."""
    return TRUTH + np.array([x, y, theta])


def _error(registration, truth):
    e = se2.between(registration.T_target_source, truth)
    return np.hypot(e[0], e[1]), abs(e[2])


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_recovered_to_the_spacing_of_points(seed):
    rng = np.random.default_rng(seed)
    target, source = seen(rng)
    found = align(target, source, _off(0.1, -0.06, 0.03), POINTS)
    assert found.converged, found.reason
    distance, angle = _error(found, TRUTH)
    assert distance < 0.03
    assert angle < 0.02


def test_exact_clouds_give_the_exact_pose():
    rng = np.random.default_rng(0)
    points = wall_points(ROOM, rng, noise=0.0)
    target, source = make_tree(points), se2.transform(se2.inverse(TRUTH), points)
    found = align(target, source, _off(0.02, 0.01, 0.005), POINTS)
    assert found.converged, found.reason
    distance, angle = _error(found, TRUTH)
    assert distance < 1e-3
    assert angle < 5e-4


def test_information_is_half_the_curvature_of_the_squared_distances():
    """With pairs fixed, cost(e) = sum |X o e s - t|^2 / variance has the second derivative 2 information at the minimum."""
    rng = np.random.default_rng(9)
    target_points = rng.uniform(-3.0, 3.0, (40, 2)) * [1.0, 0.4] + [2.0, 0.0]
    truth = np.array([0.4, -0.3, 0.5])
    source = se2.transform(se2.inverse(truth), target_points + rng.normal(scale=0.02, size=(40, 2)))
    target = make_tree(target_points)
    config = replace(POINTS, max_correspondence_distance=0.2, min_sigma=1e-6)
    found = align(target, source, truth, config)
    assert found.converged, found.reason
    assert found.overlap == 1.0
    partner = target_points[target.query(se2.transform(found.T_target_source, source))[1]]

    def squares(e):
        return np.sum((se2.transform(se2.compose(found.T_target_source, e), source) - partner) ** 2)

    variance, step = squares(np.zeros(3)) / (2 * 40 - 3), 1e-3
    basis = step * np.eye(3)
    curvature = np.array(
        [[(squares(a + b) - squares(a - b) - squares(b - a) + squares(-a - b)) / (4.0 * step**2) for a in basis] for b in basis]
    )
    # Off the minimum by the tolerance of the last step, and third derivatives times the step: a thousandth.
    scale = np.sqrt(np.outer(np.diag(found.information), np.diag(found.information)))
    np.testing.assert_allclose(0.5 * curvature / variance / scale, found.information / scale, atol=3e-3)


def test_information_is_bounded_by_the_least_sigma():
    points = np.random.default_rng(10).uniform(-3.0, 3.0, (30, 2))
    found = align(make_tree(points), points, np.zeros(3), replace(POINTS, min_sigma=0.05))
    assert found.converged, found.reason
    np.testing.assert_allclose(np.diag(found.information)[:2], 30 / 0.05**2)


def test_partial_overlap_is_measured_and_does_no_harm():
    rng = np.random.default_rng(4)
    target, source = seen(rng)
    elsewhere = np.vstack([source, rng.uniform(20.0, 26.0, (len(source), 2))])
    found, alone = (align(target, points, _off(0.05, 0.05, 0.02)) for points in (elsewhere, source))
    np.testing.assert_array_equal(found.T_target_source, alone.T_target_source)
    assert found.overlap == pytest.approx(0.5, abs=0.03)


def test_every_failure_has_a_name():
    rng = np.random.default_rng(6)
    target, source = seen(rng)
    empty = np.zeros((0, 2))
    cases = [
        (align(make_tree(empty), source, TRUTH), "the target has 0 points"),
        (align(target, empty, TRUTH), "the source has 0 points"),
        (align(target, source, _off(100.0, 0.0, 0.0)), "no overlap"),
        (align(target, source, _off(0.2, 0.2, 0.1), IcpConfig(max_iterations=2)), "after 2 iterations"),
        (align(target, source, TRUTH, IcpConfig(fitness_sigma=1e-9)), "fitness score"),
    ]
    for found, words in cases:
        assert not found.converged
        assert words in found.reason


def test_settings_need_an_iteration_and_a_distance():
    assert override(IcpConfig(), ["max_iterations=1"]).max_iterations == 1
    for wrong in ("max_iterations=0", "max_correspondence_distance=0", "min_matches=0"):
        with pytest.raises(ConfigError, match="out of range"):
            override(IcpConfig(), [wrong])


def test_fitness_is_the_mean_squared_distance_of_all_points():
    target = make_tree(np.array([[0.0, 0.0], [1.0, 0.0]]))
    points = np.array([[0.0, 0.1], [1.0, 0.2], [4.0, 4.0]])
    assert fitness_score(target, points, np.zeros(3)) == pytest.approx((0.01 + 0.04 + 25.0) / 3.0)
    assert fitness_score(make_tree(np.zeros((0, 2))), points, np.zeros(3)) == np.inf
    assert fitness_score(target, np.zeros((0, 2)), np.zeros(3)) == np.inf
    assert fitness_score(make_tree(points[:1]), points[:1] + np.array([0.3, 0.4]), np.zeros(3)) == pytest.approx(0.25)


@settings(max_examples=25, deadline=None)
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(2)), elements=st.floats(-2.0, 2.0)),
    hnp.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(2)), elements=st.floats(-2.0, 2.0)),
    hnp.arrays(np.float64, 3, elements=st.floats(-3.0, 3.0)),
)
def test_any_two_clouds_give_a_result_with_a_reason(first, second, guess):
    found = align(make_tree(first), second, guess, IcpConfig(min_matches=1))
    assert isinstance(found, Registration)
    assert found.reason
    assert np.isfinite(found.T_target_source).all()
    assert np.isfinite(found.information).all()
    assert np.linalg.eigvalsh(found.information).min() > -1e-6 * max(1.0, abs(found.information).max())
    assert -np.pi < found.T_target_source[2] <= np.pi


@pytest.mark.parametrize("points", [np.zeros((40, 2)), np.repeat([[1.0, 1.0], [1.5, 1.0]], 30, axis=0)])
def test_identical_points_are_no_trouble(points):
    assert align(make_tree(points), points, np.zeros(3), POINTS).reason


def test_the_same_input_gives_the_same_bytes():
    runs = []
    for _ in range(2):
        target, source = seen(np.random.default_rng(7))
        found = align(target, source, TRUTH + 0.05)
        runs.append(found.T_target_source.tobytes() + found.information.tobytes())
    assert runs[0] == runs[1]


def test_the_error_of_matches_and_the_overlap_are_those_of_a_loop():
    """Points of the source within the gate of their nearest one in the target, at the pose found."""
    rng = np.random.default_rng(8)
    target = rng.uniform(0.0, 6.0, (300, 2))
    source = np.concatenate([target[:200] + rng.normal(scale=0.02, size=(200, 2)), rng.uniform(20.0, 30.0, (50, 2))])
    found = align(make_tree(target), source, np.zeros(3), IcpConfig())
    moved = se2.transform(found.T_target_source, source)
    nearest = np.array([np.hypot(*(target - p).T).min() for p in moved])
    near = nearest < 1.0
    assert found.overlap == pytest.approx(near.mean(), abs=0.01)
    assert found.rmse == pytest.approx(np.sqrt(np.mean(nearest[near] ** 2)), rel=0.05)
