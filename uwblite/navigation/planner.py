"""The cheapest path of a round robot through a map: a search over the cells, and smoothing afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..errors import DataError
from ..grid.occupancy_grid import OccupancyGrid
from .clearance import ClearanceMap, clearance_map
from .smoothing import along_lines, sampled, smoothed
from .steps import StepSearch, step_search


class NoPathError(DataError):
    """There is no way to a goal; nearest is the reachable place (2,) nearest to it, m, None where the start is the trouble."""

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
    """(n,) smallest distance that an obstacle can have from the robot's centre, m, at most the radius and COMFORT."""
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
    steps: StepSearch
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
        return PlannedPath(poses, distances, self.clearance.distances(poses[:, :2]), cost)

    def _leg(self, start: Floats, goal: Floats) -> Floats:
        """Return the corners (k, 2) of the path between two places, the first of which is left out."""
        if along_lines(self.clearance, start[None], goal[None]).open[0]:
            return goal[None]
        way, first = self._entrance(start)
        nodes = self.steps.path(first, last) if (last := self._beside(goal)) >= 0 else None
        if nodes is None:
            nearest = self.steps.places(np.array([self.steps.nearest(first, goal)]))[0]
            size = f"a radius of {self.clearance.radius:g} m in cells of {self.clearance.geometry.resolution:g} m"
            text = f"no path to {_place(goal)} with {size}; the nearest reachable point is {_place(nearest)}"
            raise NoPathError(text, nearest)
        places = self.steps.places(nodes)
        line = smoothed(self.clearance, np.concatenate([way[-1:], places[len(way) > 1 :], goal[None]]))
        return np.concatenate([way, line[1:]])[1:]

    def _entrance(self, start: Floats) -> tuple[Floats, int]:
        """Return the corners (k, 2) of the way from a place to the first node, which keeps no clearance, and that node.

        Where the way keeps it, only the place itself is returned. A robot that stands nearer to an obstacle than its radius,
        by the map, may leave straight for the nearest place where it may stand, but not through an obstacle; one in unknown
        space by the cheapest way that keeps clear of known obstacles.
        """
        if (node := self._beside(start)) >= 0:
            return start[None], node
        nodes, places = self.steps.around(start, self.clearance.radius + 2.0 * self.clearance.geometry.resolution)
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
        nodes = priced.steps.way_out(first, self.clearance.passable())
        if nodes is None:
            raise NoPathError(f"no path leads from the start {_place(start)} out of unknown space")
        line = smoothed(priced.clearance, np.concatenate([way[-1:], priced.steps.places(nodes)]))
        return np.concatenate([way, line[1:]]), int(nodes[-1])

    def _beside(self, place: Floats) -> int:
        """Return the nearest node to which a straight line keeps the clearance; -1 where there is none."""
        nodes, places = self.steps.around(place, 1.5 * self.clearance.geometry.resolution)
        clear = along_lines(self.clearance, np.broadcast_to(place, places.shape), places).clear
        return int(nodes[clear][np.argmin(np.hypot(*(places[clear] - place).T))]) if clear.any() else -1


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
    if not len(clearance.tight) and not clearance.passable().any():
        raise NoPathError(f"a robot with a radius of {radius:g} m may stand nowhere in this map")
    return Planner(clearance, step_search(clearance), grid)


def _place(point: Floats) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
