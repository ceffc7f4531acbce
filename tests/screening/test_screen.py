"""Contradictions within a recording are repaired where they can be, and reported in any case."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds
from helpers.told import told

from uwblite import se2
from uwblite.errors import DataError
from uwblite.findings import Fact
from uwblite.screening import clocks, cuts, repeats, wheel_motion
from uwblite.screening import screen as screening
from uwblite.screening.screen import screen
from uwblite.se2 import chain as chained
from uwblite.sensor_log import LogNotes, Odometry, SensorLog, UwbRanges


@pytest.fixture(scope="module")
def sound():
    """A round and a half."""
    return recording(two_rounds()[:2400])


def with_poses(log, poses):
    return replace(log, odometry=Odometry(log.odometry.stamps, poses))


def kinds(log, doubts=False):
    return {r.kind for r in told(log.screening.facts) if r.severity == "doubt" or not doubts}


def frozen(log, start, end):
    steps = se2.between(log.odometry.poses[:-1], log.odometry.poses[1:])
    still = (log.odometry.stamps[1:] >= start) & (log.odometry.stamps[1:] < end)
    return with_poses(log, chained(log.odometry.poses[0], np.where(still[:, None], 0.0, steps)))


def test_a_sound_recording_stays_as_it_is(sound):
    done = screen(sound)
    assert done.screening.facts == ()
    assert len(done.screening.breaks.stamps) == 0
    assert done.odometry is sound.odometry
    assert screen(done) is done


def test_wheels_that_stand_still_are_replaced_by_the_motion_from_scan_to_scan(sound):
    log = frozen(sound, 130.0, 160.0)
    done = screen(log)
    assert kinds(done) == {"wheels-stand-still"}
    assert not kinds(done, doubts=True)
    motion, true, lost = (
        se2.between(*(se2.interpolate_trajectory(x.odometry.stamps, x.odometry.poses, t) for t in (130.0, 160.0)))
        for x in (done, sound, log)
    )
    assert np.hypot(*(lost - true)[:2]) > 0.5 or abs(se2.wrap_angle(lost[2] - true[2])) > 1.0
    # 120 steps of 0.02 m and 0.01 rad, as single scans have; only the scans, which are matched again, state what they measure.
    assert np.hypot(*(motion - true)[:2]) < 0.44
    assert abs(se2.wrap_angle(motion[2] - true[2])) < 0.22
    spread = np.sqrt((done.screening.breaks.sigma**2).sum(axis=0))
    assert np.all(spread > [1.0, 1.0, 1.0])


def test_without_lidar_ranges_show_that_wheels_stand_still_and_the_map_is_doubted(sound):
    done = screen(frozen(sound, 120.0, 200.0).without(lidar=True))
    assert kinds(done, doubts=True) == {"wheels-stand-still"}


def test_ranges_do_not_accuse_wheels_that_the_lidar_confirms(sound):
    """All ranges become 2 m longer in the middle: no path of the wheels fits, and only a lidar shows that it is right."""
    middle = sound.ranges.stamps.mean()
    log = replace(sound, ranges=replace(sound.ranges, ranges=sound.ranges.ranges + 2.0 * (sound.ranges.stamps > middle)))
    assert "wheels-against-ranges" in kinds(screen(log.without(lidar=True)))
    assert "wheels-against-ranges" not in kinds(screen(log))


def test_ranges_show_it_as_well_while_the_lidar_is_silent(sound):
    log = frozen(sound, 130.0, 150.0)
    silent = replace(log, scans=log.scans.rows((log.scans.stamps < 120.0) | (log.scans.stamps > 160.0)))
    done = screen(silent)
    assert kinds(done, doubts=True) == {"wheels-stand-still"}
    unknown = done.screening.breaks.stamps
    assert unknown.min() > 129.0
    assert unknown.max() < 150.0
    assert not kinds(screen(silent.without(uwb=True)), doubts=True)


def test_a_robot_that_stands_has_no_lost_wheels(sound):
    rests = 0.05 * np.arange(400)
    stamps = np.concatenate([100.0 + rests, sound.odometry.stamps + 20.0])
    poses = np.concatenate([np.repeat(sound.odometry.poses[:1], 400, axis=0), sound.odometry.poses])
    again = np.random.default_rng(2).normal(0.0, 0.01, (100, sound.scans.ranges.shape[1]))
    scans = replace(
        sound.scans,
        stamps=np.concatenate([100.0 + 0.2 * np.arange(100), sound.scans.stamps + 20.0]),
        ranges=np.concatenate([sound.scans.ranges[:1] + again, sound.scans.ranges]).astype(np.float32),
    )
    ranges = replace(sound.ranges, stamps=sound.ranges.stamps + 20.0)
    done = screen(replace(sound, odometry=Odometry(stamps, poses), scans=scans, ranges=ranges))
    assert done.screening.facts == ()


def test_scans_of_a_single_column_do_not_move_a_robot_that_stands(sound):
    """About one round thing a robot may turn or stand alike: that is no reason to replace the wheels."""
    rng, scans = np.random.default_rng(3), sound.scans
    angles = scans.angle_min + scans.angle_increment * np.arange(scans.ranges.shape[1])
    off = 2.0 * np.sin(angles - 0.2)
    column = 2.0 * np.cos(angles - 0.2) - np.sqrt(np.maximum(0.35**2 - off**2, 0.0))
    seen = (np.abs(off) < 0.35) & (np.cos(angles - 0.2) > 0.0)
    readings = np.where(seen, column + rng.normal(0.0, 0.02, scans.ranges.shape), np.inf).astype(np.float32)
    rest = with_poses(sound, np.repeat(sound.odometry.poses[:1], len(sound.odometry.stamps), axis=0))
    alone = replace(rest, scans=replace(scans, ranges=readings)).without(uwb=True)
    assert "wheels-stand-still" not in kinds(screen(alone))


def test_one_reading_far_off_is_left_out(sound):
    poses = sound.odometry.poses.copy()
    poses[1000, :2] += 3000.0
    done = screen(with_poses(sound.without(lidar=True), poses))
    assert kinds(done) == {"odometry-glitches"}
    assert len(done.odometry.stamps) == len(poses) - 1
    assert np.abs(done.odometry.poses).max() < 20.0


def test_a_reset_is_a_break_whose_sides_are_joined_by_predicted_motion(sound):
    poses = sound.odometry.poses.copy()
    poses[1500:] = se2.between(poses[1500], poses[1500:])
    done = screen(with_poses(sound, poses))
    assert kinds(done) == {"odometry-breaks"}
    np.testing.assert_allclose(done.screening.breaks.stamps, sound.odometry.stamps[1499])
    off = se2.between(sound.odometry.poses, done.odometry.poses)
    assert np.abs(off).max() < 0.1


@pytest.mark.parametrize(
    ("factor", "unit"), [((1000, 1000, 1), "millimetres"), ((100, 100, 1), "centimetres"), ((1, 1, 180 / np.pi), "degrees")]
)
def test_wrong_units_of_the_odometry_are_refused_by_name(sound, factor, unit):
    with pytest.raises(DataError, match=unit):
        screen(with_poses(sound, sound.odometry.poses * factor))


def test_wrong_units_of_ranges_and_scans_are_refused_by_name(sound):
    with pytest.raises(DataError, match="ranges look like millimetres"):
        screen(replace(sound, ranges=replace(sound.ranges, ranges=sound.ranges.ranges * 1000)))
    far = replace(sound.scans, ranges=sound.scans.ranges * 1000, range_max=5600.0)
    with pytest.raises(DataError, match="laser's readings look like millimetres"):
        screen(replace(sound, scans=far))


def test_two_sources_in_one_log_are_refused(sound):
    other = se2.compose(np.array([3.0, 2.0, 1.0]), sound.odometry.poses)
    stamps = np.repeat(sound.odometry.stamps, 2) + np.tile([0.0, 0.01], len(other))
    poses = np.stack([sound.odometry.poses, other], axis=1).reshape(-1, 3)
    with pytest.raises(DataError, match="two robots"):
        screen(replace(sound, odometry=Odometry(stamps, poses)))


def test_readings_that_stand_in_a_log_twice_count_once(sound):
    twice = {name: np.repeat(getattr(sound.ranges, name), 2) for name in ("stamps", "anchor", "ranges", "quality")}
    log = replace(
        sound,
        odometry=Odometry(np.repeat(sound.odometry.stamps, 2), np.repeat(sound.odometry.poses, 2, axis=0)),
        ranges=UwbRanges(**twice, anchor_ids=sound.ranges.anchor_ids),
        scans=replace(sound.scans, stamps=np.repeat(sound.scans.stamps, 2), ranges=np.repeat(sound.scans.ranges, 2, axis=0)),
    )
    done = screen(log)
    np.testing.assert_array_equal(done.odometry.stamps, sound.odometry.stamps)
    np.testing.assert_array_equal(done.scans.stamps, sound.scans.stamps)
    assert len(done.ranges.stamps) == len(sound.ranges.stamps)


def test_scans_that_repeat_themselves_are_left_out(sound):
    readings = sound.scans.ranges.copy()
    readings[400:] = readings[400]
    done = screen(replace(sound, scans=replace(sound.scans, ranges=readings)))
    assert kinds(done) == {"repeated-scans"}
    assert len(done.scans.stamps) == 401


def test_ranges_that_repeat_themselves_are_left_out(sound):
    stuck = (sound.ranges.anchor == 1) & (sound.ranges.stamps > 180.0)
    log = replace(sound, ranges=replace(sound.ranges, ranges=np.where(stuck, 4.2, sound.ranges.ranges))).without(lidar=True)
    done = screen(log)
    assert kinds(done) == {"repeated-ranges"}
    assert len(done.ranges.stamps) == len(stuck) - stuck.sum()


@pytest.mark.parametrize("beyond", [False, True])
def test_a_value_that_marks_what_a_radio_could_not_measure_is_left_out(sound, beyond):
    """A radio that reports its reach for all that is farther, or one value for every third range."""
    r = sound.ranges
    reach = float(np.quantile(r.ranges, 0.7))
    marked = r.ranges >= reach if beyond else np.arange(len(r.ranges)) % 3 == 0
    done = screen(replace(sound, scans=None, ranges=replace(r, ranges=np.where(marked, reach if beyond else 65.535, r.ranges))))
    assert kinds(done) == {"marked-ranges" if beyond else "repeated-ranges"}
    np.testing.assert_array_equal(done.ranges.ranges, r.ranges[~marked])


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_rounded_ranges_mark_nothing(sound, step):
    log = replace(sound, ranges=replace(sound.ranges, ranges=np.round(sound.ranges.ranges / step) * step))
    assert len(repeats.without_marks(log)[0].ranges.ranges) == len(log.ranges.ranges)


@pytest.mark.parametrize("beyond", [False, True])
def test_a_value_that_a_lidar_repeats_everywhere_is_no_wall(sound, beyond):
    """A lidar that reports its reach for all that is farther, or one value for every tenth beam."""
    scans = sound.scans
    reach = np.float32(np.nanquantile(scans.ranges, 0.7))
    every_tenth = np.broadcast_to(np.arange(scans.ranges.shape[1]) % 10 == 0, scans.ranges.shape)
    marked = ~(scans.ranges < reach) if beyond else every_tenth
    mark = reach if beyond else np.float32(1.0)
    done = screen(replace(sound, scans=replace(scans, ranges=np.where(marked, mark, scans.ranges))))
    assert kinds(done) == {"repeated-readings"}
    assert told(done.screening.facts)[0].text.startswith(f"{marked.sum()} of {marked.size} readings")
    np.testing.assert_array_equal(done.scans.ranges[~marked], scans.ranges[~marked])
    assert np.isposinf(done.scans.ranges[marked]).all() if beyond else np.isnan(done.scans.ranges[marked]).all()
    assert done.scans.range_max == (reach if beyond else scans.range_max)


@pytest.mark.parametrize("step", [0.001, 0.01, 0.05])
def test_rounded_readings_mark_nothing(sound, step):
    log = replace(sound, scans=replace(sound.scans, ranges=(np.round(sound.scans.ranges / step) * step).astype(np.float32)))
    assert repeats.without_lidar_marks(log)[0] is log


def test_a_heading_against_the_path_is_turned_and_the_laser_reports_how(sound):
    done = screen(with_poses(sound, sound.odometry.poses * (1, 1, -1)))
    assert kinds(done) == {"heading-against-path"}
    np.testing.assert_allclose(done.odometry.poses, sound.odometry.poses)
    done = screen(with_poses(sound, sound.odometry.poses * (1, -1, 1)))
    np.testing.assert_allclose(done.odometry.poses, sound.odometry.poses)


def test_laser_and_wheels_that_turn_opposite_ways_are_a_doubt(sound):
    done = screen(replace(sound, scans=replace(sound.scans, ranges=sound.scans.ranges[:, ::-1].copy())))
    assert kinds(done, doubts=True) == {"laser-turned-over"}
    assert done.mounting.laser_flipped
    left = screen(replace(sound, scans=replace(sound.scans, ranges=sound.scans.ranges[:, ::-1].copy())), turn_laser=False)
    assert not left.mounting.laser_flipped


def test_late_scans_are_placed_with_the_laser_as_it_is_mounted_and_the_wheels_compared_again(sound, monkeypatch):
    """The wheels of such a recording are set right where its scans show them."""
    placed = []

    def late(log):
        placed.append(log.mounting.laser_flipped)
        return with_poses(log, sound.odometry.poses * (1.25, 1.25, 1.0)), [Fact.of("late-scans", count=1, total=9)]

    monkeypatch.setattr("uwblite.screening.clocks.with_late_scans_placed", late)
    done = screen(replace(sound, scans=replace(sound.scans, ranges=sound.scans.ranges[:, ::-1].copy())))
    assert placed == [True]
    assert {"laser-turned-over", "late-scans"} <= {fact.kind for fact in done.screening.facts}
    assert done.screening.lidar_by_wheels == pytest.approx(0.8, abs=0.03)


def test_a_base_that_drives_backwards_has_its_laser_turned(sound):
    steps = se2.between(sound.odometry.poses[:-1], sound.odometry.poses[1:]) * (-1, -1, 1)
    done = screen(with_poses(sound, chained(sound.odometry.poses[0], steps)))
    assert kinds(done) == {"laser-turned-away"}
    assert abs(se2.wrap_angle(done.mounting.T_base_laser[2] - np.pi)) < 0.05


def test_a_base_that_drives_backwards_carries_its_sensors_elsewhere_and_a_laser_turned_on_the_spot_does_not(sound):
    given = replace(sound.mounting, T_base_laser=np.array([0.1, 0.0, 0.0]), tag_position=np.array([-0.1, 0.05, 0.6]))
    # The room's scans are where the odometry is; with the laser 0.1 m ahead of the base, the base is behind that.
    about = se2.compose(sound.odometry.poses, np.array([-0.1, 0.0, 0.0]))
    assert np.allclose(se2.compose(about, given.T_base_laser), sound.odometry.poses)
    reversed_ = replace(with_poses(sound, se2.compose(about, np.array([0.0, 0.0, np.pi]))), mounting=given)
    done = screen(reversed_)
    np.testing.assert_allclose(np.abs(done.mounting.T_base_laser), [0.1, 0.0, np.pi], atol=0.05)
    assert done.mounting.T_base_laser[0] < 0.0
    np.testing.assert_allclose(done.mounting.tag_position, [0.1, -0.05, 0.6], atol=0.02)
    turned = replace(with_poses(sound, about), mounting=replace(given, T_base_laser=np.array([0.1, 0.0, np.pi])))
    done = screen(turned)
    np.testing.assert_allclose(done.mounting.T_base_laser[:2], [0.1, 0.0], atol=0.01)
    assert abs(se2.wrap_angle(done.mounting.T_base_laser[2])) < 0.1


def test_scans_of_noise_are_a_doubt(sound):
    log = sound.crop(end=115.0)
    noise = np.random.default_rng(1).uniform(0.1, 5.5, (len(log.scans.stamps), 341)).astype(np.float32)
    done = screen(replace(log, scans=replace(log.scans, ranges=noise, angle_increment=4.0 / 341)))
    assert "scans-do-not-match" in kinds(done, doubts=True)


@pytest.mark.parametrize("without", [{}, {"uwb": True}, {"lidar": True}])
def test_a_robot_that_was_carried_is_a_break_and_a_doubt(sound, without):
    """From 150 s to 190 s the log lacks, and its stamps are closed up."""
    log = sound.without(**without)
    stamps, poses = log.odometry.stamps, log.odometry.poses
    before, after = stamps < 150.0, stamps >= 190.0
    put = se2.compose(poses[before][-1], se2.inverse(poses[after][0]))

    def closed(t):
        return np.concatenate([t[t < 150.0], t[t >= 190.0] - 40.0])

    def kept(t, values):
        return values[(t < 150.0) | (t >= 190.0)]

    moved = np.concatenate([poses[before], se2.compose(put, poses[after])])
    scans, ranges = log.scans, log.ranges
    if scans is not None:
        scans = replace(scans, stamps=closed(scans.stamps), ranges=kept(scans.stamps, scans.ranges))
    if ranges is not None:
        rows = {n: kept(ranges.stamps, getattr(ranges, n)) for n in ("anchor", "ranges", "quality")}
        ranges = UwbRanges(closed(ranges.stamps), **rows, anchor_ids=ranges.anchor_ids)
    done = screen(replace(log, odometry=Odometry(closed(stamps), moved), scans=scans, ranges=ranges))
    assert kinds(done, doubts=True) == {"carried"}
    assert np.all(np.abs(done.screening.breaks.stamps - 150.0) < 1.5)


def test_a_gap_in_which_the_robot_drove_on_keeps_nothing_that_others_saw_meanwhile(sound):
    kept = (sound.odometry.stamps < 140.0) | (sound.odometry.stamps > 160.0)
    done = screen(replace(sound, odometry=Odometry(sound.odometry.stamps[kept], sound.odometry.poses[kept])))
    assert kinds(done) == {"odometry-gap"}
    for stamps in (done.ranges.stamps, done.scans.stamps):
        assert not np.any((stamps > 140.5) & (stamps < 159.5))


def test_a_base_that_counts_no_way_while_it_is_unplugged_is_a_doubt_though_its_gyro_turned(sound):
    """Its pose is held, for nothing shows how far it went; the lidar sees that it went."""
    stamps, poses = sound.odometry.stamps, sound.odometry.poses.copy()
    before, after = (int(np.searchsorted(stamps, t)) for t in (140.0, 160.0))
    poses[after:, :2] += poses[before - 1, :2] - poses[after, :2]
    kept = np.r_[:before, after : len(stamps)]
    done = screen(replace(sound, odometry=Odometry(stamps[kept], poses[kept])))
    assert kinds(done, doubts=True) == {"carried"}
    np.testing.assert_allclose(done.screening.breaks.stamps, stamps[before - 1])


def test_a_clock_that_was_set_back_is_a_doubt(sound):
    done = screen(replace(sound.without(lidar=True), notes=LogNotes(set_back={"radio": 30.0, "odometry": 0.2})))
    assert [r.kind for r in told(done.screening.facts) if r.severity == "doubt"] == ["clock-set-back"]


def test_readings_that_come_in_bursts_are_spread_over_the_time_since_the_burst_before(sound):
    late = np.ceil(sound.odometry.stamps / 1.0 - 1e-9)
    done = screen(replace(sound, odometry=replace(sound.odometry, stamps=late)))
    assert kinds(done) == {"stamps-in-bursts"}
    # The first burst may be of any length; all others are 20 readings at 20 Hz.
    off = done.odometry.stamps - sound.odometry.stamps
    assert np.abs(off[40:-40] - np.median(off)).max() < 0.051
    assert np.all(np.diff(done.odometry.stamps) > 0.0)


def test_a_recording_without_stamps_is_refused_in_words_that_say_how_to_mend_it(sound):
    timeless = replace(sound, odometry=Odometry(np.zeros_like(sound.odometry.stamps), sound.odometry.poses))
    with pytest.raises(DataError, match=r"no stamps: all \d+ of the odometry are of t = 0 s; write the time of each"):
        screen(timeless)


@pytest.mark.parametrize(
    ("period", "jitter", "faster", "made_up"),
    [(1.0, 0.0, 1, True), (0.5, 0.0, 1, True), (0.1, 0.0, 1, False), (1.0, 0.01, 1, False), (1.0, 0.0, 5, False)],
)
def test_stamps_that_somebody_counted_are_named(sound, period, jitter, faster, made_up):
    """A simulation's lidar of 10 Hz is as even, and a slow lidar with a clock of its own, or with faster odometry, is not."""
    rng = np.random.default_rng(0)
    counts = len(sound.odometry.stamps), len(sound.scans.stamps)
    odometry, scans = (period * np.arange(n) + jitter * rng.random(n) for n in counts)
    log = replace(sound, odometry=Odometry(odometry / faster, sound.odometry.poses), scans=replace(sound.scans, stamps=scans))
    assert [r.kind for r in clocks.made_up(log)] == ["made-up-stamps"] * made_up


def after_half(stamps, by):
    return np.where(stamps > stamps.mean(), stamps + by, stamps)


@pytest.mark.parametrize(("sensor", "by"), [("scans", 20.0), ("ranges", 3600.0)])
def test_a_sensor_whose_clock_jumps_forward_is_set_right(sound, sensor, by):
    true = getattr(sound, sensor)
    done = screen(replace(sound, **{sensor: replace(true, stamps=after_half(true.stamps, by))}))
    assert kinds(done) == {"clock-jump"}
    assert not kinds(done, doubts=True)
    np.testing.assert_allclose(getattr(done, sensor).stamps, true.stamps, atol=0.5 if sensor == "ranges" else 0.01)


def test_where_the_clock_of_the_odometry_jumps_the_other_sensors_follow(sound):
    done = screen(replace(sound, odometry=replace(sound.odometry, stamps=after_half(sound.odometry.stamps, 3600.0))))
    assert kinds(done) == {"clock-jump"}
    middle = sound.odometry.stamps.mean()
    for sensor, true in ((done.scans, sound.scans), (done.ranges, sound.ranges)):
        late = true.stamps > middle + 0.1
        np.testing.assert_allclose(sensor.stamps[late] - true.stamps[late], 3600.0, atol=0.06)
        np.testing.assert_allclose(sensor.stamps[true.stamps < middle - 0.1], true.stamps[true.stamps < middle - 0.1])


def test_a_sensor_that_goes_silent_or_starts_late_has_no_jump(sound):
    """A lidar that fails for 20 s, and one that fails for 20 s and ends with the recording, or 30 s before it."""
    for end in (0.0, 30.0):
        stamps = sound.scans.stamps
        on = ((stamps < 130.0) | (stamps > 150.0)) & (stamps < stamps[-1] - end)
        assert clocks.without_jumps(replace(sound, scans=sound.scans.rows(on)))[1] == []


@pytest.mark.parametrize(("off", "said"), [(0.0, None), (30.0, False), (1e6, True)])
def test_readings_outside_the_time_of_the_odometry_are_counted_and_doubted_where_they_are_most(sound, off, said):
    log = replace(sound, scans=replace(sound.scans, stamps=sound.scans.stamps + off))
    left, facts = clocks.within_odometry(log)
    remarks = told(facts)
    remarks = [r for r in remarks if r.kind == "scans-outside-odometry"]
    assert [r.severity == "doubt" for r in remarks] == ([] if said is None else [said])
    outside = len(log.scans.stamps) - len(left.scans.stamps)
    assert outside == {0.0: 0, 30.0: 150 - 1, 1e6: len(log.scans.stamps)}[off]
    assert all(f"{outside} of {len(log.scans.stamps)} scans" in r.text for r in remarks)
    assert all("by about 1000000 s" in r.text for r in remarks if r.severity == "doubt")


@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_a_gap_is_a_stand_a_way_or_a_robot_that_was_carried(turned):
    """Silences of 5 s: in the first the robot stands, in the second it was put elsewhere, in the third it drives on.

    Where it was put elsewhere the gyro may have counted the turn.
    """
    path = two_rounds()
    stood, put, drives = 700, 1100, 1500
    truth = np.concatenate([path[:stood], np.tile(path[stood], (100, 1)), path[stood : put - 100], path[put + 700 :]])
    log = recording(truth)
    steps = se2.between(truth[:-1], truth[1:])
    steps[put - 1] = [0.0, 0.0, turned]
    wheels = Odometry(log.odometry.stamps, chained(truth[0], steps))
    kept = np.ones(len(truth), dtype=bool)
    for first in (stood, drives):
        kept[first + 1 : first + 100] = False

    def silent(stamps):
        return stamps + 5.0 * (stamps > log.odometry.stamps[put - 1])

    stamps = silent(wheels.stamps)
    scans, ranges = (replace(sensor, stamps=silent(sensor.stamps)) for sensor in (log.scans, log.ranges))
    odometry = Odometry(stamps[kept], wheels.poses[kept])
    done, breaks, facts = cuts.gaps(replace(log, odometry=odometry, scans=scans, ranges=ranges))
    remarks = told(facts)
    # The pose after a stand or a way counts as any other.
    np.testing.assert_allclose(breaks.stamps, stamps[put - 1 : put])
    np.testing.assert_allclose(breaks.sigma, [[20.0, 20.0, 3.0]])
    assert [(r.kind, r.severity == "doubt") for r in remarks] == [("carried", True), ("odometry-gap", False)]
    assert "silent for 5 s from t = 55 s" in remarks[0].text
    # What others saw while the robot drove on is left out, but for what is next to the odometry.
    for before, after in ((scans, done.scans), (ranges, done.ranges)):
        out = (before.stamps > stamps[drives] + 0.2) & (before.stamps < stamps[drives + 100] - 0.2)
        np.testing.assert_array_equal(after.stamps, before.stamps[~out])


@pytest.mark.parametrize(
    ("silence", "period", "gap"), [(1.95, 0.05, False), (2.05, 0.05, True), (3.9, 0.2, False), (4.1, 0.2, True)]
)
def test_a_silence_of_two_seconds_or_twenty_periods_is_a_gap(silence, period, gap):
    stamps = period * np.arange(200)
    stamps = np.where(np.arange(200) >= 100, stamps + silence - period, stamps)
    times = np.arange(0.05, stamps[-1], 0.1)
    radio = UwbRanges(times, np.zeros(len(times), dtype=int), np.ones(len(times)), np.ones(len(times)), ("A",))
    log = SensorLog(Odometry(stamps, np.column_stack([0.3 * stamps, np.zeros((200, 2))])), radio)
    done, breaks, facts = cuts.gaps(log)
    remarks = told(facts)
    assert ([r.kind for r in remarks], len(done.ranges.stamps) < len(times)) == (["odometry-gap"] * gap, gap)
    # A log without readings of others in between is thinned, and nothing is left out.
    assert not len(breaks.stamps)
    assert cuts.gaps(replace(log, ranges=None))[2] == []


def test_steps_of_lost_wheels_are_as_wide_as_the_robot_is_fast():
    """Every two seconds of each stretch; a factor of four is between the usual speed and the greatest."""
    stamps = np.arange(0.0, 60.0, 0.1)
    odometry = Odometry(stamps, np.column_stack([0.4 * stamps, np.zeros((len(stamps), 2))]))
    breaks = screening._unknown_steps(odometry, [(10.0, 15.5), (40.0, 41.0)])
    np.testing.assert_allclose(breaks.stamps, np.array([10.9, 12.9, 14.9]), atol=0.11)
    np.testing.assert_allclose(breaks.sigma, [[0.8, 0.8, 0.5]] * 3)
    assert len(screening._unknown_steps(odometry, []).stamps) == 0


@pytest.mark.parametrize(("path", "said"), [(1.99, True), (2.01, False)])
def test_a_robot_that_drives_less_than_two_metres_is_a_doubt(path, said):
    odometry = Odometry(
        100.0 + np.arange(31.0), np.column_stack([np.linspace(0.0, path, 31), np.zeros(31), np.linspace(3.0, -4.0, 31)])
    )
    found = told(screening._hardly_moving(odometry))
    assert [r.severity == "doubt" for r in found] == [True] * said
    assert all("1.99 m in 30 s (turning 7.0 rad)" in r.text for r in found)


def test_wheels_that_stand_are_asked_of_ranges_where_no_scan_sees_it():
    """The times are said since the beginning; each stretch that ranges contradict is a doubt of its own."""
    path = two_rounds()
    log = frozen(recording(np.concatenate([path[:200], np.tile(path[200], (200, 1)), path[200:]])), 126.0, 136.0)
    log = frozen(log, 150.0, 160.0)
    blind = replace(log, scans=log.scans.rows(log.scans.stamps < 124.0))
    for seen, pairs in ((blind, wheel_motion.compare(blind)), (log.without(lidar=True), None)):
        left, same, breaks, facts = screening._lost_wheels(seen, pairs)
        remarks = told(facts)
        assert (left, same) == (seen, pairs)
        assert [r.text.split("t = ")[1].split(" s")[0] for r in remarks] == ["26 to 36", "50 to 60"]
        assert all(r.severity == "doubt" and "rests on ranges alone" in r.text for r in remarks)
        assert all(np.any((breaks.stamps > a) & (breaks.stamps < b)) for a, b in ((126.0, 136.0), (150.0, 160.0)))
        assert np.all((breaks.stamps > 125.0) & (breaks.stamps < 160.0))


def test_a_log_thinned_by_motion_has_no_gap_where_the_robot_stands(sound):
    """A reading each 0.2 m or 0.25 rad, and none for a minute half-way: the wheels counted all the same."""
    odometry, kept = sound.odometry, [0]
    for k in range(1, len(odometry.stamps)):
        step = se2.between(odometry.poses[kept[-1]], odometry.poses[k])
        if np.hypot(*step[:2]) > 0.2 or abs(step[2]) > 0.25:
            kept.append(k)
    half = len(kept) // 2
    pause = 60.0 * (odometry.stamps > odometry.stamps[kept[half]])
    thinned = Odometry((odometry.stamps + pause)[kept], odometry.poses[kept])
    later = 60.0 * (sound.scans.stamps > odometry.stamps[kept[half]])
    done = screen(replace(sound, odometry=thinned, scans=replace(sound.scans, stamps=sound.scans.stamps + later), ranges=None))
    assert "odometry-gap" not in kinds(done)
