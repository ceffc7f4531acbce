"""Rounds of closing loops: sub-maps, candidates, matches, second optimisation, until nothing new is found."""

from concurrent.futures import Executor
from dataclasses import replace

from ..graph.graph import Edges
from ..graph.marginals import JointCovariance
from ..graph.solver import optimize
from ..lidar import submaps, visibility
from ..loop_closure import candidates as closure_candidates
from ..loop_closure import closures, paper_method, verification
from ..loop_closure.closures import Closures
from ..mapping_config import MappingConfig
from .lidar_stages import Scans
from .progress import Stages, solver_figures
from .recordings import Estimate, Recordings


def close(
    estimate: Estimate, edges: tuple[Edges, ...], scans: Scans, recordings: Recordings, config: MappingConfig, stages: Stages,
    executor: Executor | None,
) -> tuple[Estimate, Closures]:
    """Build sub-maps, find closures among them and solve again, until nothing new is found (paper: second optimisation)."""
    recording = recordings.of_keyframe
    base = estimate.graph.with_edges(*edges)
    found = closures.no_closures()
    tried: set[tuple[int, int, bool]] = set()
    missed: set[tuple[int, int]] = set()
    held = estimate.radio is not None
    for lap in range(config.loops.rounds):
        pieces = submaps.build(scans.clouds, base.poses, recordings.path, recording, config.submaps)
        free = visibility.observed_free_space(scans.clouds, pieces, base.poses)
        pieces = visibility.static_points(pieces, free)
        known = JointCovariance(base.with_edges(found.edges), pieces.reference)
        candidates = closure_candidates.propose(base, known, pieces, recording, tried, missed, held, config.loops)
        tried |= candidates.names(config.loops)
        reporter = stages.reporter("loop closure")
        rules = replace(
            config.loops, through=max(config.loops.through, visibility.dynamic_share(pieces, free, base.poses, recording))
        )
        new = verification.find(candidates, pieces, rules, config.search, reporter, free, executor)
        new = _without_forbidden(new, scans)
        missed |= set() if held else closure_candidates.missed(candidates, new, config.loops)
        found = closures.merged(found, new)
        base, found = verification.reconcile(base, found, config.loops, config.solver)
        stages.end(
            f"loop closure {lap + 1}", submaps=len(pieces), candidates=len(candidates.target),
            accepted=len(new.edges), standing=len(found.edges),
        )
        tied = len(found.edges) >= config.loops.enough * len(pieces)
        unsearched = missed - {(a, b) for a, b, searched in tried if searched}
        if (tied or len(new.edges) <= 0.05 * len(found.edges)) and not unsearched:
            break
    return replace(estimate, graph=estimate.graph.with_estimates_of(base)), found


def close_plainly(
    estimate: Estimate, edges: tuple[Edges, ...], scans: Scans, recordings: Recordings, config: MappingConfig, stages: Stages,
    executor: Executor | None,
) -> tuple[Estimate, Closures]:
    """Align sub-maps pair by pair and solve once more with those that fit (paper: second optimisation)."""
    graph, recording = estimate.graph, recordings.of_keyframe
    found = closures.no_closures()
    for lap in range(config.loops.rounds):
        pieces = submaps.build(scans.clouds, graph.poses, recordings.path, recording, config.submaps)
        reporter = stages.reporter("loop closure")
        found = paper_method.find(graph, pieces, recording, config.loops, config.icp, reporter, executor)
        found = _without_forbidden(found, scans)
        stages.end(f"loop closure {lap + 1}", submaps=len(pieces), candidates=len(found.candidates), accepted=len(found.edges))
        solved, result = optimize(graph.with_edges(*edges, found.edges), config.solver)
        graph = graph.with_estimates_of(solved)
        stages.end(f"second optimisation {lap + 1}", **solver_figures(result))
    return replace(estimate, graph=graph), found


def _without_forbidden(found: Closures, scans: Scans) -> Closures:
    """Return closures with those the user has forbidden rejected."""
    kept = scans.may_meet(found.edges.i, found.edges.j)
    return found if kept.all() else found.without(kept, ["forbidden by the constraints"] * len(kept))
