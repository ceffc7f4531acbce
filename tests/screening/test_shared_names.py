"""Two anchors that answer to one name: found whenever both are in reach, and never where late echoes make ranges leap."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.told import told

from uwblite.screening.shared_names import _driven, without_shared_names
from uwblite.screening.stuck_sensors import quiet_noise, resolution_of
from uwblite.sensor_log import Odometry, SensorLog, SensorMounting, UwbRanges

PLACES = {"A": (2.0, 12.0), "B": (18.0, -3.0), "C": (9.0, 5.0)}


def recording(seed=0, laps=2, every=2.0, sigma=0.1):
    """Return a drive at 0.2 m/s around a rectangle of 16 x 8 m, each anchor measured in each round."""
    corners = np.array([[1.0, 0.0], [17.0, 0.0], [17.0, 8.0], [1.0, 8.0]])
    route = np.vstack([*[corners] * laps, corners[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))])
    stamps = np.arange(0.0, way[-1] / 0.2, 0.1)
    path = np.column_stack([np.interp(0.2 * stamps, way, route[:, k]) for k in range(2)])
    times = np.arange(0.5, stamps[-1], every)
    places = np.array(list(PLACES.values()))
    at = np.column_stack([np.interp(times, stamps, path[:, k]) for k in range(2)])
    distances = np.hypot(*(places[:, None] - at[None]).transpose(2, 0, 1)).T
    noise = sigma * np.random.default_rng(seed).standard_normal(distances.shape)
    anchor = np.tile(np.arange(len(places)), len(times))
    stated, quality = (distances + noise).ravel(), np.full(len(anchor), 100.0)
    ranges = UwbRanges(np.repeat(times, len(places)), anchor, stated, quality, tuple(PLACES))
    return SensorLog(Odometry(stamps, np.column_stack([path, np.zeros(len(path))])), ranges)


def changed(log, **parts):
    return replace(log, ranges=replace(log.ranges, **parts))


def renamed(log):
    """Return the recording with B called A as well."""
    ranges = log.ranges
    return changed(log, anchor=np.array([0, 0, 1])[ranges.anchor], anchor_ids=("A", "C"))


@pytest.mark.parametrize("seed", range(5))
def test_two_anchors_with_one_name_are_left_out(seed):
    log = renamed(recording(seed))
    done, facts = without_shared_names(log)
    (remark,) = told(facts)
    assert remark.kind == "shared-name"
    assert remark.severity == "warning"
    assert "two anchors seem to have the name A:" in remark.text
    assert done.ranges.anchor_ids == ("C",)
    np.testing.assert_array_equal(done.ranges.ranges, log.ranges.ranges[log.ranges.anchor == 1])
    assert without_shared_names(done) == (done, [])


def test_the_number_of_leaps_is_told():
    """A loop over neighbours; the robot drives 0.2 m/s all the time."""
    log = renamed(recording())
    noise = quiet_noise([log.ranges.ranges[log.ranges.anchor == k] for k in range(2)], resolution_of(log.ranges.ranges))
    own = log.ranges.rows(log.ranges.anchor == 0)
    count = 0
    for k in range(1, len(own.ranges)):
        driven = 0.2 * (own.stamps[k] - own.stamps[k - 1])
        count += abs(own.ranges[k] - own.ranges[k - 1]) > 1.5 * driven + 0.5 + 5.0 * noise
    (remark,) = told(without_shared_names(log)[1])
    assert f"({count} of {len(own.ranges) - 1} times" in remark.text


def test_where_every_range_is_of_two_places_their_noise_is_not_known():
    log = renamed(recording())
    alone = replace(log, ranges=log.ranges.rows(log.ranges.anchor == 0))
    assert without_shared_names(alone) == (alone, [])


@pytest.mark.parametrize("seed", range(5))
def test_each_of_several_anchors_and_their_echoes_are_one_place(seed):
    log, rng = recording(seed), np.random.default_rng(seed)
    count = len(log.ranges.ranges)
    late = (log.ranges.anchor == 0) & (rng.random(count) < 0.4)
    for detour in (0.0, 5.0, rng.exponential(2.0, count), rng.exponential(6.0, count), rng.uniform(0.0, 8.0, count)):
        other = changed(log, ranges=log.ranges.ranges + late * detour)
        assert without_shared_names(other) == (other, [])


def test_places_in_reach_one_after_the_other_are_not_of_one_time():
    """That anchor is moved; there is one leap."""
    log = renamed(recording())
    original, middle = recording().ranges, float(np.mean(log.odometry.stamps[[0, -1]]))
    heard = (original.anchor == 2) | ((original.anchor == 1) == (original.stamps > middle))
    moved = replace(log, ranges=log.ranges.rows(heard))
    assert without_shared_names(moved) == (moved, [])


def test_tags_of_one_robot_that_are_far_apart_measure_one_anchor():
    """What two tags measure of one anchor differs, however far they are apart."""
    log = renamed(recording())
    original = recording().ranges
    tagged = replace(log, mounting=SensorMounting(more_tags=np.zeros((1, 3))))
    tagged = changed(tagged, tag=(original.anchor == 1).astype(np.intp))
    assert without_shared_names(tagged) == (tagged, [])


def test_wheels_that_count_too_little_make_no_second_place():
    """Ranges grow and shrink by more than a tenth of the way, but do not leap back."""
    log = recording(every=10.0)
    poses = log.odometry.poses * np.array([0.1, 0.1, 1.0])
    slow = replace(log, odometry=Odometry(log.odometry.stamps, poses))
    assert without_shared_names(slow) == (slow, [])


def test_a_robot_drives_as_fast_as_usual_while_its_wheels_stand():
    log = recording()
    stamps = log.odometry.stamps
    poses = np.where((stamps < 60.0)[:, None], log.odometry.poses, log.odometry.poses[stamps < 60.0][-1])
    frozen = replace(log, odometry=Odometry(stamps, poses))
    np.testing.assert_allclose(_driven(frozen), 0.2 * stamps, rtol=1e-6, atol=1e-9)


def test_what_there_is_nothing_to_see_in():
    log = recording()
    for ranges in (None, replace(log.ranges, ranges=np.zeros_like(log.ranges.ranges)), log.ranges.rows(slice(0, 3))):
        few = replace(log, ranges=ranges)
        assert without_shared_names(few) == (few, [])
    still = replace(log, odometry=Odometry(log.odometry.stamps[:1], log.odometry.poses[:1]))
    assert without_shared_names(still) == (still, [])
