"""The algorithm on one page: from recordings to trajectories, anchors and map.

``build_map`` goes through the paper's stages: keyframes and edges, first optimisation with odometry and ranges, and those of
``_stages``: sub-maps and loop closures, second optimisation with lidar edges; occupancy grid. Additions to the paper
are the calibration in the same least squares, noise estimated from the data, scan-to-scan matching between neighbouring
clouds and the joint refinement of all of them. Every stage takes one Estimate and returns one.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from .assessment import summary
from .constraints import Constraints
from .map_result import MapResult
from .pipeline import (
    anchor_places,
    broken_stretches,
    calibration_checks,
    closure_rounds,
    constraint_edges,
    final_stages,
    lidar_stages,
    map_frame,
    neighbour_matching,
    radio_stages,
    range_alternatives,
    surface_adjustment,
)
from .pipeline.estimate import Estimate, Task
from .pipeline.mapping_config import MappingConfig
from .pipeline.progress import Progress, Stage, Stages
from .pipeline.recordings import check_distinct, gather, prepared, require_types
from .sensor_log import SensorLog

__all__ = ["MapResult", "MappingConfig", "Progress", "SensorLog", "Stage", "build_map"]


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
    logs : the recording, ranges or scans may be missing; or several with ranges to the same anchors, by whatever robots on
        whatever days: they become one map, in the frame of the first unless constraints or `align` say otherwise.
    config : settings; None = defaults.
    constraints : what is known beforehand: surveyed anchors, pinned poses, an earlier map's anchors ...
    progress : called as progress(stage, done, total); returning False raises Cancelled.
    executor : any concurrent.futures executor; the result does not depend on it.
    clock : seconds, for the stages' timings; None = no timings.

    Raises
    ------
    DataError : there is nothing to map, or recordings share too few anchors, or measurements; an argument is of another type.
    Cancelled : the callback asked to stop.
    """
    require_types(logs, config, constraints)
    config, stages = config or MappingConfig(), Stages(progress, clock)
    logs = [logs] if isinstance(logs, SensorLog) else logs
    check_distinct(logs)
    logs = [prepared(log, config) for log in logs]
    config = calibration_checks.without_known_calibration(calibration_checks.with_units_checked(config, logs), logs)
    task = Task(gather(logs, config.keyframes), config, constraints or Constraints(), stages, executor)
    estimate, task = _first_optimisation(task, logs)
    range_alternatives.check_heights(estimate, task)
    for stage in _stages(task):
        estimate = stage(estimate, task)
        task = task.following(estimate)
    covariance = final_stages.covariances_of(estimate, task)
    grid = final_stages.occupancy_grid(estimate, task)
    return summary.summarise(estimate, covariance, grid, task)


def _first_optimisation(task: Task, logs: list[SensorLog]) -> tuple[Estimate, Task]:
    """Return the first optimisation, with odometry multiplied by a factor where the ranges show that its unit is wrong."""
    estimate, config = radio_stages.first_optimisation(task), task.config
    factors = calibration_checks.odometry_unit_factors(estimate, task)
    if np.all(factors == 1.0):
        return estimate, task
    logs = [log.with_odometry_times(factor) for log, factor in zip(logs, factors.tolist(), strict=True)]
    # A unit that was set by the ranges gives no information about the unit of the ranges.
    free = replace(config.calibration, odometry_scale=config.calibration.odometry_unit)
    task = replace(task, recordings=gather(logs, config.keyframes), config=replace(config, calibration=free))
    return radio_stages.first_optimisation(task), task


def _stages(task: Task) -> Iterator[Callable[[Estimate, Task], Estimate]]:
    """Yield the stages that follow the first optimisation, by what was recorded, given and asked for."""
    config, constraints = task.config, task.constraints
    if constraints != Constraints():
        yield constraint_edges.apply_given
    if task.recordings.have_scans:
        yield neighbour_matching.match_scan_to_scan if config.scan_to_scan.on else neighbour_matching.make_clouds
        if config.scan_to_scan.on:
            yield radio_stages.reestimate_ranges
            yield calibration_checks.with_slip_in_turns
        if config.use_loops:
            yield closure_rounds.close_loops if config.loop_closure.method == "search" else closure_rounds.close_loops_as_paper
            yield anchor_places.decide_places
            yield radio_stages.reestimate_noise_and_priors
            if config.refinement.rounds:
                yield lidar_stages.refine_jointly
                yield lidar_stages.solve_by_own_errors
                yield surface_adjustment.adjust_surfaces
                yield broken_stretches.replace_broken_stretches
        yield lidar_stages.place_scans_between
        yield lidar_stages.check_map_consistency
    if not (task.recordings.have_scans and config.use_loops):
        yield anchor_places.decide_places
    if constraints.landmark_distances:
        yield constraint_edges.tie_landmarks
    yield anchor_places.name_new_and_absent_anchors
    yield final_stages.final_optimisation
    yield range_alternatives.find_mirror_images
    yield map_frame.align_axes
