"""Spikes and coverage against loops; from which share, bias or scale on something is said."""

import numpy as np
import pytest

from uwblite.checks.findings import Findings
from uwblite.checks.odometry import STRAIGHT
from uwblite.checks.radio import FEW, _check_anchor, _check_coverage, _repeats, _spikes, check_calibration, check_ranges
from uwblite.graph.graph import UnknownKey
from uwblite.map_result import AnchorEstimate, CalibrationEstimate
from uwblite.sensor_log import LONGEST_RANGE, Odometry, SensorLog, UwbRanges


@pytest.mark.parametrize("seed", range(3))
def test_spikes_are_those_of_a_loop(seed):
    """Off the median of two neighbours on either side by more than was driven and five times the noise."""
    rng = np.random.default_rng(seed)
    travelled = np.cumsum(rng.uniform(0.0, 0.3, 200))
    values = 5.0 + 0.5 * travelled + rng.normal(0.0, 0.02, 200) + np.where(rng.random(200) < 0.1, rng.uniform(-3, 3, 200), 0.0)
    second = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    noise = 1.4826 * np.median(np.abs(second)) / np.sqrt(1.5)
    expected = 0
    for k in range(2, 198):
        around = np.median([values[k - 2], values[k - 1], values[k + 1], values[k + 2]])
        expected += abs(values[k] - around) > travelled[k + 2] - travelled[k - 2] + 5.0 * max(noise, 0.03)
    found, sigma = _spikes(values, travelled)
    assert found == expected > 5
    assert sigma == pytest.approx(noise, rel=1e-3)


def test_five_readings_are_needed():
    assert _spikes(np.array([1.0, 9.0, 1.0, 9.0]), np.zeros(4)) == (0, 0.0)


def anchor_figures(values, travelled=None, where=None):
    """Check one anchor's readings (n,), taken on a circle; return the figures and the findings."""
    found, count = Findings(), len(values)
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    where = np.column_stack([np.cos(angle), np.sin(angle)]) if where is None else where
    travelled = np.zeros(count) if travelled is None else travelled
    figures = _check_anchor("A1", 0.5 * np.arange(count), np.asarray(values, dtype=np.float64), travelled, where, found)
    return figures, found.ranked()


def test_the_figures_of_an_anchor_are_those_of_its_usable_ranges():
    values = np.tile([2.0, 3.0, 4.0, 3.0], 50)
    values[[7, 9]], values[[50, 120, 180]] = [0.0, 0.02], [-0.03, LONGEST_RANGE, np.inf]
    figures, _ = anchor_figures(values, travelled=10.0 * np.arange(200))
    assert (figures["count"], figures["zeros"], figures["absurd"], figures["spikes"]) == (200, 2, 3, 0)
    assert (figures["nearest m"], figures["farthest m"]) == (2.0, 4.0)
    assert figures["rate Hz"] == pytest.approx(200 / 99.5, abs=1e-3)
    assert figures["width of the path by its length"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("broken", "rank"), [(1, None), (2, "note"), (10, "note"), (11, "warning")])
@pytest.mark.parametrize("value", [0.0, -1.0, LONGEST_RANGE])
def test_readings_that_measure_nothing_are_worth_a_note_from_a_hundredth_on(broken, rank, value):
    """More than 1 of 100 is a note, more than 10 a warning."""
    _, found = anchor_figures(np.where(np.arange(100) < broken, value, 3.0))
    assert [f.rank for f in found] == ([] if rank is None else [rank])
    assert all(f"{broken if value == 0.0 else 0} of 100 readings are zero" in f.what for f in found)


@pytest.mark.parametrize(("spikes", "rank"), [(2, None), (3, "note"), (15, "note"), (16, "warning")])
def test_spikes_are_worth_a_note_from_a_fiftieth_on_and_a_warning_from_a_seventh(spikes, rank):
    """More than 2 of 100, and more than 15."""
    values = np.full(100, 3.0)
    values[3 : 3 + 6 * spikes : 6] += 1.0
    figures, found = anchor_figures(values)
    assert figures["spikes"] == spikes
    assert [f.rank for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("count", "few"), [(FEW - 1, True), (FEW, False)])
def test_an_anchor_of_fewer_than_ten_ranges_cannot_be_placed(count, few):
    _, found = anchor_figures(np.full(count, 3.0))
    assert [f"only {count} usable ranges" in f.what for f in found] == ([True] if few else [])


@pytest.mark.parametrize(("width", "straight"), [(0.9, True), (1.1, False)])
def test_a_straight_path_leaves_two_places(width, straight):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    where = np.column_stack([np.cos(angle), width * STRAIGHT * np.sin(angle)])
    _, found = anchor_figures(np.full(100, 3.0), where=where)
    assert ["either side" in f.what for f in found] == ([True] if straight else [])


@pytest.mark.parametrize("seed", range(3))
def test_the_coverage_is_that_of_a_loop_over_windows(seed):
    """Windows of 2 s of the odometry's 31 s, the last one shorter; ranges outside it or of no length do not count."""
    rng = np.random.default_rng(seed)
    stamps, anchor = np.sort(rng.uniform(95.0, 135.0, 60)), rng.integers(0, 4, 60)
    values = rng.choice([0.0, 3.0, 5.0, LONGEST_RANGE], 60, p=[0.1, 0.4, 0.4, 0.1])
    odometry = Odometry(np.array([100.0, 131.0]), np.zeros((2, 3)))
    log = SensorLog(odometry, UwbRanges(stamps, anchor, values, np.full(60, 100.0), ("A", "B", "C", "D")))
    counts = []
    for begin in np.arange(100.0, 131.0, 2.0):
        now = (stamps >= begin) & (stamps < begin + 2.0) & (stamps <= 131.0) & (values > 0.0) & (values < LONGEST_RANGE)
        counts.append(len(set(anchor[now].tolist())))
    found = Findings()
    shares = _check_coverage(log, found)
    for least in (1, 2, 3):
        assert shares[f"at least {least}"] == pytest.approx(np.mean(np.array(counts) >= least), abs=6e-4)
    assert bool(found.ranked()) is (shares["at least 2"] < 0.5)


def test_a_second_reading_of_an_anchor_at_the_same_time_is_a_repeat_and_one_of_another_anchor_is_not():
    stamps, anchor = np.array([0.0, 0.0, 1.0, 1.0, 1.0]), np.array([0, 1, 0, 1, 1])
    assert _repeats(UwbRanges(stamps, anchor, np.ones(5), np.ones(5), ("A", "B"))) == 0.25
    assert _repeats(UwbRanges(stamps[:1], anchor[:1], np.ones(1), np.ones(1), ("A", "B"))) == 0.0


def test_ranges_all_below_a_decimetre_have_another_unit():
    odometry = Odometry(np.arange(50.0), np.column_stack([np.arange(50.0), np.zeros((50, 2))]))
    for count, largest, wrong in ((FEW + 1, 0.099, True), (FEW, 0.099, False), (FEW + 1, 0.101, False)):
        radio = UwbRanges(np.arange(count) * 1.0, np.zeros(count, int), np.full(count, largest), np.ones(count), ("A",))
        found = Findings()
        check_ranges(SensorLog(odometry, radio), found)
        assert any("check the unit" in f.advice for f in found.ranked()) is wrong


def calibrated(kind, value, sigma, state="estimated", unit="1"):
    return CalibrationEstimate(UnknownKey(kind), value, sigma, unit, "", state)


@pytest.mark.parametrize(("kind", "limit", "topic"), [
    ("odometry_scale", 0.03, "odometry"), ("heading_scale", 0.05, "odometry"), ("range_scale", 0.03, "radio"),
    ("range_delay", 0.1, "radio"),
])  # fmt: skip
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_calibration_beyond_its_limit_and_five_sigmas_is_a_warning(kind, limit, topic, sign):
    for value, sigma, state, warned in (
        (1.01 * limit, 0.2 * limit, "estimated", True), (0.99 * limit, 0.0, "estimated", False),
        (1.01 * limit, 0.21 * limit, "estimated", False), (1.01 * limit, 0.0, "prior", False),
    ):  # fmt: skip
        found = Findings()
        figures = check_calibration((), (calibrated(kind, sign * value, sigma, state),), found)
        assert [(f.rank, f.topic) for f in found.ranked()] == ([("warning", topic)] if warned else [])
        assert (kind in figures) is (state == "estimated")
    found = Findings()
    check_calibration((), (calibrated("lidar_delay", 9.0, 0.0),), found)
    assert not found.ranked()


@pytest.mark.parametrize(("bias", "sigma", "status", "rank"), [
    (0.31, 0.1, "ok", "note"), (-0.31, 0.1, "ok", "note"), (0.29, 0.01, "ok", None), (0.31, 0.11, "ok", None),
    (0.0, 0.1, "unplaced", "warning"), (0.9, 0.1, "distrusted", "warning"),
])  # fmt: skip
def test_a_bias_of_three_decimetres_and_three_sigmas_is_noted(bias, sigma, status, rank):
    anchor = AnchorEstimate("A1", np.zeros(2), np.eye(2), 99, 1.0, bias, sigma, 0.1, status, "why")
    found = Findings()
    figures = check_calibration((anchor,), (), found)
    assert [f.rank for f in found.ranked()] == ([] if rank is None else [rank])
    assert ("A1" in figures["bias guess m"]) is (status == "ok")
