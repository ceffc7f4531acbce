"""Shares of the beams by a count, and from where on something is said of units, beams, turns and clocks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.checks import lidar
from uwblite.checks.findings import Findings
from uwblite.checks.lidar import check_scans
from uwblite.lidar.laser_mounting import Turning
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


def turned(monkeypatch, **values):
    """Return the figures and findings of a comparison of turns that came out so."""
    plain = Turning(
        pairs=40, typical=0.3, as_given=0.01, other=0.5, misfit=0.01, delay=0.0, delay_clear=True, ratio=1.0, ratio_sigma=0.01
    )
    turning = replace(plain, **values)
    monkeypatch.setattr(lidar, "compare", lambda log: turning)
    found = Findings()
    figures = lidar._check_turning(SimpleNamespace(), found)
    return figures, [(f.topic, f.what) for f in found.ranked()]


@pytest.mark.parametrize(("delay", "clear", "said"), [
    (0.07, True, "0.07 s too early"), (-0.07, True, "0.07 s too late"), (0.06, True, ""), (0.2, False, ""),
])  # fmt: skip
def test_a_clear_delay_of_the_laser_is_named(monkeypatch, delay, clear, said):
    figures, found = turned(monkeypatch, delay=delay, delay_clear=clear)
    assert figures["laser_delay s"] == delay
    assert [said in what for _, what in found] == ([True] if said else [])


@pytest.mark.parametrize(("ratio", "sigma", "said"), [
    (1.13, 0.01, True), (0.87, 0.01, True), (1.11, 0.01, False), (1.2, 0.051, False), (float("nan"), 0.01, False),
])  # fmt: skip
def test_wheels_that_turn_by_another_factor_are_named(monkeypatch, ratio, sigma, said):
    """By more than 0.12 and four standard deviations."""
    figures, found = turned(monkeypatch, ratio=ratio, ratio_sigma=sigma)
    named = [(topic, f"about {1.0 / ratio:.2f} times" in what) for topic, what in found]
    assert named == ([("odometry", True)] if said else [])
    assert ("turn by laser / turn by wheels" in figures) is bool(np.isfinite(ratio))
