"""Following the robot from cloud to cloud, where the wheels' word is not good enough to start matching from.

Neighbouring clouds are aligned from the wheels' guess. A pair that then shares few points got a bad guess (slip, a
sharp turn between sparse scans): a correlative search around it finds the place.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..wheels import learn_wheels
from .clouds import Clouds
from .correlative_matching import CorrelativeConfig, search
from .pair_alignment import align_pairs
from .point_cloud import make_cloud
from .scan_matching import CloudRasters, match, measured, pair_points


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """When and where neighbouring clouds are searched for."""

    on: bool = True
    """Match each cloud with those before and after it; off = only wheels and radio shape the sub-maps (the paper)."""
    good_share: ClassVar[float] = 0.75
    """Neighbours that share at least this part of their points need no search."""
    gain: ClassVar[float] = 0.08
    """A search must raise the share by this to be believed."""
    distance: float = 0.4
    """Half-width of the search, m."""
    angle: float = 0.45
    """Half-width of the search, rad."""
    least_share: ClassVar[float] = 0.4
    """A step whose clouds share a smaller part is left to the wheels."""
    gate: ClassVar[float] = 0.15
    """Farthest match at the end, m."""
    points: ClassVar[int] = 150
    """Points looked up per step."""
    min_points: ClassVar[int] = 30
    """Clouds with fewer points with a normal measure nothing."""
    sigma: ClassVar[float] = 0.03
    """Standard deviation of a match, m."""
    correlation: ClassVar[float] = 8.0
    """Matches that together weigh as one."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanOdometry:
    """Steps between neighbouring keyframes."""

    steps: RelativePoseEdges
    """Those that were measured."""
    wheels: OdometryEdges
    """With the noise that the measured steps show."""
    miss: float
    """By how much the wheels typically misplace points of the next cloud, 3 sigma, m."""
    searched: int
    """Steps that were searched for."""


def follow(
    clouds: Clouds, raster: CloudRasters, wheels: OdometryEdges, graph: Graph, gate: float, config: TrackingConfig,
    search_config: CorrelativeConfig,
) -> ScanOdometry:
    """Measure every step between neighbouring keyframes by their clouds, searching where the guess may have been bad.

    Parameters
    ----------
    clouds, raster : see clouds.build and pair_matching.paint.
    wheels : edges between neighbouring keyframes. graph : poses by wheels and radio, the guess.
    gate : reach of the raster, m.

    """
    i, tight = wheels.i, min(config.gate, gate)
    points = pair_points(clouds, i + 1, config.points)
    aligned = align_pairs(clouds, raster, i, i + 1, se2.between(graph.poses[i], graph.poses[i + 1]), points, gate, tight)
    enough = aligned.factors.asked >= config.min_points
    share, step = aligned.share.copy(), aligned.pose.copy()
    good = enough & (share >= config.good_share)
    learnt = learn_wheels(wheels, _edges(clouds, raster, i[good], step[good], tight, config), graph)
    miss = _miss(clouds, learnt)
    rows = np.flatnonzero(enough & ~good & (miss > 0.7 * gate))
    for row in rows:
        found = _search_step(clouds, raster, int(i[row]), step[row], gate, config, search_config)
        if found is not None and found[1] > share[row] + config.gain:
            step[row], share[row] = found
    kept = enough & (share >= config.least_share)
    steps = _edges(clouds, raster, i[kept], step[kept], tight, config)
    learnt = learn_wheels(wheels, steps, graph)
    return ScanOdometry(steps, learnt, float(np.median(miss)) if len(miss) else 0.0, len(rows))


def _miss(clouds: Clouds, wheels: OdometryEdges) -> Floats:
    """Return by how much the wheels may misplace points of the next cloud (e,), 3 sigma, m."""
    sigma = 1.0 / np.einsum("eii->ei", wheels.sqrt_information)
    reach = np.hypot(clouds.points[:, 0], clouds.points[:, 1])
    arm = float(np.quantile(reach, 0.75)) if len(reach) else 0.0
    return 3.0 * (sigma[:, 0] + sigma[:, 2] * arm)


def _edges(
    clouds: Clouds, raster: CloudRasters, i: Ints, step: Floats, gate: float, config: TrackingConfig
) -> RelativePoseEdges:
    """Return the steps (e, 3) from keyframes i to i + 1 as edges with the information of their matches."""
    factors = match(clouds, raster, i, step, pair_points(clouds, i + 1, config.points), gate, gate / 2.0)
    z, sqrt_information = measured(factors, step, np.full(len(i), config.sigma**2 * config.correlation))
    return RelativePoseEdges(i, i + 1, z, sqrt_information)


def _search_step(
    clouds: Clouds, raster: CloudRasters, i: int, guess: Floats, gate: float, config: TrackingConfig,
    search_config: CorrelativeConfig,
) -> tuple[Floats, float] | None:
    """Return the best pose of cloud i + 1 in cloud i and the share of points that match there."""
    target, source = (make_cloud(p, p + n) for p, n in (clouds.cloud(i), clouds.cloud(i + 1)))
    places = search(target, source, guess, (config.distance, config.distance, config.angle), search_config)
    if not len(places.poses):
        return None
    one = np.full(len(places.poses), i)
    points = pair_points(clouds, one + 1, config.points)
    aligned = align_pairs(clouds, raster, one, one + 1, places.poses, points, min(0.3, gate), min(config.gate, gate))
    best = int(np.argmax(aligned.share))
    return aligned.pose[best], float(aligned.share[best])
