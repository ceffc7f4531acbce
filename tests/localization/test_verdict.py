"""When a place is certain: what each kind of measurement says for it, and what agreement of searches does."""

import numpy as np
import pytest

from uwblite.localization import hypotheses
from uwblite.localization.range_model import Ranges
from uwblite.localization.verdict import CERTAIN, FEW_ENDS, Odds, imprecise, map_odds, undecided, vague


def a_bank(rival=-20.0):
    bank = hypotheses.started(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), np.tile(0.001 * np.eye(3), (2, 1, 1)), np.zeros(0))
    return hypotheses.reweighted(bank, np.array([0.0, rival]))


def odds(scans=10.0, ranges=5.0, share=1.0, alone=False, agreed=0.0, tracked=False):
    return Odds(scans, ranges, share, alone, agreed, tracked)


def is_certain(found):
    return not found.nowhere and found.total >= CERTAIN


def test_scans_and_ranges_that_fit_are_certain_at_once():
    assert is_certain(odds())


@pytest.mark.parametrize("found", [{"scans": 0.0}, {"ranges": 0.0}])
def test_what_one_kind_alone_says_needs_two_metres_of_the_same_place(found):
    for agreed, certain in ((0.0, False), (1.9, False), (2.1, True)):
        assert is_certain(odds(**found, alone=True, agreed=agreed)) is certain


def test_what_fits_as_well_in_another_building_is_nowhere_until_the_searches_agree_for_long():
    for agreed in (0.0, 1.0):
        assert "scans" in odds(scans=-5.0, ranges=0.5, agreed=agreed).nowhere
        assert "ranges" in odds(scans=0.5, ranges=-12.0, agreed=agreed).nowhere
    assert is_certain(odds(scans=-3.0, ranges=1.0, agreed=3.0))


def test_a_robot_that_was_tracked_in_this_map_is_likely_to_be_in_it_still():
    assert not is_certain(odds(scans=2.0, ranges=2.0))
    assert is_certain(odds(scans=2.0, ranges=2.0, tracked=True))
    # Carried to another building all the same: what contradicts is not outweighed.
    assert "scans" in odds(scans=-7.0, ranges=2.0, tracked=True).nowhere


def test_neither_scans_nor_agreement_outweigh_ranges_that_contradict():
    # An aisle that looks like the robot's own, which is not in the map.
    assert "ranges" in odds(scans=20.0, ranges=-24.0, share=0.4, agreed=6.0).nowhere


def test_what_one_kind_alone_says_is_not_outweighed_by_agreement():
    # In another building ranges to its anchors fit about as well as elsewhere, at the same place for metres.
    assert not is_certain(odds(scans=0.0, ranges=0.5, alone=True, agreed=5.0))
    assert "ranges" in odds(scans=0.0, ranges=-0.5, alone=True, agreed=5.0).nowhere


def test_odds_are_of_the_ranges_that_agree_and_of_scans_with_enough_ends():
    places, tags = np.array([[4.0, 0.0], [0.0, 3.0]]), np.zeros((2, 2))
    ranges = Ranges(np.arange(2), places, tags, np.array([4.0, 3.0]), *np.tile([[0.1], [0.0], [0.07], [1.5]], 2))
    both = map_odds(3.0, FEW_ENDS, np.zeros(3), ranges, 1.0, False)
    assert (both.scans, both.share, both.alone, both.agreed) == (3.0, 1.0, False, 1.0)
    assert both.ranges > 2.0
    assert map_odds(3.0, FEW_ENDS - 1, np.zeros(3), ranges, 1.0, False).scans == 0.0
    wrong = map_odds(3.0, FEW_ENDS, np.array([3.0, 0.0, 0.0]), ranges, 1.0, False)
    assert wrong.alone
    assert wrong.ranges < -3.0


def test_a_rival_that_may_be_right_leaves_the_place_open():
    for rival, one in ((-20.0, True), (-5.0, False)):
        assert (undecided(a_bank(rival), True) == "") is one


def test_many_places_that_are_each_unlikely_are_together_as_likely_as_one():
    """The odds of the best place are against all others together."""
    for many, one in ((2, True), (40, False)):
        poses = np.zeros((1 + many, 3))
        poses[1:, 0] = 3.0 * np.arange(1, 1 + many)
        bank = hypotheses.started(poses, np.tile(0.001 * np.eye(3), (1 + many, 1, 1)), np.zeros(0))
        weights = np.append(0.0, np.full(many, -CERTAIN - 2.0))
        assert (undecided(hypotheses.reweighted(bank, weights), True) == "") is one


def test_a_search_that_left_places_out_decides_nothing_and_a_pose_that_is_not_sure_is_the_only_one_all_the_same():
    assert "too many" in undecided(a_bank(), False)
    wide = hypotheses.started(np.zeros((1, 3)), np.diag([0.1, 0.001, 0.001])[None], np.zeros(0))
    assert undecided(wide, True) == ""
    assert "not sure" in imprecise(wide.pose_covariances[0])


def test_a_pose_is_known_while_its_longest_axis_is_short_in_any_frame():
    for turn in np.linspace(0.0, np.pi, 7):
        c, t = np.cos(turn), np.sin(turn)
        axes = np.array([[c, -t, 0.0], [t, c, 0.0], [0.0, 0.0, 1.0]])
        assert vague(axes @ np.diag([0.39**2, 0.01, 0.2**2]) @ axes.T) == ""
        assert "0.5 m" in vague(axes @ np.diag([0.48**2, 0.01, 0.2**2]) @ axes.T)


def test_ranges_outweigh_scans_of_moved_furniture_and_staying_does_not():
    """Half of a hall's furniture was moved: scans -10, ranges of four anchors +11 after six metres."""
    assert is_certain(odds(scans=-10.3, ranges=11.4, agreed=9.4))
    for agreed in (0.0, 9.4, 100.0):
        assert "scans" in odds(scans=-10.3, ranges=8.6, agreed=agreed).nowhere
        assert "ranges" in odds(scans=20.0, ranges=-6.1, agreed=agreed).nowhere
