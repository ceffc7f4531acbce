"""Moments at which the robot is suddenly elsewhere: it was carried, or the log was cut, and no sensor counted the way.

Neighbouring scans differ little. Where one differs from the next by far more than its neighbours do, and no motion
near the wheels' brings the two together, the robot is somewhere else; so it is where ranges to several anchors jump.
After a fast turn two scans may show little in common: the surfaces of the one then stand beside or behind what the other
saw. Of scans from different places, many points stand in the free space of the other.
"""

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..lidar.scan_odometry import in_free_space, scan_steps
from ..sensor_log import SensorLog
from . import range_motion

_NEIGHBOURS = 8
"""Scans on either side that say how much scans usually differ."""
_LEAST_CHANGE = 0.25
"""Mean difference of readings, m, below which nothing happened."""
_TIMES_USUAL = 2.0
"""Factor over what a tenth of the neighbours exceeds."""
_SILENCE = 6.0
"""Usual periods of the lidar after which two scans are no neighbours."""
_MOST = 40
"""Candidates looked at, the largest first."""
_SAME_PLACE = 0.55
"""Scans that match by a larger share are of one place."""
_THROUGH = 0.12
"""Share in free space that a true place does not have; people and doors leave less."""
_MOST_CHANGE = 1.0
"""A reading that differs more counts as so much, m."""


def found(log: SensorLog) -> Floats:
    """Return the times (c,) of cuts, s."""
    by_lidar = _by_lidar(log)
    if log.scans is not None and len(log.scans.stamps) > 20:
        return by_lidar
    return np.array(range_motion.cuts(log))


def same_place(log: SensorLog, before: float, after: float) -> bool | None:
    """Return whether the last scan before a time and the first after another show one place; None where there are none."""
    if log.scans is None or len(log.scans.stamps) < 2:
        return None
    middle = log.scans.middles
    first, second = int(np.searchsorted(middle, before, "right")) - 1, int(np.searchsorted(middle, after))
    if first < 0 or second >= len(middle) or middle[second] - after > 2.0 or before - middle[first] > 2.0:
        return None
    share = _matched(log, np.array([first]), np.array([second]))[1][0]
    return bool(share >= _SAME_PLACE) if share > 0.0 else None


def _by_lidar(log: SensorLog) -> Floats:
    scans = log.scans
    if scans is None or len(scans.stamps) < 2 * _NEIGHBOURS + 2 or scans.ranges.shape[1] < 30:
        return np.zeros(0)
    change = _changes(log)
    padded = np.pad(change, _NEIGHBOURS, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1).copy()
    windows[:, _NEIGHBOURS] = 0.0
    span = np.diff(scans.stamps)
    change = np.where(span > _SILENCE * max(float(np.median(span)), 1e-3), 0.0, change)
    jumps = np.flatnonzero((change > _LEAST_CHANGE) & (change > _TIMES_USUAL * np.quantile(windows, 0.9, axis=1)))
    jumps = np.sort(jumps[np.argsort(-change[jumps], kind="stable")[:_MOST]])
    if not len(jumps):
        return np.zeros(0)
    apart, share = _elsewhere(log, jumps, jumps + 1)
    apart &= share > 0.0
    # The scan itself may be at fault: those on either side of both must not match either.
    low, high = np.maximum(jumps - 1, 0), np.minimum(jumps + 2, len(scans.stamps) - 1)
    apart[apart] &= _elsewhere(log, low[apart], high[apart])[0]
    middle = scans.middles
    return 0.5 * (middle[jumps[apart]] + middle[jumps[apart] + 1])


def _changes(log: SensorLog) -> Floats:
    """Return the mean difference of readings between each scan and the next (k-1,), m."""
    assert log.scans is not None
    every = max(1, log.scans.ranges.shape[1] // 120)
    reach = min(log.scans.range_max, 30.0)
    readings = np.nan_to_num(log.scans.ranges[:, ::every], nan=reach, posinf=reach)
    return np.minimum(np.abs(np.diff(readings, axis=0)), _MOST_CHANGE).mean(axis=1)


def _elsewhere(log: SensorLog, first: Ints, second: Ints) -> tuple[Bools, Floats]:
    """Return which pairs of scans (e,) no motion near the wheels' brings together, and what share of them matches (e,)."""
    assert log.scans is not None
    motion, share = _matched(log, first, second)
    apart = share < _SAME_PLACE
    through = in_free_space(log.scans, log.mounting, first[apart], second[apart], motion[apart])
    apart[apart] &= through > _THROUGH
    return apart, share


def _matched(log: SensorLog, first: Ints, second: Ints) -> tuple[Floats, Floats]:
    """Return the motions (e, 3) at which scans match best near the wheels' guess, and how well (e,), 0..1."""
    assert log.scans is not None
    middle, odometry = log.scans.middles, log.odometry
    at = (se2.interpolate_trajectory(odometry.stamps, odometry.poses, middle[k]) for k in (first, second))
    return scan_steps(log.scans, log.mounting, first, second, se2.between(*at), searches=len(first))
