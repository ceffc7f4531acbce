"""Maps in another unit: the scale is measured from where the map fits best, and a pose in such a map is never certain."""

import dataclasses

import numpy as np
import pytest
from helpers.localization_room import ANCHORS, ODD, ROUND, cast, grid_of, known, path, robot

from uwblite import se2
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.localization.range_model import Ranges
from uwblite.localization.verdict import other_unit
from uwblite.localization.walls import Rays, walls_of

POSES = np.array([[1.0, 2.5, 0.0], [2.0, 2.5, 0.4], [3.0, 2.6, 0.9]])
NO_RANGES = Ranges(np.zeros(0, np.intp), *np.zeros((2, 0, 2)), *np.zeros((5, 0)))


def enlarged(room, factor):
    """Return the room as a map in another unit: cells, walls and anchors."""
    grid = grid_of(ODD)
    g = grid.geometry
    geometry = dataclasses.replace(g, resolution=g.resolution * factor, origin=g.origin * factor)
    anchors = dataclasses.replace(room.anchors, positions=room.anchors.positions * factor)
    return dataclasses.replace(room, anchors=anchors, walls=walls_of(dataclasses.replace(grid, geometry=geometry)))


def rays_of(poses, way=1.0):
    """Return the scans from poses (n, 3) in the frame of the last one; way: what the wheels make of a metre."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    ends, origins, hit = [], [], []
    for pose in poses:
        readings = cast(pose)
        seen = np.isfinite(readings)
        there = se2.between(poses[-1], pose) * [way, way, 1.0]
        points = np.where(seen, readings, 0.0)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ends.append(se2.transform(there, points))
        origins.append(np.tile(there[:2], (len(points), 1)))
        hit.append(seen)
    return Rays(*(np.concatenate(v) for v in (ends, origins, hit)))


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("way", [1.0, 1.03])
def test_scans_tell_how_much_larger_the_map_is_whatever_the_wheels_count(factor, way):
    walls = enlarged(known(), factor).walls
    found = other_unit(walls, POSES[-1] * [factor, factor, 1.0], rays_of(POSES, way), 45.0, NO_RANGES)
    assert found == "" if factor == 1.0 else abs(float(found.split()[5]) - factor) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_a_single_wall_fits_every_metre_and_none_is_certain(seed):
    rng = np.random.default_rng(seed)
    log_odds = np.full((200, 300), -4.0, dtype=np.float32)
    log_odds[158:160], log_odds[160:] = 4.0, 0.0
    walls = walls_of(OccupancyGrid(GridGeometry(0.05, np.zeros(2), 200, 300), log_odds))
    poses = np.column_stack([np.linspace(4.0, 7.0, 9), np.full(9, 3.3), np.full(9, 0.6)])
    angles = np.linspace(-0.2, 1.6, 14)
    ends, origins = [], []
    for pose in poses:
        far = (7.9 - pose[1]) / np.sin(angles + pose[2]) + rng.normal(0.0, 0.03, len(angles))
        there = se2.between(poses[-1], pose)
        ends.append(se2.transform(there, far[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)))
        origins.append(np.tile(there[:2], (len(angles), 1)))
    rays = Rays(np.concatenate(ends), np.concatenate(origins), np.ones(9 * len(angles), dtype=bool))
    start = poses[-1] + rng.normal(0.0, [0.03, 0.03, 0.01])
    assert "not known" in other_unit(walls, start, rays, 45.0, NO_RANGES)


def ranges_at(poses, factor, moved=0.0):
    """Return ranges without noise to all anchors of a map in another unit, of which one was moved."""
    places = np.array(list(ANCHORS.values()))
    tags = np.repeat(se2.between(poses[-1], poses)[:, :2], len(places), axis=0)
    true = np.hypot(*(poses[:, None, :2] - places - [moved, 0.0] * (np.arange(4) == 1)[:, None]).reshape(-1, 2).T)
    where = np.tile(places * factor, (len(poses), 1))
    noise = np.full(len(true), 0.1), np.arange(len(true)) / 4.0, np.full(len(true), 0.07), np.full(len(true), 1.5)
    return Ranges(np.tile(np.arange(4), len(poses)), where, tags, true, *noise)


def test_ranges_measure_it_too_and_a_moved_anchor_is_no_other_unit():
    poses = path(((1.0, 1.0), (6.0, 1.0), (6.0, 5.0), (2.0, 5.0)))[::5]
    no_rays = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    for factor in (0.9, 1.0, 1.1):
        found = other_unit(None, poses[-1] * [factor, factor, 1.0], no_rays, 0.0, ranges_at(poses, factor))
        assert found == "" if factor == 1.0 else abs(float(found.split()[5]) - factor) < 0.02
    assert "times" not in other_unit(None, poses[-1], no_rays, 0.0, ranges_at(poses, 1.0, moved=-2.0))


@pytest.mark.parametrize("count", [40, 400])
def test_ranges_that_fit_without_error_are_in_the_unit_of_the_map(count):
    """Of a robot that drives in a small circle, however many: that sigmas are long says nothing about the unit."""
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    poses = np.column_stack([4.0 + 1.5 * np.cos(angle), 3.0 + 1.5 * np.sin(angle), angle + 0.5 * np.pi])
    no_rays = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    ranges = ranges_at(poses, 1.0)
    sigma, white = np.full(len(ranges), 0.25), np.full(len(ranges), 0.05)
    drifted = dataclasses.replace(ranges, sigma=sigma, white=white, way=1.5 * np.repeat(angle, 4))
    assert other_unit(None, poses[-1], no_rays, 0.0, drifted) == ""


@pytest.mark.parametrize(("factor", "sound"), [(0.97, True), (1.03, True), (1.05, False)])
def test_scans_allow_the_error_of_a_data_sheet_and_no_more(factor, sound):
    walls = enlarged(known(), factor).walls
    found = other_unit(walls, POSES[-1] * [factor, factor, 1.0], rays_of(POSES), 45.0, NO_RANGES)
    assert (found == "") == sound


@pytest.mark.slow
@pytest.mark.parametrize("scans", [True, False])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_map_of_another_scale_is_never_certain(factor, scans):
    drive = robot(enlarged(known(), factor))
    assert all(s.lost for s in drive.along(path(ROUND), scans=scans))
