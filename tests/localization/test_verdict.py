"""How far a robot drives between two searches that agree, by what each kind of measurement says."""

import numpy as np
import pytest

from uwblite.localization import hypotheses
from uwblite.localization.verdict import ENOUGH_ENDS, RangeFit, confirming_way, doubt, nowhere

CLEAR = RangeFit(8, 1.0, 4)
TWO_ANCHORS, ONE_ANCHOR = RangeFit(3, 1.0, 2), RangeFit(3, 1.0, 1)


def test_scans_and_ranges_that_are_clear_confirm_each_other():
    assert confirming_way(-0.1, ENOUGH_ENDS, CLEAR, proven=False) == 0.0


def test_what_is_known_by_one_kind_alone_takes_longest_and_people_half_of_it():
    alone = confirming_way(-0.1, 0.0, CLEAR, proven=False)
    assert alone == confirming_way(-0.1, ENOUGH_ENDS, ONE_ANCHOR, proven=False)
    assert confirming_way(-0.4, ENOUGH_ENDS, CLEAR, proven=False) == 0.5 * alone


def test_ranges_of_which_one_in_four_disagrees_confirm_no_scans():
    # Beside scans of another building three anchors of four, or half of the ranges, agree by chance.
    odd = RangeFit(20, 0.75, 3)
    assert confirming_way(-0.1, ENOUGH_ENDS, odd, proven=False) == confirming_way(-0.1, ENOUGH_ENDS, ONE_ANCHOR, proven=False)
    assert nowhere(-0.1, ENOUGH_ENDS, odd) == ""
    assert "ranges" in nowhere(-0.1, ENOUGH_ENDS, RangeFit(29, 0.52, 3))


def test_in_a_map_in_which_the_robot_was_tracked_half_of_the_ranges_beside_scans_may_have_detours():
    half, fewer = RangeFit(10, 0.5, 4), RangeFit(10, 0.4, 4)
    assert "ranges" in nowhere(-0.1, 0.0, half, proven=True)
    for ends in (0.5 * ENOUGH_ENDS, ENOUGH_ENDS):
        assert nowhere(-0.1, ends, half, proven=True) == ""
        assert "ranges" in nowhere(-0.1, ends, half)
        assert "ranges" in nowhere(-0.1, ends, fewer, proven=True)
    assert "ranges" in nowhere(-0.1, ENOUGH_ENDS, RangeFit(10, 0.5, 1), proven=True)


def test_people_beside_a_few_ranges_contradict_no_place_in_a_map_that_is_the_right_one():
    assert "scans" in nowhere(-0.4, ENOUGH_ENDS, TWO_ANCHORS)
    assert nowhere(-0.4, ENOUGH_ENDS, TWO_ANCHORS, proven=True) == ""
    assert "scans" in nowhere(-0.4, ENOUGH_ENDS, ONE_ANCHOR, proven=True)
    assert "scans" in nowhere(-0.6, ENOUGH_ENDS, TWO_ANCHORS, proven=True)


@pytest.mark.parametrize("fit", [-0.1, -0.4])
@pytest.mark.parametrize("ends", [0.0, ENOUGH_ENDS])
def test_in_a_map_in_which_the_robot_was_tracked_ranges_to_two_anchors_need_no_second_search(fit, ends):
    assert confirming_way(fit, ends, TWO_ANCHORS, proven=True) < 0.0


def test_ranges_to_one_anchor_confirm_nothing_in_any_map():
    for fit, ends in ((-0.1, 0.0), (-0.1, ENOUGH_ENDS), (-0.4, ENOUGH_ENDS)):
        assert confirming_way(fit, ends, ONE_ANCHOR, proven=True) == confirming_way(fit, ends, ONE_ANCHOR, proven=False)


def test_a_rival_a_hundred_times_less_likely_is_none_in_a_map_in_which_the_robot_was_tracked():
    bank = hypotheses.started(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), np.tile(0.01 * np.eye(3), (2, 1, 1)), np.zeros(0))
    bank = hypotheses.reweighted(bank, np.array([0.0, -5.0]))
    for fitting, proven, certain in ((CLEAR, True, True), (CLEAR, False, False), (ONE_ANCHOR, True, False)):
        assert (doubt(bank, 0, True, -0.1, ENOUGH_ENDS, fitting, proven) == "") is certain
