"""Factors between two sensors' motions."""

import numpy as np

from uwblite.screening.motion_ratios import factor, ratios, undiluted


def test_ratios_are_those_along_the_wheels_of_clear_motions():
    rng = np.random.default_rng(1)
    wheels, lidar = rng.normal(size=(50, 2)) * 0.1, rng.normal(size=(50, 2))
    rows, ratio = ratios(wheels, lidar, 0.08)
    expected = [k for k in range(50) if np.hypot(*wheels[k]) > 0.08]
    assert rows.tolist() == expected
    # The factor by which the wheels' motion comes nearest to the lidar's.
    np.testing.assert_allclose(ratio, [np.linalg.lstsq(wheels[k, :, None], lidar[k], rcond=None)[0][0] for k in expected])
    assert factor(wheels, lidar, 0.08) == np.median(ratio)
    assert factor(wheels[expected][:12], lidar[expected][:12], 0.0) == np.median(ratio[:12])
    assert (factor(wheels[:11], lidar[:11], 0.0), factor(wheels[:11], lidar[:11], 0.0, 7.0)) == (1.0, 7.0)


def test_noise_of_turns_that_are_chosen_by_it_makes_no_factor():
    """A robot that drives straight: of turns of 0.012 rad noise those beyond 0.03 rad are noise, and the lidar has a tenth."""
    rng = np.random.default_rng(3)
    wheels, lidar = rng.normal(0.0, 0.012, (4000, 1)), rng.normal(0.0, 0.001, (4000, 1))
    true = 0.5 * (np.arange(4000) % 100 == 0)[:, None]
    wheels, lidar = wheels + true, lidar + true
    assert factor(wheels, lidar, 0.03) < 0.2
    assert abs(undiluted(wheels, lidar, 0.03, 1.0) - 1.0) < 0.02
    assert undiluted(wheels[:5], lidar[:5], 0.0, 7.0) == 7.0
