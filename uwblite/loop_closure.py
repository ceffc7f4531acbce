"""Loop closures: which sub-maps show the same place, and what that says of their poses.

Candidates come from where the graph believes the sub-maps to lie, widened by its own marginal covariance. Where that
is small, matching starts from the graph's guess; where it is large, a correlative search over the whole uncertainty
comes first. A match then has to explain enough points, closely enough, agree with the graph's own uncertainty, be the
only good one, see through no wall, and finally live in peace with all other closures in the second optimisation.
Every candidate is kept, with the reason for its fate.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import se2
from .closure_candidates import Candidates
from .closures import Closures, LoopClosureConfig, no_closures
from .free_space import FreeSpace
from .graph import Graph, RelativePoseEdges
from .map_result import LoopClosure
from .pair_alignment import Aligned, align_pairs
from .pair_matching import match, measured, paint, pair_points
from .point_cloud import PointCloud, make_cloud
from .robust import Kernel
from .scan_search import SearchConfig, search
from .sight import sees_through
from .solver import SolverConfig, optimize
from .submaps import Submaps

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_SAME_PLACE = 0.3
"""Matches nearer than this, m and rad, are one place."""


def find(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: SearchConfig,
    progress: Callable[[int, int], None] | None = None, free: Sequence[FreeSpace] | None = None,
) -> Closures:
    """Match candidates and judge each on its own.

    Parameters
    ----------
    candidates : see propose. submaps : their clouds.
    progress : called with (done, total).
    free : what each sub-map saw to be free, see sight.seen_free; None = no candidate is held to see through walls.
    """
    if not len(candidates.target):
        return no_closures()
    searched = candidates.spread > config.direct
    clouds = submaps.clouds
    raster = paint(clouds, 0.1, 0.5)
    row, guess = _guesses(candidates, submaps, searched, config, search_config, progress)
    points = pair_points(clouds, candidates.source[row], config.points)
    tries = align_pairs(clouds, raster, candidates.target[row], candidates.source[row], guess, points, 0.5, config.gate)
    best, second = _best_places(row, tries, len(searched))
    found = best >= 0
    pose = np.where(found[:, None], tries.pose[best], candidates.guess)
    points = pair_points(clouds, candidates.source, config.points)
    factors = match(clouds, raster, candidates.target, pose, points, config.gate, config.gate / 2.0)
    result = Aligned(pose, factors)
    variance = np.full(len(pose), config.match_sigma**2 * config.correlation)
    z, sqrt_information = measured(factors, pose, variance)
    through = _see_through(candidates, submaps, result, free, config)
    why = _judge(candidates, searched, found, second, through, result, z, sqrt_information, config)
    return _collect(candidates, submaps, result, z, sqrt_information, why)


def _guesses(
    candidates: Candidates, submaps: Submaps, searched: Bools, config: LoopClosureConfig, search_config: SearchConfig,
    progress: Callable[[int, int], None] | None,
) -> tuple[Ints, Floats]:
    """Return places to start matching from: candidate (g,) and pose (g, 3); several for those that were searched for."""
    rows, guesses = [], []
    prepared: dict[int, PointCloud] = {}
    total = int(searched.sum())
    for k in range(len(searched)):
        poses = candidates.guess[k : k + 1]
        if searched[k]:
            half_width = float(np.minimum(candidates.spread[k], config.search_limit))
            turn = float(np.clip(3.0 * np.sqrt(candidates.covariance[k, 2, 2]), 0.1, config.search_angle))
            pair = [_prepare(submaps, int(c[k]), prepared) for c in (candidates.target, candidates.source)]
            poses = search(pair[0], pair[1], poses[0], (half_width, half_width, turn), search_config).poses[: config.places]
            if progress is not None:
                progress(int(searched[: k + 1].sum()), total)
        rows.append(np.full(len(poses), k))
        guesses.append(poses)
    return np.concatenate(rows).astype(np.int64), np.concatenate(guesses)


def _best_places(row: Ints, tries: Aligned, candidates: int) -> tuple[Ints, Floats]:
    """Return the best try of each candidate (c,), -1 = none, and what share of its matches another place reaches (c,)."""
    best, second = np.full(candidates, -1, dtype=np.int64), np.zeros(candidates)
    share = tries.share
    for k in np.unique(row):
        own = np.flatnonzero(row == k)
        first = own[np.argmax(share[own])]
        best[k] = first
        apart = se2.between(tries.pose[first], tries.pose[own])
        other = own[(np.hypot(apart[:, 0], apart[:, 1]) > _SAME_PLACE) | (np.abs(apart[:, 2]) > _SAME_PLACE)]
        second[k] = share[other].max(initial=0.0) / max(share[first], 1e-9)
    return best, second


def _prepare(submaps: Submaps, k: int, prepared: dict[int, PointCloud]) -> PointCloud:
    """Return one sub-map's cloud ready for the search; its normals tell from which side it was seen."""
    if k not in prepared:
        points, normals = submaps.clouds.cloud(k)
        prepared[k] = make_cloud(points, points + normals)
    return prepared[k]


def _see_through(
    candidates: Candidates, submaps: Submaps, result: Aligned, free: Sequence[FreeSpace] | None, config: LoopClosureConfig
) -> Floats:
    """Return the larger share of points (c,) of either sub-map that would stand in what the other saw to be free."""
    through = np.zeros(len(candidates.target))
    if free is None:
        return through
    promising = (result.share >= min(config.overlap, config.overlap_after_search)) & (result.rms <= config.sigma)
    for k in np.flatnonzero(promising):
        a, b = int(candidates.target[k]), int(candidates.source[k])
        through[k] = sees_through(free[a], submaps.clouds.cloud(a)[0], free[b], submaps.clouds.cloud(b)[0], result.pose[k])
    return through


def _judge(
    candidates: Candidates, searched: Bools, found: Bools, second: Floats, through: Floats, result: Aligned,
    z: Floats, sqrt_information: Floats, config: LoopClosureConfig,
) -> list[str]:
    """Return why each candidate is rejected; '' = accepted so far."""
    error = se2.between(z, candidates.guess)
    information = np.swapaxes(sqrt_information, 1, 2) @ sqrt_information
    seen = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    # Only directions that the match can see are compared: project the error onto them.
    onto = seen @ information
    visible = np.einsum("eij,ej->ei", onto, error)
    joint = onto @ candidates.covariance @ np.swapaxes(onto, 1, 2) + seen
    distance = np.einsum("ei,eij,ej->e", visible, np.linalg.pinv(joint, rcond=1e-9, hermitian=True), visible)
    strength = np.linalg.eigvalsh(information)[:, 1]
    most = config.consistency if candidates.held else np.inf
    why: list[str] = []
    for k in range(len(z)):
        least = config.overlap_after_search if searched[k] else config.overlap
        if not found[k]:
            text = "the search found no place for it"
        elif result.share[k] < least:
            text = f"only {result.share[k]:.0%} of its points match (least {least:.0%})"
        elif result.rms[k] > config.sigma:
            text = f"matches lie {result.rms[k]:.3f} m apart (most {config.sigma:g} m)"
        elif through[k] > config.through:
            text = f"{through[k]:.0%} of its points would stand where free space was seen (most {config.through:.0%})"
        elif strength[k] < 1.0:
            text = "the surfaces fix neither position nor heading"
        elif searched[k] and second[k] > config.uniqueness:
            text = f"another place matches {second[k]:.0%} as well"
        elif distance[k] > most:
            text = f"contradicts the graph: squared Mahalanobis distance {distance[k]:.1f} (most {most:g})"
        else:
            text = ""
        why.append(text)
    return why


def _collect(
    candidates: Candidates, submaps: Submaps, result: Aligned, z: Floats, sqrt_information: Floats, why: list[str]
) -> Closures:
    i, j = submaps.reference[candidates.target], submaps.reference[candidates.source]
    information = np.swapaxes(sqrt_information, 1, 2) @ sqrt_information
    story = tuple(
        LoopClosure(
            int(i[k]), int(j[k]), z[k], information[k], float(result.rms[k]), float(result.share[k]), not why[k],
            why[k] or f"{result.share[k]:.0%} of its points match within {result.rms[k]:.3f} m",
        )
        for k in range(len(z))
    )
    good = np.array([not text for text in why], dtype=bool)
    return Closures(RelativePoseEdges(i[good], j[good], z[good], sqrt_information[good]), story)


def reconcile(graph: Graph, closures: Closures, config: LoopClosureConfig, solver: SolverConfig) -> tuple[Graph, Closures]:
    """Solve the graph with its closures under a kernel that tightens (graduated non-convexity) and drop those at odds.

    Returns
    -------
    The solved graph (without the closure edges) and the closures that remain; the others carry the reason.
    """
    if not len(closures.edges):
        return graph, closures
    solved = graph
    for scale in (30.0, 10.0, 4.0):
        edges = replace(closures.edges, kernel=Kernel("geman-mcclure", scale))
        solved = optimize(solved.with_edges(edges), replace(solver, relative_decrease=1e-5))[0]
        solved = replace(solved, edges=graph.edges)
    residuals = closures.edges.residuals(solved)
    squared = np.einsum("ed,ed->e", residuals, residuals)
    kept = squared < config.consistency
    left = closures.without(kept, [f"contradicts the other closures: chi2 {chi2:.0f}" for chi2 in squared])
    return solved, replace(left, edges=replace(left.edges, kernel=Kernel("cauchy", 3.0)))
