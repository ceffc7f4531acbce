"""A stretch of the path that the map has elsewhere, told from ranges that are late or of one moved anchor."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.assessment.displaced_stretches import check_displaced_stretches
from uwblite.pipeline.progress import Stages

PLACES = np.array([[0.0, 4.0], [20.0, 5.0], [10.0, -6.0], [22.0, -3.0]])


def doubts(errors, beside=(0.0, 0.0), count=4, lidar=True):
    """Return the doubts of a path of 20 m with ranges every 0.1 m, which the map has elsewhere between 8 and 14 m.

    Parameters
    ----------
    errors : of x (m,), m, and of the anchor's number (m,): what is added to the ranges (m,), m.
    """
    x, numbers = np.linspace(0.0, 20.0, 200), np.arange(200) % count
    true = np.column_stack([x, np.zeros(200)])
    tags = true - np.where(((x > 8.0) & (x < 14.0))[:, None], beside, 0.0)
    noise = np.random.default_rng(1).normal(0.0, 0.08, 200)
    ranges = np.hypot(*(true - PLACES[numbers]).T) + noise + errors(x, numbers)
    table = {
        "stamp": 100.0 + x, "anchor": numbers.astype(float), "range": ranges, "weight": np.ones(200),
        "recording": np.zeros(200), "residual": ranges - np.hypot(*(tags - PLACES[numbers]).T),
        "x": tags[:, 0], "y": tags[:, 1],
    }  # fmt: skip
    recording = SimpleNamespace(number=0, has_scans=lidar, frames=SimpleNamespace(stamps=np.array([100.0])))
    task = SimpleNamespace(recordings=SimpleNamespace(each=[recording]), stages=Stages(None, None))
    anchors = [SimpleNamespace(position=place, status="ok") for place in PLACES[:count]]
    return list(check_displaced_stretches(table, anchors, task))


def nothing(x, numbers):
    return np.zeros(len(x))


def test_a_stretch_that_all_ranges_have_elsewhere_is_a_doubt():
    (found,) = doubts(nothing, (2.0, 0.5))
    assert found.kind == "ranges-disagree"
    assert 107.5 < found.figures["start"] < 109.0
    assert 113.0 < found.figures["end"] < 114.5
    assert found.figures["off"] == pytest.approx(np.hypot(2.0, 0.5), abs=0.2)


@pytest.mark.parametrize(
    "errors",
    [
        nothing,
        lambda x, numbers: np.where((x > 8.0) & (x < 14.0), 1.5, 0.0),
        lambda x, numbers: np.where((x > 8.0) & (x < 14.0), np.random.default_rng(2).exponential(1.5, len(x)), 0.0),
        lambda x, numbers: np.where((x > 8.0) & (numbers == 1), 2.0, 0.0),
    ],
    ids=["right", "all late alike", "all late", "one anchor moved"],
)
def test_late_ranges_and_those_of_one_anchor_are_none(errors):
    assert not doubts(errors)


def test_less_than_half_a_metre_two_anchors_and_no_lidar_decide_nothing():
    assert not doubts(nothing, (0.3, 0.2))
    assert not doubts(nothing, (2.0, 0.5), count=2)
    assert not doubts(nothing, (2.0, 0.5), lidar=False)
