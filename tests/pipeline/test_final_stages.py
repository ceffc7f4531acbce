"""The occupancy grid: a map larger than memory allows is drawn coarser, and that is said."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.room_recording import recording, two_rounds
from helpers.told import told

from uwblite import se2
from uwblite.graph.calibration import CalibrationConfig, block, unknowns
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.grid.occupancy_grid import GridConfig
from uwblite.mapping import MappingConfig, build_map
from uwblite.odometry.attached import choose_scans
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.pipeline import final_stages
from uwblite.pipeline.final_stages import _sweeps
from uwblite.pipeline.recordings import gather
from uwblite.problem.solution import at_given_poses
from uwblite.radio.range_noise import RangeNoiseConfig


@pytest.fixture(scope="module")
def room():
    log = recording(two_rounds())
    return log.crop(end=float(log.odometry.stamps[0]) + 6.0)


@pytest.mark.parametrize(("most", "kind"), [(10_000, "warnings"), (150, "doubts")])
def test_a_map_larger_than_allowed_is_drawn_coarser_and_reported(room, most, kind):
    result = build_map(room, replace(MappingConfig(), grid=GridConfig(max_cells=most)))
    assert result.grid.geometry.cells <= most
    (notice,) = [n for n in getattr(result, kind) if n.kind == "coarse-grid"]
    edge = result.grid.geometry.resolution
    assert notice.figures == {"resolution": edge, "asked": 0.05, "cells": most / 1e6}
    assert f"cells of {edge:g} m instead of 0.05 m" in notice.text


def test_sweeps_begin_and_end_where_the_laser_was_by_its_corrected_mounting_and_clock(room):
    """At the first ray and at the last one, ray count less one increments later, each by the delay after its stamp."""
    scans = replace(room.scans, time_increment=0.001)
    calibration = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
    values = calibration.values.copy()
    correction = {"laser_x": 0.1, "laser_y": -0.05, "laser_theta": 0.2, "laser_delay": 0.03}
    for name, value in correction.items():
        values[calibration.index(name)] = value
    (one,) = gather([replace(room, scans=scans)], KeyframeConfig()).each
    graph = Graph(one.frames.odometry, calibration=replace(calibration, values=values))
    sweeps = _sweeps(one, graph)
    mount = se2.compose(np.array([0.1, -0.05, 0.2]), room.mounting.T_base_laser)
    for found, later in ((sweeps.first, 0.03), (sweeps.last, 0.03 + 0.001 * (scans.ranges.shape[1] - 1))):
        base = one.dense_trajectory(graph.poses, scans.stamps + later)
        np.testing.assert_allclose(found, se2.compose(base, mount), atol=1e-12)


def test_at_given_poses_only_what_belongs_to_anchors_is_free_and_what_was_fixed_stays():
    keys = tuple(UnknownKey(kind) for kind in ("bias", "height2", "range_scale", "odometry_scale", "laser_x", "bias"))
    fixed = np.array([False, False, True, False, True, True])
    graph = Graph(np.zeros((3, 3)), np.zeros((2, 2)), (), Calibration(keys, np.zeros(6)), fixed_calibration=fixed)
    given = at_given_poses(graph)
    assert given.fixed_poses.all()
    assert not given.fixed_anchors.any()
    np.testing.assert_array_equal(given.fixed_calibration, [False, False, True, True, True, True])


def test_of_anchors_alone_heights_that_the_search_puts_back_to_0_stay_fixed():
    """What is free of poses, wheels and laser is free again afterwards. One anchor is 2 m above the tag; of the other one
    ranges are shorter than from its own height."""
    rng = np.random.default_rng(0)
    turn = np.linspace(0.0, 6.0, 60)
    poses = np.column_stack([4.0 * np.cos(turn), 3.0 * np.sin(2.0 * turn), 0.5 * turn])
    anchors, keys = np.array([[7.0, 1.0], [-2.0, 6.0]]), ("bias", "height2", "height2", "odometry_scale")
    pose, anchor = np.repeat(np.arange(60), 2), np.tile([0, 1], 60)
    level = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    measured = np.sqrt(level**2 + np.array([-0.5, 4.0])[anchor]) + 0.02 * rng.standard_normal(120)
    columns = np.full((120, 6), -1)
    columns[:, 2] = np.array([1, 2])[anchor]
    ranges = replace(plain_ranges(pose, anchor, measured, 0.05), calibration=columns, stamps=pose.astype(float))
    prior = PriorEdges("calibration", np.arange(4), np.zeros((4, 1)), np.array([10.0, 0.1, 0.1, 10.0])[:, None, None])
    graph = Graph(poses, anchors, (prior,), Calibration(tuple(map(UnknownKey, keys)), np.ones(4)), np.arange(60) == 0)
    before = estimate_of(graph, ranges=ranges)
    before = replace(before, graph=before.problem)
    found = final_stages._anchors_alone(before, task_of(recordings_of(poses))).graph
    assert found.fixed_calibration.tolist() == [False, True, False, False]
    assert found.fixed_poses.tolist() == [True] + [False] * 59
    assert found.calibration.values[1] == 0.0
    assert found.calibration.values[2] == pytest.approx(4.0, abs=0.5)
    np.testing.assert_allclose(found.anchors[1], anchors[1], atol=0.1)
    np.testing.assert_array_equal(found.poses, poses)


AWAY = np.array([0.3, -0.2])


def circled(anchors, **fixed):
    """Return an estimate of a robot that drives round anchors whose places are off by decimetres, and its task."""
    turn = np.linspace(0.0, 6.0, 80)
    poses = np.column_stack([4.0 * np.cos(turn), 3.0 * np.sin(turn), turn])
    pose, anchor = np.repeat(np.arange(80), len(anchors)), np.tile(np.arange(len(anchors)), 80)
    measured = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    ranges = replace(plain_ranges(pose, anchor, measured, 0.05), stamps=pose.astype(float))
    before = estimate_of(Graph(poses, anchors + AWAY, **fixed), ranges=ranges)
    return replace(before, graph=before.problem), recordings_of(poses)


@pytest.mark.parametrize(("steady", "free", "moved"), [(0.06, True, True), (0.0, True, False), (0.06, False, False)])
def test_anchors_are_estimated_alone_where_ranges_from_one_direction_err_alike_and_one_is_free(steady, free, moved):
    anchors = np.array([[7.0, 1.0], [-2.0, 6.0]])
    before, recordings = circled(anchors, fixed_anchors=np.full(2, not free))
    config = replace(MappingConfig(), ranges=RangeNoiseConfig(steady=steady))
    done = final_stages._anchors_alone(before, task_of(recordings, config)).graph.anchors
    np.testing.assert_allclose(done, anchors if moved else anchors + AWAY, atol=0.02)


def test_scans_far_from_all_others_are_told_and_left_out():
    """A pose that a false measurement has thrown kilometres away."""
    recordings = gather([recording(two_rounds())], KeyframeConfig())
    poses, task = recordings.each[0].frames.odometry.copy(), task_of(recordings)
    poses[-1, :2] += 1e5
    grid = final_stages.occupancy_grid(estimate_of(Graph(poses)), task)
    (finding,) = told(task.stages.facts)
    assert (finding.kind, finding.severity) == ("scans-astray", "doubt")
    assert finding.figures == {"scans": grid.scans_astray, "used": grid.scans_used}
    assert 0 < grid.scans_astray < grid.scans_used


def test_the_time_from_keyframes_to_scans_is_that_of_a_random_walk(room):
    """The mean of the walk's places at the times of the scans has the variance of one place at the time that is returned."""
    one = gather([room], KeyframeConfig()).each[0]
    owner, chosen = choose_scans(one.log.scans, one.frames, KeyframeConfig())
    expected = np.zeros(len(one.frames))
    for k in range(len(one.frames)):
        t = (one.log.scans.middles[chosen] - one.frames.stamps[owner])[owner == k]
        both = np.minimum(np.abs(t[:, None]), np.abs(t)) * (np.sign(t[:, None]) == np.sign(t))
        expected[k] = both.sum() / max(len(t), 1) ** 2
    np.testing.assert_allclose(final_stages.time_to_scans(one, KeyframeConfig()), expected, atol=1e-12)
    assert expected.max() > 0.0
