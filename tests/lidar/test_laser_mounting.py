"""Turns by laser and wheels: which way up the laser is, how the clocks differ, what the track width is wrong by."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import box, drive, odometry, recording, scans, wander

from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.lidar.laser_mounting import LAGS, TurningPolicy, _ratio, _turning_pairs, compare
from uwblite.mapping import MappingConfig, build_map
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting

ROOM = np.concatenate([box(14, 11), box(3, 1) + np.array([2, 1, 2, 1]), box(1, 2) - np.array([4, 2, 4, 2])])
TURNS = [(0.0, 0.0, 0.6), (0.4, 0.0, 0.0), (0.0, 0.0, -0.5), (0.3, 0.0, 0.0), (0.0, 0.0, 0.4)] * 2
UP, DOWN = SensorMounting(), SensorMounting(laser_flipped=True)


def turner(mounting=UP, lag=0.0, turn_scale=1.0, seed=0):
    """A recording of a robot that turns on the spot now and then; its log does not contain how the laser hangs."""
    rng = np.random.default_rng(seed)
    stamps, truth = drive(TURNS, [4.0] * len(TURNS))
    seen = scans(stamps, truth, ROOM, rate=10.0, noise=0.01, rng=rng, mounting=mounting)
    seen = replace(seen, stamps=seen.stamps + lag)
    return recording(odometry(stamps, truth, rng, noise=0.005, turn_noise=0.01, turn_scale=turn_scale), None, seen), truth


@pytest.mark.parametrize("seed", range(3))
def test_the_way_up_shows_in_the_turns(seed):
    for mounting, over in ((UP, False), (DOWN, True)):
        seen = compare(turner(mounting, seed=seed)[0])
        assert seen.agree
        assert seen.turned_over is over


def test_a_way_up_given_rightly_is_not_contradicted():
    log, _ = turner(DOWN)
    assert not compare(replace(log, mounting=DOWN)).turned_over
    assert compare(replace(turner(UP)[0], mounting=DOWN)).turned_over


@pytest.mark.parametrize("lag", [0.3, -0.2])
def test_the_delay_is_found(lag):
    """Turns are measured to about a beam's tenth; with 0.5 rad/s that is 0.01 s, and offsets are tried every 0.02 s."""
    seen = compare(turner(lag=lag)[0])
    assert seen.delay == pytest.approx(-lag, abs=0.041)
    assert seen.delay_clear


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_the_wheels_turn_scale_is_found(scale):
    seen = compare(turner(turn_scale=scale)[0])
    assert 1.0 / seen.ratio == pytest.approx(scale, rel=0.05)
    assert seen.agree


@pytest.mark.parametrize("mounting", [UP, DOWN])
def test_scans_that_see_nothing_decide_nothing(mounting):
    """In a large bare hall most scans see no wall: any turn fits two of them."""
    log, _ = turner(mounting)
    ranges = log.scans.ranges.copy()
    ranges[np.arange(len(ranges)) % 20 < 13] = np.inf
    seen = compare(replace(log, scans=replace(log.scans, ranges=ranges)))
    assert seen.agree
    assert seen.turned_over is (mounting is DOWN)


@pytest.mark.parametrize(("seconds", "shown"), [(1.0, False), (3.9, True)])
def test_a_few_scans_that_see_something_decide_nothing(seconds, shown):
    """In a yard only scans beside the one post match at all, and a single pair fits a laser either way up."""
    log, _ = turner()
    begin = log.scans.stamps[0]
    ranges = np.where((log.scans.stamps < begin + seconds)[:, None], log.scans.ranges, np.inf)
    assert (compare(replace(log, scans=replace(log.scans, ranges=ranges))) is not None) == shown


def test_a_robot_that_never_turns_reports_nothing():
    stamps, truth = drive([(0.5, 0.0, 0.0)], [20.0])
    log = recording(odometry(stamps, truth), None, scans(stamps, truth, box(40, 6)))
    assert compare(log) is None
    assert compare(replace(log, scans=replace(log.scans, stamps=log.scans.stamps[:5], ranges=log.scans.ranges[:5]))) is None


def test_a_robot_that_turns_only_while_driving_still_reports_it():
    rng = np.random.default_rng(1)
    stamps, truth = drive([(0.6, 0.0, 0.35)] * 3, [10.0] * 3)
    seen = scans(stamps, truth, ROOM, rate=10.0, noise=0.01, rng=rng, mounting=DOWN)
    found = compare(recording(odometry(stamps, truth), None, seen))
    assert found.pairs >= TurningPolicy.least_pairs
    assert found.turned_over


@pytest.mark.slow
def test_a_laser_upside_down_is_mapped_and_reported():
    rng = np.random.default_rng(2)
    stamps, truth = wander(rng, 12.0)
    seen = scans(stamps, truth, ROOM, rate=5.0, noise=0.01, rng=rng, mounting=DOWN)
    log = recording(odometry(stamps, truth, rng, noise=0.005, turn_noise=0.005), None, seen)
    result = build_map(log)
    assert [d for d in result.doubts if d.kind == "laser-turned-over"]
    assert evaluate_trajectory(stamps, result.trajectory, stamps, truth).ate.rmse < 0.03
    reported = build_map(replace(log, mounting=DOWN))
    assert not [d for d in reported.doubts if d.kind == "laser-turned-over"]
    np.testing.assert_array_equal(reported.trajectory, result.trajectory)
    counted = build_map(log, MappingConfig(detect_laser_flip=False))
    assert not [d for d in counted.doubts if d.kind == "laser-turned-over"]


def differences(monkeypatch, given, other):
    """Let laser and wheels differ by these (lags, pairs), the laser mounted as given and the other way up."""
    turns = np.full(given.shape[1], 0.3)
    monkeypatch.setattr("uwblite.lidar.laser_mounting._differences", lambda *args: (turns, given if args[-1] > 0.0 else other))


@pytest.mark.parametrize(("centre", "best", "scatter", "clear"), [
    (0.10, 0.069, 0.0, True), (0.10, 0.071, 0.0, False), (0.10, 0.06, 0.081, False), (0.10, 0.06, 0.079, True),
])  # fmt: skip
def test_a_delay_is_clear_by_its_gain_and_by_the_gain_s_own_scatter(monkeypatch, centre, best, scatter, clear):
    """Below 0.7 of the difference without it, and by more than two standard deviations of the mean gain of all pairs."""
    log, _ = turner()
    pairs = 16
    errors = np.full((len(LAGS), pairs), 0.29)
    errors[len(LAGS) // 2] = centre
    errors[30] = best + scatter * np.where(np.arange(pairs) % 2 == 0, 1.0, -1.0)
    differences(monkeypatch, errors, np.full_like(errors, 0.3))
    monkeypatch.setattr("uwblite.lidar.laser_mounting._ratio", lambda laser, wheels: 1.0)
    seen = compare(log)
    assert seen.delay == LAGS[30]
    assert (seen.as_given, seen.other, seen.misfit) == pytest.approx((best, 0.3, best))
    assert seen.delay_clear is clear


@pytest.mark.parametrize(("upside_down", "over"), [(0.11, False), (0.09, True)])
def test_the_other_way_up_must_agree_twice_as_well_at_its_best_delay_as_the_given_one_at_its_own(
    monkeypatch, upside_down, over
):
    errors = np.full((len(LAGS), 16), 0.29)
    errors[30] = 0.2
    other = np.full_like(errors, 0.29)
    other[10] = upside_down
    differences(monkeypatch, errors, other)
    monkeypatch.setattr("uwblite.lidar.laser_mounting._ratio", lambda laser, wheels: 1.0)
    seen = compare(turner()[0])
    assert (seen.turned_over, seen.delay) == (over, LAGS[10 if over else 30])
    assert seen.misfit == pytest.approx(upside_down if over else 0.2)


def test_the_ratio_of_turns_is_a_median_of_clear_ones():
    """Turns of more than 0.1 rad."""
    rng = np.random.default_rng(3)
    wheels = rng.uniform(0.11, 0.5, 4000) * rng.choice([-1.0, 1.0], 4000)
    small = np.full(500, 0.1)
    laser = wheels * (1.2 + 0.1 * rng.standard_normal(4000))
    # The standard deviation of a median of Gaussian ratios is 1.2533 times that of their mean.
    sigma = 1.2533 * 0.1 / np.sqrt(4000)
    assert _ratio(np.append(laser, 9.0 * small), np.append(wheels, small)) == pytest.approx(1.2, abs=4 * sigma)
    few = wheels[: TurningPolicy.least_pairs - 1]
    assert np.isnan(_ratio(few, few))
    assert _ratio(wheels[:TurningPolicy.least_pairs], wheels[:TurningPolicy.least_pairs]) == 1.0


@pytest.mark.parametrize(("speed", "compared"), [(0.09, False), (0.11, True), (0.58, True), (0.62, False)])
def test_turns_are_compared_between_too_small_to_see_and_too_large_to_overlap(speed, compared):
    """Half a second of turning on the spot: more than 0.05 rad, and less than 0.4 of a view of 0.75 rad."""
    stamps, truth = drive([(0.0, 0.0, speed)], [20.0])
    lidar = LaserScans(np.arange(0.0, 19.0, 0.1), np.ones((190, 30), dtype=np.float32), -0.375, 0.025, 0.0, 0.1, 5.0)
    first, second = _turning_pairs(recording(odometry(stamps, truth), None, lidar), lidar, 50)
    np.testing.assert_array_equal(second - first, 5)
    assert (len(first) > 0) is compared
    assert len(first) <= 2 * 50


@pytest.mark.parametrize(("speed", "compared"), [(1.9, True), (2.1, False)])
def test_scans_a_metre_and_more_apart_show_too_little_of_the_same(speed, compared):
    """Half a second of an arc, where the robot never turns on the spot."""
    stamps, truth = drive([(speed, 0.0, 0.4)], [20.0])
    lidar = LaserScans(np.arange(0.0, 19.0, 0.1), np.ones((190, 100), dtype=np.float32), -1.0, 0.02, 0.0, 0.1, 5.0)
    first, _ = _turning_pairs(recording(odometry(stamps, truth), None, lidar), lidar, 50)
    assert (len(first) > 0) is compared


@pytest.mark.parametrize(("gap", "across"), [(1.9, True), (2.6, False)])
def test_scans_before_and_after_a_gap_of_seconds_are_no_pair(gap, across):
    """A pair is five scans of a tenth of a second apart, or, over the gap, as much longer."""
    stamps, truth = drive([(0.0, 0.0, 0.2)], [20.0])
    seen = np.concatenate([np.arange(0.0, 9.0, 0.1), np.arange(9.0 - 0.5 + gap, 19.0, 0.1)])
    lidar = LaserScans(seen, np.ones((len(seen), 100), dtype=np.float32), -1.0, 0.02, 0.0, 0.1, 5.0)
    first, second = _turning_pairs(recording(odometry(stamps, truth), None, lidar), lidar, 1000)
    assert np.any(seen[second] - seen[first] > 1.0) == across


def test_pairs_of_turns_on_the_spot_come_first_and_where_there_are_few_those_that_drive_least():
    """On the spot for 5 s, then in an arc, whose 0.5 m in half a second are more than 0.15 m + 0.3 times the turn."""
    stamps, truth = drive([(0.0, 0.0, 0.4), (1.0, 0.0, 0.4)], [5.0, 5.0])
    for begin, spot in ((0.0, True), (4.9, False)):
        lidar = LaserScans(np.arange(begin, 9.9, 0.1), np.ones((len(np.arange(begin, 9.9, 0.1)), 100), dtype=np.float32),
                           -1.0, 0.02, 0.0, 0.1, 5.0)  # fmt: skip
        first, second = _turning_pairs(recording(odometry(stamps, truth), None, lidar), lidar, 1000)
        assert len(first) >= (40 if spot else 1)
        if spot:
            assert lidar.stamps[second].max() < 5.3
        else:
            assert len(first) <= 2 * TurningPolicy.least_pairs


@pytest.mark.parametrize(("period", "pairs"), [(1.9, True), (2.0, False)])
def test_scans_two_seconds_apart_are_no_pair(period, pairs):
    stamps = np.arange(0.0, 200.0, 0.1)
    odometry = Odometry(stamps, np.column_stack([0.0 * stamps, 0.0 * stamps, 0.1 * stamps]))
    at = period * np.arange(90)
    scans = LaserScans(at, np.ones((90, 360), dtype=np.float32), -3.0, 0.0167, 0.0, 0.1, 9.0)
    first, second = _turning_pairs(SensorLog(odometry, None, scans), scans, 1000)
    assert first.tolist() == (list(range(89)) if pairs else [])
    assert second.tolist() == [k + 1 for k in first.tolist()]
