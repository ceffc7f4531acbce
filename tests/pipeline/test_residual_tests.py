"""What noise cannot explain is a doubt; a sound recording has none."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite.mapping import build_map


@pytest.fixture(scope="module")
def sound():
    return recording(two_rounds())


def doubts(log):
    return {n.kind for n in build_map(log).doubts}


@pytest.mark.parametrize("without", [{}, {"uwb": True}, {"lidar": True}])
def test_a_sound_recording_has_no_doubts(sound, without):
    assert doubts(sound.without(**without)) == set()


@pytest.mark.parametrize("lidar", [False, True])
def test_ranges_that_are_no_distances(sound, lidar):
    wild = np.random.default_rng(1).uniform(0.5, 15.0, len(sound.ranges.stamps))
    result = build_map(replace(sound, ranges=replace(sound.ranges, ranges=wild)).without(lidar=not lidar))
    assert "range-scatter" in {n.kind for n in result.doubts}
    assert all(a.status != "ok" for a in result.anchors)


def test_a_radio_whose_clock_is_seconds_late(sound):
    late = replace(sound.ranges, stamps=sound.ranges.stamps + 6.0)
    assert "range-scatter" in doubts(replace(sound, ranges=late))


def test_a_lidar_of_another_scale_contradicts_wheels_and_radio(sound):
    scans = replace(sound.scans, ranges=sound.scans.ranges * np.float32(1.25), range_max=7.0)
    assert "scales" in doubts(replace(sound, scans=scans))
    assert "scales" in doubts(replace(sound, scans=scans).without(uwb=True))


def test_odometry_alone_drifts(sound):
    assert doubts(sound.without(uwb=True, lidar=True)) == {"odometry-alone"}
