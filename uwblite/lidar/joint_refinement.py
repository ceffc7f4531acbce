"""Joint refinement: all overlapping clouds constrain all poses at once.

Every round looks up matches of every pair of clouds that see the same surfaces, condenses each pair into one
relative-pose edge and solves the whole graph again, wheels, radio and calibration included; the gate shrinks from
round to round. Both poses of a pair are free, so errors spread over the loop instead of piling up in one scan.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import WIDE, Bools, Floats, Ints
from ..config import setting
from ..graph.calibration import scan_indices
from ..graph.graph import Graph
from ..graph.pose_edges import ScanEdges
from ..graph.robust import Kernel
from ..graph.solver import Optimizer, SolverConfig, SolverSummary
from .cloud_rasters import ScanClouds
from .clouds import Clouds
from .overlap import surface_cells
from .scan_matching import PairFactors, match, measured, pair_points

_NEIGHBOURS = 4
"""Clouds no farther apart in the chain than this are neighbours."""
_CLOUDS_AT_ONCE = 128
"""Clouds whose overlaps with all others are in memory at once; a bound on the memory."""


@dataclass(frozen=True, slots=True)
class RefinementConfig:
    """Matching of clouds in the joint refinement."""

    rounds: int = 30
    """Most rounds of matching and solving; 0 = no joint refinement (the paper)."""
    track_rounds: ClassVar[int] = 12
    """Most rounds of matching neighbouring clouds before loops are sought."""
    same_pairs: ClassVar[float] = 0.04
    """Clouds are not matched again when ranges move the poses by less than this (root mean square), m."""
    first_gate: float = setting(0.5, above=0.0, advanced=True)
    """Farthest match in the first round, m."""
    later_gate: ClassVar[float] = 0.2
    """Farthest match in the first round where poses are good already: after matching scan to scan, or once matched."""
    last_gate: ClassVar[float] = 0.12
    """Farthest match in the last rounds, m."""
    shrink: ClassVar[float] = 0.7
    """Gate of a round as a share of the one before, at most."""
    partners: int = 6
    """Clouds from other times that each cloud is matched with; fewer, but two at least, where that makes too many."""
    most: ClassVar[int] = 40_000
    """Pairs of clouds from different times that are too many: recordings of hours are tied richly by less."""
    epoch: ClassVar[float] = 2.0
    """Travelled distance within which only the best partner counts, m."""
    neighbours: ClassVar[tuple[int, ...]] = (1, 2, 4)
    """Following keyframes that each cloud is matched with."""
    points: ClassVar[int] = 60
    """Points looked up per pair."""
    min_matches: ClassVar[int] = 15
    """Pairs with fewer matches do not count."""
    min_share: ClassVar[float] = 0.3
    """Pairs that match a smaller share of the points looked up do not count."""
    sigma: float = setting(0.02, advanced=True)
    """Standard deviation of a point-to-line distance before it is learnt, m."""
    correlation: float = setting(4.0, advanced=True)
    """Matches of one pair that together weigh as one independent match: errors of neighbouring rays are correlated."""
    convergence: float = setting(0.0002, advanced=True)
    """Rounds end early when the surfaces of clouds move against those of their partners by less than this (root mean square)
    at the last gate, m."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinementResult:
    """Result of the joint refinement."""

    graph: Graph
    """Solved."""
    edges: ScanEdges
    """The scan edges of the last round."""
    i: Ints
    j: Ints
    factors: PairFactors
    used: Bools
    """(e,) pairs that counted in the last round."""
    sigma: float
    """Learnt standard deviation of a point-to-line distance, m."""
    rounds: int
    summary: SolverSummary


def choose_pairs(clouds: Clouds, poses: Floats, path: Floats, recording: Ints, config: RefinementConfig) -> tuple[Ints, Ints]:
    """Choose the pairs (i < j) of clouds to be matched: following keyframes, and the best views from other times.

    Parameters
    ----------
    poses : (k, 3). path : (k,) travelled distance, m. recording : (k,) recording of each keyframe.
    """
    k = len(clouds)
    near_i = np.concatenate([np.arange(k - n) for n in config.neighbours if n < k] or [np.zeros(0, dtype=np.intp)])
    near_j = np.concatenate([np.arange(n, k) for n in config.neighbours if n < k] or [np.zeros(0, dtype=np.intp)])
    joined = (recording[near_i] == recording[near_j]) & (path[near_j] - path[near_i] < 3.0)
    near_i, near_j = near_i[joined], near_j[joined]
    pairs = near_i.astype(WIDE) * k + near_j
    if config.partners:
        i, j = _best_views(surface_cells(clouds, poses), path, recording, config)
        pairs = np.concatenate([np.minimum(i, j).astype(WIDE) * k + np.maximum(i, j), pairs])
    first, second = np.divmod(np.unique(pairs), k)
    return first.astype(np.intp), second.astype(np.intp)


def _best_views(seen: sparse.csr_matrix, path: Floats, recording: Ints, config: RefinementConfig) -> tuple[Ints, Ints]:
    """Return for every cloud i the clouds j from other times that share most with it, one of each epoch."""
    size = np.maximum(np.diff(seen.indptr), 1)
    epoch = (path / config.epoch).astype(np.intp)
    visit = recording * (int(epoch.max(initial=0)) + 1) + epoch
    visits = int(visit.max(initial=0)) + 1
    across, found = seen.T.tocsr(), []
    partners = min(config.partners, max(2, config.most // seen.shape[0]))
    for first in range(0, seen.shape[0], _CLOUDS_AT_ONCE):
        common = seen[first : first + _CLOUDS_AT_ONCE] @ across
        common.sort_indices()
        common = common.tocoo()
        i, j = common.row.astype(np.intp) + first, common.col.astype(np.intp)
        share = common.data / np.minimum(size[i], size[j])
        kept = np.flatnonzero((np.abs(path[i] - path[j]) > config.epoch) & (share > config.min_share) & (common.data >= 4))
        i, j, share = i[kept], j[kept], share[kept]
        own = i * visits + visit[j]
        # Numbers of which the whole part comes first, then the larger share, then the earlier cloud.
        order = np.argsort(own - 0.5 * share, kind="stable")
        order = order[np.diff(own[order], prepend=-1) != 0]
        i, j, share = i[order], j[order], share[order]
        order = np.argsort(i - 0.5 * share, kind="stable")
        i, j = i[order], j[order]
        best = np.arange(len(i)) - np.searchsorted(i, i) < partners
        found.append((i[best], j[best]))
    i, j = (np.concatenate(part) for part in zip(*found, strict=True))
    return i, j


def unmeasured(graph: Graph, i: Ints, j: Ints, twist: Floats, delay: float) -> ScanEdges:
    """Return pairs of clouds (e,), (e,) as scan edges that nothing has measured yet.

    Parameters
    ----------
    graph : in which they are. twist : (k, 3) velocity of the base at each keyframe.
    delay : of the lidar's clock, s, with which the clouds were made.
    """
    # Lines seen obliquely are tilted a little, so the cloud that gives the points seems shifted towards its laser: half a
    # millimetre per pair, always to the same side. With every other pair exchanged, this averages out.
    turned = i % 2 == 1
    i, j = np.where(turned, j, i), np.where(turned, i, j)
    none, names = np.broadcast_to(0.0, (len(i), 3, 3)), scan_indices(graph.calibration)
    return ScanEdges(i, j, none[:, 0], none, twist[i], twist[j], names, delay, kernel=Kernel("cauchy", 5.0))


def refine(
    graph: Graph, scans: ScanClouds, pairs: ScanEdges, config: RefinementConfig, solver: SolverConfig,
    on_round: Callable[[int, int], None] | None = None,
) -> RefinementResult:
    """Match all pairs and solve the graph, round by round.

    Parameters
    ----------
    graph : wheels, radio, priors and other edges; scan edges come from here.
    scans : their raster's reach bounds the gate. pairs : see unmeasured.
    """
    i, j, clouds, raster = pairs.i, pairs.j, scans.clouds, scans.raster
    points = pair_points(clouds, j, config.points)
    gate, sigma, rounds, fit = config.first_gate, config.sigma, 0, np.inf
    optimizer = Optimizer()
    # The next round looks all matches up again: one successful step is enough.
    brief = replace(solver, max_iterations=12, relative_decrease=0.5)
    T_i_j = pairs.relative(graph)
    while True:
        factors = match(clouds, raster, i, T_i_j, points, gate, max(gate / 3.0, 2.5 * sigma))
        used = (factors.matched >= config.min_matches) & (factors.matched >= config.min_share * factors.asked)
        if used.any() and gate < 0.25:
            sigma = float(np.sqrt(factors.squared[used].sum() / max(factors.weight[used].sum(), 1.0)))
            sigma = max(sigma, 0.25 * config.sigma)
        z, sqrt_information = measured(factors, T_i_j, sigma**2 * _shared(i, j, used, config))
        # Pairs that do not count stay in with no weight: then all rounds share one pattern, analysed once.
        edges = replace(pairs, T_i_j=z, sqrt_information=sqrt_information, weights=used.astype(np.float64))
        solved, summary = optimizer.optimize(graph.with_edges(edges), brief)
        graph = graph.with_estimates_of(solved)
        before, T_i_j = T_i_j, pairs.relative(graph)
        moved = _surfaces_moved(factors, used, T_i_j - before)
        rounds += 1
        if on_round is not None:
            on_round(rounds, config.rounds)
        last = gate <= config.last_gate * 1.001
        before_fit, fit = fit, float(factors.squared[used].sum() / max(factors.weight[used].sum(), 1.0)) if last else np.inf
        creeping = fit > (1.0 - _BETTER) * before_fit
        if rounds >= config.rounds or (last and (moved < config.convergence or creeping)):
            return RefinementResult(graph, replace(edges.rows(used), weights=None), i, j, factors, used, sigma, rounds, summary)
        # After a step that failed or was damped, as much may be left as before.
        whole = used.any() and len(summary.chi2_history) > 0 and summary.chi2_history[0] < summary.chi2_initial
        farthest = float(np.hypot(*(T_i_j - before)[used, :2].T).max()) if whole else gate
        gate = max(min(gate * config.shrink, _GATE_PER_SHIFT * farthest), config.last_gate)


def _shared(i: Ints, j: Ints, used: Bools, config: RefinementConfig) -> Floats:
    """Return the variance (e,) of a match of each pair by that of a point's distance: errors of one pair's matches are
    correlated, and all pairs of one cloud use the same points."""
    clouds = int(max(i.max(initial=-1), j.max(initial=-1))) + 1
    degree = np.bincount(i[used], minlength=clouds) + np.bincount(j[used], minlength=clouds)
    return config.correlation * np.maximum(0.25 * (degree[i] + degree[j]), 1.0)


def measured_again(
    pairs: ScanEdges, graph: Graph, scans: ScanClouds, config: RefinementConfig, weight: Floats
) -> ScanEdges:
    """Return refined pairs as the poses of a graph have them, measured with weights (p,) of the clouds' points."""
    T_i_j, points = pairs.relative(graph), pair_points(scans.clouds, pairs.j, config.points)
    gate = config.last_gate
    kernel = max(gate / 3.0, 2.5 * config.sigma)
    factors = match(scans.clouds, scans.raster, pairs.i, T_i_j, points, gate, kernel, weight)
    variance = factors.squared.sum() / max(factors.weight.sum(), 1.0)
    shared = _shared(pairs.i, pairs.j, np.ones(len(pairs), dtype=bool), config)
    z, sqrt_information = measured(factors, T_i_j, max(variance, (0.25 * config.sigma) ** 2) * shared)
    return replace(pairs, T_i_j=z, sqrt_information=sqrt_information)


_BETTER = 0.002
"""Share by which the mean squared distance of matches has to fall from round to round at the last gate. Where it does not,
clouds creep in unobserved directions: for many rounds where recordings overlap in corridors, and away from the truth
(docs/lab/performance.md)."""
_GATE_PER_SHIFT = 3.0
"""Ratio of the gate of a round to the largest motion of a cloud in the frame of its partner in the round before."""


def _surfaces_moved(factors: PairFactors, used: Bools, change: Floats) -> float:
    """Return how far changes (e, 3) of relative poses move matched points off their lines, root mean square, m.

    In directions that the scans do not measure, poses may creep from round to round; that does not change the matches.
    """
    change, hessian = np.column_stack([change[used, :2], se2.wrap_angle(change[used, 2])]), factors.hessian[used]
    squared = np.einsum("ei,eij,ej->", change, hessian, change, optimize=True)
    return float(np.sqrt(max(squared, 0.0) / max(factors.weight[used].sum(), 1.0)))


def with_fewer_pairs(graph: Graph, most: int = 12000) -> Graph:
    """Return the graph with at most so many scan edges between clouds of different times, each for several similar ones.

    The uncertainty of thousands of poses tied together everywhere would need a factor of hundreds of millions of
    entries. Every m-th pair, weighing as m, and a chain of single steps carry as much information, a little less at every
    pose: standard deviations come out up to a third too large.
    """
    return replace(graph, edges=tuple(_every_nth(e, most) if isinstance(e, ScanEdges) else e for e in graph.edges))


def _every_nth(edges: ScanEdges, most: int) -> ScanEdges:
    gap = np.abs(edges.i - edges.j)
    near, far = np.flatnonzero(gap <= _NEIGHBOURS), np.flatnonzero(gap > _NEIGHBOURS)
    each = -(-len(far) // most)
    if each <= 1:
        return edges
    weights = edges.own_weights.copy()
    # A chain of single steps causes no fill.
    steps, kept = near[gap[near] == 1], far[each // 2 :: each]
    weights[steps] *= len(near) / max(len(steps), 1)
    weights[kept] *= len(far) / max(len(kept), 1)
    chosen = np.zeros(len(edges), dtype=bool)
    chosen[steps] = chosen[kept] = True
    return replace(edges, weights=weights).rows(chosen)
