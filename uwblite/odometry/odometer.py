"""The odometry of the last seconds, looked up by time."""

import numpy as np

from .. import se2
from ..arrays import Floats

_SECONDS = 30.0
"""s that are kept: more than the largest delay of a sensor's message."""
FASTEST = 5.0
"""m/s and rad/s; a faster step is not real: the base's counters, or the gyro's heading, were reset."""
_ROOM = 64
"""Poses for which there is memory at least."""
_LEAST_STEP = 0.5
"""m and rad; a smaller step is no jump, however short its time."""


class Odometer:
    """A trajectory of the last seconds: poses are added at its end and removed at its beginning."""

    def __init__(self) -> None:
        self._stamps, self._poses = np.zeros(_ROOM), np.zeros((_ROOM, *se2.POSE))
        self._begin = self._end = 0
        self.jumps = 0
        """Number of impossible steps; they count as standing still."""
        self.late = 0
        """Poses that were left out: not newer than the one before, or not finite."""

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def stamp(self) -> float:
        """Time of the last pose, s; -inf before the first."""
        return float(self._stamps[self._end - 1]) if len(self) else -np.inf

    @property
    def pose(self) -> Floats:
        """(3,) last pose; m, m, rad."""
        return self._poses[self._end - 1]

    def add(self, stamp: float, pose: Floats) -> Floats | None:
        """Take a pose (3,) and return the step (3,) since the one before; None where it is not used, or is the first.

        A jump goes into the trajectory, with what was there before moved along: what is relative to the last pose stays there.
        """
        if not np.isfinite([stamp, *pose]).all() or stamp <= self.stamp:
            self.late += 1
            return None
        if not len(self):
            self._append(stamp, pose)
            return None
        step = se2.between(self.pose, pose)
        if np.abs(step).max() > max(_LEAST_STEP, FASTEST * (stamp - self.stamp)):
            self.jumps += 1
            kept = slice(self._begin, self._end)
            self._poses[kept] = se2.compose(pose, se2.between(self.pose, self._poses[kept]))
            step = np.zeros_like(step)
        self._append(stamp, pose)
        return step

    def forget_from(self, stamp: float) -> None:
        """Remove the poses from a time on, s, except the first of all."""
        kept = int(np.searchsorted(self._stamps[self._begin : self._end], stamp))
        self._end = self._begin + max(kept, 1)

    def at(self, stamps: Floats) -> Floats:
        """Return the poses (n, 3) at times (n,); beyond either end the nearest one."""
        kept = slice(self._begin, self._end)
        return se2.interpolate_trajectory(self._stamps[kept], self._poses[kept], stamps)

    def _append(self, stamp: float, pose: Floats) -> None:
        if self._end == len(self._stamps):
            self._shift()
        self._stamps[self._end], self._poses[self._end] = stamp, pose
        self._end += 1

    def _shift(self) -> None:
        """Remove old poses, and allocate as much memory again as the others take."""
        recent = int(np.searchsorted(self._stamps[: self._end], self.stamp - _SECONDS))
        first = max(self._begin, min(recent, self._end - 2))
        stamps, poses = self._stamps[first : self._end], self._poses[first : self._end]
        spare = max(_ROOM - len(stamps), len(stamps))
        self._stamps, self._poses = np.pad(stamps, (0, spare)), np.pad(poses, ((0, spare), (0, 0)))
        self._begin, self._end = 0, len(stamps)
