"""The cheapest path of a round robot through a map, by Dijkstra's algorithm over the cells and smoothing afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from ..arrays import Bools, Floats, Ints
from ..errors import DataError
from ..grid.occupancy_grid import OccupancyGrid
from .clearance import ClearanceMap, clearance_map
from .smoothing import along_lines, sampled, smoothed, walk_back

STEPS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""Rows and columns to the eight neighbours of a cell."""
_NOTHING = 1e-9
"""m; additional cost of a straight path through open space by rounding. No other path costs as little."""
_DETOUR = 1.5, 1.0
"""A path is looked for first among those that cost so many times the straight way, and so many metres more."""
_NEARBY = 0.25
"""Share of the map's cells up to which those in such a path's reach are worth a search of their own."""


class NoPathError(DataError):
    """There is no way to a goal.

    Parameters
    ----------
    text : what is in the way.
    nearest : (2,) the reachable place nearest to the goal, m, map frame; None where the start itself is the trouble.
    """

    def __init__(self, text: str, nearest: Floats | None = None) -> None:
        super().__init__(text)
        self.nearest = nearest


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPath:
    """A path through free space."""

    poses: Floats
    """(n, 3) x, y and the heading of the piece that begins there; m, m, rad, map frame."""
    distances: Floats
    """(n,) driven from the start, m."""
    clearances: Floats
    """(n,) smallest distance that an obstacle can have from the robot's centre, m."""
    cost: float
    """Of the whole path, in metres of open space."""

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.distances[-1])


@dataclass(frozen=True, slots=True, eq=False)
class Planner:
    """A map that has been prepared for a robot: every path then takes one search."""

    clearance: ClearanceMap
    nodes: Ints
    """(n,) flat indices of the cells in which the robot may stand."""
    node_of: NDArray[np.int32]
    """(rows, cols) number of a cell's node; -1 where the robot may not stand."""
    graph: csr_matrix
    """(n, n) costs of the steps between neighbouring cells, in metres of open space; symmetric."""
    grid: OccupancyGrid
    """What it was made of."""

    def plan(self, start: Floats, goals: Sequence[Floats], *, step: float = 0.1) -> PlannedPath:
        """Find the cheapest path.

        Parameters
        ----------
        start : (2,) or (3,) x, y and, where it is known, the heading; m, m, rad, map frame.
        goals : (2,) each: the places to pass in this order, the last of which is the goal.
        step : largest distance between poses of the path, m.

        Raises
        ------
        NoPathError : the robot cannot stand at the start, or cannot reach a goal.
        """
        line = np.asarray(start[:2], dtype=np.float64)[None]
        for goal in goals:
            line = np.concatenate([line, self._leg(line[-1], np.asarray(goal[:2], dtype=np.float64))])
        line = line[np.concatenate([[True], np.any(np.diff(line, axis=0) != 0.0, axis=1)])]
        poses, distances = sampled(line, step, float(start[2]) if len(start) > 2 else None)
        cost = float(along_lines(self.clearance, line[:-1], line[1:]).costs.sum()) if len(line) > 1 else 0.0
        return PlannedPath(poses, distances, np.sqrt(self.clearance.at(poses[:, :2])[0]), cost)

    def _leg(self, start: Floats, goal: Floats) -> Floats:
        """Return the corners (k, 2) of the path between two places, the first of which is left out."""
        straight = along_lines(self.clearance, start[None], goal[None])
        if straight.clear[0] and straight.costs[0] <= np.hypot(*(goal - start)) + _NOTHING:
            return goal[None]
        way, first = self._entrance(start)
        cells = self._search(first, self._beside(goal), goal)
        line = smoothed(self.clearance, np.concatenate([way[-1:], self._places(cells)[len(way) > 1 :], goal[None]]))
        return np.concatenate([way, line[1:]])[1:]

    def _search(self, first: int, last: int, goal: Floats) -> Ints:
        """Return the nodes (k,) of the cheapest path to the last, which is beside the goal; -1 = none is."""
        reach = _DETOUR[0] * float(np.hypot(*(self._places(np.array([first]))[0] - goal))) + _DETOUR[1]
        nearby = last >= 0 and np.pi * reach**2 < _NEARBY * len(self.nodes) * self.clearance.geometry.resolution**2
        for limit in (reach, np.inf) if nearby else (np.inf,):
            costs, before = dijkstra(self.graph, indices=first, return_predecessors=True, limit=limit)
            if last >= 0 and np.isfinite(costs[last]):
                return walk_back(before, first, last)
        raise self._no_path(goal, np.isfinite(costs))

    def _entrance(self, start: Floats) -> tuple[Floats, int]:
        """Return the corners (k, 2) of the way from a place to the first node, which keeps no clearance, and that node.

        Where the way keeps it, only the place itself is returned. A robot that stands nearer to an obstacle than its radius,
        by the map, may leave straight for the nearest place where it may stand, but not through an obstacle. One that stands
        in unknown space, into which it drove by itself, leaves it by the cheapest way that keeps clear of known obstacles.
        """
        if (node := self._beside(start)) >= 0:
            return start[None], node
        nodes, places = self._around(start, self.clearance.radius + 2.0 * self.clearance.geometry.resolution)
        free = ~along_lines(self.clearance, np.broadcast_to(start, places.shape), places).crossing
        if free.any():
            near = int(np.argmin(np.where(free, np.hypot(*(places - start).T), np.inf)))
            return np.stack([start, places[near]]), int(nodes[near])
        if self.clearance.refused:
            return self._out_of_unknown(start)
        raise NoPathError(
            f"the robot cannot stand at the start {_place(start)}: the map has an obstacle there, or ends; "
            "check the place, or plan with a smaller radius"
        )

    def _out_of_unknown(self, start: Floats) -> tuple[Floats, int]:
        """Return the corners (k, 2) of the cheapest way from a place to a node where the robot may stand, and the node."""
        priced = make_planner(self.grid, self.clearance.radius, unknown="price")
        way, first = priced._entrance(start)
        costs, before = dijkstra(priced.graph, indices=first, return_predecessors=True)
        costs[self.node_of.ravel()[priced.nodes] < 0] = np.inf
        last = int(np.argmin(costs))
        if not np.isfinite(costs[last]):
            raise NoPathError(f"no path leads from the start {_place(start)} out of unknown space")
        line = smoothed(priced.clearance, np.concatenate([way[-1:], priced._places(walk_back(before, first, last))]))
        return np.concatenate([way, line[1:]]), int(self.node_of.ravel()[priced.nodes[last]])

    def _beside(self, place: Floats) -> int:
        """Return the nearest node to which a straight line keeps the clearance; -1 where there is none."""
        nodes, places = self._around(place, 1.5 * self.clearance.geometry.resolution)
        clear = along_lines(self.clearance, np.broadcast_to(place, places.shape), places).clear
        return int(nodes[clear][np.argmin(np.hypot(*(places[clear] - place).T))]) if clear.any() else -1

    def _around(self, place: Floats, reach: float) -> tuple[Ints, Floats]:
        """Return the nodes (k,) up to a distance, m, and their places (k, 2)."""
        grid = self.clearance.geometry
        row, col = (int(v) for v in grid.cell_of(np.clip(place, grid.origin - reach, grid.corner + reach)))
        cells = int(np.ceil(reach / grid.resolution))
        window = self.node_of[max(row - cells, 0) : row + cells + 1, max(col - cells, 0) : col + cells + 1]
        nodes = window[window >= 0].astype(np.intp)
        places = self._places(nodes)
        near = np.hypot(*(places - place).T) <= reach
        return nodes[near], places[near]

    def _places(self, nodes: Ints) -> Floats:
        return self.clearance.geometry.centre_of(*np.divmod(self.nodes[nodes], self.clearance.geometry.cols))

    def _no_path(self, goal: Floats, reached: Bools) -> NoPathError:
        places = self._places(np.flatnonzero(reached))
        nearest = places[np.argmin(np.hypot(*(places - goal).T))]
        return NoPathError(f"no path to {_place(goal)}; the nearest reachable point is {_place(nearest)}", nearest)


def make_planner(grid: OccupancyGrid, radius: float, *, unknown: str = "refuse") -> Planner:
    """Prepare a map for planning.

    Parameters
    ----------
    radius : of the robot, m.
    unknown : 'refuse' keeps the robot out of unknown space, 'price' makes it dear (see clearance.UNKNOWN_PRICE).

    Raises
    ------
    NoPathError : there is no place in which the robot may stand.
    """
    clearance = clearance_map(grid, radius, unknown=unknown)
    passable = clearance.passable()
    nodes = np.flatnonzero(passable)
    if not len(nodes):
        raise NoPathError(f"a robot with a radius of {radius:g} m may stand nowhere in this map")
    node_of = np.full(passable.shape, -1, dtype=np.int32)
    node_of.ravel()[nodes] = np.arange(len(nodes), dtype=np.int32)
    return Planner(clearance, nodes, node_of, _step_graph(clearance, nodes, node_of), grid)


def _step_graph(clearance: ClearanceMap, nodes: Ints, node_of: NDArray[np.int32]) -> csr_matrix:
    """Return the costs (n, n) of the steps: their lengths times the mean cost of a metre at both ends."""
    width = node_of.shape[1] + 2
    walled = np.pad(node_of, 1, constant_values=-1).ravel()
    row, col = np.divmod(nodes, node_of.shape[1])
    at = (row + 1) * width + col + 1
    half = (0.5 * clearance.geometry.resolution * clearance.cell_cost().ravel()[nodes]).astype(np.float64)
    targets = np.stack([walled[at + dr * width + dc] for dr, dc in STEPS], axis=1)
    there = targets >= 0
    lengths = np.hypot(*np.array(STEPS).T)
    costs = (half[:, None] + half[targets]) * lengths
    starts = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return csr_matrix((costs[there], targets[there], starts), shape=(len(nodes), len(nodes)))


def _place(point: Floats) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
