"""Stretches in which an anchor's ranges disagree with the map, and a unit of the wheels that rests on them."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.assessment.range_agreement import (
    check_sustained_outliers,
    check_wheels_against_lidar,
    outlier_stretches,
)
from uwblite.findings import Fact
from uwblite.pipeline.progress import Stages
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


def recordings_from(*starts, scans=True):
    """Return recordings whose clocks begin at these times, s."""
    each = [
        SimpleNamespace(number=n, frames=SimpleNamespace(stamps=np.array([t, 9e3])), has_scans=scans)
        for n, t in enumerate(starts)
    ]
    return type("Recordings", (), {"each": each, "__len__": lambda self: len(each)})()


def test_an_anchor_that_disagrees_for_long_is_named_with_the_times_since_the_beginning():
    """Of three anchors the second disagrees from 200 s on and in four more stretches; ranges without weight do not count."""
    stamps = np.tile(1000.0 + np.arange(1000.0), 3)
    anchor = np.repeat([0.0, 1.0, 2.0], 1000)
    wrong = np.zeros(3000, dtype=bool)
    for first in (200, 400, 500, 600, 700):
        wrong |= (anchor == 1) & (stamps >= 1000 + first) & (stamps < 1050 + first)
    table = {
        "stamp": stamps, "anchor": anchor, "agrees": np.where(wrong | (anchor == 2), 0.0, 1.0),
        "weight": np.where(anchor == 2, 0.0, 1.0), "recording": np.zeros(3000),
    }  # fmt: skip
    stages = Stages(None, None)
    stages.findings.extend(
        check_sustained_outliers(table, "ABC", SimpleNamespace(recordings=recordings_from(1000.0), stages=stages))
    )
    (notice,) = stages.warnings
    assert (notice.kind, notice.figures["anchor"], len(notice.figures["stretches"])) == ("sustained-outliers", "B", 5)
    assert notice.text.startswith(
        "anchor B disagrees with the map for long (t = 200 to 249 s, 400 to 449 s, 500 to 549 s, 600 to 649 s ...)"
    )


def test_an_anchor_disagrees_in_one_recording_while_others_whose_clocks_show_the_same_agree():
    """Half of all readings between 200 and 300 s are of each recording: together six of ten would agree."""
    stamps, recording = np.tile(np.arange(400.0), 2), np.repeat([0.0, 1.0], 400)
    wrong = (recording == 1) & (stamps >= 200) & (stamps < 300) & (stamps % 5 > 0)
    table = {
        "stamp": stamps, "anchor": np.zeros(800), "agrees": np.where(wrong, 0.0, 1.0), "weight": np.ones(800),
        "recording": recording,
    }  # fmt: skip
    stages = Stages(None, None)
    stages.findings.extend(
        check_sustained_outliers(table, "A", SimpleNamespace(recordings=recordings_from(0.0, 0.0), stages=stages))
    )
    (notice,) = stages.warnings
    assert notice.text.startswith("recording 2: anchor A disagrees with the map for long (t = 200 to 299 s)")


@pytest.mark.parametrize(
    ("wrong", "count", "lidar", "doubts"),
    [(2, 4, False, 1), (1, 4, False, 0), (2, 5, False, 0), (1, 1, False, 1), (4, 4, True, 0)],
)
def test_half_of_the_anchors_that_disagree_for_long_are_a_doubt_without_a_lidar(wrong, count, lidar, doubts):
    stamps, anchor = np.tile(np.arange(1000.0), count), np.repeat(np.arange(float(count)), 1000)
    table = {
        "stamp": stamps, "anchor": anchor, "agrees": ((anchor >= wrong) | (stamps < 500)) * 1.0,
        "weight": np.ones(len(stamps)), "recording": np.zeros(len(stamps)),
    }  # fmt: skip
    stages = Stages(None, None)
    recordings = recordings_from(0.0, scans=lidar)
    stages.findings.extend(
        check_sustained_outliers(table, "ABCDE"[:count], SimpleNamespace(recordings=recordings, stages=stages))
    )
    assert [n.kind for n in stages.warnings] == ["sustained-outliers"] * wrong
    assert [n.kind for n in stages.doubts] == ["ranges-disagree"] * doubts


def against(residual, names=("A", "B", "C"), statuses=("ok", "ok", "ok"), stretches=((0.0, 40.0), (60.0, 90.0)), whose=1):
    """Return the stages of a map whose wheels and lidar contradict each other; residual(s) of three anchors' ranges.

    A second recording has ranges at the same times of its own clock, all of them off.
    """
    stamps = np.arange(150.0)
    table = {"stamp": stamps, "anchor": stamps % 3, "residual": residual(stamps), "recording": np.zeros(150)}
    other = {**table, "residual": np.ones(150), "recording": np.ones(150)}
    table = {name: np.concatenate([table[name], other[name]]) for name in table}
    anchors = [SimpleNamespace(id=name, status=status) for name, status in zip(names, statuses, strict=True)]
    found = Fact.of("wheels-against-lidar", start=0.0, stretches=stretches)
    logs = [SimpleNamespace(screening=None), SimpleNamespace(screening=None)]
    logs[whose - 1] = SimpleNamespace(screening=Screening((found,), OdometryBreaks.none()))
    task = SimpleNamespace(recordings=SimpleNamespace(each=[SimpleNamespace(log=log) for log in logs]))
    stages = Stages(None, None)
    stages.findings.extend(check_wheels_against_lidar(table, anchors, task))
    return stages


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
