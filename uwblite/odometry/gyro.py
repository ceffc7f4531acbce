"""A gyro's heading in place of the wheels': distances from the wheels, directions from the gyro."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..graph.calibration import CalibrationConfig
from ..sensor_log import Gyro, Odometry, Remark, SensorLog
from .wheels import OdometryNoiseConfig

GAP = 0.25
"""s between two gyro readings from which on the wheels' own turn is taken."""
STANDING = (0.002, 0.002)
"""m and rad of the wheels in one second below which the robot stands: ticks and noise of the wheels."""
LEAST_STANDING = 3
"""Seconds of standing from which the gyro's bias is taken from them alone."""
WINDOW = 5.0
"""s over which the turns of gyro and wheels are compared where the robot never stands."""
LEFT_OF_BIAS = 0.003
"""Standard deviation of the bias that is left, rad/s: a MEMS gyro drifts so within minutes, and with its temperature."""
SCALE = 0.02
"""Standard deviation of a gyro's scale, 1; data sheets of cheap ones say 1 to 3 %."""
PER_TURN, PER_METRE = 0.005, 0.001
"""Random error of heading per radian and per metre, rad: a gyro does not slip and measures no distance."""


def settings(
    log: SensorLog, calibration: CalibrationConfig, noise: OdometryNoiseConfig
) -> tuple[CalibrationConfig, OdometryNoiseConfig]:
    """Return the priors and the noise of the odometry, with those of a gyro's heading where the recording has one.

    What the user switched off (0) stays off, and what was set smaller stays.
    """
    if log.gyro is None:
        return calibration, noise
    bias = max(calibration.heading_rate, LEFT_OF_BIAS) if calibration.heading_rate else 0.0
    scale, drift = min(calibration.heading_scale, SCALE), min(calibration.heading_per_metre, PER_METRE)
    calibration = replace(calibration, heading_rate=bias, heading_scale=scale, heading_per_metre=drift)
    per_turn, per_metre = min(noise.heading_per_turn, PER_TURN), min(noise.heading_per_metre, PER_METRE)
    return calibration, replace(noise, heading_per_turn=per_turn, heading_per_metre=per_metre)


def heading_from_gyro(log: SensorLog) -> tuple[SensorLog, list[Remark]]:
    """Return the recording with the gyro's heading in its odometry, less the gyro's bias; and a remark.

    Each step of the wheels keeps its length; its direction turns by half of what both headings differ in (the chord of
    an arc). The bias is the gyro's turn rate while the wheels stand, else the median difference to that of the wheels;
    what is left of it is estimated with the map (``heading_rate``).

    Parameters
    ----------
    log : with or without a gyro.
    """
    gyro, odometry = log.gyro, log.odometry
    if gyro is None or len(gyro.stamps) < 2 or len(odometry.stamps) < 2:
        return log, []
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    covered = _covered(gyro, odometry.stamps)
    if not covered.any():
        return log, [Remark("gyro", "the gyro was silent while the wheels were read: their heading is taken")]
    bias, standing = _bias(gyro, odometry)
    heading = np.interp(odometry.stamps, gyro.stamps, gyro.heading) - bias * (odometry.stamps - odometry.stamps[0])
    turn = np.where(covered, np.diff(heading), steps[:, 2])
    shift = se2.rotate(0.5 * (turn - steps[:, 2]), steps[:, :2])
    theta = odometry.poses[0, 2] + np.concatenate([[0.0], np.cumsum(turn)])
    along = np.cumsum(se2.rotate(theta[:-1], shift), axis=0)
    xy = odometry.poses[0, :2] + np.concatenate([np.zeros((1, 2)), along])
    poses = np.column_stack([xy, se2.wrap_angle(theta)])
    how = "by the robot's rests" if standing else "against the wheels"
    text = f"the heading is the gyro's in {covered.mean():.0%} of the odometry; its bias is {bias:+.5f} rad/s {how}"
    return replace(log, odometry=Odometry(odometry.stamps, poses)), [Remark("gyro", text)]


def _covered(gyro: Gyro, stamps: Floats) -> Bools:
    """Return for each step between stamps (n,) whether the gyro was read throughout, (n - 1,)."""
    gaps = np.concatenate([[0], np.cumsum(np.diff(gyro.stamps) > GAP)])
    before = np.clip(np.searchsorted(gyro.stamps, stamps, "right") - 1, 0, len(gaps) - 1)
    behind = np.clip(np.searchsorted(gyro.stamps, stamps, "left"), 0, len(gaps) - 1)
    inside = (stamps >= gyro.stamps[0]) & (stamps <= gyro.stamps[-1])
    return np.asarray(inside[:-1] & inside[1:] & (gaps[behind[1:]] == gaps[before[:-1]]))


def _bias(gyro: Gyro, odometry: Odometry) -> tuple[float, bool]:
    """Return the gyro's bias, rad/s, and whether it is from rests."""
    begin, end = max(gyro.stamps[0], odometry.stamps[0]), min(gyro.stamps[-1], odometry.stamps[-1])
    wheels = np.unwrap(odometry.poses[:, 2])

    def change(values: Floats, stamps: Floats, span: float) -> tuple[Floats, Floats]:
        at = np.arange(begin, end - span, 0.5 * span)
        return at, np.interp(at + span, stamps, values) - np.interp(at, stamps, values)

    _, turned = change(gyro.heading, gyro.stamps, 1.0)
    way = [change(odometry.poses[:, k], odometry.stamps, 1.0)[1] for k in (0, 1)]
    by_wheels = change(wheels, odometry.stamps, 1.0)[1]
    rests = (np.hypot(*way) < STANDING[0]) & (np.abs(by_wheels) < STANDING[1])
    if rests.sum() >= 2 * LEAST_STANDING:
        return float(np.median(turned[rests])), True
    _, turned = change(gyro.heading, gyro.stamps, WINDOW)
    _, by_wheels = change(wheels, odometry.stamps, WINDOW)
    return (float(np.median(turned - by_wheels)) / WINDOW if len(turned) else 0.0), False
