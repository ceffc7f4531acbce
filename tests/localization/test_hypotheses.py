"""The filter's steps against numeric derivatives of what they model."""

import numpy as np
from helpers.hypotheses import a_bank, numeric
from helpers.localization_room import cast, grid_of

from uwblite import se2
from uwblite.localization import hypotheses
from uwblite.localization.hypotheses import FIRST_ANCHOR, SLOW_LENGTH, SLOW_SIGMA
from uwblite.localization.walls import Rays, walls_of


def test_a_step_moves_the_covariance_by_the_numeric_jacobian_of_the_mean():
    step = np.array([0.4, 0.05, 0.3])
    for seed in range(3):
        bank = a_bank(seed)

        def driven(x, bank=bank):
            return hypotheses.moved(hypotheses.Hypotheses(x[None], bank.covariance, bank.log_weight), step).mean[0]

        F = numeric(driven, bank.mean[0])
        still = hypotheses.Hypotheses(bank.mean, 0.0 * bank.covariance, bank.log_weight)
        noise = hypotheses.moved(still, step).covariance[0]
        np.testing.assert_allclose(hypotheses.moved(bank, step).covariance[0] - noise, F @ bank.covariance[0] @ F.T, atol=1e-9)
        fading = FIRST_ANCHOR + np.arange(2)
        np.testing.assert_allclose(F[fading, fading], np.exp(-np.hypot(*step[:2]) / SLOW_LENGTH), rtol=1e-6)
        np.testing.assert_allclose(F[-2:, -2:], np.eye(2), atol=1e-9)


def test_scans_between_two_oblique_walls_say_nothing_along_them_and_a_third_wall_does():
    turn = 0.2  # rad; cells of an oblique wall are a staircase, whose normals scatter
    sides, end = ((-1.8, -1, 5.8, -1), (-1.8, 1, 5.8, 1)), ((4, -1, 4, 1),)
    sigma = np.array([0.2, 0.2, 0.05])

    def spread(drawn):
        """Return the standard deviations along and across the walls after forty fresh scans."""
        turned = [tuple(se2.rotate(turn, np.array(w, dtype=float).reshape(2, 2)).ravel() + [2.0, 2.0] * 2) for w in drawn]
        walls = walls_of(grid_of(turned))
        pose = np.array([*se2.rotate(turn, np.array([1.0, 0.1])) + 2.0, turn])
        readings, angles = cast(pose, turned), np.linspace(-np.pi / 2, np.pi / 2, 181)
        seen = np.isfinite(readings)
        ends = readings[seen, None] * np.stack([np.cos(angles[seen]), np.sin(angles[seen])], axis=1)
        bank = hypotheses.started(pose[None], np.diag(sigma**2)[None], np.full(1, 0.1))
        for _ in range(40):
            bank = hypotheses.matched(bank, walls, Rays(ends, np.zeros_like(ends), np.ones(len(ends), bool)), 1.0)
        along = se2.rotate(turn, np.eye(2))
        return np.sqrt(np.diag(along @ bank.pose_covariances[0, :2, :2] @ along.T))

    along, across = spread(sides)
    assert along > 0.9 * sigma[0]
    assert across < 0.01
    assert max(spread(sides + end)) < 0.01


def test_range_errors_that_fade_keep_their_size_and_forget_by_the_distance_driven():
    """A Gauss-Markov process: stationary, the same by many steps as by one, correlated by exp(-way / length)."""
    sigma, way = SLOW_SIGMA, 0.7 * SLOW_LENGTH
    begun = hypotheses.started(np.zeros((1, 3)), np.zeros((1, 3, 3)), np.array([0.05]))
    at = FIRST_ANCHOR
    for count in (1, 7):
        known = begun.covariance.copy()
        known[:, at, at] = 0.0
        still, fresh = begun, hypotheses.Hypotheses(begun.mean, known, begun.log_weight)
        for _ in range(count):
            still, fresh = (hypotheses.moved(b, np.array([way / count, 0.0, 0.0])) for b in (still, fresh))
        np.testing.assert_allclose(still.covariance[0, at, at], sigma**2, rtol=1e-12)
        np.testing.assert_allclose(fresh.covariance[0, at, at], sigma**2 * (1.0 - np.exp(-2.0 * way / SLOW_LENGTH)), rtol=1e-12)


def test_a_robot_that_stands_is_lost_by_a_random_walk_in_all_three_directions():
    bank = hypotheses.started(np.zeros((1, 3)), np.zeros((1, 3, 3)), np.array([0.05]))
    bank = hypotheses.Hypotheses(bank.mean, np.zeros_like(bank.covariance), bank.log_weight)
    for _ in range(50):
        bank = hypotheses.moved(bank, np.zeros(3))
    variance = np.diagonal(bank.pose_covariances[0])
    np.testing.assert_allclose(variance, 50.0 * hypotheses._STANDING**2, rtol=1e-9)
