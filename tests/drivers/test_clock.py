"""Counters that wrap, and the lower envelope."""

import random

import pytest

from uwblite.drivers.clock import MAX_SKEW, ClockMap, Unwrapper


@pytest.mark.parametrize(("modulus", "tick"), [(1 << 24, 1e-3), (1 << 16, 1e-3)])
def test_unwrap_follows_a_counter_through_its_wraps(modulus, tick):
    unwrapper = Unwrapper(modulus, tick)
    start, period = modulus - 500, 0.1
    for k in range(3000):
        time = k * period
        seconds, reset = unwrapper.unwrap((start + round(time / tick)) % modulus, 50.0 + time)
        assert not reset
        assert seconds == pytest.approx(start * tick + time)


@pytest.mark.parametrize("turns", [0, 1, 2, 7])
def test_unwrap_counts_turns_missed_in_a_silence(turns):
    unwrapper = Unwrapper(1 << 16, 1e-3)
    unwrapper.unwrap(100, 0.0)
    gap = 20.0 + turns * 65.536
    seconds, reset = unwrapper.unwrap(round(100 + gap * 1000) % 65536, gap + 0.3)
    assert not reset
    assert seconds == pytest.approx(0.1 + gap, abs=2e-3)


def test_unwrap_says_that_the_counter_was_reset():
    unwrapper = Unwrapper(1 << 24, 1e-3)
    unwrapper.unwrap(500_000, 0.0)
    assert unwrapper.unwrap(500_100, 0.1) == (pytest.approx(500.1), False)
    assert unwrapper.unwrap(7, 1.0) == (pytest.approx(0.007), True)
    assert unwrapper.unwrap(107, 1.1) == (pytest.approx(0.107), False)


def test_unwrap_takes_frames_released_in_a_burst():
    """The host was stuck for five seconds and then reads fifty scans at once."""
    unwrapper = Unwrapper(1 << 16, 1e-3)
    unwrapper.unwrap(0, 0.0)
    for k in range(1, 51):
        seconds, reset = unwrapper.unwrap(100 * k, 5.0)
        assert not reset
        assert seconds == pytest.approx(0.1 * k)


@pytest.mark.parametrize("skew", [0.0, 1e-4, -1e-4, 5e-4])
def test_map_finds_offset_and_skew_under_one_sided_delays(skew):
    """Delays are exponential with 3 ms mean: the envelope errs by far less than their mean."""
    rng, clock = random.Random(4), ClockMap()
    errors = []
    for k in range(3000):
        device = 0.1 * k
        true = 7000.0 + device * (1 + skew)
        clock.add(device, true + rng.expovariate(1 / 0.003))
        errors.append(clock.host(device) - true)
    settled = errors[200:]
    assert max(abs(error) for error in settled) < 0.0015
    assert clock.skew == pytest.approx(skew, abs=2e-5)


def test_map_is_not_moved_by_stalls_of_the_host():
    clock = ClockMap()
    for k in range(1200):
        device = 0.1 * k
        clock.add(device, 10.0 + device + (0.8 if k % 100 < 20 else 0.0))
        if k > 100:
            assert clock.host(device) == pytest.approx(10.0 + device, abs=1e-6)


def test_map_does_not_believe_an_impossible_crystal():
    clock = ClockMap()
    for k in range(300):
        clock.add(0.1 * k, 0.1 * k * 1.05)
    assert abs(clock.skew) <= MAX_SKEW


def test_map_keeps_a_bounded_number_of_points():
    clock = ClockMap(window=10.0, bucket=1.0)
    for k in range(10000):
        clock.add(0.1 * k, 0.1 * k + 1.0)
    assert len(clock._minima) == 10
