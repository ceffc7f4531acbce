"""Motion from scan to scan, without wheels: it replaces the odometry where that has no reading.

Scans a moment apart are aligned point to line from a guess; where few points then match, a correlative search around it
finds the place.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, renumbered
from ..odometry.attached import ScanPoints
from ..sensor_log import LaserScans, SensorMounting
from . import cloud_rasters, clouds, scan_matching
from .cloud_rasters import CloudRasters
from .clouds import CloudConfig, Clouds, make_cloud
from .correlative_matching import CorrelativeConfig, search
from .overlap import directional_overlap
from .pair_alignment import align_pairs
from .scan_matching import PairPoints
from .visibility import nearest_by_bearing, pair_violations


@dataclass(frozen=True, slots=True)
class ScanStepPolicy:
    """Matching of single scans a moment apart."""

    first_gate: ClassVar[float] = 0.4
    """Farthest match in the first iteration, m."""
    last_gate: ClassVar[float] = 0.12
    """The same in the last, m."""
    points: ClassVar[int] = 200
    """Points looked up per pair."""
    good_share: ClassVar[float] = 0.75
    """Pairs that share at least this part of their points need no search."""
    gain: ClassVar[float] = 0.05
    """A search must raise the share by this to count."""
    search: ClassVar[tuple[float, float, float]] = (0.6, 0.6, 0.6)
    """Half-widths of the search, m, m, rad."""
    least_points: ClassVar[int] = 25
    """Clouds with fewer points measure nothing."""
    at_once: ClassVar[int] = 128
    """Pairs of scans whose rasters are in memory at once."""
    well_seen: ClassVar[float] = 0.9
    """Quantile of a scan's readings up to which it sees whatever is there."""
    least_in_sight: ClassVar[float] = 0.5
    """Share of the points that must be nearer."""


def scan_steps(
    scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, guess: Floats, searches: int = 0
) -> tuple[Floats, Floats]:
    """Measure the motion of the base between pairs of scans.

    Unobservable directions (along a bare corridor) keep the guess.

    Parameters
    ----------
    scans : with the mounting of their laser.
    first, second : (e,) scan numbers, so near in time that the two see the same. guess : (e, 3).
    searches : at most so many of the pairs that match worst are searched for around the guess, which takes long.

    Returns
    -------
    Motions T_first_second (e, 3) and the share of points that match (e,), 0..1; 0 where there are too few.
    """
    steps, shares = [np.zeros((0, 3))], [np.zeros(0)]
    for low in range(0, len(first), ScanStepPolicy.at_once):
        rows = slice(low, low + ScanStepPolicy.at_once)
        allowed = -(-searches * ScanStepPolicy.at_once // len(first))
        step, share = _block(scans, mounting, first[rows], second[rows], guess[rows], allowed)
        steps.append(step)
        shares.append(share)
    return np.concatenate(steps), np.concatenate(shares)


def misfits(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the mean square distance (e,), m^2, at which pairs of scans match at given motions T_first_second (e, 3).

    Points without a match count as one at the gate, unless the first scan could not see there: along a bare corridor, where
    readings end at the lidar's reach, those of two scans would otherwise match best if the robot stood.
    """
    built, raster, i, _, points = _pairs(scans, mounting, first, second)
    points = _in_sight(built, i, motion, points, scans, mounting)
    found = scan_matching.match(built, raster, i, motion, points, ScanStepPolicy.first_gate, ScanStepPolicy.first_gate)
    return (found.squared + ScanStepPolicy.first_gate**2 * (found.asked - found.matched)) / np.maximum(found.asked, 1)


def _in_sight(
    built: Clouds, i: Ints, motion: Floats, points: PairPoints, scans: LaserScans, mounting: SensorMounting
) -> PairPoints:
    """Return the points of pairs that the first scan looks at, and not from much farther than it sees; all where few are left.

    Parameters
    ----------
    i : (e,) clouds of the first scans. motion : (e, 3) T_first_second.
    """
    in_laser = se2.transform(se2.inverse(mounting.T_base_laser), built.points.astype(np.float64))
    away = np.hypot(in_laser[:, 0], in_laser[:, 1])
    ends = zip(built.offsets[:-1].tolist(), built.offsets[1:].tolist(), strict=True)
    reach = np.array([np.quantile(away[a:b], ScanStepPolicy.well_seen) if b > a else 0.0 for a, b in ends])
    T_laser_first = se2.compose(se2.inverse(mounting.T_base_laser), motion)[:, None]
    at = se2.transform(T_laser_first, built.points.astype(np.float64).take(points.row, axis=0))
    bearing = np.arctan2(at[..., 1], at[..., 0]) * (-1.0 if mounting.laser_flipped else 1.0)
    middle, half = 0.5 * (scans.angles[0] + scans.angles[-1]), 0.5 * abs(scans.angles[-1] - scans.angles[0])
    seen = (np.abs(se2.wrap_angle(bearing - middle)) <= half) & (np.hypot(at[..., 0], at[..., 1]) <= reach[i, None])
    seen &= points.row >= 0
    few = seen.sum(axis=1) < ScanStepPolicy.least_in_sight * (points.row >= 0).sum(axis=1)
    return PairPoints(np.where(seen | few[:, None], points.row, -1).astype(np.int32))


def directional_shares(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the share (e,) of two scans that matches at a motion (e, 3), in the direction with the fewest matches, 0..1.

    Along a corridor most rays of a scan match the next one best at zero motion: only the few surfaces that face
    along the corridor show the motion.
    """
    built, raster, i, j, _ = _pairs(scans, mounting, first, second)
    return directional_overlap(built, raster, i, j, motion, ScanStepPolicy.points, ScanStepPolicy.last_gate)


def in_free_space(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the share (e,) of either of two scans that stands in the free space of the other, for motions (e, 3), 0..1."""
    built, _, i, j, _ = _pairs(scans, mounting, first, second)
    nearest, pairs = nearest_by_bearing(built), zip(i.tolist(), j.tolist(), motion, strict=True)
    return np.array([pair_violations(built, nearest, a, b, step[None])[0] for a, b, step in pairs])


def _pairs(
    scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints
) -> tuple[Clouds, CloudRasters, Ints, Ints, PairPoints]:
    """Return the clouds of pairs of scans, their rasters, the two clouds of each pair (e,), and the points to be matched."""
    config = CloudConfig()
    chosen, i, j = renumbered(first, second)
    built = clouds.build(_points(scans, mounting, chosen, config.range_max), len(chosen), config)
    raster = cloud_rasters.rasterize(built, config.raster, ScanStepPolicy.first_gate)
    points = scan_matching.pair_points(built, j, ScanStepPolicy.points)
    return built, raster, i, j, points


def _block(
    scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, guess: Floats, searches: int
) -> tuple[Floats, Floats]:
    built, raster, i, j, points = _pairs(scans, mounting, first, second)
    aligned = align_pairs(built, raster, i, guess, points, ScanStepPolicy.first_gate, ScanStepPolicy.last_gate)
    enough = aligned.factors.asked >= ScanStepPolicy.least_points
    pose, share = aligned.pose.copy(), np.where(enough, aligned.share, 0.0)
    poor = np.flatnonzero((share < ScanStepPolicy.good_share) & enough)
    for row in poor[np.argsort(share[poor], kind="stable")][:searches].tolist():
        found = _searched(built, raster, int(i[row]), int(j[row]), guess[row])
        if found is not None and found[1] > share[row] + ScanStepPolicy.gain:
            pose[row], share[row] = found
    return pose, share


def _searched(built: Clouds, raster: CloudRasters, i: int, j: int, guess: Floats) -> tuple[Floats, float] | None:
    """Return the best pose of cloud j in cloud i and the share of points that match there."""
    target, source = (make_cloud(p, p + n) for p, n in (built.cloud(i), built.cloud(j)))
    places = search(target, source, guess, ScanStepPolicy.search, CorrelativeConfig())
    if not len(places.poses):
        return None
    one = np.ones(len(places.poses), dtype=np.intp)
    points = scan_matching.pair_points(built, one * j, ScanStepPolicy.points)
    aligned = align_pairs(built, raster, one * i, places.poses, points, 0.3, ScanStepPolicy.last_gate)
    best = int(np.argmax(aligned.share))
    return aligned.pose[best], float(aligned.share[best])


def _points(scans: LaserScans, mounting: SensorMounting, chosen: Ints, range_max: float) -> ScanPoints:
    """Return the rays of the chosen scans as points in the frame of the base, each scan as a snapshot."""
    readings = scans.ranges[chosen]
    scan, ray = np.nonzero(scans.hits(readings, range_max))
    sign = -1.0 if mounting.laser_flipped else 1.0
    reach = readings[scan, ray].astype(np.float64)
    bearing = sign * scans.angles[ray]
    in_laser = reach[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    points = se2.transform(mounting.T_base_laser, in_laser)
    origins = np.broadcast_to(mounting.T_base_laser[:2], points.shape)
    return ScanPoints(scan.astype(np.intp), points, origins, ray.astype(np.intp), chosen[scan])
