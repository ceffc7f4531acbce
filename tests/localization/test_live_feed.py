"""Silence of sensors: late after the limit or three of their own periods, each by itself and all together."""

import numpy as np
import pytest
from helpers.localization_room import known

from uwblite.localization.live_feed import LiveFeed, Silence


def heard(silence, name, stamps):
    for t in stamps:
        silence.hear(name, t)
    return silence


@pytest.mark.parametrize(("period", "limit"), [(0.1, 2.0), (2.0, 6.0)])
def test_a_sensor_is_late_after_the_limit_or_three_of_its_periods(period, limit):
    silence = heard(Silence(2.0), "lidar", [period * k for k in range(200)])
    last = silence.now
    for ahead in (0.9 * limit, 1.2 * limit):
        silence.hear("odometry", last + ahead)
        assert ("lidar" in silence.silent()) == (ahead > limit)
        assert silence.silent().get("lidar", ahead) == pytest.approx(ahead)


def test_a_radio_of_rounds_is_not_late_between_them():
    silence = Silence(2.0)
    for k in range(40):
        for early in (0.0, 0.03, 0.06):
            silence.hear("odometry", 2.0 * k + early - 0.01)
            assert not silence.silent()
            silence.hear("uwb", 2.0 * k + early)


def test_an_expected_sensor_that_never_sent_is_late_and_an_optional_one_is_not():
    silence = heard(Silence(2.0, ("odometry", "uwb")), "odometry", [0.1 * k for k in range(100)])
    assert set(silence.silent()) == {"uwb"}


def test_a_silence_is_noticed_again_soon_after():
    silence = heard(Silence(2.0), "lidar", [0.1 * k for k in range(100)])
    heard(silence, "lidar", [60.0 + 0.1 * k for k in range(60)])
    silence.hear("odometry", silence.now + 2.5)
    assert "lidar" in silence.silent()


def test_without_any_data_all_are_late_and_the_silence_counts_on():
    silence = Silence(2.0)
    assert silence.all_late(2.1)
    assert not silence.all_late(1.9)
    heard(silence, "odometry", [0.05 * k for k in range(200)])
    heard(silence, "uwb", [8.0])
    assert silence.all_late(2.1)
    assert not silence.all_late(1.9)
    assert silence.silent(9.0)["uwb"] == pytest.approx(9.0 + silence.now - 8.0)


def test_a_stamp_that_goes_back_sets_no_time_back():
    silence = heard(Silence(2.0), "lidar", [100.0, 100.1, 3.0])
    assert silence.now == 100.1
    assert not silence.silent()


def test_a_feed_without_data_says_so_once_ages_the_pose_and_goes_on():
    notes = []
    feed = LiveFeed(known(), lambda mounting: mounting, notes.append)
    odometry = "".join(f"ODOM 0 0 0 0 0 0 {10 + 0.1 * k:.3f} h {0.1 * k:.3f}\n" for k in range(50)).encode()
    assert all(not state.age for state in feed.take(odometry))
    assert list(feed.wait(1.5)) == []
    late, lost = *feed.wait(3.0), *feed.wait(11.0)
    assert late.age == 3.0
    assert "no data" not in late.reason
    assert lost.lost
    assert lost.reason == "no data for 11 s"
    assert len([n for n in notes if "no data" in n]) == 1
    assert not list(feed.take(b"ODOM 0 0 0 0 0 0 30.0 h 20.0\n"))[-1].age
    assert "data come again" in notes


def test_a_feed_without_odometry_says_after_its_patience_that_there_is_no_pose():
    notes = []
    feed = LiveFeed(known(), lambda mounting: mounting, notes.append)
    ranges = "".join(f"UWB A1 3.0 0 {10 + 0.1 * k:.3f} h {10 + 0.1 * k:.3f}\n" for k in range(100)).encode()
    states = list(feed.take(ranges))
    told = [state for state in states if np.isfinite(state.stamp)]
    assert all(state.lost for state in states)
    assert [state.stamp for state in told] == pytest.approx([10 + 0.1 * k for k in range(61, 100)])
    assert {state.reason for state in told} == {"no odometry has come in: without it there is no pose"}
    assert notes.count("warning: nothing from odometry for 6 s; without it there is no pose") == 1
    assert np.isfinite(list(feed.take(b"ODOM 0 0 0 0 0 0 20.0 h 20.0\n"))[-1].stamp)
