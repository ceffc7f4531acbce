#!/usr/bin/env python3
"""Does a wrong result say that it is wrong? Puts faults of sensors and users into recordings and maps them.

    python tools/faults.py                               3 min of a lab; writes into docs/accuracy.md
    python tools/faults.py --only frozen --print         cases whose names contain a word
    python tools/faults.py --worlds hall,kasdorf --minutes 5 --sensors all,no-lidar --print

A case is silently wrong when the map is trusted (exit code 0) and yet the trajectory is off by more than 0.5 m (rms), or
an anchor that is called ok by more than 1 m and three standard deviations. Without lidar and without given anchors
nothing but the odometry distinguishes a map from its mirror image: there the result is judged up to reflection.
"""

import argparse
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from simulation.recording import Settings
from trials import ROOT, SHARED, made, table, write_section

from uwblite import se2
from uwblite.cli.check import examined
from uwblite.errors import UwbliteError
from uwblite.io.carmen import read_log
from uwblite.io.carmen_messages import time_order
from uwblite.map_result import MapResult
from uwblite.mapping import build_map
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, UwbRanges

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Rng = np.random.Generator

ATE_BAR = 0.5
"""m; a trusted map with more is silently wrong."""
ANCHOR_BAR = 1.0
"""m, beyond three standard deviations."""
TIME_BAR = 60.0
"""s."""


@dataclass(frozen=True)
class Case:
    """A recording in the order in which it was recorded, and what is true of every odometry reading in it."""

    log: SensorLog
    truth: Floats
    """(n, 3) T_truth_base at each odometry reading."""
    anchors: dict[str, list[Floats]]
    """Places (2,) of each anchor, m, in the order of time."""
    clocks: dict[str, Floats] = field(default_factory=dict)
    """By odometry, radio and lidar: what its clock is wrong by at each reading, s."""

    @property
    def middle(self) -> float:
        """Half of the recording's time, s."""
        return float(np.mean(self.log.odometry.stamps[[0, -1]]))


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


# ---------------------------------------------------------------- faults of the wheels


def frozen_wheels(start: float, seconds: float) -> Fault:
    """Wheels that repeat their last reading; start as a share of the recording, then they go on from where they froze."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(stamps: Floats, poses: Floats) -> Floats:
            begin = stamps[0] + start * (stamps[-1] - stamps[0])
            still = (stamps >= begin) & (stamps < begin + seconds)
            steps = se2.between(poses[:-1], poses[1:])
            steps[still[1:]] = 0.0
            return chained(poses[0], steps)

        return with_odometry(case, change)

    return fault


def chained(start: Floats, steps: Floats) -> Floats:
    """Return the poses (n + 1, 3) of a chain of steps (n, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(se2.rotate(theta[:-1], steps[:, :2]), axis=0)])
    return np.column_stack([xy, theta])


def reset(case: Case, rng: Rng) -> Case:
    """The base restarts half-way and counts from zero."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        later = stamps >= case.middle
        poses[later] = se2.between(np.broadcast_to(poses[later][0], poses[later].shape), poses[later])
        return poses

    return with_odometry(case, change)


def glitch(case: Case, rng: Rng) -> Case:
    """A single reading is 3 km off."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        poses[len(poses) // 2, :2] += 3000.0
        return poses

    return with_odometry(case, change)


def rescaled(x: float, y: float, theta: float) -> Fault:
    """Multiply the odometry."""
    return lambda case, rng: with_odometry(case, lambda stamps, poses: poses * np.array([x, y, theta]))


def redriven(way: float, turn: float) -> Fault:
    """Let the wheels count other ways and turns: the path follows the wrong heading, as a base computes it."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps = se2.between(poses[:-1], poses[1:])
        half = 0.5 * steps[:, 2]
        forward = steps[:, 0] * np.cos(half) + steps[:, 1] * np.sin(half)
        turned = turn * steps[:, 2]
        along = way * forward[:, None] * np.column_stack([np.cos(0.5 * turned), np.sin(0.5 * turned)])
        return chained(poses[0], np.column_stack([along, turned]))

    return lambda case, rng: with_odometry(case, change)


def carried(seconds: float, gap: float) -> Fault:
    """The robot is picked up half-way and put down where it would have been `seconds` later; the log pauses for a gap, s."""

    def fault(case: Case, rng: Rng) -> Case:
        begin, end = case.middle, case.middle + seconds
        poses, stamps = case.log.odometry.poses, case.log.odometry.stamps
        before, after = np.searchsorted(stamps, [begin, end])
        put_down = se2.compose(poses[before - 1], se2.inverse(poses[after]))
        case = with_odometry(case, lambda t, p: np.where((t >= end)[:, None], se2.compose(put_down, p), p))
        case = kept(case, lambda t: (t < begin) | (t >= end))
        return shifted(case, lambda t: np.where(t >= end, gap - seconds, 0.0))

    return fault


# ---------------------------------------------------------------- faults of the lidar


def repeated_scan(start: float) -> Fault:
    """The lidar repeats one scan from a share of the recording on."""

    def change(scans: LaserScans) -> LaserScans:
        first, readings = int(start * len(scans.stamps)), scans.ranges.copy()
        readings[first:] = readings[first]
        return replace(scans, ranges=readings)

    return lambda case, rng: with_scans(case, change)


def laser_factor(factor: float) -> Fault:
    """Scale all readings and the lidar's largest range."""
    return lambda case, rng: with_scans(
        case, lambda s: replace(s, ranges=(s.ranges * factor).astype(np.float32), range_max=s.range_max * factor)
    )


def wide_claim(case: Case, rng: Rng) -> Case:
    """The driver claims twice the field of view."""
    return with_scans(case, lambda s: replace(s, angle_min=2.0 * s.angle_min, angle_increment=2.0 * s.angle_increment))


def mirrored_laser(case: Case, rng: Rng) -> Case:
    """Beams in the wrong order."""
    return with_scans(case, lambda s: replace(s, ranges=s.ranges[:, ::-1].copy()))


def noise_scans(case: Case, rng: Rng) -> Case:
    """Readings that have nothing to do with any place."""
    return with_scans(
        case, lambda s: replace(s, ranges=rng.uniform(0.1, s.range_max, s.ranges.shape).astype(np.float32))
    )


def late_half(case: Case, rng: Rng) -> Case:
    """Every other scan is stamped an hour late."""
    return shifted(case, lambda t: 3600.0 * (np.arange(len(t)) % 2), "lidar")


# ---------------------------------------------------------------- faults of the radio


def constant_ranges(case: Case, rng: Rng) -> Case:
    """Every range is the same."""
    return with_ranges(case, lambda r: replace(r, ranges=np.full(len(r.ranges), 4.2)))


def random_ranges(case: Case, rng: Rng) -> Case:
    """Ranges that have nothing to do with any distance."""
    return with_ranges(case, lambda r: replace(r, ranges=rng.uniform(0.5, 15.0, len(r.ranges))))


def range_factor(factor: float) -> Fault:
    """Scale all ranges."""
    return lambda case, rng: with_ranges(case, lambda r: replace(r, ranges=r.ranges * factor))


def rotated_ids(case: Case, rng: Rng) -> Case:
    """From half-way on every anchor answers to the next one's name."""
    ids = list(case.anchors)
    following = {a: ids[(k + 1) % len(ids)] for k, a in enumerate(ids)}

    def change(r: UwbRanges) -> UwbRanges:
        to = np.array([r.anchor_ids.index(following[a]) if following[a] in r.anchor_ids else 0 for a in r.anchor_ids])
        return replace(r, anchor=np.where(r.stamps >= case.middle, to[r.anchor], r.anchor))

    places = {name: [*case.anchors[name], case.anchors[source][0]] for source, name in following.items()}
    return replace(with_ranges(case, change), anchors=places)


def shuffled_ids(case: Case, rng: Rng) -> Case:
    """From half-way on the names are drawn again for every range."""
    return with_ranges(
        case,
        lambda r: replace(
            r, anchor=np.where(r.stamps >= case.middle, rng.integers(0, len(r.anchor_ids), len(r.anchor)), r.anchor)
        ),
    )


def moved_anchor(case: Case, rng: Rng) -> Case:
    """One anchor is put 3 m away half-way."""
    if case.log.ranges is None:
        return case
    name, shift = case.log.ranges.anchor_ids[0], np.array([1.8, 2.4])
    old = case.anchors[name][0]

    def change(r: UwbRanges) -> UwbRanges:
        base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, r.stamps)
        tag = se2.transform(base, np.broadcast_to(case.log.mounting.tag_position[:2], (len(base), 2)))
        longer = np.hypot(*(old + shift - tag).T) - np.hypot(*(old - tag).T)
        moved = (r.anchor == 0) & (r.stamps >= case.middle)
        return replace(r, ranges=np.where(moved, np.maximum(r.ranges + longer, 0.05), r.ranges))

    return replace(with_ranges(case, change), anchors={**case.anchors, name: [old, old + shift]})


# ---------------------------------------------------------------- faults of clocks and logs


def clock_back(kinds: str) -> Fault:
    """The clock of some sensors is set back 30 s half-way."""
    return lambda case, rng: shifted(case, lambda t: np.where(t >= case.middle, -30.0, 0.0), kinds)


def clock_forward(kinds: str) -> Fault:
    """The clock of some sensors is set forward by an hour half-way."""
    return lambda case, rng: shifted(case, lambda t: np.where(t >= case.middle, 3600.0, 0.0), kinds)


def late(kinds: str, seconds: float) -> Fault:
    """All stamps of a sensor are late."""
    return lambda case, rng: shifted(case, lambda t: np.full(len(t), seconds), kinds)


def absent(kinds: str, share: float = 0.4) -> Fault:
    """A sensor is silent for a share of the recording."""

    def fault(case: Case, rng: Rng) -> Case:
        first, last = case.log.odometry.stamps[[0, -1]]
        begin, end = first + 0.3 * (last - first), first + (0.3 + share) * (last - first)
        log = case.log

        def keep(t: Floats) -> NDArray[np.bool_]:
            return (t < begin) | (t > end)

        if kinds == "odometry":
            return kept(case, keep, others=False)
        if kinds == "radio" and log.ranges is not None:
            return replace(case, log=replace(log, ranges=rows(log.ranges, keep(log.ranges.stamps))))
        if log.scans is None:
            return case
        own = keep(log.scans.stamps)
        scans = replace(log.scans, stamps=log.scans.stamps[own], ranges=log.scans.ranges[own])
        return replace(case, log=replace(log, scans=scans))

    return fault


def two_robots(other: Case) -> Fault:
    """Two robots wrote into one log."""
    return lambda case, rng: merged(case, other)


def twice(case: Case, rng: Rng) -> Case:
    """The same log twice in a file."""
    return merged(case, case)


def merged(a: Case, b: Case) -> Case:
    """Return both recordings in one log, in the order of their stamps."""
    one, two = a.log, b.log
    order = np.argsort(np.concatenate([one.odometry.stamps, two.odometry.stamps]), kind="stable")
    both = {n: np.concatenate([getattr(one.odometry, n), getattr(two.odometry, n)])[order] for n in ("stamps", "poses")}
    odometry = Odometry(**both)
    truth = np.concatenate([a.truth, b.truth])[order]
    ranges, scans = one.ranges, one.scans
    if ranges is not None and two.ranges is not None:
        order = np.argsort(np.concatenate([ranges.stamps, two.ranges.stamps]), kind="stable")
        both = {n: np.concatenate([getattr(ranges, n), getattr(two.ranges, n)])[order] for n in RANGE_FIELDS}
        ranges = UwbRanges(**both, anchor_ids=ranges.anchor_ids)
    if scans is not None and two.scans is not None:
        order = np.argsort(np.concatenate([scans.stamps, two.scans.stamps]), kind="stable")
        readings = np.concatenate([scans.ranges, two.scans.ranges])[order]
        scans = replace(scans, stamps=np.concatenate([scans.stamps, two.scans.stamps])[order], ranges=readings)
    return Case(replace(one, odometry=odometry, ranges=ranges, scans=scans), truth, a.anchors)


def slipping_wheel(case: Case, rng: Rng) -> Case:
    """One wheel spins on a smooth patch: for 6 s three times over, the wheels count a turn and way that are not."""

    def change(stamps: Floats, poses: Floats) -> Floats:
        steps, span = se2.between(poses[:-1], poses[1:]), np.diff(stamps)
        for share in (0.3, 0.55, 0.8):
            begin = stamps[0] + share * (stamps[-1] - stamps[0])
            on = (stamps[1:] >= begin) & (stamps[1:] < begin + 6.0)
            steps[on] += np.column_stack([0.05 * span[on], np.zeros(on.sum()), 0.25 * span[on]])
        return chained(poses[0], steps)

    return with_odometry(case, change)


def stuck_anchor(case: Case, rng: Rng) -> Case:
    """One anchor answers with its last range from half-way on, but for the last digit."""

    def change(r: UwbRanges) -> UwbRanges:
        own = np.flatnonzero((r.anchor == 0) & (r.stamps >= case.middle))
        ranges = r.ranges.copy()
        ranges[own] = ranges[own[0]] + rng.integers(-1, 2, len(own)) * 0.01
        return replace(r, ranges=ranges)

    return with_ranges(case, change)


def one_name_for_two(case: Case, rng: Rng) -> Case:
    """Two anchors answer to one name throughout."""

    def change(r: UwbRanges) -> UwbRanges:
        anchor = np.where(r.anchor == 1, 0, r.anchor)
        used, anchor = np.unique(anchor, return_inverse=True)
        return replace(r, anchor=anchor.astype(np.int64), anchor_ids=tuple(r.anchor_ids[k] for k in used))

    return with_ranges(case, change)


def turned_laser(case: Case, rng: Rng) -> Case:
    """The lidar is mounted a quarter turn away from what stands in the log."""
    return with_scans(case, lambda s: replace(s, angle_min=s.angle_min + 0.5 * np.pi))


def reversed_scans(case: Case, rng: Rng) -> Case:
    """The scans stand in the log in reversed order."""
    return with_scans(case, lambda s: replace(s, ranges=s.ranges[::-1].copy()))


def jitter(kinds: str, seconds: float) -> Fault:
    """Stamps scatter, in order, because a busy computer sets them on arrival."""

    def fault(case: Case, rng: Rng) -> Case:
        return shifted(case, lambda t: np.maximum.accumulate(t + rng.uniform(0.0, seconds, len(t))) - t, kinds)

    return fault


def bursts(kinds: str, seconds: float) -> Fault:
    """Readings wait in a buffer, and all that waited get the stamp at which it is emptied."""
    return lambda case, rng: shifted(case, lambda t: np.ceil(t / seconds) * seconds - t, kinds)


def half_twice(case: Case, rng: Rng) -> Case:
    """Half of the lines stand in the log twice."""
    log = case.log

    def again(count: int) -> Ints:
        return np.sort(np.concatenate([np.arange(count), rng.permutation(count)[: count // 2]]))

    own = again(len(log.odometry.stamps))
    truth, odometry = case.truth[own], Odometry(log.odometry.stamps[own], log.odometry.poses[own])
    ranges = None if log.ranges is None else replace(
        log.ranges, **{n: getattr(log.ranges, n)[k] for k in [again(len(log.ranges.stamps))] for n in RANGE_FIELDS}
    )  # fmt: skip
    scans = log.scans
    if scans is not None:
        own = again(len(scans.stamps))
        scans = replace(scans, stamps=scans.stamps[own], ranges=scans.ranges[own])
    return replace(case, log=replace(log, odometry=odometry, ranges=ranges, scans=scans), truth=truth)


def one_radio_clock_fast(case: Case, rng: Rng) -> Case:
    """The radio's clock runs fast by 2 %."""
    first = float(case.log.odometry.stamps[0])
    return shifted(case, lambda t: 0.02 * (t - first), "radio")


def covered_beams(case: Case, rng: Rng) -> Case:
    """A cable hangs before a third of the beams from half-way on."""

    def change(s: LaserScans) -> LaserScans:
        readings, beams = s.ranges.copy(), s.ranges.shape[1] // 3
        late = s.stamps >= case.middle
        readings[late, beams : 2 * beams] = rng.normal(0.25, 0.005, (int(late.sum()), beams)).astype(np.float32)
        return replace(s, ranges=readings)

    return with_scans(case, change)


def offset_laser(case: Case, rng: Rng) -> Case:
    """The lidar measures 0.3 m too much, always."""
    return with_scans(case, lambda s: replace(s, ranges=np.where(s.ranges < s.range_max, s.ranges + np.float32(0.3), s.ranges)))


def round_trip(case: Case, rng: Rng) -> Case:
    """One anchor's firmware reports the way there and back."""
    return with_ranges(case, lambda r: replace(r, ranges=np.where(r.anchor == 0, 2.0 * r.ranges, r.ranges)))


RANGE_FIELDS = ("stamps", "anchor", "ranges", "quality")


def standing(case: Case, rng: Rng) -> Case:
    """The robot never moves: every sensor repeats all the time what it measured within the first second and a half."""
    first = case.log.odometry.stamps[0]
    with_ = kept(case, lambda t: t < first + 1.5)
    log, new = case.log, with_.log
    odometry = Odometry(log.odometry.stamps, np.repeat(log.odometry.poses[:1], len(log.odometry.stamps), axis=0))
    scans, ranges = log.scans, log.ranges
    if scans is not None and new.scans is not None:
        again = rng.integers(0, len(new.scans.stamps), len(scans.stamps))
        noise = rng.normal(0.0, 0.01, scans.ranges.shape)
        scans = replace(scans, ranges=(new.scans.ranges[again] + noise).astype(np.float32))
    if ranges is not None:
        typical = np.array([np.median(ranges.ranges[ranges.anchor == k][:3]) for k in range(len(ranges.anchor_ids))])
        ranges = replace(ranges, ranges=typical[ranges.anchor] + rng.normal(0.0, 0.03, len(ranges.anchor)))
    return replace(case, log=replace(log, odometry=odometry, scans=scans, ranges=ranges), truth=odometry.poses)


WHEELS, LIDAR, RADIO, ALL = ("all", "no-lidar", "no-uwb"), ("all", "no-uwb"), ("all", "no-lidar"), ("all", "no-lidar", "no-uwb")

FAULTS: dict[str, tuple[Fault, tuple[str, ...]]] = {
    "none": (lambda case, rng: case, ALL),
    "wheels frozen from half time": (frozen_wheels(0.5, 1e9), WHEELS),
    "wheels frozen for 20 s": (frozen_wheels(0.5, 20.0), WHEELS),
    "wheels frozen throughout": (frozen_wheels(0.0, 1e9), WHEELS),
    "odometry reset to zero": (reset, WHEELS),
    "odometry: one reading 3 km off": (glitch, WHEELS),
    "odometry in cm": (rescaled(100.0, 100.0, 1.0), WHEELS),
    "odometry in mm": (rescaled(1000.0, 1000.0, 1.0), WHEELS),
    "odometry times 1.3": (rescaled(1.3, 1.3, 1.0), WHEELS),
    "heading in degrees": (rescaled(1.0, 1.0, 180.0 / np.pi), WHEELS),
    "heading's sign flipped": (rescaled(1.0, 1.0, -1.0), WHEELS),
    "wheels swapped": (redriven(1.0, -1.0), WHEELS),
    "driving direction reversed": (redriven(-1.0, 1.0), WHEELS),
    "carried away, stamps closed up": (carried(30.0, 0.05), WHEELS),
    "carried away, a gap of 40 s": (carried(30.0, 40.0), WHEELS),
    "lidar repeats a scan from half time": (repeated_scan(0.5), LIDAR),
    "lidar repeats a scan throughout": (repeated_scan(0.0), LIDAR),
    "laser times 1.2": (laser_factor(1.2), LIDAR),
    "laser in mm": (laser_factor(1000.0), LIDAR),
    "laser claims twice its view": (wide_claim, LIDAR),
    "laser mirrored": (mirrored_laser, LIDAR),
    "laser: noise only": (noise_scans, LIDAR),
    "half of the scans an hour late": (late_half, LIDAR),
    "ranges constant": (constant_ranges, RADIO),
    "ranges random": (random_ranges, RADIO),
    "ranges in mm": (range_factor(1000.0), RADIO),
    "ranges 5 s late": (late("radio", 5.0), RADIO),
    "ids rotated half-way": (rotated_ids, RADIO),
    "ids shuffled half-way": (shuffled_ids, RADIO),
    "one anchor moved 3 m half-way": (moved_anchor, RADIO),
    "clock of the odometry back 30 s": (clock_back("odometry"), WHEELS),
    "clock of the radio back 30 s": (clock_back("radio"), RADIO),
    "clock of the lidar back 30 s": (clock_back("lidar"), LIDAR),
    "clock of all back 30 s": (clock_back("odometry radio lidar"), ALL),
    "clock of the odometry forward 1 h": (clock_forward("odometry"), WHEELS),
    "clock of the radio forward 1 h": (clock_forward("radio"), RADIO),
    "clock of the lidar forward 1 h": (clock_forward("lidar"), LIDAR),
    "clock of all forward 1 h": (clock_forward("odometry radio lidar"), ALL),
    "two robots in one log": (lambda case, rng: case, ALL),
    "the same log twice": (twice, ALL),
    "odometry absent for 40 %": (absent("odometry"), WHEELS),
    "radio absent for 40 %": (absent("radio"), RADIO),
    "lidar absent for 40 %": (absent("lidar"), LIDAR),
    "no movement at all": (standing, ALL),
    "one wheel slips, 3 times 6 s": (slipping_wheel, WHEELS),
    "one anchor's ranges stuck from half time": (stuck_anchor, RADIO),
    "two anchors with one name": (one_name_for_two, RADIO),
    "one anchor reports twice its distance": (round_trip, RADIO),
    "the radio's clock runs 2 % fast": (one_radio_clock_fast, RADIO),
    "lidar mounted 90 degrees away": (turned_laser, LIDAR),
    "scans in reversed order": (reversed_scans, LIDAR),
    "lidar measures 0.3 m too much": (offset_laser, LIDAR),
    "a cable before a third of the beams": (covered_beams, LIDAR),
    "odometry stamps jitter by 0.3 s": (jitter("odometry", 0.3), WHEELS),
    "all stamps jitter by 0.3 s": (jitter("odometry radio lidar", 0.3), ALL),
    "odometry in bursts of 1 s": (bursts("odometry", 1.0), WHEELS),
    "half of the lines twice": (half_twice, ALL),
}
"""Each with the sensors it is tried with."""


# ---------------------------------------------------------------- mapping and judging


def sorted_log(case: Case) -> tuple[SensorLog, Floats]:
    """Return the recording as a reader gives it, sorted by time, and the truth in that order."""
    log, warnings, set_back = case.log, list[str](), dict[str, float]()

    def ordered(sensor: str, stamps: Floats) -> tuple[Floats, Ints]:
        stated = stamps + case.clocks.get(sensor, 0.0)
        order = time_order(stated, sensor, warnings, set_back)
        return stated[order], order

    stamps, order = ordered("odometry", log.odometry.stamps)
    truth = case.truth[order]
    log = replace(log, odometry=Odometry(stamps, log.odometry.poses[order]))
    if log.ranges is not None:
        r = log.ranges
        stamps, order = ordered("radio", r.stamps)
        log = replace(log, ranges=UwbRanges(stamps, r.anchor[order], r.ranges[order], r.quality[order], r.anchor_ids))
    if log.scans is not None:
        stamps, order = ordered("lidar", log.scans.stamps)
        log = replace(log, scans=replace(log.scans, stamps=stamps, ranges=log.scans.ranges[order]))
    return replace(log, notes=replace(log.notes, warnings=tuple(warnings), set_back=set_back)), truth


def _stopped(signum: int, frame: object) -> None:
    raise TimeoutError(f"stopped after {TIME_BAR:.0f} s")


@dataclass(frozen=True)
class Outcome:
    """What became of one case."""

    world: str
    name: str
    sensors: str
    ate: float
    """m; nan where there is no map."""
    anchor: float
    """Worst error among the anchors that are called ok, m; nan without any."""
    beyond: float
    """By how much the worst of them exceeds 1 m and three standard deviations, m."""
    exit_code: int
    stated: tuple[str, ...]
    """Doubts, or the error."""
    check: int
    """Exit code of `uwblite check`."""
    seconds: float
    warnings: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """'right', 'said', or what is wrong with the answer."""
        wrong = self.ate > ATE_BAR or self.beyond > 0.0
        if self.exit_code == 4:
            return "TOO LONG" if "stopped after" in self.stated[0] else "INTERNAL ERROR"
        if self.exit_code == 0:
            return "SILENTLY WRONG" if wrong else "right"
        return "false alarm" if self.name == "none" else "said, wrong" if wrong or self.exit_code == 1 else "said, right"


def judged(
    result: MapResult, truth_stamps: Floats, truth: Floats, anchors: dict[str, list[Floats]], reflect: bool
) -> tuple[float, float, float]:
    """Return the ATE, the worst error of an anchor called ok, and by how much it exceeds its bar, m."""
    rows_ = np.clip(np.searchsorted(truth_stamps, result.stamps), 0, len(truth_stamps) - 1)
    true = truth[rows_, :2]
    best: tuple[float, float, float] | None = None
    for mirror in (False, True) if reflect else (False,):
        sign = np.array([1.0, -1.0 if mirror else 1.0])
        move = _fit(result.trajectory[:, :2] * sign, true)
        ate = float(np.sqrt(np.mean(np.sum((se2.transform(move, result.trajectory[:, :2] * sign) - true) ** 2, axis=1))))
        worst, beyond = float("nan"), -np.inf
        for anchor in result.anchors:
            name, _, turn = anchor.id.partition("@")
            places = anchors.get(name, [])
            if anchor.status != "ok" or not places:
                continue
            place = places[min(int(turn or 1), len(places)) - 1]
            off = float(np.hypot(*(se2.transform(move, anchor.position * sign) - place)))
            sigma = float(np.sqrt(max(np.linalg.eigvalsh(anchor.covariance)[-1], 0.0)))
            worst, beyond = np.fmax(worst, off), max(beyond, off - ANCHOR_BAR - 3.0 * sigma)
        if best is None or ate < best[0]:
            best = (ate, float(worst), float(beyond))
    assert best is not None
    return best


def _fit(points: Floats, onto: Floats) -> Floats:
    """Return the motion (3,) that lays points (n, 2) onto others best (least squares)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    at = onto.mean(axis=0) - se2.rotate(np.array(angle), points.mean(axis=0))
    return np.array([*at, angle])


def tried(task: tuple[str, str, str, Case, Fault]) -> Outcome:
    """Put a fault into a case and map it."""
    world, name, sensors, case, fault = task
    case = replace(case, log=case.log.without(lidar=sensors == "no-lidar", uwb=sensors == "no-uwb"))
    case = fault(case, np.random.default_rng(7))
    figures = (float("nan"), float("nan"), -np.inf)
    stated: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    check = -1
    began = time.process_time()
    signal.signal(signal.SIGPROF, _stopped)
    signal.setitimer(signal.ITIMER_PROF, TIME_BAR)
    try:
        log, truth = sorted_log(case)
        check = 3 if checked(log) else 0
        began = time.process_time()
        result = build_map(log)
        figures = judged(result, log.odometry.stamps, truth, case.anchors, sensors == "no-lidar")
        stated, warnings = tuple(map(str, result.doubts)), tuple(map(str, result.warnings))
        code = 3 if result.doubts else 0
    except TimeoutError as error:
        stated, code = (str(error),), 4
    except UwbliteError as error:
        stated, code = (str(error),), 1
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        stated, code = (f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})",), 4
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return Outcome(world, name, sensors, *figures, code, stated, check, time.process_time() - began, warnings)


Task = tuple[str, str, str, Case, Fault]
_tasks: list[Task] = []
"""What forked processes find in their memory: faults are functions and do not travel."""


def _numbered(number: int) -> Outcome:
    return tried(_tasks[number])


def outcomes(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """Try all tasks, in order, in so many processes."""
    _tasks[:] = tasks
    if jobs == 1:
        yield from map(_numbered, range(len(tasks)))
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        yield from pool.map(_numbered, range(len(tasks)))


def checked(log: SensorLog) -> bool:
    """Return whether `uwblite check` finds anything serious."""
    return bool(examined(log)[0].serious)


def clean_cases(worlds: Sequence[str], minutes: float, seed: int) -> dict[str, Case]:
    """Return the recordings that faults are put into, by name."""
    cases = {}
    for world in worlds:
        if world == "kasdorf":
            cases[world] = real_case(SHARED / "kasdorf_2017-11-17-12-31-28" / "run.log.gz")
            continue
        trial = made(Settings(world=world, minutes=minutes, seed=seed))
        truth = np.column_stack([np.interp(trial.log.odometry.stamps, trial.stamps, c) for c in _unwrapped(trial.poses).T])
        cases[world] = Case(trial.log, truth, {name: [place] for name, place in trial.anchors.items()})
    return cases


def _unwrapped(poses: Floats) -> Floats:
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def real_case(path: Path) -> Case:
    """Return a real recording; what is true of it is what its map says without any fault."""
    log = read_log(path)
    result = build_map(log)
    return Case(log, result.trajectory, {a.id: [a.position] for a in result.anchors if a.status == "ok"})


def shown(outcome: Outcome) -> list[object]:
    """Return the row of an outcome."""
    stated = "; ".join(outcome.stated)
    return [
        outcome.world, outcome.name, outcome.sensors, outcome.ate, outcome.anchor, outcome.exit_code, outcome.check,
        outcome.verdict, stated if len(stated) < 300 else stated[:297] + "...", f"{outcome.seconds:.0f}",
    ]  # fmt: skip


HEAD = ("recording", "fault", "sensors", "ATE", "worst anchor called ok", "exit code", "check", "verdict", "what is said", "s")


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--worlds", default="lab")
    p.add_argument("--minutes", type=float, default=3.0)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--only", action="append", default=[], metavar="WORD", help="faults whose names contain it; repeatable")
    p.add_argument("--sensors", default="all,no-lidar,no-uwb")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")
    p.add_argument("--print", action="store_true", help="do not write docs/accuracy.md")
    p.add_argument("--verbose", action="store_true", help="show warnings too")
    args = p.parse_args(argv)
    worlds, tasks = args.worlds.split(","), []
    cases = clean_cases(worlds, args.minutes, args.seed)
    for world, case in cases.items():
        for name, (fault, kinds) in FAULTS.items():
            if args.only and not any(word in name for word in args.only):
                continue
            if name == "two robots in one log":
                if world == "kasdorf":
                    continue
                fault = two_robots(clean_cases([world], args.minutes, args.seed + 1)[world])
            tasks += [(world, name, s, case, fault) for s in kinds if s in args.sensors.split(",")]
    done = []
    for outcome in outcomes(tasks, args.jobs):
        done.append(outcome)
        print(" | ".join(f"{c:.3f}" if isinstance(c, float) else str(c) for c in shown(outcome)), flush=True)
        if args.verbose:
            print(*(f"      warning: {w}" for w in outcome.warnings), sep="\n", flush=True)
    counts = {v: sum(o.verdict == v for o in done) for v in sorted({o.verdict for o in done})}
    summary = ", ".join(f"{v}: {n}" for v, n in counts.items())
    print(summary)
    if not args.print:
        text = f"## Faults\n\n{__doc__.split(chr(10) * 2)[-1].strip()}\n\n{summary}.\n\n{table(HEAD, [shown(o) for o in done])}"
        write_section(ROOT / "docs" / "accuracy.md", "faults", text)
    return 1 if any(o.verdict.isupper() for o in done) else 0


if __name__ == "__main__":
    sys.exit(main())
