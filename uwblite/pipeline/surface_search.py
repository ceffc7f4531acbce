"""The straight walls and round columns of a map, and the rays of all scans that end on them."""

from collections.abc import Iterator
from dataclasses import replace

from .. import se2
from ..arrays import Floats, concatenated
from ..lidar.pieces import straight_pieces
from ..lidar.ray_equations import misfit
from ..lidar.ray_noise import UNLEARNT
from ..lidar.round_columns import fitted_circles, join_circles, surroundings
from ..lidar.surface_rays import (
    NEAR,
    MeasuredSurfaces,
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
    columns = join_circles(concatenated([fitted_circles(rays) for rays in _rays(scans, task)]), poses)
    near_columns, many = surroundings(columns, NEAR), 0
    near, pieces, on = [], [], []
    for rays in _rays(scans, task):
        near.append(around_columns(as_rays(rays), poses, near_columns).packed())
        straight, some = straight_pieces(rays)
        pieces.append(straight)
        on.append(replace(some, surface=some.surface + many).packed())
        many += len(straight.length)
    straight, around = concatenated(pieces), concatenated(near)
    rim = near_columns.on_rim(se2.transform_each(poses, straight.keyframe, straight.centre), _ON_RIM)
    walls, columns = find_walls(straight, poses, ~rim), fitted_columns(around, poses, columns)
    surfaces = surfaces_of(walls.centre, walls.normal, columns)
    on_walls = concatenated(on).renumbered(walls.of_piece)
    rays_on = concatenated([on_walls, on_columns(around, poses, columns, len(walls.centre)).packed()])
    return MeasuredSurfaces(surfaces, rays_on.by_keyframe(surfaces), UNLEARNT)


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
