"""Laser scans as rays in the map frame, each ray from where the laser was at its own time."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import se2
from .sensor_log import LaserScans

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class ScanRays:
    """Rays of some scans."""

    origins: Floats
    """(r, 2) m, map frame."""
    endpoints: Floats
    """(r, 2) m, map frame."""
    hit: Bools
    """(r,) something is at the endpoint; otherwise the ray only clears."""
    scan: Ints
    """(r,) index of the scan, in the order given."""


def moved_scans(poses: Floats, distance: float, angle: float) -> Ints:
    """Choose scans such that between neighbours the laser moved or turned far enough; the first is always in.

    Parameters
    ----------
    poses : (k, 3) T_map_laser of each scan.
    distance : m; 0 chooses every scan.
    angle : rad.

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
    return np.array(chosen, dtype=np.int64)


def scan_rays(
    scans: LaserScans,
    chosen: Ints,
    first: Floats,
    last: Floats | None = None,
    *,
    flipped: bool = False,
    max_range: float = math.inf,
    max_clear_distance: float = 0.0,
    clear_run: int = 1,
) -> ScanRays:
    """Return the rays of some scans: all readings up to max_range, and runs of beams that saw nothing.

    Parameters
    ----------
    chosen : (s,) indices of scans.
    first : (s, 3) T_map_laser at the first ray of each chosen scan.
    last : (s, 3) T_map_laser at the last ray; in between the laser moves evenly. None = it stood still.
    flipped : the laser is mounted upside down; its rays run clockwise.
    max_range : longer readings are left out, m.
    max_clear_distance : length of rays of beams that saw nothing, m; 0 = there are none.
    clear_run : least number of adjacent beams that saw nothing.
    """
    readings = scans.ranges[chosen]
    hit = (readings >= scans.range_min) & (readings <= min(max_range, scans.range_max))
    used = hit.copy()
    if max_clear_distance > 0.0:
        used |= in_runs(np.isposinf(readings), clear_run)
    scan, ray = np.nonzero(used)
    hit = hit[scan, ray]
    reach = np.where(hit, readings[scan, ray], np.float32(min(max_clear_distance, scans.range_max)))
    bearing = (-scans.angles if flipped else scans.angles)[ray]
    moved = np.zeros_like(first) if last is None else last - first
    moved[:, 2] = se2.wrap_angle(moved[:, 2])
    fraction = ray * (1.0 / max(scans.ranges.shape[1] - 1, 1))
    x, y, theta = (first[:, axis][scan] + moved[:, axis][scan] * fraction for axis in range(3))
    # Single precision turns a ray by 5e-7 rad at most, far below a cell, and its sines are several times faster.
    bearing = (bearing + theta).astype(np.float32)
    ends = np.stack([x + reach * np.cos(bearing), y + reach * np.sin(bearing)])
    return ScanRays(np.stack([x, y]).T, ends.T, hit, scan)


def in_runs(flags: Bools, least: int) -> Bools:
    """Tell which flags (s, b) stand in a run of at least `least` neighbours along the last axis that are all set."""
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
