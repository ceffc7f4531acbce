"""Causes before consequences: each consequence names its cause, keeps its severity, and is told below it."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.assessment.causes import EXPLAINS, explained
from uwblite.assessment.plausibility import ResultView, _left_without
from uwblite.assessment.range_agreement import check_range_agreement
from uwblite.assessment.recording import diagnose
from uwblite.findings import Finding, doubt, folded, warning
from uwblite.graph.graph import Graph
from uwblite.map_result import AnchorEstimate
from uwblite.mapping import build_map
from uwblite.sensor_log import LogNotes, Odometry


def causes(findings):
    return {finding.kind: finding.explained_by for finding in findings}


def test_a_consequence_names_its_cause_and_comes_after_it():
    found = explained([doubt("uncertain", "c"), doubt("clock-set-back", "a"), doubt("range-scatter", "b"), doubt("gap", "d")])
    assert [f.kind for f in found] == ["clock-set-back", "gap", "range-scatter", "uncertain"]
    assert causes(found) == {
        "clock-set-back": (), "gap": (), "range-scatter": ("clock-set-back",), "uncertain": ("clock-set-back", "range-scatter"),
    }  # fmt: skip
    assert all(f.severity == "doubt" for f in found)


@pytest.mark.parametrize(("recordings", "anchors", "named"), [
    ((1, 1), ("", ""), True), ((0, 2), ("", ""), True), ((1, 2), ("", ""), False), ((1, 1), ("A", "A"), True),
    ((1, 1), ("A", "B"), False), ((1, 1), ("", "B"), True),
])  # fmt: skip
def test_a_cause_concerns_the_same_recording_and_anchor(recordings, anchors, named):
    kinds = ("anchor-distrusted", "spikes")
    pair = [Finding(k, "warning", "", recording=r, anchor=a) for k, r, a in zip(kinds, recordings, anchors, strict=True)]
    assert causes(explained(pair))["spikes"] == (("anchor-distrusted",) if named else ())


def test_no_cause_explains_itself_in_a_circle():
    """Along the order of the table every cause explains later causes only."""
    rank = {kind: k for k, kind in enumerate(EXPLAINS)}
    every = [doubt(kind, "") for kind in {*EXPLAINS, *(kind for kinds in EXPLAINS.values() for kind in kinds)}]
    for finding in explained(every):
        assert all(rank[cause] < rank.get(finding.kind, len(rank)) for cause in finding.explained_by)


@pytest.mark.parametrize(("sensor", "named"), [("radio", False), ("odometry", True)])
def test_a_fault_of_one_sensor_explains_what_that_sensor_shows(sensor, named):
    pair = [replace(doubt("clock-set-back", ""), sensor=sensor), doubt("wheels-stand-still", "")]
    assert causes(explained(pair))["wheels-stand-still"] == (("clock-set-back",) if named else ())


@pytest.mark.parametrize(("kind", "times", "still", "named"), [
    ("moved-anchor", ((18.0, 30.0),), set(), True), ("moved-anchor", ((60.0, 70.0),), set(), False),
    ("ranges-disagree", (), set(), True), ("ranges-disagree", (), {("ranges-disagree", "")}, False),
    ("free-space-violation", (), set(), False),
])  # fmt: skip
def test_a_cause_of_a_stretch_explains_what_goes_with_its_times(kind, times, still, named):
    """Where both have times, these meet; where all ranges are meant, they show no more without it; nothing else."""
    cause = replace(doubt("worse-than-parts", ""), stretches=((10.0, 20.0),))
    found = explained([cause, replace(doubt(kind, ""), stretches=times)], lambda _: still)
    assert causes(found)[kind] == (("worse-than-parts",) if named else ())


def planted_view(wrong):
    """Return what the rules look at: a path of 400 s, 1 Hz, whose ranges to two anchors are 2 m off at times (n,)."""
    stamps = np.repeat(np.arange(400.0), 2)
    poses = np.column_stack([0.05 * np.arange(400.0), np.zeros((400, 2))])
    graph = Graph(poses, np.array([[5.0, 9.0], [12.0, -7.0]]))
    pose, anchor = np.repeat(np.arange(400), 2), np.tile([0, 1], 400)
    noise = 0.02 * np.random.default_rng(0).standard_normal(800)
    off = np.where(wrong[pose], 2.0, 0.0) + noise
    ranges = plain_ranges(pose, anchor, np.hypot(*(poses[pose, :2] - graph.anchors[anchor]).T) + off, 0.1)
    table = {
        "stamp": stamps, "anchor": anchor.astype(float), "agrees": (np.abs(off) < 0.3).astype(float),
        "weight": np.ones(800), "recording": np.zeros(800), "residual": off,
    }  # fmt: skip
    share = float(table["agrees"].mean())
    anchors = [AnchorEstimate(n, np.zeros(2), np.eye(2), 400, share, 0.0, 0.1, 0.1, "distrusted") for n in "AB"]
    task = task_of(recordings_of(poses))
    estimate = estimate_of(graph, ranges=replace(ranges, stamps=stamps), anchor_ids=("A", "B"))
    return ResultView(task, estimate, anchors, (), {}, table, None, 0.1)


@pytest.mark.parametrize(("begin", "gone"), [(100.0, True), (300.0, False)])
def test_the_rules_of_all_ranges_are_asked_again_without_the_times_of_a_cause(begin, gone):
    """Both anchors are off from 100 to 350 s; a cause that ends there explains it where it begins there as well."""
    time = np.arange(400.0)
    view = planted_view((time >= 100.0) & (time < 350.0))
    before = {(f.kind, f.anchor) for f in check_range_agreement(view.anchors, view.table, view.task)}
    assert ("ranges-disagree", "") in before
    cause = replace(doubt("path-displaced", ""), stretches=((begin, 350.0),), recording=1)
    left = _left_without(view, cause)
    assert (("ranges-disagree", "") not in left) == gone
    assert (("anchor-distrusted", "A") not in left) == gone


def test_without_ranges_nothing_is_left_of_what_they_said():
    view = replace(planted_view(np.zeros(400, dtype=bool)), table={})
    view = replace(view, estimate=replace(view.estimate, ranges=None))
    assert _left_without(view, replace(doubt("path-displaced", ""), stretches=((0.0, 1.0),))) == set()


def test_what_is_explained_is_folded_under_the_first_cause_of_all():
    doubts = [doubt(kind, "") for kind in ("uncertain", "range-scatter", "clock-set-back")]
    found = explained([*doubts, warning("gyro", "")])
    (first, below), (second, none) = folded(found)
    assert (first.kind, [f.kind for f in below]) == ("clock-set-back", ["range-scatter", "uncertain"])
    assert (second.kind, none) == ("gyro", ())


@pytest.fixture(scope="module")
def sound():
    """A round and a half."""
    return recording(two_rounds()[:2400])


def with_steps(log, change):
    poses = log.odometry.poses
    steps = se2.between(poses[:-1], poses[1:])
    change(steps)
    return replace(log, odometry=Odometry(log.odometry.stamps, se2.chain(poses[0], steps)))


def turned_over(log):
    return replace(log, mounting=replace(log.mounting, laser_flipped=True))


def stuck_anchor(log):
    """Let one anchor repeat a range from 180 s on."""
    stuck = (log.ranges.anchor == 1) & (log.ranges.stamps > 180.0)
    return replace(log, ranges=replace(log.ranges, ranges=np.where(stuck, 4.2, log.ranges.ranges)))


def stuck_wheels(log):
    def stop(steps):
        steps[1000:1300] = 0.0

    return with_steps(log, stop)


def twice(log):
    """Write every scan twice."""
    scans = log.scans
    again = np.sort(np.concatenate([scans.stamps, scans.stamps + 0.01]))
    return replace(log, scans=replace(scans, stamps=again, ranges=np.repeat(scans.ranges, 2, axis=0)))


def set_back(log):
    return replace(log, notes=LogNotes(set_back={"radio": 30.0}))


FAULTS = {
    "laser-turned-over": turned_over, "repeated-ranges": stuck_anchor, "wheels-stand-still": stuck_wheels,
    "repeated-scans": twice, "clock-set-back": set_back,
}  # fmt: skip


@pytest.mark.parametrize(("one", "other"), [*combinations(FAULTS, 2)])
def test_of_two_faults_at_once_both_are_named(sound, one, other):
    """Neither hides the other, nor is it told as a consequence of the other."""
    found = diagnose(FAULTS[one](FAULTS[other](sound))).findings
    assert {one, other} <= {cause.kind for cause, _ in folded(found)}, [f.text for f in found]


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), [
    ("wheels-stand-still", "repeated-ranges"), ("clock-set-back", "wheels-stand-still"), ("repeated-scans", "repeated-ranges"),
])  # fmt: skip
def test_a_map_of_two_faults_names_both(sound, one, other):
    found = build_map(FAULTS[one](FAULTS[other](sound))).findings
    assert {one, other} <= {f.kind for f in found}
