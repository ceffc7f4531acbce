"""Faults of the radio and its anchors."""

from dataclasses import replace

import numpy as np

from uwblite import se2
from uwblite.sensor_log import UwbRanges

from .case import Case, Fault, Floats, Rng, rows, shifted, with_ranges


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
    return case if case.log.ranges is None else elsewhere(case, {case.log.ranges.anchor_ids[0]: np.array([1.8, 2.4])})


def moved_by(x: float, y: float, share: float) -> Fault:
    """One anchor is put so much elsewhere, m, at a share of the recording."""
    return lambda case, rng: case if case.log.ranges is None else elsewhere(
        case, {case.log.ranges.anchor_ids[0]: np.array([x, y])}, share
    )


def back_elsewhere(case: Case, rng: Rng) -> Case:
    """One anchor's battery is empty from 30 % on; at 60 % it is put up again, 3 m away."""
    case = moved_by(1.8, -2.4, 0.6)(case, rng)
    first, last = case.log.odometry.stamps[[0, -1]]
    return with_ranges(case, lambda r: rows(
        r, (r.anchor != 0) | (r.stamps < first + 0.3 * (last - first)) | (r.stamps >= first + 0.6 * (last - first))
    ))


def one_after_the_other(case: Case, rng: Rng) -> Case:
    """Two anchors are put 1.2 m away, one at a third of the time, one at two thirds."""
    if case.log.ranges is None:
        return case
    names = case.log.ranges.anchor_ids
    return elsewhere(elsewhere(case, {names[0]: np.array([1.2, 0.0])}, 0.3), {names[2]: np.array([0.0, -1.2])}, 0.6)


def moved_as_one(case: Case, rng: Rng) -> Case:
    """Half-way all anchors are put elsewhere as one, as if the room were another."""
    places = np.array([case.anchors[name][0] for name in case.anchors])
    middle = places.mean(axis=0)
    after = middle + se2.transform(np.array([4.0, 1.0, 0.5]), places - middle)
    return elsewhere(case, dict(zip(case.anchors, after - places, strict=True)))


def names_of_the_reading_before(case: Case, rng: Rng) -> Case:
    """From half-way on each range carries the name that the reading before it should have."""

    if case.log.ranges is None:
        return case
    r, names, places = case.log.ranges, case.log.ranges.anchor_ids, dict(case.anchors)
    given, later = np.roll(r.anchor, 1), r.stamps >= case.middle
    for k, name in enumerate(names):
        # In turn, a name is that of one other anchor throughout.
        usual = np.bincount(r.anchor[later & (given == k)], minlength=len(names)).argmax()
        if name in places and names[usual] in places:
            places[name] = [*case.anchors[name], case.anchors[names[usual]][0]]
    return replace(with_ranges(case, lambda r: replace(r, anchor=np.where(later, given, r.anchor))), anchors=places)


def elsewhere(case: Case, by: dict[str, Floats], share: float = 0.5) -> Case:
    """Return the case with anchors moved by so much (2,), m, at a share of its time."""
    first, last = case.log.odometry.stamps[[0, -1]]
    since = first + share * (last - first)

    def change(r: UwbRanges) -> UwbRanges:
        ranges = r.ranges.copy()
        for name in set(by) & set(r.anchor_ids):
            moved = (r.anchor == r.anchor_ids.index(name)) & (r.stamps >= since)
            longer = _longer(case, r, case.anchors[name][0], by[name])
            ranges[moved] = np.maximum(ranges + longer, 0.05)[moved]
        return replace(r, ranges=ranges)

    places = {name: [*places, places[-1] + by[name]] if name in by else places for name, places in case.anchors.items()}
    times = {name: [*case.since.get(name, []), since] for name in by}
    return replace(with_ranges(case, change), anchors=places, since={**case.since, **times})


def _longer(case: Case, r: UwbRanges, place: Floats, shift: Floats) -> Floats:
    """Return by how much the true distance (m,) of each range changes where its anchor is moved from its place, m."""
    base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, r.stamps)
    tag = se2.transform(base, np.broadcast_to(case.log.mounting.tag_position[:2], (len(base), 2)))
    return np.hypot(*(place + shift - tag).T) - np.hypot(*(place - tag).T)


def no_antenna_delay(anchors: int, tag: bool) -> Fault:
    """The antenna delay of the first so many anchors, and of the tag, was never set: 76.97 m each, half of 513.48 ns."""
    return lambda case, rng: with_ranges(
        case, lambda r: replace(r, ranges=r.ranges + 76.97 * ((r.anchor < anchors).astype(float) + tag))
    )


def stuck_anchor(case: Case, rng: Rng) -> Case:
    """One anchor answers with its last range from half-way on, but for the last digit."""

    def change(r: UwbRanges) -> UwbRanges:
        own = np.flatnonzero((r.anchor == 0) & (r.stamps >= case.middle))
        ranges = r.ranges.copy()
        ranges[own] = ranges[own[:1]] + rng.integers(-1, 2, len(own)) * 0.01
        return replace(r, ranges=ranges)

    return with_ranges(case, change)


def one_name_for_two(case: Case, rng: Rng) -> Case:
    """Two anchors answer to one name throughout."""

    def change(r: UwbRanges) -> UwbRanges:
        anchor = np.where(r.anchor == 1, 0, r.anchor)
        used, anchor = np.unique(anchor, return_inverse=True)
        return replace(r, anchor=anchor.astype(np.intp), anchor_ids=tuple(r.anchor_ids[k] for k in used))

    return with_ranges(case, change)


def one_radio_clock_fast(case: Case, rng: Rng) -> Case:
    """The radio's clock runs fast by 2 %."""
    first = float(case.log.odometry.stamps[0])
    return shifted(case, lambda t: 0.02 * (t - first), "radio")


def one_times(factor: float) -> Fault:
    """One anchor reports so many times its distance; 2: the way there and back."""
    return lambda case, rng: with_ranges(
        case, lambda r: replace(r, ranges=np.where(r.anchor == 0, factor * r.ranges, r.ranges))
    )


def other_tag(ahead: float, left: float, longer: float) -> Fault:
    """From half-way on the tag hangs elsewhere on the robot, m, and measures so much too much."""

    def change(r: UwbRanges, case: Case) -> UwbRanges:
        base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, r.stamps)
        tag = np.broadcast_to(case.log.mounting.tag_position[:2], (len(base), 2))
        place = np.array([case.anchors[name][0] for name in r.anchor_ids])[r.anchor]
        old, new = (np.hypot(*(place - se2.transform(base, tag + by)).T) for by in (np.zeros(2), np.array([ahead, left])))
        return replace(r, ranges=np.where(r.stamps >= case.middle, r.ranges + new - old + longer, r.ranges))

    return lambda case, rng: with_ranges(case, lambda r: change(r, case))


def own_body(metres: float) -> Fault:
    """The robot's body delays what comes from behind by so much."""

    def change(r: UwbRanges, case: Case) -> UwbRanges:
        base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, r.stamps)
        away = np.array([case.anchors[name][0] for name in r.anchor_ids])[r.anchor] - base[:, :2]
        behind = np.cos(np.arctan2(away[:, 1], away[:, 0]) - base[:, 2]) < -0.2
        return replace(r, ranges=r.ranges + metres * behind)

    return lambda case, rng: with_ranges(case, lambda r: change(r, case))


def exchanged_for(seconds: float, share: float = 0.5) -> Fault:
    """Two anchors answer to each other's names for a while, from a share of the recording on."""

    def fault(case: Case, rng: Rng) -> Case:
        if case.log.ranges is None:
            return case
        first, last = case.log.odometry.stamps[[0, -1]]
        begin, (a, b) = float(first + share * (last - first)), case.log.ranges.anchor_ids[:2]

        def change(r: UwbRanges) -> UwbRanges:
            on = (r.stamps >= begin) & (r.stamps < begin + seconds) & (r.anchor < 2)
            return replace(r, anchor=np.where(on, 1 - r.anchor, r.anchor))

        if not {a, b} <= case.anchors.keys():
            return with_ranges(case, change)
        own = {name: case.anchors[name][0] for name in (a, b)}
        places = {**case.anchors, a: [own[a], own[b], own[a]], b: [own[b], own[a], own[b]]}
        times = {name: [begin, begin + seconds] for name in (a, b)}
        return replace(with_ranges(case, change), anchors=places, since={**case.since, **times})

    return fault


def now_and_then(metres: float) -> Fault:
    """One anchor is too long by so much in three of ten ranges."""
    return lambda case, rng: with_ranges(
        case, lambda r: replace(r, ranges=r.ranges + metres * ((r.anchor == 0) & (rng.random(len(r.ranges)) < 0.3)))
    )


def dying_battery(case: Case, rng: Rng) -> Case:
    """The noise of one anchor grows to 3 m, and more and more of its ranges are missing."""

    def change(r: UwbRanges) -> UwbRanges:
        age = (r.stamps - r.stamps[0]) / np.ptp(r.stamps) * (r.anchor == 0)
        noisy = np.abs(r.ranges + 3.0 * age**2 * rng.standard_normal(len(age)))
        return rows(replace(r, ranges=noisy), rng.random(len(age)) >= 0.8 * age)

    return with_ranges(case, change)


def rounded(step: float) -> Fault:
    """Ranges are rounded, m."""
    return lambda case, rng: with_ranges(case, lambda r: replace(r, ranges=np.round(r.ranges / step) * step))


def moved_anchors(case: Case, rng: Rng) -> Case:
    """Half-way all anchors are put elsewhere, each 2 m away."""
    return elsewhere(case, {name: 2.0 * np.array([np.cos(n), np.sin(n)]) for n, name in enumerate(case.anchors)})


def carried_anchor(case: Case, rng: Rng) -> Case:
    """One anchor rides on a cart that drives to and fro all the time: it has no place."""
    if case.log.ranges is None:
        return case
    name = case.log.ranges.anchor_ids[0]

    def change(r: UwbRanges) -> UwbRanges:
        swing = np.column_stack([2.0 * np.sin(2.0 * np.pi * r.stamps / 80.0), 1.5 * np.cos(2.0 * np.pi * r.stamps / 50.0)])
        longer = _longer(case, r, case.anchors[name][0], swing)
        return replace(r, ranges=np.where(r.anchor == 0, np.maximum(r.ranges + longer, 0.05), r.ranges))

    return replace(with_ranges(case, change), anchors={n: p for n, p in case.anchors.items() if n != name})


def driven_away(metres: float) -> Fault:
    """One anchor is driven away on a cart, between two and three fifths of the time."""

    def fault(case: Case, rng: Rng) -> Case:
        if case.log.ranges is None:
            return case
        name, way = case.log.ranges.anchor_ids[0], metres * np.array([0.8, 0.6])

        def change(r: UwbRanges) -> UwbRanges:
            age = (r.stamps - r.stamps[0]) / np.ptp(r.stamps)
            driven = np.clip((age - 0.4) / 0.2, 0.0, 1.0)[:, None] * way
            longer = _longer(case, r, case.anchors[name][0], driven)
            return replace(r, ranges=np.where(r.anchor == 0, np.maximum(r.ranges + longer, 0.05), r.ranges))

        place = case.anchors[name][0]
        return replace(with_ranges(case, change), anchors={**case.anchors, name: [place, place + way]})

    return fault


def missed(share: float) -> Fault:
    """A share of the ranges is 0: the radio has missed its partner."""
    return lambda case, rng: with_ranges(
        case, lambda r: replace(r, ranges=np.where(rng.random(len(r.ranges)) < share, 0.0, r.ranges))
    )


def late_echo(case: Case, rng: Rng) -> Case:
    """A metal shelf is put up before two anchors half-way: from then on all of their ranges are 0.8 to 2 m too long."""

    def change(r: UwbRanges) -> UwbRanges:
        hidden = (r.anchor < 2) & (r.stamps >= case.middle)
        return replace(r, ranges=r.ranges + hidden * rng.uniform(0.8, 2.0, len(r.ranges)))

    return with_ranges(case, change)


def saturated(reach: float) -> Fault:
    """The radio reports its reach, m, for all that is farther."""
    return lambda case, rng: with_ranges(case, lambda r: replace(r, ranges=np.minimum(r.ranges, reach)))


def longer_from_half(metres: float) -> Fault:
    """A new firmware adds so much to all ranges from half time on."""
    return lambda case, rng: with_ranges(case, lambda r: replace(r, ranges=r.ranges + metres * (r.stamps >= case.middle)))


def warming_up(metres: float) -> Fault:
    """All ranges grow longer steadily, by so much in the end."""
    return lambda case, rng: with_ranges(
        case, lambda r: replace(r, ranges=r.ranges + metres * (r.stamps - r.stamps[0]) / np.ptp(r.stamps))
    )


def averaged(count: int) -> Fault:
    """The firmware reports the mean of the last so many ranges to each anchor: they lag."""

    def change(r: UwbRanges) -> UwbRanges:
        ranges = r.ranges.copy()
        for own in (np.flatnonzero(r.anchor == k) for k in np.unique(r.anchor)):
            before = np.concatenate([np.full(count - 1, r.ranges[own[0]]), r.ranges[own]])
            ranges[own] = np.lib.stride_tricks.sliding_window_view(before, count).mean(axis=1)
        return replace(r, ranges=ranges)

    return lambda case, rng: with_ranges(case, change)


def last_value_where_lost(share: float) -> Fault:
    """A share of the ranges is lost, eight in a row, and the radio repeats the last one instead."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(r: UwbRanges) -> UwbRanges:
            ranges = r.ranges.copy()
            for own in (np.flatnonzero(r.anchor == k) for k in np.unique(r.anchor)):
                lost = np.repeat(rng.random(len(own) // 8 + 1) < share, 8)[: len(own)]
                last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(own))))
                ranges[own] = r.ranges[own[last]]
            return replace(r, ranges=ranges)

        return with_ranges(case, change)

    return fault


def raised(metres: float) -> Fault:
    """Half-way one anchor is hung higher, from the height of the tag."""

    def change(r: UwbRanges, case: Case) -> UwbRanges:
        higher = (r.anchor == 0) & (r.stamps >= case.middle)
        return replace(r, ranges=np.where(higher, np.hypot(r.ranges, metres), r.ranges))

    return lambda case, rng: with_ranges(case, lambda r: change(r, case))


def mixed_robots(share: float) -> Fault:
    """A share of the ranges is another robot's, which drives the same path half a recording later."""

    def change(r: UwbRanges, case: Case, rng: Rng) -> UwbRanges:
        if not set(r.anchor_ids) <= case.anchors.keys():
            return r
        span = float(np.ptp(case.log.odometry.stamps))
        later = case.log.odometry.stamps[0] + (r.stamps - case.log.odometry.stamps[0] + 0.5 * span) % span
        base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, later)
        place = np.array([case.anchors[name][0] for name in r.anchor_ids])[r.anchor]
        other = np.hypot(*(place - base[:, :2]).T) + rng.normal(0.0, 0.05, len(r.ranges))
        return replace(r, ranges=np.where(rng.random(len(other)) < share, np.maximum(other, 0.05), r.ranges))

    return lambda case, rng: with_ranges(case, lambda r: change(r, case, rng))
