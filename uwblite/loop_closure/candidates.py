"""Candidates for loop closures: pairs of sub-maps that may overlap by the graph's covariance.

Where the covariance of two sub-maps is small, they are candidates if they should share surfaces; where it is large, if they
may. Where any pair is uncertain by many metres, stretches of tens of metres are compared first: a search narrower than the
uncertainty may miss the true place, and a search over all of it finds many places at which one sub-map of a corridor fits, but
one only at which doors and pillars match as well as walls (net_overlap). The likeliest pairs come first: each closed loop
makes the others more certain.
"""

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import OUTLIER, Bools, Floats, Ints, Table
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..lidar import submaps
from ..lidar.submaps import Submaps
from ..lidar.visibility import surface_cells
from .closures import LoopClosureConfig

Tried = set[tuple[int, int, bool]]
"""Target, source, and whether they were searched, of pairs that were tried."""


class CandidatePolicy:
    """Which pairs are worth a match."""

    sigmas: float = OUTLIER
    """Standard deviations within which the truth is looked for."""
    shared: float = 0.25
    """Least share of its surface that the smaller of two sub-maps should have in common with the other."""
    cells: int = 5
    """Surface of a sub-map, in cells, up to which it shows no place."""
    length: float = 30.0
    """Travelled distance of a stretch, m: it contains several doors or pillars, and the drift of a chain of scans stays
    within the gate of the final matching. Each begins in the middle of the one before."""
    wider: float = 2.0
    """Factor on the standard deviations of a chain of steps: a bias that following steps share adds up along the way, and the
    covariance contains none (twice the stated heading in a hospital)."""
    never: float = 1e-4
    """Probability of an overlap up to which stretches are not tried; the covariance may be too small, but not by so much."""
    at_once: int = 40
    """Pairs of stretches tried before the graph is solved again."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates(Table):
    """Pairs of sub-maps to try."""

    target: Ints
    """(c,) number of the sub-map that is matched against."""
    source: Ints
    """(c,) number of the sub-map that is matched with it."""
    guess: Floats
    """(c, 3) relative pose of the reference keyframes by the graph."""
    covariance: Floats
    """(c, 3, 3) of the guess."""
    spread: Floats
    """(c,) m, of its position: half-width of a search."""
    constrained: bool = True
    """Ranges or given anchors constrain the trajectory, so that its covariance is reliable."""
    long: bool = False
    """The sub-maps are long stretches, of which a part may overlap."""

    def names(self, config: LoopClosureConfig) -> Tried:
        """Return them as a record of the pairs tried."""
        doubtful = self.spread > config.direct
        return set(zip(self.target.tolist(), self.source.tolist(), doubtful.tolist(), strict=True))


def propose(
    graph: Graph, marginals: JointCovariance, submaps: Submaps, recording: Ints, tried: Tried, constrained: bool,
    config: LoopClosureConfig, beyond: float = -1.0,
) -> Candidates:
    """List pairs of sub-maps that may overlap, best expected overlap first within each sub-map.

    Parameters
    ----------
    graph, marginals : present estimates, and the uncertainty of the sub-maps' reference keyframes.
    recording : (k,) recording of each keyframe.
    tried : in earlier rounds; not proposed again.
    constrained : ranges constrain the trajectory.
    beyond : pairs that are no more uncertain, m, are left out.
    """
    reference, rules = submaps.reference, CandidatePolicy
    poses = graph.poses[reference]
    a, b, distance = _near(poses, recording[reference], config)
    guess, covariance = se2.between(poses[a], poses[b]), marginals.relative(reference[a], reference[b])
    spread = _spread(covariance)
    seen = surface_cells(submaps.clouds, poses)
    common = np.asarray((seen @ seen.T).todense())[a, b]
    size = np.maximum(np.diff(seen.indptr), 1)
    expected = common / np.minimum(size[a], size[b])
    doubtful = spread > config.direct
    worth = np.where(doubtful, overlap_probability(guess, covariance, config.reach), expected)
    near = distance < config.reach + np.minimum(spread, config.search_limit)
    possible = np.where(doubtful, near & (worth > 0.0), expected > rules.shared)
    possible &= (np.minimum(size[a], size[b]) > rules.cells) & (spread > beyond) & (spread <= config.search_limit)
    possible &= ~_among(np.stack([a, b, doubtful]), tried)
    kept = best_per_submap(a, b, np.where(possible, worth, -1.0), config.partners)
    return Candidates(a[kept], b[kept], guess[kept], covariance[kept], spread[kept], constrained)


def overlap_probability(guess: Floats, covariance: Floats, reach: float) -> Floats:
    """Return about the probability (p,) that sub-maps at relative poses (p, 3) are within reach, m, of each other.

    The disc within reach is taken as a Gaussian of the same peak and integral, whose variance is reach^2 / 2 along each axis.
    """
    own = reach**2 / 2.0 * np.eye(2)
    summed = covariance[:, :2, :2] + own
    squared = np.einsum("pi,pi->p", guess[:, :2], np.linalg.solve(summed, guess[:, :2, None])[..., 0])
    return np.asarray(np.sqrt(np.linalg.det(own) / np.linalg.det(summed)) * np.exp(-0.5 * squared))


def _among(columns: Ints, names: Set[tuple[int, ...]]) -> Bools:
    """Return which columns (d, p) of numbers, 0 or more, are among names, tuples of d such numbers."""
    named = np.array(sorted(names), dtype=np.intp).reshape(-1, len(columns)).T
    places = (1 + max(int(columns.max(initial=0)), int(named.max(initial=0)))) ** np.arange(len(columns))
    return np.isin(places @ columns, places @ named)


def _near(poses: Floats, recording: Ints, config: LoopClosureConfig) -> tuple[Ints, Ints, Floats]:
    """Return pairs (p,), (p,) of poses (s, 3) that may be tried, and their distances, m; neighbours in time may not."""
    a, b = np.triu_indices(len(poses), 1)
    distance = np.hypot(*(poses[a, :2] - poses[b, :2]).T)
    near = ((b - a > 1) | (recording[a] != recording[b])) & (distance < config.reach + config.search_limit)
    return a[near], b[near], distance[near]


def _spread(covariance: Floats) -> Floats:
    """Return how far (p,), m, places may be off in the direction in which they are least certain."""
    return CandidatePolicy.sigmas * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1], 0.0))


def best_per_submap(a: Ints, b: Ints, worth: Floats, limit: int) -> Ints:
    """Return rows such that every sub-map keeps its `limit` best partners; rows with worth <= 0 never."""
    kept: set[int] = set()
    for one in (a, b):
        order = np.lexsort((-worth, one))
        rank = np.arange(len(order)) - np.searchsorted(one[order], one[order])
        kept.update(order[(rank < limit) & (worth[order] > 0.0)].tolist())
    return np.array(sorted(kept), dtype=np.intp)


def cut(path: Floats, recording: Ints) -> tuple[Ints, Ints, Ints]:
    """Return first keyframe (s,), one past the last (s,) and reference (s,) of stretches, each overlapping the next by half.

    Parameters
    ----------
    path : (k,) travelled distance, m. recording : (k,).
    """
    first, last, _ = submaps.cut(path, recording, CandidatePolicy.length / 2.0)
    goes_on = recording[first[1:]] == recording[first[:-1]]
    last[:-1] = np.where(goes_on, last[1:], last[:-1])
    return first, last, (first + last - 1) // 2


def _of_stretches(config: LoopClosureConfig) -> LoopClosureConfig:
    return replace(config, reach=CandidatePolicy.length / 2.0, search_limit=np.inf)


def any_uncertain(
    graph: Graph, covariance: JointCovariance, reference: Ints, recording: Ints, config: LoopClosureConfig
) -> bool:
    """Return whether any stretches, or sub-maps, that may overlap are too uncertain for a search of sub-maps.

    Parameters
    ----------
    reference : (s,) keyframes in the middle of each. recording : (k,).
    """
    a, b, _ = _near(graph.poses[reference], recording[reference], _of_stretches(config))
    return bool(_spread(covariance.relative(reference[a], reference[b])).max(initial=0.0) > config.search_limit)


def uncertain_pairs(
    graph: Graph, covariance: JointCovariance, pieces: Submaps, recording: Ints, tried: Tried, constrained: bool,
    config: LoopClosureConfig, beyond: float,
) -> Candidates:
    """Return pairs of stretches that may overlap and are more uncertain than a limit, m, the likeliest first; see propose."""
    wide = _of_stretches(config)
    found = replace(propose(graph, covariance, pieces, recording, tried, constrained, wide, beyond), long=True)
    chance = overlap_probability(found.guess, found.covariance, wide.reach)
    order = np.argsort(-chance, kind="stable")
    return found.rows(order[chance[order] > CandidatePolicy.never])


def first_of(candidates: Candidates) -> Candidates:
    """Return the candidates that are tried before the graph is solved again, as uncertain as a chain of steps may be."""
    first = candidates.rows(slice(0, CandidatePolicy.at_once))
    wider = 1.0 if candidates.constrained else CandidatePolicy.wider
    return replace(first, covariance=wider**2 * first.covariance, spread=wider * first.spread)
