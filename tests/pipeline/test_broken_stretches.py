"""The map is at least as probable as its parts: a torn path is mended, one that only the radio denies is not."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.laser_walks import HALL
from helpers.planted import aligned_error, chain, odometry, ranges, scans, wander
from helpers.told import told

from uwblite import se2
from uwblite.assessment.causes import explained
from uwblite.constraints import Constraints
from uwblite.graph.calibration import LASER, indices
from uwblite.graph.pose_edges import ScanEdges
from uwblite.lidar.scan_matching import pairs_of
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.pipeline import keyframe_data
from uwblite.pipeline.anchor_places import decide_places
from uwblite.pipeline.broken_steps import _without_unused, broken_steps, range_evidence
from uwblite.pipeline.broken_stretches import _likelihood, _stretch, replace_broken_stretches
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.lidar_stages import refine_jointly
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import dead_reckoning, with_range_noise
from uwblite.pipeline.recordings import gather
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.radio.place_evidence import Explanation
from uwblite.radio.trilateration import AnchorHypothesis
from uwblite.sensor_log import SensorLog, SensorMounting

ANCHORS = np.array([[-7.5, -5.5], [7.5, -5.0], [6.5, 5.5], [-7.0, 5.0]])
SLIP = 40.0


def walked(shift=(0.0, 0.0), moved=(0, 1, 2, 3)):
    """Return an estimate at the true poses, all clouds matched, its task and the true poses.

    The wheels do not count a second of the way. From then on, the ranges to some anchors are those of anchors moved by a shift.
    """
    estimate, task, true = walked_once(shift, moved)
    task = replace(task, stages=Stages(None, None))
    task.stages.note("path-displaced", recording=1, stretch=(0.0, 9.0), start=0.0, anchors=["A"], apart=2.0, turned=0.0)
    return estimate, task, true


@cache
def walked_once(shift, moved):
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 40.0, half_width=4.0)
    motion = se2.between(truth[:-1], truth[1:])
    motion[(stamps[:-1] >= SLIP) & (stamps[:-1] < SLIP + 1.0)] *= [0.0, 0.0, 1.0]
    radio = ranges(rng, stamps, truth, ANCHORS, rate=0.75, sigma=0.05)
    tag = se2.interpolate_trajectory(stamps, truth, radio.stamps)[:, :2]
    place = ANCHORS[radio.anchor]
    late = (radio.stamps > SLIP) & np.isin(radio.anchor, moved)
    measured = radio.ranges + late * (np.hypot(*(place + shift - tag).T) - np.hypot(*(place - tag).T))
    log = SensorLog(
        odometry(stamps, chain(truth[0], motion)), replace(radio, ranges=measured),
        scans(stamps, truth, HALL, rate=4.0, sweep=0.0, range_max=6.0, noise=0.01, rng=rng),
        SensorMounting(anchor_height=0.0),
    )  # fmt: skip
    task = Task(gather([log], KeyframeConfig()), MappingConfig(), Constraints(), Stages(None, None))
    estimate, true = (
        dead_reckoning(task.recordings.each[0], task.config),
        se2.interpolate_trajectory(stamps, truth, task.recordings.stamps),
    )
    graph = replace(estimate.graph, poses=true, anchors=ANCHORS.copy())
    yes = np.ones(4, dtype=bool)
    estimate = replace(estimate, graph=graph, bootstrap=BootstrapResult(graph, yes, ((),) * 4, ~yes))
    estimate = replace(estimate, scans=keyframe_data.make(task.recordings, task.config, 0.0, task.stages.work))
    return refine_jointly(estimate, task), task, true


def torn(estimate, task, by):
    """Return the estimate whose scans say that the slip went further, by a motion (3,), and deny nothing of that."""
    k = int(np.searchsorted(task.recordings.stamps, SLIP + 0.5))
    poses, joint = estimate.graph.poses.copy(), estimate.joint
    poses[k:] = se2.compose(se2.compose(se2.compose(poses[k - 1], by), se2.inverse(poses[k - 1])), poses[k:])
    joint = joint.rows((joint.i >= k) == (joint.j >= k))
    one, none = np.array([k - 1]), np.zeros((1, 3))
    step = ScanEdges(
        one, one + 1, se2.between(poses[one], poses[one + 1]), np.diag([100.0, 100.0, 300.0])[None], none, none,
        indices(estimate.graph.calibration, *LASER), kernel=joint.kernel,
    )  # fmt: skip
    joint = joint.followed_by(step)
    graph = replace(estimate.graph, poses=poses)
    return with_range_noise(replace(estimate, graph=graph, joint=joint), task.config)


def test_a_path_that_scans_tore_by_three_metres_over_a_slip_is_mended():
    sound, task, true = walked()
    estimate = torn(sound, task, np.array([3.0, 0.0, 0.0]))
    assert aligned_error(estimate.graph.poses[:, :2], true[:, :2]) > 1.0
    assert range_evidence(estimate, task) < range_evidence(sound, task)
    task.stages.note("clock-offset", offset=0.1)
    mended = replace_broken_stretches(estimate, task)
    assert aligned_error(mended.graph.poses[:, :2], true[:, :2]) < 0.05
    # Their constant errors are unknown.
    np.testing.assert_allclose(mended.graph.anchors, ANCHORS, atol=0.4)
    finding = told(task.stages.facts)[-1]
    assert (finding.kind, finding.severity, finding.sensor, finding.recording) == ("worse-than-parts", "doubt", "lidar", 1)
    ((begin, end),) = finding.stretches
    assert SLIP - 2.0 < begin < end < SLIP + 4.0
    assert finding.figures["off"] == pytest.approx(3.0, abs=0.5)
    assert int(re.search("`end=([0-9]+)`", finding.cure)[1]) == pytest.approx(SLIP, abs=2.0)
    assert "`use_lidar=false`" in finding.cure
    # Along the mended path no anchor seems displaced any more; what was said of clocks has another cause.
    by_kind = {finding.kind: finding.explained_by for finding in explained(told(task.stages.facts))}
    assert by_kind == {"clock-offset": (), "worse-than-parts": ()}


def test_a_radio_that_is_wrong_as_a_whole_is_not_followed():
    """All anchors seem to be moved as one, and a broken step would explain that; both sides of it saw the same walls."""
    estimate, task, _ = walked(shift=(2.5, -1.5))
    estimate = with_range_noise(estimate, task.config)
    ((gain, step),) = broken_steps(estimate, task, np.zeros(0, dtype=np.intp))
    assert gain > 0.0
    assert len(step.moves) >= 3
    placed = decide_places(estimate, task)
    assert replace_broken_stretches(placed, task) is placed


def test_one_anchor_that_is_moved_breaks_no_path():
    estimate, task, _ = walked(shift=(2.5, -1.5), moved=(1,))
    placed = decide_places(with_range_noise(estimate, task.config), task)
    stages = len(task.stages.done)
    assert replace_broken_stretches(placed, task) is placed
    assert [fact.kind for fact in task.stages.facts] == ["moved-anchor"]
    assert len(task.stages.done) == stages


def test_a_sound_path_stays_and_costs_no_solution():
    """A slip that the scans followed rightly is no broken step; what was said of an earlier path is said no more."""
    estimate, task, _ = walked()
    assert replace_broken_stretches(estimate, task) is estimate
    assert (task.stages.facts, task.stages.done) == ([], [])


def test_a_torn_path_is_mended_though_no_anchor_seems_to_move():
    """The steps at which wheels slip are suspects as well."""
    sound, task, true = walked()
    estimate = torn(sound, task, np.array([3.0, 0.0, 0.0]))
    task.stages.facts.clear()
    mended = replace_broken_stretches(estimate, task)
    assert aligned_error(mended.graph.poses[:, :2], true[:, :2]) < 0.05
    assert told(task.stages.facts)[-1].kind == "worse-than-parts"


def test_an_anchor_that_seemed_moved_along_a_path_since_mended_has_one_place():
    estimate, task, _ = walked()
    estimate = with_range_noise(estimate, task.config)
    ranges = estimate.ranges
    late = (ranges.stamps > SLIP) & (ranges.anchor == 1)
    yes, anchors = np.ones(5, dtype=bool), np.vstack([ANCHORS, ANCHORS[1] + [2.5, -1.5]])
    graph = replace(estimate.graph, anchors=anchors, fixed_anchors=~yes)
    split = replace(
        estimate, graph=graph, anchor_ids=(*estimate.anchor_ids, f"{estimate.anchor_ids[1]}@2"),
        ranges=replace(ranges, anchor=np.where(late, 4, ranges.anchor)), bootstrap=BootstrapResult(graph, yes, ((),) * 5, ~yes),
    )  # fmt: skip
    task.stages.note("moved-anchor", anchor=estimate.anchor_ids[1], distance=2.9, recording=1, new_id="2")
    found = replace_broken_stretches(split, task)
    assert found.anchor_ids == estimate.anchor_ids
    assert [fact.kind for fact in task.stages.facts if fact.kind != "clock-offset"] == []
    np.testing.assert_allclose(found.graph.anchors, ANCHORS, atol=0.4)


@pytest.mark.parametrize("part", ["scans", "ranges", "joint"])
def test_without_lidar_or_radio_nothing_competes(part):
    estimate, task, _ = walked()
    estimate = replace(estimate, **{part: None})
    assert replace_broken_stretches(estimate, task) is estimate


def test_the_stretch_is_the_slip_around_the_broken_step():
    estimate, task, _ = walked()
    k = int(np.searchsorted(task.recordings.stamps, SLIP + 0.5))
    first, last = _stretch(estimate, task, k)
    stamps = task.recordings.stamps
    assert SLIP - 1.0 < stamps[first] < stamps[k] <= stamps[last] < SLIP + 2.0


def test_rays_are_less_probable_beside_their_walls():
    sound, _, _ = walked()
    clouds, poses = sound.lidar.clouds, sound.graph.poses
    i = np.arange(0, 40, 4)
    at = se2.between(poses[i], poses[i + 1])
    rays, pairs = _likelihood(sound), pairs_of(clouds, i, i + 1)
    right, wrong = (rays.log_likelihood(pairs, pose) for pose in (at, se2.compose(at, np.array([0.5, 0.5, 0.0]))))
    assert np.all(right > wrong)
    assert rays.log_likelihood(pairs.rows(i[:0]), at[:0]).shape == (0,)


@pytest.mark.parametrize(("place", "renumbered", "left"), [
    ([0, 0, 1, 2], [0, 0, 1, 2], "abc"), ([0, 0, 2, 2], [0, 0, 1, 1], "ac"), ([0, -1, 2, 2], [0, -1, 1, 1], "ac"),
    ([1, 1], [0, 0], "b"),
])  # fmt: skip
def test_a_place_whose_ranges_are_all_of_others_is_none(place, renumbered, left):
    """A move that a broken step explains leaves a gap in the numbers of the places after it."""
    places = {name: AnchorHypothesis(np.full(2, float(k)), 0.0, 0.1, 0.0, 0.1) for k, name in enumerate("abc")}
    each = _without_unused(Explanation(np.array(place), tuple(places.values()), 3.0))
    assert each.place.tolist() == renumbered
    assert each.found == tuple(places[name] for name in left)
