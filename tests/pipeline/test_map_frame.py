"""Alignment and cropping: angles are found, chi2 stays, cells keep their places."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_tasks import estimate_of, task_of
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import ConfigError, DataError
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.lidar.cloud_rasters import ScanClouds
from uwblite.lidar.clouds import Clouds
from uwblite.pipeline.map_frame import ALIGNMENTS, _quarter, alignment, alignment_of, cropped, moved, wall_direction
from uwblite.pipeline.mapping_config import MappingConfig

RNG = np.random.default_rng(2)


def walls(angle, *, clutter=0.0, n=2000):
    """Normals of walls at right angles, with two degrees of noise and a share of clutter."""
    directions = angle + np.pi / 2 * RNG.integers(0, 4, n) + RNG.normal(0, np.radians(2), n)
    directions = np.where(RNG.uniform(size=n) < clutter, RNG.uniform(-np.pi, np.pi, n), directions)
    return np.stack([np.cos(directions), np.sin(directions)], axis=1)


@given(st.floats(-np.pi, np.pi))
def test_the_walls_direction_is_found(angle):
    found = wall_direction(walls(angle, clutter=0.3))
    # Two degrees over some 1400 normals: 0.06 degrees; clutter of 30 % doubles it at most.
    assert abs(se2.wrap_angle(4 * (found - angle))) / 4 < np.radians(0.3)
    assert -np.pi / 4 < found <= np.pi / 4


def test_slanting_walls_in_the_minority_do_not_count():
    normals = np.concatenate([walls(0.1, n=1500), walls(0.5, n=700)])
    assert wall_direction(normals) == pytest.approx(0.1, abs=0.01)


def test_points_without_a_normal_are_left_out():
    normals = np.concatenate([walls(0.2), np.zeros((5000, 2))])
    assert wall_direction(normals) == pytest.approx(0.2, abs=0.005)
    with pytest.raises(DataError, match="no walls"):
        wall_direction(np.zeros((4, 2)))


def graph():
    poses = RNG.uniform(-3, 3, (6, 3))
    anchors = RNG.uniform(-5, 5, (3, 2))
    i = np.arange(5)
    chain = RelativePoseEdges(i, i + 1, RNG.uniform(-1, 1, (5, 3)), RNG.uniform(-1, 1, (5, 3, 3)))
    pinned = PriorEdges("poses", np.array([2]), RNG.uniform(-1, 1, (1, 3)), RNG.uniform(-1, 1, (1, 3, 3)))
    surveyed = PriorEdges("anchors", np.array([0, 2]), RNG.uniform(-1, 1, (2, 2)), RNG.uniform(-1, 1, (2, 2, 2)))
    return Graph(poses, anchors, (chain, pinned, surveyed))


@pytest.mark.parametrize("how", ALIGNMENTS)
def test_moving_the_frame_changes_no_chi2_and_no_distance(how):
    before = graph()
    T = alignment(how, before, np.array([True, False, True]), walls(0.3))
    after = moved(before, T)
    assert after.chi2() == pytest.approx(before.chi2(), rel=1e-12)
    np.testing.assert_allclose(
        se2.between(after.poses[:-1], after.poses[1:]), se2.between(before.poses[:-1], before.poses[1:]), atol=1e-12
    )
    np.testing.assert_allclose(
        se2.transform(se2.inverse(after.poses[0]), after.anchors), se2.transform(se2.inverse(before.poses[0]), before.anchors)
    )


def test_each_alignment_does_what_it_reports():
    before = graph()
    placed = np.array([True, False, True])
    assert np.array_equal(moved(before, alignment("odometry", before, placed, walls(0.3))).poses, before.poses)
    first = moved(before, alignment("first-pose", before, placed, walls(0.3)))
    np.testing.assert_allclose(first.poses[0], 0, atol=1e-12)
    anchored = moved(before, alignment("anchors", before, placed, walls(0.3)))
    np.testing.assert_allclose(anchored.anchors[0], 0, atol=1e-12)
    np.testing.assert_allclose(anchored.anchors[2, 1], 0, atol=1e-12)
    assert anchored.anchors[2, 0] > 0
    T = alignment("walls", before, placed, walls(0.3))
    along = moved(before, T)
    np.testing.assert_allclose(along.poses[0, :2], 0, atol=1e-12)
    assert abs(along.poses[0, 2]) <= np.pi / 4
    assert wall_direction(se2.rotate(T[2], walls(0.3))) == pytest.approx(0, abs=0.005)
    with pytest.raises(ConfigError, match="choose one of"):
        alignment("north", before, placed, walls(0.3))
    with pytest.raises(DataError, match="two placed anchors"):
        alignment("anchors", before, np.array([True, False, False]), walls(0.3))


def test_cropping_keeps_the_cells_where_they_are():
    grid = OccupancyGrid(GridGeometry(0.1, np.array([-2.0, 1.0]), 50, 40), RNG.normal(size=(50, 40)).astype(np.float32))
    part = cropped(grid, (-1.5, 2.0, 0.0, 3.05))
    assert (part.geometry.rows, part.geometry.cols) == (11, 15)
    np.testing.assert_allclose(part.geometry.origin, (-1.5, 2.0))
    row, col = np.mgrid[0:11, 0:15]
    where = part.geometry.centre_of(row, col)
    np.testing.assert_array_equal(part.log_odds, grid.log_odds[grid.geometry.cell_of(where)])
    whole = cropped(grid, (-100, -100, 100, 100))
    assert np.array_equal(whole.log_odds, grid.log_odds)
    np.testing.assert_array_equal(whole.geometry.origin, grid.geometry.origin)
    for box in ((5, 5, 6, 6), (0, 2, -1, 3), (0, 2, 0, 3)):
        with pytest.raises(ConfigError, match="holds no cell; the map reaches from"):
            cropped(grid, box)
    assert replace(grid, scans_used=3).scans_used == 3


@pytest.mark.parametrize("shift", [0.0, 5e5, 5e6])
def test_a_box_along_edges_of_cells_holds_these_also_far_from_the_origin(shift):
    """Of projected coordinates: rounding there is a billionth of a metre."""
    grid = OccupancyGrid(GridGeometry(0.05, np.array([shift, shift]), 40, 40), np.zeros((40, 40), np.float32))
    for first in range(30):
        part = cropped(grid, tuple(shift + 0.05 * np.array([first, first, first + 10, first + 10])))
        assert (part.geometry.rows, part.geometry.cols) == (10, 10)
        np.testing.assert_allclose(part.geometry.origin, shift + 0.05 * first, rtol=0.0, atol=1e-6)


@given(st.floats(-10.0, 10.0))
def test_an_angle_is_moved_by_quarter_turns(angle):
    found = float(_quarter(np.array(angle)))
    assert -np.pi / 4 < found <= np.pi / 4 + 1e-12
    quarters = (angle - found) / (np.pi / 2)
    assert abs(quarters - round(quarters)) < 1e-9


def test_the_walls_of_all_clouds_are_taken_as_the_poses_lie():
    """Each cloud's normals turned by its own pose's heading; without any the walls cannot be aligned with."""
    angle, headings = 0.2, np.array([0.3, 1.9, -2.0])
    each = [walls(angle - heading, n=400) for heading in headings]
    normals, owner = np.concatenate(each), np.repeat(np.arange(3, dtype=np.int32), 400)
    clouds = Clouds(400 * np.arange(4), np.zeros_like(normals), normals, owner, np.zeros(len(normals)))
    poses = np.column_stack([RNG.normal(size=(3, 2)), headings])
    estimate = estimate_of(Graph(poses), scans=ScanClouds(clouds, None, 0.0))
    by_walls, by_odometry = (task_of(config=MappingConfig(align=how)) for how in ("walls", "odometry"))
    motion = alignment_of(estimate, by_walls)
    turned = se2.compose(motion, poses)
    np.testing.assert_allclose(turned[0, :2], 0.0, atol=1e-12)
    assert abs(np.exp(4j * (motion[2] + angle)) - 1.0) < 4 * np.radians(0.5)
    np.testing.assert_array_equal(alignment_of(estimate, by_odometry), 0.0)
    with pytest.raises(DataError, match="no walls"):
        alignment_of(replace(estimate, scans=None), by_walls)
