"""Loop closures: which sub-maps show the same place, and what that says of their poses.

Candidates come from where the graph believes the sub-maps to lie, widened by its own marginal covariance. Where that
is small, matching starts from the graph's guess; where it is large, a correlative search over the whole uncertainty
comes first. A match then has to explain enough points, closely enough, agree with the graph's own uncertainty, be the
only good one, see through no wall, and finally live in peace with all other closures in the second optimisation.
Every candidate is kept, with the reason for its fate.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import se2
from .clouds import Clouds
from .free_space import FreeSpace, contradiction, free_space
from .graph import Graph, RelativePoseEdges
from .map_result import LoopClosure
from .marginals import JointCovariance
from .pair_matching import CloudRasters, PairFactors, PairPoints, match, measured, paint, pair_points, trusted_step
from .point_cloud import PointCloud, make_cloud
from .refinement import surface_cells
from .robust import Kernel
from .scan_search import SearchConfig, search
from .solver import SolverConfig, optimize
from .submaps import Submaps

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


_BEARINGS = 360
"""Bins of the free space around a keyframe."""
_SAME_PLACE = 0.3
"""Matches nearer than this, m and rad, are one place."""


@dataclass(frozen=True, slots=True)
class LoopClosureConfig:
    """Search and acceptance of loop closures."""

    method: Literal["search", "icp"] = "search"
    """search: candidates by the graph's own uncertainty, judged by all that follows here. icp: the paper's plain way, by
    the settings of [icp]; of those here only rounds, partners and correlation count (see plain_closures)."""
    partners: int = 4
    """Candidates per sub-map and round, best expected overlap first."""
    rounds: int = 4
    """Most rounds of searching and solving; ends early when a round finds nothing new."""
    direct: float = 0.5
    """Matching starts from the graph's guess when its uncertainty (3 sigma) is below this, m; else a search comes first."""
    reach: float = 6.0
    """Sub-maps whose middles lie farther apart than this, after the uncertainty is taken off, are no candidates, m."""
    search_limit: float = 8.0
    """Largest half-width of a search, m."""
    search_angle: float = 0.7
    """Largest half-width of a search, rad."""
    gate: float = 0.15
    """Outlier distance d of the final matching, m (the paper uses 0.1)."""
    sigma: float = 0.05
    """Fitness: greatest root mean square distance of matched points, m."""
    overlap: float = 0.4
    """Least share of points with a match when the graph's guess was good."""
    overlap_after_search: float = 0.5
    """Least share of points with a match after a search, which can be fooled."""
    uniqueness: float = 0.85
    """A second place that matches this share as well as the first makes a search ambiguous."""
    slip: float = 1.0
    """Standard deviation, m, added to the graph's guess where matching from it failed although the sub-maps ought to
    overlap and no radio holds the trajectory: the wheels may have slipped. Such pairs are searched anew."""
    slip_angle: float = 0.2
    """The same for the heading, rad."""
    chain_consistency: float = 400.0
    """The same where no radio holds the trajectory: one slip or one false step makes a chain of steps wrong far beyond
    its covariance, so a lone candidate is doubted less here and must live in peace with the other closures later."""
    consistency: float = 16.0
    """Largest squared Mahalanobis distance between match and graph (3 degrees of freedom; 16 = 0.1 %)."""
    points: int = 250
    """Points looked up per pair."""
    match_sigma: float = 0.03
    """Standard deviation of a match, m."""
    correlation: float = 24.0
    """Matches that together weigh as one: they share the bending of both sub-maps."""
    through: float = 0.12
    """Largest share of one sub-map's points that may stand where the other saw free space; people and drift leave some."""
    through_margin: float = 0.3
    """How far inside the free space a point must stand to count, m."""
    views: int = 8
    """Keyframes of a sub-map whose free space is looked at."""
    places: int = 3
    """Places found by a search that are matched before one is chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Closures:
    """Closures found so far: accepted edges between keyframes, and every candidate's story."""

    edges: RelativePoseEdges
    """One per accepted candidate, in their order."""
    candidates: tuple[LoopClosure, ...]


def no_closures() -> Closures:
    """Return the empty collection."""
    none = np.zeros(0, dtype=np.int64)
    return Closures(RelativePoseEdges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3))), ())


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Pairs of sub-maps to try."""

    target: Ints
    source: Ints
    guess: Floats
    """(c, 3) relative pose of the reference keyframes by the graph."""
    covariance: Floats
    """(c, 3, 3) of the guess."""
    spread: Floats
    """(c,) 3 sigma of its position, m."""
    held: bool = True
    """Radio or known anchors hold the trajectory, so that its covariance is to be believed."""

    def names(self, config: LoopClosureConfig) -> set[tuple[int, int, bool]]:
        """Return (target, source, searched) of each, to remember what was tried."""
        doubtful = self.spread > config.direct
        return {(int(a), int(b), bool(d)) for a, b, d in zip(self.target, self.source, doubtful, strict=True)}


def propose(
    graph: Graph, marginals: JointCovariance, submaps: Submaps, session: Ints, tried: set[tuple[int, int, bool]],
    missed: set[tuple[int, int]], held: bool, config: LoopClosureConfig,
) -> Candidates:
    """List pairs of sub-maps that may overlap, best expected overlap first within each sub-map.

    Parameters
    ----------
    graph, marginals : present estimates, and the uncertainty of the sub-maps' reference keyframes.
    session : (k,) recording of each keyframe.
    tried : (target, source, searched) of earlier rounds; not proposed again.
    held : the trajectory is held by radio.
    missed : (target, source) that did not match from the graph's guess though the graph may be wrong: searched with slack.
    """
    s = len(submaps)
    reference = submaps.reference
    a, b = np.triu_indices(s, 1)
    apart = (b - a > 1) | (session[reference[a]] != session[reference[b]])
    a, b = a[apart], b[apart]
    poses = graph.poses[reference]
    distance = np.hypot(*(poses[a, :2] - poses[b, :2]).T)
    near = distance < config.reach + config.search_limit
    a, b, distance = a[near], b[near], distance[near]
    if not len(a):
        return Candidates(a, b, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), held)
    covariance = marginals.relative(reference[a], reference[b])
    slack = np.diag([config.slip**2, config.slip**2, config.slip_angle**2])
    astray = np.array([(int(x), int(y)) in missed for x, y in zip(a, b, strict=True)])
    covariance = covariance + astray[:, None, None] * slack
    spread = 3.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1], 0.0))
    seen = surface_cells(submaps.clouds, poses)
    common = np.asarray((seen @ seen.T).todense())[a, b]
    size = np.maximum(np.diff(seen.indptr), 1)
    expected = common / np.minimum(size[a], size[b])
    doubtful = spread > config.direct
    worth = np.where(doubtful & ~astray, 1.0 - distance / (config.reach + np.minimum(spread, config.search_limit)), expected)
    possible = np.where(doubtful, worth > 0.0, expected > 0.25) & (size[a] > 5) & (size[b] > 5)
    fresh = np.array([(int(x), int(y), bool(d)) not in tried for x, y, d in zip(a, b, doubtful, strict=True)])
    kept = _best_per_submap(a, b, np.where(possible & fresh, worth, -1.0), config.partners)
    a, b = a[kept], b[kept]
    return Candidates(a, b, se2.between(poses[a], poses[b]), covariance[kept], spread[kept], held)


def _best_per_submap(a: Ints, b: Ints, worth: Floats, limit: int) -> Ints:
    """Return rows such that every sub-map keeps its `limit` best partners; rows with worth <= 0 never."""
    kept: set[int] = set()
    for one in (a, b):
        order = np.lexsort((-worth, one))
        rank = np.arange(len(order)) - np.searchsorted(one[order], one[order])
        kept.update(order[(rank < limit) & (worth[order] > 0.0)].tolist())
    return np.array(sorted(kept), dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """Outcome of matching pairs."""

    pose: Floats
    factors: PairFactors

    @property
    def share(self) -> Floats:
        return self.factors.matched / np.maximum(self.factors.asked, 1)

    @property
    def rms(self) -> Floats:
        return np.sqrt(self.factors.squared / np.maximum(self.factors.weight, 1e-9))


def align_pairs(
    clouds: Clouds, raster: CloudRasters, i: Ints, j: Ints, guess: Floats, points: PairPoints, first_gate: float,
    last_gate: float, iterations: int = 20,
) -> _Matched:
    """Align many pairs of clouds at once, each on its own: point-to-line ICP with a shrinking gate.

    Parameters
    ----------
    i, j : (e,) target and source clouds. guess : (e, 3) start poses.
    points : see pair_points. first_gate, last_gate : farthest match in the first and last iteration, m.
    """
    pose, gate = guess.copy(), first_gate
    for _ in range(iterations):
        factors = match(clouds, raster, i, pose, points, gate, gate / 2.0)
        step = trusted_step(factors)[0]
        reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / 0.3, np.abs(step[:, 2]) / 0.15)
        pose += step / np.maximum(reach, 1.0)[:, None]
        pose[:, 2] = se2.wrap_angle(pose[:, 2])
        if gate <= last_gate and np.abs(step).max(initial=0.0) < 1e-4:
            break
        gate = max(0.8 * gate, last_gate)
    return _Matched(pose, match(clouds, raster, i, pose, points, last_gate, last_gate / 2.0))


def find(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: SearchConfig,
    progress: Callable[[int, int], None] | None = None, free: Sequence[FreeSpace] | None = None,
) -> Closures:
    """Match candidates and judge each on its own.

    Parameters
    ----------
    candidates : see propose. submaps : their clouds.
    progress : called with (done, total).
    free : what each sub-map saw to be free, see seen_free; None = no candidate is held to see through walls.
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
    result = _Matched(pose, factors)
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


def _best_places(row: Ints, tries: _Matched, candidates: int) -> tuple[Ints, Floats]:
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


def seen_free(clouds: Clouds, submaps: Submaps, poses: Floats, config: LoopClosureConfig) -> list[FreeSpace]:
    """Return what each sub-map saw to be free: by bearing, how far up to the nearest point of each of its clouds.

    Parameters
    ----------
    clouds : one per keyframe. poses : (k, 3) T_map_base of the keyframes.
    """
    distance, bearing = np.hypot(clouds.points[:, 0], clouds.points[:, 1]), se2.bearing(clouds.points)
    step = 2.0 * np.pi / _BEARINGS
    bins = np.clip(((bearing + np.pi) / step).astype(np.int64), 0, _BEARINGS - 1)
    nearest = np.full((len(clouds), _BEARINGS), np.inf)
    np.minimum.at(nearest, (clouds.owner, bins), distance)
    free = []
    for first, last, reference in zip(submaps.first, submaps.last, submaps.reference, strict=True):
        views = np.unique(np.linspace(first, last - 1, config.views).round().astype(np.int64))
        relative = se2.between(poses[reference], poses[views])
        free.append(free_space(relative, nearest[views], -np.pi + 0.5 * step, step))
    return free


def _see_through(
    candidates: Candidates, submaps: Submaps, result: _Matched, free: Sequence[FreeSpace] | None, config: LoopClosureConfig
) -> Floats:
    """Return the larger share of points (c,) of either sub-map that would stand in what the other saw to be free."""
    through = np.zeros(len(candidates.target))
    if free is None:
        return through
    promising = (result.share >= min(config.overlap, config.overlap_after_search)) & (result.rms <= config.sigma)
    for k in np.flatnonzero(promising):
        a, b = int(candidates.target[k]), int(candidates.source[k])
        one = contradiction(free[a], se2.transform(result.pose[k], submaps.clouds.cloud(b)[0]), config.through_margin)
        other = se2.transform(se2.inverse(result.pose[k]), submaps.clouds.cloud(a)[0])
        through[k] = max(one[0], contradiction(free[b], other, config.through_margin)[0])
    return through


def _judge(
    candidates: Candidates, searched: Bools, found: Bools, second: Floats, through: Floats, result: _Matched,
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
    most = config.consistency if candidates.held else config.chain_consistency
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
    candidates: Candidates, submaps: Submaps, result: _Matched, z: Floats, sqrt_information: Floats, why: list[str]
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


def missed(candidates: Candidates, found: Closures, config: LoopClosureConfig) -> set[tuple[int, int]]:
    """Return (target, source) of candidates that were matched from the graph's guess and shared too few points."""
    direct = candidates.spread <= config.direct
    return {
        (int(a), int(b))
        for a, b, d, story in zip(candidates.target, candidates.source, direct, found.candidates, strict=True)
        if d and story.overlap < config.overlap
    }


def merged(one: Closures, other: Closures) -> Closures:
    """Return both collections as one."""
    a, b = one.edges, other.edges
    edges = RelativePoseEdges(
        np.concatenate([a.i, b.i]),
        np.concatenate([a.j, b.j]),
        np.concatenate([a.T_i_j, b.T_i_j]),
        np.concatenate([a.sqrt_information, b.sqrt_information]),
        b.kernel,
    )
    return Closures(edges, one.candidates + other.candidates)


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
    e = closures.edges
    left = RelativePoseEdges(e.i[kept], e.j[kept], e.T_i_j[kept], e.sqrt_information[kept], Kernel("cauchy", 3.0))
    story = list(closures.candidates)
    standing = [k for k, c in enumerate(story) if c.accepted]
    for k, chi2 in zip(np.array(standing)[~kept], squared[~kept], strict=True):
        story[k] = replace(story[k], accepted=False, reason=f"contradicts the other closures: chi2 {chi2:.0f}")
    return solved, Closures(left, tuple(story))
