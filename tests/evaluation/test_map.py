"""Columns found in maps, distances between them, walls: drawn maps whose truth is known."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.evaluation.map import (
    Landmarks,
    _blocked,
    find_columns,
    landmark_errors,
    landmark_errors_along,
    sample_surfaces,
    visible_from,
    wall_errors,
)

CELL = 0.05
COLUMNS = Landmarks(("a", "b", "c"), np.array([[2.0, 2.0], [5.0, 2.5], [3.0, 5.5]]), np.array([0.35, 0.25, 0.2]))
ROOM = np.array([[0, 0, 8, 0], [8, 0, 8, 7], [8, 7, 0, 7], [0, 7, 0, 0]], dtype=float)


def cells_of(points):
    return (np.unique(np.floor(points / CELL).astype(int), axis=0) + 0.5) * CELL


def drawn(columns=COLUMNS, noise=0.02, seed=0, side=None):
    """Return occupied cells of walls and columns as a noisy scanner would leave them; side = seen from there only."""
    rng = np.random.default_rng(seed)
    points = [sample_surfaces(ROOM, np.empty((0, 3)), 0.02)]
    for place, radius in zip(columns.positions, columns.radii, strict=True):
        ring = sample_surfaces(np.empty((0, 4)), np.array([[*place, radius]]), 0.02)
        if side is not None:
            ring = ring[(ring - place) @ (np.asarray(side) - place) > 0.2 * radius]
        points.append(ring)
    points = np.concatenate(points)
    return cells_of(points + noise * rng.standard_normal(points.shape))


def test_columns_are_found_to_a_fraction_of_a_cell():
    found = find_columns(drawn(), COLUMNS)
    assert np.hypot(*(found.positions - COLUMNS.positions).T).max() < 0.25 * CELL


def test_columns_are_found_where_they_are_not_where_they_are_expected():
    shifted = Landmarks(COLUMNS.names, COLUMNS.positions + np.array([[0.5, -0.3], [0.0, 0.4], [-0.4, 0.2]]), COLUMNS.radii)
    found = find_columns(drawn(), shifted)
    assert np.hypot(*(found.positions - COLUMNS.positions).T).max() < 0.25 * CELL


def test_half_a_column_is_enough():
    found = find_columns(drawn(side=(4.0, 3.5)), COLUMNS)
    assert np.hypot(*(found.positions - COLUMNS.positions).T).max() < CELL


def test_what_is_not_there_is_not_found():
    ghost = Landmarks(("a", "ghost"), np.array([[2.0, 2.0], [6.5, 5.0]]), np.array([0.35, 0.3]))
    found = find_columns(drawn(), ghost)
    assert np.isfinite(found.positions[0]).all()
    assert np.isnan(found.positions[1]).all()
    assert np.isnan(find_columns(np.empty((0, 2)), ghost).positions).all()
    wall = Landmarks(("wall",), np.array([[4.0, 0.3]]), np.array([0.3]))
    assert np.isnan(find_columns(drawn(), wall).positions).all()


def test_distances_between_columns():
    moved = se2.transform(np.array([3.0, 1.0, 1.2]), COLUMNS.positions)
    moved[1] += se2.rotate(1.2, [0.1, 0.0])
    errors = landmark_errors(Landmarks(COLUMNS.names, moved, COLUMNS.radii), COLUMNS)
    assert errors.pairs == (("a", "b"), ("a", "c"), ("b", "c"))
    assert errors.errors[1] == pytest.approx(0.0, abs=1e-12)
    true_ab = np.hypot(3.0, 0.5)
    assert errors.errors[0] == pytest.approx(np.hypot(3.1, 0.5) - true_ab)
    assert errors.mean == pytest.approx(errors.errors.mean())
    chosen = landmark_errors(Landmarks(COLUMNS.names, moved, COLUMNS.radii), COLUMNS, (("a", "c"),))
    assert chosen.pairs == (("a", "c"),)


def test_missing_columns_are_named_and_left_out():
    places = COLUMNS.positions.copy()
    places[1] = np.nan
    errors = landmark_errors(Landmarks(COLUMNS.names, places, COLUMNS.radii), COLUMNS)
    assert errors.missing == ("b",)
    assert errors.pairs == (("a", "c"),)
    assert errors.mean == pytest.approx(0.0)
    assert np.isnan(landmark_errors(Landmarks(COLUMNS.names, places * np.nan, COLUMNS.radii), COLUMNS).mean)


def test_distances_as_a_trajectory_draws_them():
    angle = np.linspace(0, 2 * np.pi, 300)
    poses = np.stack([4 + 1.5 * np.cos(angle), 3.5 + 1.5 * np.sin(angle), angle + np.pi / 2], axis=1)
    other_frame = se2.compose(np.array([2.0, -7.0, 0.4]), poses)
    assert landmark_errors_along(COLUMNS, poses, other_frame).mean == pytest.approx(0.0, abs=1e-9)
    # A second visit that is 0.6 m off draws every column twice: half of all combinations are wrong by up to that.
    twice = np.concatenate([poses, poses])
    slipped = np.concatenate([poses, poses + np.array([0.6, 0.0, 0.0])])
    error = landmark_errors_along(COLUMNS, twice, slipped).mean
    assert 0.05 < error < 0.3
    far = landmark_errors_along(COLUMNS, poses + np.array([50.0, 0.0, 0.0]), poses)
    assert far.missing == COLUMNS.names


def test_walls_of_a_perfect_map():
    posts = np.column_stack([COLUMNS.positions, COLUMNS.radii])
    path = np.array([[4.0, 3.5], [1.0, 1.0], [7.0, 6.0], [1.0, 6.0], [7.0, 1.0]])
    good = wall_errors(drawn(noise=0.0), ROOM, posts, path, reach=6.0)
    assert good.precision == 1.0
    assert good.recall > 0.99
    away = wall_errors(drawn(noise=0.0) + 0.3, ROOM, posts, path, reach=6.0)
    assert away.precision < 0.3
    assert away.recall < 0.3
    empty = wall_errors(np.empty((0, 2)), ROOM, posts, path)
    assert (empty.precision, empty.recall) == (0.0, 0.0)


def test_hidden_walls_do_not_count():
    screen = np.array([[2.0, 1.0, 2.0, -1.0]])
    points = np.array([[1.0, 0.0], [3.0, 0.0], [3.0, 5.0]])
    seen = visible_from(points, screen, np.empty((0, 3)), np.zeros((1, 2)), 10.0)
    np.testing.assert_array_equal(seen, [True, False, True])
    post = np.array([[2.0, 0.0, 0.3]])
    np.testing.assert_array_equal(visible_from(points, np.empty((0, 4)), post, np.zeros((1, 2)), 10.0), [True, False, True])
    np.testing.assert_array_equal(
        visible_from(points, np.empty((0, 4)), np.empty((0, 3)), np.zeros((1, 2)), 4.0), [True, True, False]
    )


@pytest.mark.parametrize("seed", range(3))
def test_ways_are_blocked_by_what_they_cross(seed):
    """Each crossing by the two lines' parameters; each column by its distance from points along the way."""
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-3.0, 3.0, (2, 300, 2))
    walls = rng.uniform(-3.0, 3.0, (3, 4))
    columns = np.array([[1.0, -1.0, 0.5], [-2.0, 2.0, 0.3]])
    across = np.zeros(300, dtype=bool)
    along = np.linspace(0.0, 1.0, 2001)[:, None]
    least = np.full(300, np.inf)
    for k in range(300):
        for x1, y1, x2, y2 in walls:
            t, u = np.linalg.solve(np.array([end[k] - start[k], [x1 - x2, y1 - y2]]).T, np.array([x1, y1]) - start[k])
            across[k] |= 0.0 < t < 1.0 and 0.0 < u < 1.0
        for x, y, radius in columns:
            least[k] = min(least[k], np.hypot(*(start[k] + along * (end[k] - start[k]) - [x, y]).T).min() - radius + 0.02)
    np.testing.assert_array_equal(_blocked(start, end, walls, np.empty((0, 3))), across)
    clear = np.abs(least) > 1e-3
    np.testing.assert_array_equal(_blocked(start, end, np.empty((0, 4)), columns)[clear], (least < 0.0)[clear])
    assert _blocked(start, start, np.empty((0, 4)), columns).sum() == np.sum(
        np.min(np.hypot(*(start[:, None] - columns[:, :2]).transpose(2, 0, 1)) - columns[:, 2], axis=1) < -0.02
    )
    np.testing.assert_array_equal(_blocked(start, end, walls, columns)[clear], (across | (least < 0.0))[clear])


def test_surfaces_are_sampled_about_a_step_apart():
    walls, columns = np.array([[0.0, 0.0, 3.0, 4.0], [1.0, 1.0, 1.0, 1.0]]), np.array([[5.0, 5.0, 1.0], [0.0, 9.0, 0.01]])
    points = sample_surfaces(walls, columns, 0.5)
    np.testing.assert_allclose(points[:10], (np.arange(10)[:, None] + 0.5) * [0.3, 0.4])
    np.testing.assert_allclose(points[10], [1.0, 1.0])
    np.testing.assert_allclose(np.hypot(*(points[11:24] - [5.0, 5.0]).T), 1.0)
    angles = np.unwrap(np.arctan2(*(points[11:24] - [5.0, 5.0]).T[::-1]))
    np.testing.assert_allclose(np.diff(angles), 2.0 * np.pi / 13)
    np.testing.assert_allclose(np.hypot(*(points[24:] - [0.0, 9.0]).T), np.full(8, 0.01))


def test_walls_that_nobody_sees_are_not_covered_and_nobody_sees_any_without_a_viewpoint():
    assert wall_errors(drawn(noise=0.0), ROOM, np.empty((0, 3)), np.array([[100.0, 100.0]]), reach=1.0).recall == 0.0
    assert not visible_from(np.zeros((3, 2)), ROOM, np.empty((0, 3)), np.empty((0, 2)), 9.0).any()
