"""The simulator: rays against geometry by hand, noise against its stated size, wheels, radio, determinism, the log."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import oracle
import pytest
from simulate import parser, settings_from
from simulation import drive, floorplans, laser, logfile, radio, recording, wheels
from simulation.fields import smooth_field
from simulation.plans import PLANS
from simulation.real_rooms import RealRooms, floor_errors, own_body, range_errors, stops
from simulation.recording import FalseRanges, Settings, simulate
from trials import as_read

from uwblite import se2
from uwblite.io.carmen import read_log

SHORT = Settings(world="room", seed=3, minutes=0.5, scan_rate=2.0, uwb_rate=2.0)
EXACT_WHEELS = wheels.WheelErrors(1.0, 1.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def room() -> recording.Recording:
    return simulate(replace(SHORT, minutes=2.0))


def brute_force(origin, angle, walls, columns):
    """March along one ray in steps of 1 mm until a wall is crossed or a column entered."""
    s = np.arange(0.0, 6.0, 1e-3)
    points = origin + s[:, None] * np.array([np.cos(angle), np.sin(angle)])
    hits = [np.inf]
    for x1, y1, x2, y2 in walls:
        side = (x2 - x1) * (points[:, 1] - y1) - (y2 - y1) * (points[:, 0] - x1)
        along = ((points - (x1, y1)) @ (x2 - x1, y2 - y1)) / ((x2 - x1) ** 2 + (y2 - y1) ** 2)
        crossed = (np.sign(side[1:]) != np.sign(side[:-1])) & (along[1:] >= 0) & (along[1:] <= 1)
        hits += [s[1:][crossed][0]] if crossed.any() else []
    for x, y, radius in columns:
        inside = np.hypot(*(points - (x, y)).T) < radius
        hits += [s[inside][0]] if inside.any() else []
    return min(hits)


def test_rays_agree_with_marching():
    rng = np.random.default_rng(1)
    plan = floorplans.lab()
    origins = rng.uniform((5.0, 9.0), (8.0, 11.0), (30, 2))
    angles = rng.uniform(-np.pi, np.pi, 30)
    distance, cosine, surface = laser.cast(origins, angles, plan.walls, plan.columns, 5.6)
    expected = np.array([brute_force(o, a, plan.walls, plan.columns) for o, a in zip(origins, angles, strict=True)])
    seen = expected < 5.6
    np.testing.assert_allclose(distance[seen], expected[seen], atol=2e-3)
    assert np.all(np.isinf(distance[expected > 5.601]))
    assert np.all((surface >= 0) == np.isfinite(distance))
    assert np.all((cosine >= 0) & (cosine <= 1 + 1e-12))


def test_walls_left_out_as_far_away_are_never_hit():
    rng = np.random.default_rng(2)
    plan = floorplans.lab()
    for centre in rng.uniform((1, 1), (14, 19), (20, 2)):
        walls, columns = laser.near(plan.walls, plan.columns, centre, 5.6)
        angles = np.linspace(-np.pi, np.pi, 400)
        origins = np.broadcast_to(centre, (400, 2))
        some = laser.cast(origins, angles, plan.walls[walls], plan.columns[columns], 5.6)[0]
        every = laser.cast(origins, angles, plan.walls, plan.columns, 5.6)[0]
        np.testing.assert_array_equal(some, every)


def test_incidence_of_a_slanting_wall():
    _, cosine, _ = laser.cast(np.zeros((1, 2)), np.zeros(1), np.array([[1.0, -1.0, 3.0, 1.0]]), np.empty((0, 3)), 9.0)
    assert cosine[0] == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize(("distance", "sd"), [(0.5, 0.010), (3.0, 0.030)])
def test_laser_noise_has_the_stated_size(distance, sd):
    model, n = laser.LaserModel(), 20_000
    true = np.full((n // 100, 100), distance)
    surface, rng = np.zeros(true.shape, int), np.random.default_rng(3)
    output, _ = laser.disturb(true, np.ones_like(true), surface, model, np.zeros(1), rng)
    good = output[(output >= 20) & (output < 5600)] / 1000.0
    assert np.std(good) == pytest.approx(sd, rel=4.0 / np.sqrt(2 * n))
    assert np.mean(good) == pytest.approx(distance, abs=4.0 * sd / np.sqrt(n))
    assert 1.0 - len(good) / n == pytest.approx(model.blind, abs=4.0 * np.sqrt(model.blind / n) + 1e-3)


def test_lost_rays_are_codes_or_the_maximum():
    model = laser.LaserModel()
    nothing = np.full((50, 200), np.inf)
    unseen, rng = np.full(nothing.shape, -1), np.random.default_rng(4)
    output, _ = laser.disturb(nothing, np.ones_like(nothing), unseen, model, np.zeros(1), rng)
    assert np.all((output < 20) | (output == 5600))
    assert np.mean(output < 20) == pytest.approx(model.error_codes, abs=4 * np.sqrt(0.09 / output.size))


def test_oblique_walls_answer_less():
    model, n = laser.LaserModel(), 4000
    true = np.full((1, n), 4.0)
    shares = []
    for degrees in (0.0, 70.0, 85.0):
        cosine = np.full((1, n), np.cos(np.deg2rad(degrees)))
        output, _ = laser.disturb(true, cosine, np.zeros((1, n), int), model, np.zeros(1), np.random.default_rng(5))
        shares.append(np.mean((output >= 20) & (output < 5600)))
    assert shares[0] > 0.97 > 0.8 > shares[2]
    assert shares[0] >= shares[1] > shares[2]


def test_a_weak_lidar_loses_returns_by_distance_and_paint():
    model, n = laser.LaserModel(weak=0.2, blind=0.0), 20_000
    for distance in (1.4, 5.0):
        true, shares = np.full((1, n), distance), []
        for painted in (False, True):
            surface, dark = np.full((1, n), int(painted)), np.array([False, True])
            output, _ = laser.disturb(true, np.ones((1, n)), surface, model, np.zeros(2), np.random.default_rng(6), dark)
            shares.append(np.mean((output < 20) | (output == 5600)))
        expected = 0.2 * np.square(distance / model.max_range) * np.array([1.0, 4.0])
        np.testing.assert_allclose(shares, expected, atol=0.02)


def test_odometry_without_faults_is_the_motion(room):
    motion = drive.Motion(room.stamps, room.truth)
    output = wheels.odometry(motion, room.stamps, EXACT_WHEELS, [], np.random.default_rng(0))
    np.testing.assert_allclose(se2.compose(room.truth[0], output)[:, :2], room.truth[:, :2], atol=2e-3)
    np.testing.assert_allclose(output[:, 2], room.truth[:, 2] - room.truth[0, 2], atol=1e-9)


def test_odometry_noise_grows_with_the_root_of_the_way():
    straight = drive.Motion(np.arange(0.0, 100.05, 0.05), np.arange(2001)[:, None] * [0.01, 0.0, 0.0])
    noisy = replace(EXACT_WHEELS, distance_noise=0.02, heading_noise_travel=0.01)
    ends = np.array(
        [wheels.odometry(straight, straight.stamps, noisy, [], np.random.default_rng(k))[-1, 2] for k in range(200)]
    )
    assert np.std(ends) == pytest.approx(0.01 * np.sqrt(20.0), rel=4.0 / np.sqrt(400))


def test_slips_are_in_the_odometry_and_nowhere_else(room):
    motion = drive.Motion(room.stamps, room.truth)
    slip = {"start": 30.0, "seconds": 1.0, "heading": 0.4, "distance": 0.2}
    clean, slipped = (
        wheels.odometry(motion, room.stamps, EXACT_WHEELS, slips, np.random.default_rng(0)) for slips in ([], [slip])
    )
    gone = slipped[:, 2] - clean[:, 2]
    assert np.all(gone[room.stamps < 29.9] == 0.0)
    np.testing.assert_allclose(gone[room.stamps > 31.1], 0.4, atol=1e-12)


def test_motion_is_what_a_differential_drive_can_do(room):
    step, turn = np.diff(room.truth[:, :2], axis=0), np.diff(room.truth[:, 2])
    heading = room.truth[:-1, 2] + 0.5 * turn
    sideways = -step[:, 0] * np.sin(heading) + step[:, 1] * np.cos(heading)
    assert np.abs(sideways).max() < 2e-4
    assert np.hypot(*step.T).max() <= 0.2 / 20 + 1e-9
    assert np.abs(np.diff(turn)).max() < 2.5 / 20**2


LARGE = {"arena", "site", "site_next_day"}
"""Worlds whose recordings take seconds to make."""


def marked(worlds):
    """Return the worlds, the large ones as slow."""
    return [pytest.param(world, marks=pytest.mark.slow) if world in LARGE else world for world in worlds]


@pytest.mark.parametrize("world", marked(world for world in PLANS if world != "site_next_day"))
def test_paths_keep_clear_of_everything(world):
    plan = PLANS[world]()
    motion = drive.follow(drive.wander(plan, np.random.default_rng(7), 30.0), plan.start[2], 0.2, 150.0)
    for x, y, _ in motion.poses[::20]:
        walls, columns = laser.near(plan.walls, plan.columns, np.array([x, y]), 0.25)
        assert not len(walls)
        assert not len(columns)
    assert len(plan.anchors) <= len(set(plan.anchor_ids))
    assert all(name in plan.landmarks for pair in plan.pairs for name in pair)


def test_random_field_has_unit_variance_and_its_length():
    rng = np.random.default_rng(8)
    at = np.array([[0.0, 0.0], [0.2, 0.0], [1.5, 0.0], [9.0, 0.0]])
    values = np.array([smooth_field(rng, at, 1.5) for _ in range(4000)])
    correlation = np.corrcoef(values.T)[0]
    assert values.std() == pytest.approx(1.0, abs=0.05)
    # Spectrum N(0, 1/length^2) means a Gaussian correlation exp(-d^2 / 2 length^2).
    np.testing.assert_allclose(correlation, np.exp(-(at[:, 0] ** 2) / (2 * 1.5**2)), atol=0.07)


def test_clean_ranges_are_distances_plus_bias():
    clean = radio.RadioModel(noise_sd=0.0, multipath_sd=0.0, antenna_sd=0.0, loss=0.0)
    made = simulate(replace(SHORT, radio=clean, nlos="off", anchor_height=2.0, tag_height=0.3, without=("laser",)))
    bias = np.array(list(made.calibration["uwb"]["bias"].values()))
    pose = drive.Motion(made.stamps, made.truth).at(made.range_stamps)
    tag = se2.transform(pose, np.array([-0.05, 0.0]))
    flat = np.hypot(*(made.anchors[made.range_anchors] - tag).T)
    np.testing.assert_allclose(made.ranges, np.hypot(flat, 1.7) + bias[made.range_anchors], atol=1.5e-3)


def test_range_errors_have_the_stated_size_and_are_correlated():
    made = simulate(replace(SHORT, world="hall", minutes=31.0, uwb_rate=2.0, nlos="off", without=("laser",)))
    pose = drive.Motion(made.stamps, made.truth).at(made.range_stamps)
    tag = se2.transform(pose, np.array([-0.05, 0.0]))
    error = made.ranges - np.hypot(*(made.anchors[made.range_anchors] - tag).T)
    bias = np.array(list(made.calibration["uwb"]["bias"].values()))
    error -= bias[made.range_anchors]
    model = made.settings.radio
    # The smooth parts have some fifty independent patches on this floor: their sd is known to about 20 %.
    expected = np.hypot(model.noise_sd, np.hypot(model.multipath_sd, model.antenna_sd))
    assert np.std(error) == pytest.approx(expected, rel=0.25)
    one = error[made.range_anchors == 0]
    assert np.std(np.diff(one)) / np.sqrt(2) == pytest.approx(model.noise_sd, rel=0.25)


def test_occlusion_only_lengthens():
    column = np.array([[5.0, 0.0, 0.4]])
    tags = np.array([[0.0, 0.0], [0.0, 3.0], [5.0, 0.5]])
    count = radio.crossings(tags, np.array([10.0, 0.0]), np.empty((0, 4)), column)
    np.testing.assert_array_equal(count, [1, 0, 0])
    boxed = radio.crossings(tags, np.array([10.0, 0.0]), np.array(floorplans.box(4.0, -1.0, 2.0, 1.2)), np.empty((0, 3)))
    np.testing.assert_array_equal(boxed, [1, 0, 0])
    points = np.random.default_rng(9).uniform(0, 20, (4000, 2))
    extra, lost = radio.excess(np.ones(4000), points, "heavy", np.random.default_rng(9))
    assert extra.min() >= 0.0
    assert np.mean(extra) == pytest.approx(0.8 * 1.0, rel=0.15)
    assert np.mean(lost) == pytest.approx(0.4, abs=0.05)
    assert not radio.excess(np.zeros(4000), points, "normal", np.random.default_rng(9))[0].any()


def test_false_ranges_last_for_their_stretch_only():
    consistent = simulate(replace(SHORT, without=("laser",)))
    lying = simulate(replace(SHORT, without=("laser",), false_ranges=(FalseRanges(2, 5.0, 10.0, 3.0),)))
    wrong = lying.ranges - consistent.ranges
    during = (consistent.range_anchors == 1) & (consistent.range_stamps >= 5.0) & (consistent.range_stamps < 15.0)
    np.testing.assert_allclose(wrong[during], 3.0)
    assert during.any()
    assert not wrong[~during].any()


def test_same_seed_same_bytes_and_parts_do_not_disturb_each_other(room):
    one, same, other, heavy = map(simulate, (SHORT, SHORT, replace(SHORT, seed=4), replace(SHORT, nlos="heavy")))
    assert b"".join(logfile.log_lines(one)) == b"".join(logfile.log_lines(same))
    assert not np.allclose(other.truth[-1], one.truth[-1])
    np.testing.assert_array_equal(heavy.truth, one.truth)
    np.testing.assert_array_equal(heavy.scans, one.scans)


def test_every_ray_is_cast_at_its_own_time():
    """A room seen by a turning robot: rays placed by the pose at their own time lie on the walls."""
    quiet = laser.LaserModel(near_sd=0.0, far_sd=0.0, surface_sd=0.0, blind=0.0, mixed=0.0, error_codes=0.0)
    made = simulate(replace(SHORT, laser=quiet, laser_error=(0.02, 0.01, 0.05), laser_delay=0.3, without=("uwb",)))
    mounting = np.add(made.settings.laser_pose, made.settings.laser_error)
    times = made.scan_stamps[:, None] - 0.3 + quiet.time_increment * np.arange(quiet.beams)
    pose = se2.compose(drive.Motion(made.stamps, made.truth).at(times), mounting)
    r = made.scans / 1000.0
    points = se2.transform(pose, np.stack([r * np.cos(quiet.angles), r * np.sin(quiet.angles)], axis=-1))
    points = points[(r >= 0.02) & (r < 5.6)]
    walls, columns = made.plan.walls, made.plan.columns
    gaps = [np.abs(np.hypot(*(points - c[:2]).T) - c[2]) for c in columns]
    for x1, y1, x2, y2 in walls:
        a, e = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        u = np.clip(((points - a) @ e) / (e @ e), 0, 1)
        gaps.append(np.hypot(*(points - a - u[:, None] * e).T))
    assert np.min(gaps, axis=0).max() < 2e-3


def test_a_flipped_laser_sees_the_mirror_image():
    upright, flipped = (simulate(replace(SHORT, seed=5, minutes=0.1, laser_flipped=f, without=("uwb",))) for f in (False, True))
    near = np.abs(upright.scans[:3] - flipped.scans[:3, ::-1]) < 150
    assert near.mean() > 0.9


def test_people_are_seen_and_leave():
    empty, crowded = (simulate(replace(SHORT, people=n, without=("uwb",))) for n in (0, 3))
    closer = crowded.scans < empty.scans - 300
    assert 0.001 < closer.mean() < 0.3


def test_log_is_read_back(tmp_path, room):
    logfile.write(room, tmp_path, compress=True)
    log = read_log(tmp_path / "run.log.gz")
    assert log.notes.broken == 0
    np.testing.assert_allclose(log.odometry.stamps, room.stamps)
    np.testing.assert_allclose(log.odometry.poses[:, :2], room.odometry[:, :2], atol=1e-6)
    assert log.scans is not None
    np.testing.assert_allclose(log.scans.stamps, room.scan_stamps)
    assert log.scans.angle_min == pytest.approx(room.settings.laser.angles[0])
    assert log.scans.angle_increment == pytest.approx(room.settings.laser.increment)
    hit = (room.scans >= 20) & (room.scans < 5600)
    np.testing.assert_array_equal(np.isfinite(log.scans.ranges), hit)
    np.testing.assert_allclose(log.scans.ranges[hit], room.scans[hit] / 1000.0, atol=1e-6)
    assert log.ranges is not None
    output = np.array(floorplans.ANCHOR_IDS)[room.range_anchors]
    np.testing.assert_array_equal(np.array(log.ranges.anchor_ids)[log.ranges.anchor], output)
    np.testing.assert_allclose(log.ranges.ranges, room.ranges)
    np.testing.assert_allclose(log.mounting.T_base_laser, room.settings.laser_pose, atol=2e-6)


def test_command_line_reaches_every_setting():
    words = (
        "hall --out x --seed 4 --minutes 2 --nlos heavy --nlos-anchors 3,4 --false-range 1:10:60:2.5 --range-bias-sd 1.5"
        " --range-scale 1.07"
        " --anchor-height 2 --tag-height 0.3 --laser-error 0.02,0,0.1 --laser-flipped --without uwb --people 2 --slips 3"
    )
    settings = settings_from(parser().parse_args(words.split()))
    assert settings.nlos_anchors == (3, 4)
    assert settings.false_ranges == (FalseRanges(1, 10.0, 60.0, 2.5),)
    assert (settings.radio.bias_sd, settings.radio.scale, settings.radio.noise_sd) == (1.5, 1.07, 0.03)
    assert settings.without == ("uwb",)
    assert (settings.slips, settings.people, settings.minutes, settings.laser_flipped) == (3, 2, 2.0, True)
    assert settings.speed == Settings().speed


def test_a_building_and_a_robot_stay_what_they_are():
    first, again, elsewhere = (
        simulate(replace(SHORT, world="hall", seed=s, robot=1, building=b, without=("laser",)))
        for s, b in ((1, 2), (3, 2), (3, 4))
    )
    assert first.calibration["odometry"] == again.calibration["odometry"] == elsewhere.calibration["odometry"]
    assert first.calibration["uwb"]["bias"] == again.calibration["uwb"]["bias"] != elsewhere.calibration["uwb"]["bias"]
    assert not np.allclose(first.truth, again.truth)


def test_overnight_one_anchor_of_the_site_moved_and_one_is_new():
    before, after = PLANS["site"](), PLANS["site_next_day"]()
    shift = np.hypot(*(after.anchors - before.anchors).T)
    renamed = [a != b for a, b in zip(before.anchor_ids, after.anchor_ids, strict=True)]
    assert np.count_nonzero(shift) == np.count_nonzero(renamed) == 1
    assert shift.max() > 2.0
    np.testing.assert_array_equal(before.walls, after.walls)


@pytest.mark.parametrize("world", marked(["arena", "tunnel", "site"]))
def test_few_anchors_are_in_reach_at_a_time_in_large_places(world):
    made = simulate(Settings(world=world, seed=1, minutes=10.0, speed=0.5, without=("laser",)))
    in_reach = [np.unique(made.range_anchors[np.abs(made.range_stamps - t) < 10.0]).size for t in range(10, 590, 20)]
    assert 3.0 <= np.mean(in_reach) <= 5.0


@pytest.mark.slow
def test_the_oracle_is_near_the_truth_and_its_bound_reports_how_near():
    """Errors agree with the Cramer-Rao bound, with lidar and without, and the lidar helps."""
    made = simulate(Settings(world="room", seed=1, minutes=3.0, scan_rate=2.0, uwb_rate=2.0))
    log = as_read(made).log
    without, with_lidar = (oracle.solve(made, log, lidar=lidar) for lidar in (False, True))
    assert with_lidar.ate < without.ate
    # One recording has a handful of independent patches of multipath: a factor of two either way.
    assert 0.4 * without.bound_ate < without.ate < 2.0 * without.bound_ate
    assert 0.3 * without.bound_anchors < without.anchors < 2.0 * without.bound_anchors
    assert with_lidar.bound_ate < 0.5 * without.bound_ate


@pytest.mark.slow
def test_the_oracle_knows_the_errors_of_real_rooms():
    made = simulate(Settings(world="hall", seed=6, minutes=3.0, scan_rate=2.0, uwb_rate=2.0, rooms=RealRooms()))
    log = as_read(made).log
    found, in_pieces = (oracle.solve(made, log, pieces=pieces) for pieces in (False, True))
    assert found.ate < 2.0 * found.bound_ate
    assert found.anchors < 2.0 * found.bound_anchors
    assert in_pieces.bound_ate > found.bound_ate
    assert in_pieces.ate < 2.0 * in_pieces.bound_ate, "noise of oblique rays turns scans against pieces of wall"


def test_real_rooms_change_every_sensor_and_nothing_changes_without_them(room):
    easy = replace(SHORT, minutes=2.0)
    np.testing.assert_array_equal(simulate(easy).odometry, room.odometry)
    real = simulate(replace(easy, rooms=RealRooms(stop_every=20.0)))
    again = simulate(replace(easy, rooms=RealRooms(stop_every=20.0)))
    for name in ("odometry", "truth", "scans", "ranges"):
        np.testing.assert_array_equal(getattr(real, name), getattr(again, name))
    assert not np.array_equal(real.truth, room.truth)


def test_errors_of_real_rooms_have_their_stated_sizes():
    rooms, rng = RealRooms(), np.random.default_rng(1)
    places = rng.uniform(0.0, 400.0, (20000, 2))
    own = range_errors(rooms, np.random.default_rng(5), places)
    # 48 waves to a field: its variance is known to about a fifth.
    assert own.std() == pytest.approx(np.sqrt(sum(sd**2 for sd, _ in rooms.range_fields)), rel=0.25)
    np.testing.assert_array_equal(own, range_errors(rooms, np.random.default_rng(5), places))
    behind = np.linspace(-np.pi, np.pi, 20001)
    late, lost = own_body(rooms, behind, rng)
    shadowed = np.abs(behind) < rooms.body_half_angle
    assert np.all(late[~shadowed] < 1e-9)
    assert not lost[~shadowed].any()
    assert late[shadowed].mean() == pytest.approx(rooms.body_excess, rel=0.1)
    way = np.full(20000, 0.01)
    _, turn = floor_errors(replace(rooms, patch_turn=0.0), places, way, rng, rng)
    bumps = way.sum() / rooms.bump_every
    assert np.sum(turn != 0.0) == pytest.approx(bumps, abs=4.0 * np.sqrt(bumps))
    halts = stops(rooms, 600.0, rng)
    assert all(b[0] > a[0] + a[1] for a, b in pairwise(halts))
