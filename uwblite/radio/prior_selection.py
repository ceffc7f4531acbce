"""How wide the priors of radio errors are: as wide as the recording asks for.

Most radios are sound: their clocks are right to parts of a million and the maker calibrated the antennas to a few
centimetres. Some are not: scales 7 % off and biases of a metre and more are on record. A prior wide enough for those
leaves the others' anchors and the map's scale hanging in the air, wherever bias and distance look alike along a path.
So the priors' standard deviations are chosen by the evidence, the probability of all measurements with the unknowns
integrated out (I. J. Good 1965; D. MacKay, Bayesian interpolation, 1992): widths from sound to unsound are tried, and
what is taken is their mean on the scale of logarithms, weighted by that probability. Where the recording cannot tell, it
is one between.

With the posterior N(a, P) found under the prior N(0, D), the evidence of another prior N(0, D') is, relative to it,

    2 log Z = h^T J^-1 h - a^T P^-1 a - log|J| - log|P| - log|D'| + log|D|,   J = P^-1 + D'^-1 - D^-1,   h = P^-1 a.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..errors import SolverError
from ..graph.calibration import CalibrationConfig, stem
from ..graph.graph import Edges, Graph, PriorEdges
from ..graph.marginals import calibration_covariance

_STEPS = 4
"""Widths tried from sound to unsound, evenly spaced in their logarithm."""


def select_priors(graph: Graph, edges: Sequence[Edges], config: CalibrationConfig) -> Graph:
    """Return the graph with the priors of range scale and biases as wide as the evidence wants them.

    Parameters
    ----------
    graph : solved under its priors and the other edges.
    edges : the measurements.
    config : the narrowest and widest priors.
    """
    scale, bias = (_free(graph, name) for name in ("range_scale", "bias"))
    which = np.concatenate([scale, bias])
    sigma = _prior_sigma(graph)
    if not len(which) or not np.all(np.isfinite(sigma[which])):
        return graph
    try:
        covariance = calibration_covariance(graph.with_edges(*edges))[np.ix_(which, which)]
        np.linalg.cholesky(covariance)
    except (SolverError, np.linalg.LinAlgError):
        return graph
    mean, before = graph.calibration.values[which], sigma[which]
    scales = _between(config.range_scale_sound, config.range_scale, 2) if len(scale) else [1.0]
    biases = _between(config.range_bias_sound, config.range_bias, _STEPS) if len(bias) else [1.0]
    tried = np.array([(s, b) for s in scales for b in biases])
    counts = [len(scale), len(bias)]
    worth = np.array([log_evidence(mean, covariance, before, np.repeat(pair, counts)) for pair in tried])
    if not np.isfinite(worth).any():
        return graph
    likely = np.exp(worth - worth.max())
    best = np.repeat(np.exp(likely @ np.log(tried) / likely.sum()), counts)
    sigma[which] = best
    return _with_prior_sigma(graph, sigma)


def log_evidence(mean: Floats, covariance: Floats, before: Floats, after: Floats) -> float:
    """Return the logarithm of the evidence of other prior standard deviations, relative to those in use.

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
    known = np.linalg.slogdet(covariance)[1]
    return float(0.5 * (gain - spread - known) - np.sum(np.log(after / before)))


def _between(low: float, high: float, steps: int) -> Sequence[float]:
    return [high] if not 0.0 < low < high else np.geomspace(low, high, steps).tolist()


def _free(graph: Graph, name: str) -> Ints:
    held = graph.fixed_calibration
    named = np.array([stem(n) == name for n in graph.calibration.names], dtype=bool)
    return np.flatnonzero(named if held is None else named & ~held)


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
