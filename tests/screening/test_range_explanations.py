"""What explains ranges that do not fit the path: planted clocks, names and wheels, and sound ones."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from helpers import planted

from uwblite import se2
from uwblite.arrays import CHUNK
from uwblite.screening.range_explanations import Explanation, Stretches, _best_order, _best_place, _traces, explained_by_ranges
from uwblite.sensor_log import Odometry, SensorLog

CORNERS = np.array([[6.5, 1.0], [-5.5, 5.0], [-2.0, -6.5], [1.0, 7.0]])


def late_by(seconds, seed=1, metres=60.0, still=()):
    """Return a drive of 120 s among four anchors; ranges are stamped late, and wheels count nothing at times, s."""
    rng = np.random.default_rng(seed)
    stamps, truth = planted.wander(rng, metres)
    wheels = planted.odometry(stamps, truth, rng, scale=1.02, noise=0.01, turn_noise=0.01)
    radio = planted.ranges(rng, stamps, truth, CORNERS, rate=1.0, sigma=0.05, outliers=0.05)
    log = SensorLog(wheels, replace(radio, stamps=radio.stamps + seconds), None)
    for begin, end in still:
        log = redriven(log, begin, end, lambda steps: 0.0 * steps)
    return log


def redriven(log, begin, end, change):
    """Return a recording whose wheels count changed steps (n, 3) between two times, s."""
    stamps, poses = log.odometry.stamps, log.odometry.poses
    steps, own = se2.between(poses[:-1], poses[1:]), (stamps[1:] > begin) & (stamps[1:] <= end)
    steps[own] = change(steps[own])
    return replace(log, odometry=Odometry(stamps, se2.chain(poses[0], steps)))


def kinds_of(log):
    return [(fact.kind, fact.figures.get("what", "")) for fact in explained_by_ranges(log)[1]]


@pytest.mark.parametrize(("seed", "late"), [(0, -18.0), (1, 5.0)])
def test_a_radio_whose_clock_is_seconds_off_is_found_along_the_path(seed, late):
    log = late_by(late, seed)
    moved, (fact,) = explained_by_ranges(log)
    assert fact.kind == "late-ranges"
    assert fact.figures["late"] == pytest.approx(late, abs=1.0)
    np.testing.assert_allclose(moved.ranges.stamps, log.ranges.stamps - fact.figures["late"])


@pytest.mark.parametrize(("seed", "late", "rate"), [(0, 0.0, 0.05), (1, 4.0, -0.08)])
def test_a_radio_whose_clock_runs_fast_or_slow_is_set_right(seed, late, rate):
    log, sound = late_by(late, seed), late_by(0.0, seed).ranges.stamps
    log = replace(log, ranges=replace(log.ranges, stamps=sound + late + rate * sound))
    moved, (fact,) = explained_by_ranges(log)
    assert (fact.kind, fact.figures["grows"]) == ("late-ranges", pytest.approx(rate * np.ptp(sound), abs=1.5))
    np.testing.assert_allclose(moved.ranges.stamps, sound, atol=1.0)


@pytest.mark.parametrize(("anchors", "metres"), [([0], 77.0), ([0, 1, 2, 3], 153.9), ([1, 2], 77.4)])
def test_antenna_delays_that_were_never_set_are_taken_off(anchors, metres):
    """77 m for the anchor, twice that where the tag has none either; boards differ by decimetres."""
    log = late_by(0.0)
    late = np.isin(log.ranges.anchor, anchors)
    shifted, (fact,) = explained_by_ranges(replace(log, ranges=replace(log.ranges, ranges=log.ranges.ranges + metres * late)))
    assert (fact.kind, fact.figures["anchors"]) == ("antenna-delay", [log.ranges.anchor_ids[a] for a in anchors])
    np.testing.assert_allclose(shifted.ranges.ranges, log.ranges.ranges, atol=0.5)


def test_readings_of_zero_have_no_antenna_delay():
    """A radio that reports zero has missed its partner."""
    log = late_by(0.0)
    missed = np.arange(len(log.ranges.ranges)) % 7 == 0
    ranges = np.where(missed, 0.0, log.ranges.ranges + 77.0)
    shifted, (fact,) = explained_by_ranges(replace(log, ranges=replace(log.ranges, ranges=ranges)))
    assert fact.kind == "antenna-delay"
    np.testing.assert_allclose(shifted.ranges.ranges, np.where(missed, 0.0, log.ranges.ranges), atol=0.5)


@pytest.mark.filterwarnings("error")
def test_a_reading_of_an_antenna_delay_itself_divides_by_nothing():
    log = late_by(0.0)
    ranges = np.where(np.arange(len(log.ranges.ranges)) == 9, 77.0, log.ranges.ranges)
    assert explained_by_ranges(replace(log, ranges=replace(log.ranges, ranges=ranges)))[1] == []


def test_rows_that_do_not_fit_in_a_cache_have_the_likelihoods_of_their_own():
    rng = np.random.default_rng(0)
    count = CHUNK // 8 + 50
    paths, ranges = rng.normal(size=(count, 8, 2)), rng.uniform(1.0, 9.0, (count, 8))
    whole, last = (_best_place(paths[k:], ranges[k:], np.ones((count - k, 8))) for k in (0, count - 60))
    np.testing.assert_allclose(whole[:, -60:], last)


def test_a_sound_recording_has_nothing_to_explain():
    log = late_by(0.0)
    assert explained_by_ranges(log) == (log, [])
    nothing = replace(log, ranges=None)
    assert explained_by_ranges(nothing) == (nothing, [])
    few = replace(log, ranges=log.ranges.rows(slice(0, 5)))
    assert explained_by_ranges(few) == (few, [])


@pytest.mark.parametrize(("seed", "still"), [(0, ((45.0, 60.0),)), (1, ((60.0, 120.0),))])
def test_wheels_that_stand_still_make_no_clock(seed, still):
    moved, facts = explained_by_ranges(late_by(0.0, seed, still=still))
    assert moved.ranges.stamps[0] == late_by(0.0, seed).ranges.stamps[0]
    assert {fact.kind for fact in facts} <= {"wheels-against-ranges"}


@pytest.mark.parametrize("seed", range(4))
def test_wheels_that_slip_twice_along_a_straight_way_make_no_clock(seed):
    """Ranges that are late by time that grows fit the two stretches on which wheels count twice the way."""
    rng, stamps = np.random.default_rng(seed), np.arange(0.0, 200.0, 0.05)
    y = 0.2 * np.sin(stamps / 9.0)
    truth = np.column_stack([0.4 * stamps, y, np.arctan2(np.gradient(y), 0.4 * 0.05)])
    anchors = np.array([[2.0, 2.5], [20.0, -2.0], [38.0, 3.0], [58.0, -2.5], [78.0, 2.0]])
    wheels = planted.odometry(stamps, truth, rng, noise=0.01, turn_noise=0.01)
    log = SensorLog(wheels, planted.ranges(rng, stamps, truth, anchors, rate=1.0, sigma=0.05, outliers=0.05), None)
    for begin, end in ((8.0, 12.5), (150.0, 154.0)):
        log = redriven(log, begin, end, lambda steps: steps * [2.3, 1.0, 1.0] - [0.0, 0.0, 0.013])
    assert {kind for kind, _ in kinds_of(log)} == {"wheels-against-ranges"}


def test_wheels_that_turn_at_random_make_no_clock():
    """Each stretch fits at some other offset; all are no clock."""
    rng = np.random.default_rng(0)
    stamps, truth = planted.wander(rng, 80.0)
    wheels = planted.odometry(stamps, truth, rng, noise=0.05, turn_noise=0.6)
    log = SensorLog(wheels, planted.ranges(rng, stamps, truth, CORNERS, rate=1.0, sigma=0.15, outliers=0.1), None)
    assert "late-ranges" not in dict(kinds_of(log))


def test_names_exchanged_half_way_are_named():
    log = late_by(0.0)
    radio = log.ranges
    other = np.where((radio.stamps > 60.0) & (radio.anchor < 2), 1 - radio.anchor, radio.anchor)
    (fact,) = explained_by_ranges(replace(log, ranges=replace(radio, anchor=other)))[1]
    assert fact.kind == "exchanged-names"
    assert set(fact.figures["anchors"]) == set(radio.anchor_ids[:2])
    assert fact.figures["at"] == pytest.approx(60.0, abs=10.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_heading_that_is_stuck_exchanges_no_names(seed):
    """An exchange of two of four anchors explains a turn that the heading misses nearly as well."""
    log = redriven(late_by(0.0, seed), 60.0, 120.0, lambda steps: steps * np.array([1.0, 1.0, 0.0]))
    assert {kind for kind, _ in kinds_of(log)} == {"wheels-against-ranges"}


def test_names_exchanged_for_a_time_are_named_twice():
    log = late_by(0.0)
    radio = log.ranges
    while_exchanged = (radio.stamps > 40.0) & (radio.stamps < 75.0) & (radio.anchor < 2)
    other = np.where(while_exchanged, 1 - radio.anchor, radio.anchor)
    assert kinds_of(replace(log, ranges=replace(radio, anchor=other))) == 2 * [("exchanged-names", "")]


def test_names_exchanged_on_a_path_that_drifts_are_no_fault_of_the_wheels():
    """Moments before and after the exchange see it on one side, where no path explains it; it is one cause."""
    rng = np.random.default_rng(1)
    stamps, truth = planted.wander(rng, 120.0)
    wheels = planted.odometry(stamps, truth, rng, scale=1.02, noise=0.02, turn_noise=0.08)
    anchors = np.concatenate([CORNERS[:, :2], [[3.0, -6.0], [-5.0, 2.0]]])
    radio = planted.ranges(rng, stamps, truth, anchors, rate=2.0, sigma=0.05, outliers=0.1)
    other = np.where(radio.stamps > 60.0, (radio.anchor + 1) % len(anchors), radio.anchor)
    facts = explained_by_ranges(SensorLog(wheels, replace(radio, anchor=other), None))[1]
    exchanged = [fact for fact in facts if fact.kind == "exchanged-names"]
    assert [set(fact.figures["anchors"]) for fact in exchanged] == [set(radio.anchor_ids)]
    assert [fact for fact in facts if abs(fact.figures["at"] - 60.0) < 15.0] == exchanged


def test_ranges_that_are_any_numbers_from_half_time_are_no_fault_of_the_wheels():
    log, rng = late_by(0.0), np.random.default_rng(1)
    radio = log.ranges
    values = np.where(radio.stamps > 60.0, rng.uniform(0.5, 15.0, len(radio.stamps)), radio.ranges)
    facts = explained_by_ranges(replace(log, ranges=replace(radio, ranges=values)))[1]
    assert not all(fact.figures["exchanged"] for fact in facts if fact.kind == "exchanged-names")
    assert "wheels-against-ranges" not in {fact.kind for fact in facts}


@pytest.mark.parametrize("seed", range(3))
def test_ranges_that_are_any_numbers_make_no_clock(seed):
    log = late_by(0.0, seed)
    values = np.random.default_rng(seed).uniform(0.5, 15.0, len(log.ranges.stamps))
    moved, facts = explained_by_ranges(replace(log, ranges=replace(log.ranges, ranges=values)))
    np.testing.assert_array_equal(moved.ranges.stamps, log.ranges.stamps)
    assert "late-ranges" not in {fact.kind for fact in facts}


@pytest.mark.parametrize(
    ("seed", "what", "begin", "end", "change"),
    [
        (0, "mirrored", 60.0, 120.0, lambda steps: steps * np.array([1.0, -1.0, -1.0])),
        (1, "turned", 60.0, 60.1, lambda steps: steps - np.array([0.0, 0.0, 1.5])),
        (0, "turns", 60.0, 120.0, lambda steps: steps * np.array([1.0, 1.0, 0.0])),
    ],
)
def test_what_is_wrong_with_the_wheels_is_named(seed, what, begin, end, change):
    facts = explained_by_ranges(redriven(late_by(0.0, seed), begin, end, change))[1]
    assert {fact.kind for fact in facts} == {"wheels-against-ranges"}
    named = {what, "elsewhere"} if what == "turned" else {what}
    assert named & {fact.figures["what"] for fact in facts}
    if what == "turned":
        assert facts[0].figures["at"] == pytest.approx(60.0, abs=10.0)


def test_an_anchor_that_is_moved_is_no_fault_of_the_wheels():
    rng = np.random.default_rng(1)
    stamps, truth = planted.wander(rng, 60.0)
    wheels = planted.odometry(stamps, truth, rng, noise=0.01, turn_noise=0.01)
    moved = CORNERS + np.array([[0.0], [0.0], [3.0], [0.0]])
    one, other = (planted.ranges(np.random.default_rng(1), stamps, truth, at, rate=1.0) for at in (CORNERS, moved))
    radio = replace(one, ranges=np.where(one.stamps > 60.0, other.ranges, one.ranges))
    assert kinds_of(SensorLog(wheels, radio, None)) == []


def test_the_likelihood_of_ranges_along_a_path_is_that_of_the_best_place():
    """Against a search over places: Cauchy errors of ranges from one place, the better path the likelier."""
    rng = np.random.default_rng(0)
    paths = rng.normal(size=(2, 30, 2)) * 3.0
    values = np.hypot(*(paths[0] - [7.0, -4.0]).T) + 0.05 * rng.standard_normal(30)
    likely = _best_place(paths, np.stack([values, values]), np.ones((2, 30)))[1]
    around = np.stack(np.meshgrid(np.linspace(6.0, 8.0, 81), np.linspace(-5.0, -3.0, 81)), axis=-1).reshape(-1, 1, 2)
    errors = np.hypot(*np.moveaxis(paths[0] - around, -1, 0)) - values
    best = -np.log(np.pi * 0.2 * (1.0 + (errors / 0.2) ** 2)).sum(axis=1)
    assert likely[0] + 1.5 * np.log(30) == pytest.approx(best.max(), abs=0.1)
    assert likely[1] < likely[0] - 10.0


def test_a_short_reading_among_long_ones_is_an_error_like_any_other():
    """One of 2 m to an anchor 21 m away; squares of ranges alone would give it a hundred times the weight of the others."""
    rng = np.random.default_rng(0)
    path = np.column_stack([np.linspace(0.0, 5.0, 13), 2.0 * np.sin(np.linspace(0.0, 2.0, 13))])
    values = np.hypot(*(path - [16.0, 14.0]).T) + 0.05 * rng.standard_normal(13)
    sound, one = (_best_place(path[None], of[None], np.ones((1, 13)))[1, 0] for of in (values, np.append(values[:-1], 2.0)))
    # What a Cauchy error of 19 m costs more than one of a scale.
    assert sound - one < np.log((1.0 + (19.5 / 0.2) ** 2) / 1.0)


def test_the_density_of_changes_by_way_is_a_density():
    """Over all values of the second range it integrates to 1, by the prior of the first."""
    stretches = Stretches.of(_traces(late_by(0.0)), np.zeros(1), np.full(1, 5.0)).rows(slice(0, 1))
    values, step = np.linspace(-100.0, 110.0, 10501, retstep=True)
    two = replace(stretches, counted=np.ones((1, 2)), way=stretches.way[:, :2])
    each = [replace(two, ranges=np.array([[5.0, v]])).driven(10.0)[0, 0] for v in values]
    assert np.exp(each).sum() * step * 10.0 == pytest.approx(1.0, abs=0.01)


def test_what_fills_up_a_stretch_counts_for_nothing():
    """Of each stretch the readings alone: the same whichever stretches are beside it."""
    traces = _traces(late_by(0.0))
    begins = np.arange(0.0, 50.0, 2.5)
    ends = begins + np.linspace(4.0, 9.0, len(begins))
    together = Stretches.of(traces, begins, ends)
    assert (together.counted.min(axis=1) == 0.0).any()
    for row in range(len(together.trace)):
        own, number = traces[together.trace[row]], together.number[row : row + 1]
        there = (own.way > begins[number]) & (own.way <= ends[number])
        alone = Stretches.of([own], begins[number], ends[number])
        assert there.sum() == together.counts[row] == alone.counts[0]
        assert set(together.stamps[row][together.counted[row] > 0.0]) == set(own.stamps[there])
        for of in (lambda s: s.likely, lambda s: s.driven(20.0)):
            np.testing.assert_allclose(of(together)[row], of(alone)[0], rtol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
def test_the_best_order_of_anchors_is_that_of_all(count):
    rng = np.random.default_rng(count)
    every = [list(order) for order in permutations(range(count))]
    for pairs in [*10.0 * rng.normal(size=(20, count, count)), *rng.integers(0, 3, (20, count, count)).astype(float)]:
        best = _best_order(pairs)
        assert sorted(best.tolist()) == list(range(count))
        assert pairs[range(count), best].sum() == pytest.approx(max(pairs[range(count), order].sum() for order in every))


def test_an_explanation_without_a_stretch_of_its_own_meets_every_other_one():
    whole = Explanation(1.0, "late-ranges", {})
    for begin, end in ((0.0, 0.5), (0.5, 2.0), (90.0, np.inf)):
        other = Explanation(1.0, "clock-jump", {}, begin, end)
        assert whole.meets(other)
        assert other.meets(whole)
    first, second = (Explanation(1.0, "clock-jump", {}, *span) for span in ((0.0, 2.0), (2.0, 3.0)))
    assert not first.meets(second)
    assert not second.meets(first)
