"""Noise of rays as residuals show it: planted scales, planted errors of places."""

import numpy as np
import pytest

from uwblite.lidar.ray_equations import learnt_noise
from uwblite.lidar.surface_rays import UNLEARNT, ShapePolicy

SURFACES, PLACES, EACH = 40, 12, 30
"""Each surface has so many places, and each place so many rays."""


def planted(own, shared, seed=0):
    """Return residuals with noise of each ray and of each place, and place and surface of each."""
    rng = np.random.default_rng(seed)
    surface = np.repeat(np.arange(SURFACES), PLACES * EACH)
    place = np.tile(np.repeat(np.arange(PLACES) - 3, EACH), SURFACES)
    of_place = np.repeat(rng.standard_normal(SURFACES * PLACES), EACH)
    return own * rng.standard_normal(len(surface)) + shared * of_place, place, surface


@pytest.mark.parametrize("true", [0.3, 1.0, 1.5])
def test_the_noise_is_the_one_planted(true):
    residual, place, surface = planted(1.0, 0.0)
    noise = learnt_noise(residual * true, place, surface, np.zeros(SURFACES, dtype=bool))
    # Relative standard deviation of a median absolute deviation of n normal values: 1.17 / sqrt(n).
    assert noise.ratio == pytest.approx(true, rel=4.0 * 1.17 / np.sqrt(len(residual)))
    few = learnt_noise(residual[:50], place[:50], surface[:50], np.zeros(SURFACES, dtype=bool))
    assert few.ratio == UNLEARNT.ratio


@pytest.mark.parametrize("shared", [0.0, 0.2, 0.5])
def test_what_rays_of_a_place_have_in_common_counts_against_them(shared):
    """The variance of a sum of n residuals with a common part c is n (1 + (n - 1) c); half of the surfaces are columns."""
    residual, place, surface = planted(np.sqrt(1.0 - shared**2), shared, seed=3)
    curved = np.arange(SURFACES) >= SURFACES // 2
    noise = learnt_noise(residual, place, surface, curved)
    expected = 1.0 + (EACH - 1) * shared**2
    # Relative standard deviation of a mean of chi2 over the places of one kind, and what the fit would have taken away.
    spread = 4.0 * np.sqrt(2.0 / (SURFACES / 2 * PLACES))
    assert noise.alike[0] == pytest.approx(expected * PLACES / (PLACES - 2), rel=spread)
    assert noise.alike[1] == pytest.approx(expected * PLACES / (PLACES - 3), rel=spread)


def test_surfaces_of_few_places_show_nothing():
    residual, place, surface = planted(1.0, 0.5)
    noise = learnt_noise(residual, place % 4, surface, np.zeros(SURFACES, dtype=bool))
    np.testing.assert_array_equal(noise.alike, ShapePolicy.alike)


def test_outliers_change_little():
    residual, place, surface = planted(1.0, 0.0, seed=5)
    residual[::50] += 40.0 * np.sign(residual[::50])
    noise = learnt_noise(residual, place, surface, np.zeros(SURFACES, dtype=bool))
    assert noise.ratio == pytest.approx(1.0, abs=0.08)
    assert noise.alike[0] < 2.0
