"""Alignment of many pairs at once: one step as the matches say, none too long, and where it ends."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import registration_worlds as worlds
from helpers.laser_walks import ROOM, scanned

from uwblite import se2
from uwblite.arrays import concatenated
from uwblite.lidar import scan_matching
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import joined
from uwblite.lidar.scan_matching import align_pairs, match, measured_part, nondegenerate_step, pairs_of

TRUTH = np.array([[0.0, 0.0, 0.3], [0.5, -0.4, 0.9], [-0.6, 0.2, -2.0]])
I, J = np.array([0, 0, 2]), np.array([1, 2, 1])


@pytest.fixture(scope="module")
def world():
    """The raster of some clouds, the pairs, and their true poses."""
    clouds = scanned(TRUTH, ROOM, 0.005, 1)
    return rasterize(clouds, 0.05, 0.8), pairs_of(clouds, I, J, 200), se2.between(TRUTH[I], TRUTH[J])


def test_one_iteration_is_one_step_of_the_matches(world):
    raster, pairs, exact = world
    guess = exact + np.array([0.05, -0.04, 0.03])
    step = nondegenerate_step(*match(raster, pairs, guess, 0.3, 0.15).quadratic)[0]
    assert 0.01 < np.abs(step).max() < 0.15
    found = align_pairs(raster, pairs, guess, 0.3, 0.3, iterations=1)
    np.testing.assert_allclose(se2.between(found.pose, guess + step), 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.factors.matched, match(raster, pairs, found.pose, 0.3, 0.15).matched)


def test_a_step_is_the_nondegenerate_one_whatever_was_measured(world):
    """Of pairs that measure all, of one whose clouds show one direction alone, and of one without matches."""
    raster, pairs, exact = world
    factors = match(raster, pairs, exact + np.array([0.05, -0.04, 0.03]), 0.3, 0.15)
    wall = np.outer([0.6, 0.8, 0.1], [0.6, 0.8, 0.1])
    hessian = np.concatenate([factors.hessian, [factors.hessian[0].max() * wall, np.zeros((3, 3))]])
    gradient = np.concatenate([factors.gradient, factors.gradient[:1], np.zeros((1, 3))])
    mixed = replace(concatenated([factors, factors.rows(slice(2))]), hessian=hessian, gradient=gradient).quadratic
    information, step = measured_part(*mixed)
    exact, root = nondegenerate_step(*mixed)
    np.testing.assert_allclose(step, exact, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(information, np.swapaxes(root, 1, 2) @ root, rtol=1e-9, atol=1e-12 * hessian.max())
    assert np.abs(step[:4]).min(axis=1).min() > 0.0
    np.testing.assert_array_equal(step[4], 0.0)


def test_no_step_is_longer_than_allowed(world):
    """0.3 m and 0.15 rad; a longer one keeps its direction."""
    raster, pairs, exact = world
    guess = exact + np.array([0.6, 0.5, 0.1])
    step = nondegenerate_step(*match(raster, pairs, guess, 0.8, 0.4).quadratic)[0]
    found = align_pairs(raster, pairs, guess, 0.8, 0.8, iterations=1)
    taken = found.pose - guess
    taken[:, 2] = se2.wrap_angle(taken[:, 2])
    long = (np.hypot(step[:, 0], step[:, 1]) > 0.3) | (np.abs(step[:, 2]) > 0.15)
    assert long.any()
    ratio = np.maximum(np.hypot(taken[:, 0], taken[:, 1]) / 0.3, np.abs(taken[:, 2]) / 0.15)
    np.testing.assert_allclose(ratio[long], 1.0)
    np.testing.assert_allclose(np.cross(taken, step), 0.0, atol=1e-9)


def test_a_step_that_turns_too_far_is_shortened_as_a_whole(world, monkeypatch):
    """By 0.6 rad, four times what is allowed; by half of what is allowed; 0.6 m and 0.3 rad, both twice as far."""
    raster, pairs, exact = world
    steps = np.array([[0.04, 0.0, -0.6], [0.1, 0.0, 0.075], [0.0, 0.6, 0.3]])
    monkeypatch.setattr(scan_matching, "measured_part", lambda *factors: (None, steps))
    found = align_pairs(raster, pairs, exact, 0.8, 0.8, iterations=1)
    taken = se2.wrap_angle(found.pose[:, 2] - exact[:, 2])
    np.testing.assert_allclose(taken, [-0.15, 0.075, 0.15])
    np.testing.assert_allclose((found.pose - exact)[:, :2], [[0.01, 0.0], [0.1, 0.0], [0.0, 0.3]], atol=1e-12)


def test_pairs_go_on_at_the_last_gate_until_none_moves(world):
    """By then one more step would move no pair; the first step was far from that."""
    raster, pairs, exact = world
    guess = exact + np.array([0.2, -0.15, 0.1])
    moves = []
    for pose in (guess, align_pairs(raster, pairs, guess, 0.5, 0.5, iterations=60).pose):
        moves.append(np.abs(nondegenerate_step(*match(raster, pairs, pose, 0.5, 0.25).quadratic)[0]).max())
    assert moves[0] > 0.05
    assert moves[1] < 1e-3


def test_motions_are_recovered_and_distinguished_from_guesses(world):
    raster, pairs, exact = world
    found = align_pairs(raster, pairs, exact + np.array([0.15, -0.1, 0.08]), 0.5, 0.1)
    error = se2.between(exact, found.pose)
    # Points err by 5 mm and are means in cells of 2 cm; some 150 of them hold a pose.
    assert np.abs(error[:, :2]).max() < 0.01
    assert np.abs(error[:, 2]).max() < 0.005
    assert found.share.min() > 0.4
    assert found.rms.max() < 0.02


MOTION, CENTRE = np.array([0.8, -0.5, 0.6]), (3.0, 1.5)


def aligned(target, source, guesses):
    """Align one pair of clouds from several guesses (g, 3)."""
    clouds, i = joined([target, source]), np.zeros(len(guesses), dtype=np.intp)
    pairs = pairs_of(clouds, i, i + 1, len(source.points))
    return align_pairs(rasterize(clouds, 0.05, 0.8), pairs, guesses, 0.8, 0.15, 30)


def distance(found):
    return np.hypot(*se2.between(MOTION, found.pose)[:, :2].T)


def test_random_guesses_fall_into_the_basin():
    rng = np.random.default_rng(1)
    target, source = worlds.pair(worlds.ROOM, MOTION, rng, CENTRE)
    away, turn = rng.uniform(-np.pi, np.pi, 60), rng.uniform(-0.15, 0.15, 60)
    guesses = MOTION + np.column_stack([0.4 * np.cos(away), 0.4 * np.sin(away), turn])
    # Some 400 points of 15 mm know the pose to 2 mm.
    assert np.sum(distance(aligned(target, source, guesses)) < 0.01) >= 55


def test_people_in_one_cloud_do_not_move_the_other():
    rng = np.random.default_rng(5)
    target, source = worlds.views(worlds.ROOM, MOTION, rng)
    # Two people close to the wall, seen by the source alone.
    legs = np.vstack([rng.normal([1.0, 0.12], 0.02, (25, 2)), rng.normal([3.0, 0.12], 0.02, (25, 2))])
    crowd = np.vstack([source, se2.transform(se2.inverse(MOTION), legs)])
    seen_from = se2.transform(se2.inverse(MOTION), np.asarray(CENTRE))
    guess = MOTION[None] + [0.1, 0.05, 0.02]
    room = worlds.cloud(target, np.asarray(CENTRE))
    alone, beside = (distance(aligned(room, worlds.cloud(s, seen_from), guess)) for s in (source, crowd))
    assert beside < alone + 0.01


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_a_corridor_constrains_across_and_not_along(heading):
    turn = np.array([0.0, 0.0, heading])
    for seed in range(5):
        target, source = worlds.pair(worlds.CORRIDOR, turn, np.random.default_rng(seed), (0.0, 0.0))
        along, across, angle = aligned(target, source, turn[None] + [0.3, 0.1, 0.02]).pose[0] - turn
        assert abs(across) < 0.006
        assert abs(angle) < 0.003
        # Along, nothing was seen: the guess stands.
        assert abs(along - 0.3) < 0.1


def test_a_pair_ends_where_it_ends_alone(world):
    """Pairs that have come to rest are left alone; the others do not notice."""
    raster, pairs, exact = world
    guess = exact + np.array([[0.0, 0.0, 0.0], [0.2, -0.2, 0.1], [-0.02, 0.01, 0.0]])
    together = align_pairs(raster, pairs, guess, 0.5, 0.15)
    for k in range(3):
        row = slice(k, k + 1)
        alone = align_pairs(raster, pairs.rows(row), guess[row], 0.5, 0.15)
        np.testing.assert_allclose(alone.pose[0], together.pose[k], atol=1e-9)


def test_a_gate_shrinks_with_the_steps_of_its_pair(world, monkeypatch):
    """One pair begins where it belongs and comes to the last gate at once, the others 0.25 m off and do not."""
    raster, pairs, exact = world
    guess = exact + np.array([[0.0, 0.0, 0.0], [0.25, 0.0, 0.0], [0.0, 0.25, 0.0]])
    gates = []

    def noted(raster, pairs, pose, gate, scale):
        gates.append(np.broadcast_to(gate, len(pairs)))
        return match(raster, pairs, pose, gate, scale)

    monkeypatch.setattr(scan_matching, "match", noted)
    found = align_pairs(raster, pairs, guess, 0.5, 0.12)
    np.testing.assert_array_equal(gates[0], 0.5)
    np.testing.assert_allclose(gates[1], [0.12, 0.4, 0.4])
    np.testing.assert_allclose(se2.between(exact, found.pose), 0.0, atol=0.01)
