"""What `uwblite map` will cost on this computer: the map itself is begun, and the rest of the time follows from its share."""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..arrays import Floats
    from ..mapping import MappingConfig, Stage
    from ..sensor_log import SensorLog

SECONDS_AT_LEAST = 0.5
"""Starting, reading settings, writing files; on the computer of docs/lab/performance.md, as the figures below."""
_SECONDS_PER_METRE = 0.06
"""Of driving, with lidar: matching of clouds, graph."""
_SECONDS_PER_METRE_WITHOUT_LIDAR = 0.0005
_SECONDS_PER_RANGE, _SECONDS_PER_RANGE_WITHOUT_LIDAR = 3e-4, 8e-4
"""Without lidar ranges alone hold the trajectory, and an optimisation takes more steps."""
_SECONDS_PER_READING = 2e-7
"""Of the laser: parsing and tracing."""
_BYTES_PER_READING = 2.0
_BYTES_PER_METRE = 0.45e6
_BYTES_PER_CELL = 20.0
_BYTES_AT_LEAST = 70e6
_SCANS_LOOKED_AT = 500
"""At most, for the size of the map."""
_TRIAL_SECONDS = 3.0
"""After so long the map that was begun is given up. The stage that it is in ends its step first."""


def work_seconds(log: "SensorLog") -> float:
    """Return the time that the map of a recording takes on the computer of docs/lab/performance.md, s."""
    import numpy as np

    path = float(np.hypot(*np.diff(log.odometry.poses[:, :2], axis=0).T).sum())
    ranges = 0 if log.ranges is None else len(log.ranges.stamps)
    readings = 0 if log.scans is None else log.scans.ranges.size
    if not readings:
        return _SECONDS_PER_METRE_WITHOUT_LIDAR * path + _SECONDS_PER_RANGE_WITHOUT_LIDAR * ranges
    return _SECONDS_PER_METRE * path + _SECONDS_PER_RANGE * ranges + _SECONDS_PER_READING * readings


def model_seconds(log: "SensorLog") -> float:
    """Return the wall time of a map on the computer of docs/lab/performance.md, s."""
    return SECONDS_AT_LEAST + work_seconds(log)


def expected_seconds(log: "SensorLog", config: "MappingConfig | None" = None) -> float:
    """Return the expected wall time of a map on this computer, s.

    The map is begun. If it ends within a few seconds, its time is known; if not, the time so far is divided by the share
    of the work that usually lies before the point reached (stage_shares.py). So what the recording holds, anywhere along
    it, the settings, and the computer with its numpy and scipy count as they count in the map. What cannot be mapped gets
    the model's time.
    """
    from ..errors import Cancelled, UwbliteError
    from ..mapping import build_map
    from .stage_shares import Overall

    overall = Overall(lidar=log.scans is not None and (config is None or config.use_lidar))
    began = time.perf_counter()

    def progress(stage: "Stage", done: int, total: int) -> bool:
        return overall.take(stage, done, total) <= 0.0 or time.perf_counter() - began < _TRIAL_SECONDS

    try:
        build_map(log, config, progress=progress)
    except Cancelled:
        return SECONDS_AT_LEAST + (time.perf_counter() - began) / overall.share
    except UwbliteError:
        return model_seconds(log)
    return SECONDS_AT_LEAST + time.perf_counter() - began


def seen_size(log: "SensorLog") -> "Floats":
    """Return the size (2,) of what the scans saw and the robot drove through, by the odometry alone, m."""
    import numpy as np

    from .. import se2

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


def expected_megabytes(path: float, scans: int, beams: int, cells: int) -> float:
    """Return the expected peak memory of a map, MB."""
    lidar = _BYTES_PER_METRE * path + _BYTES_PER_READING * scans * beams + _BYTES_PER_CELL * cells
    return 1e-6 * (_BYTES_AT_LEAST + (lidar if scans else 0.05 * _BYTES_PER_METRE * path))
