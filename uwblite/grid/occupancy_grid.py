"""The map: a grid of log-odds of being occupied, from rays through a binary Bayes filter (paper: step 3).

Every scan contributes at most one observation to a cell: *hit* where a ray ended, else *miss* where rays passed through. With
independent scans Bayes' rule adds log-odds, so that only two counts per cell need be kept:

    l = hits log(p_hit / (1 - p_hit)) + misses log(p_miss / (1 - p_miss)),    |l| <= clamp.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats
from ..config import documented, require_permitted, setting
from .geometry import GridGeometry
from .ray_counter import WEIGHT_UNIT, RayCounter

OCCUPIED_ABOVE = 0.65
"""Probability above which a cell counts as occupied."""
OCCUPIED_ODDS = math.log(OCCUPIED_ABOVE / (1.0 - OCCUPIED_ABOVE))
"""The same as log-odds."""
FREE_BELOW = 0.196
"""Probability below which a cell counts as free; between the two it is unknown."""
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""States of a cell, numbered as in ROS nav_msgs/OccupancyGrid."""
LEAST_CELL, LARGEST_CELL = 1e-4, 1e3
"""Limits of the edge of a cell, m; maps outside them are neither drawn nor read."""


@dataclass(frozen=True, slots=True)
class GridConfig:
    """How rays turn into a map."""

    resolution: float = setting(0.05, minimum=LEAST_CELL, maximum=LARGEST_CELL)
    """Edge of a cell, m. Halving it takes four times the memory and twice the time."""
    p_hit: float = setting(0.6, above=0.5, below=1.0)
    """Probability that a cell in which a ray ended is occupied. Lower: more scans needed to draw a wall."""
    p_miss: float = setting(0.45, above=0.0, below=0.5)
    """Probability that a cell through which a ray passed is occupied. Lower: moving things vanish sooner."""
    clamp: float = setting(12.0, above=0.0, advanced=True)
    """Largest absolute log-odds of a cell."""
    max_range: float = 0.0
    """Longer readings are not used, m; 0 = up to what the scanner reaches."""
    max_clear_distance: float = 3.0
    """Beams that saw nothing clear space up to this distance or the first wall, m; 0 = they clear nothing."""
    clear_run: ClassVar[int] = 5
    """Least number of adjacent beams that saw nothing before they clear space."""
    clear_weight: float = setting(0.5, minimum=0.0, maximum=1.0)
    """Weight of a beam that saw nothing against one that passed through to a hit, in steps of 1/16."""
    move_distance: float = 0.1
    """A scan is traced when the laser has moved this far since the last traced one, m; of more than 8,000 of a recording, 8,000
    or a third, evenly spread; 0 = every scan, however many."""
    move_angle: float = 0.2
    """... or has turned this far, rad."""
    most_scans: ClassVar[int] = 8000
    """Scans of a recording that are traced, at most, if these are a third of all: a cell of a building of 60 x 40 m is seen in
    a hundred of so many, and a robot that drives 10 km sees more cells."""
    max_cells: int = setting(40_000_000, minimum=1)
    """Largest grid, cells (12 bytes each while it is made); a larger map is drawn with larger cells."""

    def __post_init__(self) -> None:
        require_permitted(self)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """A map of cells."""

    geometry: GridGeometry
    log_odds: NDArray[np.float32]
    """(rows, cols) log(p / (1 - p)) of being occupied; 0 = unknown."""
    scans_used: int = 0
    """Scans traced into it."""
    scans_astray: int = 0
    """Scans not traced, because they lie so far from all others that the grid would have been too large."""
    missing_share: float = math.nan
    """Share, 0..1, of the beams towards a wall nearby that came back without a reading; nan = not known."""

    def probability(self, rows: slice = slice(None)) -> NDArray[np.float32]:
        """Return the probability of being occupied (rows, cols), of some rows; 0.5 = unknown."""
        return (1.0 / (1.0 + np.exp(-self.log_odds[rows]))).astype(np.float32)

    def states(self) -> NDArray[np.int8]:
        """Return FREE, OCCUPIED or UNKNOWN (rows, cols)."""
        states = np.full(self.log_odds.shape, UNKNOWN, dtype=np.int8)
        for rows in self.geometry.strips():
            p = self.probability(rows)
            states[rows][p > OCCUPIED_ABOVE], states[rows][p < FREE_BELOW] = OCCUPIED, FREE
        return states

    def occupied_points(self) -> Floats:
        """Return the centres (n, 2) of the occupied cells, m, map frame."""
        row, col = np.nonzero(self.states() == OCCUPIED)
        return self.geometry.centre_of(row.astype(np.intp), col.astype(np.intp))


def from_counts(counter: RayCounter, config: GridConfig) -> OccupancyGrid:
    """Return the map that counted hits and misses make: additive log-odds, clamped, in the memory of the misses."""
    log_odds = counter.misses.view(np.float32)
    for rows in counter.geometry.strips():
        np.copyto(log_odds[rows], _log_odds(counter, rows, config), where=counter.seen(rows), casting="same_kind")
    return OccupancyGrid(counter.geometry, log_odds)


def _log_odds(counter: RayCounter, rows: slice, config: GridConfig) -> NDArray[np.floating]:
    """Return the log-odds of some rows: the products in double precision would otherwise be the largest arrays."""
    per_hit = np.float32(math.log(config.p_hit / (1.0 - config.p_hit)))
    per_miss = np.float32(math.log(config.p_miss / (1.0 - config.p_miss)) / WEIGHT_UNIT)
    return np.clip(counter.hits[rows].astype(np.int32) * per_hit + counter.misses[rows] * per_miss, -config.clamp, config.clamp)


def walls_of(counter: RayCounter, config: GridConfig) -> Bools:
    """Return which cells (rows, cols) are occupied or next to an occupied one: walls without holes of two cells.

    Here as in from_counts, memory of cells that no ray met is not touched.
    """
    walls, (last, cols) = np.zeros(counter.hits.shape, dtype=bool), counter.hits.shape
    for rows in counter.geometry.strips():
        first, end = max(rows.start - 1, 0), min(rows.stop + 1, last)
        occupied = np.zeros((rows.stop - rows.start + 2, cols + 2), dtype=bool)
        within = slice(first - rows.start + 1, end - rows.start + 1)
        occupied[within, 1:-1] = _log_odds(counter, slice(first, end), config).astype(np.float32) > OCCUPIED_ODDS
        beside = occupied[:-2] | occupied[1:-1] | occupied[2:]
        np.copyto(walls[rows], True, where=beside[:, :-2] | beside[:, 1:-1] | beside[:, 2:])
    return walls
