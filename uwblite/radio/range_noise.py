"""Size of range errors, and correlation of the errors of neighbouring ranges.

A radio's error is not white: multipath and antenna angle change slowly with the place, so a robot that stands or
returns measures the same error again. Thousands of ranges taken as independent would outweigh all other measurements. Here an
anchor's residuals are split into a white part and a slow part that is correlated within a correlation length in space
(variogram: Matheron 1963); a range with n correlated neighbours then gets the variance white + n slow, so that together
they have the weight of one sample of the slow part.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ..arrays import Bools, Floats, Ints, spread, unique_rows
from ..config import setting
from ..graph.robust import Kernel

_ROBUST = Kernel("cauchy", 2.5)


@dataclass(frozen=True, slots=True)
class RangeNoiseConfig:
    """Noise of ranges: the assumption before there are residuals, and how it is learnt from them."""

    sigma: float = 0.12
    """Assumed standard deviation, m, before it is learnt."""
    slow_share: float = setting(0.5, advanced=True)
    """Assumed share of the variance that is slow."""
    correlation_length: float = setting(1.5, above=0.0, advanced=True)
    """Correlation length of the slow part, m, before it is learnt."""
    min_sigma: float = setting(0.03, advanced=True)
    """Smallest standard deviation that is learnt, m."""
    steady: float = 0.06
    """Standard deviation of the error that all ranges to an anchor from one direction and distance have in common, m.
    Radiation pattern and received power alone cause as much. Residuals do not show it: a shifted anchor explains it as well."""
    learn: bool = True
    """Estimate from the residuals how much of the error is new in every range, and how much changes slowly with the place."""
    kernel: Kernel = setting(_ROBUST, advanced=True)
    """Robust kernel: ranges through walls are long; none = squared errors (the paper)."""


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


def short_term_sigma(stamps: Floats, anchor: Ints, ranges: Floats, config: RangeNoiseConfig) -> float:
    """Return a first guess of the noise of all ranges, m, without any position: the distance of each range from the line
    between its neighbours in time, to the same anchor (median absolute value, so outliers do not count).

    Parameters
    ----------
    stamps : (m,) s. anchor : (m,). ranges : (m,) m, usable ones.
    config : bounds; its sigma holds where there are fewer than 20 such triples.
    """
    order = np.lexsort((stamps, anchor))
    t, a, r = stamps[order], anchor[order], ranges[order]
    if len(r) < 3:
        return config.sigma
    same = (a[2:] == a[:-2]) & (t[2:] > t[:-2])
    span = np.where(same, t[2:] - t[:-2], 1.0)
    w = (t[1:-1] - t[:-2]) / span
    off = (r[1:-1] - (1.0 - w) * r[:-2] - w * r[2:]) / np.sqrt(1.0 + w**2 + (1.0 - w) ** 2)
    same &= span < 4.0 * np.median(span[same]) if same.any() else same
    if same.sum() < 20:
        return config.sigma
    return max(spread(off[same]), config.min_sigma)


def learn(positions: Floats, residuals: Floats, weights: Floats, config: RangeNoiseConfig) -> RangeNoise:
    """Split one anchor's residuals into white and slow part.

    Parameters
    ----------
    positions : (m, 2) tag at the ranges, m.
    residuals : (m,) m.
    weights : (m,) 0..1, robust weights; ranges below 0.5 are outliers and left out.
    config : assumption that is used where there are too few residuals.
    """
    kept = weights > 0.5
    prior = assumed(config)
    if not config.learn or kept.sum() < 30:
        return prior
    p, e = positions[kept], residuals[kept] - np.median(residuals[kept])
    sigma = max(spread(e), config.min_sigma)
    e = np.clip(e, -3.0 * sigma, 3.0 * sigma)
    variance = max(float(e @ e) / len(e), config.min_sigma**2)
    edges = np.array([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 6.0])
    covariance, pairs = _covariance_by_distance(p, e, edges)
    enough = pairs >= 20
    if enough.sum() < 3 or not enough[:2].any():
        return prior
    middle = 0.5 * (edges[1:] + edges[:-1])
    return _fit(middle[enough], covariance[enough], pairs[enough], variance, prior, config)


def _covariance_by_distance(p: Floats, e: Floats, edges: Floats) -> tuple[Floats, Floats]:
    """Return mean products of residuals (b,) and pair counts (b,) by distance between the places."""
    stride = -(-len(e) // _MOST_PAIRED)
    p, e = p[::stride], e[::stride]
    tree = cKDTree(p)
    # Both trees at once count pairs by the thousand; each pair comes twice and each place with itself once, at distance 0.
    upto = np.append(np.nextafter(edges[1:-1], 0.0), edges[-1])
    pairs = tree.count_neighbors(tree, upto, cumulative=False).astype(np.float64)
    product = tree.count_neighbors(tree, upto, weights=(e, e), cumulative=False)
    pairs[0], product[0] = pairs[0] - len(e), product[0] - e @ e
    return product / np.maximum(pairs, 1.0), 0.5 * pairs


_MOST_PAIRED = 1000
"""Most ranges of an anchor whose pairs are counted; more do not change the correlation, and the cost grows with the square."""


def _fit(
    distance: Floats, covariance: Floats, pairs: Floats, variance: float, prior: RangeNoise, config: RangeNoiseConfig
) -> RangeNoise:
    """Fit slow^2 exp(-d / length) to the covariances by a search over length; slow^2 follows linearly."""
    weight = np.sqrt(pairs)
    best = (np.inf, 0.0, prior.length)
    for length in np.geomspace(0.3, 8.0, 15):
        shape = np.exp(-distance / length)
        slow2 = float(np.clip((weight * shape) @ covariance / ((weight * shape) @ shape), 0.0, 0.95 * variance))
        misfit = float(weight @ (covariance - slow2 * shape) ** 2)
        if misfit < best[0]:
            best = (misfit, slow2, float(length))
    slow = float(np.sqrt(best[1]))
    white = float(np.sqrt(max(variance - best[1], (0.5 * config.min_sigma) ** 2)))
    return RangeNoise(white, slow, best[2])


def effective_sigma(positions: Floats, noise: RangeNoise, weights: Floats | None = None) -> Floats:
    """Return the standard deviation (m,) of each of one anchor's ranges with which all together get the right weight.

    Parameters
    ----------
    positions : (m, 2) tag at the ranges, m.
    noise : the anchor's noise.
    weights : (m,) weight of each range as a neighbour of others, 0..1; None = all 1.
    """
    if noise.slow == 0.0 or len(positions) == 0:
        return np.full(len(positions), max(noise.sigma, 1e-6))
    return np.sqrt(noise.white**2 + noise.slow**2 * _correlation_sum(positions, noise.length, weights))


def independent_shares(positions: Floats, groups: Iterable[Ints | Bools], config: RangeNoiseConfig) -> Floats:
    """Return which share (m,) of each range is independent of its neighbours in its group, by the correlation assumed.

    Parameters
    ----------
    positions : (m, 2) tag at the ranges, m. groups : rows of each; a range of none is independent.
    """
    noise, shares = assumed(replace(config, sigma=1.0)), np.ones(len(positions))
    for own in groups:
        shares[own] = effective_sigma(positions[own], noise) ** -2
    return shares


def steady_sigma(offsets: Floats, config: RangeNoiseConfig, weights: Floats | None = None) -> Floats:
    """Return the standard deviation (m,) of each of one anchor's ranges for their common error by direction and distance.

    Parameters
    ----------
    offsets : (m, 2) from the anchor to the tag, m.
    """
    if config.steady == 0.0 or len(offsets) == 0:
        return np.zeros(len(offsets))
    return config.steady * np.sqrt(_correlation_sum(_polar(offsets), _STEADY_LENGTH, weights))


def steady_sums(offsets: Floats, values: Floats) -> Floats:
    """Return the sums (m, q) of values (m, q) of all ranges to an anchor, weighted by the correlation of errors by direction.

    Parameters
    ----------
    offsets : (m, 2) from the anchor to the tag, m.
    """
    return _correlated_sums(_polar(offsets), _STEADY_LENGTH, values)


def distance_sums(offsets: Floats, values: Floats) -> Floats:
    """Return the sums (m, q) of values (m, q) of all ranges, to any anchor, weighted by the correlation of errors by distance.

    Parameters
    ----------
    offsets : (m, 2) from the anchor to the tag, m.
    """
    return _correlated_sums(_polar(offsets)[:, 2:], _STEADY_LENGTH, values)


_STEADY_LENGTH = 0.5
"""Correlation lengths: half a radian of direction, half an e-fold of distance."""


def _polar(offsets: Floats) -> Floats:
    """Return points (m, 3) whose distances are those of directions, rad, and of logarithms of distance."""
    distance = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 0.1)
    bearing = np.arctan2(offsets[:, 1], offsets[:, 0])
    return np.stack([np.cos(bearing), np.sin(bearing), np.log(distance)], axis=1)


def _correlation_sum(positions: Floats, length: float, weights: Floats | None) -> Floats:
    """Return the sum (m,) of exp(-distance / length) over all ranges, itself included, at least 1; see _correlated_sums."""
    counts = np.ones(len(positions)) if weights is None else weights
    return np.maximum(_correlated_sums(positions, length, counts[:, None])[:, 0], 1.0)


def _correlated_sums(positions: Floats, length: float, values: Floats) -> Floats:
    """Return the sums (m, q) of exp(-distance / length) times values (m, q) over all ranges; places binned to length / 4."""
    cells, inverse = unique_rows(np.round(positions * (4.0 / length)).astype(np.intp))
    tree = cKDTree(cells / 4.0)
    correlated = tree.sparse_distance_matrix(tree, 4.0, output_type="coo_matrix")
    correlated.data = np.exp(-correlated.data)
    binned = sparse.csc_matrix((np.ones(len(inverse)), inverse, np.arange(len(inverse) + 1)), shape=(len(cells), len(inverse)))
    return np.asarray((correlated @ (binned @ values))[inverse])
