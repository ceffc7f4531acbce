"""Free space seen from some places, and points that contradict it.

Seen from one place, the space is free in every direction as far as the nearest surface. A point of another cloud, put into the
map by a hypothetical pose, contradicts that where it lies well in front of this surface; a point behind the surface was hidden
and gives no information.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Extent of the free space around v places, by bearing."""

    poses: Floats
    """(v, 3) of the places in the cloud's frame; m, m, rad."""
    ranges: Floats
    """(v, b) m, distance up to which each of b equal parts of the circle was free, from -pi on; 0 where nothing is known."""


def free_space(poses: Floats, nearest: Floats) -> FreeSpace:
    """Make the free space of v places.

    Parameters
    ----------
    poses : (v, 3) T_cloud_base of each; m, m, rad.
    nearest : (v, b) m, distance of the nearest surface in each part of the circle, from -pi on; inf = none was seen, so that
        nothing is known: dark and oblique walls return nothing. A bearing is free only as far as its neighbours on either
        side, so that a ray that grazes a wall or an edge does not contradict it.
    """
    reach = np.where(np.isfinite(nearest), nearest, 0.0)
    free = reach.copy()
    free[:, 1:] = np.minimum(free[:, 1:], reach[:, :-1])
    free[:, :-1] = np.minimum(free[:, :-1], reach[:, 1:])
    return FreeSpace(poses, free)


def seen_beyond(free: FreeSpace, points: Floats, margin: float) -> tuple[Ints, Ints]:
    """Count for each point the places that saw beyond it, and those from which it was in view.

    Parameters
    ----------
    free : of a cloud. points : (m, 2) m, in its frame.
    margin : m; a point was seen beyond where the bearing was free for more than that behind it.

    Returns
    -------
    through (m,), in_view (m,) : the latter within the seen free space or up to margin behind it.
    """
    back, parts = se2.inverse(free.poses)[:, :, None], free.ranges.shape[1]
    (c, s), (px, py) = se2.cos_sin(back[:, 2]), np.ascontiguousarray(points.T)
    x, y = c * px - s * py + back[:, 0], s * px + c * py + back[:, 1]
    distance = np.sqrt(x * x + y * y)
    bins = ((np.arctan2(y, x) + np.pi) * (parts / (2.0 * np.pi))).astype(np.intp)
    bins *= bins < parts  # Straight behind is one direction; a remainder takes longer.
    until = free.ranges.take(bins + parts * np.arange(len(free.poses))[:, None])
    reach = until > 0.0
    return (distance < until - margin).sum(axis=0), (reach & (distance < until + margin)).sum(axis=0)


def contradiction(free: FreeSpace, points: Floats, margin: float) -> tuple[float, float]:
    """Return the share of points (m, 2) in view that lie in observed free space, and the share that was in view, 0..1.

    The first is 0 where none was in view; see seen_beyond.
    """
    if len(points) == 0 or len(free.poses) == 0:
        return 0.0, 0.0
    through, in_view = seen_beyond(free, points, margin)
    seen = in_view > 0
    return float(np.sum((through > 0) & seen) / max(int(seen.sum()), 1)), float(seen.mean())
