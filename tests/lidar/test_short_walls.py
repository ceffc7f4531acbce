"""Short walls among single rays: door jambs that clouds do not show as lines."""

import numpy as np
import pytest
from helpers.planted import cast

from uwblite import se2
from uwblite.lidar.short_walls import pieces_of, walls_of
from uwblite.odometry.attached import ScanPoints

JAMBS = np.array([[1.0, 1.2, 1.0, 1.45], [2.0, 1.45, 2.0, 1.2]])
DOORWAY = np.concatenate(
    [[[-6.0, 1.2, 1.0, 1.2], [2.0, 1.2, 8.0, 1.2], [1.0, 1.45, -6.0, 1.45], [8.0, 1.45, 2.0, 1.45]], JAMBS]
)
POSES = np.column_stack([np.linspace(-1.5, 4.5, 21), np.full(21, 0.1), np.linspace(-0.4, 0.4, 21)])


def seen(walls, poses, noise, seed=0, beams=1000):
    """Return the rays of one scan from each pose, with noise as a share of the distance."""
    bearings = np.tile(np.linspace(-3.1, 3.1, beams), len(poses))
    scan, ray = np.divmod(np.arange(len(bearings)), beams)
    reach = cast(poses[scan], bearings, walls)
    hit = reach < 5.6
    reach, bearings = reach[hit], bearings[hit]
    reach = reach + noise * np.maximum(reach, 1.0) * np.random.default_rng(seed).standard_normal(len(reach))
    points = reach[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    return ScanPoints(scan[hit], points, np.zeros_like(points), ray[hit], scan[hit])


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_jambs_of_a_doorway_are_found_where_they_stand(noise):
    rays = seen(DOORWAY, POSES, noise)
    pieces, on = pieces_of(rays, np.ones(len(rays.keyframe), dtype=bool))
    walls = walls_of(pieces, POSES)
    for x, facing in ((1.0, 1.0), (2.0, -1.0)):
        near = (np.abs(walls.centre - [x, 1.325]) < [0.03, 0.1]).all(axis=1)
        jamb = np.flatnonzero(near & (facing * walls.normal[:, 0] > 0.95))
        assert len(jamb) == 1
        own = on.renumbered(walls.of_stretch)
        own = own.rows(own.surface == jamb[0])
        at = se2.transform_each(POSES, own.keyframe, own.points)
        # The mean of up to four rays each, some of which are of the corners.
        assert np.abs(np.median(at[:, 0]) - x) < 2.0 * noise
        assert np.mean(np.abs(at[:, 0] - x) < 0.02 + 3.0 * noise) > 0.95


def test_a_bent_surface_is_split_into_straight_pieces():
    """Three sides of a cupboard at once: no piece joins two of them."""
    cupboard = np.array([[1.0, -0.6, 1.0, 0.0], [1.0, 0.0, 0.7, 0.5], [0.7, 0.5, 0.1, 0.8]])
    rays = seen(cupboard, np.zeros((1, 3)), 0.005)
    pieces, on = pieces_of(rays, np.ones(len(rays.keyframe), dtype=bool))
    normals = np.array([[-1.0, 0.0], [-0.5, -0.3] / np.hypot(0.5, 0.3), [-0.3, -0.6] / np.hypot(0.3, 0.6)])
    leaning = np.arccos(np.clip((pieces.normal @ normals.T).max(axis=1), -1.0, 1.0))
    assert np.all(leaning < 4.0 * pieces.deviation)
    assert len(np.unique((pieces.normal @ normals.T).argmax(axis=1))) == 3
    assert np.all(np.bincount(on.surface) > 0)


def test_rays_that_are_not_free_make_no_piece():
    rays = seen(DOORWAY, POSES[:3], 0.01)
    pieces, on = pieces_of(rays, np.zeros(len(rays.keyframe), dtype=bool))
    assert len(pieces.keyframe) == len(on.keyframe) == 0
    assert len(walls_of(pieces, POSES).centre) == 0


def test_what_one_keyframe_shows_is_no_wall():
    rays = seen(DOORWAY, POSES[:1], 0.005)
    pieces, _ = pieces_of(rays, np.ones(len(rays.keyframe), dtype=bool))
    assert len(pieces.keyframe) > 0
    assert np.all(walls_of(pieces, POSES).of_stretch == -1)
