"""Filters against brute force, normals against known walls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uwblite.errors import DataError
from uwblite.lidar.point_cloud import (
    estimate_normals,
    neighbour_pairs,
    radius_outlier_filter,
    statistical_outlier_filter,
    voxel_filter,
)

clouds = hnp.arrays(np.float64, st.tuples(st.integers(0, 60), st.just(2)), elements=st.floats(-5.0, 5.0, allow_subnormal=False))


def _distances(points):
    return np.sqrt(((points[:, None] - points[None, :]) ** 2).sum(axis=-1))


@settings(max_examples=25, deadline=None)
@given(clouds, st.integers(1, 8), st.floats(0.0, 3.0))
def test_statistical_filter_equals_brute_force(points, neighbours, ratio):
    keep = statistical_outlier_filter(points, neighbours, ratio)
    if len(points) < 2:
        assert keep.all()
        return
    k = min(neighbours, len(points) - 1)
    mean = np.sort(_distances(points), axis=1)[:, 1 : k + 1].mean(axis=1)
    threshold = mean.mean() + ratio * mean.std()
    clear = np.abs(mean - threshold) > 1e-9
    np.testing.assert_array_equal(keep[clear], (mean <= threshold)[clear])


@settings(max_examples=25, deadline=None)
@given(clouds, st.floats(0.05, 3.0), st.integers(0, 5))
def test_radius_filter_equals_brute_force(points, radius, least):
    distances = _distances(points)
    others = (distances <= radius).sum(axis=1) - 1
    clear = (np.abs(distances - radius) > 1e-9).all(axis=1)
    np.testing.assert_array_equal(radius_outlier_filter(points, radius, least)[clear], (others >= least)[clear])


@settings(max_examples=25, deadline=None)
@given(clouds, st.floats(0.05, 3.0))
def test_voxel_filter_equals_brute_force(points, size):
    squares = {}
    for point, square in zip(points, np.floor(points / size).tolist(), strict=True):
        squares.setdefault(tuple(square), []).append(point)
    expected = np.array([np.mean(squares[key], axis=0) for key in sorted(squares)]).reshape(-1, 2)
    np.testing.assert_allclose(voxel_filter(points, size), expected, atol=1e-12)


@pytest.mark.parametrize(("points", "words"), [
    (np.zeros((3, 3)), r"points has shape \(3, 3\), expected \(n, 2\)"), ([[0.0, np.nan]], r"points\[0\] is not finite"),
    ("wall", "points must hold numbers, not str"),
])  # fmt: skip
def test_filters_say_what_is_wrong_with_points(points, words):
    for call in (lambda p: voxel_filter(p, 0.1), lambda p: statistical_outlier_filter(p, 3, 1.0),
                 lambda p: radius_outlier_filter(p, 0.1, 1)):  # fmt: skip
        with pytest.raises(DataError, match=words):
            call(points)


def test_filters_take_lists():
    points = [[0, 0], [0, 1], [5, 5]]
    np.testing.assert_array_equal(voxel_filter(points, 2.0), [[0.0, 0.5], [5.0, 5.0]])
    assert radius_outlier_filter(points, 1.0, 1).tolist() == [True, True, False]
    assert statistical_outlier_filter(points, 1, 0.5).tolist() == [True, True, False]


def test_radius_filter_counts_a_neighbour_at_exactly_the_radius():
    points = np.array([[0.0, 0.0], [0.5, 0.0]])
    assert radius_outlier_filter(points, 0.5, 1).all()
    assert not radius_outlier_filter(points, 0.499, 1).any()


def test_filters_take_a_lone_outlier_and_leave_the_wall():
    wall = np.stack([np.linspace(0.0, 3.0, 61), np.zeros(61)], axis=-1)
    points = np.vstack([wall, [[1.5, 1.0]]])
    for keep in (statistical_outlier_filter(points, 6, 3.0), radius_outlier_filter(points, 0.2, 2)):
        assert keep.tolist() == [True] * 61 + [False]


def lines_of(points, radius):
    return estimate_normals(points, *neighbour_pairs(np.zeros(len(points), dtype=np.int64), points, radius))


@settings(max_examples=25, deadline=None)
@given(clouds, st.floats(0.1, 3.0), st.integers(1, 3))
def test_neighbours_are_the_pairs_of_one_owner_within_the_radius(points, radius, owners):
    owner = np.arange(len(points)) % owners
    distances = _distances(points)
    if (np.abs(distances - radius) < 1e-9).any():
        return
    pairs = np.sort(neighbour_pairs(owner, points, radius), axis=0).T
    near = (distances <= radius) & (owner == owner[:, None]) & (np.arange(len(points)) > np.arange(len(points))[:, None])
    assert sorted(pairs.tolist()) == np.argwhere(near).tolist()


@settings(max_examples=25, deadline=None)
@given(clouds, st.floats(0.1, 3.0))
def test_lines_equal_the_eigenvectors_of_each_neighbourhood(points, radius):
    lines = lines_of(points, radius)
    distances = _distances(points)
    if (np.abs(distances - radius) < 1e-9).any():
        return
    for k in range(len(points)):
        near = points[distances[k] <= radius]
        assert lines.neighbours[k] == len(near)
        np.testing.assert_allclose(lines.centers[k], near.mean(axis=0), atol=1e-9)
        covariance = np.cov(near.T, bias=True) if len(near) > 1 else np.zeros((2, 2))
        values, vectors = np.linalg.eigh(covariance)
        if len(near) < 3 or values[1] == 0.0:
            assert (lines.normals[k] == 0.0).all()
            assert lines.linearity[k] == 0.0
            continue
        assert lines.linearity[k] == pytest.approx(1.0 - max(values[0], 0.0) / values[1], abs=1e-6 / values[1])
        if values[1] - values[0] > 1e-6:
            assert abs(lines.normals[k] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_linearity_shows_walls_from_corners_and_lone_points():
    along = np.arange(0.0, 1.001, 0.05)
    corner = np.vstack([np.stack([along, 0 * along], -1), np.stack([0 * along, along + 0.05], -1), [[5.0, 5.0]]])
    lines = lines_of(corner, 0.2)
    assert lines.linearity[10] > 0.999
    assert lines.linearity[0] < 0.8
    assert lines.linearity[-1] == 0.0


def test_variance_of_normals_is_what_the_scatter_makes_it():
    rng = np.random.default_rng(2)
    angles, predicted = [], []
    for _ in range(400):
        wall = np.stack([np.arange(-0.3, 0.301, 0.05), rng.normal(0.0, 0.01, 13)], axis=-1)
        lines = lines_of(wall, 0.21)
        angles.append(np.arctan2(lines.normals[6, 0], abs(lines.normals[6, 1])))
        predicted.append(lines.normal_variance[6])
    # 400 draws know a variance to about 7 %.
    assert np.mean(predicted) == pytest.approx(np.var(angles), rel=0.25)
