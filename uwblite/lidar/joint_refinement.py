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
from ..arrays import WIDE, Bools, Floats, Ints, chunks, run_starts
from ..config import setting
from ..graph.calibration import LASER, indices
from ..graph.graph import Graph
from ..graph.pose_edges import ScanEdges
from ..graph.robust import Kernel
from ..graph.solver import Optimizer, SolverConfig, SolverSummary
from .cloud_rasters import ScanClouds
from .clouds import CLOUDS_AT_ONCE, Clouds
from .scan_matching import CloudPairs, PairFactors, match, measured, pairs_of
from .scan_to_scan import TrackingConfig
from .visibility import surface_cells


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
    learns: ClassVar[float] = 0.25
    """Gate below which the noise of matches is learnt, m."""
    last_gate: ClassVar[float] = 0.12
    """Farthest match in the last rounds, m."""
    shrink: ClassVar[float] = 0.7
    """Gate of a round as a share of the one before, at most."""
    gate_per_shift: ClassVar[float] = 3.0
    """Ratio of the gate of a round to the largest motion of a cloud in the frame of its partner in the round before, at most,
    and of a gate to the width of the robust kernel, at most."""
    partners: int = 6
    """Clouds from other times that each cloud is matched with; fewer, but two at least, where that makes too many."""
    most: ClassVar[int] = 40_000
    """Pairs of clouds from different times that are too many: recordings of hours are tied richly by less."""
    epoch: ClassVar[float] = 2.0
    """Travelled distance within which only the best partner counts, m."""
    common: ClassVar[int] = 4
    """Least number of surface cells that both clouds of a pair see."""
    neighbours: ClassVar[tuple[int, ...]] = (1, 2, 4)
    """Following keyframes that each cloud is matched with."""
    farthest: ClassVar[float] = 3.0
    """Travelled distance between these at most, m."""
    points: ClassVar[int] = 60
    """Points looked up per pair."""
    min_matches: ClassVar[int] = 15
    """Pairs with fewer matches do not count."""
    min_share: ClassVar[float] = 0.3
    """Pairs that match a smaller share of the points looked up do not count."""
    sigma: float = setting(TrackingConfig.sigma, advanced=True)
    """Standard deviation of a point-to-line distance before it is learnt, m."""
    quietest: ClassVar[float] = 0.25
    """Least learnt one as a share of it."""
    outlier: ClassVar[float] = 2.5
    """Least width of the robust kernel, standard deviations."""
    kernel: ClassVar[Kernel] = Kernel("cauchy", 5.0)
    """Of pairs as edges of the graph."""
    correlation: float = setting(4.0, advanced=True)
    """Matches of one pair that together weigh as one independent match: errors of neighbouring rays are correlated."""
    convergence: float = setting(0.0002, advanced=True)
    """Rounds end early when the surfaces of clouds move against those of their partners by less than this (root mean square)
    at the last gate, m."""
    creep: ClassVar[float] = 0.002
    """Share by which the mean squared distance of matches has to fall from round to round at the last gate. Where it does not,
    clouds creep in unobserved directions, as in corridors, and away from the truth (docs/lab/performance.md)."""


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

    Each keyframe has its pose (k, 3), its place on the travelled path (k,), m, and its recording (k,).
    """
    i, j = np.concatenate([np.zeros((2, 0), dtype=np.intp), *(_following(len(clouds), n) for n in config.neighbours)], axis=1)
    near = (recording[i] == recording[j]) & (path[j] - path[i] < config.farthest)
    pairs = np.stack([i, j])[:, near]
    if config.partners:
        pairs = np.hstack([np.sort(_best_views(surface_cells(clouds, poses), path, recording, config), axis=0), pairs])
    first, second = np.divmod(np.unique(pairs[0].astype(WIDE) * len(clouds) + pairs[1]), len(clouds))
    return first.astype(np.intp), second.astype(np.intp)


def _following(clouds: int, apart: int) -> Ints:
    """Return the pairs (2, e) of clouds so many apart."""
    first = np.arange(max(clouds - apart, 0))
    return np.stack([first, first + apart])


def _best_views(seen: sparse.csr_matrix, path: Floats, recording: Ints, config: RefinementConfig) -> Ints:
    """Return pairs (2, e): every cloud with those from other times that share most with it, one of each epoch."""
    size = np.maximum(np.diff(seen.indptr), 1)
    epoch = (path / config.epoch).astype(np.intp)
    visit = recording * (int(epoch.max(initial=0)) + 1) + epoch
    visits = int(visit.max(initial=0)) + 1
    across, found = seen.T.tocsr(), []
    partners = min(config.partners, max(2, config.most // seen.shape[0]))
    for some in chunks(seen.shape[0], CLOUDS_AT_ONCE):
        common = seen[some] @ across
        common.sort_indices()
        common = common.tocoo()
        i, j = common.row.astype(np.intp) + some.start, common.col.astype(np.intp)
        share = common.data / np.minimum(size[i], size[j])
        kept = (np.abs(path[i] - path[j]) > config.epoch) & (share > config.min_share) & (common.data >= config.common)
        i, j, share = i[kept], j[kept], share[kept]
        own = i * visits + visit[j]
        # Numbers of which the whole part comes first, then the larger share, then the earlier cloud.
        order = np.argsort(own - 0.5 * share, kind="stable")
        order = order[run_starts(own[order])]
        order = order[np.argsort(i[order] - 0.5 * share[order], kind="stable")]
        i, j = i[order], j[order]
        best = np.arange(len(i)) - np.searchsorted(i, i) < partners
        found.append(np.stack([i[best], j[best]]))
    return np.concatenate(found, axis=1)


def unmeasured(graph: Graph, i: Ints, j: Ints, twist: Floats, delay: float) -> ScanEdges:
    """Return pairs of clouds (e,), (e,) as scan edges that nothing has measured yet, by the velocity of the base (k, 3) at each
    keyframe, and the delay of the lidar's clock, s, with which the clouds were made."""
    # Lines seen obliquely are tilted a little, so the cloud that gives the points seems shifted towards its laser: half a
    # millimetre per pair, always to the same side. With every other pair exchanged, this averages out.
    turned = i % 2 == 1
    i, j = np.where(turned, j, i), np.where(turned, i, j)
    none, names = np.broadcast_to(0.0, (len(i), *se2.POSE, *se2.POSE)), indices(graph.calibration, *LASER)
    return ScanEdges(i, j, none[:, 0], none, twist[i], twist[j], names, delay, kernel=RefinementConfig.kernel)


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
    looked_up = pairs_of(scans.clouds, pairs.i, pairs.j, config.points)
    gate, sigma, rounds, fit = config.first_gate, config.sigma, 0, np.inf
    optimizer = Optimizer()
    # The next round looks all matches up again: one successful step is enough.
    brief = replace(solver, max_iterations=config.track_rounds, relative_decrease=0.5)
    T_i_j = pairs.relative(graph)
    while True:
        factors = match(scans.raster, looked_up, T_i_j, gate, _kernel(gate, sigma, config))
        used = (factors.matched >= config.min_matches) & (factors.matched >= config.min_share * factors.asked)
        counting = factors.rows(used)
        if used.any() and gate < config.learns:
            sigma = max(float(np.sqrt(counting.variance)), config.quietest * config.sigma)
        z, sqrt_information = measured(factors, T_i_j, sigma**2 * _shared(looked_up, used, config))
        # Pairs that do not count stay in with no weight: then all rounds share one pattern, analysed once.
        edges = replace(pairs, T_i_j=z, sqrt_information=sqrt_information, weights=used.astype(np.float64))
        solved, summary = optimizer.optimize(graph.with_edges(edges), brief)
        graph = graph.with_estimates_of(solved)
        before, T_i_j = T_i_j, pairs.relative(graph)
        change = (T_i_j - before)[used]
        rounds += 1
        if on_round is not None:
            on_round(rounds, config.rounds)
        last = gate <= config.last_gate
        before_fit, fit = fit, counting.variance if last else np.inf
        settled = fit > (1.0 - config.creep) * before_fit or _surfaces_moved(counting, change) < config.convergence
        if rounds >= config.rounds or (last and settled):
            edges = replace(edges.rows(used), weights=None)
            return RefinementResult(graph, edges, pairs.i, pairs.j, factors, used, sigma, rounds, summary)
        # After a step that failed or was damped, as much may be left as before.
        whole = used.any() and len(summary.chi2_history) > 0 and summary.chi2_history[0] < summary.chi2_initial
        farthest = float(np.hypot(*change[:, :2].T).max()) if whole else gate
        gate = max(min(gate * config.shrink, config.gate_per_shift * farthest), config.last_gate)


def _kernel(gate: float, sigma: float, config: RefinementConfig) -> float:
    """Return the width of the robust kernel of matches, m."""
    return max(gate / config.gate_per_shift, config.outlier * sigma)


def _shared(pairs: CloudPairs, used: Bools, config: RefinementConfig) -> Floats:
    """Return the variance (e,) of a match of each pair by that of a point's distance: errors of one pair's matches are
    correlated, and all pairs of one cloud use the same points."""
    ends = np.stack([pairs.i, pairs.j])
    degree = np.bincount(ends[:, used].ravel(), minlength=int(ends.max(initial=-1)) + 1)[ends].sum(axis=0)
    return np.asarray(config.correlation * np.maximum(degree / 2.0**2, 1.0))


def measured_again(
    pairs: ScanEdges, graph: Graph, scans: ScanClouds, config: RefinementConfig, weight: Floats
) -> ScanEdges:
    """Return refined pairs as the poses of a graph have them, measured with weights (p,) of the clouds' points."""
    T_i_j, looked_up = pairs.relative(graph), pairs_of(scans.clouds, pairs.i, pairs.j, config.points)
    kernel = _kernel(config.last_gate, config.sigma, config)
    factors = match(scans.raster, looked_up, T_i_j, config.last_gate, kernel, weight)
    variance = max(factors.variance, (config.quietest * config.sigma) ** 2)
    z, sqrt_information = measured(factors, T_i_j, variance * _shared(looked_up, np.ones(len(pairs), dtype=bool), config))
    return replace(pairs, T_i_j=z, sqrt_information=sqrt_information)


def _surfaces_moved(factors: PairFactors, change: Floats) -> float:
    """Return how far changes (e, 3) of relative poses move matched points off their lines, root mean square, m."""
    change = np.column_stack([change[:, :2], se2.wrap_angle(change[:, 2])])
    squared = np.einsum("ei,eij,ej->", change, factors.hessian, change, optimize=True)
    return float(np.sqrt(max(squared, 0.0) / max(factors.weight.sum(), 1.0)))


def with_fewer_pairs(graph: Graph, most: int = 12_000) -> Graph:
    """Return the graph with at most so many scan edges between clouds of different times, each for several similar ones.

    The uncertainty of thousands of poses tied together everywhere would need a factor of hundreds of millions of entries. With
    every m-th pair, weighing as m, and a chain of single steps, standard deviations come out up to a third too large.
    """
    return replace(graph, edges=tuple(_every_nth(e, most) if isinstance(e, ScanEdges) else e for e in graph.edges))


def _every_nth(edges: ScanEdges, most: int) -> ScanEdges:
    gap = np.abs(edges.i - edges.j)
    far = np.flatnonzero(gap > max(RefinementConfig.neighbours))
    each = -(-len(far) // most)
    if each <= 1:
        return edges
    weights = edges.own_weights.copy()
    # A chain of single steps causes no fill.
    steps, kept = np.flatnonzero(gap == 1), far[each // 2 :: each]
    weights[steps] *= (len(edges) - len(far)) / max(len(steps), 1)
    weights[kept] *= len(far) / max(len(kept), 1)
    return replace(edges, weights=weights).rows(np.sort(np.concatenate([steps, kept])))
