"""Jumps of ranges that no motion of the wheels explains: each rule against a loop over readings."""


import numpy as np
import pytest

from uwblite.screening import range_motion
from uwblite.screening.range_motion import (
    _by_anchor,
    _jumps,
    _noise,
    _together,
    change_by_way,
    excess,
)
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges


def line(ranges_of, seconds=60.0, speed=0.0, anchors=2, noise=0.0, scans=None):
    """Return a robot that drives along x at a speed (m/s), with a range to each anchor every second: ranges_of(anchor, t)."""
    stamps = np.arange(0.0, seconds, 0.1)
    odometry = Odometry(stamps, np.column_stack([speed * stamps, np.zeros((len(stamps), 2))]))
    when, anchor = np.repeat(np.arange(0.0, seconds - 0.5), anchors), np.tile(np.arange(anchors), int(seconds))
    values = np.array([ranges_of(a, t) for a, t in zip(anchor, when, strict=True)])
    values += noise * np.random.default_rng(1).standard_normal(len(values))
    radio = UwbRanges(when, anchor, values, np.full(len(when), 100.0), tuple(f"A{k}" for k in range(anchors)))
    return SensorLog(odometry, radio, scans)


@pytest.mark.parametrize("window", [3, 8])
def test_jumps_are_differences_of_medians_beyond_the_way_driven(window):
    rng = np.random.default_rng(window)
    ranges, way = rng.normal(size=40) * 5.0, np.cumsum(rng.uniform(0.0, 0.3, 40))
    expected = np.full(40, -np.inf)
    for k in range(window - 1, 40 - window):
        before, after = slice(k - window + 1, k + 1), slice(k + 1, k + 1 + window)
        driven = np.mean(way[after]) - np.mean(way[before])
        expected[k] = abs(np.median(ranges[after]) - np.median(ranges[before])) - 1.5 * driven
    np.testing.assert_allclose(_jumps(ranges, way, window), expected)


def test_noise_is_that_of_second_differences():
    """A steady approach is no noise; of fewer than five readings nothing is learnt."""
    rng = np.random.default_rng(0)
    steady = 3.0 + 0.4 * np.arange(4000)
    assert _noise(steady + 0.2 * rng.standard_normal(4000)) == pytest.approx(0.2, rel=0.1)
    assert (_noise(steady), _noise(steady[:5]), _noise(steady[:4])) == (pytest.approx(0.03),) * 2 + (0.1,)


def test_readings_are_sorted_by_tag_and_anchor_and_what_is_no_distance_is_left_out():
    rng = np.random.default_rng(5)
    stamps = np.sort(rng.uniform(0.0, 12.0, 300))
    stamps[[0, 150]] = 1.0, 1.0 if stamps[149] <= 1.0 <= stamps[151] else stamps[150]
    stamps = np.sort(np.append(stamps[:-2], [1.0, 11.0]))
    anchor, tag = rng.integers(0, 3, 300), rng.integers(0, 2, 300)
    values = rng.choice([0.0, 0.02, 0.021, 5.0, 199.9, 200.0, 900.0], 300)
    radio = UwbRanges(stamps, anchor, values, np.full(300, 100.0), ("A", "B", "C"), tag)
    odometry = Odometry(np.array([1.0, 11.0]), np.zeros((2, 3)))
    log = SensorLog(odometry, radio, None, SensorMounting(more_tags=np.zeros((1, 3))))
    expected = []
    for a in range(3):
        for t in range(2):
            own = [
                k for k in range(300) if (anchor[k], tag[k]) == (a, t) and 0.02 < values[k] < 200.0 and 1.0 <= stamps[k] <= 11.0
            ]
            expected.append((stamps[own].tolist(), values[own].tolist()))
    assert [(s.tolist(), v.tolist()) for s, v in _by_anchor(log)] == expected
    # Two usable readings are too few to take a median of.
    few = radio.rows(np.flatnonzero((anchor == 0) & (tag == 0) & (values == 5.0) & (stamps > 1.0) & (stamps < 11.0))[:3])
    assert len(_by_anchor(SensorLog(odometry, few))) == 1
    assert _by_anchor(SensorLog(odometry, few.rows(slice(0, 2)))) == []
    assert _by_anchor(SensorLog(odometry)) == []


def jumping(t, by, at=30.0):
    return 10.0 + by * (t > at)


@pytest.mark.parametrize(("by", "speed"), [(3.0, 0.0), (0.4, 0.0), (-3.0, 0.0), (3.0, 0.02), (3.0, 0.2)])
def test_excess_is_how_much_farther_the_ranges_went_than_the_wheels(by, speed):
    """Beyond half a metre and five times the least noise, and the way that the wheels count meanwhile."""
    log = line(lambda a, t: jumping(t, by), speed=speed)
    # From the middle one of three readings before, and to that of those after, it is 1.5 s each; the times asked about are two
    # seconds apart.
    expected = max(0.0, abs(by) - speed * (1.5 + 1.5 + 2.0) - 0.5 - 5.0 * 0.03)
    assert excess(log, 29.5, 31.5) == pytest.approx(expected, abs=1e-9)


def test_what_the_wheels_count_while_the_radio_is_silent_is_no_motion_beyond_theirs():
    """A radio that measures now and then: its last readings before a stand are of another place."""
    stamps = np.arange(0.0, 60.0, 0.1)
    way = 0.5 * (np.minimum(stamps, 25.0) + np.maximum(stamps - 35.0, 0.0))
    log = line(lambda a, t: 10.0 + np.interp(t, stamps, way))
    log = SensorLog(Odometry(stamps, np.column_stack([way, np.zeros((600, 2))])), log.ranges)
    silent = log.ranges.rows((log.ranges.stamps < 16.0) | (log.ranges.stamps > 43.0))
    assert excess(SensorLog(log.odometry, silent), 25.0, 35.0) == 0.0
    carried = line(lambda a, t: 10.0 + np.interp(t, stamps, way) + 8.0 * (t > 30.0)).ranges
    carried = carried.rows((carried.stamps < 16.0) | (carried.stamps > 43.0))
    assert excess(SensorLog(log.odometry, carried), 25.0, 35.0) > 0.0


def test_what_changes_in_between_counts_too():
    """Away and back while the wheels stand: before and after are the same."""
    log = line(lambda a, t: 10.0 + 4.0 * (20 < t < 40))
    assert excess(log, 10.0, 50.0) == pytest.approx(4.0 - 0.65)
    assert excess(log, 22.0, 38.0) == pytest.approx(0.0)
    assert excess(line(lambda a, t: 10.0 + 4.0 * (20 < t < 40), anchors=1), 10.0, 50.0) == pytest.approx(3.35)
    # One of three anchors alone does not speak for a motion.
    assert excess(line(lambda a, t: 10.0 + 4.0 * (20 < t < 40) * (a == 0), anchors=3), 10.0, 50.0) == 0.0


def test_bursts_of_one_anchor_after_another_are_no_motion():
    """Compared with each other two bursts agree; with any other moment neither does. A drive changes all, all the time."""
    spell = {0: (12, 19), 1: (38, 45)}
    late = line(lambda a, t: 10.0 + a + 3.0 * (spell[a][0] < t < spell[a][1]))
    assert excess(late, 5.0, 55.0) == 0.0
    driven = line(lambda a, t: 15.0 + (2 * a - 1) * 0.2 * min(max(t - 5.0, 0.0), 50.0))
    # Eight pieces, and before and after: from the fifth of these moments the farther end is 6.5 pieces away.
    assert excess(driven, 5.0, 55.0) == pytest.approx(10.0 * 6.5 / 8.0 - 0.65, abs=0.11)


def wall_less_scans():
    return LaserScans(np.arange(0.0, 59.0), np.full((59, 40), np.inf, dtype=np.float32), -1.0, 0.05, 0.0, 0.05, 10.0)


@pytest.mark.parametrize(
    ("anchors", "who", "scans", "jumps", "cut"),
    [
        (2, {0, 1}, None, [], True),
        (3, {0}, None, [], False),
        (1, {0}, None, [], False),
        (1, {0}, None, [30.4], True),
        (8, {0}, None, [], False),
        (8, {0, 1}, None, [], False),
        (3, {0}, wall_less_scans(), [], False),
        (3, {0}, wall_less_scans(), [30.4], True),
        (3, {0}, wall_less_scans(), [20.0], False),
        (8, {0, 1, 2, 3}, wall_less_scans(), [], True),
        (8, {0, 1, 2}, wall_less_scans(), [], False),
        (8, {0, 1, 2}, wall_less_scans(), [30.4], False),
    ],
)
def test_enough_anchors_must_jump_together(anchors, who, scans, jumps, cut):
    """Two, and half of those in reach; one where the odometry jumps too, unless others contradict it."""
    log = line(lambda a, t: jumping(t, 5.0 * (a in who)), anchors=anchors, scans=scans)
    found = range_motion.cuts(log, np.array(jumps))
    assert len(found) == cut
    assert all(29.5 <= t <= 31.0 for t in found)


def test_a_cut_is_not_in_a_silence_of_more_than_six_periods_nor_seen_in_fewer_than_32_readings():
    log = line(lambda a, t: jumping(t, 5.0))
    for kept, cut in (
        (abs(log.ranges.stamps - 30.5) > 3.5, [25.5]), (abs(log.ranges.stamps - 30.5) > 1.6, [28.0]),
        (abs(log.ranges.stamps - 30.5) < 15.0, []), (abs(log.ranges.stamps - 30.5) < 16.0, [30.0]),
    ):  # fmt: skip
        part = SensorLog(log.odometry, log.ranges.rows(kept))
        assert range_motion.cuts(part, np.zeros(0)) == cut


def test_cuts_nearer_than_ten_seconds_are_one():
    def votes(*times):
        return [np.array([[t, t + 1.0, over] for t, over in times])] * 2

    assert _together(votes((5.0, 1.0), (15.0, 2.0)), np.zeros(0)) == [15.5]
    assert _together(votes((5.0, 1.0), (15.1, 2.0)), np.zeros(0)) == [5.5, pytest.approx(15.6)]
    assert _together(votes((5.0, 0.0)), np.zeros(0)) == []


def test_the_moment_of_a_cut_is_in_all_the_spans_that_jump():
    spans = [np.array([[1.0, 4.0, 1.0]]), np.array([[2.0, 5.0, 3.0]]), np.array([[4.0, 6.0, -1.0]])]
    assert _together(spans, np.zeros(0)) == [3.0]
    assert _together([spans[0], spans[1][:, [0, 1, 2]] * [1, 1, -1]], np.zeros(0)) == []
    assert _together([spans[0], spans[1] * [1, 1, 0]], np.zeros(0)) == []


@pytest.mark.parametrize("times", [0.3048, 1.0, 3.28])
def test_ranges_change_as_much_as_a_robot_drives_towards_an_anchor(times):
    """One anchor lies ahead; of another at the side one range in ten changes by more than 0.87 of the way, at last."""
    log = line(lambda a, t: times * (30.0 - 0.5 * t if a == 0 else np.hypot(2.0, 0.5 * t - 5.0)), speed=0.5, noise=0.02)
    assert change_by_way(log) == pytest.approx(times, abs=0.05)


def test_ranges_that_change_now_and_then_show_no_unit():
    assert np.isnan(change_by_way(line(lambda a, t: 10.0 + 9.0 * (t % 20 < 1), speed=0.5)))
    assert np.isnan(change_by_way(line(lambda a, t: 10.0, speed=0.5, seconds=15.0)))
