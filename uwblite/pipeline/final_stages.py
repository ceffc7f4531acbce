"""The last stages: every measurement in one graph, and the occupancy grid along its trajectory."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import TINY, Floats, evenly
from ..graph.calibration import HEIGHT, with_free
from ..graph.graph import Graph
from ..graph.marginals import Covariances, Marginals, marginals
from ..graph.pose_edges import OdometryEdges, ScanEdges
from ..graph.solver import optimize
from ..graph.unknowns import free_unknowns
from ..graph.work import RAYS
from ..grid.geometry import MEGA, GridGeometry
from ..grid.occupancy_grid import OccupancyGrid
from ..grid.tracing import Sweeps, from_sweeps
from ..lidar.joint_refinement import with_fewer_pairs
from ..odometry.attached import choose_scans
from ..odometry.keyframes import KeyframeConfig
from ..problem.solution import at_given_poses
from ..radio.anchor_covariance import anchors_with_correlated_errors, with_correlated_errors
from ..radio.prior_selection import with_alike_heights
from ..radio.range_noise import RangeNoiseConfig
from .estimate import Estimate, Task
from .map_frame import cropped
from .progress import Stage
from .radio_stages import with_range_noise
from .recordings import Recording
from .surface_adjustment import for_covariances


class FinalPolicy:
    """What the finished estimate states."""

    large_grid: int = 5_000_000
    """Cells from which on a grid's memory is announced."""
    along: int = 60
    """Poses along the trajectory whose joint covariance represents the whole trajectory."""
    shortest: float = 0.05
    """s; shortest step whose variance grows in proportion to its time."""
    fastest: float = 1.0
    """m/s and rad/s, at which a robot with wheels that measure nothing moves at most."""


def final_optimisation(estimate: Estimate, task: Task) -> Estimate:
    """Put every measurement into the graph; where the lidar has refined the poses, estimate anchors with other weights.

    For poses, a range is weighted by its own errors (lidar_stages.solve_by_own_errors); for anchors, also by the errors that
    all ranges from one direction have in common, without feedback from anchors to poses (M. Plummer, Cuts in Bayesian
    graphical models, 2015).
    """
    if estimate.joint is not None and estimate.ranges is not None:
        estimate = _anchors_alone(estimate, task)
    # Data for matching takes most of the memory; walls are needed once more where the map's axes follow them.
    scans = estimate.scans if task.config.align == "walls" else None
    # The clock with which clouds were made is uncertain as well.
    graph = with_free(estimate.problem, "laser_delay")
    return replace(estimate, graph=graph, scans=scans, steps=None, joint=None)


def covariances_of(estimate: Estimate, task: Task) -> Covariances:
    """Return the covariances of a finished estimate, with the correlated errors of ranges in them."""
    along = evenly(len(estimate.graph.poses), FinalPolicy.along)
    graph, surfaces = with_fewer_pairs(estimate.graph), estimate.surfaces
    graph, rays = (graph, None) if surfaces is None else for_covariances(surfaces, graph, task)
    result = marginals(graph, among=along, further=rays)
    covariances = result.covariances
    if estimate.ranges is not None:
        covariances = _add_correlated_ranges(result, graph, estimate, task.config.ranges)
    if not task.recordings.have_scans:
        return covariances
    return replace(covariances, poses=covariances.poses + _between_scan_and_keyframe(estimate.graph, task))


def _add_correlated_ranges(result: Marginals, model: Graph, estimate: Estimate, config: RangeNoiseConfig) -> Covariances:
    """Add the correlated errors of ranges: to anchors alone where the lidar determines the poses, else to all."""
    graph, ranges = estimate.graph, estimate.ranges
    assert ranges is not None
    if estimate.rests_on_ranges:
        return with_correlated_errors(result, model, ranges, config)
    about_anchors = tuple(e for e in graph.edges if not isinstance(e, (OdometryEdges, ScanEdges)))
    at_poses, plain = at_given_poses(replace(graph, edges=about_anchors)), result.covariances
    return replace(plain, anchors=anchors_with_correlated_errors(at_poses, ranges, plain.anchors, config))


def _between_scan_and_keyframe(graph: Graph, task: Task) -> Floats:
    """Return the covariances (k, 3, 3) of the odometry's error between the time of a keyframe and those of its scans.

    Scans measure the pose at their own times; nothing but the odometry measures the motion from there to the keyframe.
    """
    time, rate = np.zeros(len(graph.poses)), np.zeros_like(graph.poses)
    for recording in task.recordings.each:
        if recording.has_scans:
            time[recording.rows] = time_to_scans(recording, task.config.keyframes)
    time[graph.fixed_poses] = 0.0
    for wheels in (e for e in graph.edges if isinstance(e, OdometryEdges)):
        sigma = 1.0 / np.maximum(np.einsum("eii->ei", wheels.sqrt_information), TINY)
        for ends in (wheels.i, wheels.j):
            np.maximum.at(rate, ends, sigma**2 / np.maximum(wheels.duration, FinalPolicy.shortest)[:, None])
    variance = np.minimum(rate * time[:, None], np.square(FinalPolicy.fastest * time)[:, None])
    turned = se2.rotation(graph.poses[:, 2])
    return np.asarray(turned * variance[:, None] @ turned.transpose(0, 2, 1))


def time_to_scans(recording: Recording, config: KeyframeConfig) -> Floats:
    """Return for each keyframe (k,) the time in which a random walk has the variance that the mean of its scans' poses has, s.

    1 / n^2 times the sum over pairs of n scans on one side of the keyframe of the shorter time between scan and keyframe.
    """
    log, frames = recording.log, recording.frames
    assert log.scans is not None
    owner, chosen = choose_scans(log.scans, frames, config)
    away = log.scans.middles[chosen] - frames.stamps[owner]
    side = 2 * owner + (away > 0.0)
    order = np.lexsort((np.abs(away), side))
    rank = np.arange(len(order)) - np.searchsorted(side[order], side[order])
    longer = np.bincount(side, minlength=2 * len(frames))[side[order]] - rank
    total = np.bincount(owner[order], np.abs(away[order]) * (2 * longer - 1), len(frames))
    return total / np.maximum(np.bincount(owner, minlength=len(frames)), 1) ** 2


def _anchors_alone(estimate: Estimate, task: Task) -> Estimate:
    """Estimate anchors and their calibration once more at the poses found, errors steady by direction counted as well."""
    if task.config.ranges.steady == 0.0 or estimate.ranges is None:
        return estimate
    estimate = with_range_noise(estimate, task.config, steady=True)
    assert estimate.ranges is not None
    graph, at_poses = estimate.graph, at_given_poses(estimate.graph)
    if not any(free.any() for free in free_unknowns(at_poses).values()):
        return estimate
    # Heights of anchors are alike by what all ranges show.
    at_poses = with_free(at_poses, HEIGHT)
    optimum = with_alike_heights(optimize(at_poses.with_edges(estimate.ranges), task.config.solver)[0])
    at_poses = replace(at_poses, edges=optimum.edges[: len(at_poses.edges)])
    done = replace(estimate, graph=at_poses).solved(task.config.solver)[0].graph
    # What the search itself has fixed are heights put back to 0.
    heights = graph.calibration.of_kinds(HEIGHT)
    fixed = np.where(heights, done.fixed_calibration, graph.fixed_calibration)
    graph = replace(graph, edges=at_poses.edges)
    return replace(estimate, graph=replace(graph.with_estimates_of(done), fixed_calibration=fixed))


def occupancy_grid(estimate: Estimate, task: Task) -> OccupancyGrid | None:
    """Trace every scan from where the laser was at its first and last ray (paper: Bresenham, binary Bayes filter)."""
    sweeps = [_sweeps(recording, estimate.graph) for recording in task.recordings.each if recording.has_scans]
    if not sweeps:
        return None
    config, stages = task.config, task.stages

    def announce(geometry: GridGeometry) -> None:
        """Report what a large grid will take; the caller may still stop."""
        if geometry.cells >= FinalPolicy.large_grid:
            detail = f"of {geometry.cells / MEGA:.0f} million cells, about {geometry.megabytes:.0f} MB"
            stages.report(Stage("occupancy grid", detail=detail), 0, 1)

    reporter = stages.reporter("occupancy grid")
    grid = from_sweeps(sweeps, config.grid, progress=reporter, announce=announce)
    stages.work[RAYS] += sum(own.scans.ranges.size for own in sweeps)
    if grid.scans_astray:
        stages.note("scans-astray", scans=grid.scans_astray, used=grid.scans_used)
    if grid.geometry.resolution > config.grid.resolution:
        cells = config.grid.max_cells / MEGA
        stages.note("coarse-grid", resolution=grid.geometry.resolution, asked=config.grid.resolution, cells=cells)
    if config.crop is not None:
        grid = cropped(grid, config.crop)
    stages.end("occupancy grid", scans=grid.scans_used, rows=grid.geometry.rows, cols=grid.geometry.cols)
    return grid


def _sweeps(recording: Recording, graph: Graph) -> Sweeps:
    """Return the scans of a recording with where its laser was."""
    scans, mounting, cal = recording.log.scans, recording.log.mounting, graph.calibration
    assert scans is not None
    correction = np.array([cal.get("laser_x"), cal.get("laser_y"), cal.get("laser_theta")])
    mount = se2.compose(correction, mounting.T_base_laser)
    first = scans.stamps + cal.get("laser_delay")
    last = first + scans.duration
    ends = [se2.compose(recording.dense_trajectory(graph.poses, stamps), mount) for stamps in (first, last)]
    return Sweeps(scans, ends[0], ends[1], mounting.laser_flipped)
