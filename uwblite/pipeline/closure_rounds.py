"""Rounds of loop closing: sub-maps, candidates, matches, second optimisation, until nothing new is found."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..graph.solver import optimize
from ..lidar import submaps, visibility
from ..lidar.submaps import Submaps
from ..lidar.visibility import FreeSpace
from ..loop_closure import candidates as closure_candidates
from ..loop_closure import closures, paper_method, verification
from ..loop_closure.candidates import Candidates, Tried
from ..loop_closure.closures import Closures, LoopClosureConfig
from .estimate import Estimate, Task
from .mapping_config import MappingConfig
from .progress import Stage, solver_figures


class RoundPolicy:
    """Rounds of loop closing."""

    per_stretch: int = 3
    """Sub-maps in half a stretch."""
    bent: float = 0.01
    """How far, m, closures may bend sub-maps, rms, before these are made again: an eighth of the cells that they average."""
    few: float = 0.05
    """Share of the closures up to which new ones change nothing."""
    wide_rounds: int = 12
    """Rounds of searching among long stretches, at most; a bound on the time where no loop closes."""


def close_loops(estimate: Estimate, task: Task) -> Estimate:
    """Build sub-maps, find closures among them and solve again, until nothing new is found (paper: second optimisation)."""
    config, recordings, scans = task.config, task.recordings, estimate.lidar
    rules, of, with_ranges = config.loop_closure, recordings.of_keyframe, estimate.ranges is not None
    base, found = estimate.problem, closures.no_closures()
    reference = submaps.cut(recordings.path, of, config.submaps.epsilon)[2]
    first, some = JointCovariance(base, reference), reference[:: RoundPolicy.per_stretch]
    covariance: JointCovariance | None = first
    if closure_candidates.any_uncertain(base, first, some, of, rules):
        base, found = _with_long_stretches_tied(base, estimate, task)
        covariance = None
    del first
    tried = Tried()
    refined = config.refinement.rounds > 0 and not estimate.rests_on_ranges
    pieces, built, dynamic = None, base.poses, 0.0
    for lap in range(rules.rounds):
        if pieces is None or pieces.bent(built, base.poses) > RoundPolicy.bent:
            pieces = submaps.build(scans.clouds, base.poses, recordings.path, of, config.submaps)
            (pieces, free), built = _static(pieces, base, estimate), base.poses
            dynamic = visibility.dynamic_share(pieces, free, base.poses, of)
        covariance = covariance or JointCovariance(base.with_edges(found.edges), pieces.reference)
        candidates = closure_candidates.propose(base, covariance, pieces, of, tried, with_ranges, rules)
        covariance = None  # For a thousand sub-maps it takes a hundred megabytes.
        tried |= candidates.names(rules)
        loose = replace(rules, through=max(rules.through, dynamic))
        new = _verified(candidates, pieces, free, loose, task, task.stages.reporter("loop closure"))
        before = base.poses
        base, found = _reconciled(base, found, new, task)
        counts = {"candidates": len(candidates.target), "accepted": len(new.edges), "kept": len(found.edges)}
        task.stages.end(Stage("loop closure", lap + 1), submaps=len(pieces), **counts)
        if len(new.edges) <= RoundPolicy.few * len(found.edges) or (refined and _settled(candidates, before, base, config)):
            break
    return replace(estimate, closures=found).with_estimates_of(base)


def _settled(candidates: Candidates, before: Floats, graph: Graph, config: MappingConfig) -> bool:
    """Return whether the joint refinement matches from the poses of a graph whatever further closures would connect.

    Parameters
    ----------
    before : (k, 3) poses without the closures of these candidates.
    """
    moved = np.hypot(*(graph.poses - before)[:, :2].T)
    certain = candidates.spread <= config.loop_closure.direct
    return bool(certain.all()) and float(moved.max(initial=0.0)) < config.refinement.first_gate


def _with_long_stretches_tied(base: Graph, estimate: Estimate, task: Task) -> tuple[Graph, Closures]:
    """Close loops whose ends are too uncertain for a search of sub-maps, the most certain first, in rounds.

    Returns
    -------
    The solved graph and the closures.
    """
    recordings, rules, found = task.recordings, task.config.loop_closure, closures.no_closures()
    first, last, reference = closure_candidates.cut(recordings.path, recordings.of_keyframe)
    covariance = JointCovariance(base, reference)
    pieces = submaps.of_pieces(estimate.lidar.clouds, base.poses, first, last, reference, task.config.submaps)
    pieces, free = _static(pieces, base, estimate)
    tried, with_ranges = Tried(), estimate.ranges is not None
    for _ in range(RoundPolicy.wide_rounds):
        pairs = closure_candidates.first_of(
            closure_candidates.uncertain_pairs(
                base, covariance, pieces, recordings.of_keyframe, tried, with_ranges, rules, rules.direct
            )
        )
        if not len(pairs.target):
            break
        tried |= pairs.names(rules)
        new = _verified(pairs, pieces, free, rules, task)
        base, found = _reconciled(base, found, new, task)
        if len(new.edges):
            base, found = verification.without_look_alikes(base, found, recordings.path, task.config.solver)
            covariance = JointCovariance(base.with_edges(found.edges), reference)
    if not tried:
        return base, found
    task.stages.end("long stretches", stretches=len(pieces), candidates=len(tried), accepted=len(found.edges))
    return base, found


def close_loops_as_paper(estimate: Estimate, task: Task) -> Estimate:
    """Align sub-maps pair by pair by ICP and solve once more with those that fit (paper: second optimisation)."""
    config, recordings, scans = task.config, task.recordings, estimate.lidar
    edges = (*estimate.odometry_and_ranges, *estimate.steps_and_closures)
    for lap in range(config.loop_closure.rounds):
        graph = estimate.graph
        pieces = submaps.build(scans.clouds, graph.poses, recordings.path, recordings.of_keyframe, config.submaps)
        reporter = task.stages.reporter("loop closure")
        found = paper_method.find(
            graph, pieces, recordings.of_keyframe, config.loop_closure, config.icp, reporter, task.executor
        )
        found = _without_forbidden(found, task)
        task.stages.end(
            Stage("loop closure", lap + 1), submaps=len(pieces), candidates=len(found.candidates), accepted=len(found.edges)
        )
        solved, result = optimize(graph.with_edges(*edges, found.edges), config.solver)
        estimate = replace(estimate, closures=found).with_estimates_of(solved)
        task.stages.end(Stage("second optimisation", lap + 1), **solver_figures(result))
    return estimate


def _static(pieces: Submaps, graph: Graph, estimate: Estimate) -> tuple[Submaps, list[FreeSpace]]:
    """Return sub-maps without moving objects, and the observed free space of each."""
    free = visibility.observed_free_space(estimate.lidar.clouds, pieces, graph.poses)
    return visibility.static_points(pieces, free), free


def _verified(
    candidates: Candidates, pieces: Submaps, free: Sequence[FreeSpace], rules: LoopClosureConfig, task: Task,
    report: Callable[[int, int], None] | None = None,
) -> Closures:
    """Match candidates and return the outcome of each."""
    found = verification.find(candidates, pieces, rules, task.config.correlative, report, free, task.executor)
    return _without_forbidden(found, task)


def _reconciled(base: Graph, found: Closures, new: Closures, task: Task) -> tuple[Graph, Closures]:
    """Solve a graph with closures and new ones, and drop those that disagree."""
    found = closures.merged(found, new)
    if not len(new.edges):
        return base, found
    return verification.reconcile(base, found, task.config.loop_closure, task.config.solver)


def _without_forbidden(found: Closures, task: Task) -> Closures:
    """Return closures with those the user has forbidden rejected."""
    kept = task.allowed(found.edges.i, found.edges.j)
    return found if kept.all() else found.without(kept, "forbidden", ["forbidden by the constraints"] * len(kept))
