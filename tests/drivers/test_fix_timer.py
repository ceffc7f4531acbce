"""Times of fixes from polls: brackets, the grid, lateness, slots that move."""

import random

import pytest

from uwblite.drivers.fix_timer import FixTimer

PERIOD = 0.1


def poll(timer, times, rng, seen_late=lambda k: 0.0):
    """Poll every 4 ms around each fix; yield the error of each stamp."""
    for k, true in enumerate(times):
        shown = true + seen_late(k)
        first = shown - rng.uniform(0.004, 0.012)
        before = None
        while first < shown:
            before, first = first, first + 0.004
        stamp = timer.time(before, first + 0.001, PERIOD)
        timer.accept(stamp, as_found=True)
        yield stamp - true


def test_the_grid_narrows_brackets_of_4_ms_to_about_1():
    errors = list(poll(FixTimer(), [5.0 + PERIOD * k for k in range(500)], random.Random(0)))
    assert max(map(abs, errors)) < 0.004
    assert max(map(abs, errors[50:])) < 0.0015


@pytest.mark.parametrize("skew", [5e-4, -5e-4])
def test_the_grid_follows_a_network_clock_that_drifts(skew):
    errors = list(poll(FixTimer(), [5.0 + PERIOD * (1 + skew) * k for k in range(1000)], random.Random(1)))
    assert max(map(abs, errors)) < 0.004


def test_a_fix_announced_late_is_stamped_with_its_slot():
    late = lambda k: 0.009 if k % 7 == 3 else 0.0  # noqa: E731
    errors = list(poll(FixTimer(), [5.0 + PERIOD * k for k in range(300)], random.Random(2), late))
    assert max(map(abs, errors[20:])) < 0.003


@pytest.mark.parametrize("shift", [0.03, -0.03])
def test_a_slot_that_moves_is_followed(shift):
    times = [5.0 + PERIOD * k + (shift if k >= 100 else 0.0) for k in range(200)]
    errors = list(poll(FixTimer(), times, random.Random(3)))
    assert max(map(abs, errors)) < 0.006
    assert max(map(abs, errors[150:])) < 0.002


def test_rounds_that_are_missing_change_nothing():
    rng = random.Random(4)
    times = [5.0 + PERIOD * k for k in range(2000) if rng.random() < 0.3]
    errors = list(poll(FixTimer(), times, rng))
    assert max(map(abs, errors)) < 0.004


def test_a_tag_without_a_grid_is_stamped_within_its_bracket():
    rng, time, times = random.Random(5), 5.0, []
    for _ in range(500):
        time += rng.uniform(0.05, 0.4)
        times.append(time)
    errors = list(poll(FixTimer(), times, rng))
    assert sorted(map(abs, errors))[int(0.95 * len(errors))] < 0.016


def test_a_fix_that_waited_for_the_first_poll_has_no_time():
    assert FixTimer().time(None, 5.0, PERIOD) is None


def test_no_stamp_lies_in_the_future():
    rng = random.Random(6)
    timer, now = FixTimer(), 0.0
    for _ in range(5000):
        now += rng.choice([0.002, 0.03, 0.1, 0.5])
        stamp = timer.time(rng.choice([None, now - 0.004, now - 0.2]), now, PERIOD)
        if stamp is not None:
            assert stamp <= now + 0.001
        timer.accept(now if stamp is None else stamp, as_found=rng.random() < 0.8)
