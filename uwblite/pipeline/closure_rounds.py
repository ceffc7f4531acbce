"""Rounds of loop closing: candidates among sub-maps, matches, second optimisation, until nothing is left to be tried."""

from dataclasses import replace

import numpy as np

from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..graph.solver import optimize
from ..lidar import submaps, visibility
from ..loop_closure import candidates as closure_candidates
from ..loop_closure import closures, paper_method, verification
from ..loop_closure.candidates import CandidatePolicy, Tried
from ..loop_closure.closures import Closures
from .estimate import Estimate, Task
from .progress import Stage, solver_figures


def close_loops(estimate: Estimate, task: Task) -> Estimate:
    """Build sub-maps, find closures among them and solve again, the likeliest pairs first (paper: second optimisation)."""
    config, recordings, with_ranges = task.config, task.recordings, estimate.ranges is not None
    rules, of, base, found = config.loop_closure, recordings.of_keyframe, estimate.problem, closures.no_closures()
    scans = estimate.lidar.clouds
    pieces = submaps.build(scans, base.poses, recordings.path, of, config.submaps, submaps.overlapping)
    free = visibility.observed_free_space(scans, pieces, base.poses)
    pieces = visibility.static_points(pieces, free)
    covariance, tried = JointCovariance(base, pieces.reference), Tried()
    for lap in range(rules.rounds):
        candidates = closure_candidates.propose(base, covariance, pieces, of, tried, with_ranges, rules)
        if lap and not len(candidates.target):
            break
        # Each closed loop makes the others more certain, and their searches smaller.
        candidates = candidates.rows(np.cumsum(candidates.spread > rules.direct) <= CandidatePolicy.at_once)
        certain, before = bool(np.all(candidates.spread <= rules.direct)), base.poses
        tried |= candidates.names(rules)
        report = task.stages.reporter("loop closure")
        new = verification.find(candidates, pieces, free, rules, config.correlative, report, task.executor)
        new = _without_forbidden(new, task)
        base, found = _reconciled(base, found, new, task)
        counts = {"candidates": len(candidates.target), "accepted": len(new.edges), "kept": len(found.edges)}
        task.stages.end(Stage("loop closure", lap + 1), submaps=len(pieces), **counts)
        if certain and np.hypot(*(base.poses - before)[:, :2].T).max() < config.refinement.first_gate:
            # From here the joint refinement matches whatever further closures would connect.
            break
        if len(new.edges):
            covariance = JointCovariance(base.with_edges(found.edges), pieces.reference)
    return replace(estimate, closures=found).with_estimates_of(base)


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
