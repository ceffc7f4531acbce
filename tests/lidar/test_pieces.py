"""Straight pieces of single scans."""

import numpy as np
import pytest
from helpers.wall_rays import seen

from uwblite.lidar.pieces import straight_pieces


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
