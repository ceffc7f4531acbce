"""The walk's first half: what wheels and radio say, from nothing to the first optimisation.

Each recording grows on its own, recordings are joined, what the user knows is added; later, when the lidar has
stiffened the trajectory, the ranges are judged anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import keyframes, se2
from ..constraints import Constraints
from ..errors import ConfigError
from ..graph import calibration
from ..graph.calibration import RADIO, WHEELS, freed, with_real_heights
from ..graph.graph import Edges, Graph
from ..graph.solver import optimize
from ..lidar.joint_refinement import Refined
from ..mapping_config import MappingConfig
from ..radio import bootstrap, prior_selection
from ..radio.range_measurements import learn_noise, range_edges, relocate
from ..radio.range_noise import short_term_sigma
from ..wheels import wheel_edges
from . import joining, map_frame, recordings
from .constraint_edges import apply as apply_constraints
from .progress import Stages, solver_figures
from .recordings import Drives, Part, Session


def measurements(session: Session, config: MappingConfig) -> Part:
    """Return a recording's graph by dead reckoning with its calibration priors, and what its wheels and radio measured."""
    log, frames, ids = session.log, session.frames, session.anchor_ids
    told = np.array([log.mounting.height_difference(a) is not None for a in ids], dtype=bool)
    listed = calibration.unknowns(config.calibration, ids, told)
    block = calibration.block(listed)
    graph = Graph(frames.odometry.copy(), np.zeros((len(ids), 2)), (), block)
    graph = graph.with_edges(calibration.prior_edges(listed))
    graph = freed(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), *WHEELS, "bias", "range_scale")
    wheels = wheel_edges(frames, 0, config.odometry, block)
    if log.ranges is None:
        return Part(graph, wheels, None, None, ids)
    attached = keyframes.attach_ranges(log.ranges, log.odometry, frames, log.mounting)
    radio = range_edges(attached, 0, ids, log.mounting, block, config.ranges.sigma, config.anchors, config.ranges.kernel)
    return Part(graph, wheels, radio if np.any(radio.weights) else None, None, ids)


def first_optimisation(parts: Sequence[Part], drives: Drives, config: MappingConfig, stages: Stages) -> Part:
    """Grow each recording from nothing, bring them together and optimise wheels and radio (paper: first optimisation)."""
    parts = [_settled(_grown(part, drives, n, config, stages), config, stages) for n, part in enumerate(parts)]
    joined = joining.join(parts, drives)
    stages.warnings += joined.warnings
    if len(parts) == 1:
        return joined.part
    return _settled(joined.part, config, stages)


def _grown(part: Part, drives: Drives, number: int, config: MappingConfig, stages: Stages) -> Part:
    """Grow trajectory and anchors of one recording."""
    radio, path = part.radio, drives.path[drives.sessions[number].rows]
    if radio is None:
        return part
    alive = np.asarray(radio.weights) > 0
    sigma = short_term_sigma(radio.stamps[alive], radio.anchor[alive], radio.ranges[alive], config.ranges)
    growth = replace(config.growth, range_sigma=max(1.5 * sigma, config.growth.least_sigma))
    first = bootstrap.grow(part.graph, part.wheels, radio, path - path[0], growth, config.anchors)
    whose = {"recording": number + 1} if len(drives) > 1 else {}
    stages.end("first estimate", range_sigma=round(sigma, 4), placed=int(first.placed.sum()), **whose)
    # It grew from the middle; the map begins where the odometry did.
    back = se2.compose(part.graph.poses[0], se2.inverse(first.graph.poses[0]))
    graph = replace(part.graph.with_estimates_of(map_frame.moved(first.graph, back)), fixed_anchors=~first.placed)
    radio = replace(radio, weights=(alive & first.placed[radio.anchor]).astype(np.float64))
    return replace(part, graph=graph, radio=radio, first=recordings.moved_hypotheses(first, back))


def _settled(part: Part, config: MappingConfig, stages: Stages) -> Part:
    """Optimise wheels and radio together, the ranges' noise learnt by the way."""
    graph, radio = part.graph, part.radio
    if radio is None or part.first is None:
        return part
    for lap in range(3):
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        if lap == 2:
            graph = freed(prior_selection.choose_widths(graph, (part.wheels, radio), config.calibration), *RADIO)
        solved, result = optimize(graph.with_edges(part.wheels, radio), config.solver)
        graph = with_real_heights(graph.with_estimates_of(solved))
        stages.tell("first optimisation", lap + 1, 3)
    stages.end("first optimisation", placed=int(part.first.placed.sum()), **solver_figures(result))
    return replace(part, graph=graph, radio=radio)


def constrained(part: Part, known: Constraints, drives: Drives, config: MappingConfig, stages: Stages) -> Part:
    """Bring the first estimate into the user's frame, where one is known, and add what is known beforehand."""
    if known == Constraints():
        return part
    if known.places and config.align != "odometry":
        raise ConfigError("known places say where the map lies; leave out align, or the places")
    placed = np.zeros(len(part.anchor_ids), dtype=bool) if part.first is None else part.first.placed
    done = apply_constraints(known, part.graph, part.anchor_ids, placed, drives.clock)
    stages.warnings += [
        f"anchor {name} stands {off:.2f} m from its earlier place: it was moved" for name, off in done.moved.items()
    ]
    graph = done.graph.with_estimates_of(optimize(done.graph.with_edges(*part.edges), config.solver)[0])
    stages.end("constraints", moved=sorted(done.moved), shift=[round(v, 4) for v in done.motion.tolist()])
    return replace(part, graph=graph, first=recordings.moved_hypotheses(part.first, done.motion))


def heard_anew(part: Part, tracked: Refined, config: MappingConfig, stages: Stages) -> Part:
    """Judge the ranges anew on the trajectory that neighbouring clouds have stiffened.

    Wheels alone are soft enough to be bent until anchors that lie for minutes seem to tell the truth. On the stiffer
    chain lies stand out.
    """
    graph, radio = part.graph, part.radio
    if radio is None:
        return part
    roughly = replace(config.solver, max_iterations=min(config.solver.max_iterations, _ROUGHLY))
    for solver in (roughly, config.solver):
        graph = relocate(radio, graph, ~np.asarray(graph.fixed_anchors), config.anchors)
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        graph = graph.with_estimates_of(optimize(graph.with_edges(part.wheels, radio, tracked.edges), solver)[0])
    stages.end("ranges judged anew")
    return replace(part, graph=with_real_heights(graph), radio=radio)


def weighed_anew(part: Part, lidar: Sequence[Edges], config: MappingConfig) -> Part:
    """Learn the ranges' noise where the lidar puts them, and how wide their errors' priors ought to be.

    Parameters
    ----------
    lidar : what scans measured.
    """
    if part.radio is None:
        return part
    radio, _ = learn_noise(part.radio, part.graph, len(part.graph.anchors), config.ranges, steady=True)
    part = replace(part, radio=radio)
    return replace(part, graph=prior_selection.choose_widths(part.graph, (*part.edges, *lidar), config.calibration))


_ROUGHLY = 12
"""Iterations of an optimisation that another follows."""
