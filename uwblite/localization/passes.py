"""A recording played through the live localiser, forwards or backwards, and the combination of both passes.

A pass estimates the pose from all earlier measurements; the pass in the opposite direction from all later ones.
They are independent, so that their poses are averaged by their covariances: the two-filter form of the optimal
smoother (D. Fraser, J. Potter, The optimum linear smoother as a combination of two optimum linear filters, 1969). The
poses of the metres that one pass needs for its start come from the other one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..sensor_log import SensorLog
from .known_map import KnownMap
from .localizer import Localizer
from .sensing import Scanner

_SPACING = (0.1, 0.1, 1.0)
"""m, rad and s between poses, and between the scans that are used: nearer ones are redundant."""
_ODOMETRY, _RANGE, _SCAN = 1, 0, 2
"""Kinds of events; of a range and an odometry at the same time the range comes first, and waits."""
_APART = 25.0
"""Squared Mahalanobis distance beyond which two passes contradict one another: 1 : 65,000 for three degrees of freedom."""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Result of one pass."""

    poses: Floats
    """(k, 3) T_map_base at the wanted times; nan where it was lost."""
    covariances: Floats
    """(k, 3, 3) m, m, rad; without the map's own errors."""
    ends: Floats
    """(2,) of rays on walls of the map, and in its known space, while the pose was known."""
    moved_anchors: tuple[str, ...]
    reason: str
    """Why it was lost in the end; empty where it was not."""


def pose_rows(log: SensorLog) -> Ints:
    """Return the rows of the odometry at which poses are wanted."""
    way = _way(log)
    return np.unique(np.concatenate([_first_of_each(way), [len(way) - 1]]))


def _way(log: SensorLog) -> Floats:
    """Return how far the odometry has come (n,), in units of _SPACING."""
    o = log.odometry
    step = np.diff(o.poses, axis=0)
    far = np.hypot(step[:, 0], step[:, 1]) / _SPACING[0] + np.abs(se2.wrap_angle(step[:, 2])) / _SPACING[1]
    return np.concatenate([[0.0], np.cumsum(far + np.diff(o.stamps) / _SPACING[2])])


def _first_of_each(way: Floats) -> Ints:
    return np.unique(np.floor(way), return_index=True)[1].astype(np.intp)


def run_pass(log: SensorLog, known: KnownMap, rows: Ints, backwards: bool, report: Callable[[int, int], None]) -> Pass:
    """Play a recording through a localiser whose only prior knowledge is the map.

    Parameters
    ----------
    rows : (k,) of the odometry at which poses are wanted. backwards : from its end to its beginning: times change their sign.
    report : called with the events that are done and their number.
    """
    sign = -1.0 if backwards else 1.0
    localizer = Localizer(replace(known, laser_delay=sign * known.laser_delay), log.mounting, _scanner(log, sign))
    wanted = np.full(len(log.odometry.stamps), -1)
    wanted[rows] = np.arange(len(rows))
    poses, covariances = np.full((len(rows), 3), np.nan), np.full((len(rows), 3, 3), np.nan)
    times, kinds, numbers = _events(log, known, backwards)
    reason = ""
    for done, (at, kind, k) in enumerate(zip(times.tolist(), kinds.tolist(), numbers.tolist(), strict=True)):
        if kind == _ODOMETRY:
            state = localizer.add_odometry(at, *log.odometry.poses[k].tolist())
            if (slot := wanted[k]) >= 0 and localizer.tracks:
                poses[slot], covariances[slot] = state.pose, state.covariance - known.covariance_at(state.pose[:2])
            reason = state.reason
        elif kind == _RANGE and log.ranges is not None:
            r = log.ranges
            tag = 0 if r.tag is None else int(r.tag[k])
            localizer.add_ranges(at, [r.anchor_ids[r.anchor[k]]], [float(r.ranges[k])], tag)
        elif log.scans is not None:
            localizer.add_scan(sign * float(log.scans.stamps[k]), log.scans.ranges[k])
        if done % 1000 == 0:
            report(done, len(times))
    return Pass(poses, covariances, localizer.ends, localizer.state().moved_anchors, reason)


def _scanner(log: SensorLog, sign: float) -> Scanner | None:
    s = log.scans
    if s is None:
        return None
    return Scanner(s.angle_min, s.angle_increment, sign * s.time_increment, s.range_min, s.range_max)


def _events(log: SensorLog, known: KnownMap, backwards: bool) -> tuple[Floats, Ints, Ints]:
    """Return times (e,), kinds (e,) and rows (e,) of the measurements in the order of the pass."""
    o, sign = log.odometry, -1.0 if backwards else 1.0
    parts = [(sign * o.stamps, _ODOMETRY, np.arange(len(o.stamps)))]
    if log.ranges is not None:
        parts.append((sign * log.ranges.stamps, _RANGE, np.arange(len(log.ranges.stamps))))
    if log.scans is not None and len(log.scans.stamps) and known.walls is not None:
        used = _first_of_each(np.interp(log.scans.stamps, o.stamps, _way(log)))
        parts.append((sign * log.scans.stamps[used], _SCAN, used))
    times = np.concatenate([p[0] for p in parts])
    kinds = np.concatenate([np.full(len(p[0]), p[1]) for p in parts])
    order = np.lexsort((kinds, times))
    return times[order], kinds[order], np.concatenate([p[2] for p in parts])[order]


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """Both passes together."""

    poses: Floats
    """(k, 3); nan where both were lost."""
    covariances: Floats
    """(k, 3, 3), with the map's own errors."""
    contradicting: Bools
    """(k,) where both know the pose and it is not the same."""


def smoothed(one: Pass, other: Pass, of_map: Callable[[Floats], Floats]) -> Smoothed:
    """Average two passes by their covariances.

    ``x = a + A (A + B)^-1 (b - a)``, ``P = A - A (A + B)^-1 A``. Where they contradict one another the more certain one is
    kept, with a covariance that includes the other.

    Parameters
    ----------
    of_map : from places (k, 2) to the covariances (k, 3, 3) of the map's own errors there, which both passes share.
    """
    a, b = one.poses, other.poses
    off = b - a
    off[:, 2] = se2.wrap_angle(off[:, 2])
    both = np.isfinite(off).all(axis=1)
    poses = np.where(np.isfinite(a), a, b)
    covariances = np.where(np.isfinite(one.covariances), one.covariances, other.covariances)
    common = of_map(poses[:, :2])
    A, B, d = one.covariances[both], other.covariances[both], off[both]
    gain = A @ np.linalg.inv(A + B)
    far = np.einsum("ni,nij,nj->n", d, np.linalg.inv(A + B + common[both]), d) > _APART
    mean, joint = a[both] + np.einsum("nij,nj->ni", gain, d), A - gain @ A
    first = np.trace(A, axis1=1, axis2=2) <= np.trace(B, axis1=1, axis2=2)
    surer = np.where(first[:, None], a[both], b[both])
    wide = np.where(first[:, None, None], A, B) + d[:, :, None] * d[:, None, :]
    poses[both] = np.where(far[:, None], surer, mean)
    covariances[both] = np.where(far[:, None, None], wide, 0.5 * (joint + joint.transpose(0, 2, 1)))
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    contradicting = np.zeros(len(a), dtype=bool)
    contradicting[both] = far
    return Smoothed(poses, covariances + common, contradicting)
