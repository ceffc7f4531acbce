"""Where anchors stood and when: planted moves are found and told, sound anchors of a torn path are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted import odometry, ranges, wander
from helpers.planted_graphs import relative_edges
from helpers.room_recording import ANCHORS, recording, two_rounds
from helpers.told import doubted, warned

from uwblite import se2
from uwblite.constraints import Constraints, GivenAnchor
from uwblite.graph.pose_edges import ScanEdges
from uwblite.loop_closure.closures import no_closures
from uwblite.mapping import build_map
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.pipeline.anchor_places import _moves, _names, decide_places
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.joining import _one_graph
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import dead_reckoning
from uwblite.pipeline.recordings import gather
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.sensor_log import SensorLog, SensorMounting


@pytest.mark.slow
@pytest.mark.parametrize("lidar", [False, True])
def test_a_moved_anchor_has_a_row_for_each_place(lidar):
    truth = two_rounds()
    log = recording(truth).without(lidar=not lidar)
    tag = se2.interpolate_trajectory(log.odometry.stamps, log.odometry.poses, log.ranges.stamps)[:, :2]
    old, new = np.array(ANCHORS["B2"]), np.array([2.8, 5.2])
    moved = (log.ranges.anchor == log.ranges.anchor_ids.index("B2")) & (log.ranges.stamps > 180.0)
    ranges = log.ranges.ranges + moved * (np.hypot(*(new - tag).T) - np.hypot(*(old - tag).T))
    result = build_map(replace(log, ranges=replace(log.ranges, ranges=ranges)))
    by_id = {a.id: a for a in result.anchors}
    assert set(by_id) == {"A1", "B2", "B2@2", "C3"}
    assert [n.kind for n in result.warnings if n.kind == "moved-anchor"] == ["moved-anchor"]
    # The map begins at the first pose, which is the truth's.
    for name, place in (("B2", old), ("B2@2", new), ("A1", ANCHORS["A1"])):
        assert by_id[name].status == "ok"
        assert np.hypot(*(by_id[name].position - place)) < 0.3
    assert by_id["B2"].since < 101.0
    assert abs(by_id["B2@2"].since - 180.0) < 5.0
    assert np.isnan(by_id["A1"].since)


@pytest.mark.slow
def test_anchors_that_change_names_at_once_are_distinguished():
    log = recording(two_rounds())
    ranges, following = log.ranges, np.array([1, 2, 0])
    renamed = np.where(ranges.stamps > 180.0, following[ranges.anchor], ranges.anchor)
    result = build_map(replace(log, ranges=replace(ranges, anchor=renamed)))
    by_id = {a.id: a for a in result.anchors}
    names = ranges.anchor_ids
    assert set(by_id) == {*names, *(f"{name}@2" for name in names)}
    for k, name in enumerate(names):
        assert np.hypot(*(by_id[name].position - ANCHORS[name])) < 0.3
        assert np.hypot(*(by_id[f"{names[following[k]]}@2"].position - ANCHORS[name])) < 0.3


PLACES = np.array([[-7.0, -6.0], [7.5, -5.0], [6.0, 7.0], [-6.5, 6.0]])
NAMES = ("A", "B", "C", "D")


def planted(seeds=(0,), moves=(), held=True, given=None, names=None, metres=80.0, height=None):
    """Return an estimate of true poses, and its task: four anchors around a room of 10 x 10 m.

    moves : (recording, anchor, metres (2,), time in s, time in s until which it is carried). held : scans hold the path.
    height : of the anchors, m, where it is given.
    """
    logs, truths, mounting = [], [], SensorMounting(anchor_height=height)
    for number, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        stamps, truth = wander(rng, metres)
        radio = ranges(rng, stamps, truth, PLACES, rate=0.6, sigma=0.05, bias=0.1 * rng.random(4), outliers=0.05)
        tag = se2.interpolate_trajectory(stamps, truth, radio.stamps)[:, :2]
        measured = radio.ranges.copy()
        for of, anchor, by, since, until in moves:
            share = np.clip((radio.stamps - since) / max(until - since, 1e-3), 0.0, 1.0)[:, None] * np.asarray(by)
            longer = np.hypot(*(PLACES[anchor] + share - tag).T) - np.hypot(*(PLACES[anchor] - tag).T)
            measured += longer * ((radio.anchor == anchor) & (of == number))
        logs.append(SensorLog(odometry(stamps, truth), replace(radio, ranges=measured, anchor_ids=NAMES), mounting=mounting))
        truths.append((stamps, truth))
    task = Task(gather(logs, KeyframeConfig()), MappingConfig(), given or Constraints(), Stages(None, None))
    estimates = []
    for r, (stamps, truth) in zip(task.recordings.each, truths, strict=True):
        one = dead_reckoning(r, task.config)
        graph = replace(one.graph, poses=se2.interpolate_trajectory(stamps, truth, r.frames.stamps), anchors=PLACES)
        yes = np.ones(4, dtype=bool)
        estimates.append(replace(one, graph=graph, bootstrap=BootstrapResult(graph, yes, ((),) * 4, ~yes)))
    estimate = estimates[0]
    if len(estimates) > 1:
        called = [list(NAMES) for _ in estimates] if names is None else names
        estimate = _one_graph(estimates, [np.zeros(3) for _ in estimates], called, task.recordings)
    first = np.flatnonzero(np.diff(task.recordings.of_keyframe) == 0)
    steps = scans(estimate.graph.poses, first, first + 1)
    return replace(estimate, steps=steps if held else None), task


def scans(poses, i, j):
    e = len(i)
    none, root = np.zeros((e, 3)), np.tile(np.diag([100.0, 100.0, 300.0]), (e, 1, 1))
    return ScanEdges(i, j, se2.between(poses[i], poses[j]), root, none, none, np.full(4, -1))


def told(task):
    return [(w.kind, w.figures["anchor"], w.figures["new_id"]) for w in warned(task.stages)]


@pytest.mark.parametrize("held", [True, False])
def test_anchors_that_stay_keep_their_names_and_nothing_is_told(held):
    estimate, task = planted(held=held)
    assert decide_places(estimate, task) is estimate
    assert (warned(task.stages), doubted(task.stages)) == ([], [])


@pytest.mark.parametrize("given", [False, True])
def test_an_anchor_at_another_optimum_is_put_where_its_ranges_have_it(given):
    """It was placed along a path by wheels that slipped; a place that the user gave stays."""
    estimate, task = planted(given=Constraints((GivenAnchor("C"),)) if given else None)
    elsewhere = np.vstack([PLACES[:2], [[-25.0, -20.0]], PLACES[3:]])
    estimate = replace(estimate, graph=replace(estimate.graph, anchors=elsewhere))
    found = decide_places(estimate, task)
    assert found.anchor_ids == NAMES
    np.testing.assert_allclose(found.graph.anchors, elsewhere if given else PLACES, atol=0.4)
    assert (warned(task.stages), doubted(task.stages)) == ([], [])


def test_an_anchor_that_was_moved_since_an_earlier_map_stays_told():
    """What is said of its given place is no part of a decision that is made again."""
    estimate, task = planted(moves=[(0, 1, (-2.0, 1.5), 70.0, 70.0)])
    task.stages.note("moved-anchor", anchor="C", distance=2.0)
    decide_places(decide_places(estimate, task), task)
    assert [w.figures["anchor"] for w in warned(task.stages)] == ["C", "B"]


@pytest.mark.parametrize("held", [True, False])
def test_an_anchor_that_is_moved_has_two_places(held):
    estimate, task = planted(moves=[(0, 1, (-2.0, 1.5), 70.0, 70.0)], held=held, height=None if held else 0.0)
    found = decide_places(estimate, task)
    assert found.anchor_ids == (*NAMES, "B@2")
    assert told(task) == [("moved-anchor", "B", "B@2")]
    assert doubted(task.stages) == []
    np.testing.assert_allclose(found.graph.anchors[[1, 4]], [PLACES[1], PLACES[1] + [-2.0, 1.5]], atol=0.3)
    second = found.ranges.stamps[found.ranges.anchor == 4]
    assert abs(second.min() - 70.0) < 4.0
    assert "from then on it is called B@2" in warned(task.stages)[0].text
    # The constant error is the radio's, wherever it stands.
    assert len(set(found.ranges.calibration[np.isin(found.ranges.anchor, [1, 4]), 1].tolist())) == 1


def test_ranges_of_an_anchor_that_is_carried_do_not_count():
    estimate, task = planted(moves=[(0, 1, (-15.0, 9.0), 80.0, 130.0)], metres=120.0)
    found = decide_places(estimate, task)
    assert found.anchor_ids == (*NAMES, "B@2")
    left_out = found.ranges.stamps[estimate.ranges.alive & ~found.ranges.alive]
    assert 75.0 < left_out.min() < 105.0 < left_out.max() < 135.0
    assert f"(its {len(left_out)} ranges meanwhile were left out)" in warned(task.stages)[0].text


def torn(estimate, task, at, by, visits=False):
    """Return the estimate whose path is displaced from a time on by a step's error; scans follow it, other visits do not."""
    k = int(np.searchsorted(task.recordings.stamps, at))
    poses, before = estimate.graph.poses.copy(), estimate.graph.poses
    poses[k:] = se2.compose(se2.compose(se2.compose(poses[k - 1], by), se2.inverse(poses[k - 1])), poses[k:])
    i = np.arange(len(poses) - 1)
    closures = no_closures()
    if visits:
        early = np.arange(2, k - 2, 8)
        late = np.linspace(k + 2, len(poses) - 2, len(early)).astype(int)
        closures = replace(closures, edges=relative_edges(before, early, late, [0.02, 0.02, 0.01]))
    graph = replace(estimate.graph, poses=poses)
    return replace(estimate, graph=graph, steps=scans(poses, i, i + 1), closures=closures)


@pytest.mark.parametrize("by", [(1.5, 0.0, 0.0), (0.3, 0.2, -0.8)])
def test_where_the_path_is_torn_no_anchor_is_moved(by):
    """One step of the path explains the ranges to all anchors."""
    estimate, task = planted(height=0.0)
    found = decide_places(torn(estimate, task, 80.0, np.array(by)), task)
    assert found.anchor_ids == NAMES
    assert warned(task.stages) == []
    (doubt,) = doubted(task.stages)
    assert doubt.kind == "path-displaced"
    assert abs(doubt.figures["begin"] - 80.0) < 15.0
    assert doubt.figures["apart"] == pytest.approx(np.hypot(*by[:2]), abs=0.4)


def test_what_other_visits_saw_says_that_the_path_is_whole():
    """All anchors are moved as one: the path was broken, but for the scans that see the same walls before and after."""
    together = [(0, k, (2.0, -1.0), 80.0, 80.0) for k in range(4)]
    estimate, task = planted(moves=together, height=0.0)
    found = decide_places(torn(estimate, task, 80.0, np.zeros(3), visits=True), task)
    assert found.anchor_ids == (*NAMES, *(f"{name}@2" for name in NAMES))
    assert doubted(task.stages) == []


def test_an_anchor_that_is_moved_between_recordings_has_a_place_in_each():
    estimate, task = planted((0, 1, 2), moves=[(n, 2, (0.0, -1.5), -1.0, -1.0) for n in (1, 2)])
    found = decide_places(estimate, task)
    assert found.anchor_ids == (*NAMES, "C#2")
    assert told(task) == [("moved-anchor", "C", "C#2")]
    np.testing.assert_allclose(found.graph.anchors[4], PLACES[2] + [0.0, -1.5], atol=0.3)


def test_places_that_joining_set_apart_and_that_agree_are_one():
    names = [list(NAMES), ["A", "B", "C#2", "D"]]
    estimate, task = planted((0, 1), names=names)
    assert estimate.anchor_ids == (*NAMES[:3], "D", "C#2")
    found = decide_places(estimate, task)
    assert found.anchor_ids == NAMES
    assert len(found.graph.anchors) == len(found.placed) == len(found.bootstrap.hypotheses) == 4
    assert warned(task.stages) == []
    # Prior knowledge refers to anchors by their present numbers.
    estimate, task = planted((0, 1), names=names, given=Constraints((GivenAnchor("A"),)))
    assert decide_places(estimate, task).anchor_ids == estimate.anchor_ids


def test_names_say_which_place_of_which_recording():
    recording = np.repeat([0, 1, 2], 4)
    place = np.array([0, 0, 1, 1, 1, 1, -1, 2, 3, 3, 0, 4])
    assert _names("A", place, recording) == ["A", "A@2", "A@2#2", "A#3", "A@3#3"]


def test_an_estimate_without_ranges_stays():
    estimate, task = planted(metres=5.0)
    estimate = replace(estimate, ranges=None)
    assert decide_places(estimate, task) is estimate


@pytest.mark.parametrize("several", [False, True])
def test_each_change_of_place_is_told_with_its_times_its_way_and_the_ranges_meanwhile(several):
    """Within a recording from when to when, between recordings without times."""
    log = SimpleNamespace(odometry=SimpleNamespace(stamps=np.array([10.0, 90.0])))
    later = SimpleNamespace(odometry=SimpleNamespace(stamps=np.array([200.0, 290.0])))
    recordings = [SimpleNamespace(log=log), *([SimpleNamespace(log=later)] if several else [])]

    class Recordings(SimpleNamespace):
        def __len__(self):
            return len(self.each)

    task = SimpleNamespace(recordings=Recordings(each=recordings))
    place = np.array([-1, 0, 0, -1, -1, 1, 1, 0])
    stamps = np.array([11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 201.0])
    recording = np.array([0] * 7 + [int(several)])
    positions = np.array([[0.0, 0.0], [3.0, 4.0]])[place]
    names = ["A", "A@2"]
    first, second = _moves(task, positions, place, names, stamps, recording)
    assert (first.kind, first.figures) == (
        "moved-anchor",
        {"anchor": "A", "distance": 5.0, "recording": 1, "new_id": "A@2", "between": [4.0, 6.0, 2], "several": several},
    )
    told = {"anchor": "A@2", "distance": 5.0, "recording": 1 + several, "new_id": "A"}
    assert second.figures == told | ({} if several else {"between": [191.0, 191.0, 0], "several": False})
