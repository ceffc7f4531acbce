"""The page that is the algorithm: from recordings to trajectories, anchors and map.

``build_map`` reads as the paper does: keyframes and edges, first optimisation with wheels and radio, sub-maps and
loop closures, second optimisation with lidar edges, occupancy grid. Beyond the paper stand the calibration in the same
least squares, noise learnt from the data, tracking between neighbouring clouds and the joint refinement of all of them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from . import se2
from .arrays import Floats
from .constraints import Constraints
from .errors import ConfigError
from .graph.calibration import LASER, with_free, with_nonnegative_heights
from .graph.graph import Edges, Graph
from .graph.marginals import marginals
from .graph.solver import optimize
from .grid import occupancy_grid
from .grid.geometry import GridGeometry
from .grid.occupancy_grid import OccupancyGrid, Sweeps
from .lidar import joint_refinement
from .lidar.clouds import Clouds
from .lidar.joint_refinement import RefinementResult
from .loop_closure import closures
from .loop_closure.closures import Closures
from .map_result import MapResult
from .mapping_config import MappingConfig
from .pipeline import closure_rounds, landmark_ties, lidar_stages, map_frame, moved_anchors, radio_stages, summary
from .pipeline.lidar_stages import Scans
from .pipeline.progress import Progress, Stages
from .pipeline.recordings import Estimate, Recording, Recordings, gather, moved_hypotheses
from .pipeline.scan_selection import thinned
from .screening.screen import screen
from .sensor_log import SensorLog

__all__ = ["MappingConfig", "Progress", "build_map"]


_LARGE_GRID = 5_000_000
"""Cells from which on a grid's memory is announced."""


def build_map(
    logs: SensorLog | Sequence[SensorLog],
    config: MappingConfig | None = None,
    *,
    constraints: Constraints | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
    clock: Callable[[], float] | None = None,
) -> MapResult:
    """Compute trajectories, anchors and map of one or more recordings.

    Parameters
    ----------
    logs : the recording, ranges or scans may be missing; or several that hear the same anchors, by whatever robots on
        whatever days: they become one map in the frame of the first.
    config : settings; None = defaults.
    constraints : what is known beforehand: surveyed anchors, pinned poses, an earlier map's anchors ...
    progress : called as progress(stage, done, total); returning False raises Cancelled.
    executor : any concurrent.futures executor; the result does not depend on it.
    clock : seconds, for the stages' timings; None = no timings.

    Raises
    ------
    DataError : there is nothing to map, or recordings share too few anchors. Cancelled : the callback asked to stop.
    """
    config, known = config or MappingConfig(), constraints or Constraints()
    stages = Stages(progress, clock)
    logs = [logs] if isinstance(logs, SensorLog) else logs
    logs = [log.without(uwb=not config.use_uwb, lidar=not config.use_lidar) for log in logs]
    logs = [screen(log, config.turn_laser) for log in logs]
    stages.note(logs)
    logs = [thinned(log, config.keyframes, config.grid) for log in logs]

    recordings, estimate = _without_lidar(logs, config, stages)
    units = radio_stages.units(estimate, recordings)
    if np.any(units != 1.0):
        stages.warnings += radio_stages.unit_warnings(recordings, units)
        logs = [log.with_odometry_times(unit) for log, unit in zip(logs, units.tolist(), strict=True)]
        recordings, estimate = _without_lidar(logs, config, stages)
    estimate = radio_stages.constrained(estimate, known, recordings, config, stages)

    scans = Scans.of(recordings, known, config)
    found = closures.no_closures()
    tracked: RefinementResult | None = None
    refined: RefinementResult | None = None
    if scans is not None:
        stages.end("clouds", points=len(scans.clouds.points))
        estimate = replace(estimate, graph=with_free(estimate.graph, *LASER))
        if config.tracking.on:
            estimate, tracked, scans = lidar_stages.track(estimate, scans, recordings, config, stages)
            estimate = radio_stages.reestimate_ranges(estimate, tracked, config, stages)
        if config.use_loops:
            held = () if tracked is None else (tracked.edges,)
            close = closure_rounds.close if config.loops.method == "search" else closure_rounds.close_plainly
            estimate, found = close(estimate, (*estimate.edges, *held), scans, recordings, config, stages, executor)
            estimate = radio_stages.reestimate_range_noise(estimate, (*held, found.edges), config)
            estimate, refined = lidar_stages.refine_jointly(estimate, scans, recordings, config, stages)
            apart = moved_anchors.apart(estimate, recordings, config.solver, config.ranges)
            if apart.warnings:
                stages.warnings += apart.warnings
                estimate, refined = lidar_stages.refine_jointly(apart.estimate, scans, recordings, config, stages)
        lidar_stages.check_map_consistency(estimate, scans, recordings, stages)
    if known.landmark_distances:
        estimate, refined = _measured_distances(estimate, found, tracked, refined, known, scans, recordings, config, stages)
    estimate = _final(estimate, found, tracked, refined)
    walls = _walls(scans, config)
    reestimate_range_noise = refined is not None and estimate.radio is not None
    # What only matching needed is most of the memory.
    scans = tracked = refined = None
    if reestimate_range_noise:
        estimate = replace(estimate, graph=with_nonnegative_heights(optimize(estimate.graph, config.solver)[0]))
    estimate = _aligned(estimate, walls, config)

    grid = _grid(recordings, estimate.graph, config, executor, stages)
    uncertainty = marginals(joint_refinement.with_fewer_pairs(estimate.graph))
    result = summary.summarise(
        recordings, estimate, uncertainty, found, grid, config.calibration, stages.done, stages.warnings, stages.doubts
    )
    stages.end("summary")
    return replace(result, stages=tuple(stages.done))


def _without_lidar(
    logs: Sequence[SensorLog], config: MappingConfig, stages: Stages
) -> tuple[Recordings, Estimate]:
    """Return keyframes and edges of the recordings, and what wheels and radio alone make of them."""
    recordings = gather(logs, config.keyframes)
    travelled = sum(float(s.frames.path.sum()) for s in recordings.each)
    stages.end("keyframes", keyframes=len(recordings.stamps), travelled=round(travelled, 3))

    estimates = [radio_stages.measurements(recording, config) for recording in recordings.each]
    ranges = sum(len(estimate.radio) for estimate in estimates if estimate.radio is not None)
    stages.end("edges", odometry=sum(len(estimate.wheels) for estimate in estimates), ranges=ranges)

    estimate = radio_stages.first_optimisation(estimates, recordings, config, stages)
    return recordings, estimate


def _final(
    estimate: Estimate, closures: Closures, tracked: RefinementResult | None, refined: RefinementResult | None
) -> Estimate:
    """Return the graph with every measurement that holds it; the joint refinement's take the place of all other scans'."""
    if refined is not None:
        return replace(estimate, graph=estimate.graph.with_edges(*estimate.edges, refined.edges))
    lidar: tuple[Edges, ...] = (closures.edges,) if tracked is None else (tracked.edges, closures.edges)
    return replace(estimate, graph=estimate.graph.with_edges(*estimate.edges, *lidar))


def _measured_distances(
    estimate: Estimate,
    closures: Closures,
    tracked: RefinementResult | None,
    refined: RefinementResult | None,
    known: Constraints,
    scans: Scans | None,
    recordings: Recordings,
    config: MappingConfig,
    stages: Stages,
) -> tuple[Estimate, RefinementResult | None]:
    """Let true distances between landmarks pull on the map as it is without them."""
    if scans is None:
        raise ConfigError("constraints: distances between landmarks need the lidar, which sees them")
    held = _final(estimate, closures, tracked, refined)
    poses = se2.compose(_alignment(held, _walls(scans, config), config), held.graph.poses)
    tied = landmark_ties.ties(known, scans.clouds, poses, recordings.path)
    solved = optimize(held.graph.with_edges(tied.edges), config.solver)[0]
    estimate = replace(estimate, graph=estimate.graph.with_edges(tied.edges).with_estimates_of(solved))
    if refined is not None:
        estimate, refined = lidar_stages.refine_jointly(estimate, scans, recordings, config, stages)
    figures, warnings = landmark_ties.outcome(known, tied, estimate.graph)
    stages.warnings += warnings
    stages.end("measured distances", distances=figures)
    return estimate, refined


def _walls(scans: Scans | None, config: MappingConfig) -> Clouds | None:
    """Return what shows the walls, where the map's axes are to follow them."""
    return scans.clouds if scans is not None and config.align == "walls" else None


def _aligned(estimate: Estimate, walls: Clouds | None, config: MappingConfig) -> Estimate:
    """Put the map's axes where the settings want them."""
    motion = _alignment(estimate, walls, config)
    return replace(estimate, graph=map_frame.moved(estimate.graph, motion), first=moved_hypotheses(estimate.first, motion))


def _alignment(estimate: Estimate, walls: Clouds | None, config: MappingConfig) -> Floats:
    """Return T_new_map (3,), by which the map is turned to where the settings want its axes."""
    graph, normals = estimate.graph, np.zeros((0, 2))
    placed = np.zeros(len(graph.anchors), dtype=bool) if estimate.first is None else estimate.first.placed
    if walls is not None:
        normals = se2.rotate(graph.poses[walls.owner, 2], walls.normals)
    return map_frame.alignment(config.align, graph, placed, normals)


def _grid(
    recordings: Recordings, graph: Graph, config: MappingConfig, executor: Executor | None, stages: Stages
) -> OccupancyGrid | None:
    """Trace every scan from where the laser was at its first and last ray (paper: Bresenham, binary Bayes filter)."""
    sweeps = [_sweeps(recording, graph) for recording in recordings.each if recording.has_scans]
    if not sweeps:
        return None

    def announce(geometry: GridGeometry) -> None:
        """Say what a large grid will take; the caller may still stop."""
        if geometry.cells >= _LARGE_GRID:
            stages.report(
                f"occupancy grid of {geometry.cells / 1e6:.0f} million cells, about {geometry.megabytes:.0f} MB", 0, 1
            )

    reporter = stages.reporter("occupancy grid")
    grid = occupancy_grid.from_sweeps(sweeps, config.grid, executor=executor, progress=reporter, announce=announce)
    if grid.scans_astray:
        stages.doubts.append(
            f"{grid.scans_astray} of {grid.scans_astray + grid.scans_used} scans lie so far from the others that no map holds"
            " both; they are not drawn"
        )
    if config.crop is not None:
        grid = map_frame.cropped(grid, config.crop)
    stages.end("occupancy grid", scans=grid.scans_used, rows=grid.geometry.rows, cols=grid.geometry.cols)
    return grid


def _sweeps(recording: Recording, graph: Graph) -> Sweeps:
    """Return the scans of a recording with where its laser was."""
    scans, mounting, cal = recording.log.scans, recording.log.mounting, graph.calibration
    assert scans is not None
    correction = np.array([cal.get("laser_x"), cal.get("laser_y"), cal.get("laser_theta")])
    mount = se2.compose(correction, mounting.T_base_laser)
    first = scans.stamps + cal.get("laser_delay")
    last = first + scans.time_increment * (scans.ranges.shape[1] - 1)
    ends = [se2.compose(recording.dense_trajectory(graph.poses, stamps), mount) for stamps in (first, last)]
    return Sweeps(scans, ends[0], ends[1], mounting.laser_flipped)
