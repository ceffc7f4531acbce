"""The straight walls and round columns of a map, and the rays of all scans that end on them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, concatenated
from ..lidar.clouds import Clouds
from ..lidar.free_rays import rays_near, with_free_rays
from ..lidar.joined_walls import with_joined_walls
from ..lidar.ray_equations import misfit
from ..lidar.ray_noise import UNLEARNT
from ..lidar.round_columns import Circles, find_columns, fitted_circles, surroundings
from ..lidar.short_walls import Pieces, pieces_of, walls_of
from ..lidar.stretches import Stretches, stretches
from ..lidar.surface_rays import (
    NEAR,
    MeasuredSurfaces,
    SurfaceRays,
    around_columns,
    as_rays,
    fitted_columns,
    on_columns,
    points_on,
    stretch_of,
    surfaces_of,
    without_columns,
)
from ..lidar.walls import find_walls
from ..odometry.attached import ScanPoints, choose_scans, scan_points
from .estimate import ScanClouds, Task
from .recordings import Recording

_AT_ONCE = 128
"""Keyframes whose rays are in memory at once."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundSurfaces:
    """Surfaces of a map, and the points and rays that are classified again once poses have been adjusted to them."""

    measured: MeasuredSurfaces
    kind: NDArray[np.int8]
    """(p,) of the clouds' points, see points_on."""
    short: Bools
    """(s,) which surfaces are short walls."""
    free: SurfaceRays
    """Single rays near short walls that end on no stretch of their own cloud."""

    def revised(
        self, measured: MeasuredSurfaces, clouds: Clouds, sensors: Floats, poses: Floats, information: Floats
    ) -> tuple[MeasuredSurfaces, NDArray[np.int8]]:
        """Return the surfaces without false columns, with pieces of one wall joined, and with more rays on short walls;
        and the kinds (p,) of the clouds' points.

        Parameters
        ----------
        measured : the surfaces after a step. sensors, poses : (k, 3) of the rays and of the base in the map.
        information : (s, 4, 4) of each surface, see with_joined_walls.
        """
        surfaces = measured.surfaces
        none = surfaces.round & (misfit(measured, sensors, poses) > _MISFIT)
        columns = np.column_stack([surfaces.place, surfaces.radius])[none]
        measured = replace(measured, rays=measured.rays.rows(~none[measured.rays.surface]))
        measured, number = with_joined_walls(measured, information, sensors)
        short = np.ones(len(measured.surfaces.facing), dtype=bool)
        short[number[~self.short]] = False
        measured = with_free_rays(measured, short, self.free, sensors).shown()
        return measured, without_columns(self.kind, clouds, sensors, columns)


_MISFIT = 1.3
"""Rms residual of the rays of a column, relative to their noise, beyond which it is not round; that of a circle is 1."""


def find_surfaces(poses: Floats, scans: ScanClouds, task: Task) -> FoundSurfaces:
    """Return the surfaces of the map with clouds at poses (k, 3)."""
    parts = stretches(scans.clouds)
    some, circles, free = zip(*(_on_stretches(rays, scans, parts) for rays in _rays(scans, task)), strict=True)
    long, columns = concatenated(some), find_columns(concatenated(circles), poses)
    del some
    around, pieces, short, others = _off_stretches(free, poses, columns, scans, task)
    columns, walls = fitted_columns(around, poses, columns), find_walls(scans.clouds, parts, poses)
    kind = points_on(scans.clouds, poses, walls, parts, columns)
    small = walls_of(pieces, poses)
    both = concatenated([walls, small])
    many = len(walls.centre)
    long = long.renumbered(walls.of_stretch)
    short = short.renumbered(np.where(small.of_stretch >= 0, small.of_stretch + many, -1))
    free_rays = rays_near(others, short, poses)
    around, surfaces = on_columns(around, poses, columns, len(both.centre)).packed(), surfaces_of(both, columns)
    found = concatenated([long, short, around])
    del long, short, around, others
    found = found.by_keyframe(surfaces)
    is_short = (np.arange(len(surfaces.facing)) >= many) & ~surfaces.round
    return FoundSurfaces(MeasuredSurfaces(surfaces, found, UNLEARNT), kind, is_short, free_rays)


def _on_stretches(rays: ScanPoints, scans: ScanClouds, parts: Stretches) -> tuple[SurfaceRays, Circles, Bools]:
    """Return the rays on straight stretches of their clouds, with these as surfaces; circles; and which are free (p,)."""
    every = as_rays(rays)
    stretch = stretch_of(every, scans.clouds, scans.raster, parts)
    on = np.flatnonzero(stretch >= 0)
    found = replace(every, surface=stretch).rows(on).bundled()
    return found.packed(), fitted_circles(rays), stretch < 0


def _off_stretches(
    free: tuple[Bools, ...], poses: Floats, columns: Floats, scans: ScanClouds, task: Task
) -> tuple[SurfaceRays, Pieces, SurfaceRays, SurfaceRays]:
    """Return the rays around columns (c, 3); of all other free rays, the short pieces and the rays on these; and all
    of these others."""
    around, pieces, on, others, first, near_columns = [], [], [], [], 0, surroundings(columns, NEAR)
    for rays, unseen in zip(_rays(scans, task), free, strict=True):
        every = as_rays(rays)
        near = around_columns(every, poses, near_columns)
        around.append(every.rows(near).packed())
        unseen[near] = False
        found, some = pieces_of(rays, unseen)
        pieces.append(found)
        on.append(replace(some, surface=some.surface + first).packed())
        others.append(every.rows(unseen).packed())
        first += len(found.keyframe)
    return concatenated(around), concatenated(pieces), concatenated(on), concatenated(others)


def _rays(scans: ScanClouds, task: Task) -> Iterator[ScanPoints]:
    """Yield the rays of all keyframes, some keyframes at a time."""
    for recording in task.recordings.each:
        if recording.has_scans:
            yield from _rays_of(recording, scans, task)


def _rays_of(recording: Recording, scans: ScanClouds, task: Task) -> Iterator[ScanPoints]:
    log = recording.log.with_later_scans(scans.delay)
    assert log.scans is not None
    owner, chosen = choose_scans(log.scans, recording.frames, task.config.keyframes)
    for first in range(0, len(recording.frames), _AT_ONCE):
        own = (owner >= first) & (owner < first + _AT_ONCE)
        rays = scan_points(log, recording.frames, owner[own], chosen[own], task.config.clouds.range_max)
        yield replace(rays, keyframe=rays.keyframe + recording.first)
