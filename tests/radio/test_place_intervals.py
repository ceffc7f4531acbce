"""Places and intervals of one radio: planted moves are found with their times, and what looks like a move is none."""

import numpy as np
import pytest

from uwblite.arrays import best_run
from uwblite.radio.place_evidence import PlaceModel, Track, intervals_of
from uwblite.radio.place_intervals import _times, explain
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.radio.trilateration import TrilaterationConfig

STAMPS = np.arange(0.0, 200.0, 1.0)
PATH = np.column_stack([5.0 + 4.0 * np.cos(0.11 * STAMPS), 4.0 + 3.0 * np.sin(0.17 * STAMPS)])
SIGMA = 0.06
HERE = np.array([-2.0, 1.0])
ANY_HEIGHT = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def measured(seed, before, after=None, moment=100, share=0.1):
    """Return ranges with noise, a bias and a share of them too long, to one place and from a moment on to another."""
    rng = np.random.default_rng(seed)
    place = np.where((np.arange(len(STAMPS)) < moment)[:, None], before, before if after is None else after)
    blocked = rng.random(len(STAMPS)) < share
    return np.hypot(*(place - PATH).T) + 0.2 + rng.normal(0.0, SIGMA, len(STAMPS)) + blocked * rng.exponential(0.8, len(STAMPS))


def explained(path, ranges, recording=None, heights=(0.0,)):
    recording = np.zeros(len(ranges), dtype=np.int64) if recording is None else recording
    return explain(PlaceModel(Track(path, ranges, recording, SIGMA, heights), TrilaterationConfig(), RangeNoiseConfig()))


def changes(found):
    return np.flatnonzero(np.diff(found.place)) + 1


@pytest.mark.parametrize(("seed", "moment"), [(1, 100), (2, 140), (3, 60)])
def test_a_move_is_found_with_its_places_and_its_moment(seed, moment):
    after = np.array([-0.5, 3.5])
    found = explained(PATH, measured(seed, HERE, after, moment))
    np.testing.assert_allclose(found.places, [HERE, after], atol=0.3)
    assert np.all(np.abs(changes(found) - moment) <= 5)


@pytest.mark.parametrize(("seed", "share"), [(0, 0.0), (1, 0.2), (2, 0.5), (3, 0.5)])
def test_an_anchor_that_stands_still_was_not_moved_however_often_its_line_of_sight_is_blocked(seed, share):
    assert len(explained(PATH, measured(seed, HERE, share=share)).places) == 1


def test_a_high_anchor_that_is_passed_nearby_and_then_seen_from_afar_was_not_moved():
    """Nobody gave its height: level distances would place it elsewhere in each part of the drive."""
    rng, height, k = np.random.default_rng(0), 3.0, np.arange(50)
    near = np.column_stack([np.linspace(-4.0, 4.0, 50), 1.0 + 0.5 * np.sin(0.4 * k)])
    far = np.column_stack([12.0 + 3.0 * np.cos(0.14 * k), 9.0 + 3.0 * np.sin(0.22 * k)])
    path = np.vstack([near, far])
    ranges = np.hypot(np.hypot(*path.T), height) + 0.1 + rng.normal(0.0, SIGMA, len(path))
    assert len(explained(path, ranges, heights=ANY_HEIGHT).places) == 1
    moved = np.hypot(np.hypot(*(path - [6.0, -5.0]).T), height) + 0.1 + rng.normal(0.0, SIGMA, len(path))
    found = explained(path, np.where(np.arange(100) < 50, ranges, moved), heights=ANY_HEIGHT)
    assert len(found.places) == 2
    assert np.all(np.abs(changes(found) - 50) <= 5)


def test_a_few_ranges_show_no_move():
    few = slice(0, 17)
    assert len(explained(PATH[few], measured(1, HERE, np.array([4.0, 9.0]), moment=9)[few]).places) == 1


@pytest.mark.parametrize("moment", [24, 176])
def test_a_dozen_of_a_hundred_ranges_show_that_an_anchor_was_moved_by_metres(moment):
    half = slice(None, None, 2)
    found = explained(PATH[half], measured(6, HERE, np.array([3.0, 4.0]), moment, share=0.0)[half])
    assert len(found.places) == 2
    assert np.all(np.abs(2 * changes(found) - moment) <= 4)


def test_two_moves_are_found_in_the_order_of_time():
    places = [HERE, np.array([11.0, 6.0]), np.array([4.0, -5.0])]
    ranges = measured(5, places[0], places[1], 60)
    ranges[110:] = measured(5, places[2])[110:]
    found = explained(PATH, ranges)
    np.testing.assert_allclose(found.places, places, atol=0.5)
    assert [int(found.place[k]) for k in (50, 70, 100, 120)] == [0, 1, 1, 2]


def carried(seconds):
    """Return ranges to an anchor that is on its way so long from t = 70 s on, and its two places."""
    before, after = np.array([1.0, -1.0]), np.array([9.0, 8.0])
    place = before + np.clip((STAMPS[:, None] - 70.0) / seconds, 0.0, 1.0) * (after - before)
    return np.hypot(*(place - PATH).T) + 0.2 + np.random.default_rng(2).normal(0.0, SIGMA, len(STAMPS)), before, after


def test_ranges_made_while_an_anchor_is_carried_belong_to_neither_place():
    ranges, before, after = carried(50.0)
    found = explained(PATH, ranges)
    np.testing.assert_allclose(found.places, [before, after], atol=0.3)
    way = np.flatnonzero(found.place < 0)
    # At the ends of the way it is still near both places.
    assert 70 <= way[0] <= 80 < 110 <= way[-1] <= 120


@pytest.mark.parametrize(("bias", "count"), [(0.0, 2), (-0.8, 1)])
def test_a_short_move_that_a_constant_error_takes_back_is_none(bias, count):
    """A radio's constant error does not change as it is moved; that of ranges past furniture does, and place with it."""
    ranges = measured(1, HERE, np.array([-2.9, 1.9]), share=0.0) + bias * (STAMPS >= 100.0)
    assert len(explained(PATH, ranges).places) == count


@pytest.mark.parametrize("late", [0.5, 1.5])
def test_a_line_of_sight_that_is_blocked_from_some_time_on_is_no_move(late):
    rng = np.random.default_rng(3)
    ranges = measured(1, HERE, share=0.0)
    ranges[120:] += late + rng.exponential(0.3, 80)
    assert len(explained(PATH, ranges).places) == 1


@pytest.mark.parametrize(("back", "count"), [(188, 3), (199, 2)])
def test_an_anchor_that_is_brought_back_needs_few_ranges_to_show_it(back, count):
    """The place is known from before: a dozen ranges show it, one does not."""
    before, after = np.array([1.0, -1.0]), np.array([9.0, 8.0])
    ranges = measured(4, before, after, 90, share=0.0)
    ranges[back:] = measured(4, before, share=0.0)[back:]
    found = explained(PATH, ranges)
    assert len(found.places) == 2
    assert len(intervals_of(found.place)) == count


@pytest.mark.parametrize("seed", range(2))
def test_a_rack_passed_on_the_way_towards_an_anchor_does_not_move_it(seed):
    """From afar on a straight line, 0.4 m more explains the ranges as well as a place 4 m aside does; then the robot turns."""
    path = np.concatenate([np.column_stack([0.15 * STAMPS, 0.0 * STAMPS]), PATH + np.array([36.0, 0.0])])
    late, rng = 0.4 * (np.arange(400) < 200), np.random.default_rng(seed)
    ranges = np.hypot(*(np.array([55.0, -0.6]) - path).T) + late + rng.normal(0.0, SIGMA, len(path))
    assert len(explained(path, ranges).places) == 1


@pytest.mark.parametrize(("by", "count"), [(0.0, 1), (3.0, 2)])
def test_between_recordings_the_boundary_is_the_moment_and_each_has_a_constant_error(by, count):
    """Another robot's tag makes the second recording's ranges longer by 0.4 m."""
    recording = np.repeat([0, 1], 100)
    ranges = measured(7, HERE, HERE + np.array([0.0, by])) + 0.4 * recording
    found = explained(PATH, ranges, recording)
    assert len(found.places) == count
    if count == 2:
        np.testing.assert_array_equal(found.place, recording)


def test_intervals_and_runs():
    assert [rows.tolist() for rows in intervals_of(np.array([0, 0, -1, 1, 0]))] == [[0, 1], [3], [4]]
    rng = np.random.default_rng(0)
    for _ in range(20):
        gain = rng.normal(size=12)
        sums = {(i, j): gain[i:j].sum() for i in range(13) for j in range(i, 13)}
        start, end = best_run(gain)
        assert gain[start:end].sum() == pytest.approx(max(sums.values()))


def test_the_times_are_those_at_which_both_places_and_the_way_between_explain_most():
    """Every pair of times tried; a way that takes time costs the logarithm of the number of times."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        one, other, carried = rng.normal(size=(3, 30))
        sums = {
            (i, j): one[:i].sum() + carried[i:j].sum() + other[j:].sum() - (np.log(30) if j > i else 0.0)
            for i in range(4, 27) for j in range(i, 27)
        }  # fmt: skip
        best = max(sums, key=sums.get)
        likely, times = _times(one, other, carried, 4)
        assert times == best
        assert likely == pytest.approx(sums[best])
