"""Distance of every place of a map from the nearest obstacle, and the cost of driving there.

An obstacle is a whole cell, a square with the edge h. The exact Euclidean distance transform (Felzenszwalb and
Huttenlocher 2012; scipy.ndimage) gives the distance of every cell's centre from the nearest obstacle's centre; h / sqrt(2)
less is a lower bound d of the distance from the obstacle itself. Between the centres the bound comes from interpolation.
Let p be the average of the four centres c_i around it with the bilinear weights w_i, and q any point of an obstacle. Then

    sum w_i |c_i - q|^2 = |p - q|^2 + sum w_i |c_i - p|^2,   hence
    |p - q|^2 >= sum w_i d_i^2 - h^2 (u (1 - u) + v (1 - v)),   u, v = p's coordinates between the centres, 0..1.

In the same way no point of a line between p and p' comes closer than sqrt(min(d^2, d'^2) - |p - p'|^2 / 4). Checks at
sub-cell resolution with these bounds therefore hold for every point between the samples too.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..arrays import Bools, Floats
from ..grid.geometry import GridGeometry
from ..grid.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid

COMFORT = 0.5
"""m beyond the robot's radius up to which nearness to obstacles costs something."""
NEAR_COST = 3.0
"""Additional cost of a metre driven with the robot's edge at an obstacle, in metres of open space."""
UNKNOWN_PRICE = 5.0
"""Cost of a metre through unknown space, in metres of open space, where it is not refused."""
_SPECK = 0.015
"""m^2; islands of unknown cells that are smaller are noise of the map and no obstacle."""


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceMap:
    """Distances from obstacles and costs, for a round robot."""

    geometry: GridGeometry
    squared: NDArray[np.float32]
    """(rows, cols) square of the smallest distance that an obstacle can have from the cell's centre, m^2."""
    price: NDArray[np.float32]
    """(rows, cols) factor of a metre through the cell: 1, or UNKNOWN_PRICE."""
    radius: float
    """Of the robot, m."""
    refused: bool = True
    """Unknown cells are obstacles."""

    def passable(self) -> Bools:
        """Return in which cells' centres (rows, cols) the robot may stand, so that every step to a neighbour is safe too."""
        # A step is as long as the diagonal at most: see the bound of a line above.
        return self.squared >= self.radius**2 + 0.5 * self.geometry.resolution**2

    def cell_cost(self) -> NDArray[np.float32]:
        """Return the cost (rows, cols) of a metre driven at the cells' centres."""
        return (self._nearness(self.squared) * self.price).astype(np.float32)

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return lower bounds (...) of the squared clearance, m^2, and costs of a metre (...), at points (..., 2), m.

        Outside the map the clearance is 0.
        """
        grid = self.geometry
        place = (points - grid.origin) / grid.resolution - 0.5
        low = np.floor(place)
        u, v = np.moveaxis(place - low, -1, 0)
        col, row = np.moveaxis(low.astype(np.intp), -1, 0)
        inside = (row >= 0) & (row < grid.rows - 1) & (col >= 0) & (col < grid.cols - 1)
        first = np.where(inside, row * grid.cols + col, 0)
        flat = self.squared.ravel()
        lower = (1.0 - u) * flat[first] + u * flat[first + inside]
        upper_first = first + inside * grid.cols
        upper = (1.0 - u) * flat[upper_first] + u * flat[upper_first + inside]
        bound = (1.0 - v) * lower + v * upper - grid.resolution**2 * (u * (1.0 - u) + v * (1.0 - v))
        squared = np.where(inside, np.maximum(bound, 0.0), 0.0)
        nearest = first + inside * ((v > 0.5) * grid.cols + (u > 0.5))
        return squared, self._nearness(squared) * self.price.ravel()[nearest]

    def _nearness(self, squared: Floats | NDArray[np.float32]) -> Floats:
        near = np.clip(1.0 - (np.sqrt(squared) - self.radius) / COMFORT, 0.0, 1.0)
        return np.asarray(1.0 + NEAR_COST * near**2)


def clearance_map(grid: OccupancyGrid, radius: float, *, unknown: str = "refuse") -> ClearanceMap:
    """Measure a map for a round robot.

    Parameters
    ----------
    radius : of the robot, m.
    unknown : 'refuse' makes unknown cells obstacles, 'price' makes them dear.
    """
    states = grid.states()
    dark = states == UNKNOWN
    dark &= ~_specks(dark, grid.geometry.resolution)
    refused = unknown == "refuse"
    obstacles = (states == OCCUPIED) | (dark & refused)
    price = np.where(dark & (not refused), np.float32(UNKNOWN_PRICE), np.float32(1.0))
    return ClearanceMap(grid.geometry, _squared_distances(obstacles, grid.geometry.resolution), price, radius, refused)


def _squared_distances(obstacles: Bools, resolution: float) -> NDArray[np.float32]:
    """Return squared distances (rows, cols) of the centres from the obstacles, m^2; what lies outside the map is one."""
    walled = np.pad(obstacles, 1, constant_values=True)
    cells = ndimage.distance_transform_edt(~walled)[1:-1, 1:-1]
    return np.square(np.maximum(resolution * (cells - math.sqrt(0.5)), 0.0)).astype(np.float32)


def _specks(dark: Bools, resolution: float) -> Bools:
    """Return which unknown cells (rows, cols) belong to islands that are too small to matter."""
    labels, _ = ndimage.label(dark)
    small = np.bincount(labels.ravel()) * resolution**2 < _SPECK
    return np.asarray(small[labels] & dark)
