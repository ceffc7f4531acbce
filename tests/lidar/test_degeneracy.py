"""Degenerate directions: rooms hold a pose, corridors do not along their length, whatever the frame."""

import numpy as np
import pytest
import scipy.linalg
from helpers.registration_worlds import CORRIDOR, NOISE, ROOM, pair

from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import joined
from uwblite.lidar.scan_matching import (
    PairPolicy,
    _relative_eigen,
    align_pairs,
    match,
    measured,
    measured_part,
    nondegenerate_step,
    pairs_of,
)

CENTRE = (3.0, 1.5)


def matched(target, source, pose):
    clouds, i, j = joined([target, source]), np.array([0]), np.array([1])
    pairs = pairs_of(clouds, i, j, len(source.points))
    return match(rasterize(clouds, 0.05, 0.3), pairs, np.asarray(pose)[None], 0.3, 0.15)


@pytest.mark.parametrize("noise", [0.005, 0.015, 0.03])
def test_rooms_are_kept_and_the_length_of_corridors_is_dropped(noise):
    along = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for walls, centre in ((ROOM, CENTRE), (CORRIDOR, (0.0, 0.0))):
            factors = matched(*pair(walls, np.zeros(3), rng, centre, noise=noise), np.zeros(3))
            root = nondegenerate_step(*factors.quadratic)[1][0]
            raw, kept = factors.hessian[0], root.T @ root
            assert kept[1, 1] > 0.9 * raw[1, 1]
            assert (np.linalg.eigvalsh(raw - kept) > -1e-6 * raw[1, 1]).all()
            if walls is ROOM:
                assert kept[0, 0] > 0.9 * raw[0, 0]
            else:
                # What is known of x when y and theta are free, too.
                along_x = [1.0 / np.linalg.inv(h + 1e-9 * raw[1, 1] * np.eye(3))[0, 0] for h in (kept, raw)]
                along.append(along_x[0] / along_x[1])
    assert np.median(along) < 1e-3
    assert np.max(along) < 0.5


def with_niches(depth):
    """Return walls (w, 4) of a corridor of 12 m with two niches of a depth, m, 1 m wide, in one of its walls."""
    lower, (x, *_) = CORRIDOR
    along = np.array([x, 1.8, 1.8, 0.8, 0.8, -2.6, -2.6, -3.6, -3.6, -x])
    corners = np.column_stack([along, 1.0 + depth * np.array([0, 0, 1, 1, 0, 0, 1, 1, 0, 0])])
    return np.vstack([lower, np.hstack([corners[:-1], corners[1:]])])


@pytest.mark.parametrize("depth", [0.0, 0.4, 0.8])
def test_repeated_registrations_scatter_along_a_wall_as_they_state(depth):
    """Forty times, with other points of the walls and from other guesses: along a smooth corridor nothing is stated, and niches
    fix its length as well as their matches state, to a factor of 1.5."""
    stated, normalised = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        target, source = pair(with_niches(depth) if depth else CORRIDOR, np.zeros(3), rng, (0.0, 0.0))
        clouds = joined([target, source])
        pairs = pairs_of(clouds, np.array([0]), np.array([1]), len(source.points))
        guess = rng.normal(size=(1, 3)) * [0.05, 0.02, 0.01]
        found = align_pairs(rasterize(clouds, 0.05, PairPolicy.reach), pairs, guess, PairPolicy.reach, PairPolicy.gate)
        z, root = measured(found.factors, found.pose, np.array([NOISE**2 * PairPolicy.correlation]))
        sigma = np.sqrt(np.linalg.inv(root[0].T @ root[0] + 1e-6 * np.eye(3))[0, 0])
        stated.append(sigma)
        normalised.append(z[0, 0] / sigma)
    if depth:
        assert np.median(stated) < 0.015
        assert 1.0 / 1.5 < np.sqrt(np.mean(np.square(normalised))) < 1.5
    else:
        assert np.min(stated) > 0.5


def test_eigenvalues_do_not_depend_on_units_or_frame():
    rng = np.random.default_rng(7)
    half, other, change = rng.normal(size=(3, 3, 3))
    information, spurious = half @ half.T * [10.0], 0.3 * other @ other.T + np.eye(3)
    basis, inverse, values = _relative_eigen(information, spurious)
    # The floor under N, 1e-9 of H, takes that share of l from an eigenvalue l of some tens.
    np.testing.assert_allclose(values, scipy.linalg.eigh(information, spurious, eigvals_only=True), rtol=1e-6)
    np.testing.assert_allclose(basis @ np.diag(values) @ basis.T, information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(basis @ inverse, np.eye(3), atol=1e-12)
    moved = _relative_eigen(change @ information @ change.T, change @ spurious @ change.T)[-1]
    np.testing.assert_allclose(moved, values, rtol=1e-5)


def test_lines_without_scatter_are_fully_measured():
    values = _relative_eigen(np.diag([4.0, 2.0, 1.0]), np.zeros((3, 3)))[-1]
    assert values.min() > 1e8


def test_nothing_matched_has_no_measured_direction():
    assert (_relative_eigen(np.zeros((3, 3)), np.zeros((3, 3)))[-1] == 0.0).all()


def test_the_measured_part_is_that_of_the_nondegenerate_step():
    rng = np.random.default_rng(8)
    for walls, centre in ((ROOM, CENTRE), (CORRIDOR, (0.0, 0.0))):
        factors = matched(*pair(walls, np.zeros(3), rng, centre, noise=0.015), np.zeros(3))
        information, step = measured_part(*factors.quadratic)
        exact, root = nondegenerate_step(*factors.quadratic)
        np.testing.assert_allclose(information, np.swapaxes(root, 1, 2) @ root, atol=1e-6 * information.max())
        np.testing.assert_allclose(step, exact, rtol=1e-6, atol=1e-9)
    nothing = measured_part(PairPolicy.measured * factors.spurious, factors.spurious, factors.gradient)[0]
    np.testing.assert_allclose(nothing, 0.0, atol=1e-6 * factors.spurious.max())
