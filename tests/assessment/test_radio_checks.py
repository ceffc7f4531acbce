"""Spikes and coverage against loops; from which share, bias or scale on something is said."""

import numpy as np
import pytest

from uwblite.assessment.odometry_figures import STRAIGHT, rhythm
from uwblite.assessment.radio_figures import (
    FEW,
    _anchor_figures,
    _check_anchor,
    _coverage,
    _repeats,
    _spikes,
    calibration_figures,
    check_radio,
)
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
    count = len(values)
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    where = np.column_stack([np.cos(angle), np.sin(angle)]) if where is None else where
    travelled = np.zeros(count) if travelled is None else travelled
    figures = _anchor_figures(0.5 * np.arange(count), np.asarray(values, dtype=np.float64), travelled, where)
    return figures, list(_check_anchor("A1", figures))


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
    assert [f.severity for f in found] == ([] if rank is None else [rank])
    assert all(f"{broken if value == 0.0 else 0} of 100 readings are zero" in f.text for f in found)


@pytest.mark.parametrize(("spikes", "rank"), [(2, None), (3, "note"), (15, "note"), (16, "warning")])
def test_spikes_are_worth_a_note_from_a_fiftieth_on_and_a_warning_from_a_seventh(spikes, rank):
    """More than 2 of 100, and more than 15."""
    values = np.full(100, 3.0)
    values[3 : 3 + 6 * spikes : 6] += 1.0
    figures, found = anchor_figures(values)
    assert figures["spikes"] == spikes
    assert [f.severity for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("count", "few"), [(FEW - 1, True), (FEW, False)])
def test_an_anchor_of_fewer_than_ten_ranges_cannot_be_placed(count, few):
    _, found = anchor_figures(np.full(count, 3.0))
    assert [f"only {count} usable ranges" in f.text for f in found] == ([True] if few else [])


@pytest.mark.parametrize(("width", "straight"), [(0.9, True), (1.1, False)])
def test_a_straight_path_leaves_two_places(width, straight):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    where = np.column_stack([np.cos(angle), width * STRAIGHT * np.sin(angle)])
    _, found = anchor_figures(np.full(100, 3.0), where=where)
    assert ["either side" in f.text for f in found] == ([True] if straight else [])


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
    shares = _coverage(log, log.ranges)
    for least in (1, 2, 3):
        assert shares[f"at least {least}"] == pytest.approx(np.mean(np.array(counts) >= least), abs=6e-4)
    each = _anchor_figures(stamps, np.full(60, 3.0), np.arange(60.0), rng.normal(size=(60, 2)))
    figures = rhythm(stamps, expected_gap=40.0) | {"anchors": {"A": each, "B": each}, "coverage": shares}
    assert [f.kind for f in check_radio(figures)] == ["few-in-reach"] * (shares["at least 2"] < 0.5)


def test_a_second_reading_of_an_anchor_at_the_same_time_is_a_repeat_and_one_of_another_anchor_is_not():
    stamps, anchor = np.array([0.0, 0.0, 1.0, 1.0, 1.0]), np.array([0, 1, 0, 1, 1])
    assert _repeats(UwbRanges(stamps, anchor, np.ones(5), np.ones(5), ("A", "B"))) == 0.25
    assert _repeats(UwbRanges(stamps[:1], anchor[:1], np.ones(1), np.ones(1), ("A", "B"))) == 0.0


@pytest.mark.parametrize(("status", "state"), [("ok", "estimated"), ("unplaced", "prior")])
def test_a_map_gives_figures_of_what_it_estimated(status, state):
    anchor = AnchorEstimate("A1", np.zeros(2), np.eye(2), 99, 1.0, 0.3, 0.1, 0.1, status, "why")
    scale = CalibrationEstimate(UnknownKey("odometry_scale"), 0.06, 0.004, "1", "error of travelled distance", state)
    figures = calibration_figures((anchor,), (scale,))
    assert ("A1" in figures["bias guess m"]) is (status == "ok")
    assert ("odometry_scale" in figures) is (state == "estimated")
