"""Candidates for loop closures: pairs of sub-maps that may overlap by the graph's covariance.

A search narrower than the uncertainty may miss the true place, and one over all of it finds many places at which a short piece
of a corridor fits, but one only at which doors and pillars match as well as walls (net_overlap). So sub-maps are so long that
each contains several of them. The likeliest pairs come first: each closed loop makes the others more certain.
"""

from collections.abc import Set
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import OUTLIER, Bools, Floats, Ints, Table
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..lidar.submaps import Submaps
from .closures import LoopClosureConfig

Tried = set[tuple[int, int, bool]]
"""Target, source, and whether they were searched, of pairs that were tried."""


@dataclass(frozen=True, slots=True)
class CandidatePolicy:
    """Which pairs are worth a match."""

    sigmas: ClassVar[float] = OUTLIER
    """Standard deviations within which the truth is looked for."""
    wider: ClassVar[float] = 2.0
    """Factor on the standard deviations of a chain of steps: a bias that following steps share adds up along the way, and the
    covariance contains none (twice the stated heading in a hospital)."""
    never: ClassVar[float] = 1e-4
    """Probability of an overlap up to which a pair is not tried; the covariance may be too small, but not by so much."""
    at_once: ClassVar[int] = 40
    """Pairs that are searched before the graph is solved again."""


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

    def names(self, config: LoopClosureConfig) -> Tried:
        """Return them as a record of the pairs tried."""
        doubtful = self.spread > config.direct
        return set(zip(self.target.tolist(), self.source.tolist(), doubtful.tolist(), strict=True))

    def overlapping(self, sigmas: float, config: LoopClosureConfig) -> Bools:
        """Return which pairs (c,) are within reach of each other, or within so many standard deviations of that."""
        reach = config.reach + self.spread * (sigmas / CandidatePolicy.sigmas)
        return np.asarray(np.hypot(self.guess[:, 0], self.guess[:, 1]) < reach)


def propose(
    graph: Graph, marginals: JointCovariance, submaps: Submaps, recording: Ints, tried: Tried, constrained: bool,
    config: LoopClosureConfig,
) -> Candidates:
    """List pairs of sub-maps that may overlap, the best partners of each sub-map, the likeliest pair first.

    Parameters
    ----------
    graph, marginals : present estimates, and the uncertainty of the sub-maps' reference keyframes.
    recording : (k,) recording of each keyframe; neighbouring sub-maps of one recording are no candidates.
    tried : in earlier rounds; not proposed again.
    constrained : ranges constrain the trajectory; else a guess is taken as uncertain as a chain of steps may be.
    """
    reference, of = submaps.reference, recording[submaps.reference]
    a, b = np.triu_indices(len(reference), 1)
    a, b = (ends[(b - a > 1) | (of[a] != of[b])] for ends in (a, b))
    guess, covariance = se2.between(*graph.poses[reference[[a, b]]]), marginals.relative(reference[a], reference[b])
    chance = overlap_probability(guess, covariance, config.reach)
    wider = 1.0 if constrained else CandidatePolicy.wider
    every = Candidates(a, b, guess, wider**2 * covariance, wider * _spread(covariance), constrained)
    possible = every.overlapping(CandidatePolicy.sigmas / wider, config) & (chance > CandidatePolicy.never)
    possible &= ~_among(np.stack([a, b, every.spread > config.direct]), tried)
    kept = best_per_submap(a, b, np.where(possible, chance, -1.0), config.partners)
    return every.rows(kept[np.argsort(-chance[kept], kind="stable")])


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
