"""What a map will cost in time and memory, by the size of a recording."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Floats
from ..grid.geometry import MEGA
from ..grid.occupancy_grid import GridConfig
from ..odometry import keyframes
from ..odometry.keyframes import KeyframeConfig
from ..sensor_log import SensorLog

_GRID = GridConfig()
"""Of the defaults."""


@dataclass(frozen=True, slots=True)
class Rates:
    """What maps of a kind of recordings cost, measured on the computer of docs/lab/performance.md."""

    seconds: tuple[float, float, float, float]
    """Per keyframe, range, reading of the laser, and scan placed between keyframes."""
    bytes: tuple[float, float, float]
    """Per metre of driving, reading, and cell of the grid, while which is counted half of the graph's memory is free again."""


WITH_LIDAR = Rates((0.006, 1.5e-4, 2e-7, 1.5e-4), (0.2e6, 2.0, 8.0))
RANGES_ALONE = Rates((1e-4, 8e-4, 0.0, 0.0), (0.09e6, 0.0, 0.0))
"""Ranges alone hold the trajectory, and an optimisation takes more steps."""
SECONDS_AT_LEAST = 0.5
"""Starting, reading settings, writing files."""
BYTES_AT_LEAST = 105 * MEGA
"""Numpy, scipy, and what small recordings take."""
_SCANS = 500
"""Looked at, at most, for the size of the map."""


def model_seconds(log: SensorLog) -> float:
    """Return the wall time of a map on the computer of docs/lab/performance.md, s."""
    frames = len(keyframes.of(log, KeyframeConfig()).stamps)
    ranges = 0 if log.ranges is None else len(log.ranges.stamps)
    scans, beams = (0, 0) if log.scans is None else log.scans.ranges.shape
    # Two of a step, where the odometry agrees with these.
    placed = min(max(scans - frames, 0), 2 * frames)
    rates = WITH_LIDAR if scans else RANGES_ALONE
    return SECONDS_AT_LEAST + float(np.dot(rates.seconds, (frames, ranges, scans * beams, placed)))


def seen_size(log: SensorLog) -> Floats:
    """Return the size (2,) of what the scans saw and the robot drove through, by the odometry alone, m."""
    points = [log.odometry.poses[:, :2]]
    if log.scans is not None:
        scans = log.scans.rows(slice(None, None, -(-len(log.scans.stamps) // _SCANS) or 1))
        bases = log.odometry.at(scans.stamps)
        lasers = se2.compose(bases, log.mounting.T_base_laser)
        rows, beams = np.nonzero(scans.hits(scans.ranges))
        bearing = lasers[rows, 2] + scans.angles[beams]
        rays = scans.ranges[rows, beams][:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        points.append(lasers[rows, :2] + rays)
    return np.asarray(np.ptp(np.concatenate(points), axis=0))


def expected_cost(log: SensorLog, grid: GridConfig = _GRID) -> dict[str, float]:
    """Return the time (see model_seconds) and memory that the map of a screened recording is expected to need, and its size."""
    size = seen_size(log)
    # A larger grid gets larger cells.
    cells = 0 if log.scans is None else min(int(np.prod(size / grid.resolution)), grid.max_cells)
    scans, beams = (0, 0) if log.scans is None else log.scans.ranges.shape
    path = float(log.odometry.travelled[-1])
    return {
        "seconds": round(model_seconds(log), 1),
        "megabytes": round(expected_megabytes(path, scans, beams, cells), 0),
        "map width m": round(float(size[0]), 1) if cells else 0.0,
        "map height m": round(float(size[1]), 1) if cells else 0.0,
        "map cells": cells,
    }


def together(costs: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the time and memory of one map of several recordings."""
    once = {"seconds": SECONDS_AT_LEAST, "megabytes": BYTES_AT_LEAST / MEGA}
    return {name: sum(cost[name] for cost in costs) - (len(costs) - 1) * least for name, least in once.items()}


def expected_megabytes(path: float, scans: int, beams: int, cells: int) -> float:
    """Return the expected peak memory of a map, MB."""
    per_metre, per_reading, per_cell = (WITH_LIDAR if scans else RANGES_ALONE).bytes
    largest = max(per_metre * path, 0.5 * per_metre * path + per_cell * cells)
    return (BYTES_AT_LEAST + per_reading * scans * beams + largest) / MEGA
