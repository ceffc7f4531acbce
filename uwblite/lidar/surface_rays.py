"""Single rays that end on known surfaces, straight walls and round columns, as measurements of poses and surfaces.

    wall      residual n . (p - c r) - n . m          m a point of the wall, n its normal
    column    residual |p - c r - m| - radius         along the ray, times the cosine of incidence

p is the end of the ray, r its direction, both in the map, and c the range offset of the surface: the lidar error that depends
on colour and material. Derivatives are taken where the ray should have ended: noise along an oblique ray is both in
its residual and in its lever arm, and the product of both would turn every scan, along a wall always to the same side.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import WIDE, Bools, Floats, Ints, Table, dots, unique_rows
from ..odometry.attached import ScanPoints
from .clouds import Clouds
from .columns import ColumnConfig, Surroundings, refined_columns, surroundings, to_circle
from .ray_noise import RayNoise, range_sigma

ROUGHNESS = 0.004
"""Roughness of surfaces, m: a grazing ray does not measure better."""
_COLUMNS = ColumnConfig()


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces(Table):
    """Walls and columns (s) in the map."""

    round: Bools
    """Whether it is a column."""
    place: Floats
    """(s, 2) m, centre of a column, a point of a wall."""
    facing: Floats
    """(s,) rad, direction of a wall's normal; of a column 0."""
    offset: Floats
    """(s,) m, by which ranges to it are too long."""
    radius: Floats
    """(s,) m, of a column; of a wall 1."""

    @property
    def normal(self) -> Floats:
        """(s, 2) unit, of walls."""
        return np.stack(se2.cos_sin(self.facing), axis=1)

    @property
    def tangent(self) -> Floats:
        """(s, 2) unit, along walls: the normal turned left."""
        normal = self.normal
        return np.stack([-normal[:, 1], normal[:, 0]], axis=1)

    def moved(self, step: Floats) -> "Surfaces":
        """Return the surfaces after a step (s, 4): a wall's turn and shift along its normal, or a column's shift; the
        offset; the radius."""
        shift = np.where(self.round[:, None], step[:, :2], self.normal * step[:, 1:2])
        facing = self.facing + np.where(self.round, 0.0, step[:, 0])
        return replace(
            self, place=self.place + shift, facing=facing, offset=self.offset + step[:, 2], radius=self.radius + step[:, 3]
        )

    def seen_from(self, pose: Floats) -> "Surfaces":
        """Return the surfaces in the frame of a pose (3,)."""
        place = se2.transform(se2.inverse(pose), self.place)
        return replace(self, place=place, facing=np.where(self.round, 0.0, self.facing - pose[2]))


def surfaces_of(centre: Floats, normal: Floats, columns: Floats) -> Surfaces:
    """Return walls through centres (w, 2) with normals (w, 2), and after them columns (c, 3), x, y, radius, with no range
    offset."""
    w, c = len(centre), len(columns)
    facing = np.concatenate([se2.bearing(normal), np.zeros(c)])
    place, radius = np.concatenate([centre, columns[:, :2]]), np.concatenate([np.ones(w), columns[:, 2]])
    return Surfaces(np.arange(w + c) >= w, place, facing, np.zeros(w + c), radius)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceRays(Table):
    """Rays (m) of known surfaces."""

    keyframe: NDArray[np.signedinteger]
    surface: NDArray[np.signedinteger]
    points: NDArray[np.floating]
    """(m, 2) m, where they ended, frame of the keyframe."""
    directions: NDArray[np.floating]
    """(m, 2) unit, same frame."""
    sigma: NDArray[np.floating]
    """(m,) m, along the ray, by data sheets."""
    bundle: NDArray[np.signedinteger]
    """(m,) number of the group of neighbouring rays of one scan that count as one where they end on one surface."""

    def by_keyframe(self, surfaces: Surfaces) -> "SurfaceRays":
        """Return the rays in order: those on walls before those on columns, by keyframe, and by surface."""
        key = surfaces.round[self.surface] * WIDE(self.keyframe.max(initial=0) + 1) + self.keyframe
        return self.rows(np.argsort(key * len(surfaces.round) + self.surface, kind="stable"))

    def in_parts(self, surfaces: Surfaces) -> Iterator["SurfaceRays"]:
        """Yield rays in this order some at a time, all on walls or all on columns, so that arrays stay in the cache."""
        walls, last = int(np.count_nonzero(~surfaces.round[self.surface])), len(self.keyframe)
        for first, end in ((0, walls), (walls, last)):
            for begin in range(first, end, _RAYS_AT_ONCE):
                yield self.rows(slice(begin, min(begin + _RAYS_AT_ONCE, end)))

    def renumbered(self, number: Ints) -> "SurfaceRays":
        """Return the rays with surface k as number[k]; without those where that is -1."""
        new = replace(self, surface=number[self.surface])
        return new.rows(new.surface >= 0)

    def packed(self) -> "SurfaceRays":
        """Return the rays in half the memory: single precision is a few micrometres at the reach of a lidar, as in clouds."""
        points, directions, sigma = (v.astype(np.float32) for v in (self.points, self.directions, self.sigma))
        keyframe, surface = self.keyframe.astype(np.int32), self.surface.astype(np.int32)
        return SurfaceRays(keyframe, surface, points, directions, sigma, self.bundle)

    def bundled(self) -> "SurfaceRays":
        """Return the mean of neighbouring rays of one scan on one surface, with the weight of all of them; the rays of a
        scan are in order."""
        first = np.flatnonzero(np.diff(np.stack([self.bundle, self.surface]), axis=1, prepend=-1).any(axis=0))
        if not len(first):
            return self
        count = np.diff(np.append(first, len(self.bundle)))[:, None]
        points, ways = (np.add.reduceat(v.astype(np.float64), first, axis=0) / count for v in (self.points, self.directions))
        sigma = np.add.reduceat(self.sigma, first) / count[:, 0] / np.sqrt(count[:, 0])
        directions = ways / np.hypot(*ways.T)[:, None]
        return replace(self.rows(first), points=points, directions=directions, sigma=sigma)


_BUNDLE = 4
"""Neighbouring rays that count as one."""
_MOST_RAYS = 1 << 14
"""Most rays of a scan."""
_RAYS_AT_ONCE, _POINTS_AT_ONCE = 1 << 14, 1 << 16
"""Rays, and points of clouds, that are processed together."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredSurfaces:
    """Surfaces that poses have been adjusted to, in the frame of the first pose, and the rays on them."""

    surfaces: Surfaces
    rays: SurfaceRays
    noise: RayNoise


def as_rays(rays: ScanPoints) -> SurfaceRays:
    """Return rays of which it is not known yet on which surface they end."""
    way = rays.points - rays.origins
    reach = np.maximum(np.hypot(*way.T), 1e-9)
    none = np.full(len(reach), -1)
    bundle = (rays.scan * _MOST_RAYS + rays.ray) // _BUNDLE
    return SurfaceRays(rays.keyframe, none, rays.points, way / reach[:, None], range_sigma(reach), bundle)


def on_columns(rays: SurfaceRays, poses: Floats, columns: Floats, first: int, config: ColumnConfig = _COLUMNS) -> SurfaceRays:
    """Return the rays from poses (k, 3) that end on columns (c, 3), which are surfaces from a first number on."""
    if not len(columns):
        return rays.rows(np.zeros(0, dtype=np.intp))
    at, direction = in_map(rays, poses)
    nearest = cKDTree(columns[:, :2]).query(at)[1]
    shift, _, incidence = to_circle(at - columns[:, :2].take(nearest, axis=0), direction, columns[:, 2].take(nearest))
    good = (incidence < -config.incidence) & (np.abs(shift) < config.gate * rays.sigma + config.slack)
    return replace(rays, surface=nearest + first).rows(good)


NEAR = 0.3
"""Distance from a column's rim up to which rays are kept until it is fitted, m."""


def around_columns(rays: SurfaceRays, poses: Floats, columns: Surroundings) -> SurfaceRays:
    """Return the rays from poses (k, 3) that end near columns."""
    rows, which, away = columns.nearest(se2.transform_each(poses, rays.keyframe, rays.points))
    return rays.rows(rows[away < columns.columns[which, 2] + NEAR])


def points_on(clouds: Clouds, found: MeasuredSurfaces, sensors: Floats) -> NDArray[np.int8]:
    """Return the kind of each of the clouds' points (p,), whose frames are (k, 3) in the map: 0 on a wall where rays showed
    it, 1 on a column, -1 on neither."""
    surfaces, kind = found.surfaces, np.full(len(clouds.points), -1, dtype=np.int8)
    shown = _shown_walls(found, sensors)
    columns = surfaces.rows(surfaces.round)
    near = surroundings(np.column_stack([columns.place, columns.radius]), _ON)
    for first in range(0, len(kind), _POINTS_AT_ONCE):
        part = slice(first, first + _POINTS_AT_ONCE)
        at = se2.transform_each(sensors, clouds.owner[part], clouds.points[part].astype(np.float64))
        kind[part][np.isfinite(shown.query(at, distance_upper_bound=_ON)[0])] = 0
        kind[part][near.on_rim(at, _ON)] = 1
    return kind


_ON = 0.06
"""Distance from a surface up to which a point of a cloud is on it, m."""


def _shown_walls(found: MeasuredSurfaces, sensors: Floats) -> cKDTree:
    """Return the middles of the cells of walls in which rays end."""
    surfaces, rays = found.surfaces, found.rays.rows(~found.surfaces.round[found.rays.surface])
    way, wall = surfaces.tangent, rays.surface.astype(np.intp)
    ended = se2.transform_each(sensors, rays.keyframe, rays.points)
    along = dots(ended - surfaces.place.take(wall, axis=0), way.take(wall, axis=0))
    wall, cell = unique_rows(np.column_stack([wall, np.floor(along / _ON).astype(np.intp)]))[0].T
    return cKDTree(surfaces.place[wall] + ((cell + 0.5) * _ON)[:, None] * way[wall])


def fitted_columns(rays: SurfaceRays, poses: Floats, columns: Floats) -> Floats:
    """Return those of the columns (c, 3) that are round, fitted to rays around them."""
    return refined_columns(columns, *in_map(rays, poses), rays.sigma.astype(np.float64))


def in_map(rays: SurfaceRays, poses: Floats) -> tuple[Floats, Floats]:
    """Return where rays end (m, 2) and their directions (m, 2) in the map."""
    return (
        se2.transform_each(poses, rays.keyframe, rays.points),
        se2.rotate_each(poses[:, 2], rays.keyframe, rays.directions),
    )
