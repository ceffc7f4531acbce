"""Clearance is a true lower bound, and a close one; nearness and unknown space have their price."""

import numpy as np
import pytest
from helpers.planning_worlds import distance_to_squares, grid_of, random_grid

from uwblite.grid.occupancy_grid import OCCUPIED, UNKNOWN
from uwblite.navigation.clearance import NEAR_COST, UNKNOWN_PRICE, clearance_map


@pytest.mark.parametrize("seed", range(6))
def test_no_obstacle_is_nearer_than_the_clearance_anywhere(seed):
    grid = random_grid(seed)
    clearance = clearance_map(grid, 0.2)
    h = grid.geometry.resolution
    points = np.random.default_rng(seed).uniform(grid.geometry.origin, grid.geometry.corner, (2000, 2))
    bound = np.sqrt(clearance.at(points)[0])
    true = distance_to_squares(grid, grid.states() == OCCUPIED, points)
    assert np.all(bound <= true + 1e-6)
    # What is given away: the corner of a square, (1/sqrt(2) - 1/2) h at least, and of the interpolation second order terms.
    far = true > 4 * h
    assert np.all(true[far] - bound[far] < h)


def test_steps_between_passable_cells_keep_the_radius():
    grid = random_grid(3)
    clearance = clearance_map(grid, 0.15)
    passable = clearance.passable()
    row, col = np.nonzero(passable[:-1, :-1] & passable[1:, 1:])
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
    assert np.array_equal(refused.squared == 0.0, dark & (np.arange(12) >= 8))
    assert np.all(priced.squared > 0.0)
    assert np.array_equal(priced.price == UNKNOWN_PRICE, dark & (np.arange(12) >= 8))
    assert np.all(refused.price == 1.0)


def test_outside_the_map_there_is_no_clearance():
    clearance = clearance_map(grid_of("....\n....\n....\n...."), 0.1)
    squared, _ = clearance.at(np.array([[-0.01, 0.2], [0.2, 9.0], [0.2, 0.2]]))
    assert squared[0] == squared[1] == 0.0
    assert squared[2] > 0.0
