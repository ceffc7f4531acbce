"""Tests by the triangle inequality: ranges to one place change by at most the distance driven, apart from noise and NLOS.

Medians of a few readings of one anchor are compared over a time. Where several anchors change by more together, the wheels
missed a motion.
"""


import numpy as np

from ..arrays import BEYOND_NOISE, ENOUGH, MOST, Floats, white_noise
from ..sensor_log import SensorLog, plausible
from .repeats import RepeatPolicy


class MotionPolicy:
    """Changes of ranges against the distance driven."""

    window: int = 3
    """Readings whose median is taken."""
    lasting: int = 8
    """Number of readings for which a jump must last."""
    silence: float = 6.0
    """Usual periods of an anchor after which a jump does not show the time of the motion."""
    stretch: float = 1.5
    """Factor by which wheels may count too little."""
    margin: float = 0.5
    """Change, m, that a blocked line of sight explains."""
    votes: int = 2
    """Anchors that must agree, where so many are in reach."""
    apart: float = 10.0
    """Cuts nearer than this in time are one, s."""
    way: float = 2.0
    """Length of the stretches, m, in which the change of ranges is compared with the distance."""


def _without_motion(noise: float) -> float:
    """Return by how much ranges from one place to another differ at most, m, by the noise of one of them, m."""
    return MotionPolicy.margin + BEYOND_NOISE * noise


def excess(log: SensorLog, start: float, end: float) -> float:
    """Return the motion between two times, s, by the ranges minus that by the wheels, m; 0 = not larger.

    The readings before the first and those after the last are compared, and those between with each other.
    """
    by_anchor, size = _by_anchor(log), MotionPolicy.window
    middle = size // 2 + 1
    count = max((int(np.sum((stamps > start) & (stamps < end))) for stamps, _ in by_anchor), default=0)
    edges = np.linspace(start, end, max(1, min(2, count // size), count // (2 * size)) + 1)
    found = []
    for stamps, ranges in by_anchor:
        inside = np.searchsorted(edges, stamps) - 1
        parts = [ranges[(inside == k) & (stamps > start) & (stamps < end)] for k in range(len(edges) - 1)]
        parts = [ranges[stamps <= start][-size:], *parts, ranges[stamps >= end][:size]]
        level = np.array([np.median(part) if len(part) >= size else np.nan for part in parts])
        # From the middle one of the readings before, and to that of those after, the robot may have driven; wherever the median
        # is another one of the three, it lies between two that are nearer in time.
        before, after = stamps[stamps <= start][-middle:], stamps[stamps >= end][:middle]
        extra = np.zeros(len(level))
        extra[[0, -1]] = _way(log, np.append(before, start)), _way(log, np.append(after, end))
        change = np.abs(level[:, None] - level) - extra[:, None] - extra - _without_motion(_noise(ranges))
        if np.isfinite(level).sum() >= 2:
            found.append(np.where(np.isfinite(change), change, -np.inf))
    if not found:
        return 0.0
    # What enough of the anchors exceed, at least. Bursts of late readings, now of one anchor and then of another, agree only
    # when compared with each other; most moments have none.
    needed = min(max(MotionPolicy.votes, len(found) // 2), len(found))
    agreed = np.sort(np.stack(found), axis=0)[-needed].max(axis=1)
    agreed = np.sort(agreed[np.isfinite(agreed)])
    return max(0.0, float(agreed[(len(agreed) - 1) // 2]) - _way(log, np.array([start, end]))) if len(agreed) else 0.0


def cuts(log: SensorLog, jumps: Floats) -> list[float]:
    """Return the times, s, at which the ranges to several anchors jump together and permanently by more than the robot drove.

    Where the odometry jumps (b,), s, one anchor is enough, where no other one is in reach.
    """
    spans, by_anchor = [np.zeros((0, 3))], _by_anchor(log)
    for stamps, ranges in by_anchor:
        if len(ranges) < 4 * MotionPolicy.lasting:
            continue
        way, windows = log.odometry.travelled_at(stamps), (MotionPolicy.window, MotionPolicy.lasting)
        over = np.minimum(*(_jumps(ranges, way, window)[:-1] for window in windows)) - _without_motion(_noise(ranges))
        close = np.isfinite(over) & (np.diff(stamps) <= MotionPolicy.silence * np.median(np.diff(stamps)))
        spans.append(np.column_stack([stamps[:-1], stamps[1:], over])[close])
    return _together(spans, jumps)


def change_by_way(log: SensorLog) -> float:
    """Return by how much the ranges change where the robot drives 2 m, by its wheels, by that way; nan without enough.

    It is the median over the anchors of the 90 % quantile over such stretches, about 1 for any path, since the robot drives
    towards every anchor at times. It is nan, too, where ranges change that fast only rarely.
    """
    found = []
    for stamps, ranges in _by_anchor(log):
        if len(ranges) < ENOUGH:
            continue
        way = log.odometry.travelled_at(stamps)[1:-1]
        level = np.median(np.lib.stride_tricks.sliding_window_view(ranges, MotionPolicy.window), axis=1)
        last = np.searchsorted(way, way + MotionPolicy.way)
        first = np.flatnonzero(last < len(way))
        last = last[first]
        driven = way[last] - way[first]
        rate = (np.abs(level[last] - level[first]) / driven)[driven < 1.5 * MotionPolicy.way]
        if len(rate) >= ENOUGH:
            found.append(np.quantile(rate, [0.5, MOST]))
    usual, most = np.median(found, axis=0) if found else (np.nan, np.nan)
    return float(most) if usual > 0.5 * most else float("nan")


def _jumps(ranges: Floats, way: Floats, window: int) -> Floats:
    """Return by how much medians of so many readings before and after each reading (n,) differ beyond the way driven, m."""
    medians = np.median(np.lib.stride_tricks.sliding_window_view(ranges, window), axis=1)
    centres = np.mean(np.lib.stride_tricks.sliding_window_view(way, window), axis=1)
    found = np.full(len(ranges), -np.inf)
    driven = centres[window:] - centres[:-window]
    found[window - 1 : len(ranges) - window] = np.abs(medians[window:] - medians[:-window]) - MotionPolicy.stretch * driven
    return found


def _together(spans: list[Floats], jumps: Floats) -> list[float]:
    """Return the middles of the times, s, in which enough of the anchors in reach jump.

    Spans are of each anchor (n, 3) two neighbouring readings' stamps, s, and the change beyond what is plausible, m.
    """
    found: list[float] = []
    votes = np.concatenate(spans)
    votes = votes[votes[:, 2] > 0.0]
    for start, end in votes[np.argsort(-votes[:, 2], kind="stable"), :2].tolist():
        during = [own[(own[:, 0] <= end) & (own[:, 1] >= start)] for own in spans]
        agreeing = [own[own[:, 2] > 0.0] for own in during]
        same, (anchors, reached) = np.concatenate(agreeing), (sum(len(own) > 0 for own in k) for k in (agreeing, during))
        least = 1 if np.any((jumps >= start) & (jumps <= end)) else MotionPolicy.votes
        if anchors >= max(least, reached // 2) and all(abs(0.5 * (start + end) - t) > MotionPolicy.apart for t in found):
            found.append(0.5 * float(same[:, 0].max() + same[:, 1].min()))
    return sorted(found)


def _by_anchor(log: SensorLog) -> list[tuple[Floats, Floats]]:
    """Return stamps and usable ranges of each pair of tag and anchor while there is odometry."""
    ranges = log.ranges
    if ranges is None:
        return []
    usable = plausible(ranges.ranges) & (ranges.stamps >= log.odometry.stamps[0]) & (ranges.stamps <= log.odometry.stamps[-1])
    return [(ranges.stamps[own], ranges.ranges[own]) for _, own in ranges.by_pair(usable) if len(own) >= MotionPolicy.window]


def _noise(ranges: Floats) -> float:
    """Return the standard deviation of one reading by second differences, m."""
    return max(white_noise(ranges), RepeatPolicy.usual_noise) if len(ranges) > 4 else 0.1


def _way(log: SensorLog, stamps: Floats) -> float:
    """Return the distance driven between the first and the last stamp, m."""
    return float(np.ptp(log.odometry.travelled_at(stamps))) if len(stamps) else 0.0
