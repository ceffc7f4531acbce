"""Breaks in the chain of odometry: single outliers, jumps and resets, two sources in one log.

A wheeled base moves continuously. A step between neighbouring readings that is much longer than the usual speed allows
is no motion. Where leaving out a few readings makes the chain continuous again, they were wrong; elsewhere the chain is
broken: its two sides are joined by the motion that the speed before and after it predicts, with the uncertainty of that
prediction, and all later poses are moved by it, so that ranges and scans alone determine the relative pose of the sides.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import ENOUGH, Bools, Floats
from ..errors import DataError
from ..findings import Fact
from ..sensor_log import Odometry, OdometryBreaks
from .units import IMPOSSIBLE

_LEAST_JUMP = (0.3, 0.5)
"""A shorter step, m, and a smaller turn, rad, are never a jump."""
_TIMES_USUAL = 4.0
"""Ratio of a speed that the robot never has to the usual speed."""
_LEAST_SPEED = (0.5, 2.0)
"""Usual speeds below these do not show the greatest speed, m/s and rad/s."""
_GLITCH_SECONDS = 1.0
"""A chain that is continuous again after so long was interrupted by wrong readings, s."""
_INTERLEAVED = 0.05
"""Share of jumping steps from which on two sources were written into one log."""
SAME_MOTION = 2.0
"""Time for which a robot drives as it does, s."""
_NEIGHBOURS = 6
"""Steps on either side of a break by which the motion across it is predicted."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Steps between neighbouring odometry readings and their usual size."""

    steps: Floats
    """(n-1, 3) T_k_k+1."""
    sizes: Floats
    """(n-1, 2) way, m, and turn, rad."""
    span: Floats
    """(n-1,) s."""
    speed: Floats
    """(2,) greatest plausible speed, m/s, and turn rate, rad/s."""

    @staticmethod
    def of(odometry: Odometry) -> "Motion":
        """Take the steps of an odometry."""
        steps, span, most = odometry.steps, np.diff(odometry.stamps), []
        sizes = np.column_stack([np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])])
        for size, least in zip(sizes.T, _LEAST_SPEED, strict=True):
            moving = (size > 1e-4) & (span > 0.0)
            usual = float(np.quantile(size[moving] / span[moving], 0.75)) if moving.any() else 0.0
            most.append(max(_TIMES_USUAL * usual, least))
        return Motion(steps, sizes, span, np.minimum(most, (IMPOSSIBLE, np.inf)))

    def jumps(self) -> Bools:
        """Return which steps (n-1,) no motion explains."""
        time = self.span + 2.0 * float(np.median(self.span)) if len(self.span) else self.span
        return np.asarray(np.any(self.sizes > _LEAST_JUMP + self.speed * time[:, None], axis=1))


def unmeasured(odometry: Odometry, seconds: Floats) -> Floats:
    """Return the standard deviations (b, 3) of steps of so many seconds (b,) that no wheel counts, m, m, rad.

    The robot may drive at its usual speed in any direction, and in another one after a while: such steps are a random walk.
    """
    way = float(Motion.of(odometry).speed[0]) / _TIMES_USUAL * SAME_MOTION
    return np.sqrt(seconds / SAME_MOTION)[:, None] * np.array([way, way, 0.5])


def without_glitches(odometry: Odometry) -> tuple[Odometry, list[Fact]]:
    """Leave out readings whose removal makes the chain continuous again.

    Raises
    ------
    DataError : the odometry alternates between two places all the time.
    """
    motion, stamps = Motion.of(odometry), odometry.stamps
    jumps = np.flatnonzero(motion.jumps())
    if len(jumps) > max(ENOUGH, _INTERLEAVED * len(stamps)):
        begin, end = stamps[jumps[[0, -1]]] - stamps[0]
        raise DataError(
            f"the odometry jumps {len(jumps)} times in {len(stamps)} readings, from t = {begin:.1f} to {end:.1f} s: "
            "two robots, or one robot's clock before and after it was set back, were written into one log; part them first"
        )
    wrong = np.zeros(len(stamps), dtype=bool)
    for into, out in zip(jumps[:-1].tolist(), jumps[1:].tolist(), strict=True):
        step = se2.between(odometry.poses[into], odometry.poses[out + 1])
        reach = _LEAST_JUMP + motion.speed * (stamps[out + 1] - stamps[into])
        near = np.hypot(*step[:2]) < reach[0] and abs(step[2]) < reach[1]
        if near and stamps[out] - stamps[into + 1] < _GLITCH_SECONDS and not wrong[into]:
            wrong[into + 1 : out + 1] = True
    if not wrong.any():
        return odometry, []
    fact = Fact.of("odometry-glitches", count=int(wrong.sum()), first=float(stamps[np.argmax(wrong)] - stamps[0]))
    return odometry.rows(~wrong), [fact]


def rejoined(odometry: Odometry) -> tuple[Odometry, OdometryBreaks, list[Fact]]:
    """Join the two sides of each jump by predicted motion, and return its uncertainty."""
    motion = Motion.of(odometry)
    jumps = motion.jumps()
    if not jumps.any():
        return odometry, OdometryBreaks.none(), []
    steps, sigma, at = motion.steps.copy(), [], np.flatnonzero(jumps)
    for k in at.tolist():
        near = [n for n in range(k - _NEIGHBOURS, k + _NEIGHBOURS + 1) if 0 <= n < len(steps) and not jumps[n]]
        span = max(float(motion.span[near].sum()), 1e-3) if near else 1.0
        steps[k] = motion.steps[near].sum(axis=0) / span * min(float(motion.span[k]), 1.0)
        way, turn = 0.05 + 0.5 * motion.speed * float(motion.span[k])
        sigma.append([way, way, turn])
    times, largest = (odometry.stamps[at] - odometry.stamps[0]).tolist(), float(motion.sizes[at, 0].max())
    joined = Odometry(odometry.stamps, se2.chain(odometry.poses[0], steps))
    breaks = OdometryBreaks(odometry.stamps[at], np.array(sigma))
    return joined, breaks, [Fact.of("odometry-breaks", at=times, largest=largest)]


def without_repeats(odometry: Odometry) -> tuple[Odometry, list[Fact]]:
    """Leave out readings that repeat the one before with its stamp."""
    again = np.zeros(len(odometry.stamps), dtype=bool)
    again[1:] = (np.diff(odometry.stamps) == 0.0) & np.all(np.diff(odometry.poses, axis=0) == 0.0, axis=1)
    return (odometry.rows(~again), [Fact.of("repeated-odometry", count=int(again.sum()))]) if again.any() else (odometry, [])
