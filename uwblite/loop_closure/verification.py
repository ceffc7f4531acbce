"""Loop closures: which sub-maps show the same place, and the edges that follow for their poses.

Where the covariance of two sub-maps is small, matching starts from the graph's guess; where it is large, a correlative search
over the whole uncertainty comes first. A match then has to explain enough points, closely enough, agree with the graph's own
uncertainty, be the only good one, violate no free space, and finally agree with all other closures in the second optimisation.
Every candidate is kept, with the reason for its outcome.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from .. import se2
from ..arrays import TINY, Floats, Ints
from ..graph.gnc import optimize_tightening
from ..graph.graph import Graph, edge_cost
from ..graph.pose_edges import RelativePoseEdges
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig, optimize
from ..lidar.correlative_matching import CorrelativeConfig
from ..lidar.scan_matching import measured
from ..lidar.submaps import Submaps
from ..lidar.visibility import FreeSpace
from ..map_result import LoopClosure
from . import chain_breaks
from .candidates import CandidatePolicy, Candidates
from .closures import Closures, LoopClosureConfig, collected, no_closures
from .matching import ClosureMatches, fit

_ROUGH = 1e-4
"""Relative decrease of chi2 that ends a search with one scale of the kernel."""
_TIGHTER = 3.0
"""Ratio of each scale of that kernel to the next, and the scale of that of what remains, standard deviations."""
_SLID = 3
"""Most searches for shifted stretches: without the closures that moved one, another may show."""


def find(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: CorrelativeConfig,
    progress: Callable[[int, int], None] | None = None, free: Sequence[FreeSpace] | None = None,
    executor: Executor | None = None,
) -> Closures:
    """Match candidates and verify each on its own; accepted ones become edges between the sub-maps' keyframes.

    Parameters
    ----------
    free : see visibility.observed_free_space; None = free-space violations are not tested.
    executor : the result does not depend on it.
    """
    if not len(candidates.target):
        return no_closures()
    fits = fit(candidates, submaps, config, search_config, free, progress, executor)
    best = fits.best
    variance = np.full(len(best.pose), config.match_sigma**2 * config.correlation)
    z, root = measured(best.factors, best.pose, variance)
    i, j = (submaps.reference[number].tolist() for number in (candidates.target, candidates.source))
    columns = z, np.swapaxes(root, 1, 2) @ root, best.rms.tolist(), best.share.tolist()
    verdicts = _judge(candidates, fits, z, root, config)
    rows = zip(i, j, *columns, verdicts, strict=True)
    return collected([LoopClosure(*row, *verdict) for *row, verdict in rows], root)


def _judge(
    candidates: Candidates, fits: ClosureMatches, z: Floats, sqrt_information: Floats, config: LoopClosureConfig
) -> list[tuple[str, str]]:
    """Return the outcome of each candidate so far, one of map_result.OUTCOMES, and its reason in words."""
    result, searched = fits.best, candidates.spread > config.direct
    error = se2.between(z, candidates.guess)
    information = np.swapaxes(sqrt_information, 1, 2) @ sqrt_information
    seen = np.linalg.pinv(information, rcond=TINY, hermitian=True)
    # Only directions that the match measures are compared: project the error onto them.
    onto = seen @ information
    visible = np.einsum("eij,ej->ei", onto, error)
    joint = onto @ candidates.covariance @ np.swapaxes(onto, 1, 2) + seen
    distance = np.einsum("ei,eij,ej->e", visible, np.linalg.pinv(joint, rcond=TINY, hermitian=True), visible)
    strength = np.linalg.eigvalsh(information)[:, 1]
    share, rms = result.share, result.rms
    most = config.agrees**2 if candidates.constrained else np.inf
    verdicts: list[tuple[str, str]] = []
    for k in range(len(z)):
        least = config.overlap_after_search if searched[k] else config.overlap
        if not fits.found[k]:
            verdict = "not-found", "the search found no place for it"
        elif fits.net[k] < config.net_overlap:
            text = f"only {fits.net[k]:.1f} m of surface speak for it in one direction (least {config.net_overlap:g} m)"
            verdict = "few-matches", text
        elif share[k] < least and not candidates.long:
            verdict = "few-matches", f"only {share[k]:.0%} of its points match (least {least:.0%})"
        elif rms[k] > config.sigma:
            verdict = "far-matches", f"matches lie {rms[k]:.3f} m apart (most {config.sigma:g} m)"
        elif fits.through[k] > config.through:
            text = f"{fits.through[k]:.0%} of its points would stand where free space was seen (most {config.through:.0%})"
            verdict = "free-space-violation", text
        elif strength[k] < 1.0:
            verdict = "degenerate", "the surfaces fix neither position nor heading"
        elif searched[k] and fits.second[k] > config.uniqueness:
            verdict = "ambiguous", f"another place matches {fits.second[k]:.0%} as well"
        elif distance[k] > most:
            text = f"contradicts the graph: squared Mahalanobis distance {distance[k]:.1f} (most {most:g})"
            verdict = "contradicts-graph", text
        else:
            verdict = "accepted", f"{share[k]:.0%} of its points match within {rms[k]:.3f} m"
        verdicts.append(verdict)
    return verdicts


def without_look_alikes(graph: Graph, closures: Closures, path: Floats, solver: SolverConfig) -> tuple[Graph, Closures]:
    """Drop closures of places that only look alike: without them all other measurements are far more probable.

    All closures between the same stretches of the path are one piece of evidence, however many: a copy of a place matches
    everywhere. Each further length of a stretch that two visits share is another place that would have to look alike. The group
    that costs the others most leaves first, since it makes those that are right cost as much.

    Parameters
    ----------
    graph : solved with the closures, without their edges. path : (k,) travelled distance, m.

    Returns
    -------
    The graph, solved again where closures left, and those that remain; the others carry the reason.
    """
    quick = replace(solver, relative_decrease=_ROUGH)
    most = CandidatePolicy.wider**2 * chdtri(se2.POSE[0], CandidatePolicy.never)
    while len(closures.edges):
        group, shared = _meetings(closures.edges, path)
        costs, solved = [], []
        for number in range(group.max() + 1):
            rest = graph.with_edges(closures.edges.rows(np.flatnonzero(group != number)))
            solved.append(optimize(rest, quick)[0])
            costs.append((_cost(rest) - _cost(solved[-1])) / (1.0 + shared[number] / CandidatePolicy.length))
        worst = int(np.argmax(costs))
        if costs[worst] <= most:
            break
        reason = f"it looks alike: without it chi2 of all others falls by {costs[worst]:.0f} per place (most {most:.0f})"
        closures = closures.without(group != worst, "contradicts-graph", [reason] * len(group))
        graph = replace(solved[worst], edges=graph.edges)
    return graph, closures


def _meetings(edges: RelativePoseEdges, path: Floats) -> tuple[Ints, Floats]:
    """Return for each closure (e,) the number of the group that connects the same two stretches of the path (k,), m, and the
    length (g,) that both visits of a group share, m."""
    ends = np.sort(path[np.stack([edges.i, edges.j])], axis=0)
    near = (np.abs(ends[:, :, None] - ends[:, None]) < CandidatePolicy.length).all(axis=0)
    count, group = connected_components(near, directed=False)
    shared = [float(np.ptp(ends[:, group == number], axis=1).min()) for number in range(count)]
    return np.asarray(group, dtype=np.intp), np.array(shared)


def _cost(graph: Graph) -> float:
    """Return chi2 of all edges under their kernels."""
    return sum(edge_cost(edges, edges.residuals(graph)) for edges in graph.edges)


def reconcile(graph: Graph, closures: Closures, config: LoopClosureConfig, solver: SolverConfig) -> tuple[Graph, Closures]:
    """Solve the graph with its closures under a kernel that tightens (graduated non-convexity) and drop those that disagree.

    Returns
    -------
    The solved graph (without the closure edges) and the closures that remain; the others carry the reason.
    """
    solved, left = _tightened(graph, closures, config, solver)
    for _ in range(_SLID):
        by = chain_breaks.moved_by(left.edges, solved)
        if not by.any():
            break
        reasons = [f"the odometry would have to jump by {jump:.1f} m and back again" for jump in by]
        solved, left = _tightened(graph, left.without(by == 0.0, "contradicts-graph", reasons), config, solver)
    return solved, left


def _tightened(graph: Graph, closures: Closures, config: LoopClosureConfig, solver: SolverConfig) -> tuple[Graph, Closures]:
    if not len(closures.edges):
        return graph, closures
    quick = replace(solver, relative_decrease=_ROUGH)
    worst = float(np.linalg.norm(closures.edges.residuals(graph), axis=1).max())
    # The first scale contains every closure: one that ends a long drift would else be rejected before it has any weight.
    steps = int(np.ceil(np.log(max(worst / config.agrees, 1.0)) / np.log(_TIGHTER)))
    scales = [config.agrees * _TIGHTER**k for k in range(steps, -1, -1)]
    # Ranges tell by themselves which step of the odometry is torn.
    alone = not any(isinstance(edges, RangeEdges) for edges in graph.edges)
    solved = optimize_tightening(graph.with_edges(closures.edges), [len(graph.edges)], scales, quick, together=alone)
    solved = replace(solved, edges=graph.edges)
    residuals = closures.edges.residuals(solved)
    squared = np.einsum("ed,ed->e", residuals, residuals)
    kept = squared < config.agrees**2
    reasons = [f"contradicts the other closures: chi2 {chi2:.0f}" for chi2 in squared]
    left = closures.without(kept, "contradicts-closures", reasons)
    return solved, replace(left, edges=replace(left.edges, kernel=Kernel("cauchy", _TIGHTER)))

