"""Evidence of a problem: the marginal likelihood of all measurements with the unknowns integrated out (Laplace).

I. J. Good, The Estimation of Probabilities, 1965; D. MacKay, Bayesian interpolation, 1992.

Of a calibration value that parts of a recording show apart three explanations compete: it is 0, it is a constant, it changes
from part to part without a common mean. A value whose estimates scatter more than their standard deviations say is no constant
to that extent: the scatter is an error that all explanations have alike, so that it takes evidence from a constant and does not
pass for precision.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..graph.graph import Graph, PriorEdges


def laplace_marginal_likelihood(graph: Graph) -> float:
    """Return the logarithm of the marginal likelihood of a graph at its optimum (Laplace), but for terms that hypotheses share.

    Parameters
    ----------
    graph : solved, with all its edges; calibration values have priors.

    Raises
    ------
    SolverError : the measurements do not determine the graph.
    """
    from ..graph.marginals import calibration_covariance  # loads scipy, which a check of a recording does without

    which = np.flatnonzero(~graph.fixed_calibration)
    determinant = np.linalg.slogdet(calibration_covariance(graph)[np.ix_(which, which)])[1]
    return float(0.5 * (determinant - graph.chi2()) - np.sum(np.log(prior_sigma(graph)[which])))


def log_density(graph: Graph) -> float:
    """Return the logarithm of the joint density at a graph's optimum, but for a constant.

    Between optima of one problem it differs by what their evidence does, but for determinants that are nearly the same.
    """
    return -0.5 * graph.chi2()


def log_marginal_likelihood(mean: Floats, covariance: Floats, before: Floats, after: Floats) -> float:
    """Return the logarithm of the marginal likelihood of other prior standard deviations, relative to those in use.

    With the posterior N(a, P) under the prior N(0, D), that of N(0, D') is, relative to it,

        2 log Z = h^T J^-1 h - a^T P^-1 a - log|J| - log|P| - log|D'| + log|D|,   J = P^-1 + D'^-1 - D^-1,   h = P^-1 a.

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


def prior_sigma(graph: Graph) -> Floats:
    """Return the prior standard deviation (c,) of each calibration value, inf without a prior."""
    sigma = np.full(len(graph.calibration.values), np.inf)
    for priors in graph.calibration_priors:
        sigma[priors.index] = 1.0 / priors.sqrt_information[:, 0, 0]
    return sigma


def with_prior_sigma(graph: Graph, sigma: Floats, mean: Floats | None = None) -> Graph:
    """Return the graph with other prior standard deviations (c,) of its calibration values, and other means (c,), nan = as
    they are."""
    mean = np.full(len(sigma), np.nan) if mean is None else mean
    edges = []
    for e in graph.edges:
        if isinstance(e, PriorEdges) and e.block == "calibration":
            value, root = mean[e.index][:, None], (1.0 / sigma[e.index])[:, None, None]
            e = replace(e, value=np.where(np.isnan(value), e.value, value), sqrt_information=root)
        edges.append(e)
    return replace(graph, edges=tuple(edges))


class ScatterPolicy:
    """Scatters tried, evenly in their logarithm, as shares of the least standard deviation and of the prior's."""

    tried: int = 60
    least: float = 0.01
    most: float = 10.0


_TINY = np.finfo(np.float64).tiny
"""Precision of a part that shows nothing; it is the same on either side."""


def log_odds_of_constant(values: Floats, sigmas: Floats, prior: float) -> float:
    """Return the logarithm of the odds of a constant against 0, by the parts or by the two halves, whichever shows it less.

    A value that changes once is alike in neighbouring parts, and scatters only between the halves.

    Parameters
    ----------
    values, sigmas : (p,) estimates of the parts in the order of time, without a prior, and their standard deviations; inf =
        shows nothing. prior : standard deviation of a constant.
    """
    second = 2 * np.arange(len(values)) >= len(values)
    total = np.bincount(second, sigmas**-2.0, 2)
    means = np.bincount(second, values * sigmas**-2.0, 2) / np.maximum(total, _TINY)
    with np.errstate(divide="ignore"):
        of_halves = np.asarray(total**-0.5, dtype=np.float64)
    return min(log_odds_by_parts(values, sigmas, prior), log_odds_by_parts(means, of_halves, prior))


def log_odds_by_parts(values: Floats, sigmas: Floats, prior: float) -> float:
    """Return the logarithm of the odds of a constant with the prior N(0, prior^2) against 0, where no value changes once.

    Each part's estimate is N(v, s^2 + t^2) with the common value v; the scatter t has a uniform prior of its logarithm, and is
    integrated out on either side.
    """
    least = float(min(sigmas.min(initial=np.inf), prior))
    scatter = np.append(0.0, np.geomspace(ScatterPolicy.least * least, ScatterPolicy.most * prior, ScatterPolicy.tried))[
        :, None
    ]
    precision = 1.0 / (sigmas**2 + scatter**2)
    total, pulled = precision.sum(axis=1), precision @ values
    without = 0.5 * np.sum(np.log(np.maximum(precision, _TINY)), axis=1) - 0.5 * np.sum(precision * values**2, axis=1)
    gain = 0.5 * pulled**2 / (total + prior**-2.0) - 0.5 * np.log1p(total * prior**2)
    return float(np.logaddexp.reduce(without + gain) - np.logaddexp.reduce(without))


def without_prior(values: Floats, sigmas: Floats, prior: float) -> tuple[Floats, Floats]:
    """Return estimates (p,) and standard deviations (p,) without the part of the prior N(0, prior^2) in them."""
    precision = np.maximum(sigmas**-2.0 - prior**-2.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(precision > 0.0, values * sigmas**-2.0 / precision, 0.0), precision**-0.5
