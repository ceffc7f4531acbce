"""Loop closures: which sub-maps show the same place, and the edges that follow for their poses.

Candidates are sub-maps that may overlap by the graph's poses and their marginal covariance. Where the covariance
is small, matching starts from the graph's guess; where it is large, a correlative search over the whole uncertainty
comes first. A match then has to explain enough points, closely enough, agree with the graph's own uncertainty, be the
only good one, violate no free space, and finally agree with all other closures in the second optimisation.
Every candidate is kept, with the reason for its outcome.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats
from ..graph.gnc import tightened
from ..graph.graph import Graph
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig
from ..lidar.correlative_matching import CorrelativeConfig
from ..lidar.scan_matching import Aligned, measured
from ..lidar.submaps import Submaps
from ..lidar.visibility import FreeSpace
from ..map_result import LoopClosure
from . import slid_stretches
from .candidates import Candidates
from .closures import Closures, LoopClosureConfig, collected, no_closures
from .matching import ClosureMatches, fit


def find(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: CorrelativeConfig,
    progress: Callable[[int, int], None] | None = None, free: Sequence[FreeSpace] | None = None,
    executor: Executor | None = None,
) -> Closures:
    """Match candidates and verify each on its own.

    Parameters
    ----------
    free : see visibility.observed_free_space; None = free-space violations are not tested.
    executor : any concurrent.futures executor; the result does not depend on it.
    """
    if not len(candidates.target):
        return no_closures()
    fits = fit(candidates, submaps, config, search_config, free, progress, executor)
    result = fits.best
    variance = np.full(len(result.pose), config.match_sigma**2 * config.correlation)
    z, sqrt_information = measured(result.factors, result.pose, variance)
    verdicts = _judge(candidates, fits, z, sqrt_information, config)
    return _collect(candidates, submaps, result, z, sqrt_information, verdicts)


def _judge(
    candidates: Candidates, fits: ClosureMatches, z: Floats, sqrt_information: Floats, config: LoopClosureConfig
) -> list[tuple[str, str]]:
    """Return the outcome of each candidate so far, one of map_result.OUTCOMES, and its reason in words."""
    result, searched = fits.best, candidates.spread > config.direct
    error = se2.between(z, candidates.guess)
    information = np.swapaxes(sqrt_information, 1, 2) @ sqrt_information
    seen = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    # Only directions that the match measures are compared: project the error onto them.
    onto = seen @ information
    visible = np.einsum("eij,ej->ei", onto, error)
    joint = onto @ candidates.covariance @ np.swapaxes(onto, 1, 2) + seen
    distance = np.einsum("ei,eij,ej->e", visible, np.linalg.pinv(joint, rcond=1e-9, hermitian=True), visible)
    strength = np.linalg.eigvalsh(information)[:, 1]
    share, rms = result.share, result.rms
    most = config.consistency if candidates.constrained else np.inf
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


def _collect(
    candidates: Candidates, submaps: Submaps, result: Aligned, z: Floats, sqrt_information: Floats,
    verdicts: list[tuple[str, str]],
) -> Closures:
    """Return every candidate with its outcome, and the accepted ones as edges between the sub-maps' keyframes."""
    i, j = submaps.reference[candidates.target], submaps.reference[candidates.source]
    information = np.swapaxes(sqrt_information, 1, 2) @ sqrt_information
    share, rms = result.share, result.rms
    records = [
        LoopClosure(int(i[k]), int(j[k]), z[k], information[k], float(rms[k]), float(share[k]), outcome, reason)
        for k, (outcome, reason) in enumerate(verdicts)
    ]
    return collected(records, sqrt_information)


def reconcile(graph: Graph, closures: Closures, config: LoopClosureConfig, solver: SolverConfig) -> tuple[Graph, Closures]:
    """Solve the graph with its closures under a kernel that tightens (graduated non-convexity) and drop those that disagree.

    Returns
    -------
    The solved graph (without the closure edges) and the closures that remain; the others carry the reason.
    """
    solved, left = _tightened(graph, closures, config, solver)
    for _ in range(_SLID):
        by = slid_stretches.moved_by(left.edges, solved)
        if not by.any():
            break
        reasons = [f"the odometry would have to jump by {jump:.1f} m and back again" for jump in by]
        solved, left = _tightened(graph, left.without(by == 0.0, "contradicts-graph", reasons), config, solver)
    return solved, left


_SLID = 3
"""Most searches for shifted stretches: without the closures that moved one, another may show."""


def _tightened(graph: Graph, closures: Closures, config: LoopClosureConfig, solver: SolverConfig) -> tuple[Graph, Closures]:
    """Solve the graph with closures under a kernel that tightens; drop those that disagree."""
    if not len(closures.edges):
        return graph, closures
    quick = replace(solver, relative_decrease=1e-4)
    worst = float(np.linalg.norm(closures.edges.residuals(graph), axis=1).max())
    # The first scale contains every closure: one that ends a long drift would else be rejected before it has any weight.
    steps = int(np.ceil(np.log(max(worst / _LAST, 1.0)) / np.log(_TIGHTER)))
    scales = [_LAST * _TIGHTER**k for k in range(steps, -1, -1)]
    solved = tightened(graph.with_edges(closures.edges), [len(graph.edges)], scales, quick)
    solved = replace(solved, edges=graph.edges)
    residuals = closures.edges.residuals(solved)
    squared = np.einsum("ed,ed->e", residuals, residuals)
    kept = squared < config.consistency
    reasons = [f"contradicts the other closures: chi2 {chi2:.0f}" for chi2 in squared]
    left = closures.without(kept, "contradicts-closures", reasons)
    return solved, replace(left, edges=replace(left.edges, kernel=Kernel("cauchy", 3.0)))


_LAST, _TIGHTER = 4.0, 3.0
"""Last scale of the kernel, standard deviations, and the ratio of each to the next."""
