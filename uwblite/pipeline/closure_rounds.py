"""Rounds of loop closing: sub-maps, candidates, matches, second optimisation, until nothing new is found."""

from dataclasses import replace

from ..graph.marginals import JointCovariance
from ..graph.solver import optimize
from ..lidar import submaps, visibility
from ..loop_closure import candidates as closure_candidates
from ..loop_closure import closures, paper_method, verification
from ..loop_closure.closures import Closures
from .estimate import Estimate, Task
from .progress import Stage, solver_figures


def close_loops(estimate: Estimate, task: Task) -> Estimate:
    """Build sub-maps, find closures among them and solve again, until nothing new is found (paper: second optimisation)."""
    config, recordings, scans = task.config, task.recordings, estimate.scans
    assert scans is not None
    base = estimate.graph.with_edges(*estimate.odometry_and_ranges, *estimate.steps_and_closures)
    found = closures.no_closures()
    tried: set[tuple[int, int, bool]] = set()
    missed: set[tuple[int, int]] = set()
    with_ranges = estimate.ranges is not None
    for lap in range(config.loop_closure.rounds):
        pieces = submaps.build(scans.clouds, base.poses, recordings.path, recordings.of_keyframe, config.submaps)
        free = visibility.observed_free_space(scans.clouds, pieces, base.poses)
        pieces = visibility.static_points(pieces, free)
        covariance = JointCovariance(base.with_edges(found.edges), pieces.reference)
        candidates = closure_candidates.propose(
            base, covariance, pieces, recordings.of_keyframe, tried, missed, with_ranges, config.loop_closure
        )
        tried |= candidates.names(config.loop_closure)
        dynamic = visibility.dynamic_share(pieces, free, base.poses, recordings.of_keyframe)
        rules = replace(config.loop_closure, through=max(config.loop_closure.through, dynamic))
        reporter = task.stages.reporter("loop closure")
        new = verification.find(candidates, pieces, rules, config.correlative, reporter, free, task.executor)
        new = _without_forbidden(new, task)
        missed |= set() if with_ranges else closure_candidates.missed(candidates, new, config.loop_closure)
        found = closures.merged(found, new)
        base, found = verification.reconcile(base, found, config.loop_closure, config.solver)
        task.stages.end(
            Stage("loop closure", lap + 1), submaps=len(pieces), candidates=len(candidates.target),
            accepted=len(new.edges), kept=len(found.edges),
        )  # fmt: skip
        tied = len(found.edges) >= config.loop_closure.enough * len(pieces)
        unsearched = missed - {(a, b) for a, b, searched in tried if searched}
        if (tied or len(new.edges) <= 0.05 * len(found.edges)) and not unsearched:
            break
    return replace(estimate, closures=found).with_estimates_of(base)


def close_loops_as_paper(estimate: Estimate, task: Task) -> Estimate:
    """Align sub-maps pair by pair by ICP and solve once more with those that fit (paper: second optimisation)."""
    config, recordings, scans = task.config, task.recordings, estimate.scans
    assert scans is not None
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


def _without_forbidden(found: Closures, task: Task) -> Closures:
    """Return closures with those the user has forbidden rejected."""
    kept = task.allowed(found.edges.i, found.edges.j)
    return found if kept.all() else found.without(kept, "forbidden", ["forbidden by the constraints"] * len(kept))
