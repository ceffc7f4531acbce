"""The map: a grid of log-odds of being occupied, from rays through a binary Bayes filter (paper: step 3).

A cell starts unknown, log-odds 0. Every scan contributes at most one observation to a cell: *hit* where a ray ended, *miss*
where rays passed through (a hit of the same scan wins, so that rays grazing a wall do not wear it away). With independent
scans Bayes' rule adds log-odds,

    l = hits log(p_hit / (1 - p_hit)) + misses log(p_miss / (1 - p_miss)),    |l| <= clamp,

so only two counts per cell need be kept, their order does not matter, and work can be split and added up exactly. A person
who stood somewhere for a few scans is outvoted by the later scans that see the place free.

A beam that saw nothing is a weak observation: the URG-04LX cannot distinguish "nothing there" from "too dark or too oblique".
Such beams never draw anything; runs of adjacent ones clear space, with less weight, up to a stated distance and never beyond a
wall that other beams have drawn. That takes a second walk over the scans, once the walls are known.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from ..config import setting
from ..errors import ConfigError, DataError
from ..sensor_log import LaserScans
from .geometry import GridGeometry, central_box
from .ray_counter import WEIGHT_UNIT, Counts, RayCounter
from .scan_rays import ScanRays, empty_reach, extent, moved_scans, scan_rays, seen_reach

Progress = Callable[[int, int], None]
"""Called as progress(scans done, scans in all)."""

OCCUPIED_ABOVE = 0.65
"""Probability above which a cell counts as occupied."""
FREE_BELOW = 0.196
"""Probability below which a cell counts as free; between the two it is unknown."""
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""States of a cell, numbered as in ROS nav_msgs/OccupancyGrid."""
LEAST_CELL, LARGEST_CELL = 1e-4, 1e3
"""Edges of cells, m, beyond which no map is drawn or read."""

_SCANS_AT_A_TIME = 64
_TASKS = 8
"""Parts the scans are split into for an executor."""


@dataclass(frozen=True, slots=True)
class GridConfig:
    """How rays turn into a map."""

    resolution: float = 0.05
    """Edge of a cell, m. Halving it takes four times the memory and twice the time."""
    p_hit: float = 0.6
    """Probability that a cell in which a ray ended is occupied, 0.5..1. Lower: more scans needed to draw a wall."""
    p_miss: float = 0.45
    """Probability that a cell through which a ray passed is occupied, 0..0.5. Lower: moving things vanish sooner."""
    clamp: float = setting(12.0, advanced=True)
    """Largest absolute log-odds of a cell."""
    max_range: float = 0.0
    """Longer readings are not used, m; 0 = up to what the scanner reaches."""
    max_clear_distance: float = 3.0
    """Beams that saw nothing clear space up to this distance or the first wall, m; 0 = they clear nothing."""
    clear_run: ClassVar[int] = 5
    """Least number of adjacent beams that saw nothing before they clear space."""
    clear_weight: float = 0.5
    """Weight of a beam that saw nothing against one that passed through to a hit, 0..1 (in steps of 1/16)."""
    move_distance: float = 0.1
    """A scan is traced when the laser has moved this far since the last traced one, m; 0 = every scan."""
    move_angle: float = 0.2
    """... or has turned this far, rad."""
    max_cells: int = 40_000_000
    """Largest grid, cells (12 bytes each while it is made); a larger map is drawn with larger cells."""

    def __post_init__(self) -> None:
        if not LEAST_CELL <= self.resolution <= LARGEST_CELL:
            raise ConfigError(f"grid.resolution must lie in {LEAST_CELL:g}..{LARGEST_CELL:g} m, not {self.resolution}")
        if not 0.5 < self.p_hit < 1.0 or not 0.0 < self.p_miss < 0.5:
            raise ConfigError(f"grid needs 0 < p_miss < 0.5 < p_hit < 1, not {self.p_miss} and {self.p_hit}")
        if not 0.0 <= self.clear_weight <= 1.0:
            raise ConfigError(f"grid.clear_weight must lie in 0..1, not {self.clear_weight}")
        for name in ("clamp", "max_cells", "clear_run"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"grid.{name} must be positive, not {getattr(self, name)}")


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
        return self.geometry.centre_of(row.astype(np.int64), col.astype(np.int64))


def from_counts(counter: RayCounter, config: GridConfig) -> OccupancyGrid:
    """Return the map that counted hits and misses make: additive log-odds, clamped."""
    per_hit = np.float32(math.log(config.p_hit / (1.0 - config.p_hit)))
    per_miss = np.float32(math.log(config.p_miss / (1.0 - config.p_miss)) / WEIGHT_UNIT)
    log_odds = np.zeros(counter.hits.shape, dtype=np.float32)
    # In strips: the products in double precision would be the largest arrays of the run.
    for rows in counter.geometry.strips():
        part = counter.hits[rows] * per_hit + counter.misses[rows] * per_miss
        log_odds[rows] = np.clip(part, -config.clamp, config.clamp)
    return OccupancyGrid(counter.geometry, log_odds)


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """Scans of one recording and where the laser was."""

    scans: LaserScans
    first: Floats
    """(k, 3) T_map_laser at the first ray of every scan."""
    last: Floats | None = None
    """(k, 3) T_map_laser at the last ray; in between the laser moves evenly. None = no deskewing."""
    flipped: bool = False
    """The laser is mounted upside down."""

    def __post_init__(self) -> None:
        count, first, last = len(self.scans.stamps), self.first, self.last
        if first.shape != (count, 3) or (last is not None and last.shape != first.shape):
            raise DataError(f"{count} scans need as many poses, not {first.shape}")


def from_sweeps(
    recordings: Sequence[Sweeps],
    config: GridConfig = GridConfig(),
    *,
    geometry: GridGeometry | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    announce: Callable[[GridGeometry], object] | None = None,
) -> OccupancyGrid:
    """Make one map of the scans of all recordings.

    Parameters
    ----------
    geometry : the grid to fill; None = the smallest around all rays, coarser where config.max_cells asks for it.
    executor : any concurrent.futures executor; the result does not depend on it.
    announce : called with the geometry before the grid is allocated.

    Raises
    ------
    ConfigError : poses or readings are not finite.
    DataError : there are no scans.
    """
    if not any(len(sweeps.first) for sweeps in recordings):
        raise DataError("there are no scans to make a map of")
    tasks = [_task(sweeps, config) for sweeps in recordings if len(sweeps.first)]
    chosen = sum(len(task.chosen) for task in tasks)
    low, high = _around([task.extent() for task in tasks])
    if geometry is None and np.prod((high - low) / config.resolution) > config.max_cells:
        # Without the scans that lie far from all others.
        box = central_box(np.concatenate([task.first[:, :2] for task in tasks]))
        tasks = [task for task in (task.within(*box) for task in tasks) if len(task.chosen)]
        low, high = _around([task.extent() for task in tasks])
    count = sum(len(task.chosen) for task in tasks)
    grid = geometry or GridGeometry.around(low, high, config.resolution, config.max_cells)
    if announce is not None:
        announce(grid)
    counter = RayCounter(grid, config.clear_weight)
    clears = config.max_clear_distance > 0 and config.clear_weight > 0

    def trace(walls: Bools | None, before: int) -> None:
        for task in tasks:
            _trace(task, counter, walls, executor, reporter(before))
            before += len(task.chosen)

    def reporter(before: int) -> Callable[[int], None]:
        return lambda done: None if progress is None else progress(before + done, count * (2 if clears else 1))

    trace(None, 0)
    if clears:
        trace(walls_of(from_counts(counter, config)), count)
    drawn = from_counts(counter if geometry else counter.cropped(), config)
    return replace(drawn, scans_used=count, scans_astray=chosen - count)


def _task(sweeps: Sweeps, config: GridConfig) -> "_Task":
    chosen = moved_scans(sweeps.first, config.move_distance, config.move_angle)
    return _Task(sweeps.scans, np.arange(len(sweeps.first)), sweeps.first, sweeps.last, sweeps.flipped, config).rows(chosen)


def _around(boxes: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return the box, given by two corners, around several."""
    return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def walls_of(grid: OccupancyGrid) -> Bools:
    """Return which cells (rows, cols) are occupied or next to an occupied one: walls without holes of two cells."""
    occupied = np.pad(grid.log_odds > math.log(OCCUPIED_ABOVE / (1.0 - OCCUPIED_ABOVE)), 1)
    beside = occupied[:-2] | occupied[1:-1] | occupied[2:]
    return beside[:, :-2] | beside[:, 1:-1] | beside[:, 2:]


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """Scans to trace and how."""

    scans: LaserScans
    chosen: Ints
    first: Floats
    last: Floats | None
    flipped: bool
    config: GridConfig

    def _parts(self) -> Iterator[slice]:
        """Yield a bounded number of scans at a time."""
        for start in range(0, len(self.chosen), _SCANS_AT_A_TIME):
            yield slice(start, min(start + _SCANS_AT_A_TIME, len(self.chosen)))

    def _reach(self, part: slice, empty: bool) -> NDArray[np.float32]:
        config, chosen = self.config, self.chosen[part]
        if empty:
            return empty_reach(self.scans, chosen, config.max_clear_distance, config.clear_run)
        return seen_reach(self.scans, chosen, config.max_range or math.inf)

    def _poses(self, part: slice) -> tuple[Floats, Floats | None]:
        return self.first[part], None if self.last is None else self.last[part]

    def batches(self, empty: bool) -> Iterator[tuple[int, ScanRays]]:
        """Yield (scans done, rays): of beams that saw something, or of those that saw nothing."""
        for part in self._parts():
            yield part.stop, scan_rays(self.scans, self._reach(part, empty), *self._poses(part), flipped=self.flipped)

    def extent(self) -> tuple[Floats, Floats]:
        """Return the corners (2,) of a box around all rays, m."""
        boxes = []
        for part in self._parts():
            reach = np.maximum(self._reach(part, False), self._reach(part, True))
            boxes.append(extent(self.scans, reach, *self._poses(part), flipped=self.flipped))
        return _around(boxes)

    def within(self, low: Floats, high: Floats) -> "_Task":
        """Return the task with the scans whose laser stood in a box."""
        return self.rows(np.flatnonzero(np.all((self.first[:, :2] >= low) & (self.first[:, :2] <= high), axis=1)))

    def rows(self, which: Ints) -> "_Task":
        """Return the task with some of its scans."""
        last = None if self.last is None else self.last[which]
        return replace(self, chosen=self.chosen[which], first=self.first[which], last=last)

    def split(self, parts: int) -> "list[_Task]":
        """Return tasks that hold only their own share of the scans."""
        tasks = [self.rows(part) for part in np.array_split(np.arange(len(self.chosen)), parts) if len(part)]
        return [replace(task, scans=self.scans.rows(task.chosen), chosen=np.arange(len(task.chosen))) for task in tasks]


def _trace(
    task: _Task, counter: RayCounter, walls: Bools | None, executor: Executor | None, report: Callable[[int], None]
) -> None:
    """Trace the beams that saw something, or, where walls are given, those that saw nothing."""
    if executor is None:
        for done, rays in task.batches(empty=walls is not None):
            _insert(counter, rays, walls)
            report(done)
        return
    parts, done = task.split(_TASKS), 0
    same: tuple[list[GridGeometry], list[Bools | None]] = [counter.geometry] * len(parts), [walls] * len(parts)
    for part, counts in zip(parts, executor.map(_count, parts, *same), strict=True):
        counter.add(*counts)
        done += len(part.chosen)
        report(done)


def _count(task: _Task, geometry: GridGeometry, walls: Bools | None) -> tuple[Counts, Counts]:
    """Trace one task; runs in a worker."""
    counter = RayCounter(geometry, task.config.clear_weight)
    for _, rays in task.batches(empty=walls is not None):
        _insert(counter, rays, walls)
    return counter.hits, counter.misses


def _insert(counter: RayCounter, rays: ScanRays, walls: Bools | None) -> None:
    counter.insert_rays(rays.origins, rays.endpoints, np.full(len(rays.scan), walls is None), rays.scan, walls)
