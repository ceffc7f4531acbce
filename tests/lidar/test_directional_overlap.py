"""The share that matches in the direction in which fewest points do: by a loop over points, and along corridors."""

import numpy as np
from helpers.laser_walks import CORRIDOR, HALL, scanned

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.directional_overlap import _NOISE, directional_overlap

GATE = 0.15
FIRST, SECOND = np.array([0]), np.array([1])


def overlap(clouds, pose, limit=10_000):
    return float(directional_overlap(clouds, rasterize(clouds, 0.05, 0.5), FIRST, SECOND, np.array([pose]), limit, GATE)[0])


def by_loops(clouds, pose):
    """Return the least share of 3,600 directions, each by every point's nearest one."""
    clouds = [clouds.cloud(0), clouds.cloud(1)]
    moved = se2.transform(pose, clouds[1][0]), se2.rotate(np.full(len(clouds[1][0]), pose[2]), clouds[1][1])
    asked, matched = np.zeros((2, 2)), np.zeros((2, 2))
    for (p, n), (q, m) in ((clouds[0], moved), (moved, clouds[0])):
        for point, normal in zip(p, n, strict=True):
            distance = np.hypot(*(q - point).T)
            k = np.argmin(distance)
            asked += np.outer(normal, normal)
            matched += np.outer(normal, normal) * (distance[k] <= GATE and normal @ m[k] > np.sqrt(0.5))
    asked += _NOISE * np.trace(asked) * np.eye(2)
    angle = np.linspace(0.0, np.pi, 3600)
    u = np.stack([np.cos(angle), np.sin(angle)])
    return np.min(np.einsum("an,ab,bn->n", u, matched, u) / np.einsum("an,ab,bn->n", u, asked, u))


def test_it_is_the_least_over_all_directions():
    """A raster's cell is 5 cm, so points within that of the gate may count otherwise; the hall has walls of both kinds."""
    poses = np.array([[0.0, 0.0, 0.7], [1.0, 0.5, 1.1]])
    clouds, true = scanned(poses, HALL, 0.01, 1, beams=720, reach=9.0), se2.between(*poses)
    for off in ([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.4, 0.05]):
        assert abs(overlap(clouds, true + off) - by_loops(clouds, true + off)) < 0.05


def test_the_walls_of_a_corridor_share_their_direction_however_the_robot_turned():
    """Both clouds see its two walls alone: added in one frame these face one way, and what matches across is all of it."""
    poses = np.array([[0.0, 0.0, 0.4], [1.0, 0.3, 1.6]])
    clouds, true = scanned(poses, CORRIDOR, 0.0, 1, beams=360, reach=5.0), se2.between(*poses)
    for off in (0.0, 0.1):
        pose = se2.compose(true, [0.0, 0.0, off])
        assert abs(overlap(clouds, pose) - by_loops(clouds, pose)) < 0.05


def test_walls_alone_match_in_no_place_of_a_corridor():
    """All points match, but what faces along the corridor is the noise of the normals."""
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), CORRIDOR, 0.01, 2, reach=6.0)
    assert overlap(clouds, np.array([2.0, 0.0, 0.0])) < 0.5
    assert overlap(clouds, np.array([0.5, 0.0, 0.0])) < 0.5


def test_clouds_without_any_point_share_nothing():
    assert overlap(scanned(np.zeros((2, 3)), HALL, reach=0.1), np.zeros(3)) == 0.0


def test_clouds_without_common_points_share_nothing():
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.4]]), HALL, 0.01, 1, beams=720, reach=9.0)
    assert overlap(clouds, np.array([90.0, 0.0, 0.0])) == 0.0
