"""The filter's law: its errors are as large as it states, over worlds planted by its own model."""

import numpy as np
import pytest
from helpers.hypotheses import anchors_at
from helpers.localization_room import ANCHORS
from scipy.stats import chi2

from uwblite import se2
from uwblite.localization import hypotheses
from uwblite.localization.hypotheses import FIRST_ANCHOR, SLOW_LENGTH, SLOW_SIGMA, WHEEL_SIGMA
from uwblite.radio.range_errors import HARMONICS, PATTERN_SIGMA, pattern_waves

PLACES = np.array(list(ANCHORS.values()))
START = np.diag(np.square([0.3, 0.3, 0.1]))
BIASES, WHITE, STEP = np.full(len(PLACES), 0.1), 0.05, 0.1
NOISE = np.sqrt([0.02**2 * STEP, 0.02**2 * STEP, 0.02**2 * STEP])


def test_the_error_that_fades_keeps_its_size_over_a_drive():
    """A Gauss-Markov process that began in its stationary state stays there, whatever the steps are."""
    fading = FIRST_ANCHOR + np.arange(len(PLACES))
    for step in (0.01, 0.1, 1.0):
        bank = hypotheses.started(np.zeros((1, 3)), START[None], BIASES)
        for _ in range(100):
            bank = hypotheses.moved(bank, np.array([step, 0.0, 0.0]))
        np.testing.assert_allclose(np.diagonal(bank.covariance[0])[fading], SLOW_SIGMA**2, rtol=1e-9)
        np.testing.assert_allclose(np.diagonal(bank.covariance[0])[fading + len(PLACES)], BIASES**2, rtol=1e-9)


def planted(seed, steps=150):
    """Drive once with every unknown drawn from its prior; return the normalised squared error of the pose, now and then."""
    rng = np.random.default_rng(seed)
    truth = np.array([4.0, 3.0, rng.uniform(-np.pi, np.pi)])
    scale, turn_scale, drift = WHEEL_SIGMA * rng.normal(size=3)
    pattern, slow = PATTERN_SIGMA * rng.normal(size=2 * HARMONICS), SLOW_SIGMA * rng.normal(size=len(PLACES))
    bias = BIASES * rng.normal(size=len(PLACES))
    bank = hypotheses.started((truth + np.linalg.cholesky(START) @ rng.normal(size=3))[None], START[None], BIASES)
    known = anchors_at(PLACES, WHITE)
    fade, found = np.exp(-STEP / SLOW_LENGTH), []
    for k in range(steps):
        # A circle of 1.5 m about the room's middle.
        wheels = np.array([STEP, 0.0, STEP / 1.5])
        real = np.array([(1.0 + scale) * STEP, 0.0, (1.0 + turn_scale) * wheels[2] + drift * STEP])
        extra = np.array([0.0, 0.0, 0.03 * np.sqrt(wheels[2])]) * rng.normal() + 2e-4 * rng.normal(size=3)
        truth = se2.compose(truth, real + NOISE * rng.normal(size=3) + extra)
        slow = fade * slow + SLOW_SIGMA * np.sqrt(1.0 - fade**2) * rng.normal(size=len(slow))
        bank = hypotheses.moved(bank, wheels)
        for anchor, place in enumerate(PLACES):
            bearing = np.arctan2(*(place - truth[:2])[::-1]) - truth[2]
            error = pattern_waves(np.array([bearing]))[0] @ pattern + slow[anchor] + bias[anchor]
            value = np.hypot(*(truth[:2] - place)) + error + WHITE * rng.normal()
            bank = hypotheses.ranged(bank, known, anchor, value, np.zeros(2))[0]
        if k % 50 == 49:
            off = bank.poses[0] - truth
            off[2] = se2.wrap_angle(off[2])
            found.append(off @ np.linalg.solve(bank.pose_covariances[0], off))
    return found


@pytest.fixture(scope="module")
def errors():
    return np.array([planted(seed) for seed in range(16)])


def test_errors_over_planted_worlds_are_as_large_as_stated(errors):
    at_end = errors[:, -1]
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * len(at_end)) / len(at_end)
    assert low < at_end.mean() < high
    assert np.mean(errors <= chi2.ppf(0.95, 3)) > 0.9
