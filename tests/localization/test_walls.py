"""Scans against walls: the factors by numeric derivatives, and what unknown space counts for."""

import dataclasses

import numpy as np
from helpers.localization_room import ODD, cast, grid_of

from uwblite import se2
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.lidar.object_likelihood import ObjectPolicy
from uwblite.localization.walls import STRANGE, Rays, walls_of

POSE = np.array([3.0, 2.5, 0.6])


def rays_from(pose):
    readings = cast(pose)
    angles = np.linspace(-np.pi / 2, np.pi / 2, len(readings))
    ends = np.minimum(readings, 8.0)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Rays(ends, np.zeros_like(ends), np.isfinite(readings))


def test_factors_are_the_numeric_gradient_of_the_kernel_s_cost():
    walls, rays = walls_of(grid_of(ODD)), rays_from(POSE)
    start, scale = POSE + np.array([0.03, -0.04, 0.01]), 0.1
    x, y = se2.transform(start, rays.ends[rays.hit]).T
    near = walls.nearest_at(x, y)
    normals, points = walls.normals[near], walls.points[near]
    facing = (normals * (start[:2] - np.column_stack([x, y]))).sum(axis=1) > 0
    good = (near >= 0) & (np.hypot(*normals.T) > 0.7)
    good &= facing | ~walls.one_sided[near]

    def cost(pose):
        off = se2.transform(pose, rays.ends[rays.hit]) - points
        r = (normals * off).sum(axis=1)[good]
        return 0.5 * np.sum(r**2 / (1.0 + np.square(r / scale)))

    gradient = [(cost(start + s) - cost(start - s)) / 2e-6 for s in np.eye(3) * 1e-6]
    hessian, spurious, found, weight = walls.factors(start[None], rays, scale)
    np.testing.assert_allclose(found[0], gradient, rtol=1e-4, atol=1e-6)
    assert np.linalg.eigvalsh(hessian[0] - 2.0 * spurious[0]).min() > 0
    assert 0 < weight[0] <= good.sum()


def test_ends_in_unknown_space_count_for_nothing_in_the_fit():
    grid, rays = grid_of(ODD), rays_from(POSE)
    right = grid.geometry.centre_of(*np.indices(grid.log_odds.shape))[..., 0] > 4.0
    cut = dataclasses.replace(grid, log_odds=np.where(right, 0.0, grid.log_odds).astype(np.float32))
    whole, half = (walls_of(g).agreement(POSE[None], rays, 15.0) for g in (grid, cut))
    assert half.known[0] < whole.known[0]
    share = half.known[0] / whole.known[0]
    np.testing.assert_allclose(half.odds, share * whole.odds, atol=0.1)


def test_what_the_map_lacks_tells_against_a_place_once_however_many_rays_meet_it():
    """A trolley of a metre before the robot, seen by ever more rays that count as independent."""
    grid, ends = grid_of(ODD), np.column_stack([np.full(40, 1.0), np.linspace(0.1, 1.1, 40)])
    rays = Rays(ends, np.zeros_like(ends), np.ones(40, bool))
    found = [walls_of(grid).agreement(POSE[None], rays, n).log_likelihood[0] for n in (0.1, 1.0, 5.0, 40.0)]
    # Few rays tell little: each as much as one that lies on no wall.
    np.testing.assert_allclose(found[0], 0.1 * np.log(STRANGE), rtol=0.15)
    assert np.all(np.diff(found) < 0.0)
    np.testing.assert_allclose(found[-1], np.log(ObjectPolicy.moves), rtol=1e-3)
    # Two things that lie apart tell two.
    both = Rays(np.concatenate([ends, ends + np.array([0.0, 2.0])]), np.zeros((80, 2)), np.ones(80, bool))
    np.testing.assert_allclose(walls_of(grid).agreement(POSE[None], both, 80.0).log_likelihood[0], 2.0 * found[-1], rtol=0.2)


def test_walls_of_another_unit_are_those_of_a_map_in_it():
    grid, g = grid_of(ODD), grid_of(ODD).geometry
    geometry = dataclasses.replace(g, resolution=1.1 * g.resolution, origin=1.1 * g.origin)
    larger = walls_of(dataclasses.replace(grid, geometry=geometry))
    scaled, rays = walls_of(grid).times(1.1), rays_from(POSE)
    place = POSE * [1.1, 1.1, 1.0]
    for one, other in zip(larger.factors(place[None], rays, 0.1), scaled.factors(place[None], rays, 0.1), strict=True):
        np.testing.assert_allclose(one, other, rtol=0.1, atol=0.1 * np.abs(one).max())
    one, other = (walls.agreement(place[None], rays, 15.0).log_likelihood for walls in (larger, scaled))
    np.testing.assert_allclose(one, other, atol=0.2)


def test_a_thin_wall_has_a_line_on_either_side_and_a_lone_post_is_a_surface_without_one():
    thick = tuple((1.0, 2.0 + d, 7.0, 2.0 + d) for d in (0.0, 0.05, 0.1, 0.15))
    walls = walls_of(grid_of((*ODD[:4], *thick, (4.02, 4.02, 4.03, 4.03))))
    x = np.linspace(1.5, 6.5, 40)
    for y, up in ((1.98, -1.0), (2.2, 1.0)):
        near = walls.nearest_at(x, np.full(40, y))
        np.testing.assert_allclose(walls.normals[near], np.tile([0.0, up], (40, 1)), atol=0.05)
        assert walls.one_sided[near].all()
    assert walls.distances(np.array([4.1]), np.array([4.0]))[0] < 0.12
    post = walls.nearest_at(np.array([4.02]), np.array([4.02]))[0]
    assert not walls.normals[post].any()


def test_the_nearest_points_are_those_of_a_search_of_all():
    walls, rng = walls_of(grid_of(ODD)), np.random.default_rng(7)
    places = rng.uniform([-0.5, -0.5], [8.5, 6.5], (400, 2))
    found = walls.distances(*places.T)
    true = np.hypot(*(places[:, None] - walls.points).transpose(2, 0, 1)).min(axis=1)
    near = true < 0.35
    # The table tells the nearest point of a cell's centre.
    np.testing.assert_allclose(found[near], true[near], atol=0.05 * np.sqrt(2.0))
    assert np.isinf(found[true > 0.6]).all()


def test_a_few_cells_of_a_wall_know_its_direction_as_well_as_their_rounding_allows():
    """Three to nine cells of straight walls of any small angle: their lines' angles err as the stated variance says."""
    rng, geometry = np.random.default_rng(4), GridGeometry(0.05, np.zeros(2), 60, 60)
    squared = []
    for _ in range(300):
        count, angle, offset = int(rng.integers(3, 10)), rng.uniform(-0.12, 0.12), rng.uniform(1.95, 2.05)
        col = np.arange(30 - count // 2, 30 - count // 2 + count)
        row = ((offset + np.tan(angle) * 0.05 * (col - 30)) / 0.05).astype(int)
        odds = np.where(np.arange(60)[:, None] < row.mean(), -4.0, 0.0) * np.ones(60)
        odds[row, col] = 4.0
        walls = walls_of(OccupancyGrid(geometry, odds.astype(np.float32)))
        lined = np.flatnonzero(np.hypot(*walls.normals.T) > 0.5)
        middle = lined[np.argmin(np.abs(walls.points[lined, 0] - 1.525))]
        normal = walls.normals[middle]
        squared.append((np.arctan2(normal[0], -normal[1]) - angle) ** 2 / walls.normal_variance[middle])
    assert 0.3 < np.mean(squared) < 2.0
