"""What is kept of the measurements of the last metres."""

import numpy as np

from uwblite.localization import window as module
from uwblite.localization.walls import Rays
from uwblite.localization.window import Window, WindowLook, WindowRange


def look(way, stamp):
    rays = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    return WindowLook(rays, np.zeros(3), way, stamp)


def test_scans_alone_and_ranges_alone_are_forgotten_after_ten_metres():
    window = Window()
    for way in np.arange(0.0, 30.0, 0.5):
        window.add_look(look(way, way))
    assert [k.way for k in window.looks] == list(np.arange(19.5, 30.0, 0.5))
    for way in np.arange(30.0, 60.0, 0.5):
        window.add_range(WindowRange(0, 1.0, np.zeros(3), np.zeros(2), way, way))
    assert not window.looks
    assert window.ranges[0].way == 49.5


def test_a_robot_that_stands_keeps_a_scan_of_its_own_where_the_last_one_is_too_old():
    window = Window([look(4.0, 5.0)])
    assert not window.wants_look(4.0, 5.1)
    assert not window.wants_look(4.0, 5.1, 4.9)
    assert window.wants_look(4.0, 5.1, 5.0)
    assert window.wants_look(4.5, 5.1)


def test_a_robot_that_stands_keeps_one_scan_the_newest_and_one_that_creeps_keeps_its_place():
    window = Window([look(4.0, 5.0)])
    assert window.wants_look(4.02, 6.0)
    window.add_look(look(4.02, 6.0))
    assert [kept.stamp for kept in window.looks] == [6.0]
    assert not window.wants_look(4.2, 9.0)
    window.add_look(look(4.5, 10.0))
    assert [kept.stamp for kept in window.looks] == [6.0, 10.0]


def test_a_robot_that_has_gone_as_far_as_counts_keeps_both_scans():
    window = Window([look(0.0, 5.0)])
    assert not window.wants_look(module._STANDING, 60.0)
    window.add_look(look(module._STANDING, 60.0))
    assert [kept.stamp for kept in window.looks] == [5.0, 60.0]


def test_rays_are_those_of_the_last_metres_with_their_age_up_to_the_length_itself():
    window = Window()
    for way in (0.0, 0.5, 4.0, 4.5):
        rays = Rays(np.array([[way, 1.0]]), np.zeros((1, 2)), np.ones(1, bool))
        window.add_look(WindowLook(rays, np.array([way, 0.0, 0.0]), way, way))
    rays, ages = window.seen(np.array([4.5, 0.0, 0.0]), 4.5, 4.0)
    assert ages.tolist() == [4.0, 0.5, 0.0]
    np.testing.assert_allclose(rays.ends, [[-3.5, 1.0], [3.5, 1.0], [4.5, 1.0]])
    np.testing.assert_allclose(rays.origins, [[-4.0, 0.0], [-0.5, 0.0], [0.0, 0.0]])
    none, ages = window.seen(np.zeros(3), 99.0, 4.0)
    assert len(none.hit) == len(ages) == 0
