"""The live localisation: starts from nowhere, stays in doubt where there is doubt, tracks, and recovers."""

import dataclasses

import numpy as np
import pytest
from helpers.localization_room import ANCHORS, EVEN, ODD, ROUND, SCANNER, cast, errors, grid_of, known, path, robot

from uwblite import se2
from uwblite.errors import DataError
from uwblite.localization import Localizer, Scanner, hypotheses
from uwblite.localization.comparison import PlaceSearch
from uwblite.localization.known_map import from_result
from uwblite.localization.pose_estimator import PoseEstimator
from uwblite.localization.walls import walls_of


@pytest.fixture(scope="module")
def drive():
    poses = path(ROUND)
    return poses, robot(known()).along(poses)


def first_found(states):
    return next((k for k, s in enumerate(states) if not s.lost), len(states))


def test_a_start_from_nowhere_is_found_and_tracked(drive):
    poses, states = drive
    found = first_found(states)
    # 0.4 m/s: two metres of driving.
    assert found < 25
    # Cells of 0.05 m drawn one thick: walls are off by up to half of one.
    assert np.sqrt(np.mean(errors(states[found:], poses[found:]) ** 2)) < 0.025
    heading = se2.wrap_angle(np.array([s.pose[2] for s in states[found:]]) - poses[found:, 2])
    assert np.sqrt(np.mean(heading**2)) < 0.01
    assert all(s.quality > 0.9 for s in states[found + 10 :])
    assert not any(s.lost for s in states[found:])


def test_covariances_are_symmetric_and_positive(drive):
    for state in drive[1]:
        if not np.isnan(state.pose).any():
            np.testing.assert_array_equal(state.covariance, state.covariance.T)
            assert np.linalg.eigvalsh(state.covariance).min() > 0


def test_the_same_input_gives_the_same_bytes(drive):
    poses, states = drive
    for one, other in zip(states[:40], robot(known()).along(poses[:40]), strict=True):
        assert one.pose.tobytes() == other.pose.tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()
        assert (one.quality, one.lost, one.reason) == (other.quality, other.lost, other.reason)


def test_a_step_that_uses_a_scan_leaves_the_search_to_the_others(monkeypatch):
    def logged(owner, name):
        before = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *words: (done.append(name), before(*words))[1])

    done, poses = [], path(ROUND)[:40]
    drive = robot(known())
    logged(PlaceSearch, "advance")
    logged(PoseEstimator, "use_scan")
    for name in ("add_odometry", "add_ranges", "add_scan", "_work_off"):
        logged(Localizer, name)
    assert first_found(drive.along(poses)) < 25
    steps = " ".join(done).split("_work_off")
    assert sum("advance" in step for step in steps) > 0
    assert not any("advance" in step and "use_scan" in step for step in steps)


def test_a_laser_that_another_robot_carries_turned_is_learnt_while_driving():
    poses = path(ROUND)
    drive = robot(known())
    drive.laser_turn = 0.03
    states = drive.along(poses)
    off = np.array([se2.wrap_angle(s.pose[2] - p[2]) for s, p in zip(states, poses, strict=True) if not s.lost])
    sigma = np.sqrt([s.covariance[2, 2] for s in states if not s.lost])
    assert np.median(np.abs(off[-40:])) < 0.012
    assert np.all(np.abs(off) < 4.0 * sigma)
    assert np.median(sigma[-40:]) < 0.012


def test_the_work_of_every_step_is_bounded_also_where_many_measurements_are_due_at_once():
    """Two units of a search and a decision; or scans that are compared with as many places as there can be."""
    poses, drive, work = path(ROUND)[:60], robot(known()), []
    for name in ("add_odometry", "add_ranges", "add_scan"):
        step = getattr(drive.localizer, name)

        def counted(*words, step=step):
            state = step(*words)
            work.append(drive.localizer.work)
            return state

        setattr(drive.localizer, name, counted)
    drive.along(poses, every=10)
    assert 1e5 < max(work) < 7e6
    # A tracked pose costs little.
    drive.along(path(ROUND)[60:100])
    assert max(work[-60:]) < 5e5


def test_walls_alone_find_the_place_where_no_other_looks_like_it():
    poses = path(ROUND)[:75]
    states = robot(known(anchors={})).along(poses, ranges=False)
    found = first_found(states)
    assert found < 60
    assert errors(states[found:], poses[found:]).max() < 0.1


def test_two_halves_of_an_even_room_stay_two_places_until_ranges_distinguish_them():
    room, poses = known(EVEN), path(ROUND)
    drive = robot(room, walls=EVEN)
    for state in drive.along(poses[:60], ranges=False):
        assert state.lost
    turned = se2.compose(np.array([8.0, 6.0, np.pi]), poses[59])
    places = np.array([state.pose, *state.alternatives])
    for true in (poses[59], turned):
        assert np.hypot(*(places - true)[:, :2].T).min() < 0.1
    later = drive.along(poses[60:100])
    assert first_found(later) < 25
    assert errors(later[-10:], poses[90:100]).max() < 0.1


LINE = {"A": (0.5, 0.0), "B": (7.5, 0.0)}


def test_mirror_images_of_a_straight_drive_stay_two_until_it_turns():
    """Two anchors in a row with the path: what lies left and right of them looks the same."""
    drive = robot(known(None, LINE), anchors=LINE)
    straight = path(((1.0, 2.0), (7.0, 2.0)))
    state = drive.along(straight, scans=False)[-1]
    assert state.lost
    places = np.array([state.pose, *state.alternatives])
    for true in (straight[-1], straight[-1] * [1, -1, -1]):
        assert np.hypot(*(places - true)[:, :2].T).min() < 0.5
    bend = path(((7.0, 2.0), (7.0, 5.0), (2.0, 5.0), (2.0, 2.0), (6.0, 2.0)))
    states = drive.along(bend, scans=False)
    assert not states[-1].lost
    assert errors(states[-10:], bend[-10:]).max() < 0.4


def test_a_robot_that_was_carried_away_is_lost_and_found_within_ten_seconds():
    poses = path(ROUND)
    drive = robot(known())
    assert not drive.along(poses[:30])[-1].lost
    drive.carried()
    states = drive.along(poses[100:150])
    lost = next(k for k, s in enumerate(states) if s.lost)
    found = lost + first_found(states[lost:])
    assert found < 50
    assert errors(states[found:], poses[100 + found : 150]).max() < 0.1


def test_a_robot_that_was_tracked_is_found_again_before_it_drives_on():
    """Ranges to two anchors, in a map that is known to be the right one."""
    two = {name: ANCHORS[name] for name in ("A", "C")}
    poses = path(ROUND)
    stands = np.repeat(poses[120:121], 20, axis=0)
    drive = robot(known(anchors=two), anchors=two)
    assert not drive.along(poses[:60])[-1].lost
    drive.carried()
    states = drive.along(stands)
    assert any(s.lost for s in states)
    assert not states[-1].lost
    assert errors(states[-1:], stands[-1:])[0] < 0.1


def test_ranges_alone_notice_that_it_was_carried_away():
    poses = path(ROUND)
    drive = robot(known(None))
    assert not drive.along(poses[:110])[-1].lost
    drive.carried()
    assert any(s.lost for s in drive.along(poses[-60:]))


def test_scans_of_unknown_space_speak_for_no_pose_that_ranges_contradict():
    """Carried to where the walls of the map are out of view: what fitted before does not support the old place."""
    poses = path(ROUND)
    drive = robot(known())
    assert not drive.along(poses[:30])[-1].lost
    drive.carried()
    # A scan beyond the map's edge: every ray ends in unknown space.
    drive.walls = ((-30.0, 3.0, 30.0, 3.0),)
    states = drive.along(np.column_stack([np.linspace(30, 31, 40), np.full(40, 5.5), np.zeros(40)]))
    assert states[-1].lost


def test_rooms_that_the_map_does_not_hold_take_no_pose_away_while_ranges_agree():
    """The map ends behind the robot: what it sees beyond says nothing, and pulls at nothing."""
    grid = grid_of(ODD)
    right = grid.geometry.centre_of(*np.indices(grid.log_odds.shape))[..., 0] > 4.0
    cut = dataclasses.replace(grid, log_odds=np.where(right, 0.0, grid.log_odds).astype(np.float32))
    half = dataclasses.replace(known(), walls=walls_of(cut))
    poses = path(((1.0, 2.5), (3.5, 2.5), (3.5, 5.0), (1.5, 5.0), (1.5, 3.0), (7.0, 3.0)))
    drive = robot(half)
    states = drive.along(poses)
    found = first_found(states)
    # Found before it leaves the half that the map holds, x = 4 m, and still known three metres beyond.
    assert poses[found, 0] < 4.0
    assert not any(s.lost for s in states[found:])
    # Metres by wheels that are 1 % off and ranges of 0.03 m.
    assert errors(states[found:], poses[found:]).max() < 0.15


def test_a_start_at_the_map_s_edge_is_certain_though_most_rays_end_beyond_it():
    """What lies beyond the map says nothing about whether the map is the right one."""
    grid = grid_of(ODD)
    right = grid.geometry.centre_of(*np.indices(grid.log_odds.shape))[..., 0] > 2.6
    cut = dataclasses.replace(grid, log_odds=np.where(right, 0.0, grid.log_odds).astype(np.float32))
    poses = path(((2.2, 2.0), (2.2, 5.0)))
    states = robot(dataclasses.replace(known(), walls=walls_of(cut))).along(poses)
    # As where all is mapped: a metre.
    assert first_found(states) <= 13
    assert errors(states[-1:], poses[-1:]).max() < 0.15


def test_a_few_ends_near_walls_pull_at_no_pose_where_the_others_lie_in_unknown_space():
    """The map ends before the robot; what it sees beside itself is 0.1 m off the walls that the map has there."""
    grid = grid_of(ODD)
    right = grid.geometry.centre_of(*np.indices(grid.log_odds.shape))[..., 0] > 4.0
    cut = dataclasses.replace(grid, log_odds=np.where(right, 0.0, grid.log_odds).astype(np.float32))
    drive = robot(dataclasses.replace(known(), walls=walls_of(cut)))
    poses = path(((1.0, 2.5), (3.5, 2.5), (3.5, 5.0), (1.5, 5.0), (1.5, 3.0), (3.8, 3.0)))
    odd = (poses[:, 0] > 2.5) & (np.arange(len(poses)) > len(poses) - 20)
    assert not drive.along(poses[~odd])[-1].lost
    bearing = np.degrees(SCANNER.angle_min + SCANNER.angle_increment * np.arange(181))
    for pose in poses[odd]:
        drive.along(pose[None], scans=False, ranges=False)
        beside = cast(pose + np.array([0.0, 0.1, 0.0]))
        beyond = cast(pose)
        beyond[pose[0] + beyond * np.cos(np.radians(bearing)) < 4.2] = np.nan
        readings = np.where(np.abs(bearing) > 80.0, beside, beyond)
        state = drive.localizer.add_scan(drive.stamp - 0.2, readings, SCANNER)
    assert not state.lost
    assert abs(state.pose[1] - 3.0) < 0.04


def test_legs_and_moved_things_do_not_pull():
    """Two people walk beside the robot, a quarter of its view each side."""
    poses = path(ROUND)
    walker = ((0.6, 0.5), (0.7, -0.5))

    drive = robot(known())
    states = []
    for pose in poses[:80]:
        here = [se2.transform(pose, np.array(w)) for w in walker]
        legs = tuple((x - 0.15, y, x + 0.15, y) for x, y in here) + tuple((x, y - 0.15, x, y + 0.15) for x, y in here)
        drive.walls = ODD + legs
        states += drive.along(pose[None])
    found = first_found(states)
    assert found < 60
    assert errors(states[found:], poses[found:80]).max() < 0.1


@pytest.mark.slow
def test_a_moved_anchor_is_named_and_does_not_pull():
    poses = path(ROUND)
    drive = robot(known(), anchors=ANCHORS | {"B": (5.0, 2.0)})
    states = drive.along(np.concatenate([poses, poses[::-1] + np.array([0.0, 0.0, np.pi])]))
    found = first_found(states)
    assert found < len(poses)
    assert errors(states[found : len(poses)], poses[found:]).max() < 0.1
    assert states[-1].moved_anchors == ("B",)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (20.0, -3.0)])
def test_a_map_that_lies_elsewhere_moves_the_poses_and_nothing_else(shift):
    """By whole cells of the search's field: the places that are tried are then the same."""
    poses = path(ROUND)[:40]
    room = known()
    walls = room.walls
    away = np.array(shift)
    geometry = dataclasses.replace(walls.geometry, origin=walls.geometry.origin + away)
    moved = dataclasses.replace(
        room,
        anchors=dataclasses.replace(room.anchors, positions=room.anchors.positions + away),
        walls=dataclasses.replace(walls, geometry=geometry, points=walls.points + away, origin=walls.origin + away),
    )
    for one, other in zip(robot(room).along(poses), robot(moved).along(poses), strict=True):
        assert one.lost == other.lost
        if not one.lost:
            np.testing.assert_allclose(other.pose - [*shift, 0], one.pose, atol=1e-6)


@pytest.mark.slow
def test_another_building_is_never_taken_for_this_one():
    stranger = ((0, 0, 3, 0), (3, 0, 3, 9), (3, 9, 0, 9), (0, 9, 0, 0), (1.4, 2, 1.4, 7))
    poses = path(((0.7, 1.0), (0.7, 8.0), (2.2, 8.0), (2.2, 1.0)))
    states = robot(known(anchors={}), walls=stranger).along(poses, ranges=False)
    assert all(s.lost for s in states)
    assert states[-1].reason


@pytest.mark.slow
def test_a_map_of_another_scale_is_never_taken_for_this_one():
    """A plan in feet that was read as metres."""
    larger = {name: (3.28 * x, 3.28 * y) for name, (x, y) in ANCHORS.items()}
    states = robot(known(None, larger)).along(path(ROUND), scans=False)
    assert all(s.lost for s in states)


def test_anchors_that_the_map_does_not_know_are_counted():
    drive = robot(known(), anchors={"X": (1.0, 1.0)})
    drive.along(path(ROUND)[:15], scans=False)
    assert drive.localizer.strangers == {"X": 3}


def test_as_many_ids_as_ranges_are_wanted():
    with pytest.raises(DataError, match="2 anchor ids for 3 ranges"):
        robot(known()).localizer.add_ranges(100.0, ["A", "B"], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(("call", "words"), [
    (lambda r: r.add_odometry("now", 0.0, 0.0, 0.0), "stamp must be a number, not str 'now'"),
    (lambda r: r.add_odometry(1.0, 0.0, [0.0], 0.0), "y must be a number, not list"),
    (lambda r: r.add_gyro(1.0, None), "heading must be a number, not NoneType"),
    (lambda r: r.add_ranges(1.0, "AB", [1.0, 2.0]), "anchor_ids must be a list of names, not 'AB'"),
    (lambda r: r.add_ranges(1.0, [1], [1.0]), "anchor_ids must be a list of names"),
    (lambda r: r.add_ranges(1.0, ["A"], ["far"]), "metres must hold numbers, not str"),
    (lambda r: r.add_ranges(1.0, ["A"], [1.0], tag=1), "tag 1 is none of the robot's 1 tags"),
    (lambda r: r.add_scan(1.0, np.ones((1, 181)), SCANNER), r"ranges has shape \(1, 181\), expected \(181,\)"),
    (lambda r: r.add_scan(1.0, np.ones(10)), r"ranges has shape \(10,\), expected \(181,\)"),
])  # fmt: skip
def test_measurements_of_another_form_are_refused_by_the_name_of_the_argument(call, words):
    localizer = robot(known()).localizer
    localizer.add_scan(0.0, [2] * 181, SCANNER)
    with pytest.raises(DataError, match=words):
        call(localizer)


def test_another_scanner_may_have_another_number_of_rays():
    localizer = robot(known()).localizer
    localizer.add_scan(0.0, np.full(181, 2.0), SCANNER)
    localizer.add_scan(0.1, np.full(91, 2.0), dataclasses.replace(SCANNER, angle_increment=2 * SCANNER.angle_increment))
    localizer.add_scan(0.2, [])
    localizer.add_scan(0.3, np.full(91, 2.0))


def test_values_that_no_device_measures_change_nothing(drive):
    """Poses and headings whose steps have no digits left, readings beyond any lidar, a header that is broken."""
    poses, states = drive
    odd = robot(known())
    odd.along(poses[:20])
    before = odd.localizer.add_scan(odd.stamp - 0.1, np.full(181, 1e200), Scanner(-1.5, 0.01, 0.0, 0.02, np.inf))
    odd.localizer.add_odometry(odd.stamp - 0.05, 1e300, -1e300, np.inf)
    odd.localizer.add_gyro(odd.stamp - 0.05, -1e300)
    for scanner in (Scanner(np.nan, 0.01), Scanner(-1.5, np.inf), Scanner(-1.5, 0.01, np.nan)):
        odd.localizer.add_scan(odd.stamp - 0.15, np.full(181, 2.0), scanner)
    assert not before.lost
    again = odd.along(poses[20:30])
    np.testing.assert_allclose(again[-1].pose, states[29].pose, atol=0.02)


def test_a_lidar_that_states_no_reach_has_one():
    """Infinity, read where nothing was seen, is then no wall either."""
    poses, drive = path(ROUND)[:40], robot(known())
    scanner = dataclasses.replace(SCANNER, range_max=np.inf)
    for k, pose in enumerate(poses):
        drive.localizer.add_odometry(100.0 + 0.2 * k, *pose)
        drive.localizer.add_ranges(100.0 + 0.2 * k, list(ANCHORS), [np.hypot(*(pose[:2] - p)) for p in ANCHORS.values()])
        readings = np.where(np.arange(181) < 40, np.inf, cast(pose))
        state = drive.localizer.add_scan(100.0 + 0.2 * k, readings, scanner)
    assert not state.lost
    np.testing.assert_allclose(state.pose, poses[-1], atol=0.03)


@pytest.mark.parametrize("every", [5, 10])
def test_an_odometry_that_comes_rarely_is_waited_for(every):
    """Every one or two seconds: scans between two of them are laid where it says that the robot was."""
    poses = path(ROUND)
    drive = robot(known())
    drive.along(poses[:70], every=every)
    state = drive.along(poses[70 : 70 + every], every=every)[-1]
    assert not state.lost
    assert errors([state], poses[69 + every : 70 + every])[0] < 0.1


def test_where_nothing_measures_how_a_robot_moves_it_is_lost_or_where_it_was_a_second_ago():
    """Scans and ranges of different places, taken for those of one place, fit some third one."""
    poses = path(ROUND)
    drive = robot(known())
    drive.along(poses[:1])
    for k, pose in enumerate(poses[1:50]):
        drive.localizer.add_scan(100.2 + 0.2 * k, cast(pose), SCANNER)
        state = drive.localizer.add_ranges(100.2 + 0.2 * k, ["A", "C"], [np.hypot(*(pose[:2] - ANCHORS[n])) for n in "AC"])
        off = np.abs(se2.between(state.pose, poses[max(k - 6, 0) : k + 2]))
        assert state.lost or ((np.hypot(off[:, 0], off[:, 1]) < 0.15) & (off[:, 2] < 0.25)).any()


def test_a_robot_whose_wheels_are_frozen_is_followed_by_its_scans():
    """By its wheels it stands; a scan that fits 400 times as well a little further on says that it does not."""
    poses = path(ROUND)
    drive = robot(known())
    before = drive.along(poses[:10])[-1]
    for k, pose in enumerate(poses[10:30]):
        stamp = before.stamp + 0.2 * (k + 1)
        drive.localizer.add_scan(stamp, cast(pose), SCANNER)
        state = drive.localizer.add_odometry(stamp, *before.odometry)
        state = drive.localizer.add_odometry(stamp + 0.1, *before.odometry)
        assert not state.lost
        assert np.hypot(*(state.pose - pose)[:2]) < 0.25


def test_a_map_of_large_cells_serves():
    """0.2 m: walls lie anywhere within half a cell, which the covariance holds."""
    coarse = grid_of(ODD, cell=0.2)
    room = dataclasses.replace(known(), walls=walls_of(coarse))
    poses = path(ROUND)[:80]
    state = robot(room).along(poses)[-1]
    assert not state.lost
    off = np.append(state.pose[:2] - poses[-1, :2], se2.wrap_angle(state.pose[2] - poses[-1, 2]))
    assert off @ np.linalg.solve(state.covariance, off) < 14.2  # three degrees of freedom, 1 in 400


def test_a_silent_odometry_makes_the_pose_unsure():
    poses = path(ROUND)
    drive = robot(known())
    before = drive.along(poses[:30])[-1]
    drive.localizer.add_ranges(drive.stamp + 4.0, ["X"], [1.0])
    drive.localizer.add_ranges(drive.stamp + 4.0, ["A"], [200.5])
    for late in (4.0, 4.3, 4.6):  # one alone might be a stamp that is off
        after = drive.localizer.add_ranges(drive.stamp + late, ["A"], [50.0])
    assert np.trace(after.covariance) > 10 * np.trace(before.covariance)


@pytest.mark.parametrize("kind", ["range", "scan", "odometry"])
def test_one_stamp_far_ahead_changes_nothing_and_is_counted(kind, drive):
    poses, states = drive
    odd = robot(known())
    odd.along(poses[:20])
    if kind == "range":
        odd.localizer.add_ranges(odd.stamp + 3600.0, ["A", "B"], [5.0, 6.0])
    elif kind == "scan":
        odd.localizer.add_scan(odd.stamp + 1e6, np.full(181, 2.0), SCANNER)
    else:
        odd.localizer.add_odometry(odd.stamp + 1000.0, *poses[20])
    again = odd.along(poses[20:30])
    np.testing.assert_array_equal(again[-1].pose, states[29].pose)
    assert odd.localizer.refused == (2 if kind == "range" else 1)


def test_after_all_sensors_were_silent_the_odometry_goes_on():
    poses = path(ROUND)
    drive = robot(known())
    drive.along(poses[:30])
    drive.stamp += 60.0
    after = drive.along(poses[30:40])[-1]
    assert after.stamp > 60.0
    assert not after.lost
    np.testing.assert_allclose(after.pose, poses[39], atol=0.05)
    assert drive.localizer.refused == 0


def test_sensors_that_go_on_show_that_the_odometry_was_silent_for_long():
    poses = path(ROUND)
    drive = robot(known())
    before = drive.along(poses[:30])[-1]
    for k in range(8):
        after = drive.localizer.add_ranges(drive.stamp + 60.0 + 0.2 * k, ["A"], [50.0])
    assert after.stamp > before.stamp + 59.0
    assert np.trace(after.covariance) > 10 * np.trace(before.covariance)


@pytest.mark.parametrize("back", [2.0, 3600.0])
def test_a_clock_that_is_set_back_stops_nothing(back):
    poses = path(ROUND)
    drive = robot(known())
    drive.along(poses[:30])
    drive.stamp -= back
    states = drive.along(poses[30:60])
    assert not any(s.lost for s in states)
    assert errors(states[5:], poses[35:60]).max() < 0.1
    assert states[-1].stamp == pytest.approx(drive.stamp - 0.2)


def test_one_odometry_of_the_past_sets_no_clock_back(drive):
    poses, states = drive
    odd = robot(known())
    odd.along(poses[:20])
    for k in range(10):
        odd.localizer.add_odometry(odd.stamp - 50.0 + 0.02 * (k % 3), 0.0, 0.0, 0.0)
    again = odd.along(poses[20:30])
    np.testing.assert_array_equal(again[-1].pose, states[29].pose)


def test_an_odometry_that_was_set_back_alone_keeps_the_other_clocks():
    poses = path(ROUND)
    odd = robot(known())
    odd.along(poses[:30])
    for pose in poses[30:60]:
        odd.odom = se2.compose(odd.odom, se2.between(odd.last, pose) * [1.01, 1.0, 1.0])
        odd.last = pose
        state = odd.localizer.add_odometry(odd.stamp - 1000.0, *odd.odom)
        state = odd.localizer.add_scan(odd.stamp, cast(pose), SCANNER)
        odd.stamp += 0.2
    assert not state.lost
    assert np.hypot(*(state.pose - poses[59])[:2]) < 0.3
    assert odd.localizer.refused == 0


@pytest.mark.parametrize("jumped", ["odometry", "lidar"])
def test_one_clock_that_is_set_forward_alone_moves_no_pose(jumped):
    poses = path(ROUND)
    drive = robot(known())
    drive.along(poses[:30])
    name = {"odometry": "add_odometry", "lidar": "add_scan"}[jumped]
    add = getattr(drive.localizer, name)
    setattr(drive.localizer, name, lambda stamp, *rest: add(stamp + 1.5, *rest))
    states = drive.along(poses[30:60])
    assert not any(s.lost for s in states)
    assert errors(states, poses[30:60]).max() < 0.1
    assert np.sqrt(np.trace(states[-1].covariance[:2, :2])) < 0.05


def test_an_odometry_that_is_always_a_second_late_is_waited_for():
    poses, drive = path(ROUND), robot(known())
    steps = se2.between(poses[:-1], poses[1:])
    odom = [np.zeros(3)]
    for step in steps:
        odom.append(se2.compose(odom[-1], step))
    for k, pose in enumerate(poses[:100]):
        if k >= 5:
            state = drive.localizer.add_odometry(100.0 + 0.2 * (k - 5), *odom[k - 5])
        drive.localizer.add_scan(100.0 + 0.2 * k, cast(pose), SCANNER)
        if k % 5 == 0:
            metres = [np.hypot(*(np.array(p) - pose[:2])) for p in ANCHORS.values()]
            drive.localizer.add_ranges(100.0 + 0.2 * k, list(ANCHORS), metres)
    assert not state.lost
    assert np.hypot(*(state.pose - poses[94])[:2]) < 0.1


def test_a_map_of_nothing_is_refused(tmp_path):
    (tmp_path / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    from uwblite.io.stored_result import read_result

    with pytest.raises(DataError, match="neither an anchor"):
        from_result(read_result(tmp_path))


def test_garbage_among_the_measurements_changes_nothing(drive):
    poses, states = drive
    odd = robot(known())
    odd.localizer.add_scan(50.0, np.full(181, np.nan), SCANNER)
    odd.localizer.add_ranges(np.nan, ["A"], [1.0])
    odd.localizer.add_ranges(99.0, ["A", "B"], [np.nan, -3.0])
    odd.localizer.add_odometry(99.5, np.nan, 0.0, 0.0)
    again = odd.along(poses[:30])
    np.testing.assert_allclose(again[-1].pose, states[29].pose, atol=0.02)


def test_a_robot_that_is_tracked_without_doubt_searches_nothing_and_a_lost_one_twice_a_second(monkeypatch):
    poses, drive, begun = path(ROUND)[:75], robot(known(anchors={})), []
    begin, start = PlaceSearch.begin, drive.stamp

    def noted(search, *words):
        begun.append(drive.stamp - start)
        begin(search, *words)

    monkeypatch.setattr(PlaceSearch, "begin", noted)
    # s, of a state each fifth of a second.
    found = 0.2 * first_found(drive.along(poses, ranges=False))
    assert found < 12.0
    assert 2 <= sum(when <= found for when in begun) <= 1 + 2 * found
    assert not [when for when in begun if when > found + 0.1]


@pytest.mark.parametrize("first", [0, 1])
def test_of_two_places_scans_tell_the_right_one(first):
    """The other one is a metre aside, and as likely before."""
    poses, drive = path(ROUND)[:43], robot(known())
    assert not drive.along(poses[:40])[-1].lost
    estimator = drive.localizer._estimator
    (pose,), (covariance,) = estimator._bank.poses, estimator._bank.pose_covariances
    places = np.array([pose, pose + np.array([0.7, 0.7, 0.0])])[[first, 1 - first]]
    biases = estimator.known.anchors.bias_sigma
    estimator._bank = hypotheses.started(places, np.array([covariance] * 2), biases)
    drive.along(poses[40:], ranges=False)
    off = np.hypot(*(estimator._bank.poses - poses[-1])[:, :2].T)
    right = off < 0.2
    assert right.any()
    assert estimator._bank.log_weight[right].max() == 0.0
    assert estimator._bank.log_weight[~right].max(initial=-np.inf) < -5.0
