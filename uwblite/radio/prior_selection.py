"""How wide the priors of the radios' errors and of the units of length are: as wide as the recording asks for.

Most radios are sound: their clocks are right to parts of a million and the maker calibrated the antennas to a few
centimetres. Some are not: scales 7 % off and biases of a metre and more are on record. A prior wide enough for those
leaves the others' anchors and the map's scale hanging in the air, wherever bias and distance look alike along a path.
So the priors' standard deviations are chosen by marginal likelihood, the probability of all measurements with the unknowns
integrated out (I. J. Good 1965; D. MacKay, Bayesian interpolation, 1992).

Units of length: a radio measures times of flight and cannot be wrong by much, a wheel's radius is a setting and can be
wrong by any factor. Three hypotheses are weighed: both are right, the radio's scale is off, the wheels' unit is wrong.
The likeliest one holds, with its prior odds; where nothing contradicts it, the first. Biases: widths from sound to
unsound are tried, and what is taken is their mean on the scale of logarithms, weighted by the marginal likelihood.

With the posterior N(a, P) found under the prior N(0, D), the marginal likelihood of another prior N(0, D') is, relative to it,

    2 log Z = h^T J^-1 h - a^T P^-1 a - log|J| - log|P| - log|D'| + log|D|,   J = P^-1 + D'^-1 - D^-1,   h = P^-1 a.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..errors import SolverError
from ..graph.calibration import CalibrationConfig
from ..graph.graph import Edges, Graph, PriorEdges
from ..graph.marginals import calibration_covariance

_STEPS = 4
"""Widths tried from sound to unsound, evenly spaced in their logarithm."""
_UNSOUND = 0.1
"""Odds beforehand that a unit of length is wrong, against all being right."""
_FARTHEST = 0.12
"""Relative error beyond which no radio's scale is off: it measures times of flight. 0.07 is on record."""


def select_priors(graph: Graph, edges: Sequence[Edges], config: CalibrationConfig) -> Graph:
    """Return the graph with the priors of units of length and biases of greatest marginal likelihood.

    Parameters
    ----------
    graph : solved under its priors and the other edges.
    edges : the measurements.
    config : the narrowest and widest priors.
    """
    groups = [_free(graph, name) for name in ("range_scale", "odometry_scale", "bias")]
    which, scales = np.concatenate(groups), len(groups[0]) + len(groups[1])
    sigma = _prior_sigma(graph)
    if not len(groups[0]) + len(groups[2]) or not np.all(np.isfinite(sigma[which])):
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
    units, odds = _units(len(groups[0]), len(groups[1]), config)
    biases = np.array(_between(config.range_bias_sound, config.range_bias, _STEPS) if len(groups[2]) else [1.0])
    tried = [[np.append(unit, np.full(len(groups[2]), bias)) for bias in biases] for unit in units]
    worth = np.array([[log_marginal_likelihood(mean, covariance, before, widths) for widths in row] for row in tried])
    if not np.isfinite(worth).any():
        return graph
    if len(groups[0]):
        off = [abs(_mean_under(mean, covariance, before, row[0])[0]) for row in tried]
        odds = np.where(np.array(off) > _FARTHEST, -np.inf, odds)
    best = int(np.argmax(np.logaddexp.reduce(worth, axis=1) + odds))
    likely = np.exp(worth[best] - worth[best].max())
    sigma[which[:scales]] = units[best]
    sigma[which[scales:]] = np.exp(likely @ np.log(biases) / likely.sum())
    return _with_prior_sigma(graph, sigma)


def _units(radios: int, wheels: int, config: CalibrationConfig) -> tuple[Floats, Floats]:
    """Return widths (h, radios + wheels) under each hypothesis about the units of lengths, and their logarithmic odds (h,).

    All units are right; the radio's is off; the wheels' of one recording is wrong; those of all recordings are.
    """
    sound = np.append(np.full(radios, config.range_scale_sound or config.range_scale), np.full(wheels, config.odometry_scale))
    units = [sound]
    if radios and 0.0 < config.range_scale_sound < config.range_scale:
        units.append(np.append(np.full(radios, config.range_scale), sound[radios:]))
    if wheels and config.odometry_unit > config.odometry_scale:
        wrong = [np.arange(wheels) == k for k in range(wheels)]
        for which in wrong if wheels == 1 else [*wrong, np.ones(wheels, dtype=bool)]:
            units.append(np.append(sound[:radios], np.where(which, config.odometry_unit, sound[radios:])))
    return np.array(units), np.append(0.0, np.full(len(units) - 1, np.log(_UNSOUND)))


def _mean_under(mean: Floats, covariance: Floats, before: Floats, after: Floats) -> Floats:
    """Return the posterior mean (n,) of the unknowns were their prior standard deviations others."""
    precision = np.linalg.inv(covariance)
    return np.asarray(np.linalg.solve(precision + np.diag(after**-2.0 - before**-2.0), precision @ mean))


def log_marginal_likelihood(mean: Floats, covariance: Floats, before: Floats, after: Floats) -> float:
    """Return the logarithm of the marginal likelihood of other prior standard deviations, relative to those in use.

    Parameters
    ----------
    mean, covariance : (n,) and (n, n) posterior of the unknowns.
    before, after : (n,) prior standard deviations in use and to be judged.
    """
    precision = np.linalg.inv(covariance)
    pulled = precision @ mean
    other = precision + np.diag(after**-2.0 - before**-2.0)
    sign, spread = np.linalg.slogdet(other)
    if sign <= 0:
        return -np.inf
    gain = pulled @ np.linalg.solve(other, pulled) - mean @ pulled
    determinant = np.linalg.slogdet(covariance)[1]
    return float(0.5 * (gain - spread - determinant) - np.sum(np.log(after / before)))


def _between(low: float, high: float, steps: int) -> Sequence[float]:
    return [high] if not 0.0 < low < high else np.geomspace(low, high, steps).tolist()


def _free(graph: Graph, name: str) -> Ints:
    fixed = graph.fixed_calibration
    named = graph.calibration.of_kinds(name)
    return np.flatnonzero(named if fixed is None else named & ~fixed)


def _prior_sigma(graph: Graph) -> Floats:
    """Return the prior standard deviation (c,) of each calibration value, inf without a prior."""
    sigma = np.full(len(graph.calibration.values), np.inf)
    for edges in graph.edges:
        if isinstance(edges, PriorEdges) and edges.block == "calibration":
            sigma[edges.index] = 1.0 / edges.sqrt_information[:, 0, 0]
    return sigma


def _with_prior_sigma(graph: Graph, sigma: Floats) -> Graph:
    def changed(edges: object) -> bool:
        return isinstance(edges, PriorEdges) and edges.block == "calibration"

    edges = tuple(
        replace(e, sqrt_information=(1.0 / sigma[e.index])[:, None, None]) if changed(e) else e  # type: ignore[attr-defined,type-var]
        for e in graph.edges
    )
    return replace(graph, edges=edges)
