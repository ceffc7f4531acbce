"""Size of range errors, and correlation of the errors of neighbouring ranges.

A radio's error is not white: multipath and antenna angle change slowly with the place, so a robot that stands or
returns measures the same error again. An anchor's residuals are split into a white part and a slow part that is correlated
within a correlation length in space (variogram: Matheron 1963); a range with n correlated neighbours then gets the variance
white + n slow, so that together they have the weight of one sample of the slow part.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import ENOUGH, OUTLIER, Bools, Floats, Ints, spread, unique_rows
from ..config import setting
from ..graph.robust import Kernel

USUAL_KERNEL = Kernel("cauchy", 2.5)
"""On errors of ranges, some of which are false."""


@dataclass(frozen=True, slots=True)
class RangeNoiseConfig:
    """Noise of ranges: the assumption before there are residuals, and how it is learnt from them."""

    sigma: float = 0.12
    """Assumed standard deviation, m, before it is learnt."""
    slow_share: float = setting(0.5, advanced=True)
    """Assumed share of the variance that is slow."""
    correlation_length: float = setting(1.5, above=0.0, advanced=True)
    """Correlation length of the slow part, m, before it is learnt."""
    min_sigma: float = setting(0.03, above=0.0, advanced=True)
    """Smallest standard deviation that is learnt, m: few ranges fit exactly, and noise is compared by its ratio."""
    steady: float = 0.06
    """Standard deviation of the error that all ranges to an anchor from one direction and distance have in common, m.
    Radiation pattern and received power alone cause as much. Residuals do not show it: a shifted anchor explains it as well."""
    learn: bool = True
    """Estimate from the residuals how much of the error is new in every range, and how much changes slowly with the place."""
    kernel: Kernel = setting(USUAL_KERNEL, advanced=True)
    """Robust kernel: ranges through walls are long; none = squared errors (the paper)."""
    learnt_from: ClassVar[int] = 30
    """Ranges from which the noise, a correlation, or a covariance of an anchor is learnt."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeNoise:
    """White and slow part of one anchor's errors."""

    white: float
    """Standard deviation of the part that is new in every range, m."""
    slow: float
    """Standard deviation of the correlated part, m."""
    length: float
    """Correlation length, m."""

    @property
    def sigma(self) -> float:
        """Standard deviation of one range, m."""
        return float(np.hypot(self.white, self.slow))


def assumed(config: RangeNoiseConfig) -> RangeNoise:
    """Return the noise to start from."""
    slow = config.sigma * float(np.sqrt(config.slow_share))
    return RangeNoise(float(np.sqrt(config.sigma**2 - slow**2)), slow, config.correlation_length)


_SILENCE = 4.0
"""Usual times between neighbours beyond which the robot has turned in between."""


def short_term_sigma(stamps: Floats, anchor: Ints, ranges: Floats, config: RangeNoiseConfig) -> float:
    """Return a first guess of the noise of all ranges, m, without any position: the distance of each range from the line
    between its neighbours in time, to the same anchor (median absolute value, so outliers do not count).

    Parameters
    ----------
    stamps : (m,) s. anchor : (m,). ranges : (m,) m, usable ones.
    config : bounds; its sigma holds where there are too few such triples.
    """
    order = np.lexsort((stamps, anchor))
    t, a, r = stamps[order], anchor[order], ranges[order]
    same = (a[2:] == a[:-2]) & (t[2:] > t[:-2])
    if not same.any():
        return config.sigma
    span = np.where(same, t[2:] - t[:-2], 1.0)
    w = (t[1:-1] - t[:-2]) / span
    off = (r[1:-1] - (1.0 - w) * r[:-2] - w * r[2:]) / np.sqrt(1.0 + w**2 + (1.0 - w) ** 2)
    same &= span < _SILENCE * np.median(span[same])
    return max(spread(off[same]), config.min_sigma) if same.sum() >= ENOUGH else config.sigma


_DISTANCES = np.array([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 6.0])
"""m; bounds of the distances between places of which covariances are compared."""
_LENGTHS, _MOST_SLOW = np.geomspace(0.3, 8.0, 15), 0.95
"""Correlation lengths that are tried, m, and share of the variance that is slow at most."""
MOST_RANGES = 1000
"""Ranges of one anchor that are compared, spread evenly: more change neither a place nor a correlation."""


def learn(positions: Floats, residuals: Floats, weights: Floats, config: RangeNoiseConfig) -> RangeNoise:
    """Split one anchor's residuals into white and slow part.

    Parameters
    ----------
    positions : (m, 2) tag at the ranges, m. residuals : (m,) m.
    weights : (m,) 0..1, robust weights; ranges below 0.5 are outliers and left out.
    config : assumption that is used where there are too few residuals.
    """
    kept = weights > 0.5
    if not config.learn or kept.sum() < config.learnt_from:
        return assumed(config)
    p, e = positions[kept], residuals[kept] - np.median(residuals[kept])
    most = OUTLIER * max(spread(e), config.min_sigma)
    e = np.clip(e, -most, most)
    variance = max(float(e @ e) / len(e), config.min_sigma**2)
    covariance, pairs = _covariance_by_distance(p, e, _DISTANCES)
    enough = pairs >= ENOUGH
    # Three unknowns; the white part shows in what is nearer than the correlation length.
    if enough.sum() <= 2 or not enough[:2].any():
        return assumed(config)
    middle = 0.5 * (_DISTANCES[1:] + _DISTANCES[:-1])
    return _fit(middle[enough], covariance[enough], pairs[enough], variance, config)


def _covariance_by_distance(p: Floats, e: Floats, edges: Floats) -> tuple[Floats, Floats]:
    """Return mean products of residuals (b,) and pair counts (b,) by distance between the places."""
    stride = -(-len(e) // MOST_RANGES)
    p, e = p[::stride], e[::stride]
    tree = cKDTree(p)
    # Both trees at once count pairs by the thousand; each pair comes twice and each place with itself once, at distance 0.
    upto = np.append(np.nextafter(edges[1:-1], 0.0), edges[-1])
    pairs = tree.count_neighbors(tree, upto, cumulative=False).astype(np.float64)
    product = tree.count_neighbors(tree, upto, weights=(e, e), cumulative=False)
    pairs[0], product[0] = pairs[0] - len(e), product[0] - e @ e
    return product / np.maximum(pairs, 1.0), 0.5 * pairs


def _fit(distance: Floats, covariance: Floats, pairs: Floats, variance: float, config: RangeNoiseConfig) -> RangeNoise:
    """Fit slow^2 exp(-d / length) to the covariances by a search over length; slow^2 follows linearly."""
    weight, fits = np.sqrt(pairs), []
    for length in _LENGTHS.tolist():
        shape = np.exp(-distance / length)
        slow2 = float(np.clip((weight * shape) @ covariance / ((weight * shape) @ shape), 0.0, _MOST_SLOW * variance))
        fits.append((float(weight @ (covariance - slow2 * shape) ** 2), slow2, length))
    _, slow2, length = min(fits, key=lambda fit: fit[0])
    white = float(np.sqrt(max(variance - slow2, (0.5 * config.min_sigma) ** 2)))
    return RangeNoise(white, float(np.sqrt(slow2)), length)


def effective_sigma(positions: Floats, noise: RangeNoise, weights: Floats | None = None) -> Floats:
    """Return the standard deviation (m,) of each of one anchor's ranges with which all together get the right weight.

    Parameters
    ----------
    positions : (m, 2) tag at the ranges, m.
    weights : (m,) weight of each range as a neighbour of others, 0..1; None = all 1.
    """
    return np.sqrt(noise.white**2 + _common_variance(positions, noise.slow, noise.length, weights))


def independent_shares(positions: Floats, groups: Iterable[Ints | Bools], config: RangeNoiseConfig) -> Floats:
    """Return which share (m,) of each range is independent of its neighbours in its group, by the correlation assumed; a range
    of no group is independent."""
    noise, shares = assumed(replace(config, sigma=1.0)), np.ones(len(positions))
    for own in groups:
        shares[own] = effective_sigma(positions[own], noise) ** -2
    return shares


def steady_sigma(offsets: Floats, config: RangeNoiseConfig, weights: Floats | None = None) -> Floats:
    """Return the standard deviation (m,) of each of one anchor's ranges for their common error by direction and distance;
    offsets (m, 2) from the anchor to the tag, m."""
    return np.sqrt(_common_variance(_polar(offsets), config.steady, _STEADY_LENGTH, weights))


def steady_sums(offsets: Floats, values: Floats) -> Floats:
    """Return the sums (m, q) of values (m, q) of all ranges to an anchor, weighted by the correlation of errors by direction
    and distance; offsets (m, 2) from the anchor to the tag, m."""
    return _correlated_sums(_polar(offsets), _STEADY_LENGTH, values)


def distance_sums(offsets: Floats, values: Floats) -> Floats:
    """Return the same of ranges to any anchor by the correlation of errors by distance alone."""
    return _correlated_sums(_polar(offsets)[:, 2:], _STEADY_LENGTH, values)


_STEADY_LENGTH = 0.5
"""Correlation lengths: half a radian of direction, half an e-fold of distance."""
_AT_ANCHOR = 0.1
"""m from an anchor below which the logarithm of the distance has no meaning."""


def _polar(offsets: Floats) -> Floats:
    """Return points (m, 3) whose distances are those of directions, rad, and of logarithms of distance."""
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), _AT_ANCHOR)
    return np.column_stack([*se2.cos_sin(se2.bearing(offsets)), np.log(distance)])


def _common_variance(positions: Floats, sigma: float, length: float, weights: Floats | None) -> Floats:
    """Return the variance (m,) with which each of some ranges counts the error that it has in common with others."""
    if sigma == 0.0 or not len(positions):
        return np.zeros(len(positions))
    counts = np.ones(len(positions)) if weights is None else weights
    return sigma**2 * np.maximum(_correlated_sums(positions, length, counts[:, None])[:, 0], 1.0)


_CELLS = 4.0
"""Cells in a correlation length; also lengths beyond which nothing is correlated."""


def _correlated_sums(positions: Floats, length: float, values: Floats) -> Floats:
    """Return the sums (m, q) of exp(-distance / length) times values (m, q) over all ranges, of places binned to cells."""
    cells, inverse = unique_rows(np.round(positions * (_CELLS / length)).astype(np.intp))
    tree = cKDTree(cells / _CELLS)
    correlated = tree.sparse_distance_matrix(tree, _CELLS, output_type="coo_matrix")
    correlated.data = np.exp(-correlated.data)
    binned = sparse.csc_matrix((np.ones(len(inverse)), inverse, np.arange(len(inverse) + 1)), shape=(len(cells), len(inverse)))
    return np.asarray((correlated @ (binned @ values))[inverse])
