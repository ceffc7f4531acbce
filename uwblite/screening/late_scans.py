"""Scans that a queue delivered late: between neighbours that agree with the odometry, they show an earlier place."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import MAD_TO_SIGMA, Bools, Floats
from ..findings import Fact
from ..lidar.scan_odometry import scan_steps
from ..sensor_log import Odometry, SensorLog, in_bursts

_SHARE = 0.6
"""Pairs that match less measure nothing."""
_ARM = 2.0
"""Distance of what a scan sees, m: by it a turn moves the readings."""
_SIGMAS = 5.0
"""Typical differences between lidar and odometry over a step, beyond which a scan is elsewhere."""
_CANCELS = 0.5
"""Share of either step's difference that is left in their sum where a scan alone is displaced, at most."""


def with_late_scans_placed(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Give the scans that came late the poses at which they were taken; only where scans came through a queue, in bursts.

    The odometry of such a recording is tied to the scans by their order. A scan that was overtaken fits neither the pose
    before it nor the one after it, by the same difference forth and back, while the odometry fits over both.
    """
    scans = log.scans
    if scans is None or not in_bursts(scans.stamps):
        return log, []
    steps, wheels = _steps(log)
    late = 1 + np.flatnonzero(displaced(se2.between(wheels, steps)))
    if not len(late):
        return log, []
    times = scans.middles
    poses = se2.compose(log.odometry.at(times[late - 1]), steps[late - 1])
    log = replace(log, odometry=_with_poses(log.odometry, times[late], poses))
    return log, [Fact.of("late-scans", count=len(late), total=len(times))]


def _steps(log: SensorLog) -> tuple[Floats, Floats]:
    """Return the motions (k - 1, 3) from each scan to the next by the lidar, where it measures one, and by the odometry."""
    assert log.scans is not None
    times = log.scans.middles
    wheels = log.odometry.motion(times[:-1], times[1:])
    rows = np.arange(len(wheels))
    steps, share = scan_steps(log.scans, log.mounting, rows, rows + 1, wheels)
    steps = np.where((share >= _SHARE)[:, None], steps, wheels)
    return steps, wheels


def displaced(off: Floats) -> Bools:
    """Return which scans (k - 1,) between two steps, of which each is off by (k, 3), m, m, rad, are alone displaced."""
    off = off * np.array([1.0, 1.0, _ARM])
    limit = _SIGMAS * MAD_TO_SIGMA * float(np.linalg.norm(np.median(np.abs(off), axis=0)))
    into, out = off[:-1], off[1:]
    least = np.minimum(np.linalg.norm(into, axis=1), np.linalg.norm(out, axis=1))
    return np.asarray((least > limit) & (np.linalg.norm(into + out, axis=1) < _CANCELS * least))


def _with_poses(odometry: Odometry, stamps: Floats, poses: Floats) -> Odometry:
    """Return the odometry with poses (m, 3) at stamps (m,), s, in place of those that it has there."""
    kept = ~np.isin(odometry.stamps, stamps)
    together = np.concatenate([odometry.stamps[kept], stamps])
    order = np.argsort(together, kind="stable")
    return Odometry(together[order], np.concatenate([odometry.poses[kept], poses])[order])
