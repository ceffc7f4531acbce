"""A slip of the wheels, found by ranges to anchors that have a place, and by a path that begins with none."""

import numpy as np
import pytest
from helpers.planted import chain, odometry, ranges, wander

from uwblite import se2
from uwblite.constraints import Constraints
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.odometry.slips import EVERY, LASTS
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import first_optimisation
from uwblite.pipeline.recordings import gather
from uwblite.radio.slip_search import TagRanges, bursts, likeliest_slip, log_prior
from uwblite.sensor_log import SensorLog

ANCHORS = np.array([[-7.5, -5.5], [7.5, -5.0], [6.5, 5.5], [-7.0, 5.0]])


def seen_from(truth, pose, sigma=0.05, seed=1):
    """Return ranges to all anchors from poses (m,) of a path, the tag beside the base's origin."""
    rng = np.random.default_rng(seed)
    at, which = np.repeat(pose, len(ANCHORS)), np.tile(np.arange(len(ANCHORS)), len(pose))
    tag = np.broadcast_to([0.1, -0.05], (len(at), 2))
    distance = np.hypot(*(se2.transform(truth[at], tag) - ANCHORS[which]).T) + sigma * rng.standard_normal(len(at))
    return TagRanges(at, tag, ANCHORS[which], distance, np.full(len(at), sigma))


def slipping(truth, first, last, extra):
    """Return the steps of wheels along a path that count a further motion (3,) in all over the steps first <= k < last."""
    motion = se2.between(truth[:-1], truth[1:])
    motion[first:last] += np.asarray(extra) / (last - first)
    return motion


@pytest.mark.parametrize("extra", [(2.0, 0.0, 1.2), (1.0, 0.0, -2.5), (0.0, 0.0, 3.0)])
def test_the_path_after_a_slip_is_displaced_to_where_the_ranges_are_likeliest(extra):
    truth = wander(np.random.default_rng(2), 20.0, speed=0.2, rate=2.0, half_width=4.0)[1]
    first, last = 60, 66
    wheels = chain(truth[0], slipping(truth, first, last, extra))
    found = likeliest_slip(wheels, np.full(len(truth) - 1, 0.5), seen_from(truth, np.arange(0, len(truth), 4)))
    assert found.first - 4 <= first < last <= found.last + 4
    # 72 headings and three shares of the way: within 5 degrees and half a metre.
    after = max(found.last, last)
    off = se2.between(truth[after:], found.poses[after:])
    assert np.hypot(*off[:, :2].T).max() < 0.9
    assert np.abs(off[:, 2]).max() < 0.1
    np.testing.assert_array_equal(found.poses[: found.first + 1], wheels[: found.first + 1])


def test_a_slip_behind_which_nothing_is_measured_is_not_sought():
    truth = wander(np.random.default_rng(2), 4.0, speed=0.2, rate=2.0)[1]
    assert likeliest_slip(truth, np.full(len(truth) - 1, 0.5), seen_from(truth, np.array([0, 2]))) is None


def test_the_prior_is_the_share_of_time_and_three_parameters():
    assert log_prior(60.0, 1) == pytest.approx(np.log(60.0 / EVERY))
    assert log_prior(0.0, 100) == pytest.approx(np.log(LASTS / EVERY) - 1.5 * np.log(100))
    assert log_prior(10.0 * EVERY, 1) == 0.0


@pytest.mark.parametrize(
    ("seed", "moments"),
    [(3, (20.0, 110.0)), *(pytest.param(*each, marks=pytest.mark.slow) for each in [(1, (90.0,)), (2, (60.0, 150.0))])],
)
def test_a_path_by_wheels_that_slip_and_ranges_alone(seed, moments):
    """By bent wheels it is wrong by metres."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 50.0, speed=0.25, rate=10.0, half_width=4.5)
    motion = se2.between(truth[:-1], truth[1:])
    for moment in moments:
        motion[(stamps[:-1] >= moment) & (stamps[:-1] < moment + 4.0)] += np.array([2.0, 0.0, 1.5]) / 40.0
    log = SensorLog(odometry(stamps, chain(truth[0], motion), rng, noise=0.01, turn_noise=0.01),
                    ranges(rng, stamps, truth, ANCHORS, rate=0.5, sigma=0.05))  # fmt: skip
    task = Task(gather([log], KeyframeConfig()), MappingConfig(), Constraints(), Stages(None, None))
    estimate = first_optimisation(task)
    true = se2.interpolate_trajectory(stamps, truth, task.recordings.stamps)[:, :2]
    here = estimate.graph.poses[:, :2]
    off = np.hypot(*(se2.transform(se2.align(here, true), here) - true).T)
    assert np.sqrt(np.mean(off**2)) < 0.15
    slipped = 1.0 / np.einsum("eii->ei", estimate.odometry.sqrt_information)[:, 2] > 0.1
    begins = task.recordings.stamps[estimate.odometry.i[slipped]]
    assert all(np.any(np.abs(begins - moment - 2.0) < 5.0) for moment in moments)


def test_ranges_of_several_anchors_that_are_off_at_once_are_a_burst_and_those_of_one_anchor_hardly():
    """An anchor behind an obstacle for a while has lasting errors, which count about once; a tag elsewhere shows in all."""
    pose, anchor = np.repeat(np.arange(60), 4), np.tile(np.arange(4), 60)
    errors = 0.1 * np.random.default_rng(3).standard_normal(240)
    usual = np.log(0.9 * np.exp(-0.5 * (errors / 0.1) ** 2) / (0.1 * np.sqrt(2.0 * np.pi)) + 0.01)
    assert bursts(pose, errors, usual, np.full(240, 0.3)) == []
    for late, found in ((pose >= 50, [(50, 59)]), ((pose < 9) & (anchor == 1), [])):
        off = np.where(late, errors + 1.5, errors)
        density = np.where(late, np.log(0.01), usual)
        assert bursts(pose, off, density, np.full(240, 0.3)) == found
