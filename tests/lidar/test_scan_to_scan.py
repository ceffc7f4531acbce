"""Tracking: steps between neighbouring clouds are measured, slips are found by a search, blind steps left to the wheels."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import HALL, ROOM, chained, scanned, walked
from helpers.planted import box

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import Clouds, joined
from uwblite.lidar.scan_to_scan import follow, match_plainly
from uwblite.odometry.slips import EVERY, LASTS

NOISE = np.array([0.01, 0.005, 0.006])
GATE = 0.5


def odometry_steps(truth, clouds, stated):
    """Match a chain whose odometry reports the steps said (k - 1, 3)."""
    result = tracked(truth, clouds, stated)
    return result.steps, result.slipped, result.searched


def tracked(truth, clouds, stated, by_ranges=None, duration=None):
    """Return the scan odometry of a chain whose odometry reports the steps said (k - 1, 3)."""
    wheels = replace(chained(truth, NOISE), motion=stated, slips=by_ranges)
    wheels = wheels if duration is None else replace(wheels, duration=duration)
    poses = [truth[0]]
    for step in stated:
        poses.append(se2.compose(poses[-1], step))
    raster = rasterize(clouds, 0.1, GATE)
    steps = match_plainly(raster, wheels.i, stated, GATE)
    return follow(raster, wheels, Graph(np.array(poses)), steps)


@pytest.fixture(scope="module")
def walk():
    truth, _, clouds = walked(5, HALL, 30.0)
    return truth, clouds, se2.between(truth[:-1], truth[1:])


def test_steps_are_measured(walk):
    """Walls seen by a hundred points of 1 cm, alike in both clouds: a few millimetres."""
    truth, clouds, exact = walk
    rng = np.random.default_rng(1)
    steps, _, _ = odometry_steps(truth, clouds, exact + rng.standard_normal(exact.shape) * NOISE)
    np.testing.assert_array_equal(steps.j, steps.i + 1)
    # In the middle of the hall some steps see too little wall.
    assert len(steps) > 0.85 * len(exact)
    error = se2.between(exact[steps.i], steps.T_i_j)
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.005
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 0.003
    whitened = np.einsum("eij,ej->ei", steps.sqrt_information, error)
    assert np.mean(np.sum(whitened**2, axis=1)) < 6.0


def test_clouds_judge_the_slips_that_ranges_show(walk):
    """Ranges alone decide where no cloud has points; false ones lose against clouds that lie where sound wheels count them."""
    truth, clouds, exact = walk
    shown = np.full(len(exact), 1e-3)
    seen, blind = slice(3, 9), slice(20, 26)
    shown[seen] = shown[blind] = 0.999
    some = clouds.only(~np.isin(clouds.owner, np.arange(20, 27)))
    with_ranges, without = (tracked(truth, some, exact, odds).slips > 0.5 for odds in (shown, None))
    np.testing.assert_array_equal(np.flatnonzero(with_ranges), np.arange(blind.start, blind.stop))
    assert not with_ranges[seen].any()
    assert not without.any()


def test_that_ranges_show_no_slip_is_no_evidence_against_one(walk):
    """A path of few ranges follows the wheels, slips and all."""
    truth, clouds, exact = walk
    stated = exact.copy()
    slips = np.arange(8, 14)
    stated[slips] += [0.25, 0.0, 0.2]
    found = [tracked(truth, clouds, stated, shown).slips for shown in (None, np.full(len(exact), 1e-6))]
    np.testing.assert_array_equal(*found)
    # The first may be a turn as the wheels can make it.
    assert np.isin(slips[1:], np.flatnonzero(found[1] > 0.5)).all()


def test_slips_are_found_by_a_search(walk):
    """Wheels so bad that they miss by up to 0.3 m and 0.35 rad a step: the clouds show it, and the noise is re-estimated."""
    truth, clouds, exact = walk
    rng = np.random.default_rng(2)
    stated = exact + rng.uniform(-1, 1, exact.shape) * [0.3, 0.3, 0.35]
    steps, wheels, searches = odometry_steps(truth, clouds, stated)
    # Along a bare wall no match says where the next cloud lies; the information states it.
    error = np.einsum("eij,ej->ei", steps.sqrt_information, se2.between(exact[steps.i], steps.T_i_j))
    good = np.abs(error).max(axis=1) < 4.0
    assert searches > 0
    assert len(steps) > 0.8 * len(exact)
    assert good.mean() > 0.95
    before = chained(truth, NOISE).sqrt_information
    assert np.all(np.einsum("eii->ei", wheels.sqrt_information) < np.einsum("eii->ei", before))


def test_of_steps_called_slipped_with_a_probability_that_share_slipped():
    """Slips of six steps, each as long as others by luck or by a quarter of a metre; and placed clouds lie where they say."""
    probability, slipped, squared = [], [], []
    for seed in (20, 21):
        truth, _, clouds = walked(seed, HALL, 40.0)
        exact, rng = se2.between(truth[:-1], truth[1:]), np.random.default_rng(seed)
        stated, slips = exact + rng.standard_normal(exact.shape) * NOISE, np.zeros(len(exact), dtype=bool)
        for first in rng.integers(0, len(exact) - 8, 4):
            stated[first : first + 6] += rng.standard_normal(3) * [0.25, 0.25, 0.2]
            slips[first : first + 6] = True
        found = tracked(truth, clouds, stated)
        steps = found.steps
        error = np.einsum("eij,ej->ei", steps.sqrt_information, se2.between(exact[steps.i], steps.T_i_j))
        squared.append(np.sum(error**2, axis=1))
        probability.append(found.slips)
        slipped.append(slips)
    p, slips = np.concatenate(probability), np.concatenate(slipped)
    sure = p > 0.9
    # Three standard deviations of a share.
    assert slips[sure].mean() > p[sure].mean() - 3.0 * np.sqrt(0.05 * 0.95 / sure.sum())
    assert sure[slips].mean() > 0.8
    # What is missed is hardly larger than the noise of the wheels.
    assert slips[p < 0.5].mean() < 0.03
    assert np.mean(np.concatenate(squared) < 16.27) > 0.99


@pytest.mark.parametrize("times", [15.0, 40.0])
def test_long_steps_of_uncertain_wheels_are_measured_where_clouds_fit(times):
    """Among posts, half a metre wide, descent from wheels that are off by two standard deviations ends at a false place."""
    truth, rng = walked(5, HALL, 30.0)[0], np.random.default_rng(6)
    middles, half = rng.uniform(-8.0, 8.0, (60, 2)), se2.rotate(rng.uniform(0.0, np.pi, 60), np.tile([0.25, 0.0], (60, 1)))
    sides = np.hstack([middles - half, middles + half])
    clouds = scanned(truth, np.concatenate([sides, sides[:, [2, 3, 0, 1]]]), 0.01, 5, reach=4.0)
    exact = se2.between(truth[:-1], truth[1:])
    long = np.arange(6, len(exact) - 3, 8)
    noise = np.tile(NOISE, (len(exact), 1))
    noise[long] *= times
    stated = exact + rng.standard_normal(exact.shape) * NOISE
    stated[long] += rng.choice([-1.0, 1.0], (len(long), 3)) * [1.5, 1.5, 2.0] * noise[long]
    wheels = replace(chained(truth, NOISE), motion=stated, sqrt_information=np.eye(3) / noise[:, :, None])
    raster = rasterize(clouds, 0.1, GATE)
    found = follow(raster, wheels, Graph(se2.chain(truth[0], stated)), match_plainly(raster, wheels.i, stated, GATE))
    measured = long[np.isin(long, found.steps.i)]
    error = se2.between(exact[measured], found.steps.T_i_j[np.searchsorted(found.steps.i, measured)])
    assert np.sum(np.abs(error).max(axis=1) < 0.03) >= len(long) - 1
    assert found.slips[long].max() < 0.5


def test_a_lost_message_is_told_by_the_clouds_before(walk):
    """Over one step of 10 ms the odometry misses 0.7 rad, more than any slip may last; the others are right."""
    truth, clouds, exact = walk
    rng, row = np.random.default_rng(4), 60
    stated = exact + rng.standard_normal(exact.shape) * NOISE
    stated[row] += [0.1, -0.1, 0.7]
    duration = np.ones(len(exact))
    duration[row] = 0.01
    result = tracked(truth, clouds, stated, duration=duration)
    step = result.steps.T_i_j[result.steps.i == row]
    assert len(step) == 1
    assert np.abs(se2.between(exact[row], step[0])).max() < 0.02
    # The others stay.
    error = np.einsum("eij,ej->ei", result.steps.sqrt_information, se2.between(exact[result.steps.i], result.steps.T_i_j))
    assert np.mean(np.abs(error).max(axis=1) < 5.0) > 0.97


def followed_by_the_ground(clouds, some, share):
    """Return clouds some of which show the ground across the robot's way, always as far from it, in a share of their points."""
    parts = []
    for k in range(len(clouds)):
        points, normals = (part.astype(np.float64) for part in clouds.cloud(k))
        if k in some:
            ground = np.abs(np.linspace(-1.0, 1.0, len(points))) < share
            away = np.linspace(-2.0, 2.0, int(ground.sum()))
            points[ground] = np.column_stack([1.2 + 0.2 * away, away])
            normals[ground] = np.array([-1.0, 0.2]) / np.hypot(1.0, 0.2)
        owner, scatter = np.zeros(len(points), np.int32), np.full(len(points), 1e-4)
        parts.append(Clouds(np.array([0, len(points)]), points, normals, owner, scatter))
    return joined(parts)


def test_what_the_ground_shows_against_sound_wheels_is_rejected():
    """A robot that tilts sees the ground before it, always as far away; matching follows that, and the room stands still."""
    truth = np.column_stack([np.arange(80) * 0.2 - 6.0, 0.3 * np.sin(np.arange(80) * 0.1), np.zeros(80)])
    exact = se2.between(truth[:-1], truth[1:])
    rng, some = np.random.default_rng(6), np.arange(30, 42)
    clouds = followed_by_the_ground(scanned(truth, HALL, 0.01, 2, beams=300, reach=8.0), some, 0.6)
    result = tracked(truth, clouds, exact + rng.standard_normal(exact.shape) * NOISE)
    steps = result.steps
    assert result.rejected[some[:-1]].mean() > 0.5
    assert result.rejected[: some[0] - 1].sum() + result.rejected[some[-1] + 1 :].sum() <= 2
    assert not result.rejected[steps.i].any()
    error = np.hypot(*se2.between(exact[steps.i], steps.T_i_j)[:, :2].T)
    assert np.quantile(error, 0.95) < 0.05


def test_blind_steps_are_left_to_the_wheels():
    truth = np.column_stack([np.arange(30) * 0.3, np.zeros(30), np.zeros(30)])
    clouds = scanned(truth, box(400, 400))
    steps, wheels, searches = odometry_steps(truth, clouds, se2.between(truth[:-1], truth[1:]))
    assert len(steps) == 0
    assert searches == 0
    # Wheels slip in a share of the time, and nothing says that they did not.
    before, after = (np.einsum("eii->ei", w.sqrt_information) for w in (chained(truth, NOISE), wheels))
    assert np.all((after <= before) & (after**2 >= before**2 * (1.0 - 2.0 * LASTS / EVERY)))


def test_a_corridor_is_not_measured_along():
    truth = np.column_stack([np.arange(30) * 0.3 - 4.5, np.zeros(30), np.zeros(30)])
    clouds = scanned(truth, np.array([[-40.0, -1.0, 40.0, -1.0], [40.0, 1.0, -40.0, 1.0]]), 0.01, 3, reach=5.0)
    steps, _, _ = odometry_steps(truth, clouds, se2.between(truth[:-1], truth[1:]))
    information = np.swapaxes(steps.sqrt_information, 1, 2) @ steps.sqrt_information
    assert len(steps) > 20
    assert np.median(information[:, 0, 0]) < 0.02 * np.median(information[:, 1, 1])


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_a_scan_whose_stamp_is_wrong_leaves_both_of_its_steps_measured(seed):
    """Wheels give the pose of another moment: what they count too much up to there, they count too little after it.

    A match that they led to a false place may be left out, one of twelve.
    """
    truth, _, clouds = walked(seed, ROOM, 30.0, half_width=1.8)
    exact = se2.between(truth[:-1], truth[1:])
    rng = np.random.default_rng(seed)
    stated = exact + rng.standard_normal(exact.shape) * NOISE
    late = np.arange(10, len(exact) - 1, 15)
    stated[late - 1, 2] += 0.1
    stated[late, 2] -= 0.1
    found = tracked(truth, clouds, stated)
    measured = np.isin([late - 1, late], found.steps.i)
    assert (~measured).sum() <= 1
    assert found.rejected[[late - 1, late]].sum() <= 1
    both = np.stack([late - 1, late])[:, measured.all(axis=0)]
    turned = found.steps.T_i_j[np.searchsorted(found.steps.i, both), 2].sum(axis=0)
    np.testing.assert_allclose(turned, exact[both, 2].sum(axis=0), atol=0.03)
