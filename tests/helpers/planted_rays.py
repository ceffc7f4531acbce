"""Rays that end on a wall and on a column, and their equations one by one."""

from types import SimpleNamespace

import numpy as np

from uwblite import se2
from uwblite.lidar import ray_equations
from uwblite.lidar.surface_rays import SurfaceRays, Surfaces

POSES = np.array([[0.3, -0.2, 0.4], [1.1, 0.3, -2.0]])
SURFACES = Surfaces(
    np.array([False, True]),
    np.array([[3.0, 0.5], [-1.5, 1.0]]),
    np.array([2.9, 0.0]),
    np.array([0.02, -0.01]),
    np.array([1.0, 0.4]),
)


def rays_that_end(extra=0.0):
    """Rays from both poses to both surfaces, too long by the offsets of these and something extra."""
    keyframe, surface = np.repeat([0, 1], 20), np.tile(np.repeat([0, 1], 10), 2)
    origin, spread = POSES[keyframe, :2], np.tile(np.linspace(-0.2, 0.2, 10), 4)
    to = SURFACES.place[surface] - origin
    angle = np.arctan2(to[:, 1], to[:, 0]) + spread * np.where(surface == 1, 0.6, 1.0)
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    normal = np.array([np.cos(2.9), np.sin(2.9)])
    flat = ((SURFACES.place[0] - origin) @ normal) / (way @ normal)
    middle = (to * way).sum(axis=1)
    curved = middle - np.sqrt(np.maximum(0.16 - (to**2).sum(axis=1) + middle**2, 0.0))
    reach = np.where(surface == 0, flat, curved) + SURFACES.offset[surface] + extra
    local = se2.rotate(-POSES[keyframe, 2], way)
    return SurfaceRays(keyframe, surface, reach[:, None] * local, local, np.full(40, 0.01), np.arange(40))


def linearized(rays, surfaces, sensors, poses):
    """Return whitened residuals of single rays and their derivatives by pose and surface."""
    rows = np.empty((len(rays.keyframe), 8))
    for kind in (False, True):
        own = np.flatnonzero(surfaces.round[rays.surface] == kind)
        if len(own):
            lines = ray_equations.linearized(rays.rows(own), np.arange(len(own)), surfaces, sensors, poses)
            combined = np.broadcast_to(lines.combined, (len(own), *lines.combined.shape[-2:]))
            rows[own] = np.einsum("maf,fm->ma", combined, lines.figures) * np.sqrt(lines.information)[:, None]
    return SimpleNamespace(by_pose=rows[:, :3], by_surface=rows[:, 3:7], residual=rows[:, 7])
