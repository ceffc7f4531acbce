"""Covariances of anchors where the lidar holds the poses, by what their ranges err alike.

A weight that lets many alike errors count once treats each of them as a large error of its own. That suits the estimate, but
the inverse H^-1 = (J^T W J)^-1 is not its covariance: too large in directions that few ranges determine, too small where alike
errors all push one way. With the covariance R of the errors it is

    H^-1 J^T W R W J H^-1

(P. J. Huber, The behavior of maximum likelihood estimates under nonstandard conditions, 1967). One part of the errors is new
in every range, the other changes with direction and distance alone, and the anchor's place absorbs much of it. How large both
are, the residuals say: R is such that it would leave in them the scatter that they have (as in restricted maximum likelihood).
So an anchor behind obstacles, whose ranges scatter by decimetres, is stated to be decimetres off though it fits: its ranges are
all late, by an exponentially distributed way whose mean is as large as its scatter.

What the errors of the poses add is the marginal covariance of the whole graph less H^-1. That is positive but for how far the
two are linearised at different places; along a line of sight, where the curvature is all but nothing, that decides.
"""

import numpy as np

from ..arrays import Floats, spread_about_median
from ..graph.graph import Graph, edge_weights
from ..graph.marginals import CommonErrors, marginals
from ..graph.range_edges import RangeEdges
from .range_noise import RangeNoiseConfig, steady_sums

_STEADY = 0.7
"""Share of the variance that changes with direction and distance alone: a half is assumed to be slow while nothing is learnt,
and antennas, received power and the robot's own body make more of it than noise does."""
_ENOUGH = 30
"""Ranges to an anchor from which on its errors are learnt, and its covariance with them."""


def by_alike_errors(graph: Graph, edges: RangeEdges, whole: Floats, config: RangeNoiseConfig) -> Floats:
    """Return the covariances of the anchors (a, 2, 2), m^2, with the errors that their ranges have alike; see above.

    Parameters
    ----------
    graph : whatever is not estimated with the anchors is fixed.
    edges : the graph's ranges, with the weights that the anchors were estimated with.
    whole : (a, 2, 2) m^2, marginal covariances of the anchors estimated with the poses, by the weights.
    """
    around, each = marginals(graph), np.arange(len(edges))
    # Of an error of 1 m in each range.
    slopes = around.slopes(CommonErrors(edges, each, each, 1.0 / edges.sigma[:, None], each)).T.tocsr()
    weights, residuals = edge_weights(edges, graph), edges.residuals(graph)[:, 0] * edges.sigma
    offsets = edges.tag_positions(graph.poses) - graph.anchors[edges.anchor]
    found = whole.copy()
    for anchor, place in enumerate(around.unknowns.number["anchors"]):
        own = np.flatnonzero((edges.anchor == anchor) & (weights > 0.0))
        if place[0] < 0 or len(own) < _ENOUGH or np.trace(around.anchors[anchor]) > np.mean(np.sum(offsets[own] ** 2, axis=1)):
            continue  # given, hardly measured, or in a direction less known than it is far: nothing is linear there
        columns = np.unique(slopes[own].indices)
        inverse, factors = around.columns(columns)[columns], slopes[own][:, columns].toarray()
        variance = edges.sigma[own] ** 2 / weights[own]
        jacobian = variance[:, None] * factors
        alike = _STEADY * steady_sums(offsets[own], factors) + (1.0 - _STEADY) * factors
        scatter = max(config.steady, float(edges.sigma[own].max()), spread_about_median(residuals[own]))
        unlike = scatter**2 / _shown(inverse, jacobian, factors, alike) * alike - jacobian
        here = inverse[np.searchsorted(columns, place)]
        by_ranges = around.anchors[anchor] + here @ (factors.T @ unlike) @ here.T
        found[anchor] = by_ranges + _positive(whole[anchor] - around.anchors[anchor])
    return found


def _positive(matrix: Floats) -> Floats:
    """Return a symmetric matrix (k, k) without its negative part."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _shown(inverse: Floats, jacobian: Floats, factors: Floats, alike: Floats) -> float:
    """Return the share of the variance of errors that least squares leaves in residuals: of their covariance R (m, m), by 1 on
    its diagonal, the trace of (I - J H^-1 J^T W) R (I - J H^-1 J^T W)^T over m.

    Parameters
    ----------
    inverse : (q, q) H^-1. jacobian : (m, q) J. factors : (m, q) W J. alike : (m, q) R W J.
    """
    absorbed = 2.0 * np.trace(inverse @ (alike.T @ jacobian))
    absorbed -= np.trace(inverse @ (factors.T @ alike) @ inverse @ (jacobian.T @ jacobian))
    return 1.0 - float(absorbed) / len(factors)
