"""The expected error of the shape of a path, from the joint covariance of its poses."""

import numpy as np
import pytest

from uwblite.graph.covariances import shape_error


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
