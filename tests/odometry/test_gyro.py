"""A gyro's heading in place of the wheels'."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers import planted
from helpers.told import told

from uwblite import se2
from uwblite.io.carmen import read_log, write_log
from uwblite.mapping import build_map
from uwblite.odometry.gyro import GAP, LEFT_OF_BIAS, WINDOW, _changes, _covered, heading_from_gyro, reading_of, settings
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.sensor_log import Gyro, Odometry, SensorLog

ANCHORS = np.array([[-6.0, -5.0], [6.0, -5.5], [6.5, 5.0], [-5.5, 6.0]])
BIAS = 0.01


def gyro_of(stamps, truth, rng=None, bias=BIAS, noise=0.0, rate=100.0) -> Gyro:
    """Return a gyro's readings of a true motion; noise: rad per square root of a second."""
    when = np.arange(stamps[0], stamps[-1], 1.0 / rate)
    heading = np.interp(when, stamps, np.unwrap(truth[:, 2])) + bias * (when - when[0])
    if rng is not None:
        heading = heading + noise * np.sqrt(1.0 / rate) * np.cumsum(rng.standard_normal(len(when)))
    return Gyro(when, heading - heading[0] + 1.0)


def rested(stamps, truth, seconds=6.0):
    """Return the recording with a rest before it."""
    rest = np.arange(0.0, seconds, stamps[1] - stamps[0])
    return np.concatenate([rest, stamps + seconds]), np.concatenate([np.repeat(truth[:1], len(rest), axis=0), truth])


def test_a_perfect_gyro_makes_wheels_that_turn_wrongly_perfect():
    rng = np.random.default_rng(1)
    stamps, truth = rested(*planted.wander(rng, 20.0))
    motion = se2.between(truth[:-1], truth[1:])
    wrong = 0.3 * motion[:, 2] + 0.05 * np.hypot(*motion[:, :2].T)
    stated = np.column_stack([se2.rotate(0.5 * wrong, motion[:, :2]), motion[:, 2] + wrong])
    wheels = Odometry(stamps, planted.chain(np.zeros(3), stated))
    log, remarks = heading_from_gyro(SensorLog(wheels, gyro=gyro_of(stamps, truth)))
    start = se2.compose(log.odometry.poses[0], se2.inverse(truth[0]))
    expected = se2.compose(start, truth)
    covered = stamps <= stamps[-1] - 0.01
    assert np.abs(log.odometry.poses - expected)[covered, :2].max() < 0.01  # chords of 0.1 s
    assert np.abs(se2.wrap_angle(log.odometry.poses[:, 2] - expected[:, 2]))[covered].max() < 2e-3
    assert f"{BIAS:+.5f}" in told(remarks)[0].text
    assert "rests" in told(remarks)[0].text


def test_a_false_stamp_years_away_takes_no_memory():
    """Windows all the way until then are gigabytes."""
    stamps, truth = planted.wander(np.random.default_rng(3), 60.0)
    wheels, gyro = planted.odometry(stamps, truth), gyro_of(stamps, truth)
    far = Odometry(np.append(wheels.stamps, 1e9), np.vstack([wheels.poses, wheels.poses[-1:]]))
    late = Gyro(np.append(gyro.stamps, 1e9), np.append(gyro.heading, gyro.heading[-1]))
    usual, found = _changes(gyro, wheels, WINDOW), _changes(late, far, WINDOW)
    assert len(found[0]) < len(usual[0]) + 5
    for some, all_of in zip(usual, found, strict=True):
        np.testing.assert_allclose(all_of[: len(some)], some, atol=1e-9)


def test_without_a_rest_the_bias_is_found_against_the_wheels():
    rng = np.random.default_rng(2)
    stamps, truth = planted.wander(rng, 60.0)
    log, remarks = heading_from_gyro(SensorLog(planted.odometry(stamps, truth), gyro=gyro_of(stamps, truth)))
    assert "against the wheels" in told(remarks)[0].text
    turn = se2.wrap_angle(log.odometry.poses[:, 2] - (truth[:, 2] - truth[0, 2]))
    assert np.abs(turn).max() < 0.1 * BIAS * stamps[-1]


def test_where_the_gyro_is_silent_the_wheels_turn():
    rng = np.random.default_rng(3)
    stamps, truth = rested(*planted.wander(rng, 20.0))
    gyro = gyro_of(stamps, truth, bias=0.0)
    read = (gyro.stamps < 15.0) | (gyro.stamps > 25.0)
    wheels = planted.odometry(stamps, truth)
    log, _ = heading_from_gyro(SensorLog(wheels, gyro=Gyro(gyro.stamps[read], gyro.heading[read])))
    assert np.abs(se2.wrap_angle(log.odometry.poses[:, 2] - wheels.poses[:, 2])).max() < 5e-3
    silent = Gyro(np.array([1e6, 1e6 + 1.0]), np.zeros(2))
    same, remarks = heading_from_gyro(SensorLog(wheels, gyro=silent))
    assert same.odometry is wheels
    assert "silent" in told(remarks)[0].text


def test_a_gyro_that_turns_otherwise_than_the_wheels_is_not_used():
    """It is that of another robot, or broken; and one of which nothing shows what it measures is used as it is stated."""
    stamps, truth = planted.wander(np.random.default_rng(3), 60.0)
    others = Gyro(stamps, np.sin(0.7 * stamps))
    log = SensorLog(planted.odometry(stamps, truth), gyro=others)
    same, facts = heading_from_gyro(log)
    assert same is log
    assert "turn otherwise" in told(facts)[0].text
    assert reading_of(others, planted.odometry(stamps, truth))[0] == 0.0
    straight = Odometry(stamps, np.column_stack([0.5 * stamps, np.zeros((len(stamps), 2))]))
    assert reading_of(others, straight) == (1.0, "")


def test_a_log_keeps_the_gyro(tmp_path):
    rng = np.random.default_rng(4)
    stamps, truth = planted.wander(rng, 5.0)
    log = SensorLog(planted.odometry(stamps, truth), gyro=gyro_of(stamps, truth))
    write_log(tmp_path / "run.log", log)
    again = read_log(tmp_path / "run.log")
    assert again.gyro.heading == pytest.approx(log.gyro.heading, abs=1e-6)
    assert again.gyro.stamps == pytest.approx(log.gyro.stamps, abs=1e-6)
    assert read_log(tmp_path / "run.log").crop(end=3.0).gyro.stamps.max() <= 3.0


def test_priors_and_noise_are_a_gyros_and_what_is_off_stays_off():
    config, log = MappingConfig(), SensorLog(Odometry(np.zeros(1), np.zeros((1, 3))))
    assert settings(log, config.calibration, config.odometry) == (config.calibration, config.odometry)
    log = replace(log, gyro=Gyro(np.zeros(1), np.zeros(1)))
    calibration, noise = settings(log, config.calibration, config.odometry)
    given = replace(calibration, heading_rate=LEFT_OF_BIAS, heading_scale=0.02, heading_per_metre=0.001)
    assert calibration == given
    assert noise == replace(config.odometry, heading_per_turn=0.005, heading_per_metre=0.001)
    tight = replace(config.calibration, heading_scale=0.01, heading_per_metre=0.0)
    kept = settings(log, tight, config.odometry)[0]
    assert (kept.heading_scale, kept.heading_per_metre) == (0.01, 0.0)
    assert settings(log, replace(config.calibration, heading_rate=0.0), config.odometry)[0].heading_rate == 0.0


@pytest.mark.slow
def test_the_map_of_slipping_wheels_is_better_with_a_gyro():
    rng = np.random.default_rng(5)
    stamps, truth = rested(*planted.wander(rng, 100.0))
    wheels = planted.odometry(stamps, truth, rng, turn_scale=1.1, noise=0.01, turn_noise=0.1)
    ranges = planted.ranges(rng, stamps, truth, ANCHORS, sigma=0.05)
    gyro = gyro_of(stamps, truth, rng, noise=0.0005)
    errors = []
    for recording in (SensorLog(wheels, ranges), SensorLog(wheels, ranges, gyro=gyro)):
        result = build_map(recording, MappingConfig())
        turn = se2.wrap_angle(result.trajectory[:, 2] - truth[:, 2])
        errors.append(np.degrees(np.sqrt(np.mean(se2.wrap_angle(turn - np.median(turn)) ** 2))))
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_covered_where_the_gyro_was_read_throughout(seed):
    """By a loop: readings from before its begin to behind its end, none of them further apart than a gap."""
    rng = np.random.default_rng(seed)
    read = np.cumsum(rng.choice([0.05, GAP, 1.5 * GAP], 40, p=[0.6, 0.3, 0.1]))
    stamps = np.sort(np.append(rng.uniform(0.0, read[-1] + 0.3, 60), read[[0, 3, 17, -1]]))
    expected = []
    for begin, end in pairwise(stamps):
        before, behind = read[read <= begin], read[read >= end]
        inside = read[(read >= before.max(initial=-np.inf)) & (read <= behind.min(initial=np.inf))]
        expected.append(len(before) and len(behind) and np.diff(inside).max(initial=0.0) <= GAP)
    covered = _covered(Gyro(read, np.zeros(40)), stamps)
    np.testing.assert_array_equal(covered, np.array(expected, dtype=bool))
    assert 5 < covered.sum() < 58


def test_changes_are_those_between_the_ends_of_windows_that_overlap_by_half():
    """Of a robot that drives an arc through x and y: chords, not turns, and headings unwrapped."""
    stamps = np.arange(0.0, 20.0, 0.1)
    theta = 0.3 * stamps
    arc = np.column_stack([2.0 * np.sin(theta), 2.0 - 2.0 * np.cos(theta), se2.wrap_angle(theta)])
    gyro = Gyro(stamps, -0.1 * stamps)
    turned, by_wheels, way = _changes(gyro, Odometry(stamps, arc), 4.0)
    assert len(way) == 8
    np.testing.assert_allclose(turned, -0.4)
    np.testing.assert_allclose(by_wheels, 1.2)
    np.testing.assert_allclose(way, 4.0 * np.sin(0.6), rtol=1e-3)


@pytest.mark.parametrize(("seconds", "read"), [(2.4, False), (2.6, True)])
def test_four_windows_show_what_a_gyro_reads(seconds, read):
    """One that counts the other way round; three windows are too few to say so."""
    stamps = np.arange(0.0, WINDOW + 0.5 * WINDOW * 3.0 + seconds - 2.5, 0.01)
    heading = np.where(stamps < 6.0, 0.2 * stamps, 1.2 - 0.3 * (stamps - 6.0))
    wheels = Odometry(stamps, np.column_stack([stamps, np.zeros(len(stamps)), heading]))
    assert (reading_of(Gyro(stamps, -heading), wheels)[0] == -1.0) is read


@pytest.mark.parametrize(("gyro_turns", "wheel_turns"), [(0.0, 1.0), (1.0, 0.0), (1e-3, 1.0), (1.0, 1e-3)])
def test_a_gyro_beside_which_nothing_turns_is_taken_as_it_is(gyro_turns, wheel_turns):
    """However the two correlate: what neither has turned shows no sign and no unit."""
    stamps = np.arange(0.0, 120.0, 0.05)
    heading = 2.0 * np.sin(0.3 * stamps)
    wheels = Odometry(stamps, np.column_stack([stamps, np.zeros(len(stamps)), wheel_turns * heading]))
    assert reading_of(Gyro(stamps, -gyro_turns * heading), wheels) == (1.0, "")
    short = Odometry(stamps[:50], wheels.poses[:50])
    assert reading_of(Gyro(stamps[:50], -heading[:50]), short) == (1.0, "")


@pytest.mark.parametrize(
    ("factor", "read"), [(1.0, 1.0), (-1.0, -1.0), (180.0 / np.pi, np.pi / 180.0), (1.4, 1.0), (-180.0 / np.pi, -np.pi / 180.0)]
)
def test_a_gyro_is_read_in_the_unit_and_with_the_sign_that_the_wheels_have(factor, read):
    stamps = np.arange(0.0, 120.0, 0.05)
    heading = 2.0 * np.sin(0.3 * stamps)
    wheels = Odometry(stamps, np.column_stack([stamps, np.zeros(len(stamps)), heading]))
    assert reading_of(Gyro(stamps, factor * heading + 0.01 * stamps), wheels)[0] == pytest.approx(read)
