"""When a place is certain: what each kind of measurement says for it, and what agreement of searches does."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.localization import hypotheses
from uwblite.localization.verdict import CERTAIN, FEW_ENDS, RangeFit, imprecise, map_odds, needed, nowhere, undecided, vague

MANY, FEW, ONE_ANCHOR = RangeFit(12, 1.0, 4, 6.0, -2.0), RangeFit(3, 1.0, 2, 1.5, 0.0), RangeFit(3, 1.0, 1, 1.5, -0.2)
ENDS, RAYS = 3.0 * FEW_ENDS, 30.0


def a_bank(rival=-20.0):
    bank = hypotheses.started(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), np.tile(0.001 * np.eye(3), (2, 1, 1)), np.zeros(0))
    return hypotheses.reweighted(bank, np.array([0.0, rival]))


def is_certain(odds, fitting, bank=None, proven=False):
    certain = needed(fitting, proven)
    bank = a_bank() if bank is None else bank
    assert not imprecise(bank.pose_covariances[0])
    return not undecided(bank, 0, True, certain) and not nowhere(odds, fitting) and odds.total >= certain


def test_scans_and_ranges_that_fit_are_certain_at_once():
    odds = map_odds(-0.1, ENDS, RAYS, MANY, 0.0)
    assert odds.total > CERTAIN
    assert is_certain(odds, MANY)


@pytest.mark.parametrize(("ends", "fitting"), [(0.0, MANY), (ENDS, ONE_ANCHOR)])
def test_what_one_kind_alone_says_needs_two_metres_of_the_same_place(ends, fitting):
    for agreed, certain in ((0.0, False), (1.9, False), (2.1, True)):
        odds = map_odds(-0.1, ends, RAYS, replace(fitting, likelihood=-0.2), agreed)
        assert is_certain(odds, fitting) is certain


def test_what_fits_as_well_in_another_building_is_nowhere_until_the_searches_agree_for_long():
    few = RangeFit(12, 0.7, 3, 6.0, -6.0)
    for agreed in (0.0, 1.0):
        assert "scans" in nowhere(map_odds(-0.6, ENDS, RAYS, few, agreed), few)
        assert "ranges" in nowhere(map_odds(-0.3, ENDS, RAYS, replace(few, likelihood=-20.0), agreed), few)
    odds = map_odds(-0.45, ENDS, RAYS, few, 3.0)
    assert nowhere(odds, few) == ""
    assert is_certain(odds, few)


def test_neither_scans_nor_agreement_outweigh_ranges_that_contradict():
    # An aisle that looks like the robot's own, which is not in the map.
    half = RangeFit(16, 0.4, 2, 8.0, -35.0)
    assert "ranges" in nowhere(map_odds(-0.07, ENDS, 75.0, half, 6.0), half)


def test_ranges_alone_of_which_one_in_four_disagrees_are_of_another_building():
    odd = RangeFit(20, 0.75, 3, 10.0, -6.0)
    assert "ranges" in nowhere(map_odds(0.0, 0.0, 0.0, odd, 5.0), odd)


def test_scans_alone_must_fit_better_than_beside_ranges():
    assert map_odds(-0.3, ENDS, RAYS, ONE_ANCHOR, 0.0).scans < 0.0 < map_odds(-0.3, ENDS, RAYS, FEW, 0.0).scans


def test_a_rival_a_hundred_times_less_likely_is_none_in_a_map_in_which_the_robot_was_tracked():
    for fitting, proven, certain in ((MANY, True, True), (MANY, False, False), (ONE_ANCHOR, True, False)):
        odds = map_odds(-0.1, ENDS, RAYS, fitting, 3.0)
        assert is_certain(odds, fitting, a_bank(-5.0), proven) is certain


def test_a_search_that_left_places_out_decides_nothing_and_a_pose_that_is_not_sure_is_the_only_one_all_the_same():
    assert "too many" in undecided(a_bank(), 0, False, CERTAIN)
    wide = hypotheses.started(np.zeros((1, 3)), np.diag([0.1, 0.001, 0.001])[None], np.zeros(0))
    assert undecided(wide, 0, True, CERTAIN) == ""
    assert "not sure" in imprecise(wide.pose_covariances[0])


def test_a_pose_is_known_while_its_longest_axis_is_short_in_any_frame():
    for turn in np.linspace(0.0, np.pi, 7):
        c, t = np.cos(turn), np.sin(turn)
        axes = np.array([[c, -t, 0.0], [t, c, 0.0], [0.0, 0.0, 1.0]])
        assert vague(axes @ np.diag([0.39**2, 0.01, 0.2**2]) @ axes.T) == ""
        assert "0.5 m" in vague(axes @ np.diag([0.48**2, 0.01, 0.2**2]) @ axes.T)
