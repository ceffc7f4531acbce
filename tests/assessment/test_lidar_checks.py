"""Shares of the beams by a count, and from where on something is said of units, beams, turns and clocks."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.assessment.lidar_figures import check_lidar, check_turning, lidar_figures, turning_figures
from uwblite.lidar.laser_mounting import Turning
from uwblite.screening.screen import screen
from uwblite.sensor_log import LaserScans, Odometry, SensorLog


def checked(ranges, **options):
    """Check scans (n, beams); return the figures, and what is found of them."""
    scans = replace(LaserScans(0.1 * np.arange(len(ranges)), ranges.astype(np.float32), -1.0, 0.05, 0.0, 0.1, 5.0), **options)
    figures = lidar_figures(SensorLog(Odometry(np.zeros(1), np.zeros((1, 3))), None, scans))
    return figures, list(check_lidar(figures))


def test_shares_are_counts_of_beams():
    """Below the shortest range, at both ends of what is measured, beyond it, nothing, an error."""
    row = [0.05, 0.1, 5.0, 5.5, np.inf, np.nan, 2.0, 3.0]
    figures, found = checked(np.tile(row, (10, 1)))
    assert figures["share of beams that hit"] == 0.5
    assert figures["share that saw nothing"] == figures["share that is invalid"] == 0.125
    assert (figures["beams"], figures["field of view deg"], figures["range max m"]) == (8, round(np.degrees(0.35), 1), 5.0)
    assert found == []


@pytest.mark.parametrize(("hit", "rank"), [(9, "warning"), (10, None)])
def test_a_lidar_that_reaches_no_wall_is_named(hit, rank):
    ranges = np.full((10, 100), np.inf)
    ranges[:, :hit] = np.linspace(1.0, 2.0, hit)
    _, found = checked(ranges)
    assert [f.severity for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("errors", "said"), [(40, False), (41, True)])
def test_many_error_codes_are_noted(errors, said):
    ranges = np.tile(np.linspace(1.0, 2.0, 100), (10, 1))
    ranges[:, :errors] = np.nan
    assert ["error codes" in f.text for f in checked(ranges)[1]] == ([True] if said else [])


def turned(ratio=(1.0, 0.01), **values):
    """Return sensor and text of the findings of a comparison of turns that came out so."""
    plain = Turning(
        pairs=40, typical=0.3, as_given=0.01, other=0.5, misfit=0.01, delay=0.0, delay_clear=True, ratio=1.0
    )
    return [(f.sensor, f.text) for f in check_turning(replace(plain, **values), ratio)]


@pytest.mark.parametrize(("delay", "clear", "said"), [
    (0.07, True, "0.07 s too early"), (-0.07, True, "0.07 s too late"), (0.06, True, ""), (0.2, False, ""),
])  # fmt: skip
def test_a_clear_delay_of_the_laser_is_named(delay, clear, said):
    assert [said in text for _, text in turned(delay=delay, delay_clear=clear)] == ([True] if said else [])


@pytest.mark.parametrize(("ratio", "sigma", "said"), [
    (1.14, 0.001, True), (0.87, 0.001, True), (1.11, 0.001, False), (1.2, 0.06, False), (float("nan"), 0.01, False),
])  # fmt: skip
def test_wheels_that_turn_by_another_factor_are_named(ratio, sigma, said):
    """By more than 0.12 and four standard deviations."""
    found = [(sensor, "times the turns of the laser" in text) for sensor, text in turned((ratio, sigma))]
    assert found == ([("odometry", True)] if said else [])


def test_turns_that_nothing_shows_are_noted():
    assert [f.kind for f in check_turning(None, (1.0, 0.1))] == ["no-turns"]
    assert [text.startswith("laser and wheels disagree") for _, text in turned(misfit=0.2)] == [True]


def room_scan(pose, beams, width=6.0, depth=4.0):
    """Return readings of a lidar that turns once in a bare room about the origin, m."""
    angles = pose[2] - np.pi + 2 * np.pi / beams * np.arange(beams)
    axes = ((np.cos(angles) + 1e-12, width / 2, pose[0]), (np.sin(angles) + 1e-12, depth / 2, pose[1]))
    return np.minimum(*((np.sign(way) * half - place) / way for way, half, place in axes))


@pytest.mark.parametrize("beams", [90, 360])
def test_faultless_wheels_turn_as_the_laser_does_whatever_it_resolves(beams):
    """On a circle a coarse laser's shifts of beams follow the walls that pass by, and not the turn."""
    t = 0.05 * np.arange(600)
    turn = 0.36 * t
    poses = np.column_stack([0.8 * np.sin(turn), -0.8 * np.cos(turn), turn])
    scans = np.array([room_scan(pose, beams) for pose in poses[::4]])
    scans += np.random.default_rng(3).normal(0.0, 0.01, scans.shape)
    laser = LaserScans(t[::4], scans.astype(np.float32), -np.pi, 2 * np.pi / beams, 0.0, 0.05, 12.0)
    log = SensorLog(Odometry(t, poses), None, laser)
    ratio = screen(log).screening.turn_ratio
    figures, turning = turning_figures(log, ratio)
    assert not [f for f in check_turning(turning, ratio) if f.sensor == "odometry"]
    assert figures.get("turn by laser / turn by wheels", 1.0) == pytest.approx(1.0, abs=0.03)
