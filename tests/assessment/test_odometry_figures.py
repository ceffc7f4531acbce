"""The rhythm of a sensor: which silences are worth a warning."""

import numpy as np
import pytest

from uwblite.assessment.odometry_figures import check_equal_stamps, check_silences, rhythm


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
    assert [f.severity for f in check_silences("lidar", figures)] == ([] if severity is None else [severity])


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
    assert [f.severity for f in check_equal_stamps(sensor, figures)] == ([] if severity is None else [severity])
    assert figures["share of equal stamps"] == equal / 100


def test_the_rhythm_of_a_slow_sensor_has_its_own_gaps():
    """A reading every 4 s: a silence of 12 s is no gap, one of 21 s is: five periods."""
    figures = rhythm(np.array([3.0, 7.0, 11.0, 23.0, 27.0, 31.0, 52.0123]), expected_gap=1.0)
    assert figures == {
        "count": 7, "duration s": 49.012, "rate Hz": 0.25, "longest gap s": 21.012, "longest gap at s": 28.0, "gaps": 1,
        "gaps longer than s": 20.0, "silent s": 21.012, "share of equal stamps": 0.0, "share of wrongly equal stamps": 0.0,
    }  # fmt: skip
    (finding,) = check_silences("lidar", figures)
    assert finding.text == "1 silences longer than 20.0 s; the longest is 21.0 s at t = 28.0 s"


def test_one_stamp_has_no_rhythm():
    figures = rhythm(np.array([7.0]), expected_gap=1.0)
    assert (figures["rate Hz"], figures["longest gap s"], figures["duration s"], figures["gaps"]) == (0.0, 0.0, 0.0, 0)
    assert not [*check_silences("lidar", figures), *check_equal_stamps("lidar", figures)]
