"""Stretches in which an anchor's ranges disagree with the map, and a unit of the wheels that rests on them."""

import numpy as np
import pytest
from helpers.planted_tasks import recordings_of, standing, task_of

from uwblite.assessment.range_agreement import (
    check_range_agreement,
    check_wheels_against_lidar,
    outlier_stretches,
)
from uwblite.findings import Fact
from uwblite.map_result import AnchorEstimate
from uwblite.sensor_log import OdometryBreaks, Screening


def test_stretches_in_which_most_readings_disagree_are_found():
    stamps = np.arange(400.0)
    agrees = np.random.default_rng(0).random(400) < 0.95
    assert outlier_stretches(stamps, agrees) == []
    agrees[100:200] = False
    agrees[360:] = False
    found = outlier_stretches(stamps, agrees)
    assert len(found) == 2
    np.testing.assert_allclose(found, [(100, 199), (360, 399)], atol=20)
    assert outlier_stretches(stamps[:99], np.zeros(99, dtype=bool)) == []


@pytest.mark.parametrize(("agreeing", "found"), [(3, True), (4, False), (6, False)])
def test_a_stretch_has_fewer_than_four_of_ten_readings_that_agree(agreeing, found):
    """Twenty readings a bin: in each stretch of ten the first so many agree; elsewhere all."""
    stamps = np.arange(400.0)
    agrees = (np.arange(400) % 10 < agreeing) | (stamps < 100) | (stamps >= 200)
    assert outlier_stretches(stamps, agrees) == ([(100.0, 199.0)] if found else [])


def told(agrees, statuses=(), lidar=False, starts=(0.0,), where=None):
    """Return the findings about anchors of which each has a range a second, which agree with the map or not (a, n).

    Parameters
    ----------
    statuses : of the anchors; ok. starts : of the recordings' clocks, s.
    where : (n,) recording of each range; all of the first.
    """
    count, seconds = agrees.shape
    of = np.zeros(seconds) if where is None else where
    table = {
        "stamp": np.tile(starts[0] + np.arange(float(seconds)), count), "anchor": np.repeat(np.arange(float(count)), seconds),
        "agrees": agrees.ravel().astype(float), "weight": np.ones(agrees.size), "recording": np.tile(of, count),
    }  # fmt: skip
    names = ("A", "B", "C", "D", "D@2")
    anchors = [
        AnchorEstimate(names[k], np.zeros(2), np.eye(2), seconds, float(agrees[k].mean()), 0.0, 0.1, 0.1, status)
        for k, status in enumerate(statuses or ("ok",) * count)
    ]
    begins = np.ravel([(t, t + 1.0) for t in starts])
    of_each = np.repeat(np.arange(len(starts)), 2)
    task = task_of(recordings_of(np.zeros((len(begins), 3)), begins, of_each, lidar=lidar))
    return list(check_range_agreement(anchors, table, task))


def wrong_from(count, anchors=4, seconds=1000, since=500):
    """Return ranges (a, n) that agree but for those of so many anchors from some time on."""
    return (np.arange(anchors)[:, None] >= count) | (np.arange(seconds) < since)


def test_an_anchor_that_disagrees_for_long_is_named_with_the_times_since_the_beginning():
    agrees = np.ones((3, 1000), dtype=bool)
    for first in (200, 400, 500, 600):
        agrees[1, first : first + 50] = False
    (notice,) = told(agrees, lidar=True, starts=(1000.0,))
    assert (notice.kind, notice.severity, notice.anchor, len(notice.stretches)) == ("sustained-outliers", "warning", "B", 4)
    assert notice.text.startswith(
        "anchor B disagrees with the map for long (t = 200 to 249 s, t = 400 to 449 s, t = 500 to 549 s, and 1 more stretches)"
    )
    assert notice.stretches[0] == (1200.0, 1249.0)


def test_an_anchor_disagrees_in_one_recording_while_others_whose_clocks_show_the_same_agree():
    """Half of all readings between 200 and 400 s are of each recording: together six of ten would agree."""
    where, time = np.arange(800) % 2, np.arange(800)
    wrong = (where == 1) & (time >= 200) & (time < 400) & (time % 10 > 1)
    (notice,) = told(~wrong[None], lidar=True, starts=(0.0, 0.0), where=where)
    assert (notice.recording, notice.text[:60]) == (2, "recording 2: anchor A disagrees with the map for long (t = 2")


@pytest.mark.parametrize(("agrees", "options", "found"), [
    (wrong_from(2), {}, True), (wrong_from(1), {}, False), (wrong_from(2, 5), {}, True), (wrong_from(1, 1), {}, True),
    (wrong_from(4), {"lidar": True}, False), (wrong_from(4, since=200), {"lidar": True}, True),
    (wrong_from(0), {"statuses": ("ok", "ok", "ok", "distrusted")}, False),
    (wrong_from(1), {"statuses": ("ok", "ok", "ok", "distrusted")}, True),
    (wrong_from(0), {"statuses": ("distrusted",) * 4, "lidar": True}, True),
    (wrong_from(0), {"statuses": ("distrusted",) * 3 + ("ok",), "lidar": True}, False),
    (wrong_from(0), {"statuses": ("distrusted",) * 4, "lidar": True, "starts": (0.0, 0.0)}, False),
    (wrong_from(0, 5), {"statuses": ("distrusted",) * 3 + ("ok", "ok"), "lidar": True}, True),
    (wrong_from(0, 2), {"statuses": ("distrusted",) * 2, "lidar": True}, False),
    (wrong_from(0), {"statuses": ("ok", "ok", "distrusted", "unplaced")}, False),
    (wrong_from(0), {"statuses": ("ok", "unplaced", "distrusted", "unplaced")}, True),
    (wrong_from(1, 5), {}, True), (wrong_from(0, 5), {}, False),
    (wrong_from(0, 5), {"statuses": ("ok", "ok", "ok", "distrusted", "distrusted")}, False),
])  # fmt: skip
def test_ranges_that_contradict_the_map_are_a_doubt(agrees, options, found):
    """Most of all, without a lidar those of half of the anchors, with one of all; the fifth is the fourth after a move."""
    assert [n.kind for n in told(agrees, **options) if n.severity == "doubt"] == ["ranges-disagree"] * found


def against(residual, names=("A", "B", "C"), statuses=("ok", "ok", "ok"), stretches=((0.0, 40.0), (60.0, 90.0)), whose=1):
    """Return the stages of a map whose wheels and lidar contradict each other; residual(s) of three anchors' ranges.

    A second recording has ranges at the same times of its own clock, all of them off.
    """
    stamps = np.arange(150.0)
    table = {"stamp": stamps, "anchor": stamps % 3, "residual": residual(stamps), "recording": np.zeros(150)}
    other = {**table, "residual": np.ones(150), "recording": np.ones(150)}
    table = {name: np.concatenate([table[name], other[name]]) for name in table}
    anchors = [
        AnchorEstimate(name, np.zeros(2), np.eye(2), 50, 1.0, 0.0, 0.1, 0.1, status)
        for name, status in zip(names, statuses, strict=True)
    ]
    found = Fact.of("wheels-against-lidar", start=0.0, stretches=stretches, slips=False)
    screened = {"screening": Screening((found,), OdometryBreaks.none())}
    task = task_of(standing(2, lidar=True, each=[screened if n == whose - 1 else {} for n in range(2)]))
    task.stages.findings.extend(check_wheels_against_lidar(table, anchors, task))
    return task.stages


def test_ranges_that_agree_with_the_map_decide_between_wheels_and_lidar():
    """Every tenth range is late, in half of one stretch every third as well."""
    stages = against(lambda s: np.where((s % 10 == 0) | ((s > 60) & (s < 75) & (s % 3 == 1)), 1.0, 0.1))
    assert stages.doubts == []
    (notice,) = stages.warnings
    assert (notice.kind, "; the ranges agree" in notice.text, len(notice.stretches)) == (
        "wheels-against-lidar", True, 2)  # fmt: skip


@pytest.mark.parametrize(
    ("residual", "options"),
    [
        (lambda s: np.where(s % 5 == 0, 0.4, 0.1), {}),
        (lambda s: np.where((s >= 60) & (s < 80), 0.4, 0.0), {}),
        (np.zeros_like, {"names": ("A", "B", "B@2")}),
        (np.zeros_like, {"statuses": ("ok", "ok", "distrusted")}),
        (np.zeros_like, {"stretches": ((0.0, 40.0), (200.0, 210.0))}),
        (np.zeros_like, {"whose": 2}),
        (np.zeros_like, {"names": ("A", "B", "B#2")}),
    ],
    ids=[
        "a fifth of all is off", "those of one stretch are off", "an anchor was moved", "two anchors", "none in a stretch",
        "those of the other recording are off", "an anchor was moved between recordings",
    ],
)  # fmt: skip
def test_too_few_ranges_that_agree_decide_nothing(residual, options):
    stages = against(residual, **options)
    assert ([n.kind for n in stages.doubts], stages.warnings) == (["wheels-against-lidar"], [])
