"""Halves of a recording that need different wheels are a doubt; a sound recording has none."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.mapping import build_map
from uwblite.se2 import chain as chained
from uwblite.sensor_log import Odometry


@pytest.fixture(scope="module")
def sound():
    return recording(two_rounds()).without(lidar=True)


def doubts(log):
    return {n.kind for n in build_map(log).doubts}


def test_a_heading_that_drifts_from_half_way_on(sound):
    poses = sound.odometry.poses
    steps = se2.between(poses[:-1], poses[1:])
    steps[len(steps) // 2 :, 2] += 0.15 * np.hypot(*steps[len(steps) // 2 :, :2].T)
    assert "halves-disagree" in doubts(replace(sound, odometry=Odometry(sound.odometry.stamps, chained(poses[0], steps))))


def test_a_heading_that_drifts_throughout_is_calibrated(sound):
    poses = sound.odometry.poses
    steps = se2.between(poses[:-1], poses[1:])
    steps[:, 2] += 0.05 * np.hypot(*steps[:, :2].T)
    assert doubts(replace(sound, odometry=Odometry(sound.odometry.stamps, chained(poses[0], steps)))) == set()


@pytest.mark.slow
def test_turns_that_change_their_sign_half_way(sound):
    poses = sound.odometry.poses
    steps = se2.between(poses[:-1], poses[1:])
    steps[len(steps) // 2 :, 2] *= -1.0
    log = replace(sound, odometry=Odometry(sound.odometry.stamps, chained(poses[0], steps)))
    texts = [n.text for n in build_map(log).doubts if n.kind == "halves-disagree"]
    assert any("mirror images" in text for text in texts)
