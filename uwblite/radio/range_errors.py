"""Systematic errors of ranges: of all by the anchor's direction in the robot's frame, of each anchor by the tag's place.

The robot's own body shadows its tag (Otim et al., Electronics 8(11):1351, 2019), and an antenna's delay changes with the
direction (bitcraze/crazyflie-firmware, issue 680): equally for all anchors, and in every range. Once clouds determine the
trajectory, it is estimated with all other unknowns, as errors that ranges have in common (graph/marginals.py).

Multipath, walls and an anchor whose place is off cause errors that depend on the tag's place and are the same on every visit.
The range residuals of the map are interpolated over the floor by a Gaussian process of covariance ``slow^2 exp(-d / length)``,
learnt as in mapping (radio.range_noise); far from the path only the anchor's mean is corrected (C. Rasmussen, C. Williams,
Gaussian Processes for Machine Learning, 2006, algorithm 2.1). The error by direction is subtracted before.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import cdist

from .. import se2
from ..arrays import Floats, Ints, spread
from ..graph.graph import Graph
from ..graph.marginals import Marginals
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from .range_noise import RangeNoise, RangeNoiseConfig, learn

HARMONICS = 3
"""Number of harmonics of an anchor's direction in the robot's frame, which model the pattern of antenna and body."""
PATTERN_SIGMA = 0.05
"""m; prior of each of the pattern's coefficients, 0.09 m together: 0.06 m of radiation patterns and 0.1 m behind a body."""
_TAG_X = 3
"""Column of the calibration that differs between the tags of each recording."""


def pattern_waves(angles: Floats) -> Floats:
    """Return the harmonics (m, 2 HARMONICS) of an anchor's direction (m,) in the robot's frame, rad."""
    times = angles[:, None] * np.arange(1, HARMONICS + 1)
    return np.concatenate([np.cos(times), np.sin(times)], axis=1)


def without_pattern(edges: RangeEdges, graph: Graph, around: Marginals) -> RangeEdges:
    """Return the ranges with the pattern of their tags as known delays; every recording has its own.

    Parameters
    ----------
    graph : contains the edges, and is solved. around : its marginals.
    """
    way = graph.anchors[edges.anchor] - edges.tag_positions(graph.poses)
    waves = pattern_waves(se2.bearing(way) - graph.poses[edges.pose, 2] - edges.turn)
    tags, tag = np.unique(edges.calibration[:, _TAG_X], return_inverse=True)
    each = waves.shape[1]
    edge, error = np.repeat(np.arange(len(edges)), each), each * tag.reshape(-1, 1) + np.arange(each)
    shift, shape = PATTERN_SIGMA * waves / edges.sigma[:, None], (len(edges), each * len(tags))
    found = around.estimated(edges, sparse.csr_matrix((shift.ravel(), (edge, error.ravel())), shape=shape))
    late = PATTERN_SIGMA * np.sum(waves * found[error], axis=1)
    # The residuals show the remaining pattern where a part was subtracted before.
    return replace(edges, late=late + edges.ranges - edges.corrected)


_CONSTANT = 0.1
"""m; common error of the ranges to one anchor, everywhere."""
_CELL, _MOST_CELLS = 0.25, 400
"""m; ranges from one square of this size are averaged, of a larger one where an anchor has more squares: it bounds the time."""
_ROBUST, _ITERATIONS = Kernel("cauchy", 2.0), 4
"""By white standard deviations."""
_PER_LENGTH, _MOST_ENTRIES, _FADED = 0.2, 10_000, 3.0
"""Step of the table of errors, in lengths over which they are alike; most entries of an anchor, in larger buildings with a
larger step; and lengths after which a place says nothing about another one: 5 %."""
_APART = 1e6
"""m; between the anchors' ranges when their noise is learnt together."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeErrors:
    """The error of ranges to one anchor by the place of the tag, as a table: thousands of poses are compared by it."""

    origin: Floats
    """(2,) m, map frame, of the first entry."""
    cell: float
    """m between entries."""
    table: Floats
    """(x, y) m."""
    noise: RangeNoise

    def at(self, places: Floats) -> Floats:
        """Return the errors (...) to expect at places (..., 2) of the tag, m; outside of the table that of its edge."""
        at = ((places - self.origin) / self.cell).reshape(-1, 2).T
        return np.asarray(map_coordinates(self.table, at, order=1, mode="nearest").reshape(places.shape[:-1]))


def range_errors(anchor: Ints, tags: Floats, bearings: Floats, errors: Floats, count: int) -> tuple[RangeErrors, ...]:
    """Return the errors of ranges to each of so many anchors.

    Parameters
    ----------
    anchor : (m,) of each of the map's ranges. tags : (m, 2) where the tag was, m, map frame. bearings : (m,) direction of the
        anchor in the robot's frame, rad. errors : (m,) measured minus expected, m.
    """
    constants = np.eye(count)[anchor]
    jacobian = np.column_stack([pattern_waves(bearings), constants])
    prior = np.append(np.full(2 * HARMONICS, PATTERN_SIGMA), np.full(count, _CONSTANT))
    x, weight = _robust_fit(jacobian, errors, prior)
    apart = tags + np.column_stack([_APART * anchor, np.zeros(len(anchor))])
    noise = learn(apart, errors - jacobian @ x, weight, RangeNoiseConfig())
    left = errors - jacobian[:, : 2 * HARMONICS] @ x[: 2 * HARMONICS]
    return tuple(_of_one(tags[anchor == k], left[anchor == k], noise) for k in range(count))


def _robust_fit(jacobian: Floats, errors: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Return the unknowns (n,) with prior standard deviations (n,), and the errors' weights (m,)."""
    x = np.zeros(len(prior))
    weight, information = np.ones(len(errors)), np.diag(prior**-2.0)
    for _ in range(_ITERATIONS):
        left = errors - jacobian @ x
        sigma = max(spread(left), RangeNoiseConfig().min_sigma) if len(left) else 1.0
        weight = _ROBUST.weight(np.square(left / sigma))
        weighted = jacobian.T * (weight / sigma**2)
        x = np.asarray(np.linalg.solve(weighted @ jacobian + information, weighted @ errors), dtype=np.float64)
    return x, weight


def _of_one(tags: Floats, errors: Floats, noise: RangeNoise) -> RangeErrors:
    """Return the errors of ranges to one anchor, of tags (m, 2) and errors (m,), m."""
    member = _squares(tags)
    ranges = np.bincount(member)
    places = np.column_stack([np.bincount(member, c) / ranges for c in tags.T]) if len(tags) else tags
    covariance, weight = _covariance(places, places, noise), np.ones(len(tags))
    coefficients = np.zeros(len(places))
    for _ in range(_ITERATIONS):
        total = np.bincount(member, weight)
        mean = np.bincount(member, weight * errors) / total
        coefficients = np.asarray(np.linalg.solve(covariance + np.diag(noise.white**2 / total), mean), dtype=np.float64)
        left = errors - (covariance @ coefficients)[member]
        weight = _ROBUST.weight(np.square(left / noise.white))
    return _table(places, coefficients, noise)


def _table(places: Floats, coefficients: Floats, noise: RangeNoise) -> RangeErrors:
    """Return the errors about places (k, 2), m, to where they have faded, interpolated with coefficients (k,), 1/m."""
    if not len(places):
        return RangeErrors(np.zeros(2), 1.0, np.zeros((1, 1)), noise)
    origin = places.min(axis=0) - _FADED * noise.length
    size = places.max(axis=0) + _FADED * noise.length - origin
    cell = max(_PER_LENGTH * noise.length, float(np.sqrt(np.prod(size) / _MOST_ENTRIES)))
    x, y = (origin[k] + cell * np.arange(int(np.ceil(size[k] / cell)) + 1) for k in (0, 1))
    # A line after the other, to bound the memory.
    lines = [_covariance(np.column_stack([np.full(len(y), value), y]), places, noise) @ coefficients for value in x]
    return RangeErrors(origin, cell, np.array(lines), noise)


def _squares(tags: Floats) -> Ints:
    """Return in which of at most _MOST_CELLS squares of the floor each place (m, 2) lies."""
    cell = _CELL
    while True:
        member = np.unique(np.floor(tags / cell), axis=0, return_inverse=True)[1].reshape(-1).astype(np.intp)
        if member.max(initial=0) < _MOST_CELLS:
            return member
        cell *= 2.0**0.5


def _covariance(one: Floats, other: Floats, noise: RangeNoise) -> Floats:
    return np.asarray(noise.slow**2 * np.exp(-cdist(one, other) / noise.length) + _CONSTANT**2)
