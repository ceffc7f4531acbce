"""Straight walls: which stretches of many clouds are one."""

import numpy as np
import pytest
from helpers.laser_walks import scanned

from uwblite import se2
from uwblite.lidar import walls as walls_module
from uwblite.lidar.stretches import stretches
from uwblite.lidar.walls import find_walls

ALONG = np.column_stack([np.arange(0.0, 6.0, 0.4), np.zeros(15), np.zeros(15)])


def walls_from(poses, walls):
    clouds = scanned(poses, np.asarray(walls, dtype=float), beams=720, reach=4.0)
    return find_walls(clouds, stretches(clouds), poses)


def test_what_is_seen_of_a_corridor_from_many_places_is_two_walls():
    found = walls_from(ALONG, [[-9.0, -1.0, 15.0, -1.0], [15.0, 1.0, -9.0, 1.0]])
    assert len(found.centre) == 2
    order = np.argsort(found.centre[:, 1])
    np.testing.assert_allclose(found.centre[order, 1], [-1.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(found.normal[order], [[0.0, 1.0], [0.0, -1.0]], atol=1e-3)
    assert {0, 1} <= set(found.of_stretch.tolist()) <= {-1, 0, 1}


def test_walls_end_at_corners_however_close_the_points_stand():
    """Half a degree apart at 2 m, normals of neighbours in a corner differ by little; every wall of a box is found whole."""
    poses = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)])
    box = [[-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 2.5], [3.0, 2.5, -3.0, 2.5], [-3.0, 2.5, -3.0, -2.0]]
    clouds = scanned(poses, np.asarray(box), beams=720, reach=5.0)
    parts = stretches(clouds)
    found = find_walls(clouds, parts, poses)
    wall = found.of_stretch[parts.of_point]
    places = se2.transform_each(poses, clouds.owner, clouds.points.astype(float))
    for axis, at, most in ((1, -2.0, 2.7), (0, 3.0, 1.7), (1, 2.5, 2.7), (0, -3.0, 1.7)):
        on_it = (np.abs(places[:, axis] - at) < 0.01) & (np.abs(places[:, 1 - axis]) < most)
        seen = on_it & (wall >= 0)
        assert seen.sum() > 0.97 * on_it.sum()
        # Points of a corner are means over cells of 5 cm, and lean on the ends of lines by a few millimetres.
        np.testing.assert_allclose(found.centre[wall[seen], axis], at, atol=5e-3)


def test_clouds_without_points_have_no_stretch_and_no_wall():
    clouds = scanned(ALONG[:3], np.array([[50.0, 50.0, 51.0, 50.0]]), beams=720, reach=4.0)
    assert len(stretches(clouds).of_point) == 0
    assert len(find_walls(clouds, stretches(clouds), ALONG[:3]).centre) == 0


@pytest.mark.parametrize(("step", "walls"), [(0.03, 1), (0.25, 2)])
def test_a_wall_ends_where_the_next_stands_back(step, walls):
    """By a door niche; by less than what a map errs by after the joint refinement, it goes on."""
    found = walls_from(ALONG, [[-9.0, 1.0, 2.0, 1.0], [2.0, 1.0 + step, 15.0, 1.0 + step]])
    assert len(found.centre) == walls


def test_a_bent_wall_is_none():
    """An arc of 12 m radius, in pieces of 10 cm, along which the robot drives."""
    angle = np.linspace(0.0, 0.7, 85)
    arc = 12.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]) + [0.0, -1.0]
    inner = np.column_stack([11.0 * np.sin(angle[::4]), 12.0 - 11.0 * np.cos(angle[::4]) - 1.0, angle[::4]])
    found = walls_from(inner, np.column_stack([arc[:-1], arc[1:]]))
    assert len(found.centre) == 0


def test_a_wall_that_poses_bend_is_found_in_straight_parts():
    """A corridor of 30 m along which the heading drifts by 0.08 rad: 0.3 m from the line in its middle."""
    x = np.arange(0.0, 30.0, 0.4)
    walls = np.array([[-9.0, -1.0, 40.0, -1.0], [40.0, 1.0, -9.0, 1.0]])
    clouds = scanned(np.column_stack([x, 0.0 * x, 0.0 * x]), walls, beams=720, reach=4.0)
    drift = 0.08 / 30.0
    parts, poses = stretches(clouds), np.column_stack([x, 0.5 * drift * x**2, drift * x])
    found = find_walls(clouds, parts, poses)
    assert 4 <= len(found.centre) <= 8
    assert np.all(found.of_stretch[parts.straight] >= 0)
    wall = found.of_stretch[parts.of_point]
    at = se2.transform_each(poses, clouds.owner, clouds.points.astype(float))[wall >= 0]
    off = np.sum((at - found.centre[wall[wall >= 0]]) * found.normal[wall[wall >= 0]], axis=1)
    assert np.abs(off).max() < 0.2


def test_walls_found_strip_by_strip_are_those_found_at_once(monkeypatch):
    """Strips of a few places each, of a hall with a column row between its long walls, seen from two aisles."""
    across = np.column_stack([np.arange(0.0, 6.0, 0.4), np.full(15, 2.5), np.full(15, 0.2)])
    poses = np.concatenate([ALONG, across])
    room = [[-3.0, -1.0, 9.0, -1.0], [9.0, -1.0, 9.0, 4.0], [9.0, 4.0, -3.0, 4.0], [-3.0, 4.0, -3.0, -1.0]]
    room += [[x, 1.0, x + 1.0, 1.0] for x in (0.0, 3.0, 6.0)] + [[x + 1.0, 1.3, x, 1.3] for x in (0.0, 3.0, 6.0)]
    whole = walls_from(poses, room)
    monkeypatch.setattr(walls_module, "_AT_ONCE", 7)
    monkeypatch.setattr(walls_module, "_POINTS_AT_ONCE", 50)
    parts = walls_from(poses, room)
    assert len(whole.centre) >= 6
    for name in ("of_stretch", "centre", "normal"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
