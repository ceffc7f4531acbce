"""The straight walls and round columns of a map, and the rays of all scans that end on them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, concatenated
from ..lidar.pieces import Pieces, straight_pieces
from ..lidar.ray_equations import misfit
from ..lidar.ray_noise import UNLEARNT
from ..lidar.round_columns import Circles, fitted_circles, join_circles, surroundings
from ..lidar.surface_rays import (
    NEAR,
    MeasuredSurfaces,
    SurfaceRays,
    around_columns,
    as_rays,
    fitted_columns,
    on_columns,
    surfaces_of,
)
from ..lidar.walls import find_walls
from ..odometry.attached import ScanPoints, choose_scans, scan_points
from .estimate import ScanClouds, Task
from .recordings import Recording

_AT_ONCE = 128
"""Keyframes whose rays are in memory at once."""


def with_round_columns(found: MeasuredSurfaces, sensors: Floats, poses: Floats) -> MeasuredSurfaces:
    """Return the surfaces without columns that are not round; for the parameters see ray_equations.linearized."""
    none = found.surfaces.round & (misfit(found, sensors, poses) > _MISFIT)
    return replace(found, rays=found.rays.rows(~none[found.rays.surface])).shown()


_MISFIT = 1.3
"""Rms residual of the rays of a column, relative to their noise, beyond which it is not round; that of a circle is 1."""


_ON_RIM = 0.06
"""Distance from a column's rim up to which the middle of a straight piece is on it, m."""


def find_surfaces(poses: Floats, scans: ScanClouds, task: Task) -> MeasuredSurfaces:
    """Return the surfaces of the map with clouds at poses (k, 3)."""
    circles, pieces, on = _shapes(scans, task, len(poses))
    columns = join_circles(circles, poses)
    around, near = _around(columns, poses, on.rows(slice(0)), scans, task), surroundings(columns, _ON_RIM)
    walls = find_walls(pieces, poses, ~near.on_rim(se2.transform_each(poses, pieces.keyframe, pieces.centre), _ON_RIM))
    columns, on = fitted_columns(around, poses, columns), on.renumbered(walls.of_piece)
    surfaces = surfaces_of(walls.centre, walls.normal, columns)
    rays = concatenated([on, on_columns(around, poses, columns, len(walls.centre)).packed()])
    return MeasuredSurfaces(surfaces, rays.by_keyframe(surfaces), UNLEARNT)


def _shapes(scans: ScanClouds, task: Task, keyframes: int) -> tuple[Circles, Pieces, SurfaceRays]:
    """Return circles and straight pieces of all scans, and the rays on pieces."""
    circles, pieces, on, many = [], [], [], 0
    for rays in _rays(scans, task, np.ones(keyframes, dtype=bool)):
        circles.append(fitted_circles(rays))
        found, some = straight_pieces(rays)
        pieces.append(found)
        on.append(replace(some, surface=some.surface + many).packed())
        many += len(found.length)
    return concatenated(circles), concatenated(pieces), concatenated(on)


def _around(columns: Floats, poses: Floats, none: SurfaceRays, scans: ScanClouds, task: Task) -> SurfaceRays:
    """Return the rays around columns (c, 3) of the keyframes at poses (k, 3) from which the lidar reaches one."""
    if not len(columns):
        return none
    reach = max(r.log.scans.range_max for r in task.recordings.each if r.log.scans is not None)
    reach = min(task.config.clouds.range_max, reach)
    within = cKDTree(columns[:, :2]).query(poses[:, :2])[0] < reach + _AHEAD
    near = surroundings(columns, NEAR)
    return concatenated([none, *(around_columns(as_rays(r), poses, near).packed() for r in _rays(scans, task, within))])


_AHEAD = 2.0
"""Farthest that a lidar is from its keyframe, m: its mounting, and the way to the scan."""


def _rays(scans: ScanClouds, task: Task, wanted: Bools) -> Iterator[ScanPoints]:
    """Yield the rays of the wanted keyframes (k,), some keyframes at a time."""
    for recording in task.recordings.each:
        if recording.has_scans:
            yield from _rays_of(recording, scans, task, wanted[recording.rows])


def _rays_of(recording: Recording, scans: ScanClouds, task: Task, wanted: Bools) -> Iterator[ScanPoints]:
    log = recording.log.with_later_scans(scans.delay)
    assert log.scans is not None
    owner, chosen = choose_scans(log.scans, recording.frames, task.config.keyframes)
    for first in range(0, len(recording.frames), _AT_ONCE):
        if not wanted[first : first + _AT_ONCE].any():
            continue
        own = (owner >= first) & (owner < first + _AT_ONCE) & wanted[owner]
        rays = scan_points(log, recording.frames, owner[own], chosen[own], task.config.clouds.range_max)
        yield replace(rays, keyframe=rays.keyframe + recording.first)
