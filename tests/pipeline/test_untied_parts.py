"""Parts of a map that only the odometry ties are a doubt; a gap that scans, closures or anchors bridge is none."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.graph.calibration import scan_indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.untied_parts import check_untied_parts
from uwblite.sensor_log import LaserScans, Odometry, SensorLog

STAMPS = np.arange(100.0)
POSES = np.column_stack([0.3 * STAMPS, np.zeros(100), np.zeros(100)])


def measured(*spans):
    """Ranges of anchors from and until a time (s), each second."""
    at = [np.arange(*span, dtype=np.float64) for span in spans]
    stamps, anchor = np.concatenate(at), np.repeat(np.arange(len(spans)), [len(a) for a in at])
    count = len(stamps)
    zero = np.zeros(count)
    return RangeEdges(
        stamps.astype(np.int64), anchor, zero + 1.0, zero + 1.0, np.zeros((count, 2)), zero, np.zeros((count, 2)), np.zeros(2),
        zero, np.full((count, 6), -1), stamps=stamps,
    )  # fmt: skip


def scan_edge(i, j):
    none = np.zeros((1, 3))
    return ScanEdges(np.array([i]), np.array([j]), none, np.eye(3)[None], none, none, scan_indices(Calibration()))


def untied(ranges=None, scans_at=None, edges=(), poses=POSES):
    """Return from when to when the parts of a drive of 100 keyframes are untied."""
    readings = None if scans_at is None else np.ones((len(scans_at), 3), np.float32)
    scans = None if scans_at is None else LaserScans(scans_at, readings, -1.0, 1.0, 0.0, 0.0, 5.0)
    log = SensorLog(Odometry(STAMPS, poses), None, scans)
    recording = SimpleNamespace(
        log=log, frames=SimpleNamespace(stamps=STAMPS), rows=slice(0, 100), has=lambda keyframe: keyframe < 100,
        has_scans=scans is not None,
    )  # fmt: skip
    stages = Stages(None, None)
    graph = Graph(poses, np.zeros((4, 2)), edges=edges)
    task = SimpleNamespace(recordings=SimpleNamespace(each=[recording]), stages=stages)
    check_untied_parts(SimpleNamespace(graph=graph, ranges=ranges), task)
    return [(n.figures["start"], n.figures["end"]) for n in stages.doubts]


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


def test_a_robot_that_stands_needs_no_scans():
    assert untied(scans_at=WITHOUT, poses=0.01 * POSES) == []


@pytest.mark.parametrize(("first", "last", "named"), [(6, 20, True), (5, 20, False), (80, 94, True), (80, 95, False)])
def test_a_part_of_a_few_keyframes_is_too_small_for_a_word(first, last, named):
    """At either end: so many keyframes before the silence, or behind it."""
    assert len(untied(scans_at=np.concatenate([np.arange(0.0, first), np.arange(last, 100.0)]))) == named
