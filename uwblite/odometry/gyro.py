"""A gyro's heading in place of the wheels': distances from the wheels, directions from the gyro.

Live, with the last minute (GyroTurns): sign and unit of the gyro follow from the wheels, its bias from times without motion,
else from the wheels. Until both are known the turns of the wheels are used.
"""

from bisect import bisect_left
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..findings import Fact
from ..graph.calibration import CalibrationConfig
from ..sensor_log import Gyro, Odometry, SensorLog
from .odometer import FASTEST
from .wheels import OdometryNoiseConfig

GAP = 0.25
"""s between two gyro readings from which on the turn of the wheels is used instead."""
STANDING = 0.002
"""m and rad of the wheels in one second below which the robot stands: ticks and noise of the wheels."""
LEAST_RESTS = 6
"""Windows of standing, which overlap by half, from which the gyro's bias is taken from them alone."""
WINDOW = 5.0
"""s over which the turns of gyro and wheels are compared where the robot never stands."""
LEFT_OF_BIAS = 0.003
"""Standard deviation of the remaining bias, rad/s: a MEMS gyro drifts by this within minutes, and with its temperature."""
SCALE = 0.02
"""Standard deviation of a gyro's scale, 1; data sheets of cheap ones say 1 to 3 %."""
LEAST_TURNS = 0.1
"""rad by which wheels and gyro must turn in a window, root mean square, for their turns to be compared."""
ALIKE, UNLIKE = 0.8, 0.3
"""Correlation of the turns of gyro and wheels from which on one factor relates them, and below which they do not belong to
one robot. Slipping wheels do not reach it."""
READINGS = {
    1.0: "",
    -1.0: "it turns against the wheels, and is turned over (a sensor upside down, or one that counts clockwise)",
    np.radians(1.0): "it counts degrees",
    -np.radians(1.0): "it counts degrees, and turns against the wheels",
}
"""Factor that converts a heading to radians counter-clockwise -> the reason."""
SLIP = 3.0
"""Factor by which the turns of wheels may be wrong: those of tracks and four driven wheels are wrong by half."""
PER_TURN, PER_METRE = 0.005, 0.001
"""Random error of heading per radian and per metre, rad: a gyro does not slip and measures no distance."""


def settings(
    log: SensorLog, calibration: CalibrationConfig, noise: OdometryNoiseConfig
) -> tuple[CalibrationConfig, OdometryNoiseConfig]:
    """Return priors and noise of odometry, with those of a gyro's heading where there is one; what is off, or less, stays."""
    if log.gyro is None:
        return calibration, noise
    bias = max(calibration.heading_rate, LEFT_OF_BIAS) if calibration.heading_rate else 0.0
    scale, drift = min(calibration.heading_scale, SCALE), min(calibration.heading_per_metre, PER_METRE)
    calibration = replace(calibration, heading_rate=bias, heading_scale=scale, heading_per_metre=drift)
    per_turn, per_metre = min(noise.heading_per_turn, PER_TURN), min(noise.heading_per_metre, PER_METRE)
    return calibration, replace(noise, heading_per_turn=per_turn, heading_per_metre=per_metre)


def heading_from_gyro(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the gyro's heading, corrected by its bias, in its odometry; and a fact.

    A heading with the wrong sign or in degrees is recognised by the wheels; one that is not correlated with their turns is not
    used. Each step of the wheels keeps its length; its direction turns by half of the difference of both headings (the chord of
    an arc). The bias that remains is estimated with the map (``heading_rate``).
    """
    gyro, odometry = log.gyro, log.odometry
    if gyro is None or len(gyro.stamps) < 2 or len(odometry.stamps) < 2:
        return log, []
    steps = odometry.steps
    factor, why = reading_of(gyro, odometry)
    if not factor:
        return log, [Fact.of("gyro", why=why)]
    gyro = Gyro(gyro.stamps, factor * gyro.heading)
    covered = _covered(gyro, odometry.stamps)
    if not covered.any():
        return log, [Fact.of("gyro", why="the gyro was silent while the wheels were read: their heading is taken")]
    bias, standing = bias_of(gyro, odometry)
    heading = np.interp(odometry.stamps, gyro.stamps, gyro.heading) - bias * (odometry.stamps - odometry.stamps[0])
    turn = np.where(covered, np.diff(heading), steps[:, 2])
    poses = se2.chain(odometry.poses[0], _turned(steps, turn))
    fact = Fact.of("gyro", used=float(covered.mean()), bias=bias, rests=standing, why=why)
    return replace(log, odometry=Odometry(odometry.stamps, poses)), [fact]


def _turned(steps: Floats, turn: Floats) -> Floats:
    """Return steps (..., 3) that turn by other angles (...): each keeps the length of its arc."""
    return np.concatenate([se2.rotate(0.5 * (turn - steps[..., 2]), steps[..., :2]), np.asarray(turn)[..., None]], axis=-1)


def _covered(gyro: Gyro, stamps: Floats) -> Bools:
    """Return for each step between stamps (n,) whether the gyro was read throughout, (n - 1,)."""
    gaps = np.concatenate([[0], np.cumsum(np.diff(gyro.stamps) > GAP)])
    before = np.clip(np.searchsorted(gyro.stamps, stamps, "right") - 1, 0, len(gaps) - 1)
    behind = np.clip(np.searchsorted(gyro.stamps, stamps, "left"), 0, len(gaps) - 1)
    inside = (stamps >= gyro.stamps[0]) & (stamps <= gyro.stamps[-1])
    return np.asarray(inside[:-1] & inside[1:] & (gaps[behind[1:]] == gaps[before[:-1]]))


def bias_of(gyro: Gyro, odometry: Odometry) -> tuple[float, bool]:
    """Return the gyro's bias, rad/s, and whether it was measured while the robot stood."""
    turned, by_wheels, way = _changes(gyro, odometry, 1.0)
    rests = np.maximum(way, np.abs(by_wheels)) < STANDING
    if rests.sum() >= LEAST_RESTS:
        return float(np.median(turned[rests])), True
    turned, by_wheels, _ = _changes(gyro, odometry, WINDOW)
    return (float(np.median(turned - by_wheels)) / WINDOW if len(turned) else 0.0), False


def reading_of(gyro: Gyro, odometry: Odometry) -> tuple[float, str]:
    """Return the factor for the gyro's heading, and the reason; 0 where it is not the heading of this robot."""
    turned, by_wheels, _ = _changes(gyro, odometry, WINDOW)
    if len(turned) < 4:
        return 1.0, ""
    turned, by_wheels = turned - np.median(turned), by_wheels - np.median(by_wheels)
    by_gyro, size = np.sqrt(np.mean(turned**2)), np.sqrt(np.mean(by_wheels**2))
    if min(by_gyro, size) < LEAST_TURNS:
        return 1.0, ""
    alike = float(np.mean(turned * by_wheels) / (by_gyro * size))
    if abs(alike) < UNLIKE:
        return 0.0, f"gyro and wheels turn otherwise (correlation {alike:.2f}): the heading of the wheels is taken"
    signs = [factor for factor in READINGS if factor * alike > 0.0]
    factor = min(signs, key=lambda factor: abs(np.log(size / by_gyro / abs(factor))))
    sure = abs(alike) > ALIKE and abs(np.log(size / by_gyro / abs(factor))) < np.log(SLIP)
    return (factor, READINGS[factor]) if sure else (1.0, "")


def _changes(gyro: Gyro, odometry: Odometry, span: float) -> tuple[Floats, Floats, Floats]:
    """Return the turns of gyro and wheels in windows of `span` s, rad, and the distance of the wheels, m, (w,) each."""
    begin, end = max(gyro.stamps[0], odometry.stamps[0]), min(gyro.stamps[-1], odometry.stamps[-1])
    # Only windows with stamps: one false stamp may lie years away.
    at = begin + np.unique((odometry.stamps - begin) // (0.5 * span)) * (0.5 * span)
    at = at[(at >= begin) & (at < end - span)]

    def change(values: Floats, stamps: Floats) -> Floats:
        return np.asarray(np.interp(at + span, stamps, values) - np.interp(at, stamps, values))

    way = np.hypot(*(change(odometry.poses[:, k], odometry.stamps) for k in (0, 1)))
    return change(gyro.heading, gyro.stamps), change(np.unwrap(odometry.poses[:, 2]), odometry.stamps), way


_SECONDS = 60.0
"""s; length of the time that is compared."""
_LEAST = 15.0
"""s from which the gyro is tested, as often as a window is long."""


class GyroTurns:
    """An odometry whose steps turn as a gyro does."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._headings: list[float] = []
        self._wheels: list[tuple[float, Floats]] = []
        self._pose = np.zeros(se2.POSE)
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
        """Return a pose (3,) of wheels with the gyro's turns instead; as it is unless newer than the one before."""
        before = self._wheels[-1] if self._wheels else None
        if not np.isfinite(pose).all() or not np.isfinite(stamp) or (before is not None and stamp <= before[0]):
            return pose
        self._wheels.append((stamp, pose))
        if before is None or not self._stamps:
            # A robot without gyro; only the last pose is needed until there is one.
            self._wheels, self._pose = self._wheels[-1:], pose
            return pose
        if stamp - self._judged >= WINDOW:
            self._judge(stamp)
        heading, last = self._at(stamp), self._heading
        self._heading = heading
        step, elapsed = se2.between(before[1], pose), stamp - before[0]
        if self._factor and heading is not None and last is not None:
            change = self._factor * (heading - last) - self._bias * elapsed
            step = _turned(step, np.array(change)) if abs(change) < FASTEST * elapsed else step
        self._pose = se2.compose(self._pose, step)
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
