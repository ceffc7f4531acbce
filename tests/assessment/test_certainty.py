"""Whether a map states that it knows the shape of the path; what drifts where nothing but ranges holds it is a doubt."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.assessment.certainty import check_certainty
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.graph import Graph
from uwblite.mapping import build_map
from uwblite.sensor_log import Odometry, SensorMounting


@pytest.mark.parametrize(
    ("across", "ranges", "sigma", "doubted"),
    [
        (50.0, True, 0.39, False), (50.0, True, 0.41, True), (4.0, True, 0.19, False), (4.0, True, 0.21, True),
        (450.0, False, 2.2, False), (450.0, False, 2.3, True), (4.0, False, 0.19, False), (4.0, False, 0.21, True),
        (60.0, False, 0.39, False), (60.0, False, 0.41, True),
    ],
)  # fmt: skip
def test_a_path_whose_shape_is_known_roughly_only_is_doubted(across, ranges, sigma, doubted):
    """With ranges to the same error everywhere; without, a chain of steps errs by its length."""
    poses = across * np.array([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    measured = plain_ranges(np.array([0]), np.array([0]), np.array([1.0]), 0.1) if ranges else None
    estimate = estimate_of(Graph(poses, np.zeros((1, 2))), ranges=measured)
    found = list(check_certainty(estimate, sigma, task_of(recordings_of(poses))))
    assert [finding.severity for finding in found] == ["doubt"] * doubted


def without_lidar(way):
    """Return a recording of a way; heights of the anchors are given: what drifts is not told from them here."""
    return replace(recording(way).without(lidar=True), mounting=SensorMounting(anchor_height=0.0))


@pytest.fixture(scope="module")
def sound():
    return without_lidar(two_rounds()[:2600])


def drifts(log):
    return [n for n in build_map(log).doubts if n.kind == "drift"]


def age(stamps):
    return (stamps - stamps[0]) / np.ptp(stamps)


def test_ranges_that_grow(sound):
    ranges = sound.ranges
    (found,) = drifts(replace(sound, ranges=replace(ranges, ranges=ranges.ranges + 0.6 * age(ranges.stamps))))
    assert "all ranges seem to grow by 0." in found.text
    assert found.figures["value"] == pytest.approx(0.6, abs=0.15)


def test_wheels_that_lose_air(sound):
    odometry = sound.odometry
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    steps[:, :2] *= (1.0 - 0.2 * age(odometry.stamps[1:]))[:, None]
    (found,) = drifts(replace(sound, odometry=Odometry(odometry.stamps, se2.chain(odometry.poses[0], steps))))
    assert "the odometry's scale seems to change by" in found.text
    assert found.figures["value"] == pytest.approx(0.2, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("turn", "over"), [(0.6, 2.0), (1.5, 6.0)])
def test_the_ranges_hold_a_path_whose_wheel_slips_for_seconds(turn, over):
    """The turn is spread over some metres, so that no step of it is conspicuous."""
    truth = two_rounds()
    sound = without_lidar(truth)
    odometry = sound.odometry
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    way = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
    slips = np.abs(way - 0.5 * way[-1]) < 0.5 * over
    steps[slips, 2] += turn / slips.sum()
    result = build_map(replace(sound, odometry=Odometry(odometry.stamps, se2.chain(odometry.poses[0], steps))))
    assert not result.doubts
    assert evaluate_trajectory(result.stamps, result.trajectory, odometry.stamps, truth).ate.rmse < 0.03


def with_steps(log, change):
    """Return a recording whose odometry has other steps (n-1, 3)."""
    poses = log.odometry.poses
    return replace(log, odometry=Odometry(log.odometry.stamps, se2.chain(poses[0], change(se2.between(poses[:-1], poses[1:])))))


def turned_from_half_way(steps):
    way = np.hypot(*steps[:, :2].T) * (np.arange(len(steps)) >= len(steps) // 2)
    return steps + np.column_stack([0.0 * way, 0.0 * way, 0.15 * way])


def mirrored_from_half_way(steps):
    return steps * np.where(np.arange(len(steps))[:, None] < len(steps) // 2, 1.0, [1.0, 1.0, -1.0])


def test_wheels_that_turn_otherwise_from_half_way_on_are_noisy_and_the_ranges_hold_the_path(sound):
    """By 0.15 rad a metre: twenty times the noise of the heading that is assumed."""
    result = build_map(with_steps(sound, turned_from_half_way))
    assert not result.doubts
    error = evaluate_trajectory(result.stamps, result.trajectory, sound.odometry.stamps, two_rounds()).ate.rmse
    assert error < 0.05


def test_wheels_that_turn_the_other_way_from_half_way_on_are_a_doubt(sound):
    half = sound.crop(end=float(sound.odometry.stamps[0]) + 0.5 * float(np.ptp(sound.odometry.stamps)))
    assert build_map(with_steps(half, mirrored_from_half_way)).doubts


def test_a_heading_that_drifts_throughout_is_calibrated(sound):
    def drifting(steps):
        return steps + 0.05 * np.hypot(*steps[:, :2].T)[:, None] * [0.0, 0.0, 1.0]

    assert not build_map(with_steps(sound, drifting)).doubts
