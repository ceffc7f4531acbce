"""From keyframes to edges: what the wheels and the radio say, with the noise that makes them commensurate."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import se2
from .anchors import AnchorConfig, usable
from .calibration import odometry_indices, range_indices
from .graph import Calibration, Graph, OdometryEdges, RangeEdges, RelativePoseEdges
from .keyframes import AttachedRanges, Keyframes
from .range_noise import RangeNoise, RangeNoiseConfig, assumed, effective_sigma, learn
from .robust import Kernel
from .sensor_log import SensorMounting

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_STEPS = Kernel("cauchy", 5.0)
_RANGES = Kernel("cauchy", 2.5)


@dataclass(frozen=True, slots=True)
class OdometryNoiseConfig:
    """Random errors of the wheels; systematic ones are calibrated."""

    distance: float = 0.012
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
    """Return one edge per range; readings that cannot be distances get weight 0.

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
        usable(attached.ranges, search).astype(np.float64),
        attached.stamps,
    )


def tag_positions(edges: RangeEdges, poses: Floats) -> Floats:
    """Return where the tag was at each range (m, 2), map frame."""
    arm = edges.lever_arm + se2.rotate(edges.turn, edges.tag)
    return se2.transform(poses[edges.pose], arm)


def learn_noise(
    edges: RangeEdges, graph: Graph, anchors: int, config: RangeNoiseConfig
) -> tuple[RangeEdges, tuple[RangeNoise, ...]]:
    """Give every range the standard deviation that its anchor's residuals show, slow errors counted once.

    Parameters
    ----------
    graph : estimates the residuals are taken at.
    anchors : how many there are.
    """
    positions, sigma = tag_positions(edges, graph.poses), edges.sigma.copy()
    errors = edges.residuals(graph)[:, 0] * edges.sigma
    alive = np.ones(len(edges), dtype=bool) if edges.weights is None else edges.weights > 0
    noises = []
    for anchor in range(anchors):
        own = np.flatnonzero(alive & (edges.anchor == anchor))
        noise = assumed(config)
        if len(own) >= 5:
            off = np.abs(errors[own] - np.median(errors[own]))
            spread = max(1.4826 * float(np.median(off)), config.min_sigma)
            noise = learn(positions[own], errors[own], (off < 3.0 * spread).astype(np.float64), config)
        sigma[own] = effective_sigma(positions[own], noise)
        noises.append(noise)
    return replace(edges, sigma=sigma), tuple(noises)


def learn_wheels(wheels: OdometryEdges, steps: RelativePoseEdges, graph: Graph) -> OdometryEdges:
    """Scale the wheels' noise so that it explains how far they lie from steps that the lidar measured.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    steps : measured steps between neighbouring poses; with fewer than 20 the wheels keep their noise.
    graph : holds the wheels' calibration.
    """
    if len(steps) < 20:
        return wheels
    own = np.searchsorted(wheels.i, steps.i)
    off = se2.between(steps.T_i_j, wheels.corrected(graph)[own])
    off = np.abs(np.einsum("eij,ej->ei", wheels.sqrt_information[own], off))
    spread = 1.4826 * np.array([np.median(off[:, :2]), np.median(off[:, 2])])
    position, heading = np.clip(spread, 0.5, 10.0)
    return replace(wheels, sqrt_information=wheels.sqrt_information / np.array([position, position, heading])[:, None])
