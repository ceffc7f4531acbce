"""The estimate of time and memory: positive, growing with everything it depends on, scaled by the work itself."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.cli import check, cost
from uwblite.sensor_log import Odometry, SensorLog


def of_length(log, seconds):
    first = log.odometry.stamps[0]
    return log.crop(first, first + seconds)


def test_work_grows_with_path_ranges_and_readings(log):
    whole, half = cost.work_seconds(log), cost.work_seconds(of_length(log, 120.0))
    assert 0 < half < whole
    assert cost.work_seconds(log.without(uwb=True)) < whole
    assert cost.work_seconds(log.without(lidar=True)) < 0.5 * whole
    longer = dataclasses.replace(log.odometry, poses=log.odometry.poses * (2.0, 2.0, 1.0))
    assert cost.work_seconds(dataclasses.replace(log, odometry=longer)) > whole


@pytest.mark.parametrize("place", range(4))
def test_memory_grows_with_path_scans_beams_and_cells(place):
    few, many = [100.0, 5000, 682, 100_000], [100.0, 5000, 682, 100_000]
    many[place] *= 2
    assert 50 < cost.expected_megabytes(*few) < cost.expected_megabytes(*many)


def test_without_lidar_it_takes_less_memory():
    assert cost.expected_megabytes(300.0, 0, 0, 0) < 0.5 * cost.expected_megabytes(300.0, 9000, 682, 300_000)


def test_a_beginning_has_the_work_that_was_asked_for(log):
    for seconds in (0.1, 0.5):
        assert cost.work_seconds(cost.beginning(log, seconds)) == pytest.approx(seconds, rel=0.1)
    short = of_length(log, 5.0)
    assert cost.beginning(short, 10.0) is short


def test_a_robot_that_stands_at_first_is_waited_for(log):
    """The beginning is counted in work, not in time."""
    stamps = np.concatenate([log.odometry.stamps[0] - 600.0 + np.arange(6000) * 0.1, log.odometry.stamps])
    poses = np.concatenate([np.tile(log.odometry.poses[0], (6000, 1)), log.odometry.poses])
    late = dataclasses.replace(log, odometry=Odometry(stamps, poses))
    assert cost.work_seconds(cost.beginning(late, 0.5)) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("slow", [0.2, 1.0, 30.0])
def test_the_estimate_is_that_of_a_computer_whose_time_grows_with_the_work(log, monkeypatch, slow):
    """A map that takes a + b w seconds for work w, and a clock that says so: the estimate is a + b w of the whole."""
    clock, log = [0.0], of_length(log, 40.0)

    def build_map(part):
        clock[0] += 0.1 + slow * cost.work_seconds(part)

    monkeypatch.setattr("uwblite.mapping.build_map", build_map)
    monkeypatch.setattr(cost.time, "perf_counter", lambda: clock[0])
    expected = cost.SECONDS_AT_LEAST + 0.1 + slow * cost.work_seconds(log)
    assert cost.expected_seconds(log) == pytest.approx(expected, rel=1e-6)


def test_what_cannot_be_mapped_costs_as_the_model_reports():
    still = SensorLog(Odometry(np.array([0.0]), np.zeros((1, 3))))
    assert cost.expected_seconds(still) == pytest.approx(cost.SECONDS_AT_LEAST)


@pytest.mark.parametrize("slow", [0.2, 30.0])
def test_check_expects_what_its_own_trial_map_took(log, monkeypatch, slow):
    """The work itself, the whole of it: no part that happens to be easy is taken for the rest."""
    clock = [0.0]

    def build_map(part):
        clock[0] += slow
        return SimpleNamespace(anchors=(), calibration=(), doubts=())

    monkeypatch.setattr("uwblite.mapping.build_map", build_map)
    monkeypatch.setattr(check.time, "perf_counter", lambda: clock[0])
    _, seconds = check.examined(log)
    assert seconds == pytest.approx(cost.SECONDS_AT_LEAST + slow)
    assert check.expected_cost(log, seconds)["seconds"] == pytest.approx(seconds, abs=0.05)
    assert clock[0] == slow
