"""Equations of rays on surfaces for poses and surfaces, summed over the rays of one keyframe on one surface.

All rays of a keyframe on a wall share its normal, and their equations are combinations of four figures of a ray: 1, the place
along the wall where it should end, the cosine of incidence, and the residual. So ten weighted sums of products replace any
number of rays, exactly (as the point clusters of BALM: Z. Liu, X. Liu, F. Zhang, IEEE Transactions on Robotics 2023).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints
from .columns import to_circle
from .ray_noise import RayNoise, learnt_noise
from .surface_rays import ROUGHNESS, MeasuredSurfaces, SurfaceRays, Surfaces, in_map

_LEAST = 0.05
"""Least cosine of incidence; smaller ones are replaced by it."""
_PIECE, _SECTOR = 1.0, np.pi / 4.0
"""Length of a place on a wall, m, and angle of one on a column, rad, within which residuals may be correlated."""


@dataclass(frozen=True, slots=True, eq=False)
class RayEquations:
    """Whitened residuals of rays and their derivatives."""

    residual: Floats
    """(m,)."""
    by_pose: Floats
    """(m, 3) by x, y, theta of the keyframe."""
    by_surface: Floats
    """(m, 4) by the step of Surfaces.moved."""


def linearized(rays: SurfaceRays, surfaces: Surfaces, sensors: Floats, poses: Floats) -> RayEquations:
    """Linearise rays at their surfaces.

    Parameters
    ----------
    sensors : (k, 3) frames of the clouds in the map, where the laser's mounting and clock put them. poses : (k, 3) of the
        base, about which these turn.
    """
    at, direction = in_map(rays, sensors)
    at -= surfaces.offset[rays.surface, None] * direction
    away, curved = at - surfaces.place.take(rays.surface, axis=0), surfaces.round[rays.surface]
    normal, shift = surfaces.normal.take(rays.surface, axis=0), np.zeros(len(away))
    round_ones = np.flatnonzero(curved)
    if len(round_ones):
        radius = surfaces.radius[rays.surface[round_ones]]
        shift[round_ones], normal[round_ones], _ = to_circle(away[round_ones], direction[round_ones], radius)
    incidence = (normal * direction).sum(axis=1)
    incidence = np.where(np.abs(incidence) > _LEAST, incidence, -_LEAST)
    residual = np.where(curved, -shift * incidence, (normal * away).sum(axis=1))
    ahead = -(residual / incidence)[:, None] * direction
    arm, away = at + ahead - poses[:, :2].take(rays.keyframe, axis=0), away + ahead
    root = 1.0 / np.hypot(rays.sigma * incidence, ROUGHNESS)
    by_pose = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
    turn = normal[:, 0] * away[:, 1] - normal[:, 1] * away[:, 0]
    by_surface = np.column_stack(
        [
            np.where(curved, -normal[:, 0], turn),
            np.where(curved, -normal[:, 1], -1.0),
            -incidence,
            np.where(curved, -1.0, 0.0),
        ]
    )
    return RayEquations(residual * root, by_pose * root[:, None], by_surface * root[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class RaySums:
    """Normal equations of rays: of keyframes (k), of surfaces (s), and of pairs of a keyframe and a surface with rays (g)."""

    poses: Floats
    """(k, 3, 3)."""
    pose_slope: Floats
    """(k, 3)."""
    surfaces: Floats
    """(s, 4, 4)."""
    surface_slope: Floats
    """(s, 4)."""
    keyframe: Ints
    """(g,)."""
    surface: Ints
    """(g,)."""
    across: Floats
    """(g, 4, 3) of surface and pose."""


def weighted_sums(found: MeasuredSurfaces, sensors: Floats, poses: Floats, kernel: float) -> RaySums:
    """Return the normal equations of rays, robustly weighted, in standard deviations of the noise that was learnt.

    Parameters
    ----------
    sensors, poses : see linearized. kernel : width of the Geman-McClure kernel, standard deviations.
    """
    k, s = len(poses), len(found.surfaces.facing)
    of_poses, of_surfaces = np.zeros((k, 3, 4)), np.zeros((s, 4, 5))
    across, where = [np.zeros((0, 4, 3))], [np.zeros((2, 0), dtype=np.intp)]
    for rays in found.rays.in_parts(found.surfaces):
        first = _groups(rays)
        keyframe, surface = pair = np.stack([rays.keyframe[first], rays.surface[first]]).astype(np.intp)
        products = _products(rays, first, found, sensors, poses, kernel)
        np.add.at(of_poses, keyframe, products[:, :3, [0, 1, 2, 7]])
        np.add.at(of_surfaces, surface, products[:, 3:7, 3:])
        across.append(products[:, 3:7, :3])
        where.append(pair)
    keyframe, surface = np.concatenate(where, axis=1)
    of_both = np.concatenate(across)
    return RaySums(
        of_poses[:, :, :3], of_poses[:, :, 3], of_surfaces[:, :, :4], of_surfaces[:, :, 4], keyframe, surface, of_both
    )


def _products(rays: SurfaceRays, first: Ints, found: MeasuredSurfaces, sensors: Floats, poses: Floats, kernel: float) -> Floats:
    """Return for each group the sums (g, 8, 8) of products of derivatives by the pose (3), by the surface (4), and residual."""
    sums = _sums_on_columns if found.surfaces.round[rays.surface[0]] else _sums_on_walls
    return sums(rays, first, found, sensors, poses, kernel)


def _groups(rays: SurfaceRays) -> Ints:
    """Return the first ray (g,) of each keyframe on each surface."""
    new = np.ones(len(rays.keyframe), dtype=bool)
    new[1:] = (np.diff(rays.keyframe) != 0) | (np.diff(rays.surface) != 0)
    return np.flatnonzero(new)


def _sums_on_columns(
    rays: SurfaceRays, first: Ints, found: MeasuredSurfaces, sensors: Floats, poses: Floats, kernel: float
) -> Floats:
    lines, (share, narrow) = linearized(rays, found.surfaces, sensors, poses), found.noise.weights(True, kernel)
    rows = np.column_stack([lines.by_pose, lines.by_surface, lines.residual])
    rows *= (np.sqrt(share) / (1.0 + lines.residual**2 * narrow))[:, None]
    products = np.empty((len(first), 8, 8))
    for a in range(8):
        products[:, a, a:] = products[:, a:, a] = np.add.reduceat(rows[:, a:] * rows[:, a, None], first, axis=0)
    return products


@dataclass(frozen=True, slots=True, eq=False)
class _AtWalls:
    """Rays (m,) at their walls, and the walls as their keyframes (g,) see them."""

    of: Ints
    """(m,) group of each ray."""
    normal: Floats
    """(g, 2) in the map."""
    beside: Floats
    """(g,) m, where along the wall the lidar stands, from the wall's own point."""
    along: Floats
    """(m,) m, where along the wall the ray ended, from the lidar."""
    sideways: Floats
    """(m,) of the ray's direction, along the wall."""
    incidence: Floats
    """(m,) cosine of incidence, with a lower bound."""
    residual: Floats
    """(m,) m."""
    information: Floats
    """(m,) 1/m^2, of the residual by data sheets."""


def _at_walls(rays: SurfaceRays, first: Ints, surfaces: Surfaces, sensors: Floats) -> _AtWalls:
    """Return rays at their walls; a wall's direction is its normal turned left."""
    wall, sensor = rays.surface[first], sensors[rays.keyframe[first]]
    normal, (c, s) = surfaces.normal[wall], se2.cos_sin(sensor[:, 2])
    away = sensor[:, :2] - surfaces.place[wall]
    before = normal[:, 0] * away[:, 0] + normal[:, 1] * away[:, 1]
    beside = normal[:, 0] * away[:, 1] - normal[:, 1] * away[:, 0]
    of = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(rays.keyframe))))
    nx, ny = (c * normal[:, 0] + s * normal[:, 1]).take(of), (c * normal[:, 1] - s * normal[:, 0]).take(of)
    (x, y), (u, v) = (v.T.astype(np.float64, order="C") for v in (rays.points, rays.directions))
    facing, sideways = nx * u + ny * v, nx * v - ny * u
    offset = surfaces.offset[wall].take(of)
    residual = nx * x + ny * y + before.take(of) - offset * facing
    incidence = np.where(np.abs(facing) > _LEAST, facing, -_LEAST)
    information = 1.0 / ((rays.sigma.astype(np.float64) * incidence) ** 2 + ROUGHNESS**2)
    return _AtWalls(of, normal, beside, nx * y - ny * x - offset * sideways, sideways, incidence, residual, information)


def _sums_on_walls(
    rays: SurfaceRays, first: Ints, found: MeasuredSurfaces, sensors: Floats, poses: Floats, kernel: float
) -> Floats:
    on, (share, narrow) = _at_walls(rays, first, found.surfaces, sensors), found.noise.weights(False, kernel)
    weight = share * on.information / (1.0 + on.residual**2 * on.information * narrow) ** 2
    should_end = on.along - on.residual / on.incidence * on.sideways
    parts = np.stack([np.ones(len(weight)), should_end, on.incidence, on.residual])
    products = np.empty((len(first), 4, 4))
    for a in range(4):
        weighted = weight * parts[a]
        for b in range(a, 4):
            products[:, a, b] = products[:, b, a] = np.add.reduceat(weighted * parts[b], first)
    arm = (sensors - poses)[rays.keyframe[first], :2]
    by_part = np.zeros((len(first), 8, 4))
    by_part[:, :2, 0] = on.normal
    by_part[:, 2, 0] = on.normal[:, 1] * arm[:, 0] - on.normal[:, 0] * arm[:, 1]
    by_part[:, 3, 0], by_part[:, 4, 0] = on.beside, -1.0
    by_part[:, 2, 1], by_part[:, 3, 1], by_part[:, 5, 2], by_part[:, 7, 3] = -1.0, 1.0, -1.0, 1.0
    return np.asarray(by_part @ products @ by_part.transpose(0, 2, 1))


def noise_of(rays: SurfaceRays, surfaces: Surfaces, sensors: Floats, poses: Floats) -> RayNoise:
    """Learn the noise of rays from their residuals; for the parameters see linearized."""
    shown = [_shown(some, surfaces, sensors, poses) for some in rays.in_parts(surfaces)]
    residual, place = (np.concatenate(part) for part in zip(*shown, strict=True))
    return learnt_noise(residual, place, rays.surface, surfaces.round)


def _shown(
    rays: SurfaceRays, surfaces: Surfaces, sensors: Floats, poses: Floats
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the residuals (m,) of rays in standard deviations, and where on its surface each ends."""
    if surfaces.round[rays.surface[0]]:
        away = in_map(rays, sensors)[0] - surfaces.place[rays.surface]
        place, residual = se2.bearing(away) / _SECTOR, linearized(rays, surfaces, sensors, poses).residual
    else:
        on = _at_walls(rays, _groups(rays), surfaces, sensors)
        place, residual = (on.along + on.beside.take(on.of)) / _PIECE, on.residual * np.sqrt(on.information)
    return residual.astype(np.float32), np.floor(place).astype(np.int32)
