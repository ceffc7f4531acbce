"""Laser scans as rays in the map frame, each ray from the pose of the laser at its own time (deskewed)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..sensor_log import LaserScans


@dataclass(frozen=True, slots=True, eq=False)
class ScanRays:
    """Rays of some scans."""

    origins: Floats
    """(r, 2) m, map frame."""
    endpoints: Floats
    """(r, 2) m, map frame."""
    scan: Ints
    """(r,) index of the scan, in the order given."""


def moved_scans(poses: Floats, distance: float, angle: float) -> Ints:
    """Choose scans such that between neighbours the laser moved or turned far enough; the first is always in.

    Parameters
    ----------
    poses : (k, 3) T_map_laser of each scan.
    distance : m; 0 chooses every scan.

    Returns
    -------
    (s,) indices.
    """
    if distance <= 0.0 or len(poses) == 0:
        return np.arange(len(poses))
    chosen = [0]
    x0, y0, theta0 = poses[0].tolist()
    for index, (x, y, theta) in enumerate(poses.tolist()):
        turned = abs(math.remainder(theta - theta0, 2.0 * math.pi))
        if (x - x0) ** 2 + (y - y0) ** 2 >= distance * distance or turned >= angle:
            chosen.append(index)
            x0, y0, theta0 = x, y, theta
    return np.array(chosen, dtype=np.intp)


def seen_reach(scans: LaserScans, chosen: Ints, max_range: float = math.inf) -> NDArray[np.float32]:
    """Return the length (s, b) of the rays of chosen scans (s,) that ended at something up to max_range, m; 0 = none."""
    readings = scans.ranges[chosen]
    return np.where(scans.hits(readings, max_range), readings, np.float32(0.0))


def empty_reach(scans: LaserScans, chosen: Ints, distance: float, run: int) -> NDArray[np.float32]:
    """Return `distance` (s, b), m, for beams of chosen scans that saw nothing, in runs of at least `run`; 0 = others."""
    reach = np.float32(min(distance, scans.range_max))
    return np.where(in_runs(np.isposinf(scans.ranges[chosen]), run), reach, np.float32(0.0))


def scan_rays(
    scans: LaserScans, reach: NDArray[np.float32], first: Floats, last: Floats | None = None, *, flipped: bool = False
) -> ScanRays:
    """Return the rays of some scans.

    Parameters
    ----------
    reach : (s, b) length of the rays of each scan, m; where it is 0 there is no ray.
    first : (s, 3) T_map_laser at the first ray of each scan.
    last : (s, 3) T_map_laser at the last ray; in between the laser moves evenly. None = it stood still.
    flipped : the laser is mounted upside down; its rays run clockwise.
    """
    rows = np.flatnonzero(reach > 0)
    beams = reach.shape[1]
    moved = np.zeros_like(first) if last is None else last - first
    moved[:, 2] = se2.wrap_angle(moved[:, 2])
    fraction = np.arange(beams) * (1.0 / max(beams - 1, 1))
    bearing = (first[:, 2:] + (-scans.angles if flipped else scans.angles)) + moved[:, 2:] * fraction
    # Single precision turns a ray by 5e-7 rad at most, far below a cell, and its sines are several times faster.
    bearing, length = bearing.astype(np.float32).take(rows), reach.take(rows)
    origins, ends = np.empty((2, 2, len(rows)))
    for axis, direction in enumerate((np.cos(bearing), np.sin(bearing))):
        origins[axis] = (first[:, axis, None] + moved[:, axis, None] * fraction).take(rows)
        ends[axis] = origins[axis] + length * direction
    return ScanRays(origins.T, ends.T, np.repeat(np.arange(len(reach)), np.count_nonzero(reach > 0, axis=1)))


def extent(
    scans: LaserScans, reach: NDArray[np.float32], first: Floats, last: Floats | None = None, *, flipped: bool = False
) -> tuple[Floats, Floats]:
    """Return the corners (2,) of a box that holds all rays of some scans (see scan_rays), quickly and hardly too large."""
    low, high = first[:, :2].min(axis=0), first[:, :2].max(axis=0)
    angles = -scans.angles if flipped else scans.angles
    ahead, aside = reach * np.cos(angles).astype(np.float32), reach * np.sin(angles).astype(np.float32)
    c, s = (v[:, None].astype(np.float32) for v in se2.cos_sin(first[:, 2]))
    slack = np.zeros(len(first)) if last is None else _sweep_reach(first, last, reach.max(axis=1))
    for axis, offset in enumerate((c * ahead - s * aside, s * ahead + c * aside)):
        low[axis] = min(low[axis], (first[:, axis] + offset.min(axis=1) - slack).min())
        high[axis] = max(high[axis], (first[:, axis] + offset.max(axis=1) + slack).max())
    return low - 1e-4, high + 1e-4


def _sweep_reach(first: Floats, last: Floats, reach: NDArray[np.float32]) -> Floats:
    """Return how far (s,) the motion within a scan can move the end of a ray, m."""
    moved = np.abs(last - first)
    return np.hypot(moved[:, 0], moved[:, 1]) + np.abs(se2.wrap_angle(moved[:, 2])) * reach


def in_runs(flags: Bools, least: int) -> Bools:
    """Return which flags (s, b) stand in a run of at least `least` neighbours along the last axis that are all set."""
    if least <= 1:
        return flags
    if flags.shape[1] < least:
        return np.zeros_like(flags)
    total = np.cumsum(np.pad(flags, ((0, 0), (1, 0))), axis=1, dtype=np.int32)
    begins = total[:, least:] - total[:, :-least] == least
    # A flag is in a run when one of the last `least` positions begins one.
    count = np.cumsum(np.pad(begins, ((0, 0), (1, least - 1))), axis=1, dtype=np.int32)
    before = np.pad(count, ((0, 0), (least, 0)))[:, : count.shape[1]]
    return (count - before)[:, 1:] > 0
