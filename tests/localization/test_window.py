"""The newest part of what was measured."""

import numpy as np
import pytest

from uwblite.localization.walls import Rays
from uwblite.localization.window import Window, WindowLook


@pytest.mark.parametrize(("parts", "kept"), [(1, 9), (2, 4), (4, 2)])
def test_the_newest_part_of_a_window_is_of_its_time(parts, kept):
    rays = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    window = Window(looks=[WindowLook(rays, np.zeros(3), 0.4 * k, float(k)) for k in range(9)])
    assert [look.stamp for look in window.newest(parts).looks] == list(range(9 - kept, 9))
    assert not Window().newest(parts).looks


def test_a_robot_that_stands_keeps_a_scan_of_its_own_where_the_last_one_is_too_old():
    rays = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    window = Window(looks=[WindowLook(rays, np.zeros(3), 4.0, 5.0)])
    assert not window.wants_look(4.0)
    assert not window.wants_look(4.0, 4.9)
    assert window.wants_look(4.0, 5.0)
    assert window.wants_look(4.5)
