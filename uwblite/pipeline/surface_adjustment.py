"""Adjustment of all poses and surfaces: single rays on straight walls and round columns, beside matched pairs of clouds.

A pair of clouds, condensed to its relative pose, has lost that metres of wall, seen from many places, are one straight line,
that the views of a column from all sides show one circle, and that a surface's range offset is the same in all scans. So walls
and columns become unknowns themselves, with their offsets, and are eliminated (graph/eliminated.py). Then the pairs get the
resulting relative poses, so that later stages start from there; the rays are used again for the covariances.

The weight of a ray is learnt from its residuals (lidar/ray_equations.py). Where rays are nearly independent, pairs add nothing
on walls, and their points there get hardly any weight; where walls bend, all rays of one place get the weight of a few, and
pairs keep their weight. On columns they get hardly any: lines through points of a column lie inside it, to the side from which
it is seen.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import OUTLIER, Bools, Floats, Ints, concatenated, rms_length
from ..graph.calibration import LASER
from ..graph.eliminated import BlockEquations, factor, sum_of_blocks
from ..graph.graph import Graph
from ..graph.normal_equations import filled
from ..graph.pose_edges import ScanEdges
from ..graph.unknowns import Unknowns, move_by_arcs
from ..graph.work import RAYS
from ..lidar.cloud_rasters import ScanClouds
from ..lidar.columns import (
    Circles,
    around_columns,
    fitted_circles,
    fitted_columns,
    join_circles,
    on_columns,
    rim_distances,
)
from ..lidar.joint_refinement import measured_again, with_fewer_pairs
from ..lidar.ray_equations import RaySums, noise_of, weighted_sums
from ..lidar.surface_rays import (
    UNLEARNT,
    MeasuredSurfaces,
    ShapePolicy,
    SurfaceRays,
    Surfaces,
    as_rays,
    surfaces_of,
)
from ..lidar.walls import Pieces, find_walls, points_on, straight_pieces
from ..odometry.attached import ScanPoints
from ..odometry.wheels import noise_at
from .estimate import Estimate, Task
from .keyframe_data import rays_of
from .lidar_stages import STILL


class SurfacePolicy:
    """Adjustment of poses and surfaces."""

    ahead: float = 2.0
    """Farthest that a lidar is from its keyframe, m: its mounting, and the way to the scan."""
    steps: int = 6
    """Most Gauss-Newton steps."""
    settling: int = 2
    """Steps, after the first, before which pairs are measured again; noise is learnt before every step but the first."""
    still: float = STILL
    """The next change of the poses, rms, m, that ends them once noise and pairs have settled."""
    kernel: float = OUTLIER
    wider: float = 4.0
    """Width of the Geman-McClure kernel on the residual of a ray, standard deviations, and by how much it is wider in the first
    step; half as much in each that follows (graduated non-convexity: A. Blake, A. Zisserman, Visual reconstruction, 1987)."""
    least: float = 0.03
    """Least weight of a point in pairs of clouds."""
    prior: tuple[float, ...] = (1e3, 1e3, 0.0156, 0.1)
    """Prior standard deviations of a surface: turn and place, rad and m, range offset, m (a device's 10 mm by data sheets, a
    surface's 12 mm by colour and material: L. Kneip et al., ICRA 2009), and radius, m. Those of turn and place must not even
    constrain the heading of the whole map."""


def find_surfaces(poses: Floats, scans: ScanClouds, task: Task) -> MeasuredSurfaces:
    """Return the walls and columns that rays show where the frames of the clouds are at poses (k, 3), and the rays on them."""
    circles, pieces, on = _shapes(scans, task, len(poses))
    columns = join_circles(circles, poses)
    around = _around(columns, poses, on.rows(slice(0)), scans, task)
    middles = se2.transform_each(poses, pieces.keyframe, pieces.centre)
    on_rim = np.abs(rim_distances(columns, middles, ShapePolicy.on)) < ShapePolicy.on
    walls = find_walls(pieces, poses, ~on_rim)
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
    within = cKDTree(columns[:, :2]).query(poses[:, :2])[0] < reach + SurfacePolicy.ahead
    return concatenated([none, *(around_columns(as_rays(r), poses, columns).packed() for r in _rays(scans, task, within))])


def _rays(scans: ScanClouds, task: Task, wanted: Bools) -> Iterator[ScanPoints]:
    """Yield the rays of the wanted keyframes (k,), some keyframes at a time."""
    for recording in task.recordings.each:
        for _, rays in rays_of(recording, task.config, scans.delay, wanted[recording.rows]):
            yield replace(rays, keyframe=rays.keyframe + recording.first)


def adjust_surfaces(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with poses adjusted to rays on walls and columns, and its pairs of clouds measured at these poses."""
    joint, scans = estimate.joint, estimate.scans
    if joint is None or scans is None:
        return estimate
    if not len(joint):
        return estimate.solved(task.config.solver)[0]
    fixed = estimate.graph.fixed_calibration | estimate.graph.calibration.of_kinds(*LASER)
    graph = replace(estimate.graph, fixed_calibration=fixed)
    graph, found = _adjusted(graph, estimate, task)
    if not len(found.rays.keyframe):
        return estimate.solved(task.config.solver)[0]
    before, estimate = estimate.graph.poses, estimate.with_estimates_of(graph)
    walls, columns = np.bincount(found.surfaces.round, minlength=2).tolist()
    figures = {"shift": estimate.moved_since(before), "alike": found.noise.alike.tolist()}
    task.stages.end("surfaces", walls=walls, columns=columns, rays=len(found.rays.keyframe), **figures)
    found = replace(found, surfaces=found.surfaces.seen_from(graph.poses[0]))
    return replace(estimate, joint=replace(joint, T_i_j=joint.relative(estimate.graph)), surfaces=found)


def for_covariances(found: MeasuredSurfaces, graph: Graph, task: Task) -> tuple[Graph, Callable[[Unknowns], BlockEquations]]:
    """Return a graph, and the normal equations of the rays by the numbers of its unknowns, for covariances.

    Rays have the weight of the adjustment. Pairs of clouds contain the same points, and others: they get half their weight.
    """
    edges = [
        replace(e, sqrt_information=np.sqrt(0.5) * e.sqrt_information) if isinstance(e, ScanEdges) else e for e in graph.edges
    ]
    joint = next(e for e in graph.edges if isinstance(e, ScanEdges))
    found, lidar = replace(found, surfaces=found.surfaces.seen_from(se2.inverse(graph.poses[0]))), _lidar(graph, joint, task)
    sums = weighted_sums(found, lidar.sensors, graph.poses, SurfacePolicy.kernel)
    return replace(graph, edges=tuple(edges)), lambda unknowns: _blocks(sums, found.surfaces, graph, lidar, unknowns)


@dataclass(frozen=True, slots=True, eq=False)
class _Lidar:
    """Pose of the lidar at each keyframe (k), and the unknowns on which it depends beside the pose of the base."""

    sensors: Floats
    """(k, 3) frames of the clouds in the map."""
    twist: Floats
    """(k, 3) velocity of the base in its own frame."""
    calibration: Ints
    """(4,) indices of the mounting's x, y, theta and of the delay in the calibration block; -1 = not an unknown."""

    def by_lidar(self, poses: Floats) -> Floats:
        """Return the matrices (k, 4, 3) that turn derivatives by the pose of each keyframe into those by mounting and delay."""
        c, s = se2.cos_sin(poses[:, 2])
        arm, found = self.sensors[:, :2] - poses[:, :2], np.zeros((len(poses), len(self.calibration), len(poses.T)))
        found[:, 0, 0] = found[:, 1, 1] = c
        found[:, 0, 1], found[:, 1, 0] = s, -s
        found[:, 2] = np.column_stack([arm[:, 1], -arm[:, 0], np.ones(len(arm))])
        found[:, -1] = np.einsum("ka,kab->kb", self.twist[:, :2], found[:, :2])
        found[:, -1, 2] += self.twist[:, 2]
        return found


def _lidar(graph: Graph, joint: ScanEdges, task: Task) -> _Lidar:
    """Return the poses of the lidar at the graph's estimates."""
    twist = task.recordings.twist
    return _Lidar(joint.sensor_poses(graph, np.arange(len(graph.poses)), twist)[0], twist, joint.calibration)


def _adjusted(graph: Graph, estimate: Estimate, task: Task) -> tuple[Graph, MeasuredSurfaces]:
    """Return the graph and the surfaces after Gauss-Newton steps with the rays on these; unchanged without rays."""
    joint, normal, order, wheels = estimate.joint, None, None, estimate.odometry
    certainty, rules = np.zeros((0, *se2.POSE, *se2.POSE)), SurfacePolicy
    assert joint is not None
    report = task.stages.reporter("surfaces")
    report(0, rules.steps + 1)
    found = find_surfaces(_lidar(graph, joint, task).sensors, estimate.lidar, task)
    others = () if estimate.ranges is None else (estimate.ranges,)
    step, kind = np.inf, np.zeros(0, dtype=np.int8)
    for turn in range(rules.steps):
        poses, lidar = graph.poses, _lidar(graph, joint, task)
        if turn > 0:
            found = replace(found, noise=noise_of(found.rays, found.surfaces, lidar.sensors, poses))
        if turn == 1:
            wheels = noise_at(graph, wheels, certainty)
            kind = points_on(estimate.lidar.clouds, found, lidar.sensors)
        if not len(found.rays.keyframe):
            break
        report(turn + 1, rules.steps + 1)
        if 0 < turn <= rules.settling:
            # Points on walls weigh by the information that the rays leave, those on columns hardly anything.
            on_walls = max(1.0 - 1.0 / found.noise.alike[0], rules.least)
            weight = np.array([on_walls, rules.least, 1.0])[kind]
            joint = measured_again(joint, graph, estimate.lidar, task.config.refinement, weight)
        problem = with_fewer_pairs(graph.with_edges(wheels, *others, joint))
        normal = filled(problem, last=(), like=normal)
        task.stages.work[RAYS] += len(found.rays.keyframe)
        sums = weighted_sums(found, lidar.sensors, poses, rules.kernel * max(rules.wider * 0.5**turn, 1.0))
        certainty, rays = sums.poses, _blocks(sums, found.surfaces, graph, lidar, normal.unknowns)
        known = factor(normal, rays, order)
        (change, by_surface), order = known.step(normal, rays), known.order
        del known
        graph = move_by_arcs(graph, normal.unknowns, change)
        found = replace(found, surfaces=found.surfaces.moved(by_surface))
        before, step = step, rms_length((graph.poses - poses)[:, :2])
        # Steps get smaller by the same factor each.
        if turn >= rules.settling and step * min(step, before) <= rules.still * before:
            break
    return graph, found


def _blocks(sums: RaySums, surfaces: Surfaces, graph: Graph, lidar: _Lidar, unknowns: Unknowns) -> BlockEquations:
    """Return the normal equations of rays and of the priors of surfaces."""
    # An index -1 gives the number -1: fixed.
    of_lidar = np.append(unknowns.number["calibration"][:, 0], -1)[lidar.calibration]
    number = np.column_stack([unknowns.number["poses"], np.tile(of_lidar, (len(graph.poses), 1))])
    by = np.concatenate([np.tile(np.eye(len(graph.poses.T)), (len(graph.poses), 1, 1)), lidar.by_lidar(graph.poses)], axis=1)
    among = sum_of_blocks(number, number, by @ sums.poses @ by.transpose(0, 2, 1), (unknowns.size, unknowns.size))
    slope = np.zeros(unknowns.size)
    np.add.at(slope, number[number >= 0], np.einsum("kab,kb->ka", by, sums.pose_slope)[number >= 0])
    prior = np.array(SurfacePolicy.prior)
    rows = len(prior) * sums.surface[:, None] + np.arange(len(prior))
    across = sums.across @ by[sums.keyframe].transpose(0, 2, 1)
    across = sum_of_blocks(rows, number[sums.keyframe], across, (len(prior) * len(surfaces.facing), unknowns.size))
    # Walls have no radius.
    across.eliminate_zeros()
    own, own_slope = sums.surfaces + np.diag(prior**-2.0), sums.surface_slope.copy()
    own_slope[:, 2] += surfaces.offset * prior[2] ** -2.0
    return BlockEquations(among, across, own, slope, own_slope)
