"""An anchor that is moved during a recording is distinguished from one that is not, and the moment is found."""

from itertools import pairwise

import numpy as np
import pytest

from uwblite.radio.change_points import (
    _CARRIED,
    ON_GIVEN_PATH,
    ON_OWN_PATH,
    _misfit,
    _returned,
    _splits,
    find_move,
    find_moves,
)
from uwblite.radio.trilateration import AnchorHypothesis, TrilaterationConfig

STAMPS = np.arange(0.0, 200.0, 1.0)
PATH = np.column_stack([5.0 + 4.0 * np.cos(0.11 * STAMPS), 4.0 + 3.0 * np.sin(0.17 * STAMPS)])
SIGMA = 0.06


def measured(seed, before, after=None, moment=100, share=0.1):
    """Return ranges with noise, a bias and a share of them too long, to one place and from a moment on to another."""
    rng = np.random.default_rng(seed)
    place = np.where((np.arange(len(STAMPS)) < moment)[:, None], before, before if after is None else after)
    blocked = rng.random(len(STAMPS)) < share
    return np.hypot(*(place - PATH).T) + 0.2 + rng.normal(0.0, SIGMA, len(STAMPS)) + blocked * rng.exponential(0.8, len(STAMPS))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("moment", [60, 100, 140])
def test_a_move_is_found_with_its_places_and_its_moment(seed, moment):
    before, after = np.array([-2.0, 1.0]), np.array([-0.5, 3.5])
    move = find_move(PATH, measured(seed, before, after, moment), STAMPS, SIGMA, TrilaterationConfig())
    assert move is not None
    assert abs(move.stamp - moment) <= 5.0
    assert np.hypot(*(move.before - before)) < 0.5
    assert np.hypot(*(move.after - after)) < 0.5


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_an_anchor_that_stands_still_was_not_moved_however_often_its_line_of_sight_is_blocked(seed, share):
    assert find_move(PATH, measured(seed, np.array([-2.0, 1.0]), share=share), STAMPS, SIGMA, TrilaterationConfig()) is None


def test_a_high_anchor_that_is_passed_nearby_and_then_seen_from_afar_was_not_moved():
    """Nobody gave its height: level distances would place it elsewhere in each part of the drive."""
    rng, height, k = np.random.default_rng(0), 3.0, np.arange(50)
    near = np.column_stack([np.linspace(-4.0, 4.0, 50), 1.0 + 0.5 * np.sin(0.4 * k)])
    far = np.column_stack([12.0 + 3.0 * np.cos(0.14 * k), 9.0 + 3.0 * np.sin(0.22 * k)])
    path, stamps = np.vstack([near, far]), STAMPS[:100]
    ranges = np.hypot(np.hypot(*path.T), height) + 0.1 + rng.normal(0.0, SIGMA, len(path))
    assert find_moves(path, ranges, stamps, SIGMA, TrilaterationConfig()) == []
    moved = np.hypot(np.hypot(*(path - [6.0, -5.0]).T), height) + 0.1 + rng.normal(0.0, SIGMA, len(path))
    (move,) = find_moves(path, np.where(stamps < 50.0, ranges, moved), stamps, SIGMA, TrilaterationConfig())
    assert abs(move.stamp - 50.0) <= 5.0


def test_a_few_ranges_show_no_move():
    few = slice(0, 17)
    ranges = measured(1, np.array([-2.0, 1.0]), np.array([4.0, 9.0]), moment=9)[few]
    assert find_move(PATH[few], ranges, STAMPS[few], SIGMA, TrilaterationConfig()) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_late_ranges_tell_less_of_a_move_than_early_ones(sign):
    """Ten ranges in a row are off by 0.6 m, as those of a place elsewhere: behind an obstacle they are late, never early."""
    ranges = measured(1, np.array([-2.0, 1.0]), share=0.0)
    ranges[150:160] += 0.6 * sign
    misfit = _misfit(PATH, ranges, AnchorHypothesis(np.array([-2.0, 1.0]), 0.2, SIGMA, 0.0, 0.1), 4.0 * SIGMA)
    assert misfit[150:160].mean() == pytest.approx(0.52 if sign > 0.0 else 1.0, abs=0.02)
    assert misfit[:150].max() < 0.9


@pytest.mark.parametrize("moment", [24, 176])
def test_a_dozen_of_a_hundred_ranges_show_that_an_anchor_was_moved_by_metres(moment):
    half = slice(None, None, 2)
    ranges = measured(6, np.array([-2.0, 1.0]), np.array([3.0, 4.0]), moment, share=0.0)[half]
    move = find_move(PATH[half], ranges, STAMPS[half], SIGMA, TrilaterationConfig())
    assert move is not None
    assert abs(move.stamp - moment) <= 4.0


@pytest.mark.parametrize("moment", [21, 179])
def test_a_move_near_an_end_is_found_from_any_first_moment(moment):
    before, after = np.array([-2.0, 1.0]), np.array([11.0, 6.0])
    move = find_move(PATH, measured(3, before, after, moment, share=0.0), STAMPS, SIGMA, TrilaterationConfig())
    # Fewer unexplained ranges than the least share show no move; where one is found, its moment is right.
    assert move is None or abs(move.stamp - moment) <= 2.0


def test_two_moves_are_found_in_the_order_of_time():
    places = [np.array([-2.0, 1.0]), np.array([11.0, 6.0]), np.array([4.0, -5.0])]
    ranges = measured(5, places[0], places[1], 60)
    ranges[110:] = measured(5, places[2])[110:]
    moves = find_moves(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig())
    np.testing.assert_allclose([m.stamp for m in moves], [60.0, 110.0], atol=4.0)
    for move, (before, after) in zip(moves, pairwise(places), strict=True):
        np.testing.assert_allclose([move.before, move.after], [before, after], atol=0.5)


def carried(seconds):
    """Return ranges to an anchor that is on its way so long from t = 70 s on, and its two places."""
    before, after = np.array([1.0, -1.0]), np.array([9.0, 8.0])
    place = before + np.clip((STAMPS[:, None] - 70.0) / seconds, 0.0, 1.0) * (after - before)
    return np.hypot(*(place - PATH).T) + 0.2 + np.random.default_rng(2).normal(0.0, SIGMA, len(STAMPS)), before, after


def test_ranges_made_while_an_anchor_is_carried_belong_to_neither_place():
    ranges, before, after = carried(50.0)
    move = find_move(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig())
    assert move is not None
    # At the ends of the way it is still near both places.
    assert 70.0 <= move.left <= 80.0 < 110.0 <= move.stamp <= 120.0
    np.testing.assert_allclose([move.before, move.after], [before, after], atol=0.3)


def test_two_places_that_leave_out_most_of_the_ranges_between_are_no_move():
    """Any two places explain some ranges of an anchor that stands where neither is."""
    assert find_move(PATH, carried(100.0)[0], STAMPS, SIGMA, TrilaterationConfig()) is None


@pytest.mark.parametrize(("bias", "found"), [(0.6, True), (1.4, False)])
def test_a_place_whose_ranges_are_all_off_by_more_than_any_radio_is_none(bias, found):
    ranges = measured(1, np.array([-2.0, 1.0]), np.array([4.0, 9.0]), share=0.0) + bias * (STAMPS >= 100.0)
    assert (find_move(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig()) is not None) == found


@pytest.mark.parametrize(("bias", "found"), [(0.0, True), (-0.8, False)])
def test_a_short_move_that_a_constant_error_takes_back_is_none(bias, found):
    """A radio's constant error does not change as it is moved; that of ranges past furniture does, and place with it."""
    before, after = np.array([-2.0, 1.0]), np.array([-2.9, 1.9])
    ranges = measured(1, before, after, share=0.0) + bias * (STAMPS >= 100.0)
    assert (find_move(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig()) is not None) == found


def test_a_move_that_another_follows_at_once_was_not_undone_in_between():
    move = find_move(PATH, carried(50.0)[0], STAMPS, SIGMA, TrilaterationConfig())
    none = np.zeros(0)
    assert _returned(np.zeros((0, 2)), none, none, move, 0.24) is None


@pytest.mark.parametrize(("back", "number"), [(188, 2), (196, 1)])
def test_an_anchor_that_is_brought_back_needs_few_ranges_to_show_it(back, number):
    """The place is known from before: a dozen ranges show it, four do not."""
    before, after = np.array([1.0, -1.0]), np.array([9.0, 8.0])
    ranges = measured(4, before, after, 90, share=0.0)
    ranges[back:] = measured(4, before, share=0.0)[back:]
    moves = find_moves(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig())
    assert len(moves) == number
    if number == 2:
        assert abs(moves[1].stamp - back) <= 2.0
        np.testing.assert_array_equal([moves[1].before, moves[1].after], [moves[0].after, moves[0].before])


@pytest.mark.parametrize("seed", range(4))
def test_a_rack_passed_on_the_way_towards_an_anchor_does_not_move_it(seed):
    """From afar on a straight line, 0.4 m more explains the ranges as well as a place 4 m aside does; then the robot turns."""
    path = np.concatenate([np.column_stack([0.15 * STAMPS, 0.0 * STAMPS]), PATH + np.array([36.0, 0.0])])
    stamps, rng = np.concatenate([STAMPS, STAMPS + 200.0]), np.random.default_rng(seed)
    ranges = np.hypot(*(np.array([55.0, -0.6]) - path).T) + 0.4 * (stamps < 200.0) + rng.normal(0.0, SIGMA, len(stamps))
    assert find_move(path, ranges, stamps, SIGMA, TrilaterationConfig()) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_a_short_move_cannot_be_distinguished_from_a_blocked_line_of_sight(seed):
    """Two places 0.65 m apart explain these ranges clearly better than one; the least move is 0.8 m."""
    place = np.array([-2.0, 1.0])
    ranges = measured(seed, place, place + np.array([0.0, 0.65]), share=0.0)
    assert find_move(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig()) is None


@pytest.mark.parametrize(("wild", "found"), [(0.4, True), (0.7, False)])
def test_two_places_must_explain_half_of_what_one_does_not(wild, found):
    """A share of the ranges from the second place lies metres off any."""
    rng = np.random.default_rng(2)
    ranges = measured(2, np.array([-2.0, 1.0]), np.array([4.0, 9.0]), share=0.0)
    ranges += (rng.random(len(STAMPS)) < wild) * rng.uniform(3.0, 30.0, len(STAMPS))
    move = find_move(PATH, ranges, STAMPS, SIGMA, TrilaterationConfig())
    assert (move is not None) == found


def test_the_moments_are_those_at_which_both_places_explain_most():
    """Every pair of moments tried; what an anchor that is carried between them costs, whatever place it fits."""
    ranges = measured(3, np.array([-2.0, 1.0]), np.array([1.0, 4.0]), 90)
    ranges[80:95] += 3.0
    width = 0.24
    split = _splits(PATH, ranges, [(70, 110)], width, TrilaterationConfig(), 8)[70, 110]

    before, after = (_misfit(PATH, ranges, place, width) for place in (split.before, split.after))
    costs = {
        (start, end): before[:start].sum() + _CARRIED * (end - start) + after[end:].sum()
        for start in range(8, 193) for end in range(start, 193)
    }  # fmt: skip
    left, moment = min(costs, key=costs.get)
    assert (split.left, split.moment) == (left, moment)
    assert 78 <= left < moment <= 97
    assert split.cost == pytest.approx(costs[left, moment])
    between = np.minimum(before, after)[left:moment].sum()
    assert split.unexplained == pytest.approx(before[:left].sum() + between + after[moment:].sum())


@pytest.mark.parametrize(("count", "needed", "found"), [
    (17, ON_GIVEN_PATH, False), (18, ON_GIVEN_PATH, True), (41, ON_OWN_PATH, False), (42, ON_OWN_PATH, True),
])  # fmt: skip
def test_few_ranges_show_a_move(count, needed, found):
    """Half from either place: more than eight on each side, or the moment may as well lie beyond those tried; twenty where the
    path is not given."""
    few = np.linspace(0, 199, count).astype(int)
    ranges = measured(1, np.array([-2.0, 1.0]), np.array([4.0, 9.0]), int(few[count // 2]), share=0.0)[few]
    assert (find_move(PATH[few], ranges, STAMPS[few], SIGMA, TrilaterationConfig(), needed) is not None) == found
