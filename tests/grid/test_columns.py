"""Columns among cells: seen from all sides or from one, beside walls and beside each other; and what is none."""

import numpy as np
import pytest

from uwblite.evaluation.map import Landmarks, find_columns
from uwblite.grid.columns import _scores, fit_circle

CELL = 0.05


def circle(centre, radius, begin=0.0, end=2.0 * np.pi):
    angle = np.linspace(begin, end, 200)
    return np.asarray(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def cells_of(points):
    """Return the middles of the cells in which points (n, 2) lie."""
    return (np.unique(np.floor(points / CELL), axis=0) + 0.5) * CELL


def expected(*places, radius=0.25):
    return Landmarks(tuple("abc"[: len(places)]), np.array(places), np.full(len(places), radius))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.6)])
def test_a_column_is_found_where_it_stands(shift):
    centre = np.array([2.013, -1.022]) + shift
    found = find_columns(cells_of(circle(centre, 0.25)), expected((2.0, -1.0)))
    # Cells round to half a cell; the circle's many cells average that to a fifth of one.
    assert np.hypot(*(found.positions[0] - centre)) < 0.2 * CELL
    assert found.names == ("a",)


def test_half_of_a_column_is_enough_and_less_than_a_third_is_not():
    half, part = (circle((2.0, -1.0), 0.25, 0.3, 0.3 + share * 2.0 * np.pi) for share in (0.55, 0.2))
    assert np.hypot(*(find_columns(cells_of(half), expected((2.2, -1.1))).positions[0] - (2.0, -1.0))) < CELL
    assert np.isnan(find_columns(cells_of(part), expected((2.2, -1.1))).positions).all()


def test_walls_and_empty_maps_have_no_column():
    wall = np.column_stack([np.linspace(0.0, 4.0, 400), np.full(400, -1.0)])
    assert np.isnan(find_columns(cells_of(wall), expected((2.0, -1.0))).positions).all()
    assert np.isnan(find_columns(np.zeros((0, 2)), expected((2.0, -1.0))).positions).all()


def test_a_column_is_not_taken_for_its_neighbour():
    """One of two stands, 0.9 m from the place of the other, within its search radius but nearer to its own place."""
    found = find_columns(cells_of(circle((0.9, 0.0), 0.25)), expected((0.0, 0.0), (0.9, 0.0)))
    assert np.isnan(found.positions[0]).all()
    assert np.hypot(*(found.positions[1] - (0.9, 0.0))) < 0.2 * CELL


def test_a_circle_is_fitted_exactly_and_what_lies_outside_the_gate_does_not_pull():
    points = np.concatenate([circle((1.0, 2.0), 0.3, 0.0, 4.0), [[1.5, 2.0], [1.0, 2.5]]])
    np.testing.assert_allclose(fit_circle(points, np.array([1.02, 1.97]), 0.3, 0.1), (1.0, 2.0), atol=1e-4)
    lone = np.array([[5.0, 5.0]])
    np.testing.assert_array_equal(fit_circle(lone, np.array([1.0, 2.0]), 0.3, 0.1), (1.0, 2.0))


def test_three_points_are_enough_for_a_circle():
    points = circle((1.0, 2.0), 0.3, 0.0, 4.0)[::20][:3]
    assert len(points) == 3
    np.testing.assert_allclose(fit_circle(points, np.array([1.02, 1.98]), 0.3, 0.1), (1.0, 2.0), atol=2e-3)
    np.testing.assert_array_equal(fit_circle(points[:2], np.array([1.02, 1.98]), 0.3, 0.1), (1.02, 1.98))


def test_a_circle_scores_by_its_arc_less_what_stands_around_it_and_how_far_its_cells_are_off():
    """A whole circle of points scores 1; half of a second one, three cells further out, costs its share."""
    rim, around = circle((0.0, 0.0), 0.25), circle((0.0, 0.0), 0.25 + 3.0 * CELL, 0.0, np.pi)
    for cells, spoilt in ((rim, 0.0), (np.concatenate([rim, around]), 0.5)):
        score, arc = _scores(np.zeros((1, 2)), cells, 0.25, CELL)
        assert arc[0] == 1.0
        assert score[0] == pytest.approx(1.0 - spoilt, abs=2.5 / 24 if spoilt else 0.02)
    wide = circle((0.0, 0.0), 0.25 + 0.5 * CELL)
    assert _scores(np.zeros((1, 2)), wide, 0.25, CELL)[0][0] == pytest.approx(0.75, abs=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_a_fitted_circle_is_where_tukey_s_cost_is_least(seed):
    """Of noisy points all around and some astray: its numeric slope vanishes there."""
    rng = np.random.default_rng(seed)
    points = circle((1.0, 2.0), 0.3, 0.0, 5.0)[::4]
    points = np.concatenate([points + 0.02 * rng.standard_normal(points.shape), rng.uniform((0.5, 1.5), (1.5, 2.5), (6, 2))])

    def cost(centre, gate=0.1):
        residual = np.hypot(*(points - centre).T) - 0.3
        return np.sum(1.0 - np.maximum(1.0 - (residual / gate) ** 2, 0.0) ** 3)

    found = fit_circle(points, np.array([1.02, 1.97]), 0.3, 0.1)
    assert max(abs(cost(found + step) - cost(found - step)) / 2e-4 for step in 1e-4 * np.eye(2)) < 0.05
    assert cost(found) < min(cost(found + 0.01 * np.array([np.cos(a), np.sin(a)])) for a in np.arange(8) * np.pi / 4)


@pytest.mark.parametrize(("share", "is_found"), [(0.26, False), (0.36, True)])
def test_a_third_of_the_circle_is_too_little(share, is_found):
    part = circle((2.0, -1.0), 0.25, 0.0, share * 2.0 * np.pi)
    assert np.isfinite(find_columns(part, expected((2.0, -1.0), radius=0.25)).positions).all() == is_found


def test_of_two_columns_that_look_alike_the_nearer_one_is_taken():
    both = np.concatenate([circle((1.5, -1.0), 0.25), circle((2.6, -1.0), 0.25)])
    np.testing.assert_allclose(find_columns(both, expected((2.0, -1.0))).positions, [(1.5, -1.0)], atol=1e-3)


def test_two_cells_fix_no_circle_and_three_do():
    centre, radius = np.array([1.0, 2.0]), 0.3
    angle = np.array([0.3, 1.5, 4.0])
    rim = centre + np.array([0.05, 0.0]) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    np.testing.assert_array_equal(fit_circle(rim[:2], centre, radius, 0.2), centre)
    assert np.hypot(*(fit_circle(rim, centre, radius, 0.2) - centre - [0.05, 0.0])) < 0.005
