"""Single rays that end on known surfaces, straight walls and round columns, and their noise.

    wall      residual n . (p - c r) - n . m          m a point of the wall, n its normal
    column    residual |p - c r - m| - radius         along the ray, times the cosine of incidence

p is the end of the ray, r its direction, both in the map, and c the range offset of the surface: the lidar error that depends
on colour and material.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import TINY, WIDE, Bools, Floats, Ints, Table, chunks, dots, run_starts
from ..odometry.attached import ScanPoints
from .joint_refinement import RefinementConfig


class ShapePolicy:
    """Rays, and what a surface is."""

    noise: tuple[float, float] = (0.01, 0.01)
    """Standard deviation of a range by data sheets, m and as a share of it: 10 mm up to 1 m, and 1 % beyond (URG-04LX; other
    scanners are better)."""
    roughness: float = 0.004
    """Roughness of surfaces, m: a grazing ray does not measure better."""
    bundle: int = 4
    """Neighbouring rays that count as one."""
    missing: int = 2
    """Rays without a reading that do not end a run of neighbours."""
    bend: float = 20.0
    """Chi2 by which the richer of two shapes fits rays better."""
    scatter: float = 1.35
    """Largest rms distance of rays from their surface, relative to their noise."""
    on: float = 0.06
    """Distance from a surface up to which a place is on it, m."""
    uneven: float = 0.02
    """Standard deviation of surfaces beside the noise of rays, m and rad: by the poses, and because walls are not straight."""
    quietest: float = 0.1
    """Least noise of rays, as a share of that by data sheets."""
    around: float = 0.3
    """Distance from a column's rim up to which rays are its surroundings, m."""
    alike: float = RefinementConfig().correlation
    """Design effect of rays until one is learnt: that of matches of clouds."""


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
        one, other, offset, radius = step.T
        shift = np.where(self.round[:, None], step[:, :2], self.normal * other[:, None])
        facing = self.facing + np.where(self.round, 0.0, one)
        return Surfaces(self.round, self.place + shift, facing, self.offset + offset, self.radius + radius)

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

    def in_map(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return where rays end (m, 2) and their directions (m, 2) in the map, from poses (k, 3)."""
        return (
            se2.transform_each(poses, self.keyframe, self.points),
            se2.rotate_each(poses[:, 2], self.keyframe, self.directions),
        )

    def by_keyframe(self, surfaces: Surfaces) -> "SurfaceRays":
        """Return the rays in order: those on walls before those on columns, by keyframe, and by surface."""
        key = surfaces.round[self.surface] * WIDE(self.keyframe.max(initial=0) + 1) + self.keyframe
        return self.rows(np.argsort(key * len(surfaces.round) + self.surface, kind="stable"))

    def in_parts(self, surfaces: Surfaces) -> Iterator["SurfaceRays"]:
        """Yield rays in this order some at a time, all on walls or all on columns, so that arrays stay in the cache."""
        walls = int(np.count_nonzero(~surfaces.round[self.surface]))
        for kind in (self.rows(slice(walls)), self.rows(slice(walls, None))):
            for some in chunks(len(kind.keyframe)):
                yield kind.rows(some)

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
        first = run_starts(self.bundle, self.surface)
        if not len(first):
            return self
        count = np.diff(np.append(first, len(self.bundle)))[:, None]
        points, ways = (np.add.reduceat(v.astype(np.float64), first, axis=0) / count for v in (self.points, self.directions))
        sigma = np.add.reduceat(self.sigma, first) / count[:, 0] / np.sqrt(count[:, 0])
        directions = ways / np.hypot(*ways.T)[:, None]
        return replace(self.rows(first), points=points, directions=directions, sigma=sigma)


def as_rays(rays: ScanPoints) -> SurfaceRays:
    """Return rays of which it is not known yet on which surface they end."""
    way = rays.points - rays.origins
    reach = np.maximum(np.hypot(*way.T), TINY)
    within = rays.ray // ShapePolicy.bundle
    bundle = rays.scan * (within.max(initial=0) + 1) + within
    return SurfaceRays(rays.keyframe, np.full(len(reach), -1), rays.points, way / reach[:, None], range_sigma(reach), bundle)


def range_sigma(reach: Floats) -> Floats:
    """Return the standard deviation, m, of ranges (n,), m, by data sheets."""
    near, share = ShapePolicy.noise
    return np.maximum(near, share * reach)


def begins_run(rays: ScanPoints, apart: Bools) -> Bools:
    """Return which rays (m,) begin another run of neighbours; apart (m - 1,) are those that do not belong to the one before."""
    begins = np.ones(len(rays.ray), dtype=bool)
    begins[1:] = (np.diff(rays.scan) != 0) | (np.diff(rays.ray) > ShapePolicy.missing) | apart
    return begins


def to_circle(points: Floats, direction: Floats, radius: Floats) -> tuple[Floats, Floats, Floats]:
    """Return how far (m,) points (m, 2) are from a circle about 0 along their rays, the normals (m, 2) there, and the cosine
    of incidence, 0 where a ray misses."""
    along = dots(points, direction)
    inside = radius**2 - dots(points, points) + along**2
    shift = -along - np.sqrt(np.maximum(inside, 0.0))
    normal = (points + shift[:, None] * direction) / radius[:, None]
    return shift, normal, np.where(inside > 0.0, dots(normal, direction), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RayNoise:
    """Noise of rays as learnt from their residuals."""

    ratio: float
    """Of the noise to that of data sheets."""
    alike: Floats
    """(2,) design effect of rays on walls and on columns, 1 or more."""

    def weights(self, curved: bool, kernel: float) -> tuple[float, float]:
        """Return the information of a ray on a wall or a column relative to that by data sheets, and the inverse square of the
        width of a robust kernel, of so many standard deviations, on residuals by data sheets."""
        return 1.0 / (self.ratio**2 * float(self.alike[int(curved)])), 1.0 / (kernel * self.ratio) ** 2


UNLEARNT = RayNoise(1.0, np.full(2, ShapePolicy.alike))


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredSurfaces:
    """Surfaces that poses have been adjusted to, in the frame of the first pose, and the rays on them."""

    surfaces: Surfaces
    rays: SurfaceRays
    noise: RayNoise
