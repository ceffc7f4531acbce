"""Stamps: whether they are times of measurement, of receipt in bursts, or stand still."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats
from .sensors import Odometry


@dataclass(frozen=True, slots=True)
class StampPolicy:
    """What shows how stamps were made."""

    window: ClassVar[float] = 2.0
    """s on either side of a step over which a sensor keeps its rate and a robot its speed, more or less; queues are emptied
    more often."""
    readings: ClassVar[int] = 4
    steps: ClassVar[int] = 100
    """Least number of steps within a window, and of such steps in all, that show how regular stamps are."""
    anywhere: ClassVar[float] = 0.5
    """Share of the time between two readings by which each may be displaced before their order means nothing."""
    arm: ClassVar[float] = 0.3
    """m from the middle of a robot at which a turn counts as way."""
    few_stamps: ClassVar[int] = 20
    """Stamps that may be equal by chance."""
    buffered: ClassVar[float] = 10.0
    """m; more than a robot drives while readings wait in a buffer: a few seconds at 3 m/s at most."""


def in_bursts(stamps: Floats, progress: Floats | None = None) -> bool:
    """Return whether stamps tell the order of readings and not their times.

    A sensor measures at a steady rate, and a robot drives at a steady speed for a second. Receipt behind a queue gives many
    readings nearly one stamp, and the next ones come late. The median step then differs from that expected by more than half.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    progress : (n,) what grows in proportion to time, non-decreasing; None = the number of readings.
    """
    if len(stamps) <= StampPolicy.steps:
        return False
    way = np.arange(float(len(stamps))) if progress is None else progress
    step, advance, middle = np.diff(stamps), np.diff(way), 0.5 * (stamps[1:] + stamps[:-1])
    first = np.searchsorted(stamps, middle - StampPolicy.window)
    last = np.searchsorted(stamps, middle + StampPolicy.window, "right") - 1
    shown = (advance > 0.0) & (last - first >= StampPolicy.readings)
    if shown.sum() < StampPolicy.steps:
        return False
    expected = (advance * (stamps[last] - stamps[first]))[shown] / (way[last] - way[first])[shown]
    # Readings that all have one stamp expect no time between them.
    off = np.abs(step[shown] - expected) > StampPolicy.anywhere * expected
    return bool(off.mean() > StampPolicy.anywhere)


def odometry_in_bursts(odometry: Odometry) -> bool:
    """Return whether the stamps of an odometry tell the order of its readings and not their times, see in_bursts.

    They are even neither in time nor by the way: a log thinned by motion is even by the way, and a robot may jerk.
    """
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    advance = np.hypot(steps[:, 0], steps[:, 1]) + StampPolicy.arm * np.abs(steps[:, 2])
    return in_bursts(odometry.stamps) and in_bursts(odometry.stamps, np.concatenate([[0.0], np.cumsum(advance)]))


def stand_still(stamps: Floats, travelled: Floats) -> bool:
    """Return whether stamps (n,), s, in the order of the readings, stand still while the robot drives.

    Readings that waited in a buffer share a stamp as well, and then a robot drives no farther within one than it does while a
    buffer fills.

    Parameters
    ----------
    travelled : (n,) m, distance driven until each reading.
    """
    if len(stamps) < StampPolicy.few_stamps or travelled[-1] - travelled[0] <= 0.0:
        return False
    way = np.diff(travelled)
    group = np.concatenate([[0], np.cumsum(np.diff(stamps) != 0.0)])
    within = np.where(group[1:] == group[:-1], way, 0.0)
    far = np.bincount(group[1:], within) > min(StampPolicy.buffered, 0.5 * float(way.sum()))
    return float(within[far[group[1:]]].sum()) > 0.5 * float(way.sum())
