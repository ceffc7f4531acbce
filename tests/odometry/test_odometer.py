"""The odometry of the last seconds: interpolation, steps that no robot drives, order and memory."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.odometry.odometer import Odometer


def driven(count, period=0.1, speed=0.4, turn=0.3):
    """Return stamps (n,) and poses (n, 3) of an arc."""
    step = np.array([speed * period, 0.0, turn * period])
    poses = [np.zeros(3)]
    for _ in range(count - 1):
        poses.append(se2.compose(poses[-1], step))
    return 100.0 + period * np.arange(count), np.array(poses)


def fed(stamps, poses):
    odometer = Odometer()
    steps = [odometer.add(float(t), p) for t, p in zip(stamps, poses, strict=True)]
    return odometer, steps


def between(odometer, first, second):
    """Return the motion (3,) between two times."""
    return se2.between(*odometer.at(np.array([first, second])))


def test_steps_compose_to_the_path_and_times_between_readings_are_interpolated():
    stamps, poses = driven(50)
    odometer, steps = fed(stamps, poses)
    assert steps[0] is None
    whole = poses[0]
    for step in steps[1:]:
        whole = se2.compose(whole, step)
    np.testing.assert_allclose(whole, poses[-1], atol=1e-12)
    np.testing.assert_allclose(odometer.pose, poses[-1])
    at = np.array([stamps[0] - 5.0, stamps[7], 0.5 * (stamps[7] + stamps[8]), stamps[-1] + 5.0])
    found = odometer.at(at)
    np.testing.assert_allclose(found[[0, 1, 3]], poses[[0, 7, -1]], atol=1e-12)
    # Half way the arc of 0.03 rad is off its chord by 0.15 mm at most.
    np.testing.assert_allclose(found[2], se2.compose(poses[7], 0.5 * steps[8]), atol=2e-4)


def test_counters_that_begin_again_count_as_standing_still():
    """What was driven before moves along, so that relative to the newest pose it stays where it was."""
    stamps, poses = driven(40)
    plain, _ = fed(stamps, poses)
    reset = np.concatenate([poses[:20], se2.between(poses[20], poses[20:])])
    odometer, steps = fed(stamps, reset)
    assert odometer.jumps == 1
    np.testing.assert_array_equal(steps[20], np.zeros(3))
    before, after = stamps[[3, 12]], stamps[[25, 39]]
    for t in (before, after):
        np.testing.assert_allclose(between(odometer, *t), between(plain, *t), atol=1e-12)
    np.testing.assert_allclose(between(odometer, stamps[19], stamps[20]), np.zeros(3), atol=1e-12)


@pytest.mark.parametrize(("metres", "jumps"), [(0.45, 0), (0.55, 1)])
def test_a_jump_is_longer_than_half_a_metre_however_short_its_time(metres, jumps):
    odometer, _ = fed([0.0, 0.01], np.array([[0.0, 0.0, 0.0], [metres, 0.0, 0.0]]))
    assert odometer.jumps == jumps


def test_a_fast_step_over_a_long_time_is_driven():
    odometer, _ = fed([0.0, 1.0], np.array([[0.0, 0.0, 0.0], [4.5, 0.0, 0.0]]))
    assert odometer.jumps == 0


@pytest.mark.parametrize(
    ("stamp", "pose"), [(5.0, [1.0, 0.0, 0.0]), (4.0, [1.0, 0.0, 0.0]), (np.nan, [1.0, 0.0, 0.0]), (6.0, [np.inf, 0.0, 0.0])]
)
def test_a_pose_that_is_not_newer_or_not_finite_is_left_out_and_counted(stamp, pose):
    odometer, _ = fed([4.5, 5.0], np.zeros((2, 3)))
    assert odometer.add(stamp, np.array(pose)) is None
    assert odometer.late == 1
    assert odometer.stamp == 5.0


def test_half_a_minute_is_kept_and_no_more_memory_than_that_needs():
    stamps, poses = driven(3_000, period=0.1)
    odometer, _ = fed(stamps, poses)
    recent = stamps[-1] - 29.0
    k = int(np.searchsorted(stamps, recent))
    np.testing.assert_allclose(odometer.at(stamps[k : k + 1])[0], poses[k], atol=1e-9)
    assert len(odometer) < 4 * 30.0 / 0.1


def test_what_is_forgotten_from_a_time_on_leaves_the_first_pose():
    stamps, poses = driven(20)
    odometer, _ = fed(stamps, poses)
    odometer.forget_from(stamps[8])
    assert odometer.stamp == stamps[7]
    odometer.forget_from(0.0)
    assert len(odometer) == 1
    np.testing.assert_array_equal(odometer.pose, poses[0])


def test_without_poses_there_is_no_stamp():
    assert Odometer().stamp == -np.inf
