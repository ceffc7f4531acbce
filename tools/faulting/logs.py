"""Faults of clocks, logs and those who record them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwblite import se2
from uwblite.sensor_log import Odometry, UwbRanges

from .case import Case, Fault, Floats, Ints, Rng, kept, rows, shifted, with_odometry
from .wheels import reset


def clock_back(kinds: str) -> Fault:
    """The clock of some sensors is set back 30 s half-way."""
    return lambda case, rng: shifted(case, lambda t: np.where(t >= case.middle, -30.0, 0.0), kinds)


def wrapped_clock(kinds: str, period: float) -> Fault:
    """The clock of some sensors counts up to a period, s, and begins again: 16 bits of milliseconds."""
    return lambda case, rng: shifted(case, lambda t: (t - case.log.odometry.stamps[0]) // period * -period, kinds)


def clock_forward(kinds: str) -> Fault:
    """The clock of some sensors is set forward by an hour half-way."""
    return lambda case, rng: shifted(case, lambda t: np.where(t >= case.middle, 3600.0, 0.0), kinds)


def late(kinds: str, seconds: float) -> Fault:
    """All stamps of a sensor are late."""
    return lambda case, rng: shifted(case, lambda t: np.full(len(t), seconds), kinds)


def in_unit(kinds: str, seconds: float) -> Fault:
    """Stamps are written in a unit of so many seconds."""
    return lambda case, rng: shifted(case, lambda t: t / seconds - t, kinds)


def joined_with_overlap(case: Case, rng: Rng) -> Case:
    """Two logs in one file: the second begins at zero, by a clock with which it overlaps the first by 25 s."""
    return shifted(reset(case, rng), lambda t: np.where(t >= case.middle, -25.0, 0.0))


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


def two_buildings(other: Case) -> Fault:
    """The log goes on in another building with other anchors; the odometry goes on where it was."""

    def fault(case: Case, rng: Rng) -> Case:
        one, two = case.log, other.log
        later = float(one.odometry.stamps[-1] - two.odometry.stamps[0]) + 0.05
        end = se2.compose(one.odometry.poses[-1], se2.inverse(two.odometry.poses[0]))
        moved = replace(two, odometry=Odometry(two.odometry.stamps + later, se2.compose(end, two.odometry.poses)))
        if two.scans is not None:
            moved = replace(moved, scans=replace(two.scans, stamps=two.scans.stamps + later))
        if one.ranges is not None and two.ranges is not None:
            r, names = two.ranges, one.ranges.anchor_ids
            ids = (*names, *(f"Z{name}" for name in r.anchor_ids))
            moved = replace(moved, ranges=UwbRanges(r.stamps + later, r.anchor + len(names), r.ranges, r.quality, ids))
            case = replace(case, log=replace(one, ranges=replace(one.ranges, anchor_ids=ids)))
        return merged(case, replace(other, log=moved))

    return fault


def twice(case: Case, rng: Rng) -> Case:
    """The same log twice in a file."""
    return merged(case, case)

RANGE_FIELDS = ("stamps", "anchor", "ranges", "quality")


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


def time_jump(kinds: str, seconds: float) -> Fault:
    """The clock of some sensors jumps half-way and stays so."""
    return lambda case, rng: shifted(case, lambda t: np.where(t >= case.middle, seconds, 0.0), kinds)


def thinned(rate: float) -> Fault:
    """The odometry comes at a low rate only, 1/s."""

    def fault(case: Case, rng: Rng) -> Case:
        stamps = case.log.odometry.stamps
        beat = np.floor((stamps - stamps[0]) * rate)
        first = np.concatenate([[True], np.diff(beat) > 0])
        log = replace(case.log, odometry=Odometry(stamps[first], case.log.odometry.poses[first]))
        return replace(case, log=log, truth=case.truth[first])

    return fault


def whole_stamps(kinds: str, step: float) -> Fault:
    """Stamps are cut off to whole steps, s: several readings share each."""
    return lambda case, rng: shifted(case, lambda t: np.floor(t / step) * step - t, kinds)


def cut_out(seconds: float) -> Fault:
    """Nothing is recorded for a while half-way, and the robot drives on."""
    return lambda case, rng: kept(case, lambda t: (t < case.middle) | (t >= case.middle + seconds))


def lost(share: float) -> Fault:
    """A share of all readings is lost."""
    return lambda case, rng: kept(case, lambda t: rng.random(len(t)) >= share)


def hub_resets(every: float, gap: float, late: float) -> Fault:
    """All devices are gone for a while, s, again and again; the base then counts from zero, and the lidar's stamps are late."""

    def fault(case: Case, rng: Rng) -> Case:
        first = case.log.odometry.stamps[0]
        case = kept(case, lambda t: (t < first + every) | ((t - first) % every >= gap))

        def restarted(stamps: Floats, poses: Floats) -> Floats:
            for part in np.split(np.arange(len(stamps)), 1 + np.flatnonzero(np.diff((stamps - first) // every))):
                if stamps[part[0]] >= first + every:
                    poses[part] = se2.between(np.broadcast_to(poses[part[0]], (len(part), 3)), poses[part])
            return poses

        return shifted(with_odometry(case, restarted), lambda t: np.where(t >= first + every, late, 0.0), "lidar")

    return fault


def clock_rate(kinds: str, factor: float) -> Fault:
    """The clock of some sensors runs so many times too fast."""
    return lambda case, rng: shifted(case, lambda t: (factor - 1.0) * (t - case.log.odometry.stamps[0]), kinds)


def half_missing(case: Case, rng: Rng) -> Case:
    """The middle half is not in the log; what follows counts from zero and is stamped as if it came a second later."""
    stamps = case.log.odometry.stamps
    begin, end = stamps[0] + np.array([0.25, 0.75]) * np.ptp(stamps)
    case = kept(case, lambda t: (t < begin) | (t > end))

    def restarted(stamps: Floats, poses: Floats) -> Floats:
        later = stamps > end
        poses[later] = se2.between(np.broadcast_to(poses[later][0], poses[later].shape), poses[later])
        return poses

    return shifted(with_odometry(case, restarted), lambda t: np.where(t > end, begin + 1.0 - end, 0.0))


def sent_again(share: float, seconds: float) -> Fault:
    """A share of ranges and scans is sent again, with a stamp of its own, s later."""

    def fault(case: Case, rng: Rng) -> Case:
        log = case.log

        def rows_of(stamps: Floats) -> tuple[Floats, Ints]:
            again = np.flatnonzero(rng.random(len(stamps)) < share)
            which, all_stamps = np.append(np.arange(len(stamps)), again), np.append(stamps, stamps[again] + seconds)
            order = np.argsort(all_stamps, kind="stable")
            return all_stamps[order], which[order]

        if log.ranges is not None:
            stamps, which = rows_of(log.ranges.stamps)
            own = {name: getattr(log.ranges, name)[which] for name in RANGE_FIELDS[1:]}
            log = replace(log, ranges=replace(log.ranges, stamps=stamps, **own))
        if log.scans is not None:
            stamps, which = rows_of(log.scans.stamps)
            log = replace(log, scans=replace(log.scans, stamps=stamps, ranges=log.scans.ranges[which]))
        return replace(case, log=log)

    return fault
