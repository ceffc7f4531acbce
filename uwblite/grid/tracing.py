"""Scans of recordings traced into one map.

A beam without a reading is a weak observation: "nothing there", or "too dark or too oblique". Runs of adjacent ones clear
space, with less weight, up to a distance and never beyond a wall that other beams have drawn: in a second pass over the scans.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints, chunks, evenly
from ..errors import DataError
from ..sensor_log import LaserScans
from .geometry import GridGeometry, central_box
from .occupancy_grid import OCCUPIED_ODDS, GridConfig, OccupancyGrid, from_counts, walls_of
from .ray_counter import RayCounter


@dataclass(frozen=True, slots=True, eq=False)
class ScanRays:
    """Rays of some scans."""

    origins: Floats
    """(r, 2) m, map frame."""
    endpoints: Floats
    """(r, 2) m, map frame."""
    scan: Ints
    """(r,) index of the scan, in the order given."""


def moved_scans(poses: Floats, distance: float, angle: float) -> Ints:
    """Choose scans (s,) such that between neighbours the laser, at poses (k, 3), moved or turned far enough; 0 m: all."""
    if distance <= 0.0 or len(poses) == 0:
        return np.arange(len(poses))
    chosen = [0]
    x0, y0, theta0 = poses[0].tolist()
    for index, (x, y, theta) in enumerate(poses.tolist()):
        turned = abs(math.remainder(theta - theta0, 2.0 * math.pi))
        if (x - x0) ** 2 + (y - y0) ** 2 >= distance * distance or turned >= angle:
            chosen.append(index)
            x0, y0, theta0 = x, y, theta
    return np.array(chosen, dtype=np.intp)


def in_runs(flags: Bools, least: int) -> Bools:
    """Return which flags (s, b) stand in a run of at least `least` neighbours along the last axis that are all set."""
    inside, count = np.zeros_like(flags), flags.shape[1] - least + 1
    if count > 0:
        begins = np.logical_and.reduce([flags[:, k : k + count] for k in range(least)])
        for k in range(least):
            inside[:, k : k + count] |= begins
    return inside


Progress = Callable[[int, int], None]
"""Called as progress(scans done, scans in all)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """Scans of one recording and the poses of the laser."""

    scans: LaserScans
    first: Floats
    """(k, 3) T_map_laser at the first ray of every scan."""
    last: Floats | None = None
    """(k, 3) T_map_laser at the last ray; in between the laser moves evenly. None = no deskewing."""
    flipped: bool = False
    """The laser is mounted upside down."""

    def __post_init__(self) -> None:
        count, first, last = len(self.scans.stamps), self.first, self.last
        if len(first) != count or (last is not None and last.shape != first.shape):
            raise DataError(f"{count} scans need as many poses, not {first.shape}")

    def rays(self, chosen: Ints, reach: NDArray[np.float32]) -> ScanRays:
        """Return the rays of chosen scans (s,), whose lengths (s, b) are given, m; where one is 0 there is no ray."""
        rows, first, beams = np.flatnonzero(reach > 0), self.first[chosen], reach.shape[1]
        moved = np.zeros_like(first) if self.last is None else self.last[chosen] - first
        moved[:, 2] = se2.wrap_angle(moved[:, 2])
        fraction = np.arange(beams) * (1.0 / max(beams - 1, 1))
        bearing = (first[:, 2:] + (-self.scans.angles if self.flipped else self.scans.angles)) + moved[:, 2:] * fraction
        # Single precision turns a ray by 5e-7 rad at most, far below a cell, and its sines are several times faster.
        bearing, length = bearing.astype(np.float32).take(rows), reach.take(rows)
        origins, ends = np.empty((2, 2, len(rows)))
        for axis, direction in enumerate((np.cos(bearing), np.sin(bearing))):
            origins[axis] = (first[:, axis, None] + moved[:, axis, None] * fraction).take(rows)
            ends[axis] = origins[axis] + length * direction
        return ScanRays(origins.T, ends.T, np.repeat(np.arange(len(reach)), np.count_nonzero(reach > 0, axis=1)))


def from_sweeps(
    recordings: Sequence[Sweeps],
    config: GridConfig,
    *,
    progress: Progress | None = None,
    announce: Callable[[GridGeometry], object] | None = None,
) -> OccupancyGrid:
    """Make one map of the scans of all recordings.

    Parameters
    ----------
    announce : called with the grid's geometry, the smallest around all rays, before it is allocated.

    Raises
    ------
    ConfigError : poses or readings are not finite.
    DataError : there are no scans.
    """
    tasks = [_Task(sweeps, _traced(sweeps.first, config), config) for sweeps in recordings if len(sweeps.first)]
    if not tasks:
        raise DataError("there are no scans to make a map of")
    chosen = sum(len(task.chosen) for task in tasks)
    low, high = _extent(tasks)
    if np.prod((high - low) / config.resolution) > config.max_cells:
        # Scans that lie far from all others are left out.
        box = central_box(np.concatenate([task.places for task in tasks]))
        tasks = [task for task in (task.within(*box) for task in tasks) if len(task.chosen)]
        low, high = _extent(tasks)
    count = sum(len(task.chosen) for task in tasks)
    geometry = GridGeometry.around(low, high, config.resolution, config.max_cells)
    if announce is not None:
        announce(geometry)
    counter = RayCounter(geometry, config.clear_weight, most=count)
    clears = config.max_clear_distance > 0 and config.clear_weight > 0

    def trace(counter: RayCounter, walls: Bools | None, before: int) -> None:
        for task in tasks:
            for some in task.parts():
                rays = task.sweeps.rays(some, task.reach(some, empty=walls is not None))
                counter.insert_rays(rays.origins, rays.endpoints, rays.scan, walls)
                before += len(some)
                if progress is not None:
                    progress(before, count * (2 if clears else 1))

    trace(counter, None, 0)
    if clears:
        trace(counter, walls_of(counter, config), count)
    drawn = from_counts(counter.cropped(), config)
    del counter  # Its hits take half as much memory as the map.
    missing = missing_share(recordings, drawn, config.max_clear_distance) if clears else math.nan
    return replace(drawn, scans_used=count, scans_astray=chosen - count, missing_share=missing)


def missing_share(recordings: Sequence[Sweeps], grid: OccupancyGrid, reach: float) -> float:
    """Return the share, 0..1, of the beams towards a wall of the map within reach, m, that came back without a reading.

    Beams that ended before the wall, at what is not in the map, do not count. nan where no beam meets a wall.
    """
    met = lost = 0
    g = grid.geometry
    for sweeps in (each for each in recordings if len(each.first)):
        chosen = evenly(len(sweeps.first), _SAMPLED)
        far = np.zeros((len(chosen), sweeps.scans.ranges.shape[1]), dtype=np.float32)
        far[:, ::_EVERY] = reach
        readings, rays = sweeps.scans.ranges[chosen][:, ::_EVERY].reshape(-1), sweeps.rays(chosen, far)
        along = np.linspace(0.0, 1.0, int(np.ceil(reach / g.resolution)) + 1)[1:]
        for part in np.array_split(np.arange(len(rays.origins)), len(chosen)):
            origins, way = rays.origins[part], rays.endpoints[part] - rays.origins[part]
            row, col = g.cell_of(origins + along[:, None, None] * way)
            inside = g.inside(row, col)
            wall = inside & (grid.log_odds[np.where(inside, row, 0), np.where(inside, col, 0)] > OCCUPIED_ODDS)
            distance = np.where(wall.any(axis=0), reach * along[wall.argmax(axis=0)], np.inf)
            reading = readings[part]
            nothing = np.isposinf(reading)
            lost += int((nothing & np.isfinite(distance)).sum())
            met += int(((nothing | (reading >= distance - _BEFORE)) & np.isfinite(distance)).sum())
    return lost / met if met else math.nan


_SAMPLED, _EVERY, _BEFORE = 200, 8, 0.3
"""Scans of a recording, and which of their beams, that are compared with the map; and how far before a wall, m, one may end."""
_AT_ONCE = 64
"""Scans whose rays are in memory at once."""


def _traced(poses: Floats, config: GridConfig) -> Ints:
    """Return the scans to trace of a laser at poses (k, 3)."""
    chosen = moved_scans(poses, config.move_distance, config.move_angle)
    most = max(config.most_scans, len(chosen) // 3)
    thin = config.move_distance > 0.0 and len(chosen) > most
    return chosen[np.arange(most) * len(chosen) // most] if thin else chosen


def _extent(tasks: Sequence["_Task"]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of a box around all rays, and around the laser where it sees nothing, m."""
    low, high = (end([end(task.places, axis=0) for task in tasks], axis=0) for end in (np.min, np.max))
    for task in tasks:
        for some in task.parts():
            rays = task.sweeps.rays(some, np.maximum(task.reach(some, False), task.reach(some, True)))
            low = np.minimum(low, rays.endpoints.min(axis=0, initial=np.inf))
            high = np.maximum(high, rays.endpoints.max(axis=0, initial=-np.inf))
    return low, high


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """Scans (s,) of a recording to be traced."""

    sweeps: Sweeps
    chosen: Ints
    config: GridConfig

    @property
    def places(self) -> Floats:
        """(s, 2) m, of the laser."""
        return self.sweeps.first[self.chosen, :2]

    def parts(self) -> Iterator[Ints]:
        """Return a bounded number of scans at a time."""
        return (self.chosen[part] for part in chunks(len(self.chosen), _AT_ONCE))

    def reach(self, some: Ints, empty: bool) -> NDArray[np.float32]:
        """Return the length of the beams of some scans, m, with a reading or without; 0 = others."""
        scans, config, readings = self.sweeps.scans, self.config, self.sweeps.scans.ranges[some]
        if empty:
            reach = np.float32(min(config.max_clear_distance, scans.range_max))
            return np.where(in_runs(np.isposinf(readings), config.clear_run), reach, np.float32(0.0))
        return np.where(scans.hits(readings, config.max_range or math.inf), readings, np.float32(0.0))

    def within(self, low: Floats, high: Floats) -> "_Task":
        """Return the task with the scans whose laser stood in a box."""
        return replace(self, chosen=self.chosen[np.all((self.places >= low) & (self.places <= high), axis=1)])
