"""Columns found in maps, distances between them: drawn maps whose truth is known."""

import numpy as np
import pytest
from helpers import planted

from uwblite import se2
from uwblite.evaluation.map import (
    Landmarks,
    find_columns,
    landmark_errors,
    landmark_errors_along,
)

CELL = 0.05
COLUMNS = Landmarks(("a", "b", "c"), np.array([[2.0, 2.0], [5.0, 2.5], [3.0, 5.5]]), np.array([0.35, 0.25, 0.2]))
ROOM = np.array([[0, 0, 8, 0], [8, 0, 8, 7], [8, 7, 0, 7], [0, 7, 0, 0]], dtype=float)


def cells_of(points):
    return (np.unique(np.floor(points / CELL).astype(int), axis=0) + 0.5) * CELL


def drawn(columns=COLUMNS, noise=0.02, seed=0, side=None):
    """Return occupied cells of walls and columns as a noisy scanner would leave them; side = seen from there only."""
    rng = np.random.default_rng(seed)
    points = [planted.surface_points(ROOM, [])]
    for place, radius in zip(columns.positions, columns.radii, strict=True):
        ring = planted.surface_points([], [np.array([*place, radius])])
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
