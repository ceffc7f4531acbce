"""Evidence of a problem: the marginal likelihood of all measurements with the unknowns integrated out (Laplace).

I. J. Good, The Estimation of Probabilities, 1965; D. MacKay, Bayesian interpolation, 1992.
"""

from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..graph.graph import Graph, PriorEdges
from ..graph.joint_covariance import calibration_covariance


def laplace_marginal_likelihood(graph: Graph) -> float:
    """Return the logarithm of the marginal likelihood of a graph at its optimum (Laplace), but for terms that hypotheses share.

    Parameters
    ----------
    graph : solved, with all its edges; calibration values have priors.

    Raises
    ------
    SolverError : the measurements do not determine the graph.
    """
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


def with_prior_sigma(graph: Graph, sigma: Floats) -> Graph:
    """Return the graph with other prior standard deviations (c,) of its calibration values."""
    def changed(edges: object) -> bool:
        return isinstance(edges, PriorEdges) and edges.block == "calibration"

    edges = tuple(
        replace(e, sqrt_information=(1.0 / sigma[e.index])[:, None, None]) if changed(e) else e  # type: ignore[attr-defined,type-var]
        for e in graph.edges
    )
    return replace(graph, edges=edges)
