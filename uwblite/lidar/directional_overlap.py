"""What share of two clouds matches in the direction in which fewest points do.

In corridors the walls match wherever one is laid along the other: of two places that look alike most points match, but
not the few surfaces that face along the corridor. With the normals n of the points looked up, A = sum n n^T over all of
them and M the same sum over those that match, the share that matches in a direction u is u^T M u / u^T A u; the least of
all directions is the smaller eigenvalue of M u = l A u.
"""

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .scan_matching import correspondences, pair_points

_NOISE = 0.005
"""Share of the points added to A in every direction: where fewer face, as along a bare wall, the noise of normals does."""


def directional_overlap(
    clouds: Clouds, raster: CloudRasters, i: Ints, j: Ints, T_i_j: Floats, limit: int, gate: float
) -> Floats:
    """Return the least share (e,) over all directions of clouds i and j (e,) that matches when laid at poses (e, 3).

    Parameters
    ----------
    limit : most points looked up per cloud. gate : farthest match, m.
    """
    asked, matched = _sums(clouds, raster, i, j, T_i_j, limit, gate)
    back = _sums(clouds, raster, j, i, se2.inverse(T_i_j), limit, gate)
    turn = se2.rotation(T_i_j[:, 2])[:, :2, :2]
    asked, matched = (a + turn @ b @ np.swapaxes(turn, 1, 2) for a, b in zip((asked, matched), back, strict=True))
    noise = _NOISE * np.trace(asked, axis1=1, axis2=2) + np.finfo(float).tiny
    root = np.linalg.inv(np.linalg.cholesky(asked + noise[:, None, None] * np.eye(2)))
    return np.asarray(np.linalg.eigvalsh(root @ matched @ np.swapaxes(root, 1, 2))[:, 0])


def _sums(
    clouds: Clouds, raster: CloudRasters, i: Ints, j: Ints, T_i_j: Floats, limit: int, gate: float
) -> tuple[Floats, Floats]:
    """Return A and M (e, 2, 2), in the frames of i, of the points of clouds j looked up in clouds i."""
    asked, matched = np.zeros((2, len(i), 2, 2))
    for found in correspondences(clouds, raster, i, T_i_j, pair_points(clouds, j, limit), gate):
        normals = se2.rotate(T_i_j[found.pairs, 2, None], clouds.normals[found.row])
        for sums, mask in ((asked, found.row >= 0), (matched, found.good)):
            sums[found.pairs] = np.einsum("en,enk,enl->ekl", mask.astype(np.float64), normals, normals)
    return asked, matched
