"""Keyframes: spacing along the odometry, velocity, the dense trajectory."""

import numpy as np
import pytest
from helpers.planted import chain, drive, odometry, wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.odometry.attached import choose_scans
from uwblite.odometry.keyframes import (
    KeyframeConfig,
    _broken_steps,
    _moments,
    _slack,
    _travelled,
    dense_trajectory,
    select,
    velocity_at,
)
from uwblite.sensor_log import LaserScans, Odometry, OdometryBreaks

CONFIG = KeyframeConfig(distance=0.4, angle=0.3, scans=2)


def random_odometry(seed, n=400) -> Odometry:
    """Return jerky odometry: stretches that stand, turn on the spot and reverse, uneven stamps, some of them equal."""
    rng = np.random.default_rng(seed)
    moving = np.repeat(rng.random((n // 20 + 1, 2)) < 0.7, 20, axis=0)[: n - 1]
    steps = np.column_stack([rng.normal(0.01, 0.03, n - 1), rng.normal(0, 0.003, n - 1), rng.normal(0.005, 0.03, n - 1)])
    steps *= moving[:, [0, 0, 1]]
    stamps = np.cumsum(rng.choice([0.0, 0.05, 0.3], n, p=[0.05, 0.9, 0.05]))
    return Odometry(stamps, chain(rng.uniform(-3, 3, 3), steps))


@settings(max_examples=25)
@given(st.integers(0, 50))
def test_keyframes_are_spaced_by_distance_and_angle(seed):
    wheels = random_odometry(seed)
    frames = select(wheels, CONFIG)
    steps = se2.between(wheels.poses[:-1], wheels.poses[1:])
    moved, turned = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    assert frames.index[0] == 0
    assert frames.index[-1] == len(wheels.stamps) - 1
    assert np.all(np.diff(frames.index) > 0)
    for k, (a, b) in enumerate(zip(frames.index[:-1], frames.index[1:], strict=True)):
        path, angle = moved[a:b].sum(), turned[a:b].sum()
        assert frames.path[k] == pytest.approx(path, abs=1e-9)
        assert frames.turned[k] == pytest.approx(angle, abs=1e-9)
        if k < len(frames) - 2:
            # As far as the thresholds allow, one sample more would be too far; a single step may be longer than asked.
            assert b == a + 1 or (path <= CONFIG.distance + 1e-9 and angle <= CONFIG.angle + 1e-9)
            assert moved[a : b + 1].sum() > CONFIG.distance - 1e-9 or turned[a : b + 1].sum() > CONFIG.angle - 1e-9
        else:  # a rest of less than half a step joins the last one
            assert b <= a + 1 or path < 1.5 * CONFIG.distance + moved.max()
            assert b <= a + 1 or angle < 1.5 * CONFIG.angle + turned.max()
    np.testing.assert_allclose(se2.between(frames.odometry[:-1], frames.odometry[1:]), frames.motion, atol=1e-12)
    np.testing.assert_allclose(frames.duration, np.diff(frames.stamps))


@pytest.mark.parametrize("steps", [1.0, 1.2, 1.45, 1.55, 1.95, 2.2, 2.7, 7.3, 7.6])
@pytest.mark.parametrize("turning", [False, True])
def test_a_rest_of_less_than_half_a_step_joins_the_last_one(steps, turning):
    config = KeyframeConfig(distance=0.5, angle=0.5)
    stamps, truth = drive([(0.0, 0.0, 0.1) if turning else (0.1, 0.0, 0.0)], [5.0 * steps], rate=50.0)
    frames = select(Odometry(stamps, truth), config)
    gaps = (frames.turned if turning else frames.path) / 0.5
    assert len(gaps) == round(steps)
    np.testing.assert_allclose(gaps[:-1], 1.0, atol=0.01)
    assert 0.5 - 0.01 <= gaps[-1] <= 1.5 + 0.01


def test_length_is_signed_and_path_is_not():
    stamps, truth = drive([(0.5, 0, 0), (-0.5, 0, 0)], [2.0, 2.0])
    frames = select(Odometry(stamps, truth), KeyframeConfig(distance=0.25))
    assert frames.path.sum() == pytest.approx(2.0)
    assert frames.length.sum() == pytest.approx(0.0, abs=1e-9)
    assert frames.length.min() < -0.2 < 0.2 < frames.length.max()


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_a_robot_that_stands_has_its_first_and_last_sample(samples):
    frames = select(Odometry(np.arange(samples) * 1.0, np.zeros((samples, 3))), CONFIG)
    assert frames.index.tolist() == ([0] if samples == 1 else [0, samples - 1])
    assert np.all(frames.twist == 0.0)
    assert len(frames.motion) == len(frames) - 1


@pytest.mark.parametrize("window", [(0.0, 0.1), (0.1, 0.3)])
def test_velocity_is_the_twist_that_is_driven(window):
    stamps, truth = drive([(0.4, 0.1, 0.7)], [5.0])
    wheels = Odometry(stamps, truth)
    stated = velocity_at(wheels, np.array([0.0, 0.02, 0.2, 2.5, 4.9, 5.0]), window)
    np.testing.assert_allclose(stated, np.tile([0.4, 0.1, 0.7], (6, 1)), atol=1e-9)
    assert np.all(velocity_at(Odometry(stamps[:1], truth[:1]), np.array([0.0])) == 0.0)


def test_what_places_a_scan_has_no_part_in_the_velocity_of_its_keyframe():
    stamps, truth = drive([(0.4, 0.0, 0.7)], [5.0])
    frames = select(Odometry(stamps, truth), KeyframeConfig())
    at = frames.stamps[len(frames) // 2]
    poses = truth.copy()
    poses[np.abs(stamps - at) < 0.09] += [0.01, -0.01, 0.01]
    assert np.abs(stamps - at).min() < 0.09
    shaken = velocity_at(Odometry(stamps, poses), frames.stamps, (0.1, 0.3))[len(frames) // 2]
    np.testing.assert_allclose(shaken, frames.twist[len(frames) // 2], atol=1e-12)


def test_keyframes_are_scans_where_there_are_any():
    """The last scan within the thresholds; the next one where none is; samples of the odometry where the lidar was silent."""
    stamps, truth = drive([(0.5, 0, 0)], [20.0])
    begin = np.concatenate([np.arange(0.03, 8.0, 0.17), np.arange(14.0, 19.9, 0.9)])
    lidar = LaserScans(begin, np.ones((len(begin), 10), dtype=np.float32), 0.0, 0.1, 0.01, 0.1, 5.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig(distance=0.3, duration=100.0), scans=lidar)
    looks = np.isin(frames.stamps, lidar.middles)
    dense, silent = (frames.stamps > 0) & (frames.stamps < 7.5), (frames.stamps > 8.2) & (frames.stamps < 13.5)
    assert looks[dense].all()
    assert not looks[silent].any()
    assert np.isin(lidar.middles[begin > 14.0], frames.stamps).all()
    assert looks[frames.stamps > 14.5][:-1].all()
    np.testing.assert_allclose(frames.odometry, se2.interpolate_trajectory(stamps, truth, frames.stamps), atol=1e-9)
    step = np.diff(frames.stamps)[dense[:-1]]
    assert step.max() <= 0.6 + 1e-9
    assert step[1:-1].min() > 0.6 - 0.17
    assert frames.path.sum() == pytest.approx(10.0)


@pytest.mark.parametrize(("path", "step"), [(300.0, 0.3), (1000.0, 0.375), (3000.0, 0.45)])
def test_who_drives_far_with_a_lidar_has_keyframes_farther_apart(path, step):
    """Unless a distance is set, or there is no lidar."""
    stamps = np.arange(0.0, path / 2.0 + 0.01, 0.02)
    wheels = Odometry(stamps, np.column_stack([2.0 * stamps, 0.0 * stamps, 0.0 * stamps]))
    lidar = LaserScans(stamps[1:-1], np.ones((len(stamps) - 2, 2), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    # A keyframe stands at a scan, every 0.04 m.
    assert step - 0.041 < np.median(select(wheels, KeyframeConfig(), scans=lidar).path) <= step + 1e-9
    assert np.median(select(wheels, KeyframeConfig(distance=0.2), scans=lidar).path) == pytest.approx(0.2)
    assert np.median(select(wheels, KeyframeConfig()).path) == pytest.approx(0.28)


@pytest.mark.parametrize(("first", "moving"), [(0.3, True), (0.02, False)])
def test_the_first_scan_of_a_robot_under_way_has_a_keyframe_of_its_own(first, moving):
    """Laid to the first pose it would turn the whole map by what the wheels erred by until then."""
    stamps, truth = drive([(0.2, 0, 0.2)], [5.0])
    begin = np.arange(first, 4.9, 0.1)
    lidar = LaserScans(begin, np.ones((len(begin), 10), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig(), scans=lidar)
    owner, _ = choose_scans(lidar, frames, KeyframeConfig())
    assert (frames.stamps[1] == begin[0], 0 in owner) == (moving, not moving)


@pytest.mark.parametrize("creeping", [(0.05, 0.0, 0.0), (0.0, 0.0, 0.06)])
def test_keyframes_come_in_time_where_a_robot_creeps(creeping):
    stamps, truth = drive([creeping, (0.0, 0, 0)], [30.0, 30.0])
    begin = np.arange(0.0, 59.0, 0.1)
    lidar = LaserScans(begin, np.ones((len(begin), 10), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    frames = select(Odometry(stamps, truth), KeyframeConfig(duration=1.5), scans=lidar)
    assert np.diff(frames.stamps[frames.stamps < 30.0]).max() < 1.7
    assert np.sum(frames.stamps > 30.2) == 1


@settings(max_examples=25)
@given(st.integers(0, 30))
def test_dense_trajectory_passes_through_the_keyframes_and_is_continuous(seed):
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 15.0)
    wheels = odometry(stamps, truth, rng, scale=1.03, turn_scale=0.95, noise=0.02, turn_noise=0.02)
    frames = select(wheels, CONFIG)
    poses = truth[frames.index]
    dense = dense_trajectory(wheels, frames, poses)
    assert dense.shape == truth.shape
    np.testing.assert_allclose(dense[frames.index], poses, atol=1e-12)
    fine = np.linspace(stamps[0], stamps[-1], 20 * len(stamps))
    path = dense_trajectory(wheels, frames, poses, fine)
    step = se2.between(path[:-1], path[1:])
    # A sample's motion is 0.05 m and 0.1 rad; a twentieth of it, and as much again for noise and correction.
    assert np.hypot(step[:, 0], step[:, 1]).max() < 4 * 0.05 / 20
    assert np.abs(step[:, 2]).max() < 4 * 0.1 / 20
    np.testing.assert_allclose(dense_trajectory(wheels, frames, poses, stamps)[:, :2], dense[:, :2], atol=1e-9)


def test_dense_trajectory_of_exact_odometry_is_the_odometry_moved():
    rng = np.random.default_rng(5)
    stamps, truth = wander(rng, 10.0)
    wheels, shift = Odometry(stamps, truth), np.array([3.0, -2.0, 2.5])
    frames = select(wheels, CONFIG)
    dense = dense_trajectory(wheels, frames, se2.compose(shift, frames.odometry))
    error = se2.between(se2.compose(shift, truth), dense)
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


def test_dense_trajectory_holds_its_ends_and_serves_a_single_keyframe():
    stamps, truth = drive([(0.5, 0, 0.1)], [4.0])
    wheels = Odometry(stamps, truth)
    frames = select(wheels, CONFIG)
    ends = dense_trajectory(wheels, frames, frames.odometry, np.array([-5.0, 99.0]))
    np.testing.assert_allclose(ends, truth[[0, -1]], atol=1e-9)
    alone = Odometry(stamps[:1], truth[:1])
    np.testing.assert_allclose(dense_trajectory(alone, select(alone, CONFIG), np.array([[1.0, 2.0, 3.0]])), [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_dense_trajectory_of_a_few_samples_is_what_they_are(samples):
    wheels = Odometry(np.arange(samples) * 1.0, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [2.0, 0.5, 0.3]])[:samples])
    frames = select(wheels, KeyframeConfig(distance=10.0, angle=10.0))
    assert len(frames) == min(samples, 2)
    shift = np.array([3.0, -1.0, 2.0])
    expected = se2.compose(shift, wheels.poses)
    poses = se2.compose(shift, frames.odometry)
    np.testing.assert_allclose(dense_trajectory(wheels, frames, poses), expected, atol=1e-12)
    at = np.array([-9.0, 0.0, 0.5, 99.0])
    interpolated = se2.interpolate_trajectory(wheels.stamps, expected, at)
    np.testing.assert_allclose(dense_trajectory(wheels, frames, poses, at), interpolated, atol=1e-12)


def test_equal_stamps_do_no_harm():
    wheels = Odometry(np.array([0.0, 1.0, 1.0, 1.0, 2.0]), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]]))
    frames = select(wheels, CONFIG)
    poses = frames.odometry + np.array([0.0, 1.0, 0.0])
    dense = dense_trajectory(wheels, frames, poses)
    assert np.isfinite(dense).all()
    np.testing.assert_allclose(dense[frames.index], poses, atol=1e-12)


def test_what_odometry_misses_is_spread_as_its_errors_grow():
    """It drives 0.2 m, turns 0.2 rad on the spot and drives 0.1 m, all too short by a tenth: turns err where it turned."""
    stamps = np.arange(7) * 0.1
    x = np.array([0.0, 0.1, 0.2, 0.2, 0.2, 0.25, 0.3])
    turn = np.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.2, 0.2])
    corner = np.column_stack([np.minimum(x, 0.2), 0.0 * x, turn])
    wheels = Odometry(stamps, se2.compose(corner, np.column_stack([x - np.minimum(x, 0.2), 0.0 * x, 0.0 * x])))
    frames = select(wheels, KeyframeConfig(distance=1.0, angle=1.0))
    ends = np.array([[0.0, 0.0, 0.0], se2.compose(np.array([0.22, 0.0, 0.22]), np.array([0.11, 0.0, 0.0]))])
    assert len(frames) == 2
    dense = dense_trajectory(wheels, frames, ends)
    np.testing.assert_allclose(dense[[0, -1]], ends, atol=1e-9)
    # Driving takes a share of one in seven of the heading's error: 0.3 m count as 0.03 rad of turning.
    np.testing.assert_allclose(dense[2], [0.22, 0.0, 0.0], atol=0.003)
    np.testing.assert_allclose(dense[4], [0.22, 0.0, 0.22], atol=0.003)


def test_a_break_of_the_odometry_has_a_keyframe_at_either_end():
    """Whatever the spacing: the step that was predicted stands alone between two keyframes."""
    stamps, truth = drive([(0.5, 0, 0)], [10.0])
    breaks = OdometryBreaks(stamps[[57, 121]], np.ones((2, 3)))
    frames = select(Odometry(stamps, truth), KeyframeConfig(distance=2.0), breaks)
    assert {57, 58, 121, 122} <= set(frames.index.tolist())
    assert len(frames) <= 4 + 4
    loose = frames.slack[:, 0] > 0.0
    assert frames.index[:-1][loose].tolist() == [57, 121]


@pytest.mark.parametrize("seed", range(5))
def test_a_step_has_the_slack_of_every_break_it_has_time_in_common_with(seed):
    """Squares add; a break reaches from its sample of the odometry to the next one. By a loop."""
    rng = np.random.default_rng(seed)
    odometry_stamps = np.cumsum(rng.uniform(0.1, 1.0, 30))
    stamps = np.sort(rng.choice(odometry_stamps, 8, replace=False)) + rng.choice([0.0, 0.05], 8)
    at, sigma = np.sort(rng.choice(29, 5, replace=False)), rng.uniform(0.1, 1.0, (5, 3))
    expected = np.zeros((7, 3))
    for k, size in zip(at.tolist(), sigma, strict=True):
        for step in range(7):
            if stamps[step] < odometry_stamps[k + 1] and stamps[step + 1] > odometry_stamps[k]:
                expected[step] += size**2
    # A break before the first keyframe counts for the first step.
    found = _slack(stamps, odometry_stamps, OdometryBreaks(odometry_stamps[at], sigma))
    inside = ~np.isin(np.arange(7), [0, 6])
    np.testing.assert_allclose(found[inside], np.sqrt(expected)[inside])


def test_a_break_belongs_to_the_sample_before_it_that_has_a_step_behind_it():
    stamps = np.array([1.0, 2.0, 3.0, 4.0])
    breaks = OdometryBreaks(np.array([0.0, 1.0, 2.5, 3.0, 4.0, 9.0]), np.zeros((6, 3)))
    assert _broken_steps(stamps, breaks).tolist() == [0, 0, 1, 2, 2, 2]
    assert _broken_steps(stamps[:1], breaks).tolist() == [0] * 6


def test_ways_between_samples_are_shares_of_the_step_by_time():
    """Forwards 0.4 m in 0.2 s, backwards 0.1 m in 0.5 s, turning by 0.2 rad on the spot in 1 s."""
    odometry = Odometry(
        np.array([1.0, 1.2, 1.7, 2.7]), np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.2]])
    )
    moments = np.array([1.0, 1.05, 1.2, 1.3, 2.2, 2.7, 9.0])
    signed, path, turned = _travelled(odometry, moments, np.array([0, 0, 1, 1, 2, 3, 3]))
    np.testing.assert_allclose(signed, [0.0, 0.1, 0.4, 0.38, 0.3, 0.3, 0.3])
    np.testing.assert_allclose(path, [0.0, 0.1, 0.4, 0.42, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.2], atol=1e-12)


def test_moments_are_those_of_the_odometry_and_of_scans_strictly_within_it():
    """Each with the last sample before it; a scan at a sample is that sample, and preferred."""
    stamps = np.array([1.0, 2.0, 3.0, 5.0])
    odometry = Odometry(stamps, np.zeros((4, 3)))
    begin = np.array([0.5, 1.0, 1.5, 1.6, 2.0, 4.0, 4.9, 5.0, 5.5])
    lidar = LaserScans(begin, np.ones((9, 3), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 5.0)
    moments, sample, preferred = _moments(odometry, lidar)
    np.testing.assert_array_equal(moments, [1.0, 1.5, 1.6, 2.0, 3.0, 4.0, 4.9, 5.0])
    np.testing.assert_array_equal(sample, [0, 0, 0, 1, 2, 2, 2, 3])
    np.testing.assert_array_equal(preferred, [True, True, True, True, False, True, True, True])
    moments, sample, preferred = _moments(odometry, None)
    assert (moments.tolist(), sample.tolist(), preferred.all()) == (stamps.tolist(), [0, 1, 2, 3], True)


@pytest.mark.parametrize(("rate", "window"), [(20.0, (0.0, 0.1)), (3.0, (0.1, 0.3)), (20.0, (0.1, 0.3))])
def test_a_velocity_at_the_ends_is_that_of_the_half_which_is_there(rate, window):
    """And none where the odometry is a single sample."""
    stamps, truth = drive([(0.4, 0.0, 0.5)], [6.0], rate=rate)
    for stamp in (stamps[0], stamps[-1], stamps[0] + 0.5 * window[1], stamps[3]):
        found = velocity_at(Odometry(stamps, truth), np.array([stamp]), window)
        np.testing.assert_allclose(found, [[0.4, 0.0, 0.5]], atol=0.02)
    np.testing.assert_array_equal(velocity_at(Odometry(stamps[:1], truth[:1]), np.array([stamps[0]]), window), 0.0)


def test_a_break_between_the_only_two_samples_of_the_odometry_has_its_slack():
    sigma = np.array([[0.3, 0.2, 0.1]])
    two = np.array([1.0, 2.0])
    np.testing.assert_allclose(_slack(two, two, OdometryBreaks(two[:1], sigma)), sigma)
    np.testing.assert_array_equal(_slack(two, two[:1], OdometryBreaks(two[:1], sigma)), 0.0)
