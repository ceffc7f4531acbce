"""Clearance is a true lower bound, and a close one; nearness and unknown space have their price."""

import numpy as np
import pytest
from helpers.planning_worlds import distance_to_squares, grid_of, random_grid

from uwblite.grid.occupancy_grid import OCCUPIED, UNKNOWN
from uwblite.navigation.clearance import COMFORT, NEAR_COST, UNKNOWN_PRICE, clearance_map


@pytest.mark.parametrize("seed", range(6))
def test_no_obstacle_is_nearer_than_the_clearance_anywhere(seed):
    grid = random_grid(seed)
    clearance = clearance_map(grid, 0.2)
    h = grid.geometry.resolution
    rng = np.random.default_rng(seed)
    points = rng.uniform(grid.geometry.origin, grid.geometry.corner, (2000, 2))
    bound = np.sqrt(clearance.bounds(points))
    true = distance_to_squares(grid, grid.states() == OCCUPIED, points)
    true[grid.states()[grid.geometry.cell_of(points)] == OCCUPIED] = 0.0
    assert np.all(bound <= true + 1e-6)
    # Of the interpolation second order terms are given away.
    far = true > 4 * h
    assert np.all(np.minimum(true[far], 0.2 + COMFORT) - bound[far] < h)
    known = clearance.distances(points)
    assert np.all(np.abs(known - true)[true < 0.2] < 1e-6)
    assert np.all(known <= true + 1e-6)
    needed = rng.uniform(0.1, 0.29, 2000) ** 2
    assert np.array_equal(clearance.keeps(points, bound**2, needed, np.arange(2000)), true**2 >= needed)
    assert np.array_equal(clearance.is_obstacle(points), true == 0.0)


@pytest.mark.parametrize(("seed", "radius"), [(0, 0.15), (1, 0.23), (2, 0.31), (3, 0.4), (4, 0.0)])
def test_distances_of_the_centres_and_narrow_places_are_those_that_a_search_through_all_cells_finds(seed, radius):
    grid = random_grid(seed)
    clearance, shape, obstacles = clearance_map(grid, radius), grid.log_odds.shape, grid.states() == OCCUPIED
    row, col = (v.ravel() for v in np.indices(shape))
    true = np.where(obstacles.ravel(), 0.0, distance_to_squares(grid, obstacles, grid.geometry.centre_of(row, col)))
    found = 0.5 * grid.geometry.resolution * np.sqrt(clearance.half.ravel())
    assert found == pytest.approx(np.minimum(true, found.max()), abs=1e-6)
    assert found.max() >= min(true.max(), radius + COMFORT) - 1e-6
    stands = clearance.passable()
    narrow = [
        (c / 2, r / 2)
        for r, c in np.ndindex(2 * shape[0] - 1, 2 * shape[1] - 1)
        if (r % 2 or c % 2)
        for beside in [stands[r // 2 : (r + 3) // 2, c // 2 : (c + 3) // 2]]
        if not beside.any() or beside.tolist() in ([[True, False], [False, True]], [[False, True], [True, False]])
    ]
    places = grid.geometry.origin + grid.geometry.resolution * (np.array(narrow) + 0.5)
    places = places[distance_to_squares(grid, obstacles, places) >= max(radius, 0.05) - 1e-9]
    assert {tuple(p) for p in places.round(6)} == {tuple(p) for p in clearance.tight.round(6)}


def test_steps_between_passable_cells_keep_the_radius():
    grid = random_grid(3)
    clearance = clearance_map(grid, 0.15)
    passable = clearance.passable()
    row, col = np.nonzero(passable[:-1, :-1] & passable[1:, 1:] & passable[:-1, 1:] & passable[1:, :-1])
    middle = grid.geometry.centre_of(row, col) + 0.5 * grid.geometry.resolution
    assert distance_to_squares(grid, grid.states() == OCCUPIED, middle).min() >= 0.15 - 1e-6


def test_nearness_costs_smoothly():
    grid = grid_of("#" + "." * 30, scale=3)
    clearance = clearance_map(grid, 0.2)
    x = np.linspace(0.6, 2.5, 400)
    points = np.stack([x, np.full(400, 0.15)], axis=1)
    squared, cost = clearance.at(points)
    assert np.all(squared < 0.15**2)  # what lies outside the map is an obstacle
    assert np.all(cost == 1.0 + NEAR_COST)
    wide = clearance_map(grid_of("\n".join(["#" + "." * 30] * 20), scale=3), 0.2)
    cost = wide.at(np.stack([x, np.full(400, 3.0)], axis=1))[1]
    assert np.all(np.diff(cost) <= 1e-6)
    assert cost[-1] == 1.0
    assert np.abs(np.diff(cost)).max() < 2 * NEAR_COST / 0.5 * (x[1] - x[0]) * 1.5


def test_unknown_space_is_an_obstacle_or_dear_and_specks_are_neither():
    text = """
    ............
    ..?.....????
    ........????
    ........????
    ............
    """
    grid = grid_of("\n".join(line.strip() for line in text.split("\n")))
    refused, priced = clearance_map(grid, 0.0), clearance_map(grid, 0.0, unknown="price")
    dark = grid.states() == UNKNOWN
    assert np.array_equal(refused.half == 0, dark & (np.arange(12) >= 8))
    assert np.all(priced.half > 0)
    assert np.array_equal(priced.dear, dark & (np.arange(12) >= 8))
    assert np.all(priced.cell_cost()[~priced.dear] < UNKNOWN_PRICE)
    assert not refused.dear.any()


def test_outside_the_map_there_is_no_clearance():
    clearance = clearance_map(grid_of("....\n....\n....\n...."), 0.1)
    squared = clearance.bounds(np.array([[-0.01, 0.2], [0.2, 9.0], [0.2, 0.2]]))
    assert squared[0] == squared[1] == 0.0
    assert squared[2] > 0.0
