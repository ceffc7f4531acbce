"""One recording as arrays: what is checked when it enters, and parts of it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import box, odometry, ranges, recording, scans, wander

from uwblite.errors import DataError
from uwblite.sensor_log import (
    LaserScans,
    Odometry,
    OdometryBreaks,
    Screening,
    SensorLog,
    SensorMounting,
    UwbRanges,
    fault_of_id,
    one_word,
    plausible,
)


@pytest.fixture(scope="module")
def log() -> SensorLog:
    rng = np.random.default_rng(0)
    stamps, truth = wander(rng, 10.0, half_width=2.0)
    radio = ranges(rng, stamps, truth, np.array([[4.0, 0.0], [-4.0, 1.0], [0.0, 5.0]]), in_reach=[[0, 99], [0, 8], [12, 99]])
    return recording(odometry(stamps, truth), radio, scans(stamps, truth, box(8, 8), beams=30))


def test_a_part_holds_what_lies_within_its_ends(log):
    part = log.crop(9.0, 11.0)
    for stamps in (part.odometry.stamps, part.ranges.stamps, part.scans.stamps):
        assert stamps[0] >= 9.0
        assert stamps[-1] <= 11.0
    inside = (log.ranges.stamps >= 9.0) & (log.ranges.stamps <= 11.0)
    np.testing.assert_array_equal(part.ranges.ranges, log.ranges.ranges[inside])
    stated = [part.ranges.anchor_ids[k] for k in part.ranges.anchor]
    assert stated == [log.ranges.anchor_ids[k] for k in log.ranges.anchor[inside]]
    assert part.ranges.anchor_ids == ("A00",)
    assert len(log.crop().odometry.stamps) == len(log.odometry.stamps)


def test_lengths_of_the_odometry_are_multiplied_with_all_that_is_said_of_them(log):
    """Headings stay, and so does what other sensors measured."""
    breaks = OdometryBreaks(log.odometry.stamps[[3, 9]], np.array([[0.2, 0.3, 0.1], [1.0, 2.0, 0.5]]))
    screened = replace(log, screening=Screening((), breaks, lidar_by_wheels=1.2))
    for before in (log, screened):
        after = before.with_odometry_times(1.5)
        np.testing.assert_allclose(after.odometry.poses, before.odometry.poses * [1.5, 1.5, 1.0])
        assert after.ranges is before.ranges
        assert after.scans is before.scans
    np.testing.assert_allclose(after.screening.breaks.sigma, [[0.3, 0.45, 0.1], [1.5, 3.0, 0.5]])
    np.testing.assert_array_equal(after.screening.breaks.stamps, breaks.stamps)
    assert after.screening.lidar_by_wheels == pytest.approx(0.8)


def test_a_part_without_scans_or_ranges_is_a_recording_too(log):
    late = log.odometry.stamps[-1]
    part = log.crop(late - 0.01, late)
    assert len(part.odometry.stamps) == 1
    assert len(part.scans.stamps) == 0
    assert part.scans.ranges.shape == (0, 30)


def test_a_part_without_odometry_is_none(log):
    with pytest.raises(DataError, match="no odometry"):
        log.crop(1e6, 2e6)


def test_sensors_can_be_left_out(log):
    assert log.without(uwb=True).ranges is None
    assert log.without(uwb=True).scans is log.scans
    assert log.without(lidar=True).scans is None
    assert log.without().ranges is log.ranges


ONE = Odometry(np.zeros(1), np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SensorLog(Odometry(np.zeros(2), np.zeros((3, 3)))), "odometry.poses"),
        (lambda: SensorLog(Odometry(np.array([1.0, 0.0]), np.zeros((2, 3)))), "backwards at index 1"),
        (lambda: SensorLog(Odometry(np.zeros(2), np.array([[0.0, 0, 0], [np.nan, 0, 0]]))), r"poses\[1\] is not finite"),
        (lambda: SensorLog(ONE, UwbRanges([0], [1], [1], [1], ("A",))), "1 is no index of 1 anchor_ids"),
        (lambda: SensorLog(ONE, UwbRanges(np.zeros(2), np.zeros(1, int), np.ones(2), np.ones(2), ("A",))), "ranges.anchor"),
        (lambda: SensorLog(ONE, UwbRanges(np.zeros(1), np.zeros(1, int), np.ones(2), np.ones(1), ("A",))), "ranges.ranges"),
        (lambda: SensorLog(ONE, None, LaserScans(np.zeros(2), np.ones((1, 4), np.float32), 0, 1, 0, 0, 9)), "scans.ranges"),
    ],
)
def test_what_does_not_fit_is_named(make, words):
    with pytest.raises(DataError, match=words):
        make()


def test_heights_of_single_anchors_win():
    mounting = SensorMounting(tag_position=np.array([0, 0, 0.3]), anchor_height=2.0, anchor_heights={"A": 1.0})
    assert mounting.height_difference("A") == pytest.approx(0.7)
    assert mounting.height_difference("B") == pytest.approx(1.7)
    assert SensorMounting().height_difference("A") is None


@pytest.mark.parametrize("value", [1e8, -1e30, 1e308])
def test_numbers_that_nobody_measures_are_refused(value):
    stamps, poses = np.arange(3.0), np.zeros((3, 3))
    far = poses.copy()
    far[1, 0] = value
    with pytest.raises(DataError, match=r"odometry\.poses\[1\] is beyond 1e\+07"):
        SensorLog(Odometry(stamps, far))
    with pytest.raises(DataError, match=r"odometry\.stamps"):
        SensorLog(Odometry(np.array([0.0, 1.0, 1e300]), poses))


@pytest.mark.parametrize("mounting", [
    SensorMounting(T_base_laser=np.array([250.0, 0.0, 0.0])), SensorMounting(tag_position=np.array([0.0, 1e200, 0.4])),
    SensorMounting(T_base_laser=np.array([np.nan, 0.0, 0.0])),
])  # fmt: skip
def test_sensors_stand_on_the_robot(log, mounting):
    with pytest.raises(DataError, match="from the base, on which it is mounted"):
        replace(log, mounting=mounting)


def test_a_thousand_anchors_are_enough():
    names = tuple(f"A{k}" for k in range(1001))
    radio = UwbRanges(np.arange(3.0), np.zeros(3, dtype=np.intp), np.ones(3), np.full(3, 100.0), names)
    with pytest.raises(DataError, match="name 1001 anchors"):
        SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), radio)


@pytest.mark.parametrize("name", ["5C0B", "A@2", "-17", "anchor#2", '\u00c4nker,"1"', "x" * 64])
def test_ids_of_anchors_are_words(name):
    assert fault_of_id(name) == ""


@pytest.mark.parametrize(
    "name",
    ["", "x" * 65, "A B", "A\nODOM 1 2 3", "\x1b[31mred", "\u202eleft", "\ud800", "=1+1", "+1", "@x", "-1+c", "\x9b1m"],
)
def test_other_ids_are_refused_wherever_they_come_from(log, name):
    assert fault_of_id(name).isprintable()
    assert fault_of_id(name) != ""
    ranges = replace(log.ranges, anchor_ids=(name, *log.ranges.anchor_ids[1:]))
    with pytest.raises(DataError, match="anchor's id"):
        replace(log, ranges=ranges)
    with pytest.raises(DataError, match="anchor's id"):
        replace(log, mounting=SensorMounting(anchor_heights={name: 1.0}))


def test_blanks_in_an_id_become_underscores():
    assert one_word(" hall  west\t2 ") == "hall_west_2"


def test_plausible_ranges_are_positive_finite_and_not_absurd():
    readings = np.array([0.0, -3.0, 0.01, 0.5, 99.0, 101.0, np.inf, np.nan])
    assert plausible(readings, 100.0).tolist() == [False, False, False, True, True, False, False, False]
