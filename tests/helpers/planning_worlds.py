"""Rooms drawn as text, for tests of planning: # wall, ? unknown, anything else free."""

import numpy as np

from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid


def grid_of(text, resolution=0.1, origin=(0.0, 0.0), scale=1):
    """Return the grid that lines of text draw, the last of which has the smallest y; a letter is `scale` cells wide."""
    rows = [line for line in text.split("\n") if line.strip()]
    letters = np.array([list(row.ljust(max(map(len, rows)))) for row in rows])[::-1]
    log_odds = np.select([letters == "#", letters == "?"], [4.0, 0.0], -4.0).astype(np.float32)
    log_odds = np.kron(log_odds, np.ones((scale, scale), dtype=np.float32))
    return OccupancyGrid(GridGeometry(resolution, np.array(origin), *log_odds.shape), log_odds)


def random_grid(seed, rows=40, cols=50, boxes=12, resolution=0.1):
    """Return a room with walls around and boxes in it."""
    rng = np.random.default_rng(seed)
    log_odds = np.full((rows, cols), -4.0, dtype=np.float32)
    log_odds[[0, -1]] = log_odds[:, [0, -1]] = 4.0
    for _ in range(boxes):
        row, col = rng.integers(0, rows - 4), rng.integers(0, cols - 4)
        height, width = rng.integers(1, 7, size=2)
        log_odds[row : row + height, col : col + width] = 4.0
    return OccupancyGrid(GridGeometry(resolution, np.array([-1.0, 2.0]), rows, cols), log_odds)


def distance_to_squares(grid, cells, points):
    """Return the exact distance (n,) of points from the nearest of the cells (rows, cols) as squares; from the outside too."""
    middle = grid.geometry.centre_of(*np.nonzero(cells))
    half = 0.5 * grid.geometry.resolution
    beyond = np.maximum(np.abs(points[:, None] - middle) - half, 0.0)
    inner = np.minimum(points - grid.geometry.origin, grid.geometry.corner - points).min(axis=1)
    return np.minimum(np.hypot(beyond[..., 0], beyond[..., 1]).min(axis=1), inner)
