"""Rays that end on no stretch of their own cloud, assigned to short walls once the map shows these.

A scan with a few rays on a door jamb shows no line. Other scans have shown where the jamb is; then single rays are
used where they end on it, within its observed extent, and on nothing else.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, Ints, concatenated, dots, unique_rows
from .round_columns import surroundings
from .surface_rays import INCIDENCE, ROUGHNESS, MeasuredSurfaces, SurfaceRays, Surfaces, in_map

_CELL, _SHOWN = 0.05, 3
"""Length of the cells of a wall, m, and least number of rays in each."""
_NEAR = 0.15
"""Distance from a cell's middle up to which a ray is tested for ending in it, m."""
_MOST = 12
"""Most cells that are tested for each ray."""
_GATE, _ALONE = 3.0, 6.0
"""Standard deviations within which a ray ends on a wall, and beyond which it does not end on any other."""


def rays_near(free: SurfaceRays, known: SurfaceRays, poses: Floats) -> SurfaceRays:
    """Return those of the free rays that end near known ones, at poses (k, 3)."""
    centres = np.column_stack([se2.transform_each(poses, known.keyframe, known.points), np.zeros(len(known.keyframe))])
    cells = np.unique(np.round(centres / _NEAR), axis=0) * _NEAR
    return free.rows(surroundings(cells, _NEAR).inside(se2.transform_each(poses, free.keyframe, free.points)))


def with_free_rays(found: MeasuredSurfaces, short: Bools, free: SurfaceRays, sensors: Floats) -> MeasuredSurfaces:
    """Return the surfaces with all free rays that end on short walls instead of those that were known to.

    Parameters
    ----------
    short : (s,) of which surfaces all rays are among the free ones. sensors : (k, 3) frames of the rays in the map.
    """
    known = short[found.rays.surface]
    if not known.any() or not len(free.keyframe):
        return found
    cells, wall = _cells(found, sensors)
    at, direction = in_map(free, sensors)
    near = np.flatnonzero(np.isfinite(cKDTree(cells[short[wall]]).query(at, distance_upper_bound=_NEAR)[0]))
    surface = _ended_on(at[near], direction[near], free.sigma[near].astype(np.float64), found.surfaces, cells, wall)
    surface = np.where(short[surface], surface, -1)
    more = replace(free.rows(near), surface=surface).rows(np.flatnonzero(surface >= 0)).bundled().packed()
    rays = concatenated([found.rays.rows(~known), more])
    return replace(found, rays=rays.by_keyframe(found.surfaces))


def _cells(found: MeasuredSurfaces, sensors: Floats) -> tuple[Floats, Ints]:
    """Return the middles (c, 2) of the cells of walls that enough rays have shown, and the wall (c,) of each."""
    surfaces, rays = found.surfaces, found.rays.rows(~found.surfaces.round[found.rays.surface])
    way, wall = surfaces.tangent, rays.surface.astype(np.intp)
    ended = se2.transform_each(sensors, rays.keyframe, rays.points)
    along = dots(ended - surfaces.place.take(wall, axis=0), way.take(wall, axis=0))
    cells, number = unique_rows(np.column_stack([wall, np.floor(along / _CELL).astype(np.intp)]))
    wall, cell = cells[np.bincount(number, minlength=len(cells)) >= _SHOWN].T
    return surfaces.place[wall] + ((cell + 0.5) * _CELL)[:, None] * way[wall], wall


def _ended_on(
    at: Floats, direction: Floats, sigma: Floats, surfaces: Surfaces, cells: Floats, wall: Ints
) -> Ints:
    """Return on which wall (m,) each ray ends, in one of the cells (c, 2) of walls (c,), and near no other; -1 = on none."""
    away, nearest = cKDTree(cells).query(at, k=_MOST, distance_upper_bound=_NEAR)
    ray, column = np.nonzero(np.isfinite(away))
    cell = nearest[ray, column]
    of = wall[cell]
    normal = surfaces.normal[of]
    incidence = -dots(direction[ray], normal)
    end = at[ray] - surfaces.offset[of, None] * direction[ray]
    residual = dots(end - surfaces.place[of], normal)
    should_end = end + (residual / np.maximum(incidence, INCIDENCE))[:, None] * direction[ray]
    inside = (incidence > INCIDENCE) & (np.hypot(*(should_end - cells[cell]).T) <= 0.5 * _CELL)
    off = np.abs(residual) / np.hypot(sigma[ray] * incidence, ROUGHNESS)
    ray, of, off = ray[inside], of[inside], off[inside]
    # The nearest place of each wall, and of these the nearest wall.
    order = np.lexsort((off, of, ray))
    order = order[np.diff(of[order] + len(surfaces.facing) * ray[order], prepend=-1) != 0]
    order = order[np.lexsort((off[order], ray[order]))]
    best = np.flatnonzero(np.diff(ray[order], prepend=-1))
    other = np.append(best[1:], len(order)) - best > 1
    alone = np.ones(len(best), dtype=bool)
    alone[other] = off[order[best[other] + 1]] > _ALONE
    good = order[best[alone & (off[order[best]] < _GATE)]]
    found = np.full(len(at), -1)
    found[ray[good]] = of[good]
    return found
