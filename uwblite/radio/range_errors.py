"""Errors of each anchor's ranges by place, from the map's own recording: ranges are corrected by them near its path.

Multipath, walls and an anchor whose place is off by decimetres cause errors that depend on the tag's place and are the same
on every visit. The range residuals of the map are therefore interpolated over the floor by a Gaussian process, whose
noise is learnt from them as in mapping (radio.range_noise): covariance ``slow^2 exp(-d / length)``, and
far from the path only the anchor's mean is corrected (C. Rasmussen, C. Williams, Gaussian Processes for Machine Learning,
2006, algorithm 2.1). The error by direction, from the robot's own body and antenna, is subtracted before.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from ..arrays import Floats, Ints, spread
from .range_noise import RangeNoise, RangeNoiseConfig, learn
from .tag_pattern import HARMONICS, PATTERN_SIGMA, pattern_waves

_CONSTANT = 0.1
"""m; common error of the ranges to one anchor, everywhere."""
_CELL = 0.25
"""m; ranges from one square of this size are averaged: their errors are correlated."""
_MOST_CELLS = 400
"""Most squares of one anchor; where there are more the squares are larger, to bound the time for a matrix of them."""
_GATE = 2.0
"""White standard deviations at which a range's weight falls to a half (Cauchy)."""
_ITERATIONS = 4
_APART = 1e6
"""m; between the anchors' ranges when their noise is learnt together."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeErrors:
    """The error of ranges to one anchor by the place of the tag."""

    places: Floats
    """(k, 2) m, map frame."""
    coefficients: Floats
    """(k,) 1/m."""
    noise: RangeNoise

    def at(self, places: Floats) -> Floats:
        """Return the errors (h,) to expect at places (h, 2) of the tag, m."""
        return np.asarray(_covariance(places, self.places, self.noise) @ self.coefficients)


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
        weight = 1.0 / (1.0 + np.square(left / (_GATE * sigma)))
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
        weight = 1.0 / (1.0 + np.square(left / (_GATE * noise.white)))
    return RangeErrors(places, coefficients, noise)


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
