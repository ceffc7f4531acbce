"""A sensor's clock against the odometry's."""

import numpy as np
import pytest

from uwblite.clocks.sensor_clock import SensorClock

PERIOD = 0.2


def times(stamps, nows, silences=None):
    """Return the times (n,) of measurements, nan where they were never used, and how many more had come when each was used."""
    clock, found, late = SensorClock(lambda t: t), np.full(len(stamps), np.nan), np.zeros(len(stamps), int)
    leapt = np.zeros(len(nows), int) if silences is None else silences
    for k, stamp in enumerate(stamps):
        for at, which in clock.take(float(stamp), float(nows[k]), int(leapt[k]), k):
            found[which], late[which] = at, k - which
    return found, late


@pytest.mark.parametrize("jump", [-100.0, -3.0, 1.5, 3600.0])
@pytest.mark.parametrize("usual", [-0.3, 0.0, 1.0])
def test_a_sensors_clock_that_jumps_is_put_right(jump, usual):
    now = 50.0 + PERIOD * np.arange(60)
    true = now + usual
    stamps = np.where(np.arange(60) < 30, true, true + jump)
    found, late = times(stamps, now)
    np.testing.assert_allclose(found, true, atol=1e-9)
    assert late.max() == 3
    assert np.flatnonzero(late).tolist() == [30, 31, 32]


@pytest.mark.parametrize("jump", [3.0, 100.0])
def test_where_the_odometrys_clock_jumps_the_sensor_follows(jump):
    after = np.arange(60) >= 30
    now = 50.0 + PERIOD * np.arange(60) + jump * after
    found, _ = times(now - jump * after, now, after.astype(int))
    np.testing.assert_allclose(found, now, atol=1e-9)


def test_a_stamp_that_is_off_alone_is_no_clock_that_jumped():
    now = 50.0 + PERIOD * np.arange(60)
    stamps = now + np.where(np.isin(np.arange(60), (30, 40)), 500.0, 0.0)
    found, late = times(stamps, now)
    np.testing.assert_allclose(found, stamps)
    assert late.max() == 1


def test_messages_that_come_late_keep_their_times():
    """A link that stands still for two seconds, and one that is slower from then on."""
    measured = 50.0 + PERIOD * np.arange(60)
    standing = (measured > 54) & (measured < 56)
    for come in (np.where(standing, 56.0, measured), np.where(measured > 56, measured + 1.0, measured)):
        found, late = times(measured, come)
        np.testing.assert_array_equal(found, measured)
        assert not late.any()


def test_an_odometry_that_was_silent_moves_no_clock():
    stamps = 50.0 + PERIOD * np.arange(60)
    silent = (stamps > 54) & (stamps < 58)
    now = np.where(silent, 54.0, stamps)
    found, late = times(stamps, now, (stamps >= 58).astype(int))
    np.testing.assert_array_equal(found, stamps)
    assert not late.any()


def test_all_that_was_silent_goes_on_with_its_own_times():
    stamps = 50.0 + PERIOD * np.arange(60) + 20.0 * (np.arange(60) >= 30)
    now = stamps.copy()
    now[30] = now[29]  # the odometry's first stamp after that waits for the second
    found, late = times(stamps, now, (np.arange(60) >= 31).astype(int))
    np.testing.assert_array_equal(found, stamps)
    assert late.max() == 1


def test_sensors_alone_are_held_back_for_half_a_second():
    """After a minute in which nothing came the odometry stays away: what the sensor measures is used."""
    stamps = np.concatenate([50.0 + PERIOD * np.arange(20), 114.0 + PERIOD * np.arange(20)])
    found, late = times(stamps, np.minimum(stamps, 54.0))
    np.testing.assert_array_equal(found, stamps)
    assert late.max() <= 3
