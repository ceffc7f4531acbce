"""Parts of a map that only the odometry ties, or holds, are a doubt; a gap that scans, closures or anchors bridge is none."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted_graphs import plain_ranges, relative_edges
from helpers.planted_tasks import estimate_of, recordings_of, task_of

from uwblite import se2
from uwblite.assessment.untied_parts import check_untied_parts, check_untied_recordings, untied_steps
from uwblite.graph.calibration import LASER, indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.loop_closure.closures import no_closures
from uwblite.sensor_log import LaserScans

STAMPS = np.arange(100.0)
POSES = np.column_stack([0.3 * STAMPS, np.zeros(100), np.zeros(100)])
PLACES = np.array([[5.0, 8.0], [22.0, -6.0], [12.0, 9.0], [18.0, 7.0]])


def measured(*spans):
    """Ranges of anchors from and until a time (s), each second."""
    at = [np.arange(*span, dtype=np.float64) for span in spans]
    stamps, anchor = np.concatenate(at), np.repeat(np.arange(len(spans)), [len(a) for a in at])
    pose = stamps.astype(np.intp)
    return replace(plain_ranges(pose, anchor, np.hypot(*(POSES[pose, :2] - PLACES[anchor]).T), 0.1), stamps=stamps)


def scan_edge(i, j, root=(100.0, 100.0, 300.0)):
    none = np.zeros((1, 3))
    z = se2.between(POSES[[i]], POSES[[j]])
    return ScanEdges(np.array([i]), np.array([j]), z, np.diag(root)[None], none, none, indices(Calibration(), *LASER))


def doubts(ranges=None, scans_at=None, edges=(), poses=POSES):
    """Return the figures of the doubts of a drive of 100 keyframes."""
    readings = None if scans_at is None else np.ones((len(scans_at), 3), np.float32)
    scans = None if scans_at is None else LaserScans(scans_at, readings, -1.0, 1.0, 0.0, 0.0, 5.0)
    task = task_of(recordings_of(poses, STAMPS, each=[{"scans": scans}]))
    edges = edges if ranges is None else (*edges, ranges)
    wheels = chained(poses, np.array([0.01, 0.01, 0.003]))
    estimate = estimate_of(Graph(poses, PLACES, edges=edges), ranges=ranges, odometry=wheels)
    return [n.figures for n in check_untied_parts(estimate, task) if n.severity == "doubt"]


def untied(*args, **settings):
    """Return from when to when the parts of a drive of 100 keyframes are untied."""
    return [(found["start"], found["end"]) for found in doubts(*args, **settings) if "start" in found]


def loose(*args, **settings):
    """Return until when and from when no sensor holds a drive of 100 keyframes."""
    return [found["at"] for found in doubts(*args, **settings) if "at" in found]


@pytest.mark.parametrize("gap", [1.0, 20.0])
def test_all_anchors_give_way_to_others_at_once(gap):
    assert untied(measured((0, 50), (2, 49), (49 + gap, 95), (51 + gap, 95))) == [(49.0, 49.0 + gap)]


@pytest.mark.parametrize(
    ("spans", "why"),
    [
        (((0, 50), (2, 30), (50, 95), (51, 95)), "one was left behind long before: the robot drove out of its reach"),
        (((0, 50), (2, 49), (50, 95), (75, 95)), "only one appears"),
        (((0, 50), (2, 55), (50, 95), (51, 95)), "one is measured on both sides"),
        (((0, 3), (1, 4), (4, 95), (5, 95)), "the first part is too small for a word"),
    ],
)
def test_a_robot_that_drives_from_anchor_to_anchor(spans, why):
    assert untied(measured(*spans)) == [], why


WITHOUT = np.concatenate([np.arange(0.0, 40.0), np.arange(70.0, 100.0)])


def test_the_lidar_is_silent_while_the_robot_drives():
    assert untied(scans_at=WITHOUT) == [(39.0, 70.0)]
    assert untied(measured((0, 95)), WITHOUT) == [(39.0, 70.0)]


def test_what_bridges_the_silence():
    assert untied(measured((0, 95), (10, 90)), WITHOUT) == []
    assert untied(scans_at=WITHOUT, edges=(scan_edge(20, 80),)) == []
    assert untied(scans_at=WITHOUT, edges=(scan_edge(80, 20),)) == []
    assert untied(scans_at=WITHOUT, edges=(scan_edge(20, 39),)) == [(39.0, 70.0)]


ALL, ALONG = (100.0, 100.0, 300.0), (1.0, 100.0, 300.0)
"""What a match fixes, 1/m, 1/m, 1/rad: everything, or the way along a wall to a metre only."""


@pytest.mark.parametrize(("slipped", "across", "found"), [
    ((50,), [], [50]), ((50,), [(50, 51, ALONG)], [50]), ((50,), [(50, 51, ALL)], []), ((50,), [(48, 52, ALL)], []),
    ((50,), [(45, 55, ALL)], [50]), ((50,), [(20, 80, ALONG)], [50]), ((50,), [(45, 58, ALONG), (20, 80, ALL)], []),
    ((30, 32), [], [30]), ((30, 70), [], [30, 70]), ((30, 70), [(20, 60, ALL)], [70]), ((30, 31), [(30, 32, ALL)], []),
    ((2,), [], []), ((30, 96), [], [30]), (tuple(range(30, 98)), [], [30]),
])  # fmt: skip
def test_steps_in_which_the_wheels_slip_are_tied_by_scans_that_leave_no_direction_free(slipped, across, found):
    """A keyframe that hangs on two such steps alone is no part, nor are a few at either end.

    Clouds of one visit that are not neighbours were matched where the chain had put them: they tie nothing.
    """
    wheels = chained(POSES, np.array([0.01, 0.01, 0.003]))
    wheels.motion[np.array(slipped), 0] += 2.0
    others = [scan_edge(k, k + 1) for k in range(99) if k not in slipped]
    graph = Graph(POSES, edges=(*others, *(scan_edge(*edge) for edge in across)))
    assert untied_steps(estimate_of(graph, odometry=wheels), recordings_of(POSES, STAMPS)).tolist() == found


@pytest.mark.parametrize(("first", "last"), [((47, 51), (51, 55)), ((0, 20), (75, 95))])
def test_directions_that_matches_leave_free_scatter_and_measure_no_slip(first, last):
    """Of neighbours, and of 400 pairs of two visits along one wall."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(*first), np.arange(*last)))
    wheels = chained(POSES, np.array([0.01, 0.01, 0.003]))
    wheels.motion[50, 0] += 2.0
    free, root = 0.02 * np.random.default_rng(1).standard_normal(len(i)), np.zeros((len(i), 3, 3))
    root[:, 0, :2], root[:, 1, 2] = 100.0 * np.column_stack([np.sin(free), np.cos(free)]), 300.0
    none = np.zeros((len(i), 3))
    across = ScanEdges(i, j, se2.between(POSES[i], POSES[j]), root, none, none, indices(Calibration(), *LASER))
    graph = Graph(POSES, edges=(*(scan_edge(k, k + 1) for k in range(99) if k != 50), across))
    assert untied_steps(estimate_of(graph, odometry=wheels), recordings_of(POSES, STAMPS)).tolist() == [50]


def test_a_robot_that_stands_needs_no_scans():
    assert untied(scans_at=WITHOUT, poses=0.01 * POSES) == []


@pytest.mark.parametrize(("first", "last", "named"), [(6, 20, True), (5, 20, False), (80, 94, True), (80, 95, False)])
def test_a_part_of_a_few_keyframes_is_too_small_for_a_word(first, last, named):
    """At either end: so many keyframes before the silence, or behind it."""
    assert len(untied(scans_at=np.concatenate([np.arange(0.0, first), np.arange(last, 100.0)]))) == named


def test_a_sensor_that_is_silent_for_good_leaves_a_loose_end():
    assert loose(measured((0, 100))) == []
    assert loose(measured((0, 50), (0, 40))) == [47.0], "the third keyframe from the end of what is held"
    assert loose(measured((50, 100))) == [52.0]
    assert loose(measured((30, 60))) == [32.0, 57.0]
    assert loose(measured((0, 30), (70, 100))) == [], "held from both sides"
    assert loose(measured((0, 90))) == [], "3 m only"


def test_a_few_ranges_hold_nothing():
    assert loose(measured((0, 50), (98, 100))) == [49.0]
    assert loose(measured((0, 50), (97, 100))) == []
    assert loose(measured((50, 52))) == [0.0], "the whole way"


def test_scans_and_closures_hold_an_end_as_ranges_do():
    neighbours = tuple(scan_edge(k, k + 1) for k in range(50))
    assert loose(edges=neighbours) == [48.0]
    assert loose(edges=(*neighbours, scan_edge(20, 97), scan_edge(21, 98), scan_edge(22, 99))) == []
    assert loose(measured((0, 100)), edges=neighbours) == []


def test_a_middle_without_matches_is_loose_unless_a_closure_connects_both_sides():
    """18 m, of which either side errs by half; 9 m do not matter."""
    sides = [tuple(scan_edge(k, k + 1) for k in (*range(first), *range(last, 99))) for first, last in ((20, 80), (35, 65))]
    assert [loose(edges=edges) for edges in sides] == [[20.0], []]
    assert loose(edges=(*sides[0], scan_edge(10, 90))) == []
    assert loose(measured((0, 30), (70, 100)), edges=sides[0]) == [], "anchors hold both sides"
    wide = POSES.copy()
    wide[90, 0] = 1000.0
    assert loose(edges=sides[0], poses=wide) == [], "less than 1 % of the map"


def test_a_loose_stretch_is_told_with_its_ends_its_way_and_the_error_of_its_far_end():
    """Scans hold keyframes 20 to 30 and 70 to 79 of 0.3 m each: 6 m before, 12 m in between and 6 m behind."""
    edges = tuple(scan_edge(k, k + 1) for k in (*range(18, 30), *range(70, 81)))
    wheels = chained(POSES, np.array([0.01, 0.01, 0.003]))
    for scale in (1.0, 3.0):
        poses = scale * POSES
        estimate = estimate_of(Graph(poses, edges=edges), odometry=wheels)
        found = list(check_untied_parts(estimate, task_of(recordings_of(poses, STAMPS))))
        stretches = ((0.0, 20.0), (79.0, 99.0), (30.0, 70.0)) if scale > 1.0 else ((30.0, 70.0),)
        assert tuple(finding.stretches[0] for finding in found) == stretches
        for finding, (start, end) in zip(found, stretches, strict=True):
            way = 0.3 * scale * (end - start)
            middle = start == 30.0
            error = (0.5 if middle else 1.0) * 0.5 * 0.02 * way**2
            assert finding.figures["way"] == pytest.approx(way)
            assert finding.figures["error"] == pytest.approx(error)
            assert finding.figures["at"] == (20.0 if start == 0.0 else start)
            when = "from t = 30 to 70 s" if middle else "until t = 20 s" if start == 0.0 else "from t = 79 s"
            assert finding.text.startswith(f"{when}, over {way:.0f} m, ")
            assert f"drift by {error:.1f} m" in finding.text
            cut = "`end=30` and `start=70` leave" if middle else "`start=20` leaves" if start == 0.0 else "`end=79` leaves"
            assert finding.cure == f"{cut} that part out"
            assert (finding.severity, finding.kind, finding.recording) == ("doubt", "untied-parts", 1)


def test_a_robot_that_stands_goes_not_astray():
    assert loose(measured((0, 50)), poses=0.01 * POSES) == []


def test_an_end_without_any_measurement_anywhere_is_another_doubt():
    assert doubts() == []


@pytest.mark.parametrize(("turn", "error"), [(0.0, 0.02 * 15.0**2 / 2.0), (2.0 * np.pi, 0.02 * 15.0**2 / (2.0 * np.pi))])
def test_a_way_around_errs_less_than_one_straight_on(turn, error):
    """15 m without ranges at the end."""
    heading = np.maximum(STAMPS - 49.0, 0.0) / 50.0 * turn
    poses = np.column_stack([np.cumsum(0.3 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0), heading])
    (found,) = doubts(measured((0, 52)), poses=poses)
    assert found["error"] == pytest.approx(error, rel=0.05)


def doubted(heard, closures=(), few=()):
    """Return the recordings that are doubted: heard are the anchors of each, closures pairs of recordings, few heard twice."""
    ids = tuple(sorted({name for names in heard for name in names}))
    one = [(n, name) for n, names in enumerate(heard) for name in names]
    pose, anchor = np.array([(n, ids.index(name)) for n, name in one for _ in range(2 if (n, name) in few else 3)]).T
    i, j = np.array(closures, dtype=np.intp).reshape(-1, 2).T
    poses = np.zeros((len(heard), 3))
    estimate = estimate_of(
        Graph(poses, np.zeros((len(ids), 2))), ranges=plain_ranges(pose, anchor, np.ones(len(pose)), 0.1), anchor_ids=ids,
        closures=replace(no_closures(), edges=relative_edges(poses, i, j, [0.1, 0.1, 0.1])),
    )  # fmt: skip
    task = task_of(recordings_of(poses, None, np.arange(len(heard))))
    found = [finding for finding in check_untied_recordings(estimate, task) if finding.severity == "doubt"]
    assert all(finding.kind == "untied-parts" for finding in found)
    return {finding.figures["recording"]: finding.figures["moved"] for finding in found}


@pytest.mark.parametrize(("heard", "doubts"), [
    ([["A", "B"], ["A", "B"]], {}),
    ([["A", "B", "C"], ["A", "B", "C#2"]], {2: ["C"]}),
    ([["A", "B", "C", "D"], ["A", "B", "C", "D#2"]], {}),
    ([["A", "B", "C", "D"], ["A", "B", "C#2", "D#2"]], {2: ["C", "D"]}),
    ([["A", "B", "C"], ["A", "B", "C#2"], ["A", "B", "C#2"]], {1: ["C"]}),
    ([["A", "A@2", "B", "C"], ["A@2", "B", "C"]], {}),
    ([["A", "B", "C", "C#2"]], {}),
])  # fmt: skip
def test_anchors_that_agree_are_a_majority_or_a_doubt(heard, doubts):
    assert doubted(heard) == doubts


def test_a_closure_with_another_recording_ties_and_one_of_its_own_does_not():
    heard = [["A", "B", "C"], ["A", "B", "C#2"]]
    assert doubted(heard, [(0, 1)]) == {}
    assert doubted(heard, [(1, 1)]) == {2: ["C"]}


def test_an_anchor_heard_twice_says_nothing():
    heard = [["A", "B", "C"], ["A", "B", "C#2"]]
    assert doubted(heard, few=[(1, "C#2")]) == {}
