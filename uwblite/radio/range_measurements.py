"""Range edges from ranges attached to keyframes, and the noise that is learnt for them."""

from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, spread
from ..graph.calibration import range_indices
from ..graph.graph import Calibration, Graph
from ..graph.range_edges import RangeEdges
from ..odometry.attached import AttachedRanges
from ..sensor_log import SensorMounting, plausible
from . import nlos_mixture
from .range_noise import RangeNoise, RangeNoiseConfig, assumed, effective_sigma, learn, steady_sigma

_ENOUGH_ERRORS = 5
"""Least number of ranges to an anchor to which a mixture is fitted."""
_LEAST_TRUST = 1e-6
"""Weight of a gross error, which keeps a graph solvable."""
_LEAST_DELAY = 0.15
"""Least delay of a range through an obstacle, m: a wall of 0.1 to 0.2 m whose permittivity is 4 and more."""


def range_edges(
    attached: AttachedRanges,
    anchor_ids: tuple[str, ...],
    mounting: SensorMounting,
    calibration: Calibration,
    noise: RangeNoiseConfig,
    max_range: float,
) -> RangeEdges:
    """Return one edge per range; readings that cannot be distances, or were made without odometry, get weight 0.

    Parameters
    ----------
    anchor_ids : names of the graph's anchors; attached.anchor indexes them.
    noise : of all ranges until it is learnt. max_range : m; longer readings are no distances.
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
        weights=(plausible(attached.ranges, max_range) & attached.inside).astype(np.float64),
    )


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
    blocked : (m,) ranges that went through an obstacle.
    """
    positions, sigma, weights = edges.tag_positions(graph.poses), edges.sigma.copy(), np.zeros(len(edges))
    errors, late = -edges.residuals(graph)[:, 0] * edges.sigma, np.zeros(len(edges), dtype=bool) if blocked is None else blocked
    through = errors[edges.alive & late]
    delay = max(spread(through), _LEAST_DELAY) if len(through) else _LEAST_DELAY
    noises = []
    for anchor in range(anchors):
        own = np.flatnonzero(edges.alive & (edges.anchor == anchor))
        clear = own[~late[own]] if np.sum(~late[own]) >= config.learnt_from else own
        noise, trust = assumed(config), np.ones(len(own))
        if config.learn and len(own) >= _ENOUGH_ERRORS:
            mixture = nlos_mixture.fit(errors[clear], config.min_sigma)
            trust = np.maximum(mixture.weights(errors[own]), _LEAST_TRUST)
            noise = learn(positions[clear], errors[clear], mixture.core(errors[clear]), config)
        sigma[own] = max(noise.sigma, _LEAST_TRUST)
        effective = effective_sigma(positions[own], noise, trust)
        if steady:
            effective = np.hypot(effective, steady_sigma(positions[own] - graph.anchors[anchor], config, trust))
        hid = late[own]
        # For the anchor, all late ranges together are one sample of the delay; for a pose, those from nearby are.
        common = delay * np.sqrt(max(float(trust[hid].sum()), 1.0))
        nearby = effective_sigma(positions[own[hid]], RangeNoise(0.0, delay, noise.length), trust[hid])
        effective[hid] = np.hypot(effective[hid], common if steady else nearby)
        weights[own] = trust * (sigma[own] / effective) ** 2
        noises.append(noise)
    return replace(edges, sigma=sigma, weights=weights), tuple(noises)


def log_densities(edges: RangeEdges, graph: Graph, least_sigma: float) -> tuple[Floats, Floats]:
    """Return the logarithm of the density of each range's error (m,), 1/m, and the share (m,) that is independent of others.

    The density is the mixture fitted to the errors of its anchor. With n correlated neighbours a weight of 1 / n is
    independent; 0 where a range does not count, or its anchor has too few.
    """
    density, share = np.zeros(len(edges)), np.zeros(len(edges))
    errors = -edges.residuals(graph)[:, 0] * edges.sigma
    for anchor in np.unique(edges.anchor[edges.alive]).tolist():
        own = np.flatnonzero(edges.alive & (edges.anchor == anchor))
        if len(own) >= _ENOUGH_ERRORS:
            mixture = nlos_mixture.fit(errors[own], least_sigma)
            density[own] = mixture.log_density(errors[own])
            share[own] = np.minimum(edges.own_weights[own] / np.maximum(mixture.weights(errors[own]), _LEAST_TRUST), 1.0)
    return density, share
