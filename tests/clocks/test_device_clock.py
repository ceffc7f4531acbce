"""Counters that wrap, and the lower envelope."""

import random

import pytest

from uwblite.clocks.clock_map import MAX_SKEW, ClockMap
from uwblite.clocks.device_clock import WITNESSES, DeviceClock, Unwrapper


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


def test_unwrap_reports_that_the_counter_was_reset():
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


def test_map_does_not_accept_an_impossible_crystal():
    clock = ClockMap()
    for k in range(300):
        clock.add(0.1 * k, 0.1 * k * 1.05)
    assert abs(clock.skew) <= MAX_SKEW


def test_map_keeps_a_bounded_number_of_points():
    clock = ClockMap(window=10.0, bucket=1.0)
    for k in range(10000):
        clock.add(0.1 * k, 0.1 * k + 1.0)
    assert len(clock._minima) == 10


def test_a_reset_keeps_the_latency_that_was_measured():
    """The counter begins again at 60 s; frames arrive 101 ms and a random millisecond after their stamp."""
    rng, clock = random.Random(1), DeviceClock(1e-3, 1 << 24, period=0.1, latency=0.066)
    for k in range(8):
        sent = 5.0 + 0.01 * k
        clock.tie(1000 * sent + 1.5, sent, sent + 0.003)
    errors, resets = [], 0
    for k in range(1200):
        true = 10.0 + 0.1 * k
        count = 1000 * true if true < 60 else 1000 * (true - 60) + 7
        reading = clock.read(count, true + 0.101 + rng.expovariate(1000))
        resets += reading.reset
        errors.append(reading.stamp - true)
    assert resets == 1
    assert clock.latency == pytest.approx(0.101, abs=0.0005)
    assert max(map(abs, errors[100:])) < 0.003


@pytest.mark.parametrize("uptime", [1.2, 2.0, 30.0])
def test_a_clock_that_is_read_after_a_replug_is_tied_again_however_short_it_ran(uptime):
    """The unit counts from 0 again after a second without power, so that its clock steps back by little or much."""
    clock = DeviceClock(1e-3, 1 << 24, period=0.1, latency=0.066)
    for zero in (100.0, 101.0 + uptime):
        for k in range(8):
            sent = zero + 0.6 + 0.01 * k
            clock.tie(1000 * (sent + 0.001 - zero), sent, sent + 0.002)
        for k in range(10, round(10 * uptime)):
            true = zero + 0.1 * k
            assert clock.read(100 * k, true + 0.101).stamp == pytest.approx(true, abs=0.002)


@pytest.mark.parametrize("ahead", [0.3, 3.0, 40.0])
def test_a_clock_that_leaps_ahead_is_of_another_power_up(ahead):
    """No frame comes before it is made, so the delay that was measured stays, and nothing was lost."""
    clock, errors, resets, missing = DeviceClock(1e-3, 1 << 24, period=0.1), [], 0, 0
    clock.tie(5000.5, 5.0, 5.001)
    for k in range(600):
        true = 10.0 + 0.1 * k
        reading = clock.read(1000 * (true + ahead * (k >= 300)), true + 0.101)
        resets, missing = resets + reading.reset, missing + reading.missing
        errors.append(reading.stamp - true)
    assert (resets, missing) == (1, 0)
    assert max(map(abs, errors)) < 0.002


def test_frames_that_are_missing_are_counted_across_a_reset_and_with_a_learned_period():
    for period in (0.05, None):
        clock = DeviceClock(1e-3, 1 << 16, period=period)
        missing = []
        for k in (*range(40), *range(43, 60), *range(100, 120)):
            count = 50 * k if k < 100 else 50 * (k - 100)
            missing.append(clock.read(count % 65536, 0.05 * k).missing)
        assert [m for m in missing if m] == [3, 40]


@pytest.mark.parametrize(
    ("unit", "rate"), [(1e-3, 1e-3), (1e-6, 1e-6), (1.0, 1.0), (60.0, 60.0), (1000.0, 1000.0), (1e6, None)]
)
def test_a_clock_with_a_wrong_unit_is_noticed_and_arrivals_are_used(unit, rate):
    """A base counts seconds; its stated unit is wrong by a factor."""
    clock = DeviceClock(unit, proven=False)
    readings = [(0.02 * k, clock.read(0.02 * k, 50 + 0.02 * k + 0.003 * (k % 2))) for k in range(600)]
    assert max(abs(reading.stamp - 50 - time) for time, reading in readings) < 0.004
    if rate == 1.0:
        assert clock.rate is None
        assert clock.proven
        assert max(abs(reading.stamp - 50 - time) for time, reading in readings[300:]) < 1e-6
    elif rate:
        assert clock.rate == pytest.approx(rate, rel=0.01, abs=1e-4)
    else:
        assert clock.rate is not None


def test_a_clock_is_accepted_through_a_stall_of_the_host():
    clock = DeviceClock(1.0, proven=False)
    for k in range(1000):
        time = 0.02 * k
        clock.read(time, 50 + (time if not 7 < time < 12 else 12))
    assert clock.rate is None


def test_a_stamp_is_known_to_the_tie_half_a_count_and_twice_what_the_quickest_frames_scatter_by():
    rng, clock, alone, tick = random.Random(3), DeviceClock(1e-3), ClockMap(), 1e-3
    for k in range(400):
        arrival = 100.0 + 0.1 * k + rng.expovariate(50.0)
        reading = clock.read(100 * k, arrival)
        alone.add(0.1 * k, arrival)
    assert alone.excess > 5e-4
    assert reading.spread == pytest.approx(clock.tied + 0.5 * tick + 2.0 * alone.excess)
    assert abs(reading.stamp - 100.0 - 0.1 * 399) < reading.spread


def test_a_wrong_pace_is_believed_when_it_is_seen_several_times_in_a_row():
    """Between right ones it is the host that stood still."""
    clock = DeviceClock(1.0, proven=False)
    for _ in range(5):
        for rate in (*[1.5] * (WITNESSES - 1), 1.0):
            clock._judge(rate)
            assert clock.rate is None
    assert clock.proven
    for seen in range(1, WITNESSES + 1):
        clock._judge(1.5)
        assert (clock.rate == 1.5) is (seen == WITNESSES)
    clock._judge(1.0)
    assert clock.rate is None
