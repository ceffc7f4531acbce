"""Readings that repeat themselves: each rule against a loop over readings, at its limits."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.told import told

from uwblite.assessment.facts import spans
from uwblite.screening.repeats import (
    _mark,
    _when,
    without_lidar_marks,
    without_marks,
    without_own_body,
    without_repeated_ranges,
    without_repeated_scans,
)
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, UwbRanges


def driving(speed=1.0, seconds=100.0):
    stamps = np.arange(0.0, seconds + 0.05, 0.1)
    return Odometry(stamps, np.column_stack([speed * stamps, np.zeros((len(stamps), 2))]))


def ranges(stamps, values, anchor=None, ids=("A", "B")):
    n = len(stamps)
    anchor = np.zeros(n, dtype=int) if anchor is None else anchor
    return UwbRanges(np.asarray(stamps, float), anchor, np.asarray(values, float), np.full(n, 100.0), ids)


def scans(readings, stamps=None, nearest=0.05, farthest=30.0):
    readings = np.asarray(readings, dtype=np.float32)
    stamps = np.arange(float(len(readings))) if stamps is None else np.asarray(stamps, float)
    return LaserScans(stamps, readings, 0.0, 0.01, 0.0, nearest, farthest)


@pytest.mark.parametrize(("repeats", "seen", "left_out"), [(2, 10, 2), (1, 10, 0), (2, 9, 0), (5, 40, 5)])
def test_a_scan_that_stands_three_times_was_not_measured_again(repeats, seen, left_out):
    rng = np.random.default_rng(1)
    readings = np.full((20, 40), np.inf)
    readings[:, :seen] = rng.uniform(1.0, 2.0, (20, seen))
    readings[5 : 6 + repeats] = readings[5]
    log = SensorLog(driving(), None, scans(readings))
    done, facts = without_repeated_scans(log)
    remarks = told(facts)
    np.testing.assert_array_equal(done.scans.stamps, np.delete(np.arange(20.0), np.arange(6, 6 + left_out)))
    assert [r.text.split(" (t =")[0] for r in remarks] == [f"{left_out} of 20 scans equal the scan before"] * bool(left_out)
    assert all(f"t = 6 to {5 + left_out} s" in r.text for r in remarks)


@pytest.mark.parametrize(("count", "left_out"), [(10, 0), (12, 12), (50, 50)])
def test_scans_that_a_driver_sends_again_and_again_are_left_out(count, left_out):
    """Of a hundred scans some repeat the one before, never two in a row: a tenth may be chance."""
    readings = np.random.default_rng(3).uniform(1.0, 2.0, (100, 40))
    again = 1 + 2 * np.arange(count)
    readings[again] = readings[again - 1]
    done, facts = without_repeated_scans(SensorLog(driving(), None, scans(readings)))
    remarks = told(facts)
    np.testing.assert_array_equal(done.scans.stamps, np.delete(np.arange(100.0), again[:left_out]))
    assert [r.text.partition(" scans")[0] for r in remarks] == [f"{left_out} of 100"] * bool(left_out)
    assert all("the driver sends scans again" in r.text for r in remarks)


def test_a_scan_written_twice_is_left_out_without_a_word():
    readings = np.random.default_rng(2).uniform(1.0, 2.0, (10, 40))
    log = SensorLog(driving(), None, scans(np.repeat(readings, 2, axis=0), np.repeat(np.arange(10.0), 2)))
    done, facts = without_repeated_scans(log)
    remarks = told(facts)
    np.testing.assert_array_equal(done.scans.stamps, np.arange(10.0))
    assert remarks == []
    for stamps in ([1.0], [1.0, 1.0], [1.0, 1.0, 2.0]):
        few, _ = without_repeated_scans(SensorLog(driving(), None, scans(np.ones((len(stamps), 40)), stamps)))
        np.testing.assert_array_equal(few.scans.stamps, np.unique(stamps))


@pytest.mark.parametrize(
    ("count", "speed", "value", "left_out"),
    [(13, 0.05, 4.2, True), (12, 0.05, 4.2, False), (13, 0.04, 4.2, False), (13, 0.05, 0.0, False), (30, 1.0, 4.2, True)],
)
def test_a_range_that_stands_while_the_robot_moves(count, speed, value, left_out):
    """Thirteen in a row, the first with twelve repeats, over more than half a metre: at a second each, 0.05 m/s make 0.55 m."""
    values = 5.0 + 0.01 * np.arange(60)
    values[10 : 10 + count] = value
    other = 3.0 + 0.01 * np.arange(60)
    stamps, anchor = np.repeat(np.arange(60.0), 2), np.tile([0, 1], 60)
    log = SensorLog(driving(speed), ranges(stamps, np.stack([values, other], axis=1).ravel(), anchor))
    done, facts = without_repeated_ranges(log)
    remarks = told(facts)
    wrong = (anchor == 0) & (stamps >= 10) & (stamps < 10 + count) & left_out
    np.testing.assert_array_equal(done.ranges.stamps, stamps[~wrong])
    np.testing.assert_array_equal(done.ranges.anchor, anchor[~wrong])
    said = f"anchor A repeats one range while the robot moves (t = 10 to {9 + count} s)"
    assert [r.text.split(";")[0] for r in remarks] == [said] * left_out


@pytest.mark.parametrize(
    ("noise", "rounded", "jitter", "found"),
    [(0.03, 0.001, 0.0, True), (0.03, 0.001, 0.01, True), (0.03, 0.01, 0.01, True), (0.03, 0.001, 0.03, False),
     (0.1, 0.001, 0.03, True), (0.005, 0.001, 0.01, False), (0.03, 0.1, 0.0, False), (0.03, 1.0, 0.0, False)],
)  # fmt: skip
def test_a_range_stands_when_it_scatters_far_less_than_the_radio(noise, rounded, jitter, found):
    """Two anchors that the robot drives about; the second one's ranges stand at 4 m from 40 to 80 s, but for a jitter."""
    rng = np.random.default_rng(3)
    stamps, anchor = np.repeat(np.arange(0.0, 100.0, 0.5), 2), np.tile([0, 1], 200)
    values = 6.0 + 4.0 * np.sin(0.1 * stamps + anchor) + rng.normal(0.0, noise, 400)
    stands = (anchor == 1) & (stamps >= 40.0) & (stamps < 80.0)
    values[stands] = 4.0 + rng.uniform(-jitter, jitter, stands.sum())
    log = SensorLog(driving(0.5), ranges(stamps, np.round(values / rounded) * rounded, anchor))
    done, facts = without_repeated_ranges(log)
    remarks = told(facts)
    assert len(remarks) == found
    assert abs(len(done.ranges.stamps) - (400 - found * stands.sum())) <= 2


@pytest.mark.parametrize("rounded", [0.001, 0.01, 0.1, 1.0])
def test_a_robot_on_a_circle_about_an_anchor_measures_rightly(rounded):
    """The range to the middle changes by its noise alone; of a robot that stands, those to both."""
    stamps, anchor = np.repeat(np.arange(0.0, 100.0, 0.2), 2), np.tile([0, 1], 500)
    noise = np.random.default_rng(4).normal(0.0, 0.03, 1000)
    values = np.where(anchor == 0, 3.0, np.hypot(3.0 * np.cos(0.2 * stamps) - 5.0, 3.0 * np.sin(0.2 * stamps))) + noise
    for speed in (0.6, 0.0):
        driven = values if speed else np.where(anchor == 0, 3.0, 5.0) + noise
        log = SensorLog(driving(speed), ranges(stamps, np.round(driven / rounded) * rounded, anchor))
        assert without_repeated_ranges(log) == (log, [])


def test_ranges_written_twice_count_once_and_where_all_are_stuck_none_is_left():
    log = SensorLog(driving(), ranges([1.0, 1.0, 1.0, 2.0, 2.0], [5.0, 5.0, 6.0, 6.0, 6.0]))
    done, facts = without_repeated_ranges(log)
    remarks = told(facts)
    np.testing.assert_array_equal(done.ranges.stamps, [1.0, 1.0, 2.0])
    np.testing.assert_array_equal(done.ranges.ranges, [5.0, 6.0, 6.0])
    assert remarks == []
    done, facts = without_repeated_ranges(SensorLog(driving(), ranges(np.arange(20.0), np.full(20, 4.2), ids=("A",))))
    remarks = told(facts)
    assert done.ranges is None
    assert len(remarks) == 1
    one = SensorLog(driving(), ranges([1.0], [5.0]))
    assert without_repeated_ranges(one) == (one, [])


@pytest.mark.parametrize(
    ("marks", "others", "usual", "found"),
    [(20, 20, 1, True), (19, 20, 1, False), (24, 776, 1, True), (24, 777, 1, False), (32, 20, 4, True), (31, 20, 4, False)],
)
def test_a_mark_is_twenty_readings_three_percent_and_eight_times_as_frequent_as_others(marks, others, usual, found):
    values = np.concatenate([np.full(marks, 6.5), np.repeat(1.0 + 0.001 * np.arange(others), usual)])
    assert _mark(values) == (6.5 if found else None)
    assert _mark(np.full(50, 6.5)) is None


def at_places(count, standing=False):
    """Return a recording of that many seconds at 1 m/s with a mark of two anchors at each second, among other ranges."""
    stamps = np.repeat(np.arange(float(count)), 4)
    anchor = np.tile([0, 1, 0, 1], count)
    values = 2.0 + 0.001 * np.arange(4.0 * count)
    values[2::4] = values[3::4] = 65.5
    return SensorLog(driving(0.0 if standing else 1.0), ranges(stamps, values, anchor)), values


def test_marks_that_are_most_of_the_ranges_are_a_doubt_without_a_lidar():
    """Half of the ranges are marks; then two thirds, as every other of the rest is lost."""
    log, values = at_places(30)
    fewer = replace(log, ranges=log.ranges.rows((values > 60.0) | (np.arange(len(values)) % 4 == 0)))
    seen = replace(fewer, scans=scans(np.ones((5, 8))))
    assert [told(without_marks(one)[1])[0].severity == "doubt" for one in (log, fewer, seen)] == [False, True, False]


def test_a_mark_counts_once_at_each_place_and_of_each_anchor():
    log, values = at_places(10)
    done, facts = without_marks(log)
    (remark,) = told(facts)
    np.testing.assert_array_equal(done.ranges.ranges, values[values < 60.0])
    assert remark.text.startswith("20 of 40 ranges are exactly 65.5 m")
    for other in (at_places(9)[0], at_places(40, standing=True)[0]):
        assert without_marks(other) == (other, [])
    # What one anchor alone repeats is stuck; no reading at all is another matter.
    one = replace(log, ranges=log.ranges.rows(log.ranges.anchor == 0))
    longer, _ = at_places(30)
    one = replace(longer, ranges=longer.ranges.rows(longer.ranges.anchor == 0))
    assert without_marks(one) == (one, [])
    zeros = replace(log, ranges=replace(log.ranges, ranges=np.where(values > 60.0, 0.0, values)))
    assert without_marks(zeros) == (zeros, [])


def test_readings_of_the_lidar_that_are_marks():
    """Twenty places, at each of them a tenth of the beams; inside the limits that the lidar states."""
    rng = np.random.default_rng(4)
    for places, found in ((20, True), (19, False)):
        readings = rng.uniform(1.0, 9.0, (places, 50)).astype(np.float32)
        readings[:, ::10] = 5.5
        log = SensorLog(driving(), None, scans(readings))
        done, facts = without_lidar_marks(log)
        remarks = told(facts)
        assert len(remarks) == found
        if found:
            assert remarks[0].text.startswith(f"{places * 5} of {places * 50} readings of the lidar are exactly 5.5 m")
            assert "a code, or a part of the robot" in remarks[0].text
            assert np.isnan(done.scans.ranges[:, ::10]).all()
            assert done.scans.range_max == 30.0
            np.testing.assert_array_equal(np.delete(done.scans.ranges, np.s_[::10], 1), np.delete(readings, np.s_[::10], 1))
            farthest = replace(log, scans=replace(log.scans, ranges=np.where(readings == 5.5, np.float32(9.5), readings)))
            done, facts = without_lidar_marks(farthest)
            remarks = told(facts)
            assert "reports its reach where it sees nothing" in remarks[0].text
            assert np.isposinf(done.scans.ranges[:, ::10]).all()
            assert done.scans.range_max == 9.5
            for limits in ({"range_max": 9.4}, {"range_min": 9.6, "range_max": 30.0}):
                beyond = replace(farthest, scans=replace(farthest.scans, **limits))
                assert without_lidar_marks(beyond) == (beyond, [])
    standing = SensorLog(driving(0.0), None, scans(np.tile(readings, (5, 1))))
    assert without_lidar_marks(standing) == (standing, [])


def test_when_is_said_of_three_stretches():
    flags = np.zeros(100, dtype=bool)
    for first in (10, 30, 50):
        flags[first : first + 5] = True
    stamps = 2.0 * np.arange(100.0)
    assert spans(_when(stamps, flags, 4.0)) == "t = 16 to 24 s, t = 56 to 64 s, t = 96 to 104 s"
    flags[[70, 80]] = True
    assert spans(_when(stamps, flags, 4.0)).endswith("104 s, and 2 more stretches")


BEAMS = 72


def rounds(turns=1.0, metres=10.0, seconds=100.0):
    """A robot that drives in a circle."""
    stamps = np.arange(0.0, seconds + 0.05, 0.1)
    heading = np.linspace(0.0, 2.0 * np.pi * turns, len(stamps))
    radius = metres / max(2.0 * np.pi * turns, 1e-9)
    return Odometry(stamps, np.column_stack([radius * np.sin(heading), radius * (1.0 - np.cos(heading)), heading]))


def seen(odometry, readings):
    stamps = odometry.stamps[:: len(odometry.stamps) // len(readings)][: len(readings)]
    scans = LaserScans(stamps, np.asarray(readings, dtype=np.float32), -np.pi, 2.0 * np.pi / BEAMS, 0.0, 0.05, 8.0)
    return SensorLog(odometry, None, scans)


def walls(rng, count=200):
    return rng.uniform(0.3, 6.0, (count, BEAMS))


@pytest.mark.parametrize(("distance", "noise", "found"), [(0.25, 0.01, True), (0.25, 0.08, False), (1.2, 0.01, False)])
def test_a_post_of_the_robot_is_left_out(distance, noise, found):
    rng = np.random.default_rng(0)
    readings = walls(rng)
    readings[:, 10:14] = distance + noise * rng.standard_normal((200, 4))
    readings[::25, 12] = np.inf  # a lost echo now and then
    log = seen(rounds(), readings)
    done, facts = without_own_body(log)
    remarks = told(facts)
    assert len(remarks) == found
    if not found:
        assert done is log
        return
    assert remarks[0].text.startswith("4 of 72 beams of the lidar (at -130 to -115 degrees)")
    assert remarks[0].severity == "warning"
    assert np.isnan(done.scans.ranges[:, 10:14]).all()
    np.testing.assert_array_equal(np.delete(done.scans.ranges, np.s_[10:14], 1), np.delete(log.scans.ranges, np.s_[10:14], 1))


@pytest.mark.parametrize(("odometry"), [rounds(turns=0.3), rounds(metres=2.0)])
def test_a_robot_that_hardly_turns_or_drives_shows_nothing(odometry):
    readings = walls(np.random.default_rng(1))
    readings[:, 10:14] = 0.25
    log = seen(odometry, readings)
    assert without_own_body(log) == (log, [])


def test_a_wall_beside_a_corridor_stays():
    """Up and down a corridor, the wall at 0.6 m to the right but for the turns at its ends."""
    stamps = np.arange(0.0, 200.0, 0.1)
    turning = (stamps % 50.0) > 44.0
    heading = np.concatenate([[0.0], np.cumsum(np.where(turning, np.pi / 60.0, 0.0))[1:]])
    xy = np.cumsum(np.where(turning, 0.0, 0.05)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    odometry = Odometry(stamps, np.column_stack([xy, heading]))
    rng = np.random.default_rng(2)
    readings = walls(rng, len(stamps))
    readings[~turning, 17:20] = 0.6 + 0.01 * rng.standard_normal((int((~turning).sum()), 3))
    log = seen(odometry, readings)
    assert without_own_body(log) == (log, [])
    empty = replace(log, scans=replace(log.scans, stamps=np.zeros(0), ranges=np.zeros((0, BEAMS), dtype=np.float32)))
    assert without_own_body(empty) == (empty, [])
    assert without_own_body(log.without(lidar=True))[1] == []
