"""Halves of a recording that need different wheels are a doubt; a sound recording has none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.assessment import half_tests
from uwblite.graph.graph import PriorEdges
from uwblite.mapping import build_map
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


@pytest.mark.parametrize(("kind", "limit"), [(0, 0.1), (1, 0.2), (2, 0.05)])
def test_halves_differ_by_their_limit_and_four_standard_deviations(kind, limit):
    for factor, sigma, doubted in ((1.01, 0.0, True), (0.99, 0.0, False), (1.01, 0.2, True), (1.01, 0.26, False)):
        one, other = np.zeros((3, 2)), np.zeros((3, 2))
        other[kind, 0], one[kind, 1], other[kind, 1] = -factor * limit, 0.6 * sigma * limit, 0.8 * sigma * limit
        stages = Stages(None, None)
        stages.findings.extend(half_tests._compare(one, other, SimpleNamespace(stages=stages)))
        assert [n.kind for n in stages.doubts] == (["halves-disagree"] if doubted else [])


def test_a_prior_on_the_unit_of_the_wheels_is_twenty_times_as_wide():
    priors = PriorEdges("calibration", np.array([2, 0, 1]), np.zeros((3, 1)), np.array([5.0, 6.0, 7.0])[:, None, None])
    loose = half_tests._loose(priors, 0)
    np.testing.assert_allclose(loose.sqrt_information[:, 0, 0], [5.0, 0.3, 7.0])


LEFT, RIGHT = np.array([[0.0, 0.0], [6.0, 0.0], [5.0, 4.0], [1.0, 5.0]]), np.array([1.0, -1.0])


@pytest.mark.parametrize(
    ("mirrored", "missing", "doubted"), [(False, 0, False), (True, 0, True), (True, 1, True), (True, 2, False)]
)
def test_anchors_of_both_halves_that_are_mirror_images_are_a_doubt(monkeypatch, mirrored, missing, doubted):
    """By the anchors that both halves place, three at least; where either half lies does not matter."""
    places = dict(zip("ABCD", LEFT, strict=True))
    other = {name: se2.transform([3.0, -2.0, 0.7], place * (RIGHT if mirrored else 1.0)) for name, place in places.items()}
    for name in "AD"[:missing]:
        del other[name]
    halves = iter([places, other | {"Z": np.zeros(2)}])
    monkeypatch.setattr(half_tests, "_anchors_alone", lambda *args: next(halves))
    stages = Stages(None, None)
    stages.findings.extend(half_tests._check_sign_of_turns(
        SimpleNamespace(frames=SimpleNamespace(stamps=np.arange(9.0))), SimpleNamespace(stages=stages)
    ))
    assert [n.kind for n in stages.doubts] == (["halves-disagree"] if doubted else [])
    assert all(n.figures["apart"] > 1.0 and n.figures["mirrored"] < 1e-9 for n in stages.doubts)


def test_a_radio_with_several_places_in_a_half_is_not_compared():
    places = {"A": LEFT[0], "B@2": LEFT[1], "C": LEFT[2], "C@2": LEFT[3]}
    assert list(half_tests._radios_at_one_place(places)) == ["A", "B"]
