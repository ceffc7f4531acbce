"""The filter's steps against numeric derivatives of what they model."""

import numpy as np
from helpers.hypotheses import a_bank, numeric

from uwblite.localization import hypotheses
from uwblite.localization.hypotheses import SLOW_LENGTH


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
        assert np.isclose(F[-1, -1], np.exp(-np.hypot(*step[:2]) / SLOW_LENGTH))
