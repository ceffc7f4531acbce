"""Ranges and rays attached to keyframes, see uwblite/odometry/attached.py."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import drive, ranges, recording, scans, wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.range_edges import RangeEdges
from uwblite.odometry.attached import attach_ranges, choose_scans, scan_points
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting

CONFIG = KeyframeConfig(distance=0.4, angle=0.3, scans=2)


@settings(max_examples=25)
@given(st.integers(0, 30), st.floats(-1, 1), st.floats(-1, 1))
def test_lever_arms_put_the_tag_where_it_was_at_the_range(seed, tag_x, tag_y):
    """With keyframes at the truth, arm and mounting give the tag of the trajectory at the range's own time."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 20.0)
    wheels, mounting = Odometry(stamps, truth), SensorMounting(tag_position=np.array([tag_x, tag_y, 0.5]))
    radio = ranges(rng, stamps, truth, rng.uniform(-5, 5, (3, 2)), sigma=0.0, tag=(tag_x, tag_y))
    frames = select(wheels, CONFIG)
    attached = attach_ranges(radio, wheels, frames, mounting)
    here, following = frames.stamps[attached.keyframe], frames.stamps[np.minimum(attached.keyframe + 1, len(frames) - 1)]
    assert np.all((here <= radio.stamps) & (radio.stamps <= following))
    arm = attached.lever_arm + se2.rotate(attached.turn, mounting.tag_position[:2])
    expected = se2.transform(se2.interpolate_trajectory(stamps, truth, radio.stamps), mounting.tag_position[:2])
    np.testing.assert_allclose(se2.transform(truth[frames.index][attached.keyframe], arm), expected, atol=1e-9)


def test_exact_ranges_have_no_residual_and_a_delay_is_seen_by_the_tag_s_velocity():
    """The edges agree with a radio whose clock is late by 20 ms once the delay is an unknown with that value."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 20.0, rate=50.0)
    anchors, tag, late = rng.uniform(-5, 5, (2, 2)), np.array([0.3, -0.2]), 0.02
    radio = ranges(rng, stamps, truth, anchors, sigma=0.0, tag=tag)
    wheels = Odometry(stamps + late, truth)
    frames = select(wheels, CONFIG)
    attached = attach_ranges(radio, wheels, frames, SensorMounting(tag_position=np.array([*tag, 0.0])))
    edges = RangeEdges(
        attached.keyframe,
        attached.anchor,
        attached.ranges,
        np.ones(len(attached.ranges)),
        attached.lever_arm,
        attached.turn,
        attached.velocity,
        tag,
        np.zeros(len(attached.ranges)),
        np.full((len(attached.ranges), 6), -1),
    )

    def wrong(delay):
        moved = replace(edges, lever_arm=attached.lever_arm + delay * attached.velocity)
        return np.abs(moved.residuals(Graph(frames.odometry, anchors)))

    inner = (radio.stamps > 0.2) & (radio.stamps < stamps[-1] - 0.2)
    assert wrong(0.0)[inner].max() > 0.005
    # What is left is the curvature of the path within the delay and the window of the velocity.
    assert wrong(late)[inner].max() < 0.001


def test_ranges_outside_the_odometry_keep_the_nearest_end():
    stamps, truth = drive([(0.5, 0, 0.2)], [4.0])
    wheels = Odometry(stamps + 10.0, truth)
    rng = np.random.default_rng(0)
    radio = ranges(rng, np.array([0.0, 30.0]), truth[[0, 0]], np.zeros((1, 2)), rate=3.0)
    frames = select(wheels, CONFIG)
    attached = attach_ranges(radio, wheels, frames, SensorMounting())
    early, late = radio.stamps < 10.0, radio.stamps > 14.0
    assert np.all(attached.keyframe[early] == 0)
    assert np.all(attached.keyframe[late] == len(frames) - 1)
    np.testing.assert_allclose(attached.lever_arm[early | late], 0.0, atol=1e-12)


@settings(max_examples=25)
@given(st.integers(0, 20), st.integers(1, 4))
def test_scans_go_to_the_nearest_keyframe_and_to_one_only(seed, limit):
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 10.0)
    frames = select(Odometry(stamps, truth), CONFIG)
    begin = np.sort(rng.uniform(0, stamps[-1], 80))
    lidar = LaserScans(begin, np.ones((80, 10), dtype=np.float32), 0.0, 0.1, 0.01, 0.1, 5.0)
    frames = replace(frames, alone=rng.random(len(frames)) < 0.3)
    owner, chosen = choose_scans(lidar, frames, KeyframeConfig(scans=limit))
    assert len(np.unique(chosen)) == len(chosen)
    assert np.all(np.diff(owner) >= 0)
    gap = np.abs((begin + 0.05)[:, None] - frames.stamps)
    for k in range(len(frames)):
        own = np.flatnonzero(np.argmin(gap, axis=1) == k)
        best = own[np.argsort(gap[own, k], kind="stable")[: 1 if frames.alone[k] else limit]]
        assert sorted(chosen[owner == k]) == sorted(best)


@pytest.mark.parametrize(
    ("path", "beams", "scans", "each"), [(700, 682, 0, 2), (900, 682, 0, 1), (900, 180, 0, 2), (900, 682, 3, 3)]
)
def test_one_scan_of_a_fine_lidar_is_a_cloud_where_a_robot_drives_far(path, beams, scans, each):
    stamps = np.arange(0.0, path / 2.0 + 0.01, 0.05)
    wheels, config = Odometry(stamps, np.column_stack([2.0 * stamps, 0.0 * stamps, 0.0 * stamps])), KeyframeConfig(scans=scans)
    lidar = LaserScans(stamps[:-1], np.ones((len(stamps) - 1, beams), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    owner, _ = choose_scans(lidar, select(wheels, replace(config, distance=0.5)), config)
    assert np.median(np.bincount(owner)) == each


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.2, -0.1, 2.0)])
def test_rays_are_deskewed_like_a_loop_over_rays(flipped, mount):
    rng = np.random.default_rng(7)
    speed, turning, sweep, rate = 0.5, 0.8, 0.1, 20.0
    stamps, truth = drive([(speed, 0, turning), (speed, 0, -turning)], [6.0, 6.0], rate)
    wheels = Odometry(stamps, truth)
    mounting = SensorMounting(T_base_laser=np.array(mount), laser_flipped=flipped)
    frames = select(wheels, CONFIG)
    begin = np.arange(0.3, 11.5, 0.37)
    readings = rng.uniform(0.0, 6.0, (len(begin), 40)).astype(np.float32)
    readings[rng.random(readings.shape) < 0.1] = np.nan
    readings[rng.random(readings.shape) < 0.1] = np.inf
    lidar = LaserScans(begin, readings, -1.2, 0.06, sweep / 40, 0.1, 5.0)
    owner, chosen = choose_scans(lidar, frames, CONFIG)
    rays = scan_points(recording(wheels, lidar=lidar, mounting=mounting), frames, owner, chosen, range_max=4.5)
    expected = []
    for own, scan in zip(owner, chosen, strict=True):
        for ray, reading in enumerate(readings[scan]):
            if 0.1 <= reading <= 4.5:
                base = se2.interpolate_trajectory(stamps, truth, begin[scan] + ray * lidar.time_increment)
                laser = se2.compose(se2.between(frames.odometry[own], base), mounting.T_base_laser)
                bearing = lidar.angles[ray] * (-1 if flipped else 1)
                hit = se2.transform(laser, reading * np.array([np.cos(bearing), np.sin(bearing)]))
                expected.append((own, scan, ray, *hit, *laser[:2]))
    expected = np.array(expected)
    np.testing.assert_array_equal(np.column_stack([rays.keyframe, rays.scan, rays.ray]), expected[:, :3])
    # Straight motion within a sweep: the arc bends from the chord by v w t^2 / 8; where the sweep crosses the knot at
    # which the turn changes sign, the heading is off by up to w t / 2 times the reach.
    smooth = np.abs(begin[rays.scan] + sweep / 2 - 6.0) > sweep
    bend = speed * turning * sweep**2 / 8 + np.hypot(*mount[:2]) * (turning * sweep) ** 2 / 8
    assert np.abs(rays.origins - expected[:, 5:])[smooth].max() < bend + 1e-6
    assert np.abs(rays.points - expected[:, 3:5])[smooth].max() < bend + 1e-6
    assert np.abs(rays.points - expected[:, 3:5]).max() < turning * sweep / 2 * 4.5


def test_deskewed_points_of_a_turning_robot_lie_on_the_walls():
    """Without deskewing a turn of 1 rad/s smears a wall 3 m away by 0.3 m."""
    walls = np.array([[3.0, -4.0, 3.0, 4.0]])
    stamps, truth = drive([(0.2, 0, 1.0)], [6.0], 50.0)
    wheels = Odometry(stamps, truth)
    mounting = SensorMounting(T_base_laser=np.array([0.1, 0.05, 0.3]))
    lidar = scans(stamps, truth, walls, mounting=mounting, range_max=8.0)
    frames = select(wheels, CONFIG)
    owner, chosen = choose_scans(lidar, frames, CONFIG)
    rays = scan_points(recording(wheels, lidar=lidar, mounting=mounting), frames, owner, chosen)
    on_wall = se2.transform(truth[frames.index][rays.keyframe], rays.points)
    assert len(on_wall) > 500
    assert np.abs(on_wall[:, 0] - 3.0).max() < 0.003


@pytest.mark.parametrize(("range_max", "hits"), [(np.inf, 3), (4.0, 2)])
def test_readings_at_both_ends_of_what_a_lidar_measures_are_points(range_max, hits):
    lidar = LaserScans(np.zeros(1), np.array([[0.05, 0.1, 4.0, 5.0, 5.5, np.inf]], np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    lidar = replace(lidar, ranges=lidar.ranges, range_min=float(np.float32(0.1)))
    wheels = Odometry(np.arange(2.0), np.zeros((2, 3)))
    points = scan_points(
        SensorLog(wheels, None, lidar), select(wheels, KeyframeConfig()), np.zeros(1, int), np.zeros(1, int), range_max
    )
    assert points.ray.tolist() == [1, 2, 3][:hits]
