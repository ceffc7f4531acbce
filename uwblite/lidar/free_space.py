"""Free space seen by a scan, and points that contradict it: would this pose see through a wall?

A scan from one place measures for every bearing how far it was free. A point of another scan, put into the map by a
hypothetical pose, contradicts it where it lies well short of that distance; where it lies beyond, it was hidden and
shows nothing.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """How far v scans saw nothing, by bearing."""

    poses: Floats
    """(v, 3) of the sensor in the cloud's frame; m, m, rad."""
    ranges: Floats
    """(v, b) m, distance up to which the bearing was free; 0 where nothing is known."""
    angle_min: float
    """Bearing of the first bin's centre in the sensor's frame, rad."""
    angle_increment: float
    """Between bins, rad."""


def free_space(
    poses: Floats, ranges: Floats, angle_min: float, angle_increment: float, beyond: float = 0.0, blur: int = 2
) -> FreeSpace:
    """Make the free space of v scans.

    Parameters
    ----------
    poses : (v, 3) T_cloud_laser of each scan; m, m, rad.
    ranges : (v, b) m, as LaserScans has them: +inf = nothing seen, nan = invalid.
    angle_min, angle_increment : rad, of the scans.
    beyond : m; a ray that saw nothing was free so far. 0: nothing is known (dark and oblique walls return nothing).
    blur : each bearing is free only as far as this many neighbours on either side, too; a ray grazing a wall or an
        edge must not contradict it.
    """
    ranges = np.asarray(ranges, dtype=np.float64)
    reach = np.where(np.isposinf(ranges), beyond, np.where(np.isfinite(ranges), ranges, 0.0))
    free = reach.copy()
    for k in range(1, blur + 1):
        free[:, k:] = np.minimum(free[:, k:], reach[:, :-k])
        free[:, :-k] = np.minimum(free[:, :-k], reach[:, k:])
    return FreeSpace(np.asarray(poses, dtype=np.float64).reshape(-1, 3), free, angle_min, angle_increment)


def seen_beyond(free: FreeSpace, points: Floats, margin: float) -> tuple[Ints, Ints]:
    """Count for each point the scans that looked through it, and those to which it was in view.

    Parameters
    ----------
    free : of a cloud. points : (m, 2) m, in its frame.
    margin : m; a scan looked through a point if the bearing was free for more than that beyond it.

    Returns
    -------
    through (m,), in_view (m,) : the latter within the seen free space or up to margin behind it.
    """
    local = se2.transform(se2.inverse(free.poses)[:, None, :], points[None, :, :])
    distance = np.hypot(local[..., 0], local[..., 1])
    bearing = se2.bearing(local)
    turns = np.remainder(bearing - free.angle_min + 0.5 * free.angle_increment, 2.0 * np.pi)
    bins = (turns / free.angle_increment).astype(np.int64)
    scan = np.arange(len(free.poses))[:, None]
    width = free.ranges.shape[1]
    until = np.where(bins < width, free.ranges[scan, np.minimum(bins, width - 1)], 0.0)
    reach = until > 0.0
    through, in_view = reach & (distance < until - margin), reach & (distance < until + margin)
    return through.sum(axis=0), in_view.sum(axis=0)


def contradiction(free: FreeSpace, points: Floats, margin: float, least: int = 1) -> tuple[float, float]:
    """Return what share of points lies where free space was seen.

    Parameters
    ----------
    free : of the other cloud. points : (m, 2) m, in that cloud's frame. margin : m, see looked_through.
    least : how many scans a point must contradict.

    Returns
    -------
    contradicting : share of the points in view that contradict, 0..1; 0 where none was.
    seen : share of the points that were in view, 0..1.
    """
    if len(points) == 0 or len(free.poses) == 0:
        return 0.0, 0.0
    through, in_view = seen_beyond(free, points, margin)
    seen = in_view > 0
    return float(np.sum((through >= least) & seen) / max(int(seen.sum()), 1)), float(seen.mean())
