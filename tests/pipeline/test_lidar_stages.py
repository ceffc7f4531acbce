"""What the lidar frees, which pairs of clouds it matches, and when a map contradicts itself."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import HALL, walked, with_a_walker
from helpers.planted import odometry, recording, scans, wander
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.told import doubted

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.work import Work
from uwblite.lidar.cloud_rasters import ScanClouds
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.pipeline import keyframe_data, lidar_stages, neighbour_matching, radio_stages
from uwblite.pipeline.lidar_stages import check_map_consistency
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.recordings import gather
from uwblite.radio.range_noise import RangeNoiseConfig

NO_PAIRS = ScanEdges(
    *(np.zeros(0, dtype=np.intp) for _ in range(2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3)),
    np.full(4, -1),
)

@pytest.mark.parametrize(("keys", "fixed"), [
    (("laser_x", "odometry_scale"), [False, True]), (("sideways_per_turn", "laser_x"), [True, False]),
    (("sideways_per_turn",), [False]),
])  # fmt: skip
def test_clouds_are_made_and_the_laser_is_free_from_then_on(keys, fixed):
    """Where its place is given, the wheels may turn about another point: both explain the same residuals."""
    stamps, truth = wander(np.random.default_rng(1), 3.0, half_width=4.0)
    log = recording(odometry(stamps, truth), None, scans(stamps, truth, HALL, rate=2.0, range_max=8.0))
    task = task_of(gather([log], KeyframeConfig()))
    calibration = Calibration(tuple(map(UnknownKey, keys)), np.zeros(len(keys)))
    graph = Graph(task.recordings.each[0].frames.odometry, calibration=calibration)
    before = estimate_of(replace(graph, fixed_calibration=np.ones(len(keys), dtype=bool)))
    made = neighbour_matching.make_clouds(before, task)
    points = len(made.scans.clouds.points)
    assert [(s.name, s.figures) for s in task.stages.done] == [("clouds", {"points": points})]
    assert points > 50 * len(graph.poses)
    assert made.graph.fixed_calibration.tolist() == fixed


def scans_placed_between(jitter, rate, *, speed=0.8):
    """Return stamps and true poses of a drive, its recording before and after scans between keyframes were placed, and the
    graph; the odometry's stamps are off by a jitter, s, the poses at keyframes are right."""
    rng = np.random.default_rng(2)
    stamps, truth = wander(rng, 20.0, speed=speed, half_width=4.0)
    off = np.clip(stamps + jitter * rng.standard_normal(len(stamps)), stamps[0], stamps[-1])
    wheels = odometry(stamps, se2.interpolate_trajectory(stamps, truth, off))
    log = recording(wheels, None, scans(stamps, truth, HALL, rate=rate, range_max=8.0))
    config = MappingConfig(keyframes=KeyframeConfig(scans=1))
    task = task_of(gather([log], config.keyframes), config)
    (one,) = task.recordings.each
    reckoned = radio_stages.dead_reckoning(one, config)
    graph = replace(reckoned.graph, poses=se2.interpolate_trajectory(stamps, truth, one.frames.stamps))
    estimate = replace(reckoned, graph=graph, scans=keyframe_data.make(task.recordings, config, 0.0, Work()), joint=NO_PAIRS)
    (after,) = lidar_stages.place_scans_between(estimate, task).recordings.each
    return stamps, truth, one, after, graph


@pytest.mark.parametrize(("jitter", "most"), [(0.0, 2), (0.05, np.inf)])
def test_scans_beyond_two_of_a_step_are_placed_only_where_these_contradict_the_odometry(jitter, most):
    _, _, one, after, _ = scans_placed_between(jitter, 20.0, speed=0.4)
    within = np.diff(np.flatnonzero(np.isin(after.between.frames.stamps, one.frames.stamps))) - 1
    assert 2 <= within.max() <= most
    assert (within.max() > 2) == (most > 2)


def test_scans_between_keyframes_show_where_the_robot_was_when_stamps_of_the_odometry_jitter():
    stamps, truth, one, after, graph = scans_placed_between(0.05, 5.0)
    log = one.log
    inside = log.scans.middles[(log.scans.middles > one.frames.stamps[0]) & (log.scans.middles < one.frames.stamps[-1])]
    right = se2.interpolate_trajectory(stamps, truth, inside)
    turned = [
        np.abs(se2.between(right, r.dense_trajectory(graph.poses, inside))[:, 2]).mean() for r in (one, after)
    ]
    assert turned[1] < 0.6 * turned[0]
    np.testing.assert_allclose(after.dense_trajectory(graph.poses, one.frames.stamps), graph.poses, atol=1e-9)
    np.testing.assert_array_equal(after.trajectory_stamps, stamps)
    thinner = replace(after, log=replace(log, odometry=log.odometry.rows(slice(None, None, 2))))
    assert np.isin(after.between.frames.stamps, thinner.trajectory_stamps).all()


def test_ranges_whose_errors_are_their_own_are_not_corrected_by_direction():
    graph = Graph(np.zeros((2, 3)), np.array([[3.0, 1.0]]))
    ranges = plain_ranges(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp), np.array([3.2]), 0.1)
    none, some = estimate_of(graph), estimate_of(graph, ranges=ranges)
    task = task_of(config=replace(MappingConfig(), ranges=RangeNoiseConfig(steady=0.0)))
    assert lidar_stages._without_pattern(some, task) is some
    assert lidar_stages._without_pattern(none, task_of()) is none
    assert lidar_stages._without_pattern(some, task_of()) is not some


@pytest.mark.parametrize("torn", [False, True])
def test_a_map_whose_visits_do_not_show_the_same_place_is_doubted(torn):
    """Half of a walk lies two metres aside."""
    truth, _, clouds = walked(3)
    poses = truth.copy()
    if torn:
        poses[len(truth) // 2 :] = se2.compose(np.array([2.0, 1.0, 0.0]), truth[len(truth) // 2 :])
    estimate, task = estimate_of(Graph(poses), scans=ScanClouds(clouds, None, 0.0)), task_of(recordings_of(truth))
    assert check_map_consistency(estimate, task) is estimate
    assert [n.kind for n in doubted(task.stages)] == ["free-space-violation"] * torn


def test_people_who_walk_along_explain_violated_free_space(monkeypatch):
    """They show within one visit as well: no doubt, however small the share that is one without them."""
    truth, _, clouds = walked(3)
    clouds = with_a_walker(truth, clouds)
    estimate, task = estimate_of(Graph(truth), scans=ScanClouds(clouds, None, 0.0)), task_of(recordings_of(truth))
    monkeypatch.setattr(lidar_stages, "_VIOLATION", 0.001)
    check_map_consistency(estimate, task)
    assert task.stages.done[-1].figures["free_space_violation"] > 0.001
    assert doubted(task.stages) == []


def test_pairs_of_one_visit_do_not_lead_across_a_step_that_clouds_measure_falsely():
    """Those between visits do: their clouds are compared at the poses that everything else gives."""
    truth, _, clouds = walked(3)
    settings, graph, task = MappingConfig().refinement, Graph(truth), task_of(recordings_of(truth))
    estimate = estimate_of(graph, scans=ScanClouds(clouds, None, 0.0))
    false, near = len(truth) // 2, max(settings.neighbours)
    every = set(zip(*(part.tolist() for part in lidar_stages.pairs(estimate, graph, settings, task)), strict=True))
    rejected = replace(estimate, rejected=np.arange(len(truth)) == false)
    kept = set(zip(*(part.tolist() for part in lidar_stages.pairs(rejected, graph, settings, task)), strict=True))
    across = {(i, j) for i, j in every if i <= false < j}
    assert every - kept == {(i, j) for i, j in across if j - i <= near} != set()
    assert any(j - i > near for i, j in across)


def test_a_scan_between_keyframes_is_placed_by_the_cloud_of_the_farther_one():
    """That of the nearer one may hold the scan itself."""
    _, _, one, after, _ = scans_placed_between(0.05, 5.0)
    own, between = one.frames.stamps, after.between
    inside = ~np.isin(between.frames.stamps, own)
    stamps, keyframe = between.frames.stamps[inside], between.keyframe[inside]
    step = np.searchsorted(own, stamps) - 1
    nearer_to_the_first = stamps - own[step] < own[step + 1] - stamps
    assert len(stamps) > 10
    assert 0 < nearer_to_the_first.sum() < len(stamps)
    even = np.isclose(stamps - own[step], own[step + 1] - stamps)
    np.testing.assert_array_equal((keyframe - step)[~even], nearer_to_the_first[~even].astype(int))
