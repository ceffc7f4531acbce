"""Keyframes moved in time or added: exact measurements stay exact, and what was stated of a step is stated of its pieces."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.planted import box, odometry, ranges, recording, scans, wander

from uwblite import se2
from uwblite.graph.graph import PriorEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.work import Work
from uwblite.pipeline import keyframe_data
from uwblite.pipeline.keyframe_data import with_keyframes
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.radio_stages import dead_reckoning
from uwblite.pipeline.recordings import denser, gather, later
from uwblite.sensor_log import Odometry, SensorMounting

PLACES = np.array([[6.0, 4.5], [-6.0, 4.0], [5.5, -4.5]])
MOUNTING = SensorMounting(tag_position=np.array([0.2, -0.1, 0.0]), anchor_height=0.0)
CUT = np.array([3, 8])


@pytest.fixture(scope="module")
def exact():
    """Recordings whose odometry and ranges have no error, and the true estimate."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 15.0)
    seen = scans(stamps, truth, box(14, 11), rate=40.0, beams=20, sweep=0.02)
    radio = ranges(rng, stamps, truth, PLACES, sigma=0.0, tag=(0.2, -0.1))
    config = MappingConfig()
    recordings = gather([recording(Odometry(stamps, truth), radio, seen, mounting=MOUNTING)], config.keyframes)
    estimate = dead_reckoning(recordings.each[0], config)
    n = len(estimate.graph.poses)
    closure = RelativePoseEdges(
        np.array([6]), np.array([n - 2]), se2.between(estimate.graph.poses[[6]], estimate.graph.poses[[n - 2]]), np.eye(3)[None]
    )
    prior = PriorEdges("poses", np.array([5]), estimate.graph.poses[[5]], np.eye(3)[None])
    fixed = np.arange(n) == 4
    graph = replace(estimate.graph, anchors=PLACES, fixed_poses=fixed).with_edges(*estimate.graph.edges, closure, prior)
    return recordings, replace(estimate, graph=graph)


def covariances(edges):
    return np.linalg.inv(np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information)


def test_the_same_keyframes_leave_all_as_it_is(exact):
    recordings, estimate = exact
    same = with_keyframes(estimate, recordings, later(recordings, 0.0))
    np.testing.assert_array_equal(same.graph.poses, estimate.graph.poses)
    np.testing.assert_allclose(same.odometry.motion, estimate.odometry.motion, atol=1e-12)
    np.testing.assert_array_equal(same.odometry.sqrt_information, estimate.odometry.sqrt_information)
    np.testing.assert_allclose(same.ranges.lever_arm, estimate.ranges.lever_arm, atol=1e-12)
    np.testing.assert_array_equal(same.ranges.pose, estimate.ranges.pose)


def test_moved_keyframes_keep_exact_measurements_exact(exact):
    recordings, estimate = exact
    after = later(recordings, 0.06)
    moved = with_keyframes(estimate, recordings, after)
    there = replace(moved.graph, poses=after.each[0].frames.odometry)
    assert np.abs(there.poses - estimate.graph.poses).max() > 0.005
    assert np.abs(moved.odometry.residuals(there)).max() < 1e-6
    # Between two odometry samples (0.1 s) an arc was driven that ranges see to a tenth of a millimetre.
    assert np.abs(moved.ranges.residuals(there) * moved.ranges.sigma[:, None]).max() < 1e-3
    assert moved.recordings is after


def test_ranges_stay_where_the_tag_is_however_its_place_is_split(exact):
    """A part of the tag's place may stand in the lever arms of the ranges, as where recordings have different mountings."""
    recordings, estimate = exact
    part, ranges = np.array([0.05, 0.12]), estimate.ranges
    split = replace(ranges, tag=ranges.tag + part, lever_arm=ranges.lever_arm - se2.rotate(ranges.turn, part))
    after = later(recordings, 0.06)
    poses = after.each[0].frames.odometry
    whole, parts = (
        with_keyframes(replace(estimate, ranges=r), recordings, after).ranges.tag_positions(poses) for r in (ranges, split)
    )
    assert np.abs(ranges.turn).max() > 0.01
    np.testing.assert_allclose(parts, whole, atol=1e-12)


def test_added_keyframes_keep_poses_measurements_and_what_is_stated_of_them(exact):
    recordings, estimate = exact
    after = denser(recordings, CUT, 2)
    n, more = len(recordings.stamps), len(after.stamps)
    assert more == n + 2 * len(CUT)
    dense = with_keyframes(estimate, recordings, after)
    number = np.searchsorted(after.stamps, recordings.stamps)
    np.testing.assert_allclose(dense.graph.poses[number], estimate.graph.poses, atol=1e-9)
    np.testing.assert_allclose(dense.graph.poses, after.each[0].frames.odometry, atol=1e-6)
    assert np.abs(dense.odometry.residuals(dense.graph)).max() < 1e-3
    np.testing.assert_array_equal(dense.odometry.i, np.arange(more - 1))
    np.testing.assert_array_equal(dense.odometry.j, np.arange(1, more))
    assert np.flatnonzero(dense.graph.fixed_poses).tolist() == [number[4]]
    closure, prior = dense.graph.edges[-2:]
    assert (int(closure.i[0]), int(closure.j[0]), int(prior.index[0])) == (number[6], number[n - 2], number[5])
    assert np.abs(closure.residuals(dense.graph)).max() < 1e-9
    assert np.abs(dense.ranges.residuals(dense.graph) * dense.ranges.sigma[:, None]).max() < 1e-3


def test_scans_of_a_late_clock_are_added_where_they_were_taken(exact):
    """Keyframes that follow the lidar's clock already have the scans at both ends of a step."""
    recordings, _ = exact
    usual = denser(recordings, CUT, 2)
    moved = denser(later(recordings, 0.06), CUT, 2, 0.06)
    np.testing.assert_allclose(moved.stamps, usual.stamps + 0.06, atol=1e-9)


def test_pieces_of_a_step_have_its_variance_together(exact):
    recordings, estimate = exact
    after = denser(recordings, CUT, 2)
    dense = with_keyframes(estimate, recordings, after)
    number = np.searchsorted(after.stamps, recordings.stamps)
    whole, pieces = covariances(estimate.odometry), covariances(dense.odometry)
    for k, (first, last) in enumerate(pairwise(number)):
        np.testing.assert_allclose(pieces[first:last].sum(axis=0), whole[k], rtol=1e-4)


def test_pieces_of_a_step_slip_as_it_does(exact):
    recordings, estimate = exact
    slips = np.linspace(0.0, 1.0, len(estimate.odometry))
    slipping = replace(estimate, odometry=replace(estimate.odometry, slips=slips))
    dense = with_keyframes(slipping, recordings, denser(recordings, CUT, 2))
    number = np.searchsorted(dense.recordings.stamps, recordings.stamps)
    for k, (first, last) in enumerate(pairwise(number)):
        np.testing.assert_array_equal(dense.odometry.slips[first:last], slips[k])


SETTINGS = MappingConfig()


def drive(seed, length=6.0, lidar=True):
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, length)
    seen = scans(stamps, truth, box(9, 7), beams=120, rng=rng, noise=0.01) if lidar else None
    return recording(odometry(stamps, truth, rng, noise=0.003, turn_noise=0.002), None, seen)


@pytest.mark.parametrize("steps", [[], [3], [0, 4, 5, 19]])
def test_clouds_taken_over_are_those_made_again(steps):
    logs = [drive(1), drive(2, lidar=False), drive(3)]
    before = gather(logs, SETTINGS.keyframes)
    last = before.each[2]
    after = denser(before, np.array([*steps, last.first + np.argmax(last.frames.duration)]), 4)
    assert len(after.stamps) > len(before.stamps)
    old = keyframe_data.make(before, SETTINGS, 0.02, Work())
    mixed = keyframe_data.remake(old, before, after, SETTINGS)
    fresh = keyframe_data.make(after, SETTINGS, 0.02, Work())
    for name in ("offsets", "points", "normals", "owner", "normal_variance"):
        np.testing.assert_array_equal(getattr(mixed.clouds, name), getattr(fresh.clouds, name))
    for k in range(len(fresh.clouds)):
        np.testing.assert_array_equal(mixed.raster.cells(k), fresh.raster.cells(k))
    assert mixed.delay == fresh.delay == 0.02
    # Steps that were cut and their neighbours alone are made again.
    pairs = zip(before.each, after.each, strict=True)
    former = np.concatenate([keyframe_data._former(*pair, SETTINGS, 0.02) for pair in pairs])
    assert 0 < np.sum(former < 0) < len(former) / 2
    np.testing.assert_array_equal(before.stamps[former[former >= 0]], after.stamps[former >= 0])


def test_ranges_of_the_second_of_two_recordings_follow_its_keyframes(exact):
    """The first one has none."""
    (alone,), estimate = exact[0].each, exact[1]
    before = gather([alone.log.without(uwb=True), alone.log], MappingConfig().keyframes)
    count = len(alone.frames)
    ranges = replace(estimate.ranges, pose=estimate.ranges.pose + count)
    again = keyframe_data._attached(ranges, before, later(before, 0.06))
    expected = keyframe_data._attached(estimate.ranges, exact[0], later(exact[0], 0.06))
    np.testing.assert_array_equal(again.pose, expected.pose + count)
    for name in ("lever_arm", "turn", "velocity"):
        np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))
