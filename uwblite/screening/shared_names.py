"""Anchors with one name: their ranges alternate between two places while the robot drives on.

Neighbouring ranges to one place differ by at most the distance driven in between (the triangle inequality), apart from noise
and multipath. While two places are in reach, the ranges jump between two distances, each of which changes by at most the
distance driven, and their difference varies. Multipath delays are constant, or different each time; a motion that the wheels
miss makes ranges jump, but not back.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats
from ..findings import Fact
from ..sensor_log import SensorLog
from .odometry_chain import Motion
from .stuck_sensors import quiet_noise, resolution_of

_STRETCH, _MARGIN, _TIMES_NOISE = 1.5, 0.5, 5.0
"""Factor by which wheels may count too little, m that a line of sight blocked for a moment explains, and standard deviations
of a range."""
_LEAST, _SHARE = 12, 0.1
"""Least number of jumps, and their least share of the ranges' differences, for two places; one place has 3 % at most."""
_NEXT = 0.6
"""Distance, m, over which a jump is compared with the next one."""
_STEADY, _VARIES = 0.9, 0.7
"""Share of leaps whose ends are where the next one's are, and by how much all differ (10 to 90 %, by their median). Two places
have 0.97 and 1.2 at least; exponential detours in 40 % of the ranges 0.74 at most, constant ones vary by 0.34."""


def without_shared_names(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Leave out the ranges of each name that two anchors have: the place of none of them is known."""
    ranges = log.ranges
    if ranges is None or len(log.odometry.stamps) < 2:
        return log, []
    usable = ranges.ranges > 0.0
    each = ranges.by_pair(usable)
    if not each:
        return log, []
    noise = quiet_noise([ranges.ranges[own] for _, own in each], resolution_of(ranges.ranges[usable]))
    driven = np.interp(ranges.stamps, log.odometry.stamps, _driven(log))
    wrong, facts = np.zeros(len(ranges.stamps), dtype=bool), []
    for anchor, own in each:
        leaps = np.abs(np.diff(ranges.ranges[own])) > _most(np.diff(driven[own]), noise)
        if _two_distances(ranges.ranges[own], driven[own], leaps, noise) and not wrong[own].any():
            name = ranges.anchor_ids[anchor]
            facts.append(Fact.of("shared-name", anchor=name, jumps=int(leaps.sum()), total=len(leaps)))
            wrong |= ranges.anchor == anchor
    if not facts:
        return log, []
    return replace(log, ranges=None if wrong.all() else ranges.rows(~wrong)), facts


def _driven(log: SensorLog) -> Floats:
    """Return how far the robot may have driven until each reading of the odometry (n,), m: at least as fast as usual."""
    usual = float(Motion.of(log.odometry).speed[0]) / 4.0
    steps = np.maximum(np.diff(log.odometry.travelled), usual * np.diff(log.odometry.stamps))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _most(way: Floats, noise: float) -> Floats:
    """Return by how much ranges to one place differ at most between two points of the way (n,), m."""
    return _STRETCH * way + _MARGIN + _TIMES_NOISE * noise


def _two_distances(values: Floats, driven: Floats, leaps: Bools, noise: float) -> bool:
    """Return whether the shorter and the longer ends of an anchor's leaps are distances to a place each, no constant apart."""
    at = np.flatnonzero(leaps)
    if len(at) < max(_LEAST, _SHARE * len(leaps)):
        return False
    ends = np.sort(np.column_stack([values[at], values[at + 1]]), axis=1)
    way = np.diff(0.5 * (driven[at] + driven[at + 1]))
    steady = np.abs(np.diff(ends, axis=0)).max(axis=1) < _most(way, noise)
    low, middle, high = np.quantile(ends[:, 1] - ends[:, 0], [0.1, 0.5, 0.9])
    close = way < _NEXT
    return bool(close.sum() >= _LEAST and steady[close].mean() > _STEADY and high - low > _VARIES * middle)
