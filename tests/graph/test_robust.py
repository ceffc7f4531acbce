import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.errors import ConfigError
from uwblite.graph.robust import KERNELS, SQUARED, Kernel

SQUARES = np.concatenate([[0.0], np.logspace(-8, 8, 400)])
scales = st.floats(0.05, 50.0)
names = st.sampled_from(KERNELS)


@given(names, scales)
def test_weight_is_the_derivative_of_rho(name, scale):
    kernel = Kernel(name, scale)
    s = np.logspace(-3, 3, 61) * scale**2 * 1.00123  # not on the kink
    step = 1e-6 * s
    slope = (kernel.rho(s + step) - kernel.rho(s - step)) / (2 * step)
    # Rounding of rho, at most s itself, over a step of 1e-6 s leaves about 1e-9.
    np.testing.assert_allclose(kernel.weight(s), slope, atol=1e-6)


@given(names, scales)
def test_small_residuals_are_squared(name, scale):
    kernel = Kernel(name, scale)
    s = np.array([0.0, 1e-8, 1e-6]) * scale**2
    np.testing.assert_allclose(kernel.rho(s), s, rtol=2e-6)
    np.testing.assert_allclose(kernel.weight(s), 1.0, atol=1e-5)


@given(names, scales)
def test_weights_fall_from_one_towards_the_limit(name, scale):
    kernel = Kernel(name, scale)
    weight = kernel.weight(SQUARES * scale**2)
    assert weight[0] == 1.0
    assert np.all(np.diff(weight) <= 1e-15)
    assert np.all((weight >= 0.0) & (weight <= 1.0))


@given(names, scales)
def test_rho_grows_and_never_exceeds_the_square(name, scale):
    kernel = Kernel(name, scale)
    s = SQUARES * scale**2
    rho = kernel.rho(s)
    assert np.all(np.diff(rho) >= -1e-12 * scale**2)
    # Rounding of rho(s) = k^2 f(s / k^2) is relative to k^2.
    assert np.all(rho <= s * (1.0 + 1e-12) + 1e-15 * scale**2)


def test_a_redescending_kernel_is_bounded():
    kernel = Kernel("geman-mcclure", 3.0)
    assert kernel.rho(np.array(1e12)) == pytest.approx(9.0)
    assert kernel.weight(np.array(1e12)) == pytest.approx(0.0, abs=1e-9)


def test_closed_forms_at_twice_the_scale():
    at = np.array(4.0)  # norm 2 at scale 1
    expected = {"none": 4.0, "huber": 3.0, "cauchy": np.log(5.0), "geman-mcclure": 0.8}
    for name, value in expected.items():
        assert Kernel(name, 1.0).rho(at) == pytest.approx(value)


def test_kernels_are_checked():
    with pytest.raises(ConfigError, match="hubert"):
        Kernel("hubert")
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="must be > 0"):
            Kernel("huber", scale)
    assert SQUARED.rho(np.array(7.0)) == 7.0
