"""Stamps that are times of measurement, and those of receipt in bursts."""

import numpy as np
import pytest

from uwblite.sensor_log import Odometry, in_bursts, odometry_in_bursts


def drive(stamps, speed=lambda t: 0.5 + 0.3 * np.sin(0.5 * t)):
    way = np.concatenate([[0.0], np.cumsum(speed(stamps[1:]) * np.diff(stamps))])
    return Odometry(stamps, np.column_stack([way, np.zeros((len(way), 2))]))


def received(stamps, period):
    """Return when messages arrive whose queue is emptied every so often, a millisecond apart."""
    rounds = np.ceil(stamps / period)
    order = np.arange(len(stamps)) - np.searchsorted(rounds, rounds)
    return rounds * period + 0.001 * order


EVEN = 0.1 * np.arange(600)


@pytest.mark.parametrize("jitter", [0.0, 0.01, 0.03])
def test_stamps_with_jitter_below_their_period_are_times(jitter):
    stamps = np.sort(EVEN + np.random.default_rng(1).normal(scale=jitter, size=600))
    assert not in_bursts(stamps)
    log = drive(EVEN)
    assert not odometry_in_bursts(Odometry(stamps, log.poses))


@pytest.mark.parametrize("period", [0.35, 0.6, 0.9])
def test_stamps_of_receipt_in_bursts_are_none(period):
    assert in_bursts(received(EVEN, period))
    assert odometry_in_bursts(Odometry(received(EVEN, period), drive(EVEN).poses))


def test_a_log_thinned_by_motion_has_times():
    """A reading every 0.2 m, at speeds from 0.2 to 0.8 m/s, and stands of a minute."""
    log = drive(np.arange(0.0, 600.0, 0.01))
    own = np.unique(np.searchsorted(log.poses[:, 0], np.arange(0.0, log.poses[-1, 0], 0.05)))
    stamps = log.stamps[own] + 60.0 * (log.stamps[own] // 100.0)
    assert not in_bursts(stamps)
    assert not odometry_in_bursts(Odometry(stamps, log.poses[own]))


def test_readings_of_a_robot_that_stands_and_a_few_of_any_show_nothing():
    assert not odometry_in_bursts(Odometry(received(EVEN, 0.6), np.zeros((600, 3))))
    assert not in_bursts(np.array([0.0, 0.001, 0.9, 0.901]))
    assert not in_bursts(np.zeros(100) + np.arange(100) * 5.0)
    # All at one time: each is expected no time after the other.
    assert not in_bursts(np.zeros(100))


def test_steps_of_a_robot_that_stands_are_none_of_a_burst():
    """It drives for 2 s and stands for 4 s in turn, and is told of evenly."""
    way = np.cumsum(np.where(np.arange(600) % 60 < 20, 0.05, 0.0))
    assert not in_bursts(EVEN, way)


def test_a_robot_that_jerks_has_times():
    """Steps of nothing and of four times the usual way, stamped evenly."""
    way = np.cumsum(np.where(np.random.default_rng(4).random(600) < 0.25, 0.2, 0.001))
    assert in_bursts(EVEN, way)
    assert not odometry_in_bursts(Odometry(EVEN, np.column_stack([way, np.zeros((600, 2))])))
