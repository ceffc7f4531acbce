"""Widths of the priors of the radios' errors and of the units of length, chosen by marginal likelihood of the recording.

Most radios are calibrated. A prior wide enough for those that are not (scales 7 % off, biases of a metre) leaves the others'
anchors and the map's scale undetermined, wherever bias and distance have the same effect along a path. So widths are chosen by
marginal likelihood (I. J. Good 1965; D. MacKay, Bayesian interpolation, 1992).

A wheel's radius is a setting and can be wrong by any factor, or by a worn tyre's where a lidar has measured ways that are
about as long: of the hypotheses about the wheels' unit the likeliest one is taken. The scale and the biases of radios can be
wrong by little or much: of several widths the mean (of the logarithms), weighted by marginal likelihood, is taken, and the
widest where a scale is clearly off.
"""

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats, Ints
from ..errors import SolverError
from ..graph.calibration import BIAS, HEIGHT, RANGE_SCALE, CalibrationConfig
from ..graph.graph import Edges, Graph
from ..graph.marginals import calibration_covariance
from ..graph.range_edges import RangeEdges
from ..problem.alternatives import EvidencePolicy
from ..problem.evidence import log_marginal_likelihood, prior_sigma, with_prior_sigma


class UnitPolicy:
    """What is known beforehand of units of length and of the calibration of radios."""

    widths: int = 4
    """Widths tried from calibrated to uncalibrated radios, and of heights, evenly spaced in their logarithm."""
    wrong_unit: float = 0.1
    """Prior odds that the wheels' unit of length is wrong, against all units being right."""
    off: float = 1.0
    """Prior odds that the radio's scale is off, by any order of magnitude, against being right; and the same of biases."""
    farthest: float = 0.08
    """Largest relative error of a radio's scale, unless the wheels' unit is known better: it measures times of flight. 0.07 has
    been observed."""
    short: float = -0.01
    too_short: float = 0.01
    """Relative error from which on ranges are shorter than the speed of light allows, and the factor on the odds of such a
    radio: ranges too long may come from late first paths, too short ones do not."""
    fewest: int = 3
    least_heights: float = 0.3
    """Least number of anchors for a common mean, and spread of squared heights, m^2: 1.5 m above the tag, within 10 cm."""
    together: float = 4.0
    """Ratio of the prior width of the mean to that of a single square: all anchors of a hall may be twice as high as usual."""


def with_calibrated_radio(graph: Graph, config: CalibrationConfig) -> Graph:
    """Return the graph with the priors of a radio whose antenna delays and unit are right, or narrower ones that it has."""
    sigma, biases = prior_sigma(graph), _between(config.range_bias_sound, config.range_bias)
    for kind, widths in ((BIAS, biases), (RANGE_SCALE, _between(config.range_scale_sound, config.range_scale))):
        own = graph.calibration.of_kinds(kind)
        sigma[own] = np.minimum(sigma[own], widths[0])
    return with_prior_sigma(graph, sigma)


def select_priors(graph: Graph, edges: Sequence[Edges], config: CalibrationConfig) -> Graph:
    """Return the graph with the priors of units of length and biases of greatest marginal likelihood.

    Parameters
    ----------
    graph : solved under its priors and the other edges.
    edges : the measurements.
    config : the narrowest and widest priors.
    """
    groups = [_free(graph, name) for name in (RANGE_SCALE, "odometry_scale", BIAS)]
    if not any(isinstance(each, RangeEdges) for each in edges):
        groups[0] = groups[2] = np.zeros(0, dtype=np.intp)
    which, radios, scales = np.concatenate(groups), len(groups[0]), len(groups[0]) + len(groups[1])
    sigma = prior_sigma(graph)
    if not len(which) or not np.all(np.isfinite(sigma[which])):
        return graph
    try:
        covariance = calibration_covariance(graph.with_edges(*edges))[np.ix_(which, which)]
        np.linalg.cholesky(covariance)
        determined = np.all(np.isfinite(np.linalg.inv(covariance)))
    except (SolverError, np.linalg.LinAlgError):
        return graph
    if not determined:
        return graph
    mean, before = graph.calibration.values[which], sigma[which]
    units, odds, hypothesis = _units(radios, len(groups[1]), config)
    biases = np.array(_between(config.range_bias_sound, config.range_bias) if len(groups[2]) else [1.0])
    tried = [[np.append(unit, np.full(len(groups[2]), bias)) for bias in biases] for unit in units]
    worth = np.array([[log_marginal_likelihood(mean, covariance, before, widths) for widths in row] for row in tried])
    if not np.isfinite(worth).any():
        return graph
    if radios:
        floats = int(np.flatnonzero(hypothesis == 0)[-1])
        # What a robot that stands measured determines no unit.
        known = bool(np.isfinite(worth[floats, 0]))
        off = float(_mean_under(mean, covariance, before, tried[floats][0])[0]) if known else np.inf
        against = np.log(UnitPolicy.too_short) if off < UnitPolicy.short else 0.0
        if abs(off) > UnitPolicy.farthest and config.odometry_unit > config.range_scale:
            against = -np.inf
        odds = odds + np.where((hypothesis == 0) & (np.arange(len(odds)) > 0), against, 0.0)
    worth = worth + odds[:, None] + np.log(_odds(len(biases)))
    likely = np.exp(worth - worth.max())
    rows = hypothesis == np.argmax(np.bincount(hypothesis, likely.sum(axis=1)))
    likely, units = likely[rows], units[rows]
    sigma[which[:scales]] = _unit_widths(units, likely.sum(axis=1))
    sigma[which[scales:]] = np.exp(likely.sum(axis=0) @ np.log(biases) / likely.sum())
    return with_prior_sigma(graph, sigma)


def _unit_widths(units: Floats, likely: Floats) -> Floats:
    """Return the chosen widths (n,) of those under one hypothesis about the wheels (h, n), the first for a calibrated radio."""
    if likely[1:].sum() > np.exp(EvidencePolicy.positive) * likely[0]:
        return np.asarray(units[likely > 0.0][-1])
    return np.asarray(np.exp(likely @ np.log(units) / likely.sum()))


def _units(radios: int, wheels: int, config: CalibrationConfig) -> tuple[Floats, Floats, Ints]:
    """Return the widths of units of length that are tried (h, radios + wheels), their logarithmic odds (h,), and which
    hypothesis about the wheels' unit each is under (h,).

    All units of wheels are right, and the radio's scale is sound or off by more and more; that of one recording's wheels is
    wrong; those of all recordings are.
    """
    scales = _between(config.range_scale_sound, config.range_scale) if radios else [1.0]
    right = np.full(wheels, config.odometry_scale)
    units = [np.append(np.full(radios, scale), right) for scale in scales]
    odds = list(_odds(len(scales)))
    hypothesis = [0] * len(scales)
    if wheels and config.odometry_unit > config.odometry_scale:
        wrong = [np.arange(wheels) == k for k in range(wheels)]
        for number, these in enumerate(wrong if wheels == 1 else [*wrong, np.ones(wheels, dtype=bool)]):
            units.append(np.append(units[0][:radios], np.where(these, config.odometry_unit, right)))
            odds.append(UnitPolicy.wrong_unit)
            hypothesis.append(number + 1)
    return np.array(units), np.log(odds), np.array(hypothesis)


def _odds(widths: int) -> Floats:
    """Return the prior odds (widths,) of the widths from calibrated to uncalibrated radios."""
    return np.append(1.0, np.full(widths - 1, UnitPolicy.off / max(widths - 1, 1)))


def _mean_under(mean: Floats, covariance: Floats, before: Floats, after: Floats) -> Floats:
    """Return the posterior mean (n,) of the unknowns under other prior standard deviations."""
    precision = np.linalg.inv(covariance)
    return np.asarray(np.linalg.solve(precision + np.diag(after**-2.0 - before**-2.0), precision @ mean))


def _between(low: float, high: float) -> list[float]:
    return [high] if not 0.0 < low < high else np.geomspace(low, high, UnitPolicy.widths).tolist()


def _free(graph: Graph, name: str) -> Ints:
    return np.flatnonzero(graph.calibration.of_kinds(name) & ~graph.fixed_calibration)


def with_alike_heights(graph: Graph) -> Graph:
    """Return the graph with priors of squared heights about their common mean: anchors of one building are alike in height.

    From a straight path ranges hardly determine which part of an anchor's distance is height, and an assumed height of 0 moves
    every anchor away from the path. So the squared heights q of one robot's tag get the prior

        q_k = m + d_k,    m ~ N(0, (4 sigma)^2),    d_k ~ N(0, tau^2)

    instead of independent ones, N(0, sigma^2); tau is the mean of widths from nearly equal to independent heights, weighted by
    marginal likelihood. Every height then has a prior of its own about the common mean, whose width contains its uncertainty.

    Parameters
    ----------
    graph : solved with all its edges and its heights free, about priors of 0.
    """
    kinds = graph.calibration.of_kinds(HEIGHT) & ~graph.fixed_calibration
    sigma, owners = prior_sigma(graph), [(key.recording, key.tag) for key in graph.calibration.keys]
    groups = [np.flatnonzero(kinds & np.array([o == own for o in owners])) for own in sorted(set(owners), key=str)]
    groups = [group for group in groups if len(group) >= UnitPolicy.fewest and np.all(np.isfinite(sigma[group]))]
    if not groups:
        return graph
    try:
        covariance = calibration_covariance(graph)
    except SolverError:
        return graph
    about = np.full(len(sigma), np.nan)
    for group in groups:
        mean, width = _common(graph.calibration.values[group], covariance[np.ix_(group, group)], sigma[group])
        about[group], sigma[group] = mean, width
    return with_prior_sigma(graph, sigma, about)


def _common(values: Floats, covariance: Floats, sigma: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of the heights' common prior, by the posterior of the squared heights (h,), (h, h) and
    the standard deviations (h,) of their independent priors."""
    posterior = np.linalg.inv(covariance)
    pulled, measured = posterior @ values, posterior - np.diag(sigma**-2.0)
    usual = float(np.median(sigma))
    wide, found = UnitPolicy.together * usual, []
    for spread in np.geomspace(min(UnitPolicy.least_heights, usual), usual, UnitPolicy.widths).tolist():
        prior = wide**2 + spread**2 * np.eye(len(values))
        whole = measured + np.linalg.inv(prior)
        likely = 0.5 * (pulled @ np.linalg.solve(whole, pulled) - np.linalg.slogdet(whole)[1] - np.linalg.slogdet(prior)[1])
        # Information about the mean from ranges and spread; each anchor is weighted by how well its height is determined.
        shown = np.linalg.inv(np.eye(len(values)) + spread**2 * measured)
        worth = (shown @ measured).sum() + wide**-2.0
        mean = float((shown @ pulled).sum() / worth)
        found.append((likely, mean, 1.0 / worth, spread))
    likely, mean, variance, spread = np.array(found).T
    weight = np.exp(likely - likely.max())
    weight /= weight.sum()
    # A square cannot be below 0.
    middle = max(float(weight @ mean), 0.0)
    return middle, float(np.sqrt(weight @ (variance + (mean - middle) ** 2) + np.exp(2.0 * weight @ np.log(spread))))
