"""Walls and columns with the noise of a small lidar, for the tests of registration."""

import numpy as np

from uwblite import se2
from uwblite.lidar.clouds import CloudConfig, Clouds, build
from uwblite.odometry.attached import ScanPoints

ROOM = np.array(
    [[0, 0, 6, 0], [6, 0, 6, 4.2], [6, 4.2, 3.5, 4.2], [3.5, 4.2, 3.5, 5], [3.5, 5, 0, 5], [0, 5, 0, 0], [2, 2, 2.5, 2.3]],
    dtype=float,
)
CORRIDOR = np.array([[-6, -1, 6, -1], [6, 1, -6, 1]], dtype=float)
NOISE = 0.015


def wall_points(walls, rng, spacing=0.05, noise=NOISE):
    """Return points (n, 2) spread at random along walls (w, 4) x1, y1, x2, y2."""
    lengths = np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
    chosen = rng.choice(len(walls), int(lengths.sum() / spacing), p=lengths / lengths.sum())
    share = rng.random(len(chosen))[:, None]
    points = walls[chosen, :2] + share * (walls[chosen, 2:] - walls[chosen, :2])
    return points + rng.normal(0.0, noise, points.shape)


def views(walls, truth, rng, spacing=0.05, noise=NOISE):
    """Return target and source points (n, 2), two samples of the same walls, the source in the frame at the pose truth."""
    target = wall_points(walls, rng, spacing, noise)
    return target, se2.transform(se2.inverse(truth), wall_points(walls, rng, spacing, noise))


def cloud(points, seen_from=None) -> Clouds:
    """Return the cloud of single points (n, 2), seen from a place (2,); None = the sides of its normals mean nothing."""
    config = CloudConfig(voxel=1e-6, normal_radius=0.25, min_neighbours=0, linearity=0.6)
    seen_from = points if seen_from is None else np.broadcast_to(seen_from, points.shape)
    nothing = np.zeros(len(points), dtype=np.intp)
    return build(ScanPoints(nothing, points, seen_from, nothing, nothing), 1, config)


def pair(walls, truth, rng, centre, spacing=0.05, noise=NOISE) -> tuple[Clouds, Clouds]:
    """Return the clouds of two views, both seen from the same place, the centre."""
    target, source = views(walls, truth, rng, spacing, noise)
    return cloud(target, centre), cloud(source, se2.transform(se2.inverse(truth), np.asarray(centre)))


def scattered(rng, counts) -> Clouds:
    """Return random clouds, every point with a random normal but a tenth without."""
    n = int(np.sum(counts))
    angle = rng.uniform(-np.pi, np.pi, n)
    normals = np.column_stack([np.cos(angle), np.sin(angle)]) * (rng.random(n) > 0.1)[:, None]
    owner = np.repeat(np.arange(len(counts)), counts)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
    return Clouds(offsets, rng.uniform(-2, 3, (n, 2)), normals, owner, np.full(n, 1e-3))
