"""Replacement for wheels that counted nothing: the motion from scan to scan."""

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..lidar.scan_odometry import scan_steps
from ..sensor_log import LaserScans, Odometry, OdometryBreaks, SensorLog

_SCANS_APART = 0.25
"""Time between the scans whose motion replaces the wheels, s."""
_STEP_SIGMA = (0.02, 0.02, 0.01)
"""Standard deviation of such a step, m, m, rad."""
_UNKNOWN_STEP = (0.3, 0.3, 0.3)
"""The same where the scans do not match either."""
_SEARCHES = 100
"""Steps of a stretch that are searched for, where they match badly."""
_FASTEST_STEP = 1.0
"""Longest possible step, m: a speed of 4 m/s."""


def replaced(log: SensorLog, stretches: list[tuple[float, float]]) -> tuple[Odometry, OdometryBreaks]:
    """Return the odometry with the motion from scan to scan in stretches in which the wheels were lost."""
    odometry, scans = log.odometry, log.scans
    assert scans is not None
    breaks = [OdometryBreaks.none()]
    for a, b in stretches:
        odometry, own = _replaced(odometry, scans, log, a, b)
        breaks.append(own)
    return odometry, OdometryBreaks.of_all(breaks)


def _replaced(odometry: Odometry, scans: LaserScans, log: SensorLog, a: float, b: float) -> tuple[Odometry, OdometryBreaks]:
    middle = scans.middles
    period = max(float(np.median(np.diff(middle))), 1e-3)
    first_scan, last_scan = max(int(np.searchsorted(middle, a)) - 1, 0), min(int(np.searchsorted(middle, b)), len(middle) - 1)
    inside = np.unique([*range(first_scan, last_scan, max(1, round(_SCANS_APART / period))), last_scan]).astype(np.intp)
    inside = inside[(middle[inside] >= odometry.stamps[0]) & (middle[inside] <= odometry.stamps[-1])]
    if len(inside) < 2:
        return odometry, OdometryBreaks.none()
    steps, share = _smooth_steps(scans, log, inside)
    chain = se2.chain(np.zeros(3), steps)
    at = middle[inside]
    own = (odometry.stamps > at[0]) & (odometry.stamps <= at[-1])
    first, last = int(np.argmax(own)), len(own) - 1 - int(np.argmax(own[::-1]))
    moved = se2.compose(odometry.poses[first - 1 if first else 0], se2.interpolate_trajectory(at, chain, odometry.stamps[own]))
    rest = se2.compose(moved[-1], se2.between(odometry.poses[last], odometry.poses[last + 1 :]))
    poses = np.concatenate([odometry.poses[:first], moved, rest])
    sigma = np.where((share >= 0.5)[:, None], _STEP_SIGMA, _UNKNOWN_STEP)
    before = np.clip(np.searchsorted(odometry.stamps, at[1:]) - 1, 0, len(odometry.stamps) - 1)
    return Odometry(odometry.stamps, poses), OdometryBreaks(odometry.stamps[before], sigma)


def _smooth_steps(scans: LaserScans, log: SensorLog, chosen: Ints) -> tuple[Floats, Floats]:
    """Measure steps twice: the second time, directions that scans do not measure continue the motion before and after."""
    first, second = chosen[:-1], chosen[1:]
    steps, share = scan_steps(scans, log.mounting, first, second, np.zeros((len(first), 3)), _SEARCHES)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(steps, ((3, 3), (0, 0)), mode="edge"), 7, axis=0)
    usual = np.median(windows, axis=2)
    again, better = scan_steps(scans, log.mounting, first, second, usual)
    taken = np.where((better >= share - 0.1)[:, None], again, steps)
    wild = (np.hypot(taken[:, 0], taken[:, 1]) > _FASTEST_STEP) | (np.maximum(share, better) < 0.3)
    return np.where(wild[:, None], usual, taken), np.where(wild, 0.0, np.maximum(share, better))
