"""Stamps: whether they are times of measurement, of receipt in bursts, or stand still."""

import numpy as np

from ..arrays import ENOUGH, Floats
from .sensors import Odometry

_WINDOW = 2.0
"""s on either side of a step over which a sensor keeps its rate and a robot its speed, more or less; queues are emptied more
often."""
_READINGS, _STEPS = 4, 100
"""Least number of steps within a window, and of such steps in all, that show how regular stamps are."""
_ARM = 0.3
"""m from the middle of a robot at which a turn counts as way."""
_BUFFERED = 10.0
"""m, more than a robot drives while readings wait in a buffer: seconds at 3 m/s at most."""


def in_bursts(stamps: Floats, progress: Floats | None = None) -> bool:
    """Return whether stamps tell the order of readings and not their times.

    A sensor measures at a steady rate, and a robot drives at a steady speed for a second. Receipt behind a queue gives many
    readings nearly one stamp, and the next ones come late. The median step then differs from that expected by more than half.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    progress : (n,) what grows in proportion to time, non-decreasing; None = the number of readings.
    """
    if len(stamps) <= _STEPS:
        return False
    way = np.arange(float(len(stamps))) if progress is None else progress
    step, advance, middle = np.diff(stamps), np.diff(way), 0.5 * (stamps[1:] + stamps[:-1])
    first = np.searchsorted(stamps, middle - _WINDOW)
    last = np.searchsorted(stamps, middle + _WINDOW, "right") - 1
    shown = (advance > 0.0) & (last - first >= _READINGS)
    if shown.sum() < _STEPS:
        return False
    expected = (advance * (stamps[last] - stamps[first]))[shown] / (way[last] - way[first])[shown]
    # Readings that all have one stamp expect no time between them.
    return bool(np.mean(np.abs(step[shown] - expected) > 0.5 * expected) > 0.5)


def odometry_in_bursts(odometry: Odometry) -> bool:
    """Return whether the stamps of an odometry tell the order of its readings and not their times, see in_bursts.

    They are even neither in time nor by the way: a log thinned by motion is even by the way, and a robot may jerk.
    """
    advance = np.hypot(*odometry.steps[:, :2].T) + _ARM * np.abs(odometry.steps[:, 2])
    return in_bursts(odometry.stamps) and in_bursts(odometry.stamps, np.concatenate([[0.0], np.cumsum(advance)]))


def stand_still(stamps: Floats, travelled: Floats) -> bool:
    """Return whether stamps (n,), s, in the order of the readings, stand still while the robot drives, until each reading so
    far (n,), m, and farther within one stamp than while a buffer fills."""
    if len(stamps) < ENOUGH or travelled[-1] - travelled[0] <= 0.0:
        return False
    way = np.diff(travelled)
    group = np.concatenate([[0], np.cumsum(np.diff(stamps) != 0.0)])
    within = np.where(group[1:] == group[:-1], way, 0.0)
    far = np.bincount(group[1:], within) > min(_BUFFERED, 0.5 * float(way.sum()))
    return float(within[far[group[1:]]].sum()) > 0.5 * float(way.sum())
