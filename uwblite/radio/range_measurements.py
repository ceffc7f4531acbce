"""Range edges from ranges attached to keyframes, and the noise that is learnt for them."""

from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, spread
from ..graph.calibration import range_indices
from ..graph.graph import Calibration, Graph
from ..graph.range_edges import RangeEdges
from ..odometry.attached import AttachedRanges
from ..sensor_log import SensorMounting
from . import nlos_mixture
from .range_noise import RangeNoise, RangeNoiseConfig, assumed, effective_sigma, learn, steady_sigma
from .trilateration import TrilaterationConfig, agreement, trilaterate_each, usable


def range_edges(
    attached: AttachedRanges,
    anchor_ids: tuple[str, ...],
    mounting: SensorMounting,
    calibration: Calibration,
    noise: RangeNoiseConfig,
    search: TrilaterationConfig,
) -> RangeEdges:
    """Return one edge per range; readings that cannot be distances, or were made without odometry, get weight 0.

    Parameters
    ----------
    anchor_ids : names of the graph's anchors; attached.anchor indexes them.
    noise : of all ranges until it is learnt. search : decides which readings can be distances.
    """
    above = [mounting.height_difference(a) for a in anchor_ids]
    given = np.array([height or 0.0 for height in above])
    is_given = np.array([height is not None for height in above], dtype=bool)
    return RangeEdges(
        attached.keyframe,
        attached.anchor,
        attached.ranges,
        np.full(len(attached.ranges), noise.sigma),
        attached.lever_arm,
        attached.turn,
        attached.velocity,
        np.asarray(mounting.tag_position[:2], dtype=np.float64),
        given[attached.anchor] - np.where(is_given[attached.anchor], attached.rise, 0.0),
        range_indices(calibration, attached.anchor, anchor_ids, attached.tag),
        attached.stamps,
        kernel=noise.kernel,
        weights=(usable(attached.ranges, search) & attached.inside).astype(np.float64),
    )


def relocate(edges: RangeEdges, graph: Graph, placed: Bools, search: TrilaterationConfig) -> Graph:
    """Return the graph with anchors moved to places where clearly more of their ranges agree, with fixed poses.

    Parameters
    ----------
    edges : ranges; those of weight 0 do not count. placed : (a,) anchors that may be moved.
    """
    positions, anchors = edges.tag_positions(graph.poses), graph.anchors.copy()
    rows = [np.flatnonzero(edges.alive & (edges.anchor == anchor)) for anchor in np.flatnonzero(placed)]
    each = trilaterate_each([(positions[own], edges.rows(own).planar_ranges()) for own in rows], search, _LEVEL_SIGMA)
    for anchor, own, found in zip(np.flatnonzero(placed), rows, each, strict=True):
        if not found:
            continue
        here, there = (
            agreement(positions[own], edges.ranges[own], place, edges.height[own])
            for place in (anchors[anchor], found[0].position)
        )
        if there > here + _CLEARLY:
            anchors[anchor] = found[0].position
    return replace(graph, anchors=anchors)


_LEVEL_SIGMA = 0.15
"""Error of a path that the lidar determines, m."""
_CLEARLY = 0.1
"""Least additional share of its ranges that agree with another place, for an anchor to be moved there."""


def learn_noise(
    edges: RangeEdges, graph: Graph, anchors: int, config: RangeNoiseConfig, steady: bool = False, blocked: Bools | None = None
) -> tuple[RangeEdges, tuple[RangeNoise, ...]]:
    """Give every range the standard deviation learnt from its anchor's residuals, and a weight that counts slow errors once.

    The weight is no part of sigma: the outlier test uses the scatter of a single range.

    Parameters
    ----------
    graph : estimates the residuals are taken at.
    steady : also count errors once that depend only on direction and distance, see range_noise.steady_sigma: right for
        anchors at given poses, and against sustained outliers. Such errors do not affect poses, since the anchors'
        places absorb them; for poses, all ranges together must constrain the trajectory.
    """
    positions, sigma, weights = edges.tag_positions(graph.poses), edges.sigma.copy(), np.zeros(len(edges))
    errors = edges.residuals(graph)[:, 0] * edges.sigma
    alive = edges.alive
    delay = 0.0 if blocked is None else max(spread(errors[alive & blocked]) if np.any(alive & blocked) else 0.0, _LEAST_DELAY)
    noises = []
    for anchor in range(anchors):
        own = np.flatnonzero(alive & (edges.anchor == anchor))
        late = np.zeros(len(own), dtype=bool) if blocked is None else blocked[own]
        clear = np.flatnonzero(~late) if np.sum(~late) >= _ENOUGH_CLEAR else np.arange(len(own))
        noise = assumed(config)
        trust = np.ones(len(own))
        if config.learn and len(own) >= _ENOUGH_ERRORS:
            mixture = nlos_mixture.fit(-errors[own[clear]], config.min_sigma)
            trust = np.maximum(mixture.weights(-errors[own]), _LEAST_TRUST)
            noise = learn(positions[own[clear]], errors[own[clear]], mixture.core(-errors[own[clear]]), config)
        sigma[own] = max(noise.sigma, 1e-6)
        effective = np.hypot(
            effective_sigma(positions[own], noise, trust),
            steady_sigma(positions[own] - graph.anchors[anchor], config, trust) if steady else 0.0,
        )
        effective[late] = np.hypot(effective[late], _delay_sigma(positions[own[late]], delay, trust[late], noise, steady))
        weights[own] = trust * (sigma[own] / effective) ** 2
        noises.append(noise)
    return replace(edges, sigma=sigma, weights=weights), tuple(noises)


def log_densities(edges: RangeEdges, graph: Graph, config: RangeNoiseConfig) -> tuple[Floats, Floats]:
    """Return the logarithm of the density of each range's error (m,), 1/m, and the share (m,) that is independent of others.

    The density is the mixture fitted to the errors of its anchor. With n correlated neighbours a share of 1 / n is independent;
    0 where a range does not count, or its anchor has too few.
    """
    density, share = np.zeros(len(edges)), np.zeros(len(edges))
    errors = -edges.residuals(graph)[:, 0] * edges.sigma
    for anchor in np.unique(edges.anchor[edges.alive]).tolist():
        own = np.flatnonzero(edges.alive & (edges.anchor == anchor))
        if len(own) >= _ENOUGH_ERRORS:
            mixture = nlos_mixture.fit(errors[own], config.min_sigma)
            density[own] = np.log(mixture.density(errors[own]))
            share[own] = np.minimum(edges.own_weights[own] / np.maximum(mixture.weights(errors[own]), _LEAST_TRUST), 1.0)
    return density, share


def _delay_sigma(positions: Floats, delay: float, trust: Floats, noise: RangeNoise, steady: bool) -> Floats:
    """Return the standard deviation (m,) of an anchor's ranges through obstacles, from their delay.

    For the anchor, all of them together are one sample of the delay, since all are late; for a pose, those from nearby are.
    """
    if steady:
        return np.full(len(trust), delay * np.sqrt(max(float(trust.sum()), 1.0)))
    return effective_sigma(positions, RangeNoise(0.0, delay, noise.length), trust)


_ENOUGH_ERRORS, _LEAST_TRUST = 5, 1e-6
"""Least number of ranges to an anchor to which a mixture is fitted; weight of a gross error, which keeps a graph solvable."""
_ENOUGH_CLEAR = 30
"""Least number of ranges in line of sight from which the noise is learnt from these alone."""
_LEAST_DELAY = 0.15
"""Least delay of a range through an obstacle, m: a wall of 0.1 to 0.2 m whose permittivity is 4 and more."""
