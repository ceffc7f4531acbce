"""Rounds of loop closing: sub-maps, candidates, matches, second optimisation, until nothing new is found."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Floats
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..graph.pose_edges import OdometryEdges
from ..graph.solver import optimize
from ..lidar import submaps, visibility
from ..lidar.free_space import FreeSpace
from ..lidar.submaps import Submaps
from ..loop_closure import candidates as closure_candidates
from ..loop_closure import closures, long_stretches, loose_links, paper_method, verification
from ..loop_closure.candidates import Candidates
from ..loop_closure.closures import Closures, LoopClosureConfig
from .estimate import Estimate, Task
from .mapping_config import MappingConfig
from .progress import Stage, solver_figures


@dataclass(frozen=True, slots=True)
class RoundPolicy:
    """Rounds of loop closing."""

    per_stretch: ClassVar[int] = 3
    """Sub-maps in half a stretch."""
    bent: ClassVar[float] = 0.01
    """How far, m, closures may bend sub-maps, rms, before these are made again: an eighth of the cells that they average."""
    wide_rounds: ClassVar[int] = 12
    """Rounds of searching among long stretches, at most; a bound on the time where no loop closes."""


def close_loops(estimate: Estimate, task: Task) -> Estimate:
    """Build sub-maps, find closures among them and solve again, until nothing new is found (paper: second optimisation)."""
    config, recordings, scans = task.config, task.recordings, estimate.lidar
    base = estimate.graph.with_edges(*estimate.odometry_and_ranges, *estimate.steps_and_closures)
    base, found, estimate = _with_loose_links_tied(base, estimate, task)
    reference = submaps.references(recordings.path, recordings.of_keyframe, config.submaps.epsilon)
    first, stretches = JointCovariance(base.with_edges(found.edges), reference), None
    covariance: JointCovariance | None = first
    some = reference[:: RoundPolicy.per_stretch]
    if long_stretches.any_uncertain(base, first, some, recordings.of_keyframe, config.loop_closure):
        base, found, stretches = _with_long_stretches_tied(base, found, estimate, task)
        covariance = None
    del first
    tried: set[tuple[int, int, bool]] = set()
    missed: set[tuple[int, int]] = set()
    with_ranges = estimate.ranges is not None
    refined = config.refinement.rounds > 0 and not estimate.rests_on_ranges
    pieces, built, dynamic = None, base.poses, 0.0
    for lap in range(config.loop_closure.rounds):
        if pieces is None or pieces.bent(built, base.poses) > RoundPolicy.bent:
            pieces = submaps.build(scans.clouds, base.poses, recordings.path, recordings.of_keyframe, config.submaps)
            (pieces, free), built = _static(pieces, base, estimate), base.poses
            dynamic = visibility.dynamic_share(pieces, free, base.poses, recordings.of_keyframe)
        covariance = covariance or JointCovariance(base.with_edges(found.edges), pieces.reference)
        candidates = closure_candidates.propose(
            base, covariance, pieces, recordings.of_keyframe, tried, missed, with_ranges, config.loop_closure
        )
        covariance = None  # For a thousand sub-maps it takes a hundred megabytes.
        tried |= candidates.names(config.loop_closure)
        rules = replace(config.loop_closure, through=max(config.loop_closure.through, dynamic))
        new = _verified(candidates, pieces, free, rules, task, task.stages.reporter("loop closure"))
        missed |= set() if with_ranges else closure_candidates.missed(candidates, new, config.loop_closure)
        found, before = closures.merged(found, new), base.poses
        if len(new.edges):
            base, found = verification.reconcile(base, found, config.loop_closure, config.solver)
        counts = {"candidates": len(candidates.target), "accepted": len(new.edges), "kept": len(found.edges)}
        task.stages.end(Stage("loop closure", lap + 1), submaps=len(pieces), **counts)
        tied = len(found.edges) >= config.loop_closure.enough * len(pieces)
        tied = tied or (refined and _settled(candidates, before, base, config))
        unsearched = missed - {(a, b) for a, b, searched in tried if searched}
        if (tied or len(new.edges) <= 0.05 * len(found.edges)) and not unsearched:
            break
    if stretches is not None:
        _check_open_loops(base, found, stretches, with_ranges, task)
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


def _with_long_stretches_tied(
    base: Graph, found: Closures, estimate: Estimate, task: Task
) -> tuple[Graph, Closures, Submaps | None]:
    """Close loops whose ends are too uncertain for a search of sub-maps, the most certain first, in rounds.

    Returns
    -------
    The solved graph, the closures, and the stretches; None where nothing is as uncertain.
    """
    recordings, scans, rules = task.recordings, estimate.lidar, task.config.loop_closure
    first, last, reference = long_stretches.cut(recordings.path, recordings.of_keyframe)
    covariance = JointCovariance(base.with_edges(found.edges), reference)
    pieces = submaps.of_pieces(scans.clouds, base.poses, first, last, reference, task.config.submaps)
    pieces, free = _static(pieces, base, estimate)
    tried: set[tuple[int, int, bool]] = set()
    accepted = 0
    for _ in range(RoundPolicy.wide_rounds):
        pairs = long_stretches.uncertain_pairs(
            base, covariance, pieces, recordings.of_keyframe, tried, estimate.ranges is not None, rules, rules.direct
        )
        if not len(pairs.target):
            break
        pairs = long_stretches.first_of(pairs, pieces)
        tried |= pairs.names(rules)
        new = _verified(pairs, pieces, free, rules, task)
        found = closures.merged(found, new)
        if len(new.edges):
            base, found = verification.reconcile(base, found, rules, task.config.solver)
            covariance = JointCovariance(base.with_edges(found.edges), reference)
            accepted += len(new.edges)
    if not tried:
        return base, found, None
    task.stages.end("long stretches", stretches=len(pieces), candidates=len(tried), accepted=accepted)
    return base, found, pieces


def _check_open_loops(base: Graph, found: Closures, stretches: Submaps, with_ranges: bool, task: Task) -> None:
    """Note stretches that may show the same place and are still too uncertain for any search."""
    recordings, rules = task.recordings, task.config.loop_closure
    covariance = JointCovariance(base.with_edges(found.edges), stretches.reference)
    left = long_stretches.uncertain_pairs(
        base, covariance, stretches, recordings.of_keyframe, set(), with_ranges, rules, rules.search_limit
    )
    left = long_stretches.likely(left)
    if not len(left.target):
        return
    a, b = (float(recordings.stamps[stretches.reference[k[0]]] - recordings.stamps[0]) for k in (left.target, left.source))
    sigma = float(left.spread[0]) / 3.0
    task.stages.note("open-loops", pairs=len(left.target), first=a, second=b, sigma=sigma)


def _with_loose_links_tied(base: Graph, estimate: Estimate, task: Task) -> tuple[Graph, Closures, Estimate]:
    """Match both sides of each link that no scan measures once more; solve with the matches that hold.

    Where these contradict the odometry, its step gets little weight afterwards: if it stood still, no match would outweigh it.
    """
    recordings, scans, rules, wheels = task.recordings, estimate.lidar, task.config.loop_closure, estimate.odometry
    links = loose_links.loose_links(wheels, base)
    if not len(links):
        return base, closures.no_closures(), estimate
    candidates, pieces = loose_links.propose(
        base, scans.clouds, wheels, links, recordings.of_keyframe, rules, task.config.submaps
    )
    free = visibility.observed_free_space(scans.clouds, pieces, base.poses)
    found = _verified(candidates, pieces, free, rules, task)
    spanned = loose_links.spanned(wheels, found.edges)
    solved, found = verification.reconcile(
        _with_odometry(base, wheels, loose_links.loosened(wheels, spanned, rules)), found, rules, task.config.solver
    )
    wrong = loose_links.spanned(wheels, found.edges) & loose_links.contradicted(wheels, solved)
    after = loose_links.loosened(wheels, wrong, rules)
    task.stages.end(
        "loose links", links=len(links), candidates=len(found.candidates), kept=len(found.edges), loosened=int(wrong.sum())
    )
    return _with_odometry(base.with_estimates_of(solved), wheels, after), found, replace(estimate, odometry=after)


def _with_odometry(graph: Graph, wheels: OdometryEdges, others: OdometryEdges) -> Graph:
    """Return a graph with other edges of the odometry in place of its own."""
    return replace(graph, edges=tuple(others if edges is wheels else edges for edges in graph.edges))


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


def _without_forbidden(found: Closures, task: Task) -> Closures:
    """Return closures with those the user has forbidden rejected."""
    kept = task.allowed(found.edges.i, found.edges.j)
    return found if kept.all() else found.without(kept, "forbidden", ["forbidden by the constraints"] * len(kept))
