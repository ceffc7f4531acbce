"""Two passes in opposite directions, averaged."""

import numpy as np

from uwblite.localization.localize import Pass, smoothed

OF_MAP = np.diag([4e-4, 4e-4, 25e-6])


def of_map(places):
    """The same error everywhere."""
    return np.broadcast_to(OF_MAP, (len(places), 3, 3))


def a_pass(poses, covariances):
    return Pass(np.array(poses, dtype=float), np.array(covariances, dtype=float), np.zeros(2), (), "")


def test_passes_are_averaged_by_their_information():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(2, 5, 3, 3))
    A, B = (0.01 * (r @ r.transpose(0, 2, 1) + 0.1 * np.eye(3)) for r in roots)
    a = rng.normal(size=(5, 3))
    b = a + 0.01 * rng.normal(size=(5, 3))
    poses, covariances, contradicting = smoothed(a_pass(a, A), a_pass(b, B), of_map)
    information = np.linalg.inv(A) + np.linalg.inv(B)
    np.testing.assert_allclose(np.linalg.inv(covariances - OF_MAP), information, rtol=1e-6)
    mean = np.linalg.solve(information, (np.linalg.inv(A) @ a[..., None]) + np.linalg.inv(B) @ b[..., None])[..., 0]
    np.testing.assert_allclose(poses, mean, atol=1e-9)
    assert not contradicting.any()


def test_where_one_pass_is_lost_the_other_one_stands():
    nowhere, unknown = np.full(3, np.nan), np.full((3, 3), np.nan)
    one = a_pass([[1, 2, 3], nowhere, nowhere], [np.eye(3), unknown, unknown])
    other = a_pass([nowhere, [4, 5, -3], nowhere], [unknown, 2 * np.eye(3), unknown])
    poses, covariances, _ = smoothed(one, other, of_map)
    np.testing.assert_allclose(poses[:2], [[1, 2, 3], [4, 5, -3]])
    np.testing.assert_allclose(covariances[:2] - OF_MAP, [np.eye(3), 2 * np.eye(3)])
    assert np.isnan(poses[2]).all()


def test_headings_are_averaged_across_the_turn():
    cov = [np.eye(3) * 1e-2]
    poses, _, _ = smoothed(a_pass([[0, 0, np.pi - 0.01]], cov), a_pass([[0, 0, -np.pi + 0.03]], cov), of_map)
    np.testing.assert_allclose(poses[0, 2], -np.pi + 0.01)


def test_a_contradiction_is_reported_and_makes_the_pose_unsure():
    one, other = a_pass([[0, 0, 0]], [1e-4 * np.eye(3)]), a_pass([[3, 0, 0]], [4e-4 * np.eye(3)])
    poses, covariances, contradicting = smoothed(one, other, of_map)
    assert contradicting.tolist() == [True]
    np.testing.assert_allclose(poses[0], 0)
    assert covariances[0, 0, 0] > 9.0
