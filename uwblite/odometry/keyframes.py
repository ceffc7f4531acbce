"""Keyframes: the poses that the graph holds, chosen along the odometry, and the motion between them."""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..sensor_log import LaserScans, Odometry, OdometryBreaks, SensorLog


@dataclass(frozen=True, slots=True)
class KeyframeConfig:
    """When a new keyframe begins, and how much lidar it gets."""

    distance: float = 0.0
    """Travelled distance after which a new keyframe begins, m. Smaller: finer trajectory, slower. 0 = 0.3; with a lidar it
    grows from 800 m of driving on, up to 0.45 from 1.2 km on."""
    angle: float = 0.35
    """Turned angle after which a new keyframe begins, rad."""
    duration: float = 1.5
    """Time in motion after which a new keyframe begins where there is a lidar, s: wheels that slip hardly measure distance."""
    scans: int = 0
    """Scans gathered into the cloud of one keyframe, nearest in time first; more average the lidar's noise. 0 = 2, and 1 in a
    recording of more than 800 m by a lidar of at least 500 beams."""

    def spacing(self, path: float, lidar: bool) -> float:
        """Return the travelled distance after which a new keyframe begins, m, where a robot drives so far in all, m."""
        if self.distance > 0.0:
            return self.distance
        return _SPACING * (min(max(path / _LONG, 1.0), _WIDER) if lidar else 1.0)

    def scans_each(self, path: float, beams: int) -> int:
        """Return the scans of a cloud where a robot drives so far in all, m, with a lidar of so many beams."""
        return self.scans or (1 if path > _LONG and beams >= _FINE else _SCANS)


_SPACING, _SCANS = 0.3, 2
"""Usual distance between keyframes, m, and scans of a cloud."""
_LONG, _WIDER, _FINE = 800.0, 1.5, 500
"""Path from which on keyframes are farther apart, m, in proportion to it; how many times as far at most; and beams with which
one scan is a cloud there: walls are seen again and again, and noise averages out (docs/lab/performance.md)."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """Poses chosen along the odometry, at scans where there are any, and the motion between them."""

    index: Ints
    """(k,) odometry sample at or last before each keyframe."""
    stamps: Floats
    """(k,) s."""
    odometry: Floats
    """(k, 3) T_odom_base."""
    motion: Floats
    """(k-1, 3) odometry from each keyframe to the next, in the frame of the first."""
    length: Floats
    """(k-1,) signed distance travelled between them (backwards negative), m."""
    path: Floats
    """(k-1,) distance travelled between them regardless of direction, m."""
    turned: Floats
    """(k-1,) sum of absolute turns between them, rad."""
    duration: Floats
    """(k-1,) s."""
    twist: Floats
    """(k, 3) velocity of the base at each keyframe, own frame, m/s, m/s, rad/s."""
    slack: Floats
    """(k-1, 3) additional standard deviation of steps that were not measured, m, m, rad; else 0."""
    alone: Bools
    """(k,) its cloud is of a single scan: the odometry that would place a further one is not reliable there."""

    def __len__(self) -> int:
        return len(self.stamps)


def select(
    odometry: Odometry, config: KeyframeConfig, breaks: OdometryBreaks | None = None, scans: LaserScans | None = None
) -> Keyframes:
    """Choose keyframes along the odometry by travelled distance and turned angle; its first and last sample are always in.

    Parameters
    ----------
    odometry : n >= 1 samples. breaks : steps that were not measured; a keyframe stands on either side of each.
    scans : keyframes are then at times of scans, at which alone the lidar measures a pose: errors of the odometry and of both
        clocks stay edges of the graph and bend no cloud.
    """
    moments, sample, seen = _moments(odometry, scans)
    _, path, turned = _travelled(odometry, moments, sample)
    ways = [path / config.spacing(float(path[-1]), scans is not None), turned / config.angle]
    if scans is not None:
        moves = np.hypot(np.diff(ways[0]), np.diff(ways[1])) > _STANDING * np.diff(moments)
        ways.append(np.concatenate([[0.0], np.cumsum(moves * np.diff(moments))]) / config.duration)
    chosen = _advance(np.stack(ways), seen)
    if breaks is not None and len(breaks.stamps):
        broken = _broken_steps(odometry.stamps, breaks)
        before, behind = odometry.stamps[broken], odometry.stamps[broken + 1]
        own = np.searchsorted(moments, before), np.searchsorted(moments, behind, "right") - 1
        chosen = np.union1d(chosen, np.concatenate(own))
    return _keyframes(odometry, moments[chosen], sample[chosen], breaks)


def of(log: SensorLog, config: KeyframeConfig) -> Keyframes:
    """Choose the keyframes of a recording, see select."""
    return select(log.odometry, config, None if log.screening is None else log.screening.breaks, log.scans)


def at(log: SensorLog, stamps: Floats, alone: Bools) -> Keyframes:
    """Return keyframes of a recording at given moments (k,), s; for alone (k,) see Keyframes."""
    breaks = None if log.screening is None else log.screening.breaks
    return replace(_keyframes(log.odometry, stamps, _sample(log.odometry, stamps), breaks), alone=alone)


def _keyframes(odometry: Odometry, stamps: Floats, index: Ints, breaks: OdometryBreaks | None) -> Keyframes:
    """Return keyframes at given moments (k,), s, the last odometry samples (k,) before them being known."""
    between = odometry.at(stamps)
    poses = np.where((odometry.stamps[index] == stamps)[:, None], odometry.poses[index], between)
    length, path, turned = (np.diff(way) for way in _travelled(odometry, stamps, index))
    motion, alone = se2.between(poses[:-1], poses[1:]), np.zeros(len(stamps), dtype=bool)
    twist, slack = velocity_at(odometry, stamps, _BESIDE_SCANS), _slack(stamps, odometry.stamps, breaks)
    return Keyframes(index, stamps, poses, motion, length, path, turned, np.diff(stamps), twist, slack, alone)


def _broken_steps(stamps: Floats, breaks: OdometryBreaks) -> Ints:
    """Return the number (b,) of the odometry sample before each break; the last sample has no step behind it."""
    return np.clip(np.searchsorted(stamps, breaks.stamps, "right") - 1, 0, max(len(stamps) - 2, 0)).astype(np.intp)


def _slack(stamps: Floats, odometry: Floats, breaks: OdometryBreaks | None) -> Floats:
    """Return the standard deviation (k-1, 3) that breaks of an odometry with stamps (n,) add to the steps that they overlap."""
    variance = np.zeros((len(stamps) - 1, *se2.POSE))
    if breaks is None or not len(variance) or len(odometry) < 2:
        return variance
    broken = _broken_steps(odometry, breaks)
    first = np.maximum(np.searchsorted(stamps, odometry[broken], "right") - 1, 0)
    last = np.minimum(np.searchsorted(stamps, odometry[broken + 1], "left"), len(variance))
    for low, high, sigma in zip(first.tolist(), last.tolist(), breaks.sigma, strict=True):
        variance[low : max(high, low + 1)] += sigma**2
    return np.sqrt(variance)


def _sample(odometry: Odometry, stamps: Floats) -> Ints:
    """Return the last odometry sample (k,) at or before stamps (k,), s; the first for earlier ones."""
    return np.maximum(np.searchsorted(odometry.stamps, stamps, "right") - 1, 0)


def _travelled(odometry: Odometry, moments: Floats, sample: Ints) -> tuple[Floats, Floats, Floats]:
    """Return signed distance, distance and turning until moments (m,), m, m, rad; sample (m,) is the last one before each."""
    steps = odometry.steps
    forward = np.where(steps[:, 0] >= 0, 1.0, -1.0) * np.hypot(steps[:, 0], steps[:, 1])
    span = np.append(np.diff(odometry.stamps), 0.0)[sample]
    fraction = np.clip((moments - odometry.stamps[sample]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
    signed, path, turned = (
        np.concatenate([[0.0], np.cumsum(part)])[sample] + np.append(part, 0.0)[sample] * fraction
        for part in (forward, np.abs(forward), np.abs(steps[:, 2]))
    )
    return signed, path, turned


def _moments(odometry: Odometry, scans: LaserScans | None) -> tuple[Floats, Ints, Bools]:
    """Return the moments (m,) at which a keyframe may be, s, the last odometry sample before each, and which are of scans."""
    stamps = odometry.stamps
    if scans is None:
        return stamps, np.arange(len(stamps)), np.ones(len(stamps), dtype=bool)
    middle = scans.middles
    at_scans = np.setdiff1d(middle[(middle > stamps[0]) & (middle < stamps[-1])], stamps)
    moments = np.concatenate([stamps, at_scans])
    order = np.argsort(moments, kind="stable")
    sample = np.concatenate([np.arange(len(stamps)), _sample(odometry, at_scans)])
    return moments[order], sample[order], np.isin(moments[order], middle)


def _advance(ways: Floats, preferred: Bools) -> Ints:
    """Return moments as far apart as possible with at most 1 of each measure (w, m) between neighbours, if there are such:
    preferred ones, others only where the next preferred one is farther than _GAP."""
    chosen, last, stops = [0], ways.shape[1] - 1, np.flatnonzero(preferred)
    if len(stops) and stops[0] < last and ways[:2, stops[0]].max() > _AT_REST:
        chosen.append(int(stops[0]))
    while chosen[-1] < last:
        here = chosen[-1]
        within = _reached(ways, here, 1.0)
        number = int(np.searchsorted(stops, within, "right"))
        stop = int(stops[number - 1]) if number else here
        if stop <= here:
            stop = int(stops[number]) if number < len(stops) else here
            if stop <= here or stop > _reached(ways, here, _GAP):
                stop = max(within, here + 1)
        chosen.append(min(stop, last))
    if len(chosen) > 2 and (ways[:2, last] - ways[:2, chosen[-2]] < 0.5).all():
        del chosen[-2]
    return np.array(chosen, dtype=np.intp)


_AT_REST = 0.05
"""Keyframe distances or angles up to which the first scan is one of the first pose: the wheels' error is small there."""
_GAP = 10.0
"""Keyframe distances, angles or durations without any scan after which keyframes are set without scans."""
_STANDING = 0.1
"""Keyframe distances or angles per second below which a robot stands, 1/s."""


def _reached(ways: Floats, here: int, most: float) -> int:
    """Return the last moment that is at most so far from this one by all measures."""
    return min(int(np.searchsorted(way, way[here] + most, "right")) for way in ways) - 1


_WINDOW = (0.0, 0.1)
"""Time before and after a stamp over which the velocity is a mean, s: two readings of a base at 20 Hz."""
_BESIDE_SCANS = (0.1, 0.3)
"""The same at keyframes, s: odometry within a shorter time also places the second scan of a cloud, and noise in both would look
like an offset of the lidar's clock."""


def velocity_at(odometry: Odometry, stamps: Floats, window: tuple[float, float] = _WINDOW) -> Floats:
    """Return the velocity (m, 3) of the base in its own frame at the stamps (m,), m/s, m/s, rad/s."""
    near, far = window
    moments = np.clip(stamps + np.array([[-far], [-near], [near], [far]]), odometry.stamps[0], odometry.stamps[-1])
    begin, end = moments[::2], moments[1::2]
    motion, span = se2.log(se2.between(odometry.at(begin), odometry.at(end))).sum(axis=0), (end - begin).sum(axis=0)[:, None]
    return np.where(span > 0, motion / np.where(span > 0, span, 1.0), 0.0)


def dense_trajectory(odometry: Odometry, keyframes: Keyframes, poses: Floats, stamps: Floats | None = None) -> Floats:
    """Return T_map_base (n, 3) at the stamps (default: every odometry stamp) between optimised keyframes (k, 3).

    The raw odometry since the keyframe is used, and its misclosure at the next keyframe is distributed as errors of wheels
    arise: in position with the distance travelled, in heading with the turn, and little with time.
    """
    query = odometry.stamps if stamps is None else stamps
    base = odometry.poses if stamps is None else odometry.at(stamps)
    left = np.clip(np.searchsorted(keyframes.stamps, query, "right") - 1, 0, max(len(keyframes) - 2, 0))
    since = se2.between(keyframes.odometry[left], base)
    if len(keyframes) == 1:
        return se2.compose(poses[left], since)
    missed = se2.log(se2.between(keyframes.motion, se2.between(poses[:-1], poses[1:])))
    at, ends = _error_ways(odometry, query), _error_ways(odometry, keyframes.stamps)
    whole = np.diff(ends, axis=0)[left]
    fraction = np.where(whole > 0.0, np.clip((at - ends[left]) / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0), 0.0)
    return se2.compose(poses[left], se2.compose(since, se2.exp(fraction * missed[left])))


def _error_ways(odometry: Odometry, stamps: Floats) -> Floats:
    """Return the growth (m, 3) of odometry errors since the beginning, in x, y and heading, in arbitrary units."""
    _, path, turned = _travelled(odometry, stamps, _sample(odometry, stamps))
    position = path + _STANDING_ERROR * stamps
    return np.column_stack([position, position, turned + _BY_PATH * path + _STANDING_ERROR * stamps])


_STANDING_ERROR = 1e-3
"""m/s or rad/s of travelling and turning with the same error as standing."""
_BY_PATH = 0.1
"""rad/m of turning with the same error in heading as driving straight; of the order of the wheels' noise settings."""
