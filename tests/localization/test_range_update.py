"""A range's correction against a Kalman filter with a numeric Jacobian."""

import numpy as np
from helpers.hypotheses import a_bank, anchors_at, numeric
from scipy.ndimage import map_coordinates

from uwblite import se2
from uwblite.localization.hypotheses import FIRST_ANCHOR, PATTERN, ranged
from uwblite.localization.range_model import repeated
from uwblite.radio.range_errors import RangeErrors
from uwblite.radio.range_noise import RangeNoise


def test_a_range_corrects_as_a_kalman_filter_with_the_numeric_jacobian():
    table = np.random.default_rng(7).normal(0.0, 0.2, (9, 8))
    field = RangeErrors(np.array([-3.0, -2.5]), 1.0, table, RangeNoise(0.05, 0.08, 2.0))
    place, square, sigma, scale, tag = np.array([4.0, -2.0]), 0.5, 0.1, 0.01, np.array([0.3, -0.1])
    anchors = anchors_at(np.stack([[9.0, 9.0], place]), sigma, rise=np.full(2, square), scale=scale, errors=(field, field))
    for seed in range(3):
        bank = a_bank(seed)

        tagged = se2.transform(bank.mean[0, :3], tag)
        towards = np.arctan2(*(place - tagged)[::-1]) - bank.mean[0, 2]
        waves = np.array([np.cos(towards * np.array([1, 2, 3])), np.sin(towards * np.array([1, 2, 3]))]).ravel()
        known = map_coordinates(table, (tagged - field.origin)[:, None], order=1, mode="nearest")[0]

        def expected(x, waves=waves, known=known):
            there = x[:2] + se2.rotate(x[2], tag)
            distance = np.sqrt(np.sum((there - place) ** 2) + square)
            own = x[FIRST_ANCHOR + 1] + x[FIRST_ANCHOR + 2 + 1]
            return np.array([(1.0 + scale) * distance + own + waves @ x[PATTERN] + known])

        H, P = numeric(expected, bank.mean[0]), bank.covariance[0]
        measured = float(expected(bank.mean[0])[0]) + 0.05
        found, weight, _, _ = ranged(bank, anchors, 1, measured, tag)
        gain = P @ H.T / (H @ P @ H.T + sigma**2 / weight[0])
        np.testing.assert_allclose(found.mean[0], bank.mean[0] + gain[:, 0] * 0.05, atol=1e-8)
        np.testing.assert_allclose(found.covariance[0], P - gain @ H @ P, atol=1e-9)
        assert 0.5 < weight[0] <= 1.0


def test_a_range_that_is_metres_late_moves_nothing():
    bank = a_bank(1)
    anchors = anchors_at(np.array([[4.0, -2.0], [9.0, 9.0]]), 0.1)
    found, weight, likelihood, anywhere = ranged(bank, anchors, 0, 160.0, np.zeros(2))
    # 0.03 of such ranges over 60 m, against one over 30 m: that of one that comes from anywhere is 200 / 3 times as large.
    np.testing.assert_allclose(anywhere - likelihood, np.log(200.0 / 3.0), atol=1e-6)
    assert weight[0] < 1e-3
    np.testing.assert_array_equal(found.mean, bank.mean)


def test_repeated_ranges_count_as_the_mean_of_their_correlated_errors_varies():
    """White noise and multipath over 200 lengths: the variance of the mean is that of so many independent ranges."""
    noise, every, count = RangeNoise(0.06, 0.1, 0.8), 0.05, 3200
    sigma = float(np.hypot(noise.white, noise.slow))
    field = RangeErrors(np.zeros(2), 1.0, np.zeros((1, 1)), noise)
    new, length = anchors_at(np.zeros((1, 2)), sigma, errors=(field,)).noise[0]
    away = every * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    variance = noise.white**2 / count + noise.slow**2 * np.exp(-away / noise.length).mean()
    white = (new / sigma) ** 2
    np.testing.assert_allclose(repeated(white, length, every) * sigma**2 / count, variance, rtol=0.02)
    assert repeated(white, length, np.inf) == 1.0
    assert repeated(white, length, 0.0) > 50.0
