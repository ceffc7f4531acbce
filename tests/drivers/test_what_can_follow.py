"""What may follow a reading: bases, clocks, gyros and ranges that go on up to their limits, and leap beyond them."""

import math
from dataclasses import replace

import pytest

from uwblite.drivers.continuity import LinkHealth, RangeGuard, device_time
from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, GyroHeading, OdometryPose, RangeEpoch, RangeReading
from uwblite.drivers.kobuki import TICK, Feedback, _follows
from uwblite.drivers.odometry_line import GyroLineDriver, LineFormat, OdometryLineDriver, gyro_format
from uwblite.drivers.text_lines import Line
from uwblite.drivers.uwb_line import Ranges

PACKET = Feedback(10.0, 1000, 100, 100, 0.5, 0.0, 0, 15.0)


@pytest.mark.parametrize(
    ("seconds", "way", "turn", "follows"),
    [
        (0.1, 0.0, 0.0, True),
        # A period of 20 ms beside the time between the packets, at 3 m/s and two turns a second.
        (0.1, 0.35, 0.0, True),
        (0.1, -0.35, 0.0, True),
        (0.1, 0.37, 0.0, False),
        (0.1, -0.37, 0.0, False),
        (0.1, 0.0, 1.49, True),
        (0.1, 0.0, 1.52, False),
        (0.1, 0.0, -1.52, False),
        (0.0, 0.05, 0.0, True),
        (0.0, 0.07, 0.0, False),
    ],
)
def test_a_base_that_is_carried_is_no_faster_than_three_metres_a_second(seconds, way, turn, follows):
    ticks = round(way / TICK)
    later = replace(PACKET, stamp=10.0 + seconds, time=1000 + round(1000 * seconds), left=(100 + ticks) % 65536,
                    right=(100 + ticks) % 65536, heading=math.remainder(0.5 + turn, 2 * math.pi))  # fmt: skip
    assert _follows(PACKET, later) is follows


@pytest.mark.parametrize(("ahead", "follows"), [(0.24, True), (-0.24, True), (0.26, False), (-0.26, False)])
def test_the_clocks_of_device_and_host_go_on_together_but_for_a_quarter_of_a_second(ahead, follows):
    assert (device_time(1.0 + ahead, 1.0, 65.536) is not None) is follows
    assert (device_time(1.0 + ahead - 65.536, 1.0, 65.536) is not None) is follows
    if follows:
        assert device_time(1.0 + ahead, 1.0, 65.536) == pytest.approx(1.0 + ahead)


def lines(driver, *contents, step=1.0):
    """Return whether the second of two lines, so many seconds later, can follow the first."""
    one, other = (Line(10.0 + step * k, content) for k, content in enumerate(contents))
    return driver.follows(one, other)


@pytest.mark.parametrize(
    ("change", "step", "follows"),
    [
        ({"x": 2.9}, 1.0, True), ({"x": 3.1}, 1.0, False), ({"y": -3.1}, 1.0, False), ({"y": 2.9}, 1.0, True),
        ({"theta": 3.1}, 0.32, True), ({"theta": 3.1}, 0.3, False), ({"theta": 2 * math.pi}, 0.1, True),
        # Shorter times count as a tenth of a second: numbers are rounded.
        ({"x": 0.29}, 0.01, True), ({"x": 0.31}, 0.01, False), ({"theta": 0.99}, 0.0, True), ({"theta": 1.01}, 0.0, False),
    ],
)  # fmt: skip
def test_a_base_that_prints_goes_three_metres_and_turns_ten_radians_a_second(change, step, follows):
    still = {"x": 0.0, "y": 0.0, "theta": 0.0}
    assert lines(OdometryLineDriver(LineFormat()), still, still | change, step=step) is follows
    millimetres = LineFormat(length_unit=0.001, angle_unit=math.radians(1.0))
    scaled = {name: value * (math.degrees(1.0) if name == "theta" else 1000.0) for name, value in (still | change).items()}
    assert lines(OdometryLineDriver(millimetres), still, scaled, step=step) is follows


@pytest.mark.parametrize(
    ("ticks", "follows"), [(290, True), (310, False), (-310, False), (290 - 1000, True), (310 - 1000, False)]
)
def test_wheels_that_print_their_counts_go_as_far(ticks, follows):
    driver, still = OdometryLineDriver(LineFormat(("left", "right"), tick=0.01, tick_modulus=1000)), {"left": 0.0, "right": 0.0}
    for wheel in ("left", "right"):
        assert lines(driver, still, still | {wheel: ticks}) is follows


@pytest.mark.parametrize(
    ("change", "step", "follows"),
    [
        ({"turn_rate": 0.99}, 0.0, True), ({"turn_rate": 1.01}, 0.0, False), ({"turn_rate": -1.01}, 0.0, False),
        ({"turn_rate": 5.9}, 0.1, True), ({"turn_rate": 6.1}, 0.1, False), ({"theta": 0.99}, 0.01, True),
        ({"theta": 1.01}, 0.01, False), ({"theta": 3.0}, 0.31, True),
    ],
)  # fmt: skip
def test_a_gyro_shakes_by_a_radian_a_second_and_changes_by_fifty_more_in_a_second(change, step, follows):
    (name,) = change
    driver = GyroLineDriver(gyro_format(name, 1.0, 1.0, ""))
    assert lines(driver, {name: 0.0}, change, step=step) is follows
    degrees = GyroLineDriver(gyro_format(name, 1.0, math.radians(1.0), ""))
    assert lines(degrees, {name: 0.0}, {name: math.degrees(change[name])}, step=step) is follows


@pytest.mark.parametrize(("step", "turned"), [(0.1, 0.15), (0.25, 0.375), (0.26, 0.0)])
def test_a_rate_is_integrated_over_a_quarter_of_a_second_at_most(step, turned):
    driver = GyroLineDriver(gyro_format("turn_rate", 1.0, 1.0, ""))
    driver.measured(Line(10.0, {"turn_rate": 1.0}))
    (heading,) = driver.measured(Line(10.0 + step, {"turn_rate": 2.0}))
    assert isinstance(heading, GyroHeading)
    assert (heading.heading, heading.turn_rate) == (pytest.approx(turned), 2.0)


def test_a_line_has_the_speeds_of_its_columns_in_its_units():
    form = LineFormat(("x", "y", "theta", "speed", "turn_rate"), length_unit=0.001, angle_unit=math.radians(1.0))
    content = {"x": 1000.0, "y": -500.0, "theta": 90.0, "speed": 200.0, "turn_rate": -45.0}
    (pose,) = OdometryLineDriver(form).measured(Line(10.0, content))
    assert pose == OdometryPose(10.0, 1.0, -0.5, pytest.approx(math.pi / 2), 0.2, pytest.approx(-math.pi / 4))


def guarded(*ranges, damaged):
    """Return the ranges that pass, and how many are given up, of one anchor ten times a second."""
    health = LinkHealth()
    guard, passed, lost = RangeGuard(health), [], 0
    for k, metres in enumerate(ranges):
        now = 100.0 + 0.1 * k
        if damaged:
            health.damage(now)
        actions = guard.take(RangeEpoch(now, (RangeReading("A", metres, 100),)), now)
        passed += [r.range for action in actions if isinstance(action, RangeEpoch) for r in action.readings]
        lost += sum(isinstance(action, Corrupt) for action in actions)
    return passed, lost


@pytest.mark.parametrize(("leap", "passes"), [(0.29, True), (0.31, False), (-0.31, False)])
def test_on_a_damaged_link_a_range_that_leaps_away_and_back_is_given_up(leap, passes):
    """0.15 m, and 1.5 m/s."""
    steady = [3.0] * 8
    assert guarded(*steady, 3.0 + leap, 3.0, 3.0, damaged=False) == ([*steady, 3.0 + leap, 3.0, 3.0], 0)
    passed, lost = guarded(*steady, 3.0 + leap, 3.0, 3.0, damaged=True)
    assert (3.0 + leap in passed, lost) == (passes, 0 if passes else 1)
    assert len(passed) + lost == 11


def test_a_link_counts_as_damaged_for_a_minute():
    health = LinkHealth()
    assert not health.is_damaged(0.0)
    health.damage(100.0)
    assert [health.is_damaged(t) for t in (100.0, 159.9, 160.0)] == [True, True, False]


@pytest.mark.parametrize(("pause", "missed"), [(2.3, 22), (1.05, 22), (0.95, 0), (0.1, 0)])
def test_numbers_of_rounds_that_wrap_leap_no_faster_than_twice_as_fast_as_they_are_counted(pause, missed):
    """Else the board has restarted: 23 rounds on, of ten a second; what is lost shows in the round behind the leap."""
    driver = open_device("uwb", "makerfabs-at:/dev/tag")[0].driver
    found = [driver._missed(Ranges(round=240 + k, modulus=256), 10.0 + 0.1 * k) for k in range(11)]
    assert not any(found)
    assert driver._missed(Ranges(round=(250 + 23) % 256, modulus=256), 11.0 + pause) == 0
    assert driver._missed(Ranges(round=(250 + 24) % 256, modulus=256), 11.1 + pause) == missed


@pytest.mark.parametrize(("following", "missed"), [(1, 9), (3, 9), (4, 0)])
def test_a_leap_of_rounds_is_believed_when_one_of_the_next_three_follows(following, missed):
    driver = open_device("uwb", "dwm3001:/dev/tag")[0].driver
    numbers = [5, 6, 7, 17, 17 + following]
    found = [driver._missed(Ranges(round=number), 10.0 + 0.1 * k) for k, number in enumerate(numbers)]
    assert found == [0, 0, 0, 0, missed]
