"""A gyro that prints lines: rates are integrated, headings unwrapped, gaps not guessed."""

import math
import random

import pytest
from emulators.kobuki_device import GyroLineDevice
from emulators.world import RoomWorld, WorldClock
from helpers.driver_harness import of_kind, simulate

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, GyroHeading, Lost
from uwblite.errors import ConfigError

DEGREES = "angle_unit=0.017453292519943295"


def test_a_rate_that_leaps_away_and_back_turns_nothing():
    stated, actions = headings("line:x?columns=turn_rate", ["0", *["0.01"] * 50, "8.01", *["0.01"] * 50])
    assert [a.why for a in actions if isinstance(a, Corrupt)] == ["line that leaps away and back"]
    assert stated[-1].heading < 0.03


def headings(spec, lines, period=0.02):
    session = open_device("gyro", spec)[0]
    session.start(0.0)
    actions = [action for k, line in enumerate(lines) for action in session.feed(f"{line}\n".encode(), period * k)]
    return [action for action in actions if isinstance(action, GyroHeading)], actions


def test_rates_are_integrated_by_the_gyros_own_time():
    rng = random.Random(1)
    clock, sent = WorldClock(), []
    clock.start(1000.0)
    device = GyroLineDevice(RoomWorld().poses(), clock, on_packet=lambda *pose: sent.append(pose))
    session = open_device("gyro", f"line:x?columns=t,turn_rate&time_unit=0.001&{DEGREES}")[0]
    actions, _ = simulate(session, device, 60.0, jitter=lambda: rng.expovariate(300.0))
    stated = of_kind(actions, GyroHeading)
    assert len(stated) > 5900
    assert not of_kind(actions, Corrupt)
    assert not of_kind(actions, Lost)
    turned, seconds = stated[-1].heading - stated[200].heading, stated[-1].stamp - stated[200].stamp
    # The circle of the emulated room, 0.2 m/s on 1.5 m, and the bias of the gyro.
    assert turned / seconds == pytest.approx(0.2 / 1.5 + math.radians(0.8), abs=2e-4)


def test_headings_are_unwrapped_and_may_count_clockwise():
    stated, _ = headings(f"line:x?columns=theta&angle_unit={-math.radians(1)}", ["0", "170", "179", "-179", "-90", "10"], 0.2)
    assert [round(-math.degrees(h.heading)) for h in stated] == [170, 179, 181, 270, 370]


def test_what_happens_in_a_gap_is_not_guessed():
    stated, _ = headings("line:x?columns=t,turn_rate", [f"{t},1.0" for t in (0.0, 0.1, 0.2, 5.0, 5.1)], period=0.1)
    assert stated[-1].heading - stated[0].heading == pytest.approx(0.2, abs=1e-9)


@pytest.mark.parametrize(("step", "turned"), [(0.25, 0.25), (0.26, 0.0)])
def test_a_rate_is_integrated_over_a_quarter_of_a_second_at_most(step, turned):
    stated, _ = headings("line:x?columns=t,turn_rate", [f"{t},1.0" for t in (0.0, 0.125, 0.25, 0.25 + step)], period=0.125)
    assert stated[-1].heading - stated[-2].heading == pytest.approx(turned, abs=1e-9)


@pytest.mark.parametrize("columns", ["t", "x,y,theta", "turn_rate,turn_rate", "-"])
def test_columns_without_a_turn_are_refused(columns):
    with pytest.raises(ConfigError, match="gyro line"):
        open_device("gyro", f"line:x?columns={columns}")


def test_a_digit_that_is_lost_from_the_time_costs_its_own_reading_only():
    driver = open_device("gyro", "line:port?columns=t,turn_rate&time_unit=0.001")[0].driver
    actions = []
    for k in range(1500):
        text = str(10 * k + 20_000)
        time = text[:2] + text[3:] if k in (700, 900) else text
        for event in driver.parse(f"{time},0.1\n".encode(), 50 + 0.01 * k):
            actions += driver.take(event)
    assert [a.count for a in actions if isinstance(a, Lost)] == [1, 1]
    assert [a.why for a in actions if isinstance(a, Corrupt)] == ["line that leaps away and back"] * 2
    stamps = [a.stamp for a in actions if isinstance(a, GyroHeading)]
    assert len(stamps) == 1498
    assert max(abs(s - t) for s, t in zip(stamps[-500:], [50 + 0.01 * k for k in range(1000, 1500)], strict=True)) < 0.002
