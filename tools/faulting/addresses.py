"""Faults of what ranges are said to be to, and of when and where they were measured."""

from dataclasses import replace

import numpy as np

from uwblite.sensor_log import UwbRanges

from .case import Case, Fault, Rng, with_ranges


def damaged_ids(share: float) -> Fault:
    """A share of the ids, hexadecimal numbers, arrives with one bit of twelve flipped."""

    def fault(case: Case, rng: Rng) -> Case:
        if case.log.ranges is None:
            return case
        r = case.log.ranges
        said = [f"{n + 0xA00:04X}" for n in range(len(r.anchor_ids))]
        wrong = [f"{int(said[a], 16) ^ (1 << int(rng.integers(12))):04X}" for a in r.anchor]
        hit = rng.random(len(wrong)) < share
        names, number = np.unique(np.where(hit, wrong, np.array(said)[r.anchor]), return_inverse=True)
        ranges = replace(r, anchor=number.astype(np.intp), anchor_ids=tuple(names.tolist()))
        places = {new: case.anchors[old] for new, old in zip(said, r.anchor_ids, strict=True) if old in case.anchors}
        return replace(case, log=replace(case.log, ranges=ranges), anchors=places)

    return fault


def copied_anchor(case: Case, rng: Rng) -> Case:
    """One anchor's ranges are what another one measured last: it has no place."""
    if case.log.ranges is None:
        return case

    def change(r: UwbRanges) -> UwbRanges:
        last = np.maximum.accumulate(np.where(r.anchor == 0, np.arange(len(r.anchor)), 0))
        return replace(r, ranges=np.where(r.anchor == 1, r.ranges[last], r.ranges))

    name = case.log.ranges.anchor_ids[1]
    return replace(with_ranges(case, change), anchors={n: p for n, p in case.anchors.items() if n != name})


def late_anchor(seconds: float) -> Fault:
    """One anchor's ranges come through a relay and are stamped late, s."""

    def change(r: UwbRanges) -> UwbRanges:
        stamps = r.stamps + seconds * (r.anchor == 0)
        order = np.argsort(stamps, kind="stable")
        return replace(
            r, stamps=stamps[order], anchor=r.anchor[order], ranges=r.ranges[order], quality=r.quality[order]
        )

    return lambda case, rng: with_ranges(case, change)


def beside_the_robot(seconds: float) -> Fault:
    """Half-way one anchor is carried beside the robot for a while, 1 m away, and put back."""

    def change(r: UwbRanges, case: Case, rng: Rng) -> UwbRanges:
        on = (r.anchor == 0) & (r.stamps >= case.middle) & (r.stamps < case.middle + seconds)
        return replace(r, ranges=np.where(on, 1.0 + 0.2 * rng.standard_normal(len(on)), r.ranges))

    return lambda case, rng: with_ranges(case, lambda r: change(r, case, rng))


def squared(case: Case, rng: Rng) -> Case:
    """The driver reports squared distances."""
    return with_ranges(case, lambda r: replace(r, ranges=r.ranges**2))
