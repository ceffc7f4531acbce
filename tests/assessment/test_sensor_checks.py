"""Rhythm, wheels, radio and lidar of a log: figures against counts and loops, and from where on something is said."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import chain
from scipy.special import j0

from uwblite import se2
from uwblite.assessment.sensor_checks import (
    CheckPolicy,
    _anchor_figures,
    _check_anchor,
    _coverage,
    _repeats,
    _spikes,
    calibration_figures,
    check_lidar,
    check_odometry,
    check_radio,
    check_rhythm,
    lidar_figures,
    odometry_figures,
    rhythm,
    width_by_length,
)
from uwblite.graph.graph import UnknownKey
from uwblite.map_result import AnchorEstimate, CalibrationEstimate
from uwblite.sensor_log import LONGEST_RANGE, LaserScans, Odometry, SensorLog, UwbRanges


@pytest.mark.parametrize(
    ("silences", "seconds", "severity"),
    [(0, 0.0, None), (1, 2.0, "note"), (2, 2.0, "note"), (4, 2.0, "warning"), (1, 5.5, "warning")],
)
def test_silences_are_a_warning_by_their_share_or_their_length(silences, seconds, severity):
    """More than a fiftieth of some 300 s in all, or one of more than 5 s."""
    steps = np.full(3000, 0.1)
    steps[500 : 500 + 300 * silences : 300] = seconds
    figures = rhythm(np.cumsum(steps), expected_gap=1.0)
    assert figures["gaps"] == silences
    assert [f.severity for f in check_rhythm("lidar", figures)] == ([] if severity is None else [severity])


@pytest.mark.parametrize(("equal", "repeats", "sensor", "severity"), [
    (2, None, "odometry", None), (3, None, "odometry", "warning"), (3, None, "radio", "note"), (50, 0.02, "radio", None),
    (0, 0.021, "radio", "note"),
])  # fmt: skip
@pytest.mark.parametrize("step", [0.0, 1e-6])
def test_equal_stamps_are_said_from_a_fiftieth_on(equal, repeats, sensor, severity, step):
    """More than 2 of 100 steps, or what the caller says to be wrong of them; rows of one piece are a microsecond apart."""
    steps = np.full(100, 0.1)
    steps[::2][:equal] = step
    figures = rhythm(np.concatenate([[5.0], 5.0 + np.cumsum(steps)]), expected_gap=1.0, repeated=repeats)
    assert [f.severity for f in check_rhythm(sensor, figures)] == ([] if severity is None else [severity])
    assert figures["share of equal stamps"] == equal / 100


def test_the_rhythm_of_a_slow_sensor_has_its_own_gaps():
    """A reading every 4 s: a silence of 12 s is no gap, one of 21 s is: five periods."""
    figures = rhythm(np.array([3.0, 7.0, 11.0, 23.0, 27.0, 31.0, 52.0123]), expected_gap=1.0)
    assert figures == {
        "count": 7, "duration s": 49.0123, "rate Hz": 0.25, "longest gap s": 21.0123, "longest gap at s": 28.0, "gaps": 1,
        "gaps longer than s": 20.0, "silent s": 21.0123, "share of equal stamps": 0.0, "share of wrongly equal stamps": 0.0,
    }  # fmt: skip
    (finding,) = check_rhythm("lidar", figures)
    assert finding.text == "1 silences longer than 20.0 s; the longest is 21.0 s at t = 28.0 s"


def test_one_stamp_has_no_rhythm():
    figures = rhythm(np.array([7.0]), expected_gap=1.0)
    assert (figures["rate Hz"], figures["longest gap s"], figures["duration s"], figures["gaps"]) == (0.0, 0.0, 0.0, 0)
    assert not [*check_rhythm("lidar", figures)]


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0])
def test_a_path_is_as_wide_as_its_principal_axes_are_long(turn):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ellipse = np.column_stack([3.0 * np.cos(angle), 1.2 * np.sin(angle)])
    assert width_by_length(se2.rotate(turn, ellipse)) == pytest.approx(0.4)
    assert width_by_length(se2.rotate(turn, ellipse * [1.0, 0.0])) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_robot_that_stands_has_no_width(count):
    assert width_by_length(np.ones((count, 2))) == 0.0


def driven(poses, rate):
    odometry = Odometry(np.arange(len(poses)) / rate, poses)
    figures = odometry_figures(odometry)
    return figures, list(check_odometry(odometry, figures))


@pytest.mark.parametrize(("rate", "slow"), [(4.9, True), (5.1, False)])
def test_figures_of_a_square(rate, slow):
    """Four sides of five steps of 0.1 m; after each side a step that turns on the spot and one that rests."""
    steps = np.tile(np.array([[0.1, 0.0, 0.0]] * 5 + [[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]]), (4, 1))
    figures, found = driven(chain(np.zeros(3), steps), rate)
    assert figures["path m"] == 2.0
    assert figures["turned rad"] == pytest.approx(2.0 * np.pi, abs=1e-3)
    assert figures["speed m/s"] == pytest.approx(0.1 * rate, abs=1e-4)
    assert figures["width of the path by its length"] == pytest.approx(1.0, abs=0.05)
    assert ["readings a second" in f.text for f in found] == ([True] if slow else [])


@pytest.mark.parametrize(("swing", "said"), [(0.5, False), (0.6, True)])
def test_a_robot_that_moves_across_its_heading_is_named(swing, said):
    """A heading that swings about the tangent of a circle: the mean of exp(2i swing sin) is Bessel's J0(2 swing)."""
    angle = np.linspace(0.0, 4.0 * np.pi, 800)
    there = np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle)])
    off = 0.5 * np.pi + swing * np.sin(3.0 * angle)
    figures, found = driven(np.column_stack([there, se2.wrap_angle(angle + off)]), 20.0)
    assert figures["heading"]["agreement with the motion"] == pytest.approx(j0(2.0 * swing), abs=0.02)
    assert ["across its heading" in f.text for f in found] == ([True] if said else [])


def test_three_places_have_a_width_and_two_have_none():
    assert width_by_length(np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])) == pytest.approx(1.0)
    assert width_by_length(np.array([[0.0, 0.0], [1.0, 3.0]])) == 0.0


def test_a_robot_that_never_moves_has_no_speed():
    figures, _ = driven(np.ones((50, 3)), 10.0)
    assert (figures["speed m/s"], figures["path m"], figures["turned rad"]) == (0.0, 0.0, 0.0)


def test_the_usual_speed_is_that_of_a_robot_that_drives():
    """It stands for two thirds of the time, and one reading has the stamp of the one before."""
    poses = np.zeros((91, 3))
    poses[61:, 0] = 0.05 * np.arange(1, 31)
    stamps = 0.1 * np.arange(91)
    stamps[80] = stamps[79]
    assert odometry_figures(Odometry(stamps, poses))["speed m/s"] == pytest.approx(0.5, abs=1e-3)


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


@pytest.mark.parametrize(("broken", "rank"), [(2, None), (3, "note"), (10, "note"), (11, "warning")])
@pytest.mark.parametrize("value", [0.0, -1.0, LONGEST_RANGE])
def test_readings_that_measure_nothing_are_worth_a_note_from_a_fiftieth_on(broken, rank, value):
    """More than 2 of 100 are a note, more than 10 a warning."""
    _, found = anchor_figures(np.where(np.arange(100) < broken, value, 3.0))
    assert [f.severity for f in found] == ([] if rank is None else [rank])
    assert all(f"{broken if value == 0.0 else 0} of 100 readings are zero" in f.text for f in found)


@pytest.mark.parametrize(("spikes", "rank"), [(2, None), (3, "note"), (10, "note"), (11, "warning")])
def test_spikes_are_worth_a_note_from_a_fiftieth_on_and_a_warning_from_a_tenth(spikes, rank):
    """More than 2 of 100, and more than 10."""
    values = np.full(100, 3.0)
    values[3 : 3 + 6 * spikes : 6] += 1.0
    figures, found = anchor_figures(values)
    assert figures["spikes"] == spikes
    assert [f.severity for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("count", "few"), [(CheckPolicy.few - 1, True), (CheckPolicy.few, False)])
def test_an_anchor_of_fewer_than_ten_ranges_cannot_be_placed(count, few):
    _, found = anchor_figures(np.full(count, 3.0))
    assert [f"only {count} usable ranges" in f.text for f in found] == ([True] if few else [])


@pytest.mark.parametrize(("width", "straight"), [(0.9, True), (1.1, False)])
def test_a_straight_path_leaves_two_places(width, straight):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    where = np.column_stack([np.cos(angle), width * CheckPolicy.some * np.sin(angle)])
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
    assert (figures["beams"], figures["field of view deg"], figures["range max m"]) == (8, round(np.degrees(0.35), 4), 5.0)
    assert found == []


@pytest.mark.parametrize(("hit", "rank"), [(9, "warning"), (10, None)])
def test_a_lidar_that_reaches_no_wall_is_named(hit, rank):
    ranges = np.full((10, 100), np.inf)
    ranges[:, :hit] = np.linspace(1.0, 2.0, hit)
    _, found = checked(ranges)
    assert [f.severity for f in found] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("errors", "said"), [(50, False), (51, True)])
def test_many_error_codes_are_noted(errors, said):
    ranges = np.tile(np.linspace(1.0, 2.0, 100), (10, 1))
    ranges[:, :errors] = np.nan
    assert ["error codes" in f.text for f in checked(ranges)[1]] == ([True] if said else [])
