"""Equations of rays on surfaces for poses and surfaces, summed over the rays of one keyframe on one surface.

All rays of a keyframe on a wall share its normal, and their equations are combinations of four figures of a ray: 1, the place
along the wall where it should end, the cosine of incidence, and the residual. So ten weighted sums of products replace any
number of rays, exactly (as the point clusters of BALM: Z. Liu, X. Liu, F. Zhang, IEEE Transactions on Robotics 2023). On a
column the figures are six. Derivatives are taken where the ray should have ended: noise along an oblique ray is both in its
residual and in its lever arm, and the product of both would turn every scan, along a wall always to the same side.

Residuals also show the noise: its size, and the correlation of residuals in one place, since walls are not straight, columns
not round, and errors of neighbouring rays are correlated: the variance of the sum of n residuals is then n times a factor, the
design effect (L. Kish, Survey sampling, 1965), and n rays have the information of n divided by that factor.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import OUTLIER, Bools, Floats, Ints, run_starts, spread
from .surface_rays import MeasuredSurfaces, RayNoise, ShapePolicy, SurfaceRays, Surfaces, to_circle


class RayPolicy:
    """Linearisation and noise of rays."""

    incidence: float = 0.05
    """Least cosine of incidence; smaller ones are replaced by it."""
    piece: float = 1.0
    """Length of a place on a wall, m, within which residuals may be correlated."""
    sector: float = np.pi / 4.0
    """The same of one on a column, rad."""
    fewest: int = 200
    """Least number of rays from which their noise is learnt."""
    clip: float = OUTLIER
    """Standard deviations at which residuals are clipped: outliers give no information about the noise of inliers."""
    places: int = 5
    """Least number of places of a surface from which the correlation of its residuals is learnt."""


_POSE = slice(0, *se2.POSE)
_SURFACE = slice(_POSE.stop, _POSE.stop + 4)
"""Derivatives among those of a ray: by x, y, theta of the keyframe, and by the step of Surfaces.moved; last, the residual."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearRays:
    """Rays (m) of keyframes on surfaces, in groups (g) of one keyframe on one surface, linearised."""

    figures: Floats
    """(f, m) of which all derivatives are combinations; the last one is the residual, m."""
    combined: Floats
    """(g, 8, f) or (8, f) derivatives by the pose, by the surface, and the residual, by the figures."""
    information: Floats
    """(m,) 1/m^2, of the residual by data sheets."""
    place: Floats
    """(m,) where on its surface each ray ends, in places."""

    def products(self, first: Ints, weight: Floats) -> Floats:
        """Return for each group, from its first ray (g,) on, the weighted sums (g, 8, 8) of products of what is combined."""
        many = len(self.figures)
        products = np.empty((len(first), many, many))
        for a in range(many):
            weighted = weight * self.figures[a]
            for b in range(a, many):
                products[:, a, b] = products[:, b, a] = np.add.reduceat(weighted * self.figures[b], first)
        return np.asarray(self.combined @ products @ np.swapaxes(self.combined, -1, -2))


def linearized(rays: SurfaceRays, first: Ints, surfaces: Surfaces, sensors: Floats, poses: Floats) -> LinearRays:
    """Linearise rays, all on walls or all on columns, at their surfaces.

    Parameters
    ----------
    first : (g,) first ray of each group. sensors : (k, 3) frames of the clouds in the map, where the laser's mounting and clock
        put them. poses : (k, 3) of the base, about which these turn.
    """
    if surfaces.round[rays.surface[0]]:
        return _at_columns(rays, surfaces, sensors, poses)
    return _at_walls(rays, first, surfaces, sensors, poses)


def _at_columns(rays: SurfaceRays, surfaces: Surfaces, sensors: Floats, poses: Floats) -> LinearRays:
    column, (at, direction) = surfaces.rows(rays.surface), rays.in_map(sensors)
    at -= column.offset[:, None] * direction
    shift, normal, incidence = to_circle(at - column.place, direction, column.radius)
    incidence = _bounded(incidence)
    (nx, ny), (x, y) = normal.T, (at + shift[:, None] * direction - poses[:, :2].take(rays.keyframe, axis=0)).T
    # In the order of the derivatives by a column: its place, offset and radius.
    figures = np.stack([nx, ny, incidence, np.ones(len(nx)), ny * x - nx * y, -shift * incidence])
    unit = np.eye(len(figures))
    combined = np.concatenate([unit[[0, 1, -2]], -unit[:-2], unit[-1:]])
    place = se2.bearing(at - column.place) / RayPolicy.sector
    return LinearRays(figures, combined, _information(rays, incidence), place)


def _at_walls(rays: SurfaceRays, first: Ints, surfaces: Surfaces, sensors: Floats, poses: Floats) -> LinearRays:
    wall, keyframe = surfaces.rows(rays.surface[first]), rays.keyframe[first]
    sensor, (nx, ny) = sensors[keyframe], wall.normal.T
    (c, s), (x, y) = se2.cos_sin(sensor[:, 2]), (sensor[:, :2] - wall.place).T
    before, beside = nx * x + ny * y, nx * y - ny * x
    of = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(rays.keyframe))))
    mx, my = (c * nx + s * ny).take(of), (c * ny - s * nx).take(of)
    (x, y), (u, v) = (v.T.astype(np.float64, order="C") for v in (rays.points, rays.directions))
    facing, sideways, offset = mx * u + my * v, mx * v - my * u, wall.offset.take(of)
    residual = mx * x + my * y + before.take(of) - offset * facing
    incidence, along = _bounded(facing), mx * y - my * x - offset * sideways
    figures = np.stack([np.ones(len(of)), along - residual / incidence * sideways, incidence, residual])
    arm, nothing = (sensors - poses)[keyframe], np.zeros(len(first))
    shared = np.column_stack([nx, ny, ny * arm[:, 0] - nx * arm[:, 1], beside, nothing - 1.0, nothing, nothing, nothing])
    others = np.array([[0, 0, -1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, -1, 0, 0], [0, 0, 0, 0, 0, 0, 0, 1]], dtype=np.float64)
    combined = np.stack(np.broadcast_arrays(shared, *others), axis=-1)
    return LinearRays(figures, combined, _information(rays, incidence), (along + beside.take(of)) / RayPolicy.piece)


def _bounded(incidence: Floats) -> Floats:
    return np.where(np.abs(incidence) > RayPolicy.incidence, incidence, -RayPolicy.incidence)


def _information(rays: SurfaceRays, incidence: Floats) -> Floats:
    return np.asarray(1.0 / ((rays.sigma.astype(np.float64) * incidence) ** 2 + ShapePolicy.roughness**2))


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
    """Return the normal equations of rays, robustly weighted by a Geman-McClure kernel of a width, in standard deviations of
    the noise that was learnt; for the parameters see linearized."""
    k, s, end = len(poses), len(found.surfaces.facing), _SURFACE.stop
    of_poses, of_surfaces = np.zeros((k, end + 1, end + 1)), np.zeros((s, end + 1, end + 1))
    across, where = [np.zeros((0, end + 1, end + 1))], [np.zeros((2, 0), dtype=np.intp)]
    for rays in found.rays.in_parts(found.surfaces):
        first = run_starts(rays.keyframe, rays.surface)
        pair = np.stack([rays.keyframe[first], rays.surface[first]]).astype(np.intp)
        lines = linearized(rays, first, found.surfaces, sensors, poses)
        share, narrow = found.noise.weights(bool(found.surfaces.round[rays.surface[0]]), kernel)
        weight = share * lines.information / (1.0 + lines.figures[-1] ** 2 * lines.information * narrow) ** 2
        products = lines.products(first, weight)
        for sums, own in zip((of_poses, of_surfaces), pair, strict=True):
            np.add.at(sums, own, products)
        across.append(products)
        where.append(pair)
    keyframe, surface = np.concatenate(where, axis=1)
    return RaySums(
        of_poses[:, _POSE, _POSE], of_poses[:, _POSE, -1], of_surfaces[:, _SURFACE, _SURFACE], of_surfaces[:, _SURFACE, -1],
        keyframe, surface, np.concatenate(across)[:, _SURFACE, _POSE],
    )


def noise_of(rays: SurfaceRays, surfaces: Surfaces, sensors: Floats, poses: Floats) -> RayNoise:
    """Learn the noise of rays from their residuals; for the parameters see linearized."""
    residual, place = [np.zeros(0, dtype=np.float32)], [np.zeros(0, dtype=np.int32)]
    for some in rays.in_parts(surfaces):
        lines = linearized(some, run_starts(some.keyframe, some.surface), surfaces, sensors, poses)
        residual.append((lines.figures[-1] * np.sqrt(lines.information)).astype(np.float32))
        place.append(np.floor(lines.place).astype(np.int32))
    return learnt_noise(np.concatenate(residual), np.concatenate(place), rays.surface, surfaces.round)


def learnt_noise(residual: Floats, place: Ints, surface: Ints, curved: Bools) -> RayNoise:
    """Learn the noise of rays from their residuals (m,), in standard deviations by data sheets, the place and the surface (m,)
    of each, and which surfaces (s,) are columns."""
    c = RayPolicy
    ratio = max(spread(residual), ShapePolicy.quietest) if len(residual) >= c.fewest else 1.0
    clipped = np.where(np.abs(residual) < c.clip * ratio, residual / ratio, 0.0)
    return RayNoise(ratio, _design_effects(clipped, place, surface, curved))


def _design_effects(residual: Floats, place: Ints, surface: Ints, curved: Bools) -> Floats:
    """Return the ratios (2,) of the squared sums of residuals over places to their sums of squares, of walls and of columns."""
    first = int(place.min(initial=0))
    many = int(place.max(initial=0)) - first + 1
    number = surface.astype(np.intp) * many + (place - first)
    shown = np.flatnonzero(np.bincount(number))
    sums, squares, of = np.bincount(number, residual)[shown], np.bincount(number, residual**2)[shown], shown // many
    places = np.bincount(of, minlength=len(curved))
    # The unknowns of a wall's line or a column's circle reduce the sums.
    share = np.where(places >= RayPolicy.places, places / np.maximum(places - (2 + curved), 1), 0.0)[of]
    found = np.full(2, ShapePolicy.alike)
    for kind in range(2):
        own = (curved[of] == bool(kind)) & (share > 0.0)
        if own.any():
            found[kind] = max(1.0, float((share * sums**2)[own].sum() / max(squares[own].sum(), 1.0)))
    return found
