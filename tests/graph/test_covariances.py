"""The expected error of the shape of a path, from the joint covariance of its poses."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.graph.covariances import about_best_fit, shape_error


def test_the_error_of_a_shape_is_what_alignment_leaves_of_many_draws():
    """Errors drawn from a covariance of no structure, small beside the path; a similarity is z -> a z + b."""
    rng = np.random.default_rng(2)
    poses = rng.normal(loc=[40.0, -20.0, 0.0], scale=10.0, size=(7, 3))
    root = 1e-3 * rng.normal(size=(21, 21))
    errors = (root @ rng.normal(size=(21, 4000))).reshape(7, 3, -1)
    path, drawn = poses[:, 0] + 1j * poses[:, 1], errors[:, 0] + 1j * errors[:, 1]
    fit = np.column_stack([path, np.ones(7)])
    left = drawn - fit @ np.linalg.lstsq(fit, drawn, rcond=None)[0]
    # Of a mean of 4,000 squares that scatter by about themselves.
    expected = pytest.approx(np.mean(np.abs(left) ** 2), rel=4 / np.sqrt(4000))
    assert shape_error(poses, root @ root.T) ** 2 == expected


def test_moves_turns_and_growth_of_the_whole_are_no_error_of_its_shape():
    poses = np.random.default_rng(3).normal(scale=5.0, size=(9, 3))
    modes = np.zeros((4, 9, 3))
    modes[0, :, 0] = modes[1, :, 1] = 1.0
    modes[2, :, 0], modes[2, :, 1] = -poses[:, 1], poses[:, 0]
    modes[3] = poses
    modes = modes.reshape(4, -1).T
    assert shape_error(poses, modes @ modes.T) == pytest.approx(0.0, abs=1e-6)
    assert shape_error(poses, np.eye(27)) == pytest.approx(np.sqrt((18 - 4) / 9))


def test_covariances_about_the_best_fit_are_those_of_many_draws_that_were_fitted():
    rng = np.random.default_rng(5)
    poses = rng.normal(loc=[40.0, -20.0, 0.0], scale=10.0, size=(6, 3))
    root = 1e-3 * rng.normal(size=(18, 18))
    errors = (root @ rng.normal(size=(18, 4000))).T.reshape(-1, 6, 3)
    fits = np.array([se2.align(poses[:, :2] + e[:, :2], poses[:, :2]) for e in errors])
    left = np.array([se2.compose(fit, poses + e) - poses for fit, e in zip(fits, errors, strict=True)])
    left[..., 2] = se2.wrap_angle(left[..., 2])
    drawn = np.einsum("nki,nkj->kij", left, left) / len(left)
    stated = about_best_fit(poses, root @ root.T)
    scale = np.sqrt(np.einsum("kii->ki", stated))
    both = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(drawn / both, stated / both, atol=0.1)


def test_a_move_of_the_whole_bends_it_nowhere():
    poses = np.random.default_rng(3).normal(scale=5.0, size=(9, 3))
    modes = np.tile(np.eye(3), (9, 1, 1))
    modes[:, 0, 2], modes[:, 1, 2] = -poses[:, 1], poses[:, 0]
    modes = modes.reshape(27, 3)
    np.testing.assert_allclose(about_best_fit(poses, modes @ modes.T), 0.0, atol=1e-9)
