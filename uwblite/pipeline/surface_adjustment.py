"""Adjustment of all poses and surfaces: single rays on straight walls and round columns, beside matched pairs of clouds.

A pair of clouds, condensed to its relative pose, has lost two things that show where the robot was: that metres of wall, seen
from many places, are one straight line, and that what is seen of a column from all sides is one circle. And a range offset of
a surface, which bends a pair, shows in the rays of many scans. So after the joint refinement walls and columns become
unknowns themselves, with their offsets, and rays on them measure poses beside the pairs; surfaces are eliminated
(graph/eliminated.py). Then the pairs get the relative poses that were found, so that later stages go on from there; the rays
count once more for the covariances.

Pairs keep all of their weight, though they have seen the same rays: in clutter they know what rays on walls do not. Without
the points on surfaces, or with a quarter of the weight, simulated halls gain more and real offices lose.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import Floats, Ints, concatenated
from ..graph.calibration import LASER
from ..graph.eliminated import Blocks, blocks_of, step, summed
from ..graph.graph import Graph
from ..graph.marginals import factor_of
from ..graph.normal_equations import filled
from ..graph.pose_edges import ScanEdges
from ..graph.unknowns import Unknowns, moved
from ..lidar.joint_refinement import with_fewer_pairs
from ..lidar.round_columns import find_columns, fitted_circles
from ..lidar.surface_rays import (
    MeasuredSurfaces,
    RayEquations,
    SurfaceRays,
    Surfaces,
    fitted_columns,
    linearized,
    on_columns,
    on_stretches,
    rays_around,
    surfaces_of,
)
from ..lidar.walls import find_walls, stretches
from ..odometry.attached import ScanPoints, choose_scans, scan_points
from .estimate import Estimate, ScanClouds, Task
from .recordings import Recording

_ROUNDS, _STILL = 3, 1e-3
"""Most Gauss-Newton steps; the largest change of a pose, m and rad, that ends them."""
_KERNEL = 1.5
"""Width of the Geman-McClure kernel on a residual, standard deviations; of one ray 3."""
_PRIOR = np.array([1.0, 1.0, 0.0156, 0.1])
"""Prior standard deviations of a surface: turn and place, rad and m, which say nothing, range offset, m (a device's 10 mm and
a surface's 12 mm, see lidar/surface_errors.py), and radius, m."""
_AT_ONCE = 128
"""Keyframes whose rays are in memory at once."""


def adjust_surfaces(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with poses adjusted to rays on walls and columns, and its pairs of clouds in accordance."""
    joint, scans = estimate.joint, estimate.scans
    if joint is None or scans is None or not len(joint):
        return estimate
    fixed = estimate.graph.fixed_calibration | estimate.graph.calibration.of_kinds(*LASER)
    graph = replace(estimate.graph, fixed_calibration=fixed)
    report = task.stages.reporter("surfaces")
    report(0, _ROUNDS + 1)
    surfaces, rays = _found(_sensors(graph, joint, task), scans, task)
    if not len(rays.keyframe):
        return estimate
    report(1, _ROUNDS + 1)
    graph, surfaces = _adjusted(graph, estimate, surfaces, rays, task)
    before, estimate = estimate.graph.poses, estimate.with_estimates_of(graph)
    task.stages.end(
        "surfaces", walls=int((~surfaces.round).sum()), columns=int(surfaces.round.sum()), rays=len(rays.keyframe),
        shift=round(estimate.moved_since(before), 5),
    )  # fmt: skip
    measured = MeasuredSurfaces(surfaces.seen_from(graph.poses[0]), rays)
    return replace(estimate, joint=replace(joint, T_i_j=joint.relative(estimate.graph)), surfaces=measured)


def for_covariances(
    found: MeasuredSurfaces, graph: Graph, task: Task
) -> tuple[Graph, Callable[[Unknowns], Blocks]]:
    """Return a graph and what gives the normal equations of the rays by the numbers of its unknowns, for covariances.

    Pairs of clouds and rays have seen the same points: each of both counts half.
    """
    half = np.sqrt(0.5)
    edges = [
        replace(e, sqrt_information=half * e.sqrt_information) if isinstance(e, ScanEdges) else e for e in graph.edges
    ]
    joint = next(e for e in graph.edges if isinstance(e, ScanEdges))
    surfaces, sensors = found.surfaces.seen_from(se2.inverse(graph.poses[0])), _sensors(graph, joint, task)
    return replace(graph, edges=tuple(edges)), lambda unknowns: _of_rays(found.rays, surfaces, graph, sensors, unknowns, half)


def _found(poses: Floats, scans: ScanClouds, task: Task) -> tuple[Surfaces, SurfaceRays]:
    """Return the surfaces of the map with clouds at poses (k, 3), and their rays."""
    parts = stretches(scans.clouds)
    walls = find_walls(scans.clouds, parts, poses)
    once = [
        (on_stretches(some, scans.clouds, scans.raster, parts).packed(), fitted_circles(some)) for some in _rays(scans, task)
    ]
    straight, circles = (concatenated(part) for part in zip(*once, strict=True))
    del once
    columns = find_columns(circles, poses)
    around = concatenated([rays_around(some, poses, columns) for some in _rays(scans, task)])
    columns = fitted_columns(around, poses, columns)
    straight = replace(straight, surface=walls.of_stretch[straight.surface])
    rays = [straight.rows(straight.surface >= 0), on_columns(around, poses, columns, len(walls.centre))]
    return surfaces_of(walls, columns), concatenated([part.packed() for part in rays])


def _sensors(graph: Graph, joint: ScanEdges, task: Task) -> Floats:
    """Return the frames (k, 3) of all clouds in the map."""
    return joint.sensor_poses(graph, np.arange(len(graph.poses)), task.recordings.twist)[0]


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


def _adjusted(
    graph: Graph, estimate: Estimate, surfaces: Surfaces, rays: SurfaceRays, task: Task
) -> tuple[Graph, Surfaces]:
    """Return the graph and the surfaces after Gauss-Newton steps with the rays on these."""
    joint = estimate.joint
    assert joint is not None
    problem = with_fewer_pairs(graph.with_edges(*estimate.odometry_and_ranges, joint))
    poses, factor = graph.poses, None
    for _ in range(_ROUNDS):
        normal = filled(problem, subtrees=True)
        factor = factor_of(normal) if factor is None else factor
        blocks = _of_rays(rays, surfaces, problem, _sensors(problem, joint, task), normal.unknowns)
        change, by_surface = step(normal, blocks, factor.solve)
        problem, surfaces = moved(problem, normal.unknowns, change), surfaces.moved(by_surface)
        if np.abs(problem.poses - poses).max() < _STILL:
            break
        poses = problem.poses
    return graph.with_estimates_of(problem), surfaces


def _of_rays(
    rays: SurfaceRays, surfaces: Surfaces, graph: Graph, sensors: Floats, unknowns: Unknowns, factor: float = 1.0
) -> Blocks:
    """Return the normal equations of rays and of what is known of surfaces, some rays at a time; residuals times a factor."""
    total = _priors(surfaces, unknowns)
    for first in range(0, len(rays.keyframe), _RAYS_AT_ONCE):
        some = rays.rows(slice(first, first + _RAYS_AT_ONCE))
        lines = linearized(some, surfaces, sensors, graph.poses)
        total = summed(total, _of_some(some, lines, len(surfaces.facing), unknowns, factor))
    return total


_RAYS_AT_ONCE = 1 << 16
"""Rays that are linearised at once; bounds the memory."""


def _priors(surfaces: Surfaces, unknowns: Unknowns) -> Blocks:
    """Return the normal equations of what is known of surfaces beforehand."""
    count, size = len(surfaces.facing), unknowns.size
    own, slope = np.tile(np.diag(_PRIOR**-2.0), (count, 1, 1)), np.zeros((count, 4))
    slope[:, 2] = surfaces.offset * _PRIOR[2] ** -2.0
    return Blocks(sparse.csr_matrix((size, size)), sparse.csr_matrix((4 * count, size)), own, np.zeros(size), slope)


def _of_some(rays: SurfaceRays, lines: RayEquations, count: int, unknowns: Unknowns, factor: float) -> Blocks:
    """Return the normal equations of rays on as many surfaces, robustly weighted."""
    root = factor / (1.0 + (lines.residual / _KERNEL) ** 2)
    for values in (lines.by_pose, lines.by_surface):
        values *= root[:, None]
    by_pose = _sparse(unknowns.number["poses"][rays.keyframe], lines.by_pose, unknowns.size)
    by_surface = _sparse(4 * rays.surface[:, None] + np.arange(4), lines.by_surface, 4 * count)
    return blocks_of(by_pose, by_surface, lines.residual * root, 4)


def _sparse(columns: Ints, values: Floats, size: int) -> sparse.csr_matrix:
    """Return the matrix (m, size) with values (m, k) in these columns (m, k), ascending; a column below 0 is fixed."""
    free = columns >= 0
    ends = np.concatenate([[0], np.cumsum(free.sum(axis=1))])
    return sparse.csr_matrix((values[free], columns[free], ends), shape=(len(columns), size))
