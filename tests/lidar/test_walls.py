"""Straight pieces of single scans; which pieces of many scans are one wall, and the rays on them."""

import dataclasses

import numpy as np
import pytest
from helpers.wall_rays import seen

from uwblite import se2
from uwblite.lidar.walls import Pieces, WallPolicy, find_walls, straight_pieces

ALONG = np.column_stack([np.arange(0.0, 6.0, 0.4), np.zeros(15), np.zeros(15)])


def walls_from(poses, walls, noise=0.0, drawn=None):
    """Return the walls that scans from poses show in a map where these are as drawn, and the rays on them there."""
    pieces, on = straight_pieces(seen(walls, poses, noise, beams=720, reach=4.0))
    poses = poses if drawn is None else drawn
    found = find_walls(pieces, poses, np.ones(len(pieces.length), dtype=bool))
    on = on.renumbered(found.of_piece)
    return found, on.surface, se2.transform_each(poses, on.keyframe, on.points)


def test_what_is_seen_of_a_corridor_from_many_places_is_two_walls():
    found = walls_from(ALONG, [[-9.0, -1.0, 15.0, -1.0], [15.0, 1.0, -9.0, 1.0]])[0]
    assert len(found.centre) == 2
    order = np.argsort(found.centre[:, 1])
    np.testing.assert_allclose(found.centre[order, 1], [-1.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(found.normal[order], [[0.0, 1.0], [0.0, -1.0]], atol=1e-3)
    assert set(found.of_piece.tolist()) == {0, 1}


JAMBS = [[1.0, 1.2, 1.0, 1.45], [2.0, 1.45, 2.0, 1.2]]
DOORWAY = [[-6.0, 1.2, 1.0, 1.2], [2.0, 1.2, 8.0, 1.2], [1.0, 1.45, -6.0, 1.45], [8.0, 1.45, 2.0, 1.45], *JAMBS]
PASSING = np.column_stack([np.linspace(-1.5, 4.5, 21), np.full(21, 0.1), np.linspace(-0.4, 0.4, 21)])


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_jambs_of_a_doorway_are_walls_where_they_stand(noise):
    found, wall, at = walls_from(PASSING, DOORWAY, noise)
    for x, facing in ((1.0, 1.0), (2.0, -1.0)):
        near = (np.abs(found.centre - [x, 1.325]) < [0.03, 0.1]).all(axis=1)
        jamb = np.flatnonzero(near & (facing * found.normal[:, 0] > 0.95))
        assert len(jamb) == 1
        off = at[wall == jamb[0], 0] - x
        # The mean of up to four rays each, some of which are of the corners.
        assert np.abs(np.median(off)) < 2.0 * noise
        assert np.mean(np.abs(off) < 0.02 + 3.0 * noise) > 0.95


def test_every_wall_of_a_box_is_one_up_to_its_corners():
    poses = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)])
    box = [[-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 2.5], [3.0, 2.5, -3.0, 2.5], [-3.0, 2.5, -3.0, -2.0]]
    found, wall, places = walls_from(poses, box)
    # What is right behind the robot is not seen, and the wall there may be two.
    assert len(found.centre) <= 5
    for axis, at, most in ((1, -2.0, 2.7), (0, 3.0, 1.7), (1, 2.5, 2.7), (0, -3.0, 1.7)):
        on_it = (np.abs(places[:, axis] - at) < 0.01) & (np.abs(places[:, 1 - axis]) < most)
        assert len(np.unique(wall[on_it])) == (2 if at == -3.0 else 1)
        np.testing.assert_allclose(found.centre[wall[on_it], axis], at, atol=2e-3)


@pytest.mark.parametrize("keyframes", [0, 3])
def test_what_few_keyframes_show_is_no_wall(keyframes):
    found, wall, _ = walls_from(ALONG[:keyframes], [[-9.0, -1.0, 15.0, -1.0]])
    assert len(found.centre) == len(wall) == 0
    assert np.all(found.of_piece == -1)


def test_pieces_that_are_left_out_are_of_no_wall():
    pieces = straight_pieces(seen([[-9.0, -1.0, 15.0, -1.0], [15.0, 1.0, -9.0, 1.0]], ALONG))[0]
    left = pieces.normal[:, 1] > 0.0
    found = find_walls(pieces, ALONG, left)
    assert len(found.centre) == 1
    np.testing.assert_array_equal(found.of_piece, np.where(left, 0, -1))


@pytest.mark.parametrize(("step", "walls"), [(0.03, 1), (0.25, 2)])
def test_a_wall_ends_where_the_next_stands_back(step, walls):
    """By a door niche; by less than what a map errs by after the joint refinement, it goes on."""
    found = walls_from(ALONG, [[-9.0, 1.0, 2.0, 1.0], [2.0, 1.0 + step, 15.0, 1.0 + step]], 0.01)[0]
    assert len(found.centre) == walls


def test_a_bent_wall_is_none():
    """An arc of 6 m radius, in pieces of 5 cm, along which the robot drives."""
    angle = np.linspace(0.0, 1.4, 170)
    arc = 6.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]) + [0.0, -1.0]
    inner = np.column_stack([5.0 * np.sin(angle[::8]), 6.0 - 5.0 * np.cos(angle[::8]) - 1.0, angle[::8]])
    found = walls_from(inner, np.column_stack([arc[:-1], arc[1:]]), 0.003)[0]
    assert len(found.centre) == 0


def test_stems_that_look_flat_from_every_side_are_hardly_walls(monkeypatch):
    """Stems of 9 cm radius along an aisle: few rays on each show no curvature, and what is seen of it turns with the view."""
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    rings = [0.09 * np.column_stack([np.cos(angle), np.sin(angle)]) + [x, y] for x in (1.5, 3.0, 4.5) for y in (-1.5, 1.5)]
    stems = np.concatenate([np.column_stack([ring[:-1], ring[1:]]) for ring in rings])
    poses = np.column_stack([np.arange(0.0, 6.0, 0.2), np.zeros(30), np.zeros(30)])
    pieces = straight_pieces(seen(stems, poses, 0.01, beams=720, reach=4.0))[0]
    every = np.ones(len(pieces.length), dtype=bool)
    # One of the six hardly turns, within its noise.
    assert len(find_walls(pieces, poses, every).centre) <= 1
    monkeypatch.setattr(WallPolicy, "turned", np.inf)
    assert len(find_walls(pieces, poses, every).centre) >= 5


def test_a_wall_that_poses_bend_is_found_in_straight_parts():
    """A corridor of 30 m along which the heading drifts by 0.08 rad: 0.3 m from the line in its middle."""
    x = np.arange(0.0, 30.0, 0.4)
    drift = 0.08 / 30.0
    drawn = np.column_stack([x, 0.5 * drift * x**2, drift * x])
    corridor = [[-9.0, -1.0, 40.0, -1.0], [40.0, 1.0, -9.0, 1.0]]
    found, wall, at = walls_from(np.column_stack([x, 0.0 * x, 0.0 * x]), corridor, drawn=drawn)
    assert 4 <= len(found.centre) <= 8
    assert np.all(found.of_piece >= 0)
    off = np.sum((at - found.centre[wall]) * found.normal[wall], axis=1)
    assert np.abs(off).max() < 0.3


def test_of_a_thousand_walls_in_a_row_none_is_cut_or_joined():
    """Of 3 m each, 2 m apart: so many places that they are compared strip by strip, which end within walls."""
    views, count = 6, 1000
    keyframe, wall = np.divmod(np.arange(views * count), count)
    centre = np.column_stack([5.0 * wall + 0.013 * keyframe, np.zeros(len(wall))])
    pieces = Pieces(keyframe, centre, np.tile([0.0, 1.0], (len(wall), 1)), np.full(len(wall), 3.0), np.full(len(wall), 0.01))
    found = find_walls(pieces, np.zeros((views, 3)), np.ones(len(wall), dtype=bool))
    assert len(found.centre) == count
    assert all(len(set(of.tolist())) == 1 for of in found.of_piece.reshape(views, count).T)
    np.testing.assert_allclose(found.normal, np.tile([0.0, 1.0], (count, 1)), atol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_wall_is_one_piece_and_its_rays_are_bundled_and_lie_on_it(noise):
    rays = seen([[-9.0, 1.0, 9.0, 1.0]], np.zeros((1, 3)), noise, beams=720, reach=4.0)
    pieces, on = straight_pieces(rays)
    assert len(pieces.length) == 1
    np.testing.assert_allclose(pieces.normal, [[0.0, -1.0]], atol=0.01)
    assert pieces.length[0] == pytest.approx(2.0 * np.sqrt(15.0), rel=0.03)
    np.testing.assert_allclose(pieces.centre, [[0.0, 1.0]], atol=0.1)
    assert len(on.keyframe) == pytest.approx(len(rays.ray) / 4, abs=4)
    off = on.points[:, 1] - 1.0
    assert np.abs(off).max() < max(5.0 * 0.5 * noise, 1e-9) + 1e-9
    # Means of four rays, of 1 cm at the nearest.
    assert on.sigma.min() == pytest.approx(0.005, rel=0.02)


def test_a_bent_surface_is_split_into_straight_pieces():
    """Three sides of a cupboard at once: no piece joins two of them."""
    cupboard = [[1.0, -0.6, 1.0, 0.0], [1.0, 0.0, 0.7, 0.5], [0.7, 0.5, 0.1, 0.8]]
    pieces, on = straight_pieces(seen(cupboard, np.zeros((1, 3)), 0.005))
    normals = np.array([[-1.0, 0.0], [-0.5, -0.3] / np.hypot(0.5, 0.3), [-0.3, -0.6] / np.hypot(0.3, 0.6)])
    leaning = np.arccos(np.clip((pieces.normal @ normals.T).max(axis=1), -1.0, 1.0))
    assert np.all(leaning < 4.0 * pieces.deviation)
    assert len(np.unique((pieces.normal @ normals.T).argmax(axis=1))) == 3
    assert np.all(np.bincount(on.surface) > 0)


def test_the_stated_deviation_of_a_direction_is_that_of_many_scans():
    walls, poses = [[-1.0, 2.0, 0.5, 2.2]], np.zeros((1, 3))
    true = np.arctan2(-1.5, 0.2)
    turns, stated = [], []
    for seed in range(200):
        pieces, _ = straight_pieces(seen(walls, poses, 0.01, seed))
        if len(pieces.length) == 1:
            turns.append(np.arctan2(*pieces.normal[0, ::-1]) - true)
            stated.append(pieces.deviation[0])
    assert len(turns) > 190
    # Relative standard deviation of a standard deviation of n values: 1 / sqrt(2 n).
    assert np.std(turns) == pytest.approx(np.mean(stated), rel=0.2)


def test_a_step_of_a_few_standard_deviations_ends_a_piece():
    """A door niche of 0.1 m behind a wall, seen from ahead: rays on both sides of its edge are of two pieces."""
    pieces, on = straight_pieces(seen([[-3.0, 2.0, 0.0, 2.0], [0.0, 2.1, 3.0, 2.1]], np.zeros((1, 3)), 0.005))
    depth = on.points[:, 1]
    for k in range(len(pieces.length)):
        assert np.ptp(np.round((depth[on.surface == k] - 2.0) / 0.1)) == 0
    assert {0.0, 1.0} == set(np.round((depth - 2.0) / 0.1).tolist())


def test_neighbours_that_are_apart_and_few_rays_make_no_piece():
    behind = [[-0.01, 1.0, 0.0, 1.0], [0.0, 2.0, 0.01, 2.0]]
    pieces, on = straight_pieces(seen(behind, np.zeros((1, 3)), 0.002, beams=600))
    assert len(pieces.length) == len(on.keyframe) == 0
    pieces, on = straight_pieces(seen([[50.0, 50.0, 51.0, 50.0]], np.zeros((2, 3))))
    assert len(pieces.length) == len(on.keyframe) == 0


@pytest.mark.parametrize(("apart", "pieces"), [(0.27, 1), (0.42, 0)])
def test_rays_farther_apart_than_a_third_of_a_metre_are_of_no_piece(apart, pieces):
    """A wall 4 m away that is hit every so many metres: such hits in a row are a piece, or as many of one each."""
    beams = round(6.2 * 4.0 / apart) + 1
    found, _ = straight_pieces(seen([[-1.6, 4.0, 1.6, 4.0]], np.zeros((1, 3)), 0.0, beams=beams))
    assert len(found.length) == pieces


@pytest.mark.parametrize("wall", [[2.0, -0.7, 3.5, -0.7], [0.1, -0.3, 4.0, -0.3]])
def test_rays_count_down_to_a_cosine_of_incidence_of_a_seventh(wall):
    """All of a wall 0.7 m beside the way, from 2 to 3.5 m ahead; of one beside the robot 2 m of 4."""
    pieces, on = straight_pieces(seen([wall], np.zeros((1, 3)), beams=5760, reach=6.0))
    assert len(pieces.length) == 1
    aside = -wall[1]
    farthest = min(wall[2], aside * np.sqrt(0.15**-2 - 1.0))
    assert on.points[:, 0].max() == pytest.approx(farthest, rel=0.05)


@pytest.mark.parametrize(("wall", "noise", "count"), [
    ([[1.0, -1.0, 4.0, -1.0]], 0.01, 1), ([[3.0, -0.35, 5.0, -0.35]], 0.01, 0), ([[2.0, -0.12, 2.0, 0.12]], 0.06, 0),
])  # fmt: skip
def test_a_grazed_wall_and_one_of_vague_direction_are_no_pieces(wall, noise, count):
    """Readings at a grazing angle err; a narrow post seen by a bad lidar shows no direction."""
    pieces, _ = straight_pieces(seen(wall, np.zeros((1, 3)), noise, beams=2880, reach=6.0))
    assert len(pieces.length) == count


@pytest.mark.parametrize("moved", [[0.3, -0.2, 0.0], [-2.0, 5.0, 2.0]])
def test_pieces_do_not_depend_on_the_frame_of_the_rays(moved):
    """The laser sits anywhere on the robot, and moves while it turns: noise goes by the lengths of rays."""
    rays = seen([[-3.0, 2.0, 3.0, 2.5], [3.0, 2.5, 3.0, -2.0]], np.zeros((1, 3)), 0.008)
    pieces, on = straight_pieces(rays)
    T = np.array(moved)
    there = dataclasses.replace(rays, points=se2.transform(T, rays.points), origins=se2.transform(T, rays.origins))
    again, on_again = straight_pieces(there)
    assert len(pieces.length) >= 2
    np.testing.assert_allclose(again.centre, se2.transform(T, pieces.centre), atol=1e-6)
    np.testing.assert_allclose(again.normal, se2.rotate(T[2], pieces.normal), atol=1e-6)
    np.testing.assert_allclose(again.deviation, pieces.deviation, rtol=1e-5)
    np.testing.assert_allclose(again.length, pieces.length, atol=1e-6)
    np.testing.assert_allclose(on_again.sigma, on.sigma, rtol=1e-5)
    np.testing.assert_array_equal(on_again.surface, on.surface)
