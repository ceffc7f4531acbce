"""Covariances with correlated range errors: of anchors where the lidar determines the poses, of all where ranges alone do.

A weight that counts many correlated errors as one is right for the estimate, but H^-1 = (J^T W J)^-1 is not its covariance: it
is too large in directions that few ranges determine, and too small where errors all have one sign. With their covariance R it
is

    H^-1 J^T W R W J H^-1

(P. J. Huber, The behavior of maximum likelihood estimates under nonstandard conditions, 1967). One part of the errors is new in
every range, the other changes only with direction and distance, and the anchor's place absorbs much of it. R is scaled so that
it would leave the scatter of the residuals (as in restricted maximum likelihood). The errors of the poses add the marginal
covariance of the whole graph minus H^-1, as far as that is positive: the two are linearised at different places.

Without a lidar the poses follow such errors as anchors do. Then H is that of the whole graph, and R counts in the place of W^-1
for its ranges alone: H^-1 + H^-1 J^T W (R - W^-1) W J H^-1. Behind more walls the ranges to all anchors are longer, and there
are more walls over a longer distance: half of the lasting errors belong to one anchor, by direction and distance, and half are
common to all, by distance. Their size is learnt from all anchors together, since a bent path hides half of what walls delay.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from ..arrays import OUTLIER, TINY, Bools, Floats, evenly, spread, spread_about_median
from ..graph.graph import Graph, edge_weights
from ..graph.marginals import Covariances, Marginals, marginals
from ..graph.range_edges import RangeEdges
from .range_noise import RangeNoiseConfig, distance_sums, steady_sums

_STEADY = 0.7
"""Share of the variance that changes only with direction and distance: one half is assumed as slow before it is learnt, and
antennas, received power and the robot's own body contribute more to it than noise does."""
_SAMPLE = 200
"""Ranges of a sample from which the share of an error that remains in residuals is computed."""
_NO_WEIGHT = 1e-12
"""Weight below which a range does not count."""


def anchors_with_correlated_errors(graph: Graph, edges: RangeEdges, whole: Floats, config: RangeNoiseConfig) -> Floats:
    """Return the covariances of the anchors (a, 2, 2), m^2, with the correlated errors of their ranges; see above.

    Parameters
    ----------
    graph : whatever is not estimated with the anchors is fixed.
    edges : the graph's ranges, with the weights that the anchors were estimated with.
    whole : (a, 2, 2) m^2, marginal covariances of the anchors estimated with the poses, by the weights.
    """
    if config.steady == 0.0:
        return whole
    around = marginals(graph)
    own_covariances = around.covariances.anchors
    slopes = _by_each_range(around, edges)
    weights, residuals = edge_weights(edges, graph), edges.residuals(graph)[:, 0] * edges.sigma
    offsets = edges.tag_positions(graph.poses) - graph.anchors[edges.anchor]
    found = whole.copy()
    for anchor, place in enumerate(around.unknowns.number["anchors"]):
        own = np.flatnonzero((edges.anchor == anchor) & (weights > 0.0))
        if (
            place[0] < 0
            or len(own) < config.learnt_from
            or np.trace(own_covariances[anchor]) > np.mean(np.sum(offsets[own] ** 2, axis=1))
        ):
            continue  # given, hardly measured, or with an uncertainty above its distance: there the linearisation is invalid
        columns = np.unique(slopes[own].indices)
        inverse, factors = around.columns(columns)[columns], slopes[own][:, columns].toarray()
        variance = edges.sigma[own] ** 2 / weights[own]
        jacobian = variance[:, None] * factors
        correlated = _STEADY * steady_sums(offsets[own], factors) + (1.0 - _STEADY) * factors
        scatter = max(config.steady, float(edges.sigma[own].max()), spread_about_median(residuals[own]))
        excess = scatter**2 / _shown(inverse, jacobian, factors, correlated) * correlated - jacobian
        here = inverse[np.searchsorted(columns, place)]
        by_ranges = own_covariances[anchor] + here @ (factors.T @ excess) @ here.T
        found[anchor] = by_ranges + _positive(whole[anchor] - own_covariances[anchor])
    return found


def with_correlated_errors(found: Marginals, graph: Graph, edges: RangeEdges, config: RangeNoiseConfig) -> Covariances:
    """Return the covariances of a graph whose poses rest on ranges, with the correlated errors of these; see above.

    Those of the chosen poses, anchors and calibration are computed; those of poses between two chosen ones grow as these do.

    Parameters
    ----------
    found : marginals of the graph, with chosen poses.
    """
    number, weights, plain = found.unknowns.number, edge_weights(edges, graph), found.covariances
    moving = np.all(number["poses"][plain.chosen] >= 0, axis=1)
    if config.steady == 0.0 or not np.any(weights > 0.0) or not moving.any():
        return plain
    offsets, variance = (
        edges.tag_positions(graph.poses) - graph.anchors[edges.anchor],
        edges.sigma**2 / np.maximum(weights, _NO_WEIGHT),
    )
    factors = _by_each_range(found, edges)
    scatter = _scatter(found, graph, edges, config, factors, offsets)
    parts = [number["poses"][plain.chosen].ravel(), number["anchors"].ravel(), number["calibration"].ravel()]
    poses, anchors, calibration = np.split(np.arange(sum(map(len, parts))), np.cumsum([len(part) for part in parts[:2]]))
    columns = found.columns(np.concatenate(parts))
    seen = factors @ columns[:-1]
    added = seen.T @ (scatter**2 * _times_correlation(edges, offsets, seen) - variance[:, None] * seen)
    whole = columns[np.concatenate(parts)] + 0.5 * (added + added.T)
    among = whole[np.ix_(poses, poses)]
    pairs, sigmas = anchors.reshape(-1, 2), np.sqrt(np.maximum(np.diagonal(whole)[calibration], 0.0))
    # Variances of unknowns without edges stay infinite.
    return replace(
        plain,
        poses=_grown(plain, among, moving),
        anchors=np.where(np.isfinite(plain.anchors), whole[pairs[:, :, None], pairs[:, None, :]], plain.anchors),
        calibration=np.where(np.isfinite(plain.calibration), sigmas, plain.calibration),
        among=among,
    )


def _grown(plain: Covariances, among: Floats, moving: Bools) -> Floats:
    """Return the covariances (n, 3, 3) of all poses, by those of the chosen ones that move.

    With C the covariance of a chosen pose and P the plain one, M = root(C) root(P)^-1 makes M P M^T = C. Between chosen poses M
    is linear, so that a triangle with a positive diagonal stays one.
    """
    count, size = len(plain.chosen), plain.poses.shape[1]
    before, after = (
        np.einsum("kikj->kij", matrix.reshape(count, size, count, size))[moving] for matrix in (plain.among, among)
    )
    by = (_root(after) @ np.linalg.inv(_root(before))).reshape(-1, size**2)
    at, chosen = np.arange(len(plain.poses)), plain.chosen[moving]
    grown = np.stack([np.interp(at, chosen, own) for own in by.T], axis=1).reshape(-1, size, size)
    return np.asarray(grown @ plain.poses @ grown.transpose(0, 2, 1))


def _root(covariances: Floats) -> Floats:
    """Return the lower triangles L (k, 3, 3) with L L^T = covariances, which round-off may have made indefinite."""
    sigma = np.sqrt(np.maximum(np.einsum("kii->ki", covariances), TINY**2))
    correlations = covariances / (sigma[:, :, None] * sigma[:, None, :])
    values, vectors = np.linalg.eigh(correlations)
    sound = (vectors * np.maximum(values, TINY)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.asarray(sigma[:, :, None] * np.linalg.cholesky(sound))


def _by_each_range(found: Marginals, edges: RangeEdges) -> sparse.csr_matrix:
    """Return W J (m, unknowns): of an error of 1 m in each range."""
    return found.slopes(edges, sparse.csr_matrix(sparse.diags(1.0 / edges.sigma))).T.tocsr()


def _times_correlation(edges: RangeEdges, offsets: Floats, values: Floats) -> Floats:
    """Return R (m, m), by 1 on its diagonal, times values (m, q)."""
    found = (1.0 - _STEADY) * values + 0.5 * _STEADY * distance_sums(offsets, values)
    for anchor in np.unique(edges.anchor):
        own = edges.anchor == anchor
        found[own] += 0.5 * _STEADY * steady_sums(offsets[own], values[own])
    return found


def _scatter(
    found: Marginals, graph: Graph, edges: RangeEdges, config: RangeNoiseConfig, factors: sparse.csr_matrix, offsets: Floats
) -> float:
    """Return the standard deviation of ranges, m, that leaves residuals, (I - J H^-1 J^T W) times the errors of all ranges plus
    the effect of other measurements, as large as they are."""
    weights, residuals = edge_weights(edges, graph), edges.residuals(graph)[:, 0] * edges.sigma
    alive = np.flatnonzero(weights > 0.0)
    most = OUTLIER * max(spread(residuals[alive]), config.steady)
    some = alive[evenly(len(alive), _SAMPLE)]
    variance = edges.sigma**2 / np.maximum(weights, _NO_WEIGHT)
    jacobian = factors[some].multiply(variance[some, None]).toarray()
    moved = found.solve(jacobian.T)
    taken = factors @ moved
    by_others = np.einsum("sk,ks->s", jacobian, moved) - np.einsum("ms,m,ms->s", taken, variance, taken)
    left = -taken
    left[some, np.arange(len(some))] += 1.0
    shown = np.einsum("ms,ms->s", left, _times_correlation(edges, offsets, left))
    unexplained = max(float(np.mean(np.minimum(np.abs(residuals[alive]), most) ** 2) - np.mean(by_others)), 0.0)
    checks = len(alive) * float(np.mean(shown))
    scatter = np.sqrt((config.learnt_from * config.sigma**2 + len(alive) * unexplained) / (config.learnt_from + checks))
    return max(config.steady, float(scatter))


def _positive(matrix: Floats) -> Floats:
    """Return a symmetric matrix (k, k) without its negative part."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _shown(inverse: Floats, jacobian: Floats, factors: Floats, correlated: Floats) -> float:
    """Return the share of the variance of errors that least squares leaves in residuals: of their covariance R (m, m), by 1 on
    its diagonal, the trace of (I - J H^-1 J^T W) R (I - J H^-1 J^T W)^T over m; of H^-1 (q, q), J, W J and R W J (m, q)."""
    absorbed = 2.0 * np.trace(inverse @ (correlated.T @ jacobian))
    absorbed -= np.trace(inverse @ (factors.T @ correlated) @ inverse @ (jacobian.T @ jacobian))
    return 1.0 - float(absorbed) / len(factors)
