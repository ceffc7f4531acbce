"""From keyframes to edges: what the wheels and the radio say, with the noise that makes them commensurate."""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..graph.calibration import odometry_indices, range_indices
from ..graph.graph import Calibration, Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from ..keyframes import AttachedRanges, Keyframes
from ..sensor_log import SensorMounting
from . import nlos_mixture
from .range_noise import RangeNoise, RangeNoiseConfig, assumed, effective_sigma, learn, steady_sigma
from .trilateration import AnchorConfig, agreement, locate, usable

_STEPS = Kernel("cauchy", 5.0)
_RANGES = Kernel("cauchy", 2.5)


@dataclass(frozen=True, slots=True)
class OdometryNoiseConfig:
    """Random errors of the wheels; systematic ones are calibrated."""

    distance: float = 0.018
    """Standard deviation of position along and across after one metre, m; grows with the square root of the distance."""
    heading_per_metre: float = 0.008
    """Standard deviation of heading after one metre, rad; grows with the square root of the distance."""
    heading_per_turn: float = 0.03
    """Standard deviation of heading after one radian of turning, rad; grows with the square root of the angle."""
    standing: float = 0.0005
    """Standard deviation of position (m) and heading (rad) of a robot that stands."""
    kernel: Kernel = _STEPS
    """Robust kernel: a step that slipped must not bend the rest; none = squared errors (the paper)."""


def wheel_edges(keyframes: Keyframes, first: int, config: OdometryNoiseConfig, calibration: Calibration) -> OdometryEdges:
    """Return the edges between consecutive keyframes of one recording; `first` is the graph's number of its first pose."""
    n = len(keyframes) - 1
    position = np.sqrt(config.standing**2 + config.distance**2 * keyframes.path)
    turning = config.heading_per_turn**2 * keyframes.turned
    heading = np.sqrt(config.standing**2 + config.heading_per_metre**2 * keyframes.path + turning)
    sqrt_information = np.zeros((n, 3, 3))
    sqrt_information[:, 0, 0] = sqrt_information[:, 1, 1] = 1.0 / position
    sqrt_information[:, 2, 2] = 1.0 / heading
    return OdometryEdges(
        first + np.arange(n),
        first + np.arange(1, n + 1),
        keyframes.motion,
        keyframes.length,
        keyframes.duration,
        sqrt_information,
        odometry_indices(calibration, n),
        config.kernel,
    )


def range_edges(
    attached: AttachedRanges, first: int, anchor_ids: tuple[str, ...], mounting: SensorMounting,
    calibration: Calibration, sigma: float, search: AnchorConfig, kernel: Kernel = _RANGES,
) -> RangeEdges:
    """Return one edge per range; readings that cannot be distances, or were made without odometry, get weight 0.

    Parameters
    ----------
    first : the graph's number of the recording's first pose.
    anchor_ids : names of the graph's anchors; attached.anchor indexes them.
    sigma : m, for all ranges until noise is learnt.
    search : says which readings can be distances. kernel : robust kernel of all ranges.
    """
    told = np.array([mounting.height_difference(a) or 0.0 for a in anchor_ids])
    return RangeEdges(
        attached.keyframe + first,
        attached.anchor,
        attached.ranges,
        np.full(len(attached.ranges), sigma),
        attached.lever_arm,
        attached.turn,
        attached.velocity,
        np.asarray(mounting.tag_position[:2], dtype=np.float64),
        told[attached.anchor],
        range_indices(calibration, attached.anchor, anchor_ids),
        kernel,
        (usable(attached.ranges, search) & attached.inside).astype(np.float64),
        attached.stamps,
    )


def tag_positions(edges: RangeEdges, poses: Floats) -> Floats:
    """Return where the tag was at each range (m, 2), map frame."""
    arm = edges.lever_arm + se2.rotate(edges.turn, edges.tag)
    return se2.transform(poses[edges.pose], arm)


def relocate(edges: RangeEdges, graph: Graph, placed: Bools, search: AnchorConfig) -> Graph:
    """Return the graph with anchors moved to where clearly more of their ranges agree, its poses being trusted.

    Parameters
    ----------
    edges : ranges; those of weight 0 do not count. placed : (a,) anchors that may be moved.
    """
    positions, anchors = tag_positions(edges, graph.poses), graph.anchors.copy()
    alive = np.ones(len(edges), dtype=bool) if edges.weights is None else edges.weights > 0
    for anchor in np.flatnonzero(placed):
        own = np.flatnonzero(alive & (edges.anchor == anchor))
        level = np.sqrt(np.maximum(edges.ranges[own] ** 2 - edges.height[own] ** 2, 1e-4))
        found = locate(positions[own], level, search, _TRUSTED)
        if not found:
            continue
        here, there = (
            agreement(positions[own], edges.ranges[own], place, edges.height[own])
            for place in (anchors[anchor], found[0].position)
        )
        if there > here + _CLEARLY:
            anchors[anchor] = found[0].position
    return replace(graph, anchors=anchors)


_TRUSTED = 0.15
"""Error of a path that the lidar holds, m."""
_CLEARLY = 0.1
"""Share of its ranges that must agree more with another place before an anchor is moved there."""


def learn_noise(
    edges: RangeEdges, graph: Graph, anchors: int, config: RangeNoiseConfig, steady: bool = False
) -> tuple[RangeEdges, tuple[RangeNoise, ...]]:
    """Give every range the standard deviation that its anchor's residuals show, and a weight that counts slow errors once.

    The weight is no part of sigma: whether a range is an outlier is judged by what one range scatters.

    Parameters
    ----------
    graph : estimates the residuals are taken at.
    anchors : how many there are.
    steady : count errors that depend on direction and distance alone once as well, see range_noise.steady_sigma: right
        where the lidar holds the poses. Without it such errors hardly matter for the poses, since the anchors' places
        absorb them; what matters then is that all ranges together hold the trajectory.
    """
    positions, sigma, weights = tag_positions(edges, graph.poses), edges.sigma.copy(), np.zeros(len(edges))
    errors = edges.residuals(graph)[:, 0] * edges.sigma
    alive = np.ones(len(edges), dtype=bool) if edges.weights is None else edges.weights > 0
    noises = []
    for anchor in range(anchors):
        own = np.flatnonzero(alive & (edges.anchor == anchor))
        noise = assumed(config)
        trust = np.ones(len(own))
        if config.learn and len(own) >= 5:
            mixture = nlos_mixture.fit(-errors[own], config.min_sigma)
            trust = np.maximum(mixture.weights(-errors[own]), 1e-6)
            noise = learn(positions[own], errors[own], mixture.core(-errors[own]), config)
        sigma[own] = max(noise.sigma, 1e-6)
        effective = np.hypot(
            effective_sigma(positions[own], noise, trust),
            steady_sigma(positions[own] - graph.anchors[anchor], config, trust) if steady else 0.0,
        )
        weights[own] = trust * (sigma[own] / effective) ** 2
        noises.append(noise)
    return replace(edges, sigma=sigma, weights=weights), tuple(noises)


def learn_wheels(wheels: OdometryEdges, steps: RelativePoseEdges, graph: Graph) -> OdometryEdges:
    """Scale the wheels' noise along, across and in heading so that it explains how far they lie from measured steps.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    steps : steps between neighbouring poses that the lidar measured. Directions that a step does not see do not count;
        where fewer than 20 steps see one, its noise stays.
    graph : holds the wheels' calibration.
    """
    if len(steps) < _ENOUGH_STEPS:
        return wheels
    own = np.searchsorted(wheels.i, steps.i)
    off = se2.between(steps.T_i_j, wheels.corrected(graph)[own]) / wheels.own_scale(graph)[own]
    off = np.abs(np.einsum("eij,ej->ei", wheels.sqrt_information[own], off))
    information = np.swapaxes(steps.sqrt_information, 1, 2) @ steps.sqrt_information
    onto = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ information
    seen = np.einsum("eii->ei", onto) > 0.9
    factor = np.ones(3)
    for k in np.flatnonzero(seen.sum(axis=0) >= _ENOUGH_STEPS):
        factor[k] = np.clip(1.4826 * np.median(off[seen[:, k], k]), 0.3, 10.0)
    return replace(wheels, sqrt_information=wheels.sqrt_information / factor)


_ENOUGH_STEPS = 20
"""Measured steps from which the noise of the wheels may be learnt."""
