"""Wheels that counted nothing: what stands in for them, and how the rest of the odometry goes on."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.screening import wheel_motion
from uwblite.screening.wheel_motion import _smooth_steps, replaced
from uwblite.sensor_log import LaserScans, Odometry, SensorLog

STILL = (20.0, 30.0)
"""When the wheels count nothing, s."""


def driven(until=60.0):
    stamps = np.arange(0.0, until, 0.05)
    return stamps, se2.chain(np.array([1.0, 2.0, 0.3]), np.tile([0.01, 0.0, 0.004], (len(stamps) - 1, 1)))


def log_of(period=0.1, first=-1.0):
    """Return the recording of a robot whose wheels stood still meanwhile, and its true poses."""
    stamps, truth = driven()
    steps = se2.between(truth[:-1], truth[1:])
    steps[(stamps[1:] > STILL[0]) & (stamps[1:] <= STILL[1])] = 0.0
    scans = np.arange(first, 61.0, period)
    readings = np.ones((len(scans), 4), dtype=np.float32)
    return SensorLog(
        Odometry(stamps, se2.chain(truth[0], steps)), None, LaserScans(scans, readings, 0.0, 0.1, 0.0, 0.1, 9.0)
    ), truth


@pytest.fixture
def exact_scans(monkeypatch):
    """Scans show the true motion exactly, but for two pairs that do not match."""
    stamps, truth = driven()

    def steps(scans, mounting, first, second, guess, searches=0):
        at = [se2.interpolate_trajectory(stamps, truth, scans.middles[k]) for k in (first, second)]
        return se2.between(*at), np.where(np.isin(np.arange(len(first)), [5, 6]), 0.4, 0.9)

    monkeypatch.setattr(wheel_motion, "scan_steps", steps)


@pytest.mark.usefixtures("exact_scans")
@pytest.mark.parametrize("period", [0.1, 0.2, 0.7])
def test_the_motion_of_scans_stands_in_and_the_rest_moves_along(period):
    log, truth = log_of(period)
    done, breaks = replaced(log, [STILL])
    np.testing.assert_array_equal(done.stamps, log.odometry.stamps)
    before, after = done.stamps <= STILL[0] - 2.0 * period, done.stamps >= STILL[1] + 1.5 * period
    np.testing.assert_array_equal(done.poses[before], log.odometry.poses[before])
    # A chord instead of an arc between scans, and the odometry's own count at the edges: some millimetres.
    off = se2.between(truth, done.poses)
    assert np.abs(off[:, :2]).max() < 0.2 * period + 0.01
    assert np.abs(off[:, 2]).max() < 0.1 * period
    own = log.odometry.poses
    np.testing.assert_allclose(
        se2.between(done.poses[after][:-1], done.poses[after][1:]), se2.between(own[after][:-1], own[after][1:]), atol=1e-9
    )
    # Scans a quarter of a second apart or one by one; their steps begin before the stretch and end behind it.
    apart = max(round(0.25 / period), 1) * period
    assert len(breaks.stamps) == pytest.approx(10.0 / apart, abs=2)
    assert STILL[0] - 0.25 - period <= breaks.stamps[0] <= STILL[0] + apart
    assert np.all(np.diff(breaks.stamps) > 0.0)
    np.testing.assert_allclose(breaks.sigma[[5, 6]], 0.3)
    np.testing.assert_allclose(np.delete(breaks.sigma, [5, 6], axis=0), [[0.02, 0.02, 0.01]] * (len(breaks.stamps) - 2))


@pytest.mark.usefixtures("exact_scans")
def test_several_stretches_are_replaced_one_after_the_other_and_none_without_scans():
    log, _ = log_of()
    both, breaks = replaced(log, [(20.0, 24.0), (26.0, 30.0)])
    one, first = replaced(log, [(20.0, 24.0)])
    again, second = replaced(SensorLog(one, None, log.scans), [(26.0, 30.0)])
    np.testing.assert_array_equal(both.poses, again.poses)
    np.testing.assert_array_equal(breaks.stamps, np.concatenate([first.stamps, second.stamps]))
    late, _ = log_of(first=59.95)
    unchanged, nothing = replaced(late, [(20.0, 30.0)])
    assert unchanged is late.odometry
    assert len(nothing.stamps) == 0
    assert replaced(log, [])[0] is log.odometry


def test_steps_that_scans_do_not_show_go_on_as_before_and_after(monkeypatch):
    """Measured from rest and again from the median of seven; too long or unmatched ones are that median."""
    usual = np.tile([0.1, 0.0, 0.02], (12, 1))
    one, share = usual.copy(), np.full(12, 0.8)
    one[3], share[3] = [5.0, 0.0, 0.0], 0.9
    one[6], share[6] = [0.0, 0.3, 0.0], 0.29
    one[8], share[8] = [0.0, 0.2, 0.0], 0.8
    one[10], share[10] = [0.0, 0.4, 0.0], 0.5
    other, better = usual + np.array([0.0, 0.0, 0.001]), np.full(12, 0.78)
    better[[3, 6, 8, 10]] = 0.2, 0.2, 0.76, 0.75
    guesses, answers = [], iter([(one, share), (other, better)])

    def steps(scans, mounting, first, second, guess, searches=0):
        guesses.append(guess)
        return next(answers)

    monkeypatch.setattr(wheel_motion, "scan_steps", steps)
    log, _ = log_of()
    found, matched = _smooth_steps(log, np.arange(13))
    np.testing.assert_array_equal(guesses[0], 0.0)
    np.testing.assert_allclose(guesses[1], usual)
    expected = other.copy()
    expected[[3, 6]] = usual[[3, 6]]
    expected[8] = one[8]
    np.testing.assert_allclose(found, expected)
    assert np.flatnonzero(~matched).tolist() == [3, 6]
