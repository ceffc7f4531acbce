"""Breaks in the chain of odometry: single outliers, jumps and resets, two sources in one log.

A wheeled base moves continuously. A step between neighbouring readings that is much longer than the usual speed allows
is no motion. Where leaving out a few readings makes the chain continuous again, they were wrong; elsewhere the chain is
broken: its two sides are joined by the motion that the speed before and after it predicts, with the uncertainty of that
prediction, and all later poses are moved by it, so that ranges and scans alone determine the relative pose of the sides.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..errors import DataError
from ..findings import Fact
from ..sensor_log import Odometry, OdometryBreaks
from .units import FASTEST

_LEAST_JUMP = 0.3
"""A shorter step is never a jump, m."""
_LEAST_SPIN = 0.5
"""A smaller turn is never a jump, rad."""
_TIMES_USUAL = 4.0
"""Ratio of a speed that the robot never has to the usual speed."""
_LEAST_SPEED, _LEAST_TURN_RATE = 0.5, 2.0
"""Usual speeds below these do not show the greatest speed, m/s and rad/s."""
_GLITCH_SECONDS = 1.0
"""A chain that is continuous again after so long was interrupted by wrong readings, s."""
_INTERLEAVED = 0.05
"""Share of jumping steps from which on two sources were written into one log."""
_NEIGHBOURS = 6
"""Steps on either side of a break by which the motion across it is predicted."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Steps between neighbouring odometry readings and their usual size."""

    steps: Floats
    """(n-1, 3) T_k_k+1."""
    span: Floats
    """(n-1,) s."""
    speed: Floats
    """(2,) greatest plausible speed, m/s, and turn rate, rad/s."""

    @staticmethod
    def of(odometry: Odometry) -> "Motion":
        """Take the steps of an odometry."""
        steps, span = odometry.steps, np.diff(odometry.stamps)
        length, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
        most = []
        for size, least in ((length, _LEAST_SPEED), (turn, _LEAST_TURN_RATE)):
            moving = (size > 1e-4) & (span > 0.0)
            usual = float(np.quantile(size[moving] / span[moving], 0.75)) if moving.any() else 0.0
            most.append(max(_TIMES_USUAL * usual, least))
        return Motion(steps, span, np.array([min(most[0], 3.0 * FASTEST), most[1]]))

    def jumps(self) -> Bools:
        """Return which steps (n-1,) no motion explains."""
        length, turn = np.hypot(self.steps[:, 0], self.steps[:, 1]), np.abs(self.steps[:, 2])
        time = self.span + 2.0 * float(np.median(self.span)) if len(self.span) else self.span
        return (length > _LEAST_JUMP + self.speed[0] * time) | (turn > _LEAST_SPIN + self.speed[1] * time)


def without_glitches(odometry: Odometry) -> tuple[Odometry, list[Fact]]:
    """Leave out readings whose removal makes the chain continuous again.

    Raises
    ------
    DataError : the odometry alternates between two places all the time.
    """
    jumps = np.flatnonzero(Motion.of(odometry).jumps())
    if not len(jumps):
        return odometry, []
    if len(jumps) > max(20, _INTERLEAVED * len(odometry.stamps)):
        raise DataError(
            f"the odometry jumps {len(jumps)} times in {len(odometry.stamps)} readings, from t = "
            f"{odometry.stamps[jumps[0]] - odometry.stamps[0]:.1f} to {odometry.stamps[jumps[-1]] - odometry.stamps[0]:.1f} s: "
            "two robots, or one robot's clock before and after it was set back, were written into one log; part them first"
        )
    wrong = np.zeros(len(odometry.stamps), dtype=bool)
    motion = Motion.of(odometry)
    for into, out in zip(jumps[:-1].tolist(), jumps[1:].tolist(), strict=True):
        span = odometry.stamps[out + 1] - odometry.stamps[into]
        step = se2.between(odometry.poses[into], odometry.poses[out + 1])
        reach = np.array([_LEAST_JUMP, _LEAST_SPIN]) + motion.speed * span
        near = np.hypot(*step[:2]) < reach[0] and abs(step[2]) < reach[1]
        if near and odometry.stamps[out] - odometry.stamps[into + 1] < _GLITCH_SECONDS and not wrong[into]:
            wrong[into + 1 : out + 1] = True
    if not wrong.any():
        return odometry, []
    first = float(odometry.stamps[np.argmax(wrong)] - odometry.stamps[0])
    fact = Fact.of("odometry-glitches", count=int(wrong.sum()), first=first)
    return Odometry(odometry.stamps[~wrong], odometry.poses[~wrong]), [fact]


def rejoined(odometry: Odometry) -> tuple[Odometry, OdometryBreaks, list[Fact]]:
    """Join the two sides of each jump by predicted motion, and return its uncertainty."""
    motion = Motion.of(odometry)
    jumps = motion.jumps()
    if not jumps.any():
        return odometry, OdometryBreaks.none(), []
    steps, sigma = motion.steps.copy(), []
    for k in np.flatnonzero(jumps).tolist():
        near = [n for n in range(k - _NEIGHBOURS, k + _NEIGHBOURS + 1) if 0 <= n < len(steps) and not jumps[n]]
        span = max(float(motion.span[near].sum()), 1e-3) if near else 1.0
        rate = motion.steps[near].sum(axis=0) / span if near else np.zeros(3)
        steps[k] = rate * min(float(motion.span[k]), 1.0)
        unsure = 0.5 * motion.speed * float(motion.span[k])
        sigma.append([0.05 + unsure[0], 0.05 + unsure[0], 0.05 + unsure[1]])
    at = np.flatnonzero(jumps)
    times, largest = (odometry.stamps[at] - odometry.stamps[0]).tolist(), float(np.hypot(*motion.steps[at, :2].T).max())
    joined = Odometry(odometry.stamps, se2.chain(odometry.poses[0], steps))
    breaks = OdometryBreaks(odometry.stamps[at], np.array(sigma))
    return joined, breaks, [Fact.of("odometry-breaks", at=times, largest=largest)]


def without_repeats(odometry: Odometry) -> tuple[Odometry, int]:
    """Leave out readings that repeat the one before with its stamp; return how many."""
    again = np.zeros(len(odometry.stamps), dtype=bool)
    again[1:] = (np.diff(odometry.stamps) == 0.0) & np.all(np.diff(odometry.poses, axis=0) == 0.0, axis=1)
    kept = replace(odometry, stamps=odometry.stamps[~again], poses=odometry.poses[~again])
    return (kept, int(again.sum())) if again.any() else (odometry, 0)
