"""The rhythm of a sensor: which silences are worth a warning."""

import numpy as np
import pytest

from uwblite.checks.findings import Findings, timing


@pytest.mark.parametrize(
    ("silences", "seconds", "rank"),
    [(0, 0.0, None), (1, 2.0, "note"), (2, 2.0, "note"), (4, 2.0, "warning"), (1, 5.5, "warning")],
)
def test_silences_are_a_warning_by_their_share_or_their_length(silences, seconds, rank):
    """More than a fiftieth of some 300 s in all, or one of more than 5 s."""
    steps = np.full(3000, 0.1)
    steps[500 : 500 + 300 * silences : 300] = seconds
    found = Findings()
    figures = timing(np.cumsum(steps), "lidar", found, expected_gap=1.0)
    assert figures["gaps"] == silences
    assert [f.rank for f in found.ranked()] == ([] if rank is None else [rank])


@pytest.mark.parametrize(("equal", "repeats", "topic", "rank"), [
    (2, None, "odometry", None), (3, None, "odometry", "warning"), (3, None, "radio", "note"), (50, 0.02, "radio", None),
    (0, 0.021, "radio", "note"),
])  # fmt: skip
def test_equal_stamps_are_said_from_a_fiftieth_on(equal, repeats, topic, rank):
    """More than 2 of 100 steps, or what the caller says to be wrong of them."""
    steps = np.full(100, 0.1)
    steps[::2][:equal] = 0.0
    found = Findings()
    figures = timing(np.concatenate([[5.0], 5.0 + np.cumsum(steps)]), topic, found, expected_gap=1.0, repeats=repeats)
    assert [f.rank for f in found.ranked()] == ([] if rank is None else [rank])
    assert figures["share of equal stamps"] == equal / 100


def test_the_rhythm_of_a_slow_sensor_has_its_own_gaps():
    """A reading every 4 s: a silence of 12 s is no gap, one of 21 s is: five periods."""
    found = Findings()
    stamps = np.array([3.0, 7.0, 11.0, 23.0, 27.0, 31.0, 52.0123])
    figures = timing(stamps, "lidar", found, expected_gap=1.0)
    assert figures == {
        "count": 7, "duration s": 49.012, "rate Hz": 0.25, "longest gap s": 21.012, "gaps": 1, "share of equal stamps": 0.0,
    }  # fmt: skip
    (finding,) = found.ranked()
    assert finding.what == "1 silences longer than 20.0 s; the longest is 21.0 s at t = 28.0 s"


def test_one_stamp_has_no_rhythm():
    found = Findings()
    figures = timing(np.array([7.0]), "lidar", found, expected_gap=1.0)
    assert (figures["rate Hz"], figures["longest gap s"], figures["duration s"], figures["gaps"]) == (0.0, 0.0, 0.0, 0)
    assert found.ranked() == ()


def test_findings_are_ranked_worst_first_and_keep_their_order():
    found = Findings()
    found.note("log", "a", "")
    found.serious("map", "b", "")
    found.warning("radio", "c", "")
    found.serious("lidar", "d", "")
    assert [f.what for f in found.ranked()] == ["b", "d", "c", "a"]
