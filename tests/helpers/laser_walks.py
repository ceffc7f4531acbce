"""Clouds of planted walls seen from known poses, walks through them, and chains of odometry that drift."""

import numpy as np

from uwblite import se2
from uwblite.graph.calibration import odometry_indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import OdometryEdges
from uwblite.lidar.clouds import CloudConfig, Clouds, build
from uwblite.odometry.attached import ScanPoints

from .planted import box, cast, chain, wander

ROOM = np.concatenate([box(8, 6), [[1.0, -1.0, 1.0, 1.0], [1.0, 1.0, 2.0, 1.5]]])
CORRIDOR = np.array([[-40.0, -1.0, 40.0, -1.0], [40.0, 1.0, -40.0, 1.0]])
HALL = np.concatenate(
    [
        box(16, 12),
        [
            [-3.0, -6.0, -3.0, -1.0],
            [2.0, 6.0, 2.0, 1.5],
            [4.0, -1.0, 6.5, -2.5],
            [-6.0, 2.0, -4.5, 4.0],
            [-5.5, -3.0, -5.0, -3.4],
        ],
    ]
)
"""A hall whose corners and inner walls all look different."""


def scanned(poses, walls, noise=0.0, seed=0, beams=360, reach=8.0) -> Clouds:
    """Return the clouds that a laser sees from poses (k, 3)."""
    rng = np.random.default_rng(seed)
    bearings = np.tile(np.linspace(-np.pi, np.pi, beams, endpoint=False), len(poses))
    owner = np.repeat(np.arange(len(poses)), beams)
    distance = cast(poses[owner], bearings, walls) + noise * rng.standard_normal(len(owner))
    hit = np.isfinite(distance) & (distance < reach)
    points = distance[hit, None] * np.column_stack([np.cos(bearings[hit]), np.sin(bearings[hit])])
    nothing = np.zeros(hit.sum(), dtype=np.intp)
    rays = ScanPoints(owner[hit], points, np.zeros_like(points), nothing, nothing)
    return build(rays, len(poses), CloudConfig(voxel=0.02, normal_radius=0.3))


def chained(poses, noise) -> OdometryEdges:
    """Return exact edges between consecutive poses, with standard deviations noise (3,) each."""
    n = len(poses) - 1
    motion = se2.between(poses[:-1], poses[1:])
    root = np.tile(np.diag(1.0 / np.asarray(noise)), (n, 1, 1))
    i = np.arange(n)
    return OdometryEdges(i, i + 1, motion, motion[:, 0], np.ones(n), root, odometry_indices(Calibration(), n))


def drifted(rng, truth, noise) -> Graph:
    """Return the graph of a chain whose steps err by the noise that its edges state."""
    steps = se2.between(truth[:-1], truth[1:])
    poses = chain(truth[0], steps + rng.standard_normal(steps.shape) * noise)
    return Graph(poses).with_edges(chained(poses, noise))


def walked(seed, walls=HALL, metres=60.0, half_width=4.0, spacing=6, **settings):
    """Return true key poses (k, 3), travelled distance and clouds of a walk through walls with lidar noise of 1 cm."""
    rng = np.random.default_rng(seed)
    _, truth = wander(rng, metres, half_width=half_width, **settings)
    truth = truth[::spacing]
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    return truth, path, scanned(truth, walls, 0.01, seed, beams=300, reach=5.6)


def with_a_walker(truth, clouds):
    """Return clouds in each of which a person stands, 2 m ahead of where the robot is and each time somewhere else."""
    parts = []
    for k in range(len(truth)):
        points, normals = clouds.cloud(k)
        angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        body = [2.0 + 0.3 * (k % 3), 0.4 * (k % 5) - 0.8] + 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        hidden = np.abs(np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(body[:, 1].mean(), body[:, 0].mean())) < 0.2
        parts.append((np.concatenate([points[~hidden], body]), np.concatenate([normals[~hidden], np.zeros_like(body)])))
    counts = np.array([len(points) for points, _ in parts])
    points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    owner = np.repeat(np.arange(len(parts), dtype=np.int32), counts)
    return Clouds(np.concatenate([[0], np.cumsum(counts)]), points, normals, owner, np.zeros(len(points)))


def in_map(clouds: Clouds, poses):
    """Return all points and normals (p, 2) in the map frame, given keyframe poses (k, 3)."""
    own = poses[clouds.owner]
    return se2.transform(own, clouds.points), se2.rotate(own[:, 2], clouds.normals)


def returned(walls, far, shift):
    """Return a path of 45 m along x, again after a way back known to `far` m only and wrong by shift (3,).

    Returns
    -------
    True poses (k, 3), the graph, travelled distances (k,) and the clouds.
    """
    once = np.column_stack([np.arange(0.0, 45.0, 0.6), np.zeros(75), np.zeros(75)])
    truth = np.concatenate([once, once])
    edges = chained(truth, [0.003, 0.003, 0.0005])
    edges.sqrt_information[74] = np.diag(1.0 / np.array([far, far, 0.03]))
    poses = np.concatenate([once, se2.compose(np.asarray(shift), once)])
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(truth[:, 0])))])
    return truth, Graph(poses).with_edges(edges), path, scanned(truth, walls, 0.01, 5, beams=240, reach=8.0)
