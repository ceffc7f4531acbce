"""When ranges take a pose away: several anchors at once, never one alone."""

import numpy as np

from uwblite.localization.running_fit import full_agreement

AGREES, CONTRADICTS = (0.95, 4.0), (0.0, -3.7)
"""Weight and log-likelihood ratio of a range that is as expected, and of one that is metres off."""


def after(*ranges):
    """Return the fit after ranges (anchor, what) at 1, 2, 3 ... s, each anchor having agreed before."""
    fit = full_agreement(4)
    fit.restart(False)
    for anchor in range(4):
        fit.add_range(anchor, *AGREES, 0.0)
    for k, (anchor, what) in enumerate(ranges):
        fit.add_range(anchor, *what, k + 1.0)
    return fit


def test_two_anchors_at_once_contradict_the_pose_and_one_does_not():
    assert after((0, CONTRADICTS), (1, CONTRADICTS)).ranges_contradict()
    assert not after((0, CONTRADICTS)).ranges_contradict()
    # Again and again: its ranges err alike.
    assert not after(*[(0, CONTRADICTS)] * 5).ranges_contradict()


def test_the_first_ranges_that_contradict_begin_a_search_and_take_no_pose_away():
    fit = after((0, CONTRADICTS))
    assert fit.in_doubt()
    assert not fit.jumped()
    assert not after((0, AGREES)).in_doubt()


def test_a_moved_anchor_among_others_takes_no_pose_away():
    rounds = [(k % 4, CONTRADICTS if k % 4 == 0 else AGREES) for k in range(100)]
    for count in range(1, 100):
        assert not after(*rounds[:count]).ranges_contradict()
    np.testing.assert_array_equal(after(*rounds).moved_anchors(), [0])


def test_walls_that_fit_outweigh_ranges_that_jump():
    fit = after((0, CONTRADICTS), (1, CONTRADICTS))
    for k in range(20):
        fit.add_scan(0.3, 3.0 + 0.1 * k)
    assert fit.jumped()
    assert not fit.ranges_contradict()


def test_what_agrees_by_chance_after_a_jump_does_not_hide_its_beginning():
    fit = after((0, AGREES), (1, CONTRADICTS), (2, CONTRADICTS))
    fit.add_scan(0.25, 3.5)
    assert 1.0 <= fit.agreed() < 2.0


def test_ranges_that_never_agreed_do_not_jump():
    fit = full_agreement(4)
    fit.restart(False)
    for k in range(12):
        fit.add_range(k % 4, *CONTRADICTS, float(k))
        fit.add_range(k % 4, 0.3, 1.0, float(k))
    fit.add_range(0, 0.3, 20.0, 20.0)
    fit.add_range(0, *CONTRADICTS, 21.0)
    fit.add_range(1, *CONTRADICTS, 22.0)
    assert not fit.jumped()


def test_a_pose_that_is_lost_is_not_lost_again_by_the_same_ranges():
    fit = after(*[(k % 4, CONTRADICTS) for k in range(8)])
    assert fit.jumped()
    fit.forget_anchors()
    for k in range(40):
        fit.add_range(k % 4, *CONTRADICTS, 10.0 + k)
        assert not fit.jumped()


def test_a_range_that_agrees_by_chance_does_not_hide_since_when_in_doubt():
    fit = after((0, AGREES))
    fit.add_scan(0.25, 2.0)
    assert not fit.in_doubt()
    for k in range(20):
        fit.add_scan(-0.15, 2.1 + 0.1 * k)
    fit.add_range(1, *AGREES, 4.0)
    assert fit.in_doubt()
    assert not fit.scans_contradict()
    assert (fit.matched, fit.sound) == (2.0, 4.0)


def test_a_pose_that_is_found_anew_has_the_agreement_of_all_anchors():
    """What was held against them at another pose does not count; walls support it where it was found by them."""
    fit = after(*[(k % 4, CONTRADICTS) for k in range(8)])
    assert fit.jumped()
    for sees in (True, False):
        fit.restart(sees)
        assert not fit.jumped()
        assert not fit.ranges_contradict()
        assert len(fit.moved_anchors()) == 0
        assert (fit.scans > 0.0) is sees
    for anchor in range(2):
        fit.add_range(anchor, *CONTRADICTS, 20.0 + anchor)
        assert fit.jumped() == (anchor == 1)
