"""The walk's first half: what wheels and radio say, from nothing to the first optimisation.

Each recording grows on its own, recordings are joined, what the user knows is added; later, when the lidar has
stiffened the trajectory, the ranges are judged anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import keyframes, se2
from ..arrays import Floats
from ..constraints import Constraints
from ..errors import ConfigError
from ..graph import calibration
from ..graph.calibration import RADIO, WHEELS, with_free, with_nonnegative_heights
from ..graph.graph import Edges, Graph
from ..graph.solver import optimize
from ..lidar.joint_refinement import RefinementResult
from ..mapping_config import MappingConfig
from ..radio import bootstrap, prior_selection
from ..radio.range_measurements import learn_noise, range_edges, relocate
from ..radio.range_noise import short_term_sigma
from ..wheels import wheel_edges
from . import joining, map_frame
from .constraint_edges import apply as apply_constraints
from .progress import Stages, solver_figures
from .recordings import Estimate, Recording, Recordings, moved_hypotheses


def measurements(recording: Recording, config: MappingConfig) -> Estimate:
    """Return a recording's graph by dead reckoning with its calibration priors, and what its wheels and radio measured."""
    log, frames, ids = recording.log, recording.frames, recording.anchor_ids
    told = np.array([log.mounting.height_difference(a) is not None for a in ids], dtype=bool)
    listed = calibration.unknowns(config.calibration, ids, told)
    block = calibration.block(listed)
    graph = Graph(frames.odometry.copy(), np.zeros((len(ids), 2)), (), block)
    graph = graph.with_edges(calibration.prior_edges(listed))
    graph = with_free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), *WHEELS, "bias", "range_scale")
    wheels = wheel_edges(frames, 0, config.odometry, block)
    if log.ranges is None:
        return Estimate(graph, wheels, None, None, ids)
    attached = keyframes.attach_ranges(log.ranges, log.odometry, frames, log.mounting)
    radio = range_edges(attached, 0, ids, log.mounting, block, config.ranges.sigma, config.anchors, config.ranges.kernel)
    return Estimate(graph, wheels, radio if np.any(radio.weights) else None, None, ids)


def first_optimisation(
    estimates: Sequence[Estimate], recordings: Recordings, config: MappingConfig, stages: Stages
) -> Estimate:
    """Grow each recording from nothing, bring them together and optimise wheels and radio (paper: first optimisation)."""
    estimates = [
        _settled(_grown(estimate, recordings, n, config, stages), config, stages) for n, estimate in enumerate(estimates)
    ]
    joined = joining.join(estimates, recordings)
    stages.warnings += joined.warnings
    if len(estimates) == 1:
        return joined.estimate
    return _settled(joined.estimate, config, stages)


def _grown(estimate: Estimate, recordings: Recordings, number: int, config: MappingConfig, stages: Stages) -> Estimate:
    """Grow trajectory and anchors of one recording."""
    radio, path = estimate.radio, recordings.path[recordings.each[number].rows]
    if radio is None:
        return estimate
    alive = np.asarray(radio.weights) > 0
    sigma = short_term_sigma(radio.stamps[alive], radio.anchor[alive], radio.ranges[alive], config.ranges)
    growth = replace(config.growth, range_sigma=max(1.5 * sigma, config.growth.least_sigma))
    first = bootstrap.bootstrap_graph(estimate.graph, estimate.wheels, radio, path - path[0], growth, config.anchors)
    whose = {"recording": number + 1} if len(recordings) > 1 else {}
    stages.end("first estimate", range_sigma=round(sigma, 4), placed=int(first.placed.sum()), **whose)
    # It grew from the middle; the map begins where the odometry did.
    back = se2.compose(estimate.graph.poses[0], se2.inverse(first.graph.poses[0]))
    graph = replace(estimate.graph.with_estimates_of(map_frame.moved(first.graph, back)), fixed_anchors=~first.placed)
    radio = replace(radio, weights=(alive & first.placed[radio.anchor]).astype(np.float64))
    return replace(estimate, graph=graph, radio=radio, first=moved_hypotheses(first, back))


def _settled(estimate: Estimate, config: MappingConfig, stages: Stages) -> Estimate:
    """Optimise wheels and radio together, the ranges' noise learnt by the way."""
    graph, radio = estimate.graph, estimate.radio
    if radio is None or estimate.first is None:
        return estimate
    for lap in range(3):
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        if lap == 2:
            graph = with_free(prior_selection.select_priors(graph, (estimate.wheels, radio), config.calibration), *RADIO)
        solved, result = optimize(graph.with_edges(estimate.wheels, radio), config.solver)
        graph = with_nonnegative_heights(graph.with_estimates_of(solved))
        stages.report("first optimisation", lap + 1, 3)
    stages.end("first optimisation", placed=int(estimate.first.placed.sum()), **solver_figures(result))
    return replace(estimate, graph=graph, radio=radio)


def units(estimate: Estimate, recordings: Recordings) -> Floats:
    """Return by what the odometry of each recording (r,) is to be multiplied to be in metres; 1 where it is, or nearly so."""
    known = estimate.graph.calibration
    names = [calibration.of_recording("odometry_scale", n) for n in range(len(recordings))]
    factor = np.array([1.0 + known.get(name) for name in names])
    return np.where(np.abs(factor - 1.0) > _OTHER_UNIT, factor, 1.0)


def unit_warnings(recordings: Recordings, factors: Floats) -> list[str]:
    """Return what to say of odometry that was in another unit; factors (r,), see units."""
    whose = [f"{r.name}: " if len(recordings) > 1 else "" for r in recordings.each]
    return [
        f"{name}by the ranges, which measure times of flight, the robot drove {factor:.3f} times as far as its odometry says: "
        "the unit of the wheels is wrong; the odometry was multiplied by that"
        for name, factor in zip(whose, factors.tolist(), strict=True) if factor != 1.0
    ]


_OTHER_UNIT = 0.12
"""Relative error of travelled distance from which on it is no wheel radius to be calibrated but another unit."""


def constrained(
    estimate: Estimate, known: Constraints, recordings: Recordings, config: MappingConfig, stages: Stages
) -> Estimate:
    """Bring the first estimate into the user's frame, where one is known, and add what is known beforehand."""
    if known == Constraints():
        return estimate
    if known.places and config.align != "odometry":
        raise ConfigError("known places say where the map lies; leave out align, or the places")
    placed = np.zeros(len(estimate.anchor_ids), dtype=bool) if estimate.first is None else estimate.first.placed
    done = apply_constraints(known, estimate.graph, estimate.anchor_ids, placed, recordings.clock)
    stages.warnings += [
        f"anchor {name} stands {off:.2f} m from its earlier place: it was moved" for name, off in done.moved.items()
    ]
    graph = done.graph.with_estimates_of(optimize(done.graph.with_edges(*estimate.edges), config.solver)[0])
    stages.end("constraints", moved=sorted(done.moved), shift=[round(v, 4) for v in done.motion.tolist()])
    return replace(estimate, graph=graph, first=moved_hypotheses(estimate.first, done.motion))


def reestimate_ranges(estimate: Estimate, tracked: RefinementResult, config: MappingConfig, stages: Stages) -> Estimate:
    """Judge the ranges anew on the trajectory that neighbouring clouds have stiffened.

    Wheels alone are soft enough to be bent until anchors that lie for minutes seem to tell the truth. On the stiffer
    chain lies stand out.
    """
    graph, radio = estimate.graph, estimate.radio
    if radio is None:
        return estimate
    roughly = replace(config.solver, max_iterations=min(config.solver.max_iterations, _ROUGHLY))
    for solver in (roughly, config.solver):
        graph = relocate(radio, graph, ~np.asarray(graph.fixed_anchors), config.anchors)
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        graph = graph.with_estimates_of(optimize(graph.with_edges(estimate.wheels, radio, tracked.edges), solver)[0])
    stages.end("ranges judged anew")
    return replace(estimate, graph=with_nonnegative_heights(graph), radio=radio)


def reestimate_range_noise(estimate: Estimate, lidar: Sequence[Edges], config: MappingConfig) -> Estimate:
    """Learn the ranges' noise where the lidar puts them, and how wide their errors' priors ought to be.

    Parameters
    ----------
    lidar : what scans measured.
    """
    if estimate.radio is None:
        return estimate
    radio, _ = learn_noise(estimate.radio, estimate.graph, len(estimate.graph.anchors), config.ranges, steady=True)
    estimate = replace(estimate, radio=radio)
    return replace(estimate, graph=prior_selection.select_priors(estimate.graph, (*estimate.edges, *lidar), config.calibration))


_ROUGHLY = 12
"""Iterations of an optimisation that another follows."""
