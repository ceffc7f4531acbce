"""Columns among rays: seen from all sides, from too few keyframes, beside each other; and what is none."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite import se2
from uwblite.arrays import concatenated
from uwblite.lidar.columns import fitted_circles, fitted_columns, join_circles, nearest_rims, rim_distances
from uwblite.lidar.surface_rays import as_rays
from uwblite.odometry.attached import ScanPoints

POSES = np.array([[2.0 * np.cos(a), 2.0 * np.sin(a), a + 2.0] for a in np.arange(0.0, 6.2, 0.5)])
RADIUS = 0.35


def seen(poses, shape, noise=0.01, seed=0):
    """Rays from poses to what stands about the origin, by a function of origin and direction."""
    rng, bearing = np.random.default_rng(seed), np.arange(-np.pi, np.pi, 2.0 * np.pi / 1024)
    parts = []
    for k, pose in enumerate(poses):
        way = np.column_stack([np.cos(pose[2] + bearing), np.sin(pose[2] + bearing)])
        reach = shape(pose[:2], way) + noise * rng.standard_normal(len(way))
        hit = np.flatnonzero(np.isfinite(reach))
        points = se2.transform(se2.inverse(pose), pose[:2] + reach[hit, None] * way[hit])
        parts.append((np.full(len(hit), k), points, hit))
    keyframe, points, ray = (np.concatenate(p) for p in zip(*parts, strict=True))
    return ScanPoints(keyframe, points, np.zeros_like(points), ray, keyframe)


def round_column(origin, way, radius=RADIUS):
    along = -(way @ origin)
    inside = radius**2 - origin @ origin + along**2
    return np.where((inside > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(inside, 0.0)), np.inf)


def square(origin, way):
    """A box of 50 cm, whose corner looks round to a poor scanner."""
    with np.errstate(divide="ignore"):
        low, high = (-0.25 - origin) / way, (0.25 - origin) / way
    near, far = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    return np.where((near < far) & (near > 0.0), near, np.inf)


def test_circles_of_many_scans_are_a_column_where_it_stands():
    rays = seen(POSES, round_column)
    columns = join_circles(fitted_circles(rays), POSES)
    assert len(columns) == 1
    np.testing.assert_allclose(columns[0], [0.0, 0.0, RADIUS], atol=0.05)
    np.testing.assert_allclose(fitted_columns(as_rays(rays), POSES, columns)[0], [0.0, 0.0, RADIUS], atol=0.003)


def test_a_column_seen_from_too_few_keyframes_is_none():
    rays = seen(POSES[:2], round_column)
    assert len(fitted_circles(rays).radius) == 2
    assert len(join_circles(fitted_circles(rays), POSES)) == 0


@pytest.mark.parametrize("seed", [0, 1])
def test_a_box_is_no_column(seed):
    rays = seen(POSES, square, seed=seed)
    columns = join_circles(fitted_circles(rays), POSES)
    assert len(fitted_columns(as_rays(rays), POSES, columns)) == 0


def test_rays_that_do_not_bend_are_no_circle():
    rays = seen(POSES, lambda origin, way: np.full(len(way), 30.0))
    assert len(fitted_circles(rays).radius) == 0


@pytest.mark.parametrize("size", [10.0, 3000.0])
def test_points_near_columns_have_the_distance_to_the_nearest_rim(size):
    """All that are near, as if every point were compared with every column."""
    rng = np.random.default_rng(2)
    columns = np.column_stack([rng.uniform(0.0, size, (7, 2)), rng.uniform(0.1, 0.8, 7)])
    anywhere, close = rng.uniform(-5.0, size + 5.0, (4000, 2)), rng.standard_normal((999, 2))
    at = np.concatenate([anywhere, columns[rng.integers(7, size=999), :2] + close])
    rim = (np.hypot(*(at[:, None] - columns[None, :, :2]).transpose(2, 0, 1)) - columns[:, 2]).min(axis=1)
    near = rim < 0.3
    assert near.sum() > 100
    away = rim_distances(columns, at, 0.3)
    np.testing.assert_allclose(away[near], rim[near], rtol=1e-9, atol=1e-9)
    assert np.all(np.isinf(away[~near]))
    assert np.all(np.isinf(rim_distances(columns[:0], at, 0.3)))


def test_a_point_on_a_wide_column_is_not_that_of_a_narrow_one_whose_centre_is_nearer():
    columns = np.array([[0.0, 0.0, 0.8], [1.0, 0.0, 0.04], [1.0, 0.3, 0.04], [1.0, -0.3, 0.04]])
    at = np.array([[0.79, 0.0], [0.97, 0.0], [0.75, 0.25], [0.0, 0.1]])
    which, away = nearest_rims(columns, at)
    np.testing.assert_array_equal(which, [0, 1, 0, 0])
    np.testing.assert_allclose(away, [-0.01, -0.01, np.hypot(0.75, 0.25) - 0.8, -0.7])
    np.testing.assert_allclose(rim_distances(columns, at, 0.02), away)


def test_nine_rays_of_three_times_the_noise_count_as_one():
    """Half of the keyframes see a column that is 4 mm larger, nine times as often: it is in the middle of both."""
    larger = seen(POSES[1:12:2], lambda origin, way: round_column(origin, way, RADIUS + 0.004), noise=0.0)
    true = seen(POSES[:12:2], round_column, noise=0.0)
    larger = replace(larger, keyframe=2 * larger.keyframe + 1)
    one, other = as_rays(replace(true, keyframe=2 * true.keyframe)), as_rays(larger)
    rays = concatenated([replace(one, sigma=0.0 * one.sigma + 0.01), *[replace(other, sigma=0.0 * other.sigma + 0.03)] * 9])
    (column,) = fitted_columns(rays, POSES, np.array([[0.0, 0.0, RADIUS]]))
    assert column[2] == pytest.approx(RADIUS + 0.002, abs=2e-4)
    np.testing.assert_allclose(column[:2], 0.0, atol=5e-4)
