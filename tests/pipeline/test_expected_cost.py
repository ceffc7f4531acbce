"""The estimate of time and memory: positive, growing with everything it depends on, from the work itself."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.cli import check
from uwblite.config import override
from uwblite.grid.occupancy_grid import GridConfig
from uwblite.pipeline import expected_cost as cost
from uwblite.screening.screen import screen
from uwblite.sensor_log import LaserScans, Odometry, SensorLog


def of_length(log, seconds):
    first = log.odometry.stamps[0]
    return log.crop(first, first + seconds)


def work_seconds(log):
    return cost.model_seconds(log) - cost.SECONDS_AT_LEAST


def test_work_grows_with_path_ranges_and_readings(log):
    whole, half = work_seconds(log), work_seconds(of_length(log, 120.0))
    assert 0 < half < whole
    assert work_seconds(log.without(uwb=True)) < whole
    assert work_seconds(log.without(lidar=True)) < 0.5 * whole
    longer = dataclasses.replace(log.odometry, poses=log.odometry.poses * (2.0, 2.0, 1.0))
    assert work_seconds(dataclasses.replace(log, odometry=longer)) > whole


@pytest.mark.parametrize("place", range(4))
def test_memory_grows_with_path_scans_beams_and_cells(place):
    few, many = [100.0, 5000, 682, 2_000_000], [100.0, 5000, 682, 2_000_000]
    many[place] *= 2
    assert 50 < cost.expected_megabytes(*few) < cost.expected_megabytes(*many)


def test_without_lidar_it_takes_less_memory():
    assert cost.expected_megabytes(300.0, 0, 0, 0) < cost.expected_megabytes(300.0, 9000, 682, 300_000) - 40


@pytest.mark.parametrize("slow", [0.2, 30.0])
def test_check_expects_what_its_own_trial_map_took(log, monkeypatch, slow):
    """The work itself, the whole of it: no part that happens to be easy is taken for the rest."""
    log, clock = of_length(log, 20.0), [0.0]

    def build_map(part, config):
        clock[0] += slow
        return SimpleNamespace(anchors=(), calibration=(), doubts=(), findings=())

    monkeypatch.setattr("uwblite.mapping.build_map", build_map)
    monkeypatch.setattr(check.time, "perf_counter", lambda: clock[0])
    _, seconds = check.examined(log, screen(log), clock[0])
    assert seconds == pytest.approx(cost.SECONDS_AT_LEAST + slow)
    assert clock[0] == slow


def test_the_map_is_as_large_as_what_was_seen(log):
    """A robot turns by a quarter on the spot and sees 1 m to its right, nothing ahead, 2 m to its left."""
    odometry = Odometry(np.array([0.0, 1.0]), np.array([[5.0, 5.0, 0.0], [5.0, 5.0, np.pi / 2]]))
    ranges = np.tile(np.array([1.0, np.inf, 2.0], dtype=np.float32), (2, 1))
    scans = LaserScans(np.array([0.0, 1.0]), ranges, -np.pi / 2, np.pi / 2, 0.0, 0.1, 5.0)
    assert cost.seen_size(SensorLog(odometry, scans=scans)) == pytest.approx([3.0, 3.0])
    assert np.array_equal(cost.seen_size(log.without(lidar=True)), np.ptp(log.odometry.poses[:, :2], axis=0))


def test_a_larger_grid_than_is_allowed_costs_what_is_allowed(log):
    few = cost.expected_cost(log, override(GridConfig(), ["resolution=0.001", "max_cells=10000"]))
    assert few["map cells"] == 10_000
    many = cost.expected_cost(log, override(GridConfig(), ["resolution=0.001"]))
    assert many["megabytes"] > few["megabytes"] + 100
    assert few["map width m"] == cost.expected_cost(log)["map width m"] > 5.0
    assert cost.expected_cost(log.without(lidar=True))["map cells"] == 0
