"""What a map will cost in time and memory, by the size of a recording."""

from collections.abc import Sequence

import numpy as np

from .. import se2
from ..arrays import Floats
from ..grid.occupancy_grid import GridConfig
from ..sensor_log import SensorLog

SECONDS_AT_LEAST = 0.5
"""Starting, reading settings, writing files; on the computer of docs/lab/performance.md, as the figures below."""
_SECONDS_PER_METRE = 0.045
"""Of driving, with lidar: matching of clouds, graph."""
_SECONDS_PER_METRE_WITHOUT_LIDAR = 0.0005
_SECONDS_PER_RANGE, _SECONDS_PER_RANGE_WITHOUT_LIDAR = 1.5e-4, 8e-4
"""Without lidar ranges alone hold the trajectory, and an optimisation takes more steps."""
_SECONDS_PER_READING = 2e-7
"""Of the laser: parsing and tracing."""
_BYTES_PER_READING = 2.0
_BYTES_PER_METRE, _BYTES_PER_METRE_WITHOUT_LIDAR = 0.2e6, 0.09e6
_BYTES_PER_CELL = 20.0
_BYTES_AT_LEAST = 105e6
"""Numpy, scipy, and what small recordings take. With these figures 31 min in a hall are 245 MB (223 measured), the sample 118
(143), and public recordings of lidar and of ranges alone 0.9 to 1.1 times what is measured."""
_SCANS_LOOKED_AT = 500
"""At most, for the size of the map."""
_GRID = GridConfig()
"""Of the defaults."""


def work_seconds(log: SensorLog) -> float:
    """Return the time that the map of a recording takes on the computer of docs/lab/performance.md, s."""
    path = float(np.hypot(*np.diff(log.odometry.poses[:, :2], axis=0).T).sum())
    ranges = 0 if log.ranges is None else len(log.ranges.stamps)
    readings = 0 if log.scans is None else log.scans.ranges.size
    if not readings:
        return _SECONDS_PER_METRE_WITHOUT_LIDAR * path + _SECONDS_PER_RANGE_WITHOUT_LIDAR * ranges
    return _SECONDS_PER_METRE * path + _SECONDS_PER_RANGE * ranges + _SECONDS_PER_READING * readings


def model_seconds(log: SensorLog) -> float:
    """Return the wall time of a map on the computer of docs/lab/performance.md, s."""
    return SECONDS_AT_LEAST + work_seconds(log)


def seen_size(log: SensorLog) -> Floats:
    """Return the size (2,) of what the scans saw and the robot drove through, by the odometry alone, m."""
    points = [log.odometry.poses[:, :2]]
    if log.scans is not None:
        scans = log.scans.rows(slice(None, None, -(-len(log.scans.stamps) // _SCANS_LOOKED_AT) or 1))
        bases = log.odometry.at(scans.stamps)
        lasers = se2.compose(bases, log.mounting.T_base_laser)
        rows, beams = np.nonzero(scans.hits(scans.ranges))
        bearing = lasers[rows, 2] + scans.angles[beams]
        rays = scans.ranges[rows, beams][:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        points.append(lasers[rows, :2] + rays)
    return np.asarray(np.ptp(np.concatenate(points), axis=0))


def expected_cost(log: SensorLog, grid: GridConfig = _GRID) -> dict[str, float]:
    """Return the time and memory that the map of a screened recording is expected to need, and the size of the map.

    The time is that on the computer of docs/performance.md; a Raspberry Pi 4 takes several times as long.
    """
    size = seen_size(log)
    # A larger grid gets larger cells.
    cells = 0 if log.scans is None else min(int(np.prod(size / grid.resolution)), grid.max_cells)
    scans, beams = (0, 0) if log.scans is None else log.scans.ranges.shape
    path = float(np.hypot(*np.diff(log.odometry.poses[:, :2], axis=0).T).sum())
    return {
        "seconds": round(model_seconds(log), 1),
        "megabytes": round(expected_megabytes(path, scans, beams, cells), 0),
        "map width m": round(float(size[0]), 1) if cells else 0.0,
        "map height m": round(float(size[1]), 1) if cells else 0.0,
        "map cells": cells,
    }


def together(costs: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the time and memory of one map of several recordings."""
    twice = (len(costs) - 1) * SECONDS_AT_LEAST, (len(costs) - 1) * 1e-6 * _BYTES_AT_LEAST
    return {name: sum(cost[name] for cost in costs) - less for name, less in zip(("seconds", "megabytes"), twice, strict=True)}


def expected_megabytes(path: float, scans: int, beams: int, cells: int) -> float:
    """Return the expected peak memory of a map, MB."""
    lidar = _BYTES_PER_METRE * path + _BYTES_PER_READING * scans * beams + _BYTES_PER_CELL * cells
    return 1e-6 * (_BYTES_AT_LEAST + (lidar if scans else _BYTES_PER_METRE_WITHOUT_LIDAR * path))
