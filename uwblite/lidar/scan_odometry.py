"""Motion from scan to scan, without wheels: it replaces the odometry where that has no reading.

Scans a moment apart are aligned point to line from a guess; where few points then match, a correlative search around it
finds the place.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, chunks, renumbered
from ..odometry.attached import ScanPoints
from ..sensor_log import LaserScans, SensorMounting
from . import clouds, scan_matching
from .cloud_rasters import CloudRasters, rasterize
from .clouds import CLOUDS_AT_ONCE, CloudConfig, Clouds
from .correlative_matching import search
from .scan_matching import CloudPairs, PairPolicy, align_pairs, measured_part, pairs_of
from .visibility import directional_overlap, free_around, violates_free_space


class ScanStepPolicy:
    """Matching of single scans a moment apart."""

    reach: float = 0.4
    """Farthest match at the beginning of a descent, m; a point without one counts as one there."""
    gate: float = 0.12
    """The same at its end: single scans are thinner than clouds of keyframes, and more often match what they do not show."""
    search: float = 0.6
    """Half-width of the search, m and rad."""
    well_seen: float = 0.9
    """Quantile of a scan's readings up to which it sees whatever is there."""
    least_in_sight: float = 0.5
    """Share of the points that must be nearer."""


def scan_steps(
    scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, guess: Floats, searches: int = 0
) -> tuple[Floats, Floats, Floats]:
    """Measure the motion of the base between pairs of scans.

    Unobservable directions (along a bare corridor) keep the guess.

    Parameters
    ----------
    first, second : (e,) scan numbers, so near in time that the two see the same. guess : (e, 3).
    searches : at most so many of the pairs that match worst are searched for around the guess, which takes long.

    Returns
    -------
    Motions T_first_second (e, 3), the share of points that match (e,), 0..1; 0 where there are too few; and the information
    (e, 3, 3) that a descent from the guess gives about the motion, unscaled by noise, none in directions that nothing measures.
    """
    steps, shares, information = [np.zeros_like(guess[:0])], [np.zeros(0)], [np.zeros((0, *2 * se2.POSE))]
    for rows in chunks(len(first), CLOUDS_AT_ONCE):
        raster, pairs = _pairs(*_clouds(scans, mounting, first[rows], second[rows]))
        aligned = align_pairs(raster, pairs, guess[rows], ScanStepPolicy.reach, ScanStepPolicy.gate)
        enough = aligned.factors.asked >= PairPolicy.fewest
        pose, share = aligned.pose, np.where(enough, aligned.share, 0.0)
        poor = np.flatnonzero((share < PairPolicy.good_share) & enough)
        allowed = -(-searches * CLOUDS_AT_ONCE // len(first))
        for row in poor[np.argsort(share[poor], kind="stable")][:allowed].tolist():
            found = _searched(raster, pairs.rows(slice(row, row + 1)), guess[rows.start + row])
            if found[1] > share[row]:
                pose[row], share[row] = found
        steps.append(pose)
        shares.append(share)
        information.append(measured_part(*aligned.factors.quadratic)[0])
    return np.concatenate(steps), np.concatenate(shares), np.concatenate(information)


def misfits(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the mean square distance (e,), m^2, at which pairs of scans match at given motions T_first_second (e, 3).

    Points without a match count as one at the gate, unless the first scan could not see there, as along a bare corridor.
    """
    raster, pairs = _pairs(*_clouds(scans, mounting, first, second))
    pairs = _in_sight(raster.clouds, pairs, motion, scans, mounting)
    gate = ScanStepPolicy.reach
    found = scan_matching.match(raster, pairs, motion, gate, gate)
    return (found.squared + gate**2 * (found.asked - found.matched)) / np.maximum(found.asked, 1)


def _in_sight(built: Clouds, pairs: CloudPairs, motion: Floats, scans: LaserScans, mounting: SensorMounting) -> CloudPairs:
    """Return pairs with the points that the first scan looks at, not from much farther than it sees; all where few are left."""
    points, T_laser_base = built.points.astype(np.float64), se2.inverse(mounting.T_base_laser)
    away = np.split(np.hypot(*se2.transform(T_laser_base, points).T), built.offsets[1:-1])
    reach = np.array([np.quantile(own, ScanStepPolicy.well_seen) if len(own) else 0.0 for own in away])
    at = se2.transform(se2.compose(T_laser_base, motion)[:, None], points.take(pairs.points, axis=0))
    bearing = se2.bearing(at) * (-1.0 if mounting.laser_flipped else 1.0)
    middle, half = 0.5 * (scans.angles[0] + scans.angles[-1]), 0.5 * abs(scans.angles[-1] - scans.angles[0])
    seen = (np.abs(se2.wrap_angle(bearing - middle)) <= half) & (np.hypot(at[..., 0], at[..., 1]) <= reach[pairs.i, None])
    few = (seen & pairs.asked).sum(axis=1) < ScanStepPolicy.least_in_sight * pairs.asked.sum(axis=1)
    return replace(pairs, points=np.where(seen | few[:, None], pairs.points, -1))


def directional_shares(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the share (e,) of two scans that matches at a motion (e, 3), in the direction with the fewest matches, 0..1."""
    built, i, j = _clouds(scans, mounting, first, second)
    raster = rasterize(built, CloudConfig.raster, ScanStepPolicy.reach)
    return directional_overlap(raster, i, j, motion, ScanStepPolicy.gate)


def in_free_space(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints, motion: Floats) -> Floats:
    """Return the share (e,) of either of two scans that stands in the free space of the other, for motions (e, 3), 0..1."""
    built, i, j = _clouds(scans, mounting, first, second)
    free, seen = free_around(built), [built.cloud(k)[0] for k in range(len(built))]
    steps = zip(i.tolist(), j.tolist(), motion, strict=True)
    return np.array([violates_free_space(free[a], seen[a], free[b], seen[b], step) for a, b, step in steps])


def _clouds(scans: LaserScans, mounting: SensorMounting, first: Ints, second: Ints) -> tuple[Clouds, Ints, Ints]:
    """Return the clouds of pairs of scans, and the targets and sources (e,) of the pairs among them."""
    config = CloudConfig()
    chosen, i, j = renumbered(first, second)
    return clouds.build(_points(scans, mounting, chosen, config.range_max), len(chosen), config), i, j


def _pairs(built: Clouds, i: Ints, j: Ints) -> tuple[CloudRasters, CloudPairs]:
    """Return the rasters of the targets, and the pairs of clouds (e)."""
    return rasterize(built, CloudConfig.raster, ScanStepPolicy.reach, i), pairs_of(built, i, j)


def _searched(raster: CloudRasters, pair: CloudPairs, guess: Floats) -> tuple[Floats, float]:
    """Return the best pose (3,) of the source of one pair around a guess, and the share of points that match there."""
    target, source = (raster.clouds.chosen(of) for of in (pair.i, pair.j))
    half = ScanStepPolicy.search
    places = search(target, source, guess, (half, half, half))
    if not len(places):
        return guess, 0.0
    pairs = pair.rows(np.zeros(len(places), dtype=np.intp))
    aligned = align_pairs(raster, pairs, places, ScanStepPolicy.reach, ScanStepPolicy.gate)
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
