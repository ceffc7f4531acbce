"""Halves of a recording that need different wheels are a doubt; a sound recording has none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.mapping import build_map
from uwblite.pipeline import half_tests
from uwblite.pipeline.progress import Stages
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


@pytest.mark.parametrize("missing", [None, 0, 1])
def test_halves_are_compared_where_both_decide(monkeypatch, missing):
    """Poses 10 to 31 of the second recording: 10 to 20 and 20 to 31; a recording with a lidar is not examined."""
    asked, compared = [], []

    def calibrated(estimate, recording, rows, task):
        asked.append((rows.start, rows.stop))
        return None if missing == len(asked) - 1 else len(asked)

    monkeypatch.setattr(half_tests, "_calibration", calibrated)
    monkeypatch.setattr(half_tests, "_check_sign_of_turns", lambda *args: None)
    monkeypatch.setattr(half_tests, "_compare", lambda one, other, task: compared.append((one, other)))
    each = [SimpleNamespace(has_scans=True), SimpleNamespace(has_scans=False, rows=slice(10, 31))]
    half_tests.check_halves(SimpleNamespace(ranges=1), SimpleNamespace(recordings=SimpleNamespace(each=each)))
    assert asked == [(10, 20), (20, 31)]
    assert compared == ([(1, 2)] if missing is None else [])


@pytest.mark.parametrize(("kind", "limit"), [(0, 0.1), (1, 0.2), (2, 0.05)])
def test_halves_differ_by_their_limit_and_four_standard_deviations(kind, limit):
    for factor, sigma, doubted in ((1.01, 0.0, True), (0.99, 0.0, False), (1.01, 0.2, True), (1.01, 0.26, False)):
        one, other = np.zeros((3, 2)), np.zeros((3, 2))
        other[kind, 0], one[kind, 1], other[kind, 1] = -factor * limit, 0.6 * sigma * limit, 0.8 * sigma * limit
        stages = Stages(None, None)
        half_tests._compare(one, other, SimpleNamespace(stages=stages))
        assert [n.kind for n in stages.doubts] == (["halves-disagree"] if doubted else [])
