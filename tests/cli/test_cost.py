"""The estimate of time and memory: positive, growing with everything it depends on, from the work itself."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.cli import check, cost
from uwblite.cli.stage_shares import Overall
from uwblite.config import override
from uwblite.errors import Cancelled, DataError
from uwblite.mapping import MappingConfig, Stage
from uwblite.sensor_log import LaserScans, Odometry, SensorLog


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


def begun(monkeypatch, stages, refused=None):
    """Replace the map by stages (name, s) that report ten steps each, on a clock of their own."""
    clock = [0.0]

    def build_map(part, config=None, *, progress):
        for name, seconds in stages:
            for step in range(1, 11):
                clock[0] += seconds / 10
                if progress(Stage(name), step, 10) is False:
                    raise Cancelled("stopped")
        if refused:
            raise DataError(refused)

    monkeypatch.setattr("uwblite.mapping.build_map", build_map)
    monkeypatch.setattr(cost.time, "perf_counter", lambda: clock[0])
    return clock


def usual(seconds, lidar=True):
    """Return the stages of a map of so many seconds that takes what maps usually take in each."""
    shares = Overall(lidar=lidar)._shares
    return [(name, seconds * share / sum(s for _, s in shares)) for name, share in shares]


@pytest.mark.parametrize("lidar", [True, False])
@pytest.mark.parametrize("seconds", [0.5, 30.0, 300.0])
def test_the_time_of_a_usual_map_is_known_after_a_part_of_it(log, monkeypatch, seconds, lidar):
    clock = begun(monkeypatch, usual(seconds, lidar))
    assert cost.expected_seconds(log.without(lidar=not lidar)) == pytest.approx(cost.SECONDS_AT_LEAST + seconds, rel=1e-6)
    longest_step = max(s for _, s in usual(seconds, lidar)) / 10
    assert clock[0] <= min(seconds, cost._TRIAL_SECONDS + longest_step) + 1e-9


def test_a_stage_that_takes_longer_than_usual_makes_the_estimate_longer(log, monkeypatch):
    """Wherever along the recording the difficult part lies: the stages go over all of it."""
    stages = [(name, 4.0 * s if name == "scan-to-scan matching" else s) for name, s in usual(8.0)]
    begun(monkeypatch, stages)
    assert cost.expected_seconds(log) == pytest.approx(sum(s for _, s in stages), rel=0.5)


def test_without_the_lidar_by_the_settings_the_stages_are_those_of_the_radio(log, monkeypatch):
    begun(monkeypatch, usual(30.0, lidar=False))
    config = override(MappingConfig(), ["use_lidar=false"])
    assert cost.expected_seconds(log, config) == pytest.approx(cost.SECONDS_AT_LEAST + 30.0, rel=1e-6)


def test_what_a_map_refuses_costs_what_the_model_expects(log, monkeypatch):
    begun(monkeypatch, [("keyframes", 0.1)], refused="nothing")
    assert cost.expected_seconds(log) == cost.model_seconds(log)


@pytest.mark.parametrize("slow", [0.2, 30.0])
def test_check_expects_what_its_own_trial_map_took(log, monkeypatch, slow):
    """The work itself, the whole of it: no part that happens to be easy is taken for the rest."""
    clock = [0.0]

    def build_map(part, config):
        clock[0] += slow
        return SimpleNamespace(anchors=(), calibration=(), doubts=())

    monkeypatch.setattr("uwblite.mapping.build_map", build_map)
    monkeypatch.setattr(check.time, "perf_counter", lambda: clock[0])
    _, seconds = check.examined(log, check.screened(log), clock[0])
    assert seconds == pytest.approx(cost.SECONDS_AT_LEAST + slow)
    assert check.expected_cost(log, seconds)["seconds"] == pytest.approx(seconds, abs=0.05)
    assert clock[0] == slow


def test_the_map_is_as_large_as_what_was_seen(log):
    """A robot turns by a quarter on the spot and sees 1 m to its right, nothing ahead, 2 m to its left."""
    odometry = Odometry(np.array([0.0, 1.0]), np.array([[5.0, 5.0, 0.0], [5.0, 5.0, np.pi / 2]]))
    ranges = np.tile(np.array([1.0, np.inf, 2.0], dtype=np.float32), (2, 1))
    scans = LaserScans(np.array([0.0, 1.0]), ranges, -np.pi / 2, np.pi / 2, 0.0, 0.1, 5.0)
    assert cost.seen_size(SensorLog(odometry, scans=scans)) == pytest.approx([3.0, 3.0])
    assert np.array_equal(cost.seen_size(log.without(lidar=True)), np.ptp(log.odometry.poses[:, :2], axis=0))
