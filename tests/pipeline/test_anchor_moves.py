"""An anchor that is moved during a recording has two rows, and the map holds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges
from helpers.room_recording import ANCHORS, recording, two_rounds

from uwblite import se2
from uwblite.constraints import Constraints
from uwblite.graph.graph import Graph
from uwblite.mapping import build_map
from uwblite.pipeline import anchor_moves, radio_stages
from uwblite.pipeline.anchor_moves import (
    _moves,
    _of_all,
    _renamed,
    _same,
    alike,
    first_with_moves_apart,
    optimised_with_names,
    said_of_places,
    short_ranges,
    with_moves_apart,
)
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import first_optimisation
from uwblite.pipeline.recordings import Recording, gather
from uwblite.radio.change_points import ON_GIVEN_PATH, ON_OWN_PATH, Move
from uwblite.radio.trilateration import AnchorHypothesis
from uwblite.sensor_log import Odometry, SensorLog, SensorMounting, UwbRanges


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


def moved(stamp, far=1.0, left=None):
    places = (AnchorHypothesis(np.array([x, 0.0]), 0.0, 0.1, 0.0, 0.1) for x in (0.0, far))
    return Move(stamp if left is None else left, stamp, *places)


def four_ranges(**moves):
    """Return a log of ranges at t = 0, 1, 2, 3 s to A and B in turn twice, with moves applied."""
    stamps = np.repeat(np.arange(4.0), 2)
    ranges = UwbRanges(stamps, np.tile([0, 1], 4), np.ones(8), np.ones(8), ("A", "B"))
    log = SensorLog(Odometry(np.array([0.0, 9.0]), np.zeros((2, 3))), ranges, None, SensorMounting(anchor_heights={"A": 2.0}))
    return _renamed(log, moves)


def names(log):
    return [log.ranges.anchor_ids[k] for k in log.ranges.anchor]


def test_ranges_have_another_name_from_each_move_on():
    """From the first range at the second place on; a given height stays with the anchor; the recording says so."""
    log = four_ranges(A=[moved(1.0, 0.7), moved(3.0)])
    assert names(log) == ["A", "B", "A@2", "B", "A@2", "B", "A@3", "B"]
    assert log.mounting.anchor_heights == {"A": 2.0, "A@2": 2.0, "A@3": 2.0}
    first, second = log.screening.findings
    assert first.text == "anchor A was moved by 0.7 m at about t = 1 s; from then on it is called A@2"
    assert second.text.endswith("it is called A@3")
    assert [(remark.anchor, remark.cure) for remark in (first, second)] == [("A@2", ""), ("A@3", "")]
    assert names(four_ranges(B=[moved(2.0)])) == ["A", "B", "A", "B", "A", "B@2", "A", "B@2"]
    assert names(four_ranges()) == ["A", "B"] * 4


def test_readings_of_an_anchor_that_is_carried_are_no_distances():
    log = four_ranges(A=[moved(3.0, left=1.0)])
    assert names(log) == ["A", "B"] * 3 + ["A@2", "B"]
    assert log.ranges.ranges.tolist() == [1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0]
    said = "moved by 1.0 m between t = 1 and 3 s (its 2 ranges meanwhile were left out); from then on it is called A@2"
    assert log.screening.findings[0].text == f"anchor A was {said}"
    # Where it was put down is looked for in all ranges again.
    assert not _same(four_ranges(A=[moved(3.0)]).ranges, log.ranges, {})
    assert _same(four_ranges(A=[moved(3.0)]).ranges, log.ranges, {"A": [moved(3.0)]})


def test_two_ranges_at_each_move_may_be_called_otherwise():
    one, none = four_ranges(A=[moved(1.0)]).ranges, four_ranges().ranges
    moves = {"A": [moved(1.0)]}
    assert not _same(one, none, moves)  # three ranges have another name
    assert _same(one, four_ranges(A=[moved(3.0)]).ranges, moves)
    assert not _same(one, four_ranges(A=[moved(3.0)]).ranges, {})
    assert _same(one, none, {"A": [moved(1.0)], "B": [moved(2.0)]})
    assert _same(None, none, {})


def test_moves_of_about_the_same_time_are_one_for_all_anchors():
    """Each is compared with the one before it: 10, 40 and 70 s are one, 100.1 s is another."""
    moves = {"A": [moved(40.0), moved(100.1)], "B": [moved(10.0, left=3.0), moved(70.0)]}
    found = _of_all(four_ranges(), moves)
    assert list(found) == ["A", "B"]
    assert [m.stamp for m in found["A"]] == [m.left for m in found["B"]] == [10.0, 100.1]
    assert _of_all(replace(four_ranges(), ranges=None), moves) == {}


@pytest.mark.parametrize(("found", "again", "called"), [
    ({}, {}, None), ({"A": [1.0]}, {}, None), ({"A": [1.0]}, {"B": [2.0]}, ["A", "B", "A", "B", "A", "B@2", "A", "B@2"]),
])  # fmt: skip
def test_moves_are_those_of_the_trajectory_that_presumes_none(monkeypatch, found, again, called):
    """Where one moved, all anchors are apart before and after in a first optimisation, whose warnings are forgotten."""
    log, seen, stages = four_ranges(), [], Stages(None, None)
    results = iter([[{k: [moved(t) for t in v] for k, v in moves.items()}] for moves in (found, again)])
    monkeypatch.setattr(anchor_moves, "_moves_of_all", lambda *args: next(results))
    monkeypatch.setattr(anchor_moves, "gather", lambda logs, keyframes: seen.append(names(logs[0])))
    monkeypatch.setattr(anchor_moves, "first_optimisation", lambda task, known: task.stages.warn("bent", ""))
    task = Task(SimpleNamespace(each=[SimpleNamespace(log=log)]), MappingConfig(), Constraints(), stages)
    renamed = first_with_moves_apart(SimpleNamespace(alone=()), task, [log])
    assert (renamed if called is None else names(renamed[0])) == called
    assert seen == ([["A", "B"] + ["A@2", "B@2"] * 3] if found else [])
    assert stages.warnings == []


def test_renamings_are_alike_with_the_same_names_ranges_and_remarks():
    one = four_ranges(A=[moved(3.0, left=1.0)])
    assert alike(one, four_ranges(A=[moved(3.0, left=1.0)]))
    assert alike(four_ranges(), four_ranges())
    for other in ([moved(2.0, left=1.0)], [moved(3.0, left=2.0)], [moved(3.0, 0.7, left=1.0)], []):
        assert not alike(one, four_ranges(A=other))
    silent = replace(one, ranges=None)
    assert alike(silent, replace(silent))
    assert not alike(one, silent)


def test_ranges_shorter_than_the_distance_are_counted_and_late_ones_not():
    residuals = np.array([[0.49], [0.51], [-3.0], [1.1]])
    ranges = SimpleNamespace(residuals=lambda graph: residuals, sigma=np.array([1.0, 1.0, 1.0, 0.5]))
    assert short_ranges(SimpleNamespace(ranges=ranges, graph=None)) == 2
    assert short_ranges(SimpleNamespace(ranges=None)) == 0


def test_a_recording_whose_names_stay_is_not_bootstrapped_again(monkeypatch):
    """The result is to the last bit that of recordings that were never called otherwise."""
    whole = recording(two_rounds()).without(lidar=True)
    logs = [whole.crop(70.0, 160.0), whole.crop(160.0, 250.0)]
    task = Task(gather(logs, MappingConfig().keyframes), MappingConfig(), Constraints(), Stages(None, None))
    middle = float(logs[1].ranges.stamps.mean())
    # A copy of the first, as _of_all makes one.
    renamed = [_renamed(logs[0], {"B2": []}), _renamed(logs[1], {"B2": [moved(middle)]})]
    assert renamed[0] is not logs[0]
    expected = first_optimisation(replace(task, recordings=gather(renamed, task.config.keyframes)))
    before, calls, find = first_optimisation(task), [], radio_stages.bootstrapped
    monkeypatch.setattr(radio_stages, "bootstrapped", lambda own, n, task: calls.append(n) or find(own, n, task))
    found, now = optimised_with_names(renamed, before, task)
    assert calls == [1]
    assert [own.log for own in now.recordings.each] == renamed
    assert "B2@2" in found.anchor_ids
    assert found.anchor_ids == expected.anchor_ids
    for name in ("poses", "anchors"):
        assert getattr(found.graph, name).tobytes() == getattr(expected.graph, name).tobytes()
    assert found.graph.calibration.values.tobytes() == expected.graph.calibration.values.tobytes()
    assert found.ranges.sigma.tobytes() == expected.ranges.sigma.tobytes()


def test_names_that_are_already_so_stay(monkeypatch):
    log, moves, needed = four_ranges(), {"A": [moved(1.0)]}, []
    monkeypatch.setattr(anchor_moves, "_moves_of_all", lambda *args: needed.append(args[-1]) or [moves])
    for now, stays in ((log, False), (four_ranges(**moves), True)):
        # A lidar holds the path, or sees next to nothing, so that ranges alone do, which takes more evidence.
        task = SimpleNamespace(recordings=SimpleNamespace(each=[SimpleNamespace(log=now, rows=slice(0, 8))]))
        renamed = with_moves_apart(SimpleNamespace(held_by_scans=np.arange(8) < (4 if stays else 3)), task, [log])
        assert (renamed is None) is stays
        assert needed.pop() is (ON_GIVEN_PATH if stays else ON_OWN_PATH)
        assert stays or names(renamed[0]) == ["A", "B", "A@2", "B", "A@2", "B", "A@2", "B"]


def test_moves_are_sought_in_the_level_part_of_usable_ranges(monkeypatch):
    """The second recording's ranges alone, without those that measure nothing: sqrt(range^2 - height^2) at the tag's places."""
    asked = {}

    def found(places, level, stamps, *rest):
        asked[stamps[0]] = places, level

    monkeypatch.setattr(anchor_moves, "find_moves", found)
    poses = np.array([[9.0, 9.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2]])
    edges = plain_ranges(np.array([0, 1, 1, 2, 2]), np.array([1, 0, 1, 0, 1]), np.array([4.0, 5.0, 2.0, np.nan, 1.0]), 0.1)
    edges = replace(edges, stamps=np.arange(5.0), height=np.array([0.0, 3.0, 0.0, 0.0, 2.0]), tag=np.array([0.5, 0.0]))
    estimate = SimpleNamespace(ranges=edges, bootstrap=True, graph=Graph(poses), tag_positions=edges.tag_positions)
    # As recorded: what the graph leaves out, because the anchor was carried then, is looked at again.
    as_recorded, edges = np.nan_to_num(edges.ranges[1:]), replace(edges, ranges=np.where(np.arange(5) == 2, 0.0, edges.ranges))
    ranges = UwbRanges(np.arange(1.0, 5.0), np.array([0, 1, 0, 1]), as_recorded, np.ones(4), ("A", "B"))
    second = Recording(1, None, range(2), 1)
    task = SimpleNamespace(config=MappingConfig())
    assert _moves(second, SensorLog(four_ranges().odometry, ranges), estimate, task, ON_OWN_PATH) == {}
    assert sorted(asked) == [1.0, 2.0]
    np.testing.assert_allclose(asked[1.0][0], [[0.5, 0.0]], atol=1e-12)
    np.testing.assert_allclose(asked[2.0][0], [[0.5, 0.0], [1.0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(asked[1.0][1], [4.0])
    np.testing.assert_allclose(asked[2.0][1], [2.0, 0.01])


def test_the_noise_by_which_moves_are_judged_is_that_of_the_recording_alone(monkeypatch):
    """Two recordings whose clocks show the same times hear one anchor, from 10 and from 20 m."""
    noises = []
    monkeypatch.setattr(anchor_moves, "find_moves", lambda at, level, stamps, sigma, *rest: noises.append(sigma))
    rng, recording = np.random.default_rng(2), np.repeat([0, 1], 100)
    stamps, values = np.tile(np.arange(100.0), 2), 10.0 + 10.0 * recording + 0.1 * rng.standard_normal(200)
    edges = replace(plain_ranges(recording, np.zeros(200, dtype=int), values, 0.1), stamps=stamps)
    estimate = SimpleNamespace(ranges=edges, bootstrap=True, graph=Graph(np.zeros((2, 3))))
    for number in range(2):
        own = recording == number
        ranges = UwbRanges(stamps[own], np.zeros(100, dtype=int), values[own], np.ones(100), ("A",))
        log = SensorLog(four_ranges().odometry, ranges)
        _moves(Recording(number, None, range(1), number), log, estimate, SimpleNamespace(config=MappingConfig()), ON_OWN_PATH)
    np.testing.assert_allclose(noises, 0.1, rtol=0.3)


def test_of_places_that_a_map_does_not_have_nothing_is_said_but_what_was_left_out():
    log = four_ranges(A=[moved(1.0, 0.7), moved(3.0, left=2.0)], B=[moved(2.0)])
    task = SimpleNamespace(recordings=SimpleNamespace(each=[SimpleNamespace(log=log)]))
    (whole,) = said_of_places(task, ["A", "A@2#2", "A@3", "B", "B@2"])
    assert whole.screening.findings == log.screening.findings
    (some,) = said_of_places(task, ["A", "A@2", "B"])
    said = [(remark.kind, remark.text) for remark in some.screening.findings]
    left_out = "between t = 2 and 3 s (its 1 ranges meanwhile were left out): both places are the same within their uncertainty"
    assert said == [
        ("moved-anchor", "anchor A was moved by 0.7 m at about t = 1 s; from then on it is called A@2"),
        ("sustained-outliers", f"anchor A seemed to be moved by 1.0 m {left_out}"),
    ]
    silent = SimpleNamespace(recordings=SimpleNamespace(each=[SimpleNamespace(log=replace(log, screening=None))]))
    assert said_of_places(silent, [])[0].screening is None
