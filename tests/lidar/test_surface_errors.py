"""Errors of ranges that stay with surfaces: what a pair makes of them, and how they add up along a chain."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, scanned

from uwblite import se2
from uwblite.graph.calibration import scan_indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import ScanEdges
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import joined
from uwblite.lidar.joint_refinement import RefinementConfig
from uwblite.lidar.scan_matching import match, nondegenerate_step, pair_points
from uwblite.lidar.surface_errors import common_range_errors, with_range_errors

CONFIG = RefinementConfig()
STEP, SIGMA, BEND = 0.25, 0.002, 0.02


def edges_between(i, j, poses):
    root, still = np.tile(np.eye(3) / SIGMA, (len(i), 1, 1)), np.zeros((len(i), 3))
    return ScanEdges(i, j, se2.between(poses[i], poses[j]), root, still, still, scan_indices(Calibration()))


def test_a_pair_moves_as_its_points_do_along_their_rays():
    """Numeric derivative: all points of one wall moved out along their rays, the matches looked up as before."""
    x = np.array([0.0, 0.25, 1.0, 1.3])
    poses = np.column_stack([x, [0.3, 0.35, 0.4, 0.3], [0.4, 0.1, -0.2, 0.0]])
    seen = scanned(poses, CORRIDOR, beams=400, reach=4.0)
    clouds, graph = joined([seen], np.float64), Graph(poses)
    raster, (i, j) = rasterize(clouds, 0.1, 0.3), (np.array([0, 1, 0, 3]), np.array([1, 0, 2, 2]))
    edges = with_range_errors(edges_between(i, j, poses), graph, clouds, raster, CONFIG)
    assert edges.by_surface.shape == (4, 4, 3)
    points, T = pair_points(clouds, j, CONFIG.points), edges.T_i_j
    ray = clouds.points / np.linalg.norm(clouds.points, axis=1, keepdims=True)
    facing = se2.rotate(poses[clouds.owner, 2], clouds.normals)
    for quarter, wall in ((1, facing[:, 1] > 0.7), (3, facing[:, 1] < -0.7)):
        moved = []
        for error in (1e-6, -1e-6):
            there = replace(clouds, points=clouds.points + error * wall[:, None] * ray)
            gate = CONFIG.last_gate
            z = T + nondegenerate_step(match(there, raster, i, T, points, gate, gate / 3.0))[0]
            moved.append(se2.between(z, T) / error)
        numeric = 0.5 * (moved[0] + moved[1])
        np.testing.assert_allclose(edges.by_surface[:, quarter], numeric, rtol=0.02, atol=0.002)
    assert np.all(edges.by_surface[:, [0, 2]] == 0.0)
    # The two walls turn a pair against each other: equal errors of both cancel where they are equally far.
    assert np.all(edges.by_surface[:, 1, 2] * edges.by_surface[:, 3, 2] < 0.0)


@pytest.mark.parametrize(("metres", "places"), [(3.0, 1), (13.0, 2)])
def test_along_a_wall_the_heading_errs_with_the_way_and_not_with_its_root(metres, places):
    """A wall that turns every step by 0.02 rad per metre of its error: n steps have the variance n^2 times that of one for
    the parts of the error that stay, and n^2 / 2 for the part that is another halfway."""
    n = round(metres / STEP)
    x = np.arange(n + 1) * STEP + (0.5 if places == 1 else 8.0 - 0.5 * metres + 1e-6)
    poses = np.column_stack([x, np.full(n + 1, 1.0), np.zeros(n + 1)])
    i = np.arange(n)
    by_surface = np.zeros((n, 4, 3))
    by_surface[:, 1, 2] = BEND
    graph = Graph(poses).with_edges(replace(edges_between(i, i + 1, poses), by_surface=by_surface))
    alone, together = marginals(graph), marginals(graph, common_range_errors(graph))
    assert alone.covariances.poses[-1, 2, 2] == pytest.approx(n * SIGMA**2)
    first = int(np.sum(x[:-1] < 8.0))
    piece = n**2 if places == 1 else first**2 + (n - first) ** 2
    added = BEND**2 * ((0.010**2 + 0.014**2) * n**2 + 0.014**2 * piece)
    assert together.covariances.poses[-1, 2, 2] - alone.covariances.poses[-1, 2, 2] == pytest.approx(added, rel=1e-6)


def test_edges_of_unknown_errors_have_none_in_common():
    poses = np.zeros((3, 3))
    graph = Graph(poses).with_edges(edges_between(np.arange(2), np.arange(1, 3), poses))
    assert common_range_errors(graph) == []
