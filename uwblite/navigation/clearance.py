"""Distance of every place of a map from the nearest obstacle, and the cost of driving there.

An obstacle is a whole cell, a square with the edge h. Distances between the centres, edges and corners of cells are whole in
halves of a cell, and along and across the rows they part: with g(c, r) the distance of column c from the nearest obstacle
of row r, d^2 = min over r of g^2 + (r's own distance)^2 (Felzenszwalb and Huttenlocher 2012, here up to a reach). Between the
centres a bound comes from interpolation: let p be the average of the four centres c_i around it with the bilinear weights
w_i, and q any point of an obstacle. Then

    sum w_i |c_i - q|^2 = |p - q|^2 + sum w_i |c_i - p|^2,   hence
    |p - q|^2 >= sum w_i d_i^2 - h^2 (u (1 - u) + v (1 - v)),   u, v = p's coordinates between the centres, 0..1.

In the same way no point of a line between p and p' comes closer than sqrt(min(d^2, d'^2) - |p - p'|^2 / 4). Checks at
sub-cell resolution with these bounds therefore hold for every point between the samples too; where the bound does not decide,
the squares around are looked at one by one.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..arrays import TINY, Bools, Floats, Ints, chunks
from ..grid.geometry import STRIP, GridGeometry
from ..grid.occupancy_grid import OCCUPIED, UNKNOWN, OccupancyGrid

COMFORT = 0.5
"""m beyond the robot's radius up to which nearness to obstacles costs something."""
NEAR_COST = 3.0
"""Additional cost of a metre driven with the robot's edge at an obstacle, in metres of open space."""
UNKNOWN_PRICE = 5.0
"""Cost of a metre through unknown space, in metres of open space, where it is not refused."""
_SPECK = 0.015
"""m^2; islands of unknown cells that are smaller are noise of the map and no obstacle."""
AT_ONCE = 300_000
"""Squares, samples or nodes looked at together."""


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceMap:
    """Distances from obstacles and costs, for a round robot."""

    geometry: GridGeometry
    half: NDArray[np.unsignedinteger]
    """(rows, cols) square of the distance from a cell's centre to the nearest obstacle, in half cells; cut off where nearness
    costs nothing any more."""
    obstacles: Bools
    """(rows, cols)."""
    dear: Bools
    """(rows, cols) cells where a metre costs UNKNOWN_PRICE."""
    radius: float
    """Of the robot, m."""
    tight: Floats
    """(k, 2) m; places on edges and corners of cells where the robot may stand, though in none of the centres beside them, or
    in two across a corner alone: in narrow passages, with an obstacle on either side."""
    refused: bool = True
    """Unknown cells are obstacles."""

    @property
    def _unit(self) -> float:
        return (0.5 * self.geometry.resolution) ** 2

    @property
    def least(self) -> int:
        """Smallest square of a distance that the robot needs, in half cells."""
        return _least(self.radius, self.geometry.resolution)

    def passable(self, rows: slice = slice(None)) -> Bools:
        """Return in which cells' centres (rows, cols) the robot may stand.

        Straight steps to a neighbour then keep the radius too, and diagonal ones where all four cells around are passable.
        """
        return np.asarray(self.half[rows] >= self.least)

    def cell_cost(self, rows: Ints | slice = slice(None), cols: Ints | slice = slice(None)) -> NDArray[np.float32]:
        """Return the cost of a metre driven at the centres of cells."""
        half = self.half[rows, cols]
        table = self._nearness(self._unit * np.arange(int(half.max(initial=0)) + 1)).astype(np.float32)
        if self.refused:
            return table[half]
        return np.where(self.dear[rows, cols], np.float32(UNKNOWN_PRICE), np.float32(1.0)) * table[half]

    def bounds(self, points: Floats) -> Floats:
        """Return lower bounds (n,) of the squared clearance at points (n, 2), m and m^2; outside the map it is 0."""
        return self._interpolated(points)[0]

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the same bounds (n,), m^2, and the costs of a metre (n,), at points (n, 2), m."""
        squared, between = self._interpolated(points)
        costs = self._nearness(self._unit * between)
        if not self.refused:
            row, col = (np.clip(n, 0, most - 1) for n, most in zip(self.geometry.cell_of(points), self.dear.shape, strict=True))
            costs *= np.where(self.dear[row, col], UNKNOWN_PRICE, 1.0)
        return squared, costs

    def _interpolated(self, points: Floats) -> tuple[Floats, Floats]:
        """Return `bounds` (n,) and `half` (n,) interpolated between the centres around, 0 outside of all."""
        place = (points.T - self.geometry.origin[:, None]) / self.geometry.resolution - 0.5
        between = ndimage.map_coordinates(self.half, place[::-1], np.float64, order=1)
        u, v = place - np.floor(place)
        return self._unit * np.maximum(between - 2.0 + (2.0 * u - 1.0) ** 2 + (2.0 * v - 1.0) ** 2, 0.0), between

    def is_obstacle(self, points: Floats) -> Bools:
        """Return which points (n, 2), m, lie in an obstacle, or outside the map."""
        row, col = self.geometry.cell_of(points)
        inside = self.geometry.inside(row, col)
        return ~inside | self.obstacles[np.where(inside, row, 0), np.where(inside, col, 0)]

    def keeps(self, points: Floats, bound: Floats, needed: Floats, owner: Ints) -> Bools:
        """Return which owners' points (n, 2), m, all keep a squared distance (n,), m^2, of which `bound` is known.

        The owners are numbered 0 ... in order; every one has a point.
        """
        grid, kept = self.geometry, np.ones(int(owner.max(initial=-1)) + 1, dtype=np.bool_)
        # A robot may touch what it passes.
        needed = needed * (1.0 - TINY)
        open_ = np.flatnonzero(bound < needed)
        cell = (points[open_] - grid.origin) / grid.resolution
        col, row = np.floor(cell).astype(np.intp).T
        outside = ~grid.inside(row, col)
        row, col = np.clip(row, 0, grid.rows - 1), np.clip(col, 0, grid.cols - 1)
        # No square is farther from a point than from the centre of its cell and back.
        most = np.sqrt(self.half[row, col]) + 2.0 * np.hypot(*(cell - np.floor(cell) - 0.5).T)
        kept[owner[open_[outside | (self._unit * most**2 < needed[open_])]]] = False
        rest = open_[kept[owner[open_]]]
        kept[owner[rest[self._exact(points[rest]) < needed[rest]]]] = False
        return kept

    def distances(self, points: Floats) -> Floats:
        """Return the distances (n,) of points (n, 2) from the nearest obstacle, m, up to the radius; beyond, lower bounds."""
        squared = self.bounds(points)
        near = np.flatnonzero(squared < self.radius**2)
        squared[near] = np.minimum(self._exact(points[near]), self.radius**2)
        return np.asarray(np.minimum(np.sqrt(squared), self.radius + COMFORT))

    def _exact(self, points: Floats) -> Floats:
        """Return the squared distance (n,) of points from the nearest obstacle within the radius and a cell more, m^2."""
        grid = self.geometry
        reach = int(np.ceil(self.radius / grid.resolution)) + 1
        dy, dx = (v.ravel() for v in np.mgrid[-reach : reach + 1, -reach : reach + 1])
        found = [np.zeros(0)]
        for part in np.split(points, range(step := max(AT_ONCE // len(dx), 1), len(points), step)):
            cell = (part - grid.origin) / grid.resolution
            col, row = (n[:, None] + d for n, d in zip(np.floor(cell).astype(np.intp).T, (dx, dy), strict=True))
            solid = ~grid.inside(row, col)
            solid |= self.obstacles[np.clip(row, 0, grid.rows - 1), np.clip(col, 0, grid.cols - 1)]
            away = [np.maximum(np.abs(p[:, None] - n - 0.5) - 0.5, 0.0) for p, n in zip(cell.T, (col, row), strict=True)]
            found.append(np.where(solid, away[0] ** 2 + away[1] ** 2, np.inf).min(axis=1, initial=np.inf))
        return grid.resolution**2 * np.concatenate(found)

    def _nearness(self, squared: Floats | NDArray[np.float32]) -> Floats:
        near = np.clip(1.0 - (np.sqrt(squared) - self.radius) / COMFORT, 0.0, 1.0)
        return np.asarray(1.0 + NEAR_COST * near**2)


def clearance_map(grid: OccupancyGrid, radius: float, *, unknown: str = "refuse") -> ClearanceMap:
    """Measure a map for a round robot with a radius, m.

    Parameters
    ----------
    unknown : 'refuse' makes unknown cells obstacles, 'price' makes them dear.
    """
    states, geometry = grid.states(), grid.geometry
    dark = states == UNKNOWN
    dark &= ~_specks(dark, geometry.resolution)
    refused = unknown == "refuse"
    obstacles = states == OCCUPIED
    obstacles |= dark & refused
    dear = np.broadcast_to(np.False_, dark.shape) if refused else dark
    half, tight = _measured(obstacles, geometry, radius)
    return ClearanceMap(geometry, half, obstacles, dear, radius, tight, refused)


def _measured(obstacles: Bools, geometry: GridGeometry, radius: float) -> tuple[NDArray[np.unsignedinteger], Floats]:
    """Return `half` and `tight` of a map with obstacles (rows, cols)."""
    least, near = _least(radius, geometry.resolution), int(np.ceil(radius / geometry.resolution)) + 1
    reach = min(int(np.ceil((radius + COMFORT) / geometry.resolution)) + 1, max(obstacles.shape) + 1)
    cut = (2 * reach) ** 2
    half = np.empty(obstacles.shape, dtype=np.uint16 if 2 * cut <= np.iinfo(np.uint16).max else np.uint32)
    tight = []
    for rows in geometry.strips():
        count = rows.stop - rows.start
        centres, edges = (squares.astype(half.dtype) for squares in _along_rows(_rows(obstacles, rows, reach), cut))
        stands = np.zeros((count + 1, geometry.cols + 1), dtype=np.bool_)
        found = _across_rows(centres, count + 1, reach, reach, 0, cut)
        half[rows], stands[:, :-1] = found[:count], found >= least
        for right, up, squares in ((1, 0, edges), (0, 1, centres), (1, 1, edges)):
            may = _across_rows(squares, count, reach, min(near, reach), up, cut) >= least
            beside = [stands[dr : dr + count, dc : dc + geometry.cols] for dr in range(up + 1) for dc in range(right + 1)]
            none = ~reduce(np.logical_or, beside)
            across = (beside[0] == beside[3]) & (beside[1] == beside[2]) & (beside[0] != beside[1]) if right and up else none
            may &= none | across
            row, col = np.nonzero(may)
            tight.append(geometry.centre_of(row + rows.start, col) + 0.5 * geometry.resolution * np.array([right, up]))
    return half, np.concatenate(tight)


def _rows(obstacles: Bools, rows: slice, margin: int) -> Bools:
    """Return some rows with a margin and one row more above; what lies outside the map is an obstacle."""
    low, high = max(rows.start - margin, 0), min(rows.stop + 1 + margin, len(obstacles))
    outside = (low - rows.start + margin, rows.stop + 1 + margin - high)
    return np.pad(obstacles[low:high], (outside, (0, 0)), constant_values=True)


def _along_rows(obstacles: Bools, cut: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return squared distances along the rows (rows, cols) from an obstacle, of centres and of the edges to their right."""
    cols = obstacles.shape[1]
    at, most = np.arange(cols, dtype=np.int32), int(np.sqrt(cut))
    left = at - np.maximum.accumulate(np.where(obstacles, at, np.int32(-1)), axis=1)
    right = np.minimum.accumulate(np.where(obstacles, at, np.int32(cols))[:, ::-1], axis=1)[:, ::-1] - at
    centres = np.asarray(np.clip(2 * np.minimum(left, right) - 1, 0, most))
    edges = np.zeros_like(left)
    edges[:, :-1] = np.minimum(2 * np.minimum(left[:, :-1], right[:, 1:]), most)
    return centres**2, edges**2


def _across_rows(
    along: NDArray[np.unsignedinteger], count: int, margin: int, reach: int, up: int, cut: int
) -> NDArray[np.unsignedinteger]:
    """Return squared distances (count, cols) in half cells, of centres or, `up` by half a cell, of the edges above."""
    found = np.full((count, along.shape[1]), cut, dtype=along.dtype)
    for d in range(up - reach, reach + 1):
        gap = 2 * max(d - 1, -d) if up else max(2 * abs(d) - 1, 0)
        np.minimum(found, along[margin + d : margin + d + count] + along.dtype.type(gap**2), out=found)
    return found


def _least(radius: float, resolution: float) -> int:
    """Return the least square of a distance, in half cells: half a cell at least, which parts a free cell from an obstacle."""
    return max(int(np.ceil((2.0 * radius / resolution) ** 2 * (1.0 - TINY))), 1)


def _specks(dark: Bools, resolution: float) -> Bools:
    """Return which unknown cells (rows, cols) belong to islands that are too small to matter."""
    if not dark.any():
        return dark
    labels, count = ndimage.label(dark)
    sizes = np.zeros(count + 1, dtype=np.intp)
    for rows in chunks(len(dark), STRIP):
        sizes += np.bincount(labels[rows].ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes * resolution**2 < _SPECK)[labels] & dark)
