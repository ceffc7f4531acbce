"""Where the laser looks, from how it sees the robot drive."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import room_recording
from helpers.planted import box, drive, odometry, recording, scans, wander
from helpers.told import told

from uwblite import se2
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.mapping import MappingConfig, build_map
from uwblite.screening.directions import heading_with_the_path, laser_ahead, laser_upright
from uwblite.screening.wheel_motion import Pairs, compare
from uwblite.sensor_log import Odometry, SensorLog, SensorMounting


def alike(count):
    """Return the same information for each of so many pairs (count, 3, 3)."""
    return np.tile(np.eye(3), (count, 1, 1))


def pairs_of_a_laser_turned_by(angle: float, stuck: float) -> Pairs:
    """Ways of 0.12 m and small turns; of a share of the pairs, along bare walls, the lidar repeats what the wheels said."""
    rng, count = np.random.default_rng(3), 200
    wheels = np.column_stack([np.full(count, 0.12), np.zeros(count), rng.normal(0.0, 0.05, count)])
    lidar = np.column_stack([se2.rotate(np.full(count, -angle), wheels[:, :2]), wheels[:, 2]])
    lidar[:, :2] += rng.normal(0.0, 0.004, (count, 2))
    kept = rng.permutation(count) < stuck * count
    lidar[kept] = wheels[kept]
    return Pairs(np.arange(count) * 1.0, np.arange(count) + 0.3, lidar, wheels, np.ones(count), alike(count))


@pytest.mark.parametrize("angle", [np.pi, np.pi / 2, -np.pi / 2, 0.5])
@pytest.mark.parametrize("stuck", [0.0, 0.2])
def test_pairs_along_bare_walls_do_not_hide_the_direction_of_the_laser(angle, stuck):
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), None, None)
    turned, facts = laser_ahead(log, pairs_of_a_laser_turned_by(angle, stuck))
    remarks = told(facts)
    assert [r.kind for r in remarks] == ["laser-turned-away"]
    assert abs(se2.wrap_angle(turned.mounting.T_base_laser[2] - angle)) < 0.1


@pytest.mark.parametrize(("signs", "lidar", "changed"), [
    ((1.0, 1.0, -1.0), True, "the sign of its heading"), ((1.0, -1.0, 1.0), True, "the sign of its y"),
    ((1.0, 1.0, -1.0), False, "the sign of its heading"),
])  # fmt: skip
def test_a_heading_against_its_path_is_mended_as_the_laser_shows(signs, lidar, changed):
    """The heading counts the wrong way, or y does; without a laser nothing shows which."""
    sound = room_recording.recording(room_recording.two_rounds()).without(lidar=not lidar)
    wrong = replace(sound, odometry=Odometry(sound.odometry.stamps, sound.odometry.poses * signs))
    done, facts = heading_with_the_path(wrong)
    (remark,) = told(facts)
    np.testing.assert_array_equal(done.odometry.poses, sound.odometry.poses)
    assert (remark.kind, f"path: {changed} was inverted" in remark.text) == ("heading-against-path", True)
    assert ("whether the map is mirrored" in remark.text) == (not lidar)
    assert heading_with_the_path(done) == (done, [])
    assert heading_with_the_path(sound) == (sound, [])


def test_directions_that_do_not_agree_leave_the_laser_as_given():
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), None, None)
    pairs = pairs_of_a_laser_turned_by(np.pi, 0.4)
    assert laser_ahead(log, pairs) == (log, [])
    anyhow = replace(pairs, lidar=np.random.default_rng(1).normal(0.0, 0.1, pairs.lidar.shape))
    assert laser_ahead(log, anyhow) == (log, [])


@pytest.mark.parametrize("angle", [np.pi, np.pi / 2, -0.6])
@pytest.mark.parametrize("around", [False, True])
def test_turns_show_whether_the_laser_or_the_way_of_driving_is_turned(angle, around):
    """The laser's lever arm swings otherwise: where the wheels drive another way, sensors are carried elsewhere on the base."""
    rng, count = np.random.default_rng(5), 60
    given, tag = np.array([0.2, 0.1, 0.3]), np.array([-0.1, 0.05, 0.6])
    turn = np.array([0.0, 0.0, angle])
    mount = se2.compose(turn, given) if around else given + turn
    wheels = np.column_stack([np.full(count, 0.2), np.zeros(count), rng.uniform(-0.25, 0.25, count)])
    laser = se2.compose(se2.compose(se2.inverse(mount), wheels), mount)
    lidar = se2.compose(se2.compose(given, laser), se2.inverse(given))
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), mounting=SensorMounting(given, tag_position=tag))
    start = np.arange(count) * 1.0
    done, facts = laser_ahead(log, Pairs(start, start + 0.3, lidar, wheels, np.ones(count), alike(count)))
    (remark,) = told(facts)
    # The median direction over turns, at which the lever arm shows itself, is known to some hundredths.
    np.testing.assert_allclose(done.mounting.T_base_laser[:2], mount[:2], atol=0.02)
    assert abs(se2.wrap_angle(done.mounting.T_base_laser[2] - mount[2])) < 0.05
    moved = np.append(se2.rotate(angle, tag[:2]), 0.6) if around else tag
    np.testing.assert_allclose(done.mounting.tag_position, moved, atol=0.01)
    assert f"differs by {np.degrees(angle):+.0f}"[:13] in remark.text


ROOM = np.concatenate([box(14, 11), box(3, 1) + np.array([2, 1, 2, 1]), box(1, 2) - np.array([4, 2, 4, 2])])
TURNS = [(0.0, 0.0, 0.6), (0.4, 0.0, 0.0), (0.0, 0.0, -0.5), (0.3, 0.0, 0.0), (0.0, 0.0, 0.4)] * 2
UP, DOWN = SensorMounting(), SensorMounting(laser_flipped=True)


def turner(mounting=UP, lag=0.0, turn_scale=1.0, seed=0, legs=TURNS):
    """A recording of a robot that turns on the spot now and then; its log does not contain how the laser hangs."""
    rng = np.random.default_rng(seed)
    stamps, truth = drive(legs, [4.0] * len(legs))
    seen = scans(stamps, truth, ROOM, rate=10.0, noise=0.01, rng=rng, mounting=mounting)
    seen = replace(seen, stamps=seen.stamps + lag)
    return recording(odometry(stamps, truth, rng, noise=0.005, turn_noise=0.01, turn_scale=turn_scale), None, seen)


def turned_over(log):
    """Return whether the laser is taken as mounted the other way up than given."""
    pairs = compare(log)
    return pairs is not None and laser_upright(log, pairs)[0].mounting.laser_flipped is not log.mounting.laser_flipped


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mounting", [UP, DOWN])
def test_the_way_up_shows_in_the_turns(seed, mounting):
    assert turned_over(turner(mounting, seed=seed)) is (mounting is DOWN)


def test_a_way_up_given_rightly_is_not_contradicted():
    assert not turned_over(replace(turner(DOWN), mounting=DOWN))
    assert turned_over(replace(turner(UP), mounting=DOWN))


@pytest.mark.parametrize("other", [{"lag": 0.3}, {"lag": -0.2}, {"turn_scale": 0.5}, {"turn_scale": 2.0}])
@pytest.mark.parametrize("mounting", [UP, DOWN])
def test_neither_another_clock_nor_another_track_hides_the_way_up(mounting, other):
    assert turned_over(turner(mounting, **other)) is (mounting is DOWN)


@pytest.mark.parametrize("mounting", [UP, DOWN])
def test_scans_that_see_nothing_decide_nothing(mounting):
    """In a large bare hall most scans see no wall: any turn fits two of them."""
    log = turner(mounting)
    ranges = log.scans.ranges.copy()
    ranges[np.arange(len(ranges)) % 20 < 13] = np.inf
    assert turned_over(replace(log, scans=replace(log.scans, ranges=ranges))) is (mounting is DOWN)


@pytest.mark.parametrize(("seconds", "shown"), [(1.0, False), (3.9, True)])
def test_a_few_scans_that_see_something_decide_nothing(seconds, shown):
    """In a yard only scans beside the one post match at all, and a single pair fits a laser either way up."""
    log = turner(DOWN)
    ranges = np.where((log.scans.stamps < log.scans.stamps[0] + seconds)[:, None], log.scans.ranges, np.inf)
    assert turned_over(replace(log, scans=replace(log.scans, ranges=ranges))) is shown


def test_a_robot_that_never_turns_shows_nothing_and_one_that_turns_only_while_driving_does():
    assert not turned_over(turner(DOWN, legs=[(0.3, 0.0, 0.0)] * 4))
    assert turned_over(turner(DOWN, legs=[(0.6, 0.0, 0.35)] * 6))


@pytest.mark.slow
def test_a_laser_upside_down_is_mapped_and_reported():
    rng = np.random.default_rng(2)
    stamps, truth = wander(rng, 12.0)
    seen = scans(stamps, truth, ROOM, rate=5.0, noise=0.01, rng=rng, mounting=DOWN)
    log = recording(odometry(stamps, truth, rng, noise=0.005, turn_noise=0.005), None, seen)
    result = build_map(log)
    assert [d for d in result.doubts if d.kind == "laser-turned-over"]
    assert evaluate_trajectory(stamps, result.trajectory, stamps, truth).ate.rmse < 0.03
    reported = build_map(replace(log, mounting=DOWN))
    assert not [d for d in reported.doubts if d.kind == "laser-turned-over"]
    np.testing.assert_array_equal(reported.trajectory, result.trajectory)
    counted = build_map(log, MappingConfig(detect_laser_flip=False))
    assert not [d for d in counted.doubts if d.kind == "laser-turned-over"]
