"""Candidates for loop closures: pairs of sub-maps that may overlap by the graph's covariance.

Where the graph's own covariance of two sub-maps is small, they are candidates if they should share surfaces; where
it is large, if they may share surfaces.
"""

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..lidar.overlap import surface_cells
from ..lidar.submaps import Submaps
from .closures import Closures, LoopClosureConfig


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
    """(c,) 3 sigma of its position, m."""
    constrained: bool = True
    """Ranges or given anchors constrain the trajectory, so that its covariance is reliable."""
    long: bool = False
    """The sub-maps are long stretches, of which a part may overlap."""

    def renumbered(self, target: Ints, source: Ints) -> "Candidates":
        """Return them with other numbers of sub-maps."""
        return replace(self, target=target, source=source)

    def names(self, config: LoopClosureConfig) -> set[tuple[int, int, bool]]:
        """Return (target, source, searched) of each, as a record of the pairs tried."""
        doubtful = self.spread > config.direct
        return {(int(a), int(b), bool(d)) for a, b, d in zip(self.target, self.source, doubtful, strict=True)}


def propose(
    graph: Graph, marginals: JointCovariance, submaps: Submaps, recording: Ints, tried: set[tuple[int, int, bool]],
    missed: set[tuple[int, int]], constrained: bool, config: LoopClosureConfig, beyond: float = -1.0,
) -> Candidates:
    """List pairs of sub-maps that may overlap, best expected overlap first within each sub-map.

    Parameters
    ----------
    graph, marginals : present estimates, and the uncertainty of the sub-maps' reference keyframes.
    recording : (k,) recording of each keyframe.
    tried : (target, source, searched) of earlier rounds; not proposed again.
    constrained : ranges constrain the trajectory.
    beyond : pairs whose 3 sigma are no larger, m, are left out; so are those of which a search would see a part only.
    missed : (target, source) that did not match from the graph's guess though the graph may be wrong: searched with slack.
    """
    reference = submaps.reference
    poses = graph.poses[reference]
    a, b, distance = _near(poses, recording[reference], config)
    if not len(a):
        return Candidates(a, b, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), constrained)
    covariance = marginals.relative(reference[a], reference[b])
    astray = _among(np.stack([a, b]), missed)
    covariance[astray] += np.diag([config.slip**2, config.slip**2, config.slip_angle**2])
    spread = _spread(covariance)
    seen = surface_cells(submaps.clouds, poses)
    common = np.asarray((seen @ seen.T).todense())[a, b]
    size = np.maximum(np.diff(seen.indptr), 1)
    expected = common / np.minimum(size[a], size[b])
    doubtful = spread > config.direct
    guess = se2.between(poses[a], poses[b])
    worth = np.where(doubtful & ~astray, overlap_probability(guess, covariance, config.reach), expected)
    near = distance < config.reach + np.minimum(spread, config.search_limit)
    possible = np.where(doubtful, near & (worth > 0.0), expected > 0.25) & (size[a] > 5) & (size[b] > 5)
    possible &= (spread > beyond) & (spread <= config.search_limit)
    fresh = ~_among(np.stack([a, b, doubtful]), tried)
    kept = _best_per_submap(a, b, np.where(possible & fresh, worth, -1.0), config.partners)
    a, b = a[kept], b[kept]
    return Candidates(a, b, guess[kept], covariance[kept], spread[kept], constrained)


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


def uncertain(
    graph: Graph, marginals: JointCovariance, reference: Ints, recording: Ints, config: LoopClosureConfig, beyond: float
) -> bool:
    """Return whether any two reference keyframes (s,) so near that they may be tried have 3 sigma beyond a limit, m."""
    a, b, _ = _near(graph.poses[reference], recording[reference], config)
    return bool(len(a) and _spread(marginals.relative(reference[a], reference[b])).max() > beyond)


def _near(poses: Floats, recording: Ints, config: LoopClosureConfig) -> tuple[Ints, Ints, Floats]:
    """Return pairs (p,), (p,) of poses (s, 3) that may be tried, and their distances, m; neighbours in time may not."""
    a, b = np.triu_indices(len(poses), 1)
    distance = np.hypot(*(poses[a, :2] - poses[b, :2]).T)
    near = ((b - a > 1) | (recording[a] != recording[b])) & (distance < config.reach + config.search_limit)
    return a[near], b[near], distance[near]


def _spread(covariance: Floats) -> Floats:
    """Return 3 sigma (p,) of places in the direction in which it is largest, m, by covariances (p, 3, 3)."""
    return 3.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1], 0.0))


def _best_per_submap(a: Ints, b: Ints, worth: Floats, limit: int) -> Ints:
    """Return rows such that every sub-map keeps its `limit` best partners; rows with worth <= 0 never."""
    kept: set[int] = set()
    for one in (a, b):
        order = np.lexsort((-worth, one))
        rank = np.arange(len(order)) - np.searchsorted(one[order], one[order])
        kept.update(order[(rank < limit) & (worth[order] > 0.0)].tolist())
    return np.array(sorted(kept), dtype=np.intp)


def missed(candidates: Candidates, found: Closures, config: LoopClosureConfig) -> set[tuple[int, int]]:
    """Return (target, source) of candidates that were matched from the graph's guess and shared too few points."""
    direct = candidates.spread <= config.direct
    return {
        (int(a), int(b))
        for a, b, d, records in zip(candidates.target, candidates.source, direct, found.candidates, strict=True)
        if d and records.overlap < config.overlap
    }
