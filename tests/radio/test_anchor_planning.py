"""Planning anchors: the error is that of least squares, the first choice the best of all, walls block the line of sight."""

import numpy as np
import pytest

from uwblite.errors import ConfigError
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.radio.anchor_planning import (
    SIGMA_BEHIND_WALLS,
    SIGMA_LINE_OF_SIGHT,
    _choose,
    _coarse,
    _information,
    _near,
    _wall_cells,
    plan_anchors,
    position_errors,
)

NO_WALLS = np.zeros((0, 2))


def hall(rows=60, cols=100, wall_at=None, door=range(0)):
    """A hall of cells of 0.2 m with walls around, and one across it with a door where it is asked for."""
    odds = np.full((rows, cols), -4.0, dtype=np.float32)
    odds[[0, -1]] = odds[:, [0, -1]] = 4.0
    if wall_at is not None:
        odds[:, wall_at] = 4.0
        odds[list(door), wall_at] = -4.0
    return OccupancyGrid(GridGeometry(0.2, np.array([-3.0, 2.0]), rows, cols), odds)


def test_the_error_is_that_of_least_squares():
    rng = np.random.default_rng(2)
    point, anchors = rng.uniform(0, 10, 2), rng.uniform(0, 10, (4, 2))
    information = _information(point[None], anchors, NO_WALLS, 100.0).sum(axis=0)[0]
    u = (point - anchors) / np.linalg.norm(point - anchors, axis=1)[:, None]
    covariance = np.linalg.inv(u.T @ u / SIGMA_LINE_OF_SIGHT**2 + np.eye(2) / 9.0)
    assert position_errors(information) == pytest.approx(np.sqrt(np.trace(covariance)), rel=1e-12)
    # Drawn positions scatter as it says: ranges with that noise, linearised least squares.
    step = np.linalg.lstsq(u, SIGMA_LINE_OF_SIGHT * rng.normal(size=(4, 20_000)), rcond=None)[0]
    assert np.sqrt(np.mean(np.sum(step**2, axis=0))) == pytest.approx(position_errors(information), rel=0.03)


def test_out_of_reach_informs_nothing_and_walls_inform_less():
    point, anchor = np.zeros((1, 2)), np.array([[5.0, 0.0]])
    cases = ((NO_WALLS, 9.0), (np.array([[2.5, 0.0]]), 9.0), (NO_WALLS, 4.0))
    near, behind, far = (_information(point, anchor, walls, reach)[0, 0] for walls, reach in cases)
    assert near[0] / behind[0] == pytest.approx((SIGMA_BEHIND_WALLS / SIGMA_LINE_OF_SIGHT) ** 2)
    assert not far.any()


@pytest.mark.slow
def test_the_first_place_is_the_best_of_all_and_more_never_harm():
    grid = hall()
    anchors = np.array([[-2.0, 3.0], [-2.0, 13.0]])
    plan = plan_anchors(grid, anchors, 3)
    assert (np.diff(plan.errors, axis=0) < 1e-12).all()
    one = plan_anchors(grid, anchors, 1)
    occupied, free, low, cell = _coarse(grid)
    cells, walls = np.argwhere(free), low + cell * (np.argwhere(occupied)[:, ::-1] + 0.5)
    rng = np.random.default_rng(0)
    for other in cells[rng.choice(len(cells), 150, replace=False)]:
        place = low + cell * (other[::-1] + 0.5)
        edge = np.minimum(place - grid.geometry.origin, grid.geometry.corner - place).min() - 0.2
        beside = 0.5 <= edge < 0.75
        if not beside or np.linalg.norm(anchors - place, axis=1).min() < 1.0:
            continue
        information = _information(one.points, np.vstack([anchors, place]), walls, 25.0).sum(axis=0)
        # The candidates are thinned to every other cell or so: a neighbour may be better by a little.
        assert position_errors(information).mean() > one.errors[1].mean() * 0.99


def test_anchors_go_where_none_are_in_line_of_sight():
    """Two rooms joined by a door; all anchors stand in the left one."""
    grid = hall(44, 70, wall_at=35, door=range(20, 24))
    plan = plan_anchors(grid, np.array([[-2.0, 3.0], [-2.0, 10.0], [3.0, 7.0]]), 2)
    assert (plan.places[:, 0] > -3.0 + 0.2 * 35).all()
    right = plan.points[:, 0] > -3.0 + 0.2 * 36
    assert plan.errors[-1][right].mean() < 0.6 * plan.errors[0][right].mean()


def test_places_half_a_metre_from_walls_are_those_of_a_loop():
    """The distance is that of the middle of a cell to the nearest edge of a blocked one, to half a cell."""
    rng = np.random.default_rng(3)
    blocked = rng.random((14, 15)) < 0.04
    free = ~blocked & (rng.random((14, 15)) < 0.7)
    expected = []
    for row, col in np.argwhere(free):
        away = 0.2 * np.hypot(*(np.argwhere(blocked) - [row, col]).T).min() - 0.1
        if 0.5 <= away < 0.5 + 0.2 * np.sqrt(2.0):
            expected.append([row, col])
    assert len(expected) > 10
    assert _wall_cells(blocked, free, 0.2).tolist() == expected


def test_places_keep_half_a_metre_from_walls_where_there_is_room():
    grid = hall(44, 70, wall_at=35, door=range(20, 24))
    plan = plan_anchors(grid, np.zeros((0, 2)), 4)
    walls = grid.occupied_points()
    for place in plan.places:
        assert np.hypot(*(walls - place).T).min() - 0.1 >= 0.5 - 1e-9
    narrow = plan_anchors(hall(6, 40), np.zeros((0, 2)), 2)
    assert len(narrow.places) == 2


@pytest.mark.parametrize("seed", range(8))
def test_no_exchange_of_one_place_is_better(seed):
    rng = np.random.default_rng(seed)
    at, offered = rng.uniform(0, 10, (30, 2)), rng.uniform(0, 10, (25, 2))
    walls = rng.uniform(0, 10, (6, 2))
    today = _information(at, rng.uniform(0, 10, (seed % 3, 2)), NO_WALLS, 8.0).sum(axis=0)
    gains = _information(at, offered, walls, 8.0)
    taken = offered[:, 0] < 1.0
    chosen = _choose(today, gains, offered, taken, 4)
    least = position_errors(today + gains[chosen].sum(axis=0)).mean()
    # The most useful of those left comes first each time.
    for k in range(4):
        means = [position_errors(today + gains[[*chosen[:k], other]].sum(axis=0)).mean() for other in chosen[k:]]
        assert np.argmin(means) == 0
    for k in range(4):
        others = np.delete(chosen, k)
        for other in np.flatnonzero(~taken & ~_near(offered, offered[others])):
            assert position_errors(today + gains[[*others, other]].sum(axis=0)).mean() > least - 1e-12


def test_what_cannot_be_planned_is_reported():
    nothing = OccupancyGrid(GridGeometry(0.2, np.zeros(2), 5, 5), np.zeros((5, 5), dtype=np.float32))
    with pytest.raises(ConfigError, match="no free space"):
        plan_anchors(nothing, np.zeros((0, 2)), 1)
    with pytest.raises(ConfigError, match="no room"):
        plan_anchors(hall(10, 10), np.zeros((0, 2)), 50)


@pytest.mark.slow
def test_same_map_same_plan():
    one, two = (plan_anchors(hall(wall_at=40), np.zeros((0, 2)), 2) for _ in range(2))
    np.testing.assert_array_equal(one.places, two.places)
    apart = np.linalg.norm(one.places[:, None] - one.places[None], axis=2) + 9 * np.eye(2)
    assert apart.min() >= 1.0
