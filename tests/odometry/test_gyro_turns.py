"""The gyro's turns as they come in: against the wheels' own, and against what is made of the whole recording."""

import numpy as np
import pytest
from helpers import planted
from helpers.localization_room import ANCHORS, ODD, known

from uwblite import se2
from uwblite.localization import Localizer
from uwblite.odometry.gyro import GyroTurns

BIAS = 0.01


def drive(seed=1, seconds=90.0, rest=8.0):
    """Return stamps, true poses and those of wheels that turn 30 % too far and pull to one side; a rest comes first."""
    stamps, truth = planted.wander(np.random.default_rng(seed), seconds)
    still = np.arange(0.0, rest, stamps[1] - stamps[0])
    stamps = np.concatenate([still, stamps - stamps[0] + rest])
    truth = np.concatenate([np.repeat(truth[:1], len(still), axis=0), truth])
    motion = se2.between(truth[:-1], truth[1:])
    wrong = 0.3 * motion[:, 2] + 0.05 * np.hypot(*motion[:, :2].T)
    stated = np.column_stack([se2.rotate(0.5 * wrong, motion[:, :2]), motion[:, 2] + wrong])
    return stamps, truth, planted.chain(np.array([3.0, -1.0, 0.7]), stated)


def along(stamps, truth, wheels, factor=1.0, silent=(np.inf, np.inf), again=np.inf):
    """Return the corrected poses (n, 3) where a gyro is read a hundred times a second, up to 10 ms late."""
    turns, poses = GyroTurns(), []
    when = np.arange(stamps[0], stamps[-1], 0.01)
    heading = factor * (np.interp(when, stamps, np.unwrap(truth[:, 2])) + BIAS * when) + 4.0
    heading -= np.where(when > again, heading[-1], 0.0)
    spoken = (when < silent[0]) | (when > silent[1])
    k = 0
    for stamp, pose in zip(stamps, wheels, strict=True):
        while k < len(when) and when[k] < stamp - 0.01:
            if spoken[k]:
                turns.add(when[k], heading[k])
            k += 1
        poses.append(turns.turned(stamp, pose))
    return np.array(poses)


def drift(found, truth, begin):
    """Return by how much headings differ from the truth's, from a row on, rad."""
    return np.abs(se2.wrap_angle((found[:, 2] - truth[:, 2]) - (found[begin, 2] - truth[begin, 2])))[begin:].max()


@pytest.mark.parametrize("factor", [1.0, -1.0, 180.0 / np.pi])
def test_wheels_that_turn_wrongly_follow_the_gyro_once_it_is_known(factor):
    stamps, truth, wheels = drive()
    found, learned = along(stamps, truth, wheels, factor), int(np.searchsorted(stamps, 30.0))
    assert drift(wheels, truth, learned) > 0.5
    # A tenth of the bias is left, and an extrapolation of 10 ms.
    assert drift(found, truth, learned) < 0.1 * BIAS * (stamps[-1] - 30.0) + 0.02
    lengths = [np.hypot(*se2.between(poses[:-1], poses[1:])[:, :2].T) for poses in (found, wheels)]
    assert lengths[0] == pytest.approx(lengths[1], abs=1e-9)


def test_where_the_gyro_is_silent_or_begins_again_the_wheels_turn():
    stamps, truth, wheels = drive()
    steps = [se2.between(p[:-1], p[1:])[:, 2] for p in (along(stamps, truth, wheels, silent=(50.0, 60.0)), wheels)]
    inside = (stamps[:-1] > 50.5) & (stamps[1:] < 59.5)
    assert steps[0][inside] == pytest.approx(steps[1][inside], abs=1e-9)
    leap = along(stamps, truth, wheels, again=55.0)
    assert np.abs(se2.between(leap[:-1], leap[1:])[:, 2]).max() < 5.0 * np.diff(stamps).max()


def test_without_a_gyro_poses_are_what_they_were():
    stamps, _, wheels = drive(seconds=20.0)
    turns = GyroTurns()
    np.testing.assert_array_equal([turns.turned(t, pose) for t, pose in zip(stamps, wheels, strict=True)], wheels)
    # One that comes late is handed on as it is.
    np.testing.assert_array_equal(turns.turned(0.0, wheels[0]), wheels[0])


def test_a_single_reading_turns_nothing():
    stamps, _, wheels = drive(seconds=20.0)
    turns = GyroTurns()
    turns.add(stamps[0], 1.0)
    found = [turns.turned(t, pose) for t, pose in zip(stamps, wheels, strict=True)]
    np.testing.assert_allclose(found, wheels, atol=1e-9)


def test_readings_of_two_minutes_are_kept_where_no_wheels_come():
    turns = GyroTurns()
    for stamp in np.arange(0.0, 600.0, 0.5):
        turns.add(stamp, 0.1 * stamp)
        assert len(turns._stamps) == len(turns._headings) <= 242


def test_the_stated_odometry_remains_that_of_the_wheels():
    """Whoever ties the map to the odometry's frame knows the wheels' poses only."""
    localizer = Localizer(known(ODD, ANCHORS))
    stamps, truth, wheels = drive(seconds=40.0)
    for k, (stamp, pose) in enumerate(zip(stamps, wheels, strict=True)):
        localizer.add_gyro(stamp, float(np.unwrap(truth[: k + 1, 2])[-1]) if k else float(truth[0, 2]))
        state = localizer.add_odometry(stamp, *pose)
        np.testing.assert_array_equal(state.odometry, pose)


@pytest.mark.parametrize("begin", [0.0, 2.0**20])
def test_until_a_gyro_has_been_compared_for_15_s_the_wheels_turn(begin):
    """At any time of day."""
    stamps, truth, wheels = drive(seconds=30.0)
    early = stamps - stamps[0] < 14.0
    np.testing.assert_allclose(along(stamps + begin, truth, wheels, 2.0)[early], wheels[early], atol=1e-9)


def test_readings_that_come_late_twice_or_are_no_numbers_change_nothing():
    stamps, truth, wheels = drive(seconds=40.0)
    odd = [(-1.0, 9.0), (0.0, 9.0), (np.nan, 1.0), (0.01, np.nan), (np.inf, 1.0)]
    sound, among = GyroTurns(), GyroTurns()
    for stamp, pose, heading in zip(stamps, wheels, np.unwrap(truth[:, 2]), strict=True):
        for turns, others in ((sound, []), (among, odd)):
            turns.add(stamp, heading)
            for later, value in others:
                turns.add(stamp + later, value)
        np.testing.assert_array_equal(sound.turned(stamp, pose), among.turned(stamp, pose))
    assert len(sound._stamps) == len(among._stamps) > 100
