"""Units: where the words begin, at each limit; and the agreement of heading and path against its definition."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.errors import DataError
from uwblite.screening.units import (
    heading_agreement,
    heading_reading,
    likely_unit,
    refuse_degrees,
    refuse_other_ranges,
    refuse_wrong_lengths,
    refuse_wrong_times,
)
from uwblite.sensor_log import Gyro, LaserScans, Odometry, SensorLog, UwbRanges


def straight(speed=0.3, seconds=20.0, period=0.1):
    stamps = period * np.arange(round(seconds / period) + 1)
    return Odometry(stamps, np.column_stack([speed * stamps, np.zeros((len(stamps), 2))]))


def said(log):
    try:
        refuse_wrong_lengths(log)
    except DataError as error:
        return str(error)
    return ""


def factor(text):
    return text.rsplit("=", 1)[-1].rstrip("`)")


@pytest.mark.parametrize(("speed", "unit"), [(8.99, ""), (9.01, "0.01"), (94.0, "0.01"), (96.0, "0.001"), (-96.0, "0.001")])
def test_speeds_of_the_odometry(speed, unit):
    text = said(SensorLog(straight(speed)))
    assert factor(text) == unit
    assert f"usual speed would be {abs(speed):.0f} m/s" in text or not unit


def test_speed_is_taken_over_a_second_of_those_that_move():
    """Two robots by turns jump to and fro between readings; a robot that mostly stands is fast when it moves."""
    odometry = straight(0.3)
    to_and_fro = replace(odometry, poses=odometry.poses + np.outer(np.arange(len(odometry.stamps)) % 2, [5.0, 0.0, 0.0]))
    assert said(SensorLog(to_and_fro)) == ""
    x = 105.0 * np.maximum(odometry.stamps - 17.5, 0.0)
    assert factor(said(SensorLog(replace(odometry, poses=np.column_stack([x, 0 * x, 0 * x]))))) == "0.001"
    # Ten readings that move are enough; the last second has no reading a second later.
    for seconds, unit in ((1.4, "0.01"), (1.2, "")):
        assert factor(said(SensorLog(straight(20.0, seconds)))) == unit


def ranges(values):
    n = len(values)
    return UwbRanges(np.linspace(0.0, 20.0, n), np.zeros(n, dtype=int), np.asarray(values, float), np.full(n, 100.0), ("A",))


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        ([200.0] * 10, ""), ([200.1] * 10, "0.01"), ([940.0] * 10, "0.01"), ([960.0] * 10, "0.001"), ([5000.0] * 9, ""),
        ([0.0] * 30 + [5000.0] * 10, "0.001"), ([-1.0] * 30 + [5000.0] * 10, "0.001"), ([0.5] * 30 + [5000.0] * 10, ""),
    ],
)  # fmt: skip
def test_usual_ranges(values, unit):
    assert factor(said(SensorLog(straight(), ranges(values)))) == unit


def scans(value, count=1, beams=100, view=4.0, nearest=0.05, farthest=1e6):
    readings = np.full((count, beams), value, dtype=np.float32)
    return LaserScans(np.arange(float(count)), readings, -0.5 * view, view / (beams - 1), 0.0, nearest, farthest)


@pytest.mark.parametrize(("value", "unit"), [(150.0, ""), (150.1, "0.01"), (940.0, "0.01"), (960.0, "0.001"), (np.nan, "")])
def test_usual_readings_of_the_laser(value, unit):
    assert factor(said(SensorLog(straight(), None, scans(value)))) == unit
    assert factor(said(SensorLog(straight(), None, scans(value, 1000)))) == unit


def test_readings_outside_the_laser_s_own_limits_count_for_nothing():
    assert said(SensorLog(straight(), None, scans(960.0, farthest=959.0))) == ""
    assert said(SensorLog(straight(), None, scans(960.0, nearest=961.0))) == ""
    assert factor(said(SensorLog(straight(), None, scans(960.0, nearest=960.0, farthest=960.0)))) == "0.001"
    assert factor(said(SensorLog(straight(), None, scans(960.0, beams=10)))) == "0.001"
    assert said(SensorLog(straight(), None, scans(960.0, beams=9))) == ""


@pytest.mark.parametrize(("view", "named"), [(6.37, False), (6.39, True), (-6.39, True)])
def test_a_laser_sees_at_most_one_turn(view, named):
    assert ("angles must be radians" in said(SensorLog(straight(), None, scans(1.0, view=view)))) == named


def test_all_that_is_wrong_is_said_at_once():
    text = said(SensorLog(straight(100.0), ranges([5000.0] * 10), scans(960.0)))
    assert [part.split()[1] for part in text.split("; the ")] == ["odometry's", "look", "readings"]


def arc(turn=1.5, metres=30.0, step=0.05):
    """Return a path that turns by so many rad to and fro per 10 m, heading along it."""
    s = np.arange(0.0, metres, step)
    heading = turn * np.sin(2.0 * np.pi * s / 10.0)
    xy = np.cumsum(step * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return Odometry(0.1 * np.arange(len(s)), np.column_stack([xy, heading]))


def with_heading(odometry, heading):
    return replace(odometry, poses=np.column_stack([odometry.poses[:, :2], heading]))


def test_a_heading_along_the_path_agrees_forwards_and_backwards():
    path = arc()
    heading = path.poses[:, 2]
    for other in (heading, heading + np.pi, np.angle(np.exp(1j * (heading + 3.0)))):
        agreement, straight = heading_agreement(with_heading(path, other))
        assert agreement == pytest.approx(1.0, abs=0.01)
        assert straight < 0.9
    assert heading_agreement(with_heading(path, -heading), -1.0)[0] == pytest.approx(1.0, abs=0.01)
    assert heading_agreement(with_heading(path, 0.5 * heading), 2.0)[0] == pytest.approx(1.0, abs=0.01)
    assert heading_agreement(with_heading(path, -heading))[0] < 0.5
    assert heading_agreement(arc(turn=0.1))[1] > 0.9


def test_agreement_is_a_mean_over_the_way_and_not_over_the_readings():
    """Half the way sideways, at a tenth of the speed."""
    stamps = np.arange(0.0, 44.0, 0.1)
    x = np.where(stamps < 4.0, 2.5 * stamps, 10.0 + 0.25 * (stamps - 4.0))
    heading = np.where(stamps < 4.0, 0.0, np.pi / 4)
    agreement, straight = heading_agreement(Odometry(stamps, np.column_stack([x, 0 * x, heading])))
    # Two equal halves whose doubled angles are a right angle apart.
    assert agreement == pytest.approx(np.sqrt(0.5), abs=0.01)
    assert straight == pytest.approx(1.0, abs=1e-6)
    short = heading_agreement(Odometry(stamps[:3], np.zeros((3, 3))))
    assert short == (1.0, 1.0)


@pytest.mark.parametrize("wrapped", [False, True])
def test_degrees_are_refused_and_radians_are_not(wrapped):
    path = arc()
    degrees = np.degrees(path.poses[:, 2])
    degrees = (degrees + 180.0) % 360.0 - 180.0 if wrapped else degrees
    with pytest.raises(DataError, match=r"as such it agrees with the path to 1\.00 of 1, as radians to 0"):
        refuse_degrees(with_heading(path, degrees))
    # A heading against the path is another fault.
    for heading in (path.poses[:, 2], -path.poses[:, 2], 0.01 * degrees):
        refuse_degrees(with_heading(path, heading))
    with pytest.raises(DataError, match="looks like degrees"):
        refuse_degrees(with_heading(arc(0.05), np.degrees(arc(0.05).poses[:, 2])))


def test_degrees_show_in_small_turns_of_a_straight_path():
    """As radians they are turns at random; a base that turns by itself along such a path shows no unit."""
    stamps = np.arange(0.0, 100.0, 0.1)
    heading = 0.04 * np.sin(0.2 * stamps)
    path = Odometry(stamps, np.column_stack([np.cumsum(0.03 * np.cos(heading)), np.cumsum(0.03 * np.sin(heading)), heading]))
    assert heading_reading(path).straight > 0.99
    refuse_degrees(path)
    with pytest.raises(DataError, match="looks like degrees"):
        refuse_degrees(with_heading(path, np.degrees(heading)))
    refuse_degrees(with_heading(path, 0.1 * stamps))


def test_a_heading_against_a_path_that_swings_about_one_direction_is_not_in_degrees():
    """Against the path radians agree least; as degrees they are all but constant, which agrees with such a path in part."""
    stamps = np.arange(0.0, 60.0, 0.05)
    direction = 0.8 * (2.0 / np.pi) * np.arcsin(np.sin(2.35 * stamps))
    steps = 0.025 * np.column_stack([np.cos(direction), np.sin(direction)])[:-1]
    path = Odometry(stamps, np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), -direction]))
    assert np.median(np.abs(np.diff(direction)) / 0.05) > 1.0
    plain, degrees, mirrored = (heading_agreement(path, factor)[0] for factor in (1.0, np.pi / 180.0, -1.0))
    assert plain + 0.2 < degrees < mirrored
    refuse_degrees(path)


def test_readings_that_jitter_within_a_fifth_of_a_metre_agree_nevertheless():
    path = arc(step=0.02)
    jitter = 0.01 * np.random.default_rng(1).standard_normal((len(path.stamps), 2))
    shaken = replace(path, poses=path.poses + np.column_stack([jitter, np.zeros(len(jitter))]))
    assert heading_agreement(shaken)[0] > 0.97


def times_said(log):
    try:
        refuse_wrong_times(log)
    except DataError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("unit", "name"), [(1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")])
@pytest.mark.parametrize("speed", [0.05, 0.3, 2.0])
@pytest.mark.parametrize("period", [0.01, 0.05, 0.5])
def test_stamps_of_a_recording(unit, name, speed, period):
    log = SensorLog(straight(speed, period=period), ranges([3.0] * 40), scans(3.0, 20))
    assert times_said(log) == ""
    text = times_said(log.with_time_unit(1.0 / unit))
    assert name in text
    assert float(factor(text)) == unit


@pytest.mark.parametrize(("unit", "name"), [(1e-3, "milliseconds"), (1e-9, "nanoseconds")])
def test_stamps_since_1970_of_a_recording_of_wheels_alone(unit, name):
    """Neighbouring numbers are 256 ns apart there: a second is a step of one, and is lost."""
    odometry = straight(0.3, period=0.05)
    assert name in times_said(SensorLog(replace(odometry, stamps=(1.7e9 + odometry.stamps) / unit)))


def test_slow_robots_and_seldom_readings_are_in_seconds():
    """A reading for every keyframe, a stamp for every message, a crawl at a usual rate, and a robot that stands."""
    for speed, period in ((0.1, 10.0), (0.03, 2.0), (0.001, 0.1), (0.0, 100.0)):
        assert times_said(SensorLog(straight(speed, 100.0 * period, period))) == ""


def test_one_sensor_s_stamps():
    log = SensorLog(straight(), ranges([3.0] * 40), scans(3.0, 20))
    log = replace(log, gyro=Gyro(log.odometry.stamps, np.zeros(len(log.odometry.stamps))))
    for name, what in (("ranges", "radio"), ("scans", "lidar"), ("gyro", "gyro")):
        sensor = getattr(log, name)
        for unit, word in ((1e3, "milliseconds"), (1e9, "nanoseconds")):
            moved = replace(sensor, stamps=1.7e9 * unit + sensor.stamps * unit)
            assert f"stamps of the {what} look like {word}" in times_said(replace(log, **{name: moved}))
    ms = replace(log.odometry, stamps=1e3 * log.odometry.stamps)
    assert "stamps of the odometry look like milliseconds" in times_said(replace(log, odometry=replace(ms, poses=0 * ms.poses)))
    # A sensor that was started late, or died, is of the same clock.
    assert times_said(replace(log, ranges=replace(log.ranges, stamps=0.001 * log.ranges.stamps))) == ""


def by_time(odometry, unit):
    return replace(odometry, stamps=odometry.stamps / unit)


def stamps_said(odometry, ranges=None):
    try:
        refuse_wrong_times(SensorLog(odometry, ranges))
    except DataError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("unit", "name"), [(1.0, ""), (60.0, "minutes"), (3960.0, "hours"), (86400.0, "days")])
@pytest.mark.parametrize("period", [0.02, 0.1])
def test_stamps_in_long_units_are_told_from_lengths_in_short_ones(unit, name, period):
    """In minutes a robot drives and turns sixty times as fast; in centimetres it does not turn so, in degrees not drive so."""
    path = arc()
    stamps = period * np.arange(len(path.stamps))
    path = Odometry(stamps, np.column_stack([path.poses[:, :2] * period / 0.1, 0.4 * stamps]))
    assert (f"look like {name}:" if name else "") in stamps_said(by_time(path, unit))
    assert stamps_said(replace(path, poses=path.poses * [100.0, 100.0, 1.0])) == ""
    assert stamps_said(replace(path, poses=path.poses * [1.0, 1.0, np.degrees(1.0)])) == ""


def test_stamps_of_one_sensor_in_minutes():
    path = arc()
    values = replace(ranges([5.0] * 900), stamps=np.linspace(0.0, path.stamps[-1], 900))
    assert stamps_said(path, values) == ""
    text = stamps_said(path, replace(values, stamps=values.stamps / 60.0))
    assert "the stamps of the radio look like minutes: odometry and radio would last 59.9 s and" in text


@pytest.mark.parametrize(
    ("times", "by_lidar", "unit"),
    [(1.0, np.nan, ""), (2.0, np.nan, ""), (3.2, np.nan, "0.3048"), (3.2, 1.0, "0.3048"), (3.2, 3.3, ""), (96.0, 1.0, "0.01"),
     (1050.0, np.nan, "0.001"), (np.nan, 1.0, ""), (3.2, 0.0, "0.3048"), (np.nan, 0.0, "")],
)  # fmt: skip
def test_ranges_that_change_as_much_as_another_unit_would(times, by_lidar, unit):
    try:
        refuse_other_ranges(times, by_lidar)
        text = ""
    except DataError as error:
        text = str(error)
    assert factor(text) == unit


def test_factors_that_a_unit_explains():
    assert "ranges in yards" in likely_unit(1.10)
    assert "odometry in feet" in likely_unit(0.31)
    assert likely_unit(1.0) == likely_unit(1.15) == likely_unit(1.41) == likely_unit(-0.31) == ""


@pytest.mark.parametrize(("unit", "metres"), [("feet", 0.3048), ("centimetres", 0.01), ("millimetres", 0.001)])
def test_ranges_that_change_as_fast_as_in_another_unit_are_refused_unless_the_lidar_agrees(unit, metres):
    """To a fifth: wheels have errors of their own."""
    for off in (1.0, 1.19, 1.0 / 1.19):
        with pytest.raises(DataError, match=rf"the ranges look like {unit}.*`range_unit={metres:g}`"):
            refuse_other_ranges(off / metres, np.nan)
        refuse_other_ranges(off / metres, 1.0 / metres)
    for off in (1.21, 1.0 / 1.21):
        refuse_other_ranges(off / metres, np.nan)
    with pytest.raises(DataError):
        refuse_other_ranges(1.0 / metres, 1.21 / metres)
    refuse_other_ranges(1.0, np.nan)
