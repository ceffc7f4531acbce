"""Shares of the beams by a count, and from where on something is said of units, beams, turns and clocks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.arrays import MAD_TO_SIGMA, MEDIAN_TO_MEAN
from uwblite.checks import lidar
from uwblite.checks.findings import Findings
from uwblite.checks.lidar import check_scans
from uwblite.lidar.laser_mounting import Turning
from uwblite.screening import wheel_motion
from uwblite.screening.wheel_motion import Pairs
from uwblite.sensor_log import LaserScans, Odometry, SensorLog


def checked(ranges, **options):
    """Check scans (n, beams); return the figures, and what is found of them."""
    scans = replace(LaserScans(0.1 * np.arange(len(ranges)), ranges.astype(np.float32), -1.0, 0.05, 0.0, 0.1, 5.0), **options)
    found = Findings()
    return check_scans(SensorLog(Odometry(np.zeros(1), np.zeros((1, 3))), None, scans), found), found.ranked()


def test_shares_are_counts_of_beams():
    """Below the shortest range, at both ends of what is measured, beyond it, nothing, an error."""
    row = [0.05, 0.1, 5.0, 5.5, np.inf, np.nan, 2.0, 3.0]
    figures, found = checked(np.tile(row, (10, 1)))
    assert figures["share of beams that hit"] == 0.5
    assert figures["share that saw nothing"] == figures["share that is invalid"] == 0.125
    assert (figures["beams"], figures["field of view deg"], figures["range max m"]) == (8, round(np.degrees(0.35), 1), 5.0)
    assert found == ()


@pytest.mark.parametrize(("longest", "small"), [(0.049, True), (0.051, False)])
def test_readings_of_some_centimetres_have_another_unit(longest, small):
    ranges = np.tile(np.linspace(0.5, 1.0, 20) * longest, (10, 1))
    ranges[:, 0] = 0.94 * longest
    _, found = checked(np.where(ranges > 0.96 * longest, longest, ranges), range_min=0.001)
    assert ["check the unit" in f.advice for f in found] == ([True] if small else [])


@pytest.mark.parametrize(("hit", "rank"), [(9, "warning"), (10, None)])
def test_a_lidar_that_reaches_no_wall_is_named(hit, rank):
    ranges = np.full((10, 100), np.inf)
    ranges[:, :hit] = np.linspace(1.0, 2.0, hit)
    _, found = checked(ranges)
    assert [f.rank for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("errors", "said"), [(40, False), (41, True)])
def test_many_error_codes_are_noted(errors, said):
    ranges = np.tile(np.linspace(1.0, 2.0, 100), (10, 1))
    ranges[:, :errors] = np.nan
    assert ["error codes" in f.what for f in checked(ranges)[1]] == ([True] if said else [])


def turned(monkeypatch, pairs=None, **values):
    """Return the figures and findings of a comparison of turns that came out so, and of motions between scans."""
    plain = Turning(
        pairs=40, typical=0.3, as_given=0.01, other=0.5, misfit=0.01, delay=0.0, delay_clear=True, ratio=1.0, ratio_sigma=0.01
    )
    turning = replace(plain, **values)
    monkeypatch.setattr(lidar, "compare", lambda log: turning)
    monkeypatch.setattr(wheel_motion, "compare", lambda log: pairs)
    found = Findings()
    figures = lidar._check_turning(SimpleNamespace(), found)
    return figures, [(f.topic, f.what) for f in found.ranked()]


def motions(ratio, sigma, count=40):
    """Return turns by wheels of 0.3 rad, and by the lidar a factor of them whose median has a standard deviation."""
    off = sigma * np.sqrt(count) / (MEDIAN_TO_MEAN * MAD_TO_SIGMA)
    turn = np.full(count, 0.3)
    by_lidar = turn * (ratio + off * np.tile([1.0, -1.0], count // 2))
    rows = [np.column_stack([np.zeros((count, 2)), each]) for each in (by_lidar, turn)]
    return Pairs(np.arange(count) * 1.0, np.arange(count) + 0.5, *rows, np.ones(count))


@pytest.mark.parametrize(("delay", "clear", "said"), [
    (0.07, True, "0.07 s too early"), (-0.07, True, "0.07 s too late"), (0.06, True, ""), (0.2, False, ""),
])  # fmt: skip
def test_a_clear_delay_of_the_laser_is_named(monkeypatch, delay, clear, said):
    figures, found = turned(monkeypatch, delay=delay, delay_clear=clear)
    assert figures["laser_delay s"] == delay
    assert [said in what for _, what in found] == ([True] if said else [])


@pytest.mark.parametrize(("ratio", "sigma", "said"), [
    (1.14, 0.001, True), (0.87, 0.001, True), (1.11, 0.001, False), (1.2, 0.06, False), (float("nan"), 0.01, False),
])  # fmt: skip
def test_wheels_that_turn_by_another_factor_are_named(monkeypatch, ratio, sigma, said):
    """By more than 0.12 and four standard deviations."""
    pairs = motions(ratio, sigma) if np.isfinite(ratio) else None
    figures, found = turned(monkeypatch, pairs)
    assert [(topic, "times the turns of the laser" in what) for topic, what in found] == ([("odometry", True)] if said else [])
    assert ("turn by laser / turn by wheels" in figures) is bool(np.isfinite(ratio))


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
    found = Findings()
    figures = check_scans(SensorLog(Odometry(t, poses), None, laser), found)
    assert not [f for f in found.ranked() if f.topic == "odometry"]
    assert figures["turning"].get("turn by laser / turn by wheels", 1.0) == pytest.approx(1.0, abs=0.03)
