"""Readings that no motion explains, against a loop."""

import numpy as np
import pytest

from uwblite.checks.radio import _spikes


@pytest.mark.parametrize("seed", range(3))
def test_spikes_are_those_of_a_loop(seed):
    """Off the median of two neighbours on either side by more than was driven and five times the noise."""
    rng = np.random.default_rng(seed)
    travelled = np.cumsum(rng.uniform(0.0, 0.3, 200))
    values = 5.0 + 0.5 * travelled + rng.normal(0.0, 0.02, 200) + np.where(rng.random(200) < 0.1, rng.uniform(-3, 3, 200), 0.0)
    second = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    noise = 1.4826 * np.median(np.abs(second)) / np.sqrt(1.5)
    expected = 0
    for k in range(2, 198):
        around = np.median([values[k - 2], values[k - 1], values[k + 1], values[k + 2]])
        expected += abs(values[k] - around) > travelled[k + 2] - travelled[k - 2] + 5.0 * max(noise, 0.03)
    found, sigma = _spikes(values, travelled)
    assert found == expected > 5
    assert sigma == pytest.approx(noise, rel=1e-3)


def test_five_readings_are_needed():
    assert _spikes(np.array([1.0, 9.0, 1.0, 9.0]), np.zeros(4)) == (0, 0.0)
