"""The width of a path by its length."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.checks.odometry import straightness


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0])
def test_a_path_is_as_wide_as_its_principal_axes_are_long(turn):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ellipse = np.column_stack([3.0 * np.cos(angle), 1.2 * np.sin(angle)])
    assert straightness(se2.rotate(turn, ellipse)) == pytest.approx(0.4)
    assert straightness(se2.rotate(turn, ellipse * [1.0, 0.0])) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_robot_that_stands_has_no_width(count):
    assert straightness(np.ones((count, 2))) == 0.0
