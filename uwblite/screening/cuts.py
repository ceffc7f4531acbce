"""Times at which the robot is suddenly elsewhere: it was carried, or the log was cut, and no sensor measured the motion.

Neighbouring scans differ little. Where one differs from the next by far more than its neighbours do, and no motion
near that of the wheels aligns the two, the robot is at another place; so it is where ranges to several anchors jump and
the scans do not contradict them: along a smooth tunnel every scan matches every other one.
After a fast turn two scans may overlap little: the surfaces of the one then stand beside or behind those of the other.
For scans from different places, many points stand in the free space of the other.
"""

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..lidar.scan_odometry import directional_shares, in_free_space, scan_steps
from ..sensor_log import SensorLog
from . import range_motion

_NEIGHBOURS = 8
"""Scans on either side from which the usual difference of scans is computed."""
_LEAST_CHANGE = 0.25
"""Mean difference of readings, m, below which nothing happened."""
_TIMES_USUAL = 2.0
"""Factor relative to the 90 % quantile of the neighbours."""
_SILENCE = 6.0
"""Usual periods of the lidar after which two scans do not count as neighbours."""
_MOST = 40
"""Most candidates that are tested, the largest first."""
_SAME_PLACE = 0.55
"""Scans that match by a larger share are of one place."""
_EVERYWHERE = 0.5
"""Least share of matching points, in the direction that fewest points face, for scans of one place."""
_ONE_CUT = 3.0
"""Uncertainty of the time of a cut found by ranges, s."""
_THROUGH = 0.12
"""Share in free space that is too large for a true place; people and doors cause less."""
_MOST_CHANGE = 1.0
"""Limit to which the difference of a reading is clipped, m."""


def found(log: SensorLog, jumps: Floats) -> Floats:
    """Return the times (c,) of cuts, s.

    Parameters
    ----------
    jumps : (b,) times at which the odometry jumps, s.
    """
    by_lidar = _by_lidar(log)
    by_ranges = [_nearest(jumps, t) for t in range_motion.cuts(log, jumps)]
    more = [t for t in by_ranges if not same_place(log, t, t) and np.all(np.abs(by_lidar - t) > _ONE_CUT)]
    return np.sort(np.concatenate([by_lidar, more]))


def _nearest(jumps: Floats, time: float) -> float:
    """Return the jump that is the same moment as a cut by ranges, s; the cut's own time where there is none."""
    near = jumps[np.abs(jumps - time) < _ONE_CUT]
    return float(near[np.argmin(np.abs(near - time))]) if len(near) else time


def same_place(log: SensorLog, before: float, after: float) -> bool | None:
    """Return whether the last scan before a time and the first after another show one place.

    None where there are none, and where nothing would distinguish it from places along a smooth wall.
    """
    if log.scans is None or len(log.scans.stamps) < 2:
        return None
    middle = log.scans.middles
    first, second = int(np.searchsorted(middle, before, "right")) - 1, int(np.searchsorted(middle, after))
    if first < 0 or second >= len(middle) or middle[second] - after > 2.0 or before - middle[first] > 2.0:
        return None
    pair = np.array([first]), np.array([second])
    motion, share = _matched(log, *pair)
    if not 0.0 < share[0] < _SAME_PLACE:
        everywhere = share[0] > 0.0 and directional_shares(log.scans, log.mounting, *pair, motion)[0] >= _EVERYWHERE
        return True if everywhere else None
    return False


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
    # The scan itself may be wrong: those on either side of both must not match either.
    # The first and the last change are none: about them, where scans are repeated, as large a one is usual.
    apart[apart] &= _elsewhere(log, jumps[apart] - 1, jumps[apart] + 2)[0]
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
    middle = log.scans.middles
    guess = log.odometry.motion(middle[first], middle[second])
    return scan_steps(log.scans, log.mounting, first, second, guess, searches=len(first))
