"""A recording, what is true of it, and how a fault changes one part of it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uwblite import se2
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, UwbRanges

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator


@dataclass(frozen=True)
class Case:
    """A recording in the order in which it was recorded, and what is true of every odometry reading in it."""

    log: SensorLog
    truth: Floats
    """(n, 3) T_truth_base at each odometry reading."""
    anchors: dict[str, list[Floats]]
    """Places (2,) of each anchor, m, in the order of time."""
    known: dict[str, float] = field(default_factory=dict)
    """Standard deviation of the place of each anchor, m, where it is not simulated but found in a map."""
    clocks: dict[str, Floats] = field(default_factory=dict)
    """By odometry, radio and lidar: what its clock is wrong by at each reading, s."""
    since: dict[str, list[float]] = field(default_factory=dict)
    """When the anchor was put to its second, third ... place, s; of anchors that are not named here, half-way."""

    @property
    def middle(self) -> float:
        """Half of the recording's time, s."""
        return float(np.mean(self.log.odometry.stamps[[0, -1]]))

    def place(self, anchor: str, since: float, until: float) -> Floats:
        """Return the place (2,) where an anchor stood for longest between two times, s; -inf and inf: begin and end."""
        first, last = self.log.odometry.stamps[[0, -1]].tolist()
        places = self.anchors[anchor]
        times = [first, *self.since.get(anchor, [self.middle] * (len(places) - 1)), last]
        ends = np.clip(times, max(since, first), min(until, last))
        return places[int(np.argmax(np.diff(ends)[: len(places)]))]


Fault = Callable[[Case, Rng], Case]


def with_odometry(case: Case, change: Callable[[Floats, Floats], Floats]) -> Case:
    """Return the case with odometry poses changed: change(stamps, poses with unwrapped heading) -> poses."""
    stamps, poses = case.log.odometry.stamps, case.log.odometry.poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return replace(case, log=replace(case.log, odometry=Odometry(stamps, change(stamps, poses))))


def with_scans(case: Case, change: Callable[[LaserScans], LaserScans]) -> Case:
    """Return the case with its scans changed."""
    return case if case.log.scans is None else replace(case, log=replace(case.log, scans=change(case.log.scans)))


def with_ranges(case: Case, change: Callable[[UwbRanges], UwbRanges]) -> Case:
    """Return the case with its ranges changed."""
    return case if case.log.ranges is None else replace(case, log=replace(case.log, ranges=change(case.log.ranges)))


def kept(case: Case, keep: Callable[[Floats], NDArray[np.bool_]], *, odometry: bool = True, others: bool = True) -> Case:
    """Return the case with the readings whose stamps are to be kept."""
    log, truth = case.log, case.truth
    if odometry:
        own = keep(log.odometry.stamps)
        log, truth = replace(log, odometry=Odometry(log.odometry.stamps[own], log.odometry.poses[own])), truth[own]
    if others and log.ranges is not None:
        log = replace(log, ranges=rows(log.ranges, keep(log.ranges.stamps)))
    if others and log.scans is not None:
        own = keep(log.scans.stamps)
        log = replace(log, scans=replace(log.scans, stamps=log.scans.stamps[own], ranges=log.scans.ranges[own]))
    return replace(case, log=log, truth=truth)


def shifted(case: Case, by: Callable[[Floats], Floats], kinds: str = "odometry radio lidar") -> Case:
    """Return the case with the clocks of some sensors wrong by by(stamps), s."""
    sensors = {"odometry": case.log.odometry, "radio": case.log.ranges, "lidar": case.log.scans}
    return replace(case, clocks={k: by(v.stamps) for k, v in sensors.items() if k in kinds and v is not None})


def rows(ranges: UwbRanges, which: NDArray[np.bool_]) -> UwbRanges:
    """Return some of the ranges, of all anchors."""
    return UwbRanges(ranges.stamps[which], ranges.anchor[which], ranges.ranges[which], ranges.quality[which], ranges.anchor_ids)


def chained(start: Floats, steps: Floats) -> Floats:
    """Return the poses (n + 1, 3) of a chain of steps (n, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(se2.rotate(theta[:-1], steps[:, :2]), axis=0)])
    return np.column_stack([xy, theta])
