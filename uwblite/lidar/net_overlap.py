"""How much surface two clouds show in common, in the direction in which they show least, less what contradicts it.

Two stretches of a recording that meet share only a part of their surfaces: what share of all points matches says how long
they run together, not whether the place is right. Points that the other cloud cannot have seen say nothing; each that
matches speaks for the place, each in view without a match against it. In corridors walls match anywhere, so that only the
direction counts in which least speaks for the place: with the normals n of matches and of misses in view, it is the smaller
eigenvalue of sum n n^T over the matches - c sum n n^T over the misses, times the length of surface for which a point stands.
"""

from collections.abc import Sequence

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .free_space import FreeSpace, seen_beyond
from .scan_matching import Correspondences, correspondences, pair_points

_AGAINST = 2.0
"""Matches that one miss in view outweighs, by the ratio of likelihoods: in the true place five of six points match, in a wrong
one that looks alike half of them; log((1/2) / (1/6)) / log((5/6) / (1/2)) = 2.2."""
_MARGIN = 0.3
"""How far behind the farthest seen free space a point counts as in view, m."""


def net_overlap(
    clouds: Clouds, raster: CloudRasters, free: Sequence[FreeSpace] | None, i: Ints, j: Ints, T_i_j: Floats, limit: int,
    gate: float, spacing: float,
) -> Floats:
    """Return the net surface (e,), m, that speaks for clouds i and j (e,) lying at poses (e, 3), counted both ways.

    Parameters
    ----------
    free : what each cloud saw to be free; None = not asked, all points count as in view.
    limit : most points looked up per cloud. gate : farthest match, m.
    spacing : distance between neighbouring points of a cloud, m.
    """
    forth = _net(clouds, raster, free, i, j, T_i_j, limit, gate)
    back = _net(clouds, raster, free, j, i, se2.inverse(T_i_j), limit, gate)
    turn = se2.rotation(T_i_j[:, 2])[:, :2, :2]
    both = forth + turn @ back @ np.swapaxes(turn, 1, 2)
    return np.asarray(spacing * np.linalg.eigvalsh(both)[:, 0])


def _net(
    clouds: Clouds, raster: CloudRasters, free: Sequence[FreeSpace] | None, i: Ints, j: Ints, T_i_j: Floats, limit: int,
    gate: float,
) -> Floats:
    """Return the sums (e, 2, 2), in the frames of i, over the points of clouds j looked up in clouds i."""
    net = np.zeros((len(i), 2, 2))
    for found in correspondences(clouds, raster, i, T_i_j, pair_points(clouds, j, limit), gate):
        normals = se2.rotate(T_i_j[found.pairs, 2, None], clouds.normals[found.row])
        missed = (found.row >= 0) & ~found.good
        if free is not None:
            missed &= _in_view(clouds, free, i[found.pairs], T_i_j[found.pairs], found)
        weight = found.good - _AGAINST * missed
        asked = np.maximum((found.row >= 0).sum(axis=1), 1)
        weight *= (clouds.counts[j[found.pairs]] / asked)[:, None]
        net[found.pairs] = np.einsum("en,enk,enl->ekl", weight, normals, normals)
    return net


def _in_view(clouds: Clouds, free: Sequence[FreeSpace], i: Ints, T_i_j: Floats, found: Correspondences) -> Bools:
    """Return which points (e, n) were in view from the places at which clouds i (e,) were seen."""
    points = se2.transform(T_i_j[:, None, :], clouds.points[found.row])
    return np.array([seen_beyond(free[k], p, _MARGIN)[1] > 0 for k, p in zip(i.tolist(), points, strict=True)], dtype=bool)
