"""What `uwblite map` will cost on this computer: a model of the work, scaled by mapping the beginning of the recording."""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..sensor_log import SensorLog

SECONDS_AT_LEAST = 0.5
"""Starting, reading settings, writing files; on the computer of docs/performance.md, as the figures below."""
_SECONDS_PER_METRE = 0.06
"""Of driving, with lidar: matching of clouds, graph."""
_SECONDS_PER_METRE_WITHOUT_LIDAR = 0.001
_SECONDS_PER_RANGE = 3e-4
_SECONDS_PER_READING = 2e-7
"""Of the laser: parsing and tracing."""
_BYTES_PER_READING = 2.0
_BYTES_PER_METRE = 0.45e6
_BYTES_PER_CELL = 20.0
_BYTES_AT_LEAST = 70e6
_TRIAL_SECONDS = 0.6
"""Of work by the model: so much of the recording's beginning is mapped to see how fast this computer is."""
_LEAST_SLOPE = 0.3
"""Of the time for a piece of work, the least share that grows with it."""
_HALVINGS = 12
"""Of the recording's duration, to find a part of it."""


def work_seconds(log: "SensorLog") -> float:
    """Return the time that the map of a recording takes on the computer of docs/performance.md, s."""
    import numpy as np

    path = float(np.hypot(*np.diff(log.odometry.poses[:, :2], axis=0).T).sum())
    ranges = 0 if log.ranges is None else len(log.ranges.stamps)
    readings = 0 if log.scans is None else log.scans.ranges.size
    per_metre = _SECONDS_PER_METRE if readings else _SECONDS_PER_METRE_WITHOUT_LIDAR
    return per_metre * path + _SECONDS_PER_RANGE * ranges + _SECONDS_PER_READING * readings


def model_seconds(log: "SensorLog") -> float:
    """Return the wall time of a map on the computer of docs/performance.md, s."""
    return SECONDS_AT_LEAST + work_seconds(log)


def expected_seconds(log: "SensorLog") -> float:
    """Return the expected wall time of a map on this computer, s.

    A short and a longer beginning of the recording are mapped: their difference gives the speed, what remains of the
    shorter one is what every map takes. The trial is the work itself, so that versions of numpy and scipy, BLAS and what
    the recording holds change it as they change the map. What cannot be mapped gets the model's own speed.
    """
    whole = work_seconds(log)
    parts = [beginning(log, share * _TRIAL_SECONDS) for share in (0.25, 1.0)]
    (short, first), (long, second) = ((work_seconds(part), _seconds_of(part)) for part in parts)
    if first is None or second is None or long <= 0.0:
        return model_seconds(log)
    slowness = second / long
    if long > 1.5 * short:
        # A computer that is busy with other things may give the shorter one the worse time.
        slowness = max((second - first) / (long - short), _LEAST_SLOPE * slowness)
    return SECONDS_AT_LEAST + max(second - slowness * long, 0.0) + slowness * whole


def _seconds_of(log: "SensorLog") -> float | None:
    """Return the time that a map takes, s; None where there can be none."""
    from ..errors import UwbliteError
    from ..mapping import build_map

    began = time.perf_counter()
    try:
        build_map(log)
    except UwbliteError:
        return None
    return time.perf_counter() - began


def beginning(log: "SensorLog", seconds: float) -> "SensorLog":
    """Return the first part of a recording that is so many seconds of work by the model, or all of a short one."""
    if work_seconds(log) <= seconds:
        return log
    first, last = log.odometry.stamps[[0, -1]].tolist()
    low, high = 0.0, last - first
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if work_seconds(log.crop(first, first + middle)) < seconds else (low, middle)
    return log.crop(first, first + high)


def expected_megabytes(path: float, scans: int, beams: int, cells: int) -> float:
    """Return the expected peak memory of a map, MB."""
    lidar = _BYTES_PER_METRE * path + _BYTES_PER_READING * scans * beams + _BYTES_PER_CELL * cells
    return 1e-6 * (_BYTES_AT_LEAST + (lidar if scans else 0.05 * _BYTES_PER_METRE * path))
