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
from .graph.calibration import LASER, freed, with_real_heights
from .graph.graph import Edges, Graph
from .graph.marginals import marginals
from .graph.solver import optimize
from .grid import occupancy_grid
from .grid.geometry import GridGeometry
from .grid.occupancy_grid import OccupancyGrid, Sweeps
from .lidar import joint_refinement, laser_mounting
from .lidar.clouds import Clouds
from .lidar.joint_refinement import Refined
from .loop_closure import closures
from .loop_closure.closures import Closures
from .map_result import MapResult
from .mapping_config import MappingConfig
from .pipeline import closure_rounds, landmark_ties, lidar_stages, map_frame, moved_anchors, radio_stages, recordings, summary
from .pipeline.lidar_stages import Scans
from .pipeline.progress import Progress, Stages
from .pipeline.recordings import Drives, Part, Session
from .pipeline.scan_selection import thinned
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
    logs = [_upright(log, config, stages) for log in logs]
    logs = [thinned(log, config.keyframes, config.grid) for log in logs]

    drives = recordings.gather(logs, config.keyframes)
    travelled = sum(float(s.frames.path.sum()) for s in drives.sessions)
    stages.end("keyframes", keyframes=len(drives.stamps), travelled=round(travelled, 3))

    parts = [radio_stages.measurements(session, config) for session in drives.sessions]
    ranges = sum(len(part.radio) for part in parts if part.radio is not None)
    stages.end("edges", odometry=sum(len(part.wheels) for part in parts), ranges=ranges)

    part = radio_stages.first_optimisation(parts, drives, config, stages)
    part = radio_stages.constrained(part, known, drives, config, stages)

    scans = Scans.of(drives, known, config)
    found = closures.no_closures()
    tracked: Refined | None = None
    refined: Refined | None = None
    if scans is not None:
        stages.end("clouds", points=len(scans.clouds.points))
        part = replace(part, graph=freed(part.graph, *LASER))
        if config.tracking.on:
            part, tracked, scans = lidar_stages.track(part, scans, drives, config, stages)
            part = radio_stages.heard_anew(part, tracked, config, stages)
        if config.use_loops:
            held = () if tracked is None else (tracked.edges,)
            close = closure_rounds.close if config.loops.method == "search" else closure_rounds.close_plainly
            part, found = close(part, (*part.edges, *held), scans, drives, config, stages, executor)
            part = radio_stages.weighed_anew(part, (*held, found.edges), config)
            part, refined = lidar_stages.refine_jointly(part, scans, drives, config, stages)
            apart = moved_anchors.apart(part, drives, config.solver, config.ranges)
            if apart.warnings:
                stages.warnings += apart.warnings
                part, refined = lidar_stages.refine_jointly(apart.part, scans, drives, config, stages)
        lidar_stages.look_again(part, scans, drives, stages)
    if known.landmark_distances:
        part, refined = _measured_distances(part, found, tracked, refined, known, scans, drives, config, stages)
    part = _final(part, found, tracked, refined)
    walls = _walls(scans, config)
    weighed_anew = refined is not None and part.radio is not None
    # What only matching needed is most of the memory.
    scans = tracked = refined = None
    if weighed_anew:
        part = replace(part, graph=with_real_heights(optimize(part.graph, config.solver)[0]))
    part = _aligned(part, walls, config)

    grid = _grid(drives, part.graph, config, executor, stages)
    uncertainty = marginals(joint_refinement.with_fewer_pairs(part.graph))
    result = summary.summarise(
        drives, part, uncertainty, found, grid, config.calibration, stages.done, stages.warnings, stages.doubts
    )
    stages.end("summary")
    return replace(result, stages=tuple(stages.done))


def _upright(log: SensorLog, config: MappingConfig, stages: Stages) -> SensorLog:
    """Return the recording with the laser the way up that its turns show."""
    seen = laser_mounting.compare(log, _TURNS) if config.turn_laser and log.scans is not None else None
    if seen is None or not (seen.agree and seen.turned_over):
        return log
    flipped = not log.mounting.laser_flipped
    stages.warnings.append(
        f"the laser is mounted {'upside down' if flipped else 'upright'}, not as told: so its turns agree "
        f"{seen.told / max(seen.other, 1e-6):.0f} times better with the wheels'; it was taken that way"
    )
    return replace(log, mounting=replace(log.mounting, laser_flipped=flipped))


_TURNS = 300
"""Scan pairs looked at for the way up of the laser."""


def _final(part: Part, closures: Closures, tracked: Refined | None, refined: Refined | None) -> Part:
    """Return the graph with every measurement that holds it; the joint refinement's take the place of all other scans'."""
    if refined is not None:
        return replace(part, graph=part.graph.with_edges(*part.edges, refined.edges))
    lidar: tuple[Edges, ...] = (closures.edges,) if tracked is None else (tracked.edges, closures.edges)
    return replace(part, graph=part.graph.with_edges(*part.edges, *lidar))


def _measured_distances(
    part: Part, closures: Closures, tracked: Refined | None, refined: Refined | None, known: Constraints,
    scans: Scans | None, drives: Drives, config: MappingConfig, stages: Stages
) -> tuple[Part, Refined | None]:
    """Let true distances between landmarks pull on the map as it is without them."""
    if scans is None:
        raise ConfigError("constraints: distances between landmarks need the lidar, which sees them")
    held = _final(part, closures, tracked, refined)
    poses = se2.compose(_alignment(held, _walls(scans, config), config), held.graph.poses)
    tied = landmark_ties.ties(known, scans.clouds, poses, drives.path)
    solved = optimize(held.graph.with_edges(tied.edges), config.solver)[0]
    part = replace(part, graph=part.graph.with_edges(tied.edges).with_estimates_of(solved))
    if refined is not None:
        part, refined = lidar_stages.refine_jointly(part, scans, drives, config, stages)
    figures, warnings = landmark_ties.outcome(known, tied, part.graph)
    stages.warnings += warnings
    stages.end("measured distances", distances=figures)
    return part, refined


def _walls(scans: Scans | None, config: MappingConfig) -> Clouds | None:
    """Return what shows the walls, where the map's axes are to follow them."""
    return scans.clouds if scans is not None and config.align == "walls" else None


def _aligned(part: Part, walls: Clouds | None, config: MappingConfig) -> Part:
    """Put the map's axes where the settings want them."""
    motion = _alignment(part, walls, config)
    return replace(part, graph=map_frame.moved(part.graph, motion), first=recordings.moved_hypotheses(part.first, motion))


def _alignment(part: Part, walls: Clouds | None, config: MappingConfig) -> Floats:
    """Return T_new_map (3,), by which the map is turned to where the settings want its axes."""
    graph, normals = part.graph, np.zeros((0, 2))
    placed = np.zeros(len(graph.anchors), dtype=bool) if part.first is None else part.first.placed
    if walls is not None:
        normals = se2.rotate(graph.poses[walls.owner, 2], walls.normals)
    return map_frame.alignment(config.align, graph, placed, normals)


def _grid(
    drives: Drives, graph: Graph, config: MappingConfig, executor: Executor | None, stages: Stages
) -> OccupancyGrid | None:
    """Trace every scan from where the laser was at its first and last ray (paper: Bresenham, binary Bayes filter)."""
    sweeps = [_sweeps(session, graph) for session in drives.sessions if session.has_scans]
    if not sweeps:
        return None

    def announce(geometry: GridGeometry) -> None:
        """Say what a large grid will take; the caller may still stop."""
        if geometry.cells >= _LARGE_GRID:
            stages.tell(f"occupancy grid of {geometry.cells / 1e6:.0f} million cells, about {geometry.megabytes:.0f} MB", 0, 1)

    teller = stages.teller("occupancy grid")
    grid = occupancy_grid.from_sweeps(sweeps, config.grid, executor=executor, progress=teller, announce=announce)
    if config.crop is not None:
        grid = map_frame.cropped(grid, config.crop)
    stages.end("occupancy grid", scans=grid.scans_used, rows=grid.geometry.rows, cols=grid.geometry.cols)
    return grid


def _sweeps(session: Session, graph: Graph) -> Sweeps:
    """Return the scans of a recording with where its laser was."""
    scans, mounting, cal = session.log.scans, session.log.mounting, graph.calibration
    assert scans is not None
    correction = np.array([cal.get("laser_x"), cal.get("laser_y"), cal.get("laser_theta")])
    mount = se2.compose(correction, mounting.T_base_laser)
    first = scans.stamps + cal.get("laser_delay")
    last = first + scans.time_increment * (scans.ranges.shape[1] - 1)
    ends = [se2.compose(session.dense_trajectory(graph.poses, stamps), mount) for stamps in (first, last)]
    return Sweeps(scans, ends[0], ends[1], mounting.laser_flipped)
