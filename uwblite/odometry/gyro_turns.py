"""The turns of a gyro in place of those of the wheels, live: distances from the wheels, directions from the gyro.

The same as odometry.gyro for a whole recording, with the last minute: sign and unit of the gyro follow from the
wheels, its bias from times without motion, else from the wheels. Until both are known the turns of the wheels are used.
"""

from bisect import bisect_left

import numpy as np

from .. import se2
from ..arrays import Floats
from ..sensor_log import Gyro, Odometry
from .gyro import GAP, bias_of, reading_of

_SECONDS = 60.0
"""s; length of the time that is compared."""
_LEAST, _EVERY = 15.0, 5.0
"""s from which the gyro is tested, and between two tests: three windows of the comparison."""
_FASTEST = 5.0
"""rad/s; a faster turn is not real: the gyro's heading was reset."""


class GyroTurns:
    """An odometry whose steps turn as a gyro does."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._headings: list[float] = []
        self._wheels: list[tuple[float, Floats]] = []
        self._pose = np.zeros(3)
        self._heading: float | None = None
        self._factor = self._bias = 0.0
        self._rested = False
        self._judged = -np.inf

    def add(self, stamp: float, heading: float) -> None:
        """Take a heading from any zero; s, on the odometry's clock, rad."""
        if np.isfinite([stamp, heading]).all() and (not self._stamps or stamp > self._stamps[-1]):
            self._stamps.append(stamp)
            self._headings.append(heading)
            if stamp - self._stamps[0] > 2.0 * _SECONDS:
                self._forget(stamp - _SECONDS)

    def turned(self, stamp: float, pose: Floats) -> Floats:
        """Return a pose (3,) of the wheels with the gyro's turns since the beginning instead of theirs; m, m, rad.

        A pose that is not newer than the one before is returned as it is.
        """
        before = self._wheels[-1] if self._wheels else None
        if not np.isfinite(pose).all() or not np.isfinite(stamp) or (before is not None and stamp <= before[0]):
            return pose
        self._wheels.append((stamp, pose))
        if before is None or not self._stamps:
            # A robot without gyro; only the last pose is needed until there is one.
            self._wheels, self._pose = self._wheels[-1:], pose
            return pose
        if stamp - self._judged >= _EVERY:
            self._judge(stamp)
        heading, last = self._at(stamp), self._heading
        self._heading = heading
        step, elapsed = se2.between(before[1], pose), stamp - before[0]
        turn = float(step[2])
        if self._factor and heading is not None and last is not None:
            change = self._factor * (heading - last) - self._bias * elapsed
            turn = change if abs(change) < _FASTEST * elapsed else turn
        shift = se2.rotate(0.5 * (turn - step[2]), step[:2])
        self._pose = se2.compose(self._pose, np.array([*shift, turn]))
        return self._pose

    def _at(self, stamp: float) -> float | None:
        """Return the gyro's heading at a time, rad, a little beyond its last reading too; None where it was silent."""
        if len(self._stamps) < 2:
            return None
        k = min(max(bisect_left(self._stamps, stamp), 1), len(self._stamps) - 1)
        begin, end = self._stamps[k - 1], self._stamps[k]
        if not begin - GAP <= stamp <= end + GAP or end - begin > GAP:
            return None
        share = (stamp - begin) / (end - begin)
        return self._headings[k - 1] + share * (self._headings[k] - self._headings[k - 1])

    def _forget(self, before: float) -> None:
        old = bisect_left(self._stamps, before)
        self._stamps, self._headings = self._stamps[old:], self._headings[old:]

    def _judge(self, now: float) -> None:
        """Remove old readings, and learn the gyro's sign, unit and bias."""
        self._forget(now - _SECONDS)
        self._wheels = [w for w in self._wheels if w[0] >= now - _SECONDS]
        self._judged = now
        if len(self._stamps) < 2 or self._stamps[-1] - max(self._stamps[0], self._wheels[0][0]) < _LEAST:
            return
        stamps, poses = zip(*self._wheels, strict=True)
        wheels = Odometry(np.array(stamps), np.array(poses))
        readings, headings = np.array(self._stamps), np.array(self._headings)
        self._factor, _ = reading_of(Gyro(readings, headings), wheels)
        bias, rested = bias_of(Gyro(readings, self._factor * headings), wheels)
        if rested or not self._rested:
            self._bias, self._rested = bias, rested
