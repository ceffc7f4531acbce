"""Surface that two clouds have in common, in the direction in which it is least.

In corridors the walls match at any shift along them: of two similar places most points match, but not the few
surfaces that face along the corridor. So only the direction with the least matching surface counts: with the normals n of
points and weights w, a direction u has the sum u^T (sum w n n^T) u, and eigenvalues give the least of all directions.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .. import se2
from ..arrays import WIDE, Bools, Floats, Ints, Wides, chunks
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .scan_matching import CloudPairs, Correspondences, correspondences, pairs_of
from .visibility import FreeSpace, seen_beyond


@dataclass(frozen=True, slots=True)
class OverlapPolicy:
    """Surface that two clouds have in common."""

    noise: ClassVar[float] = 0.005
    """Share of the points added in every direction: fewer points that face it, as along a bare wall, are noise of normals."""
    against: ClassVar[float] = 2.0
    """Weight of a point in view without a match relative to one with a match, by the ratio of likelihoods: in the true
    place five of six points match, in a wrong one that looks the same half of them; log((1/2) / (1/6)) / log((5/6) /
    (1/2)) = 2.2."""
    points: ClassVar[int] = 1000
    """Most points of either cloud that are looked up."""
    surface_cell: ClassVar[float] = 0.5
    """Size of a surface cell, m: about what a cloud's normal is the same over in a room."""
    facings: ClassVar[int] = 8
    """Directions in which such a cell may face."""


Weights = Callable[[Correspondences, CloudPairs, Floats], Floats]
"""Gives the weights (e, n) of points of sources that were looked up in their targets at poses (e, 3)."""


def directional_overlap(raster: CloudRasters, i: Ints, j: Ints, T_i_j: Floats, gate: float) -> Floats:
    """Return the least share (e,) over all directions of clouds i and j (e,) that matches when laid at poses (e, 3).

    With A = sum n n^T over the points looked up and M the same sum over those that match, the share that matches in a
    direction u is u^T M u / u^T A u; the least of all is the smaller eigenvalue of M u = l A u. No match is beyond the gate, m.
    """
    asked, matched = _both_ways(
        raster, i, j, T_i_j, gate, lambda found, *_: (found.row >= 0).astype(float), lambda found, *_: found.good.astype(float)
    )
    noise = OverlapPolicy.noise * np.trace(asked, axis1=1, axis2=2) + np.finfo(float).tiny
    root = np.linalg.inv(np.linalg.cholesky(asked + noise[:, None, None] * np.eye(2)))
    return np.asarray(np.linalg.eigvalsh(root @ matched @ np.swapaxes(root, 1, 2))[:, 0])


def net_overlap(
    raster: CloudRasters, free: Sequence[FreeSpace] | None, i: Ints, j: Ints, T_i_j: Floats, gate: float
) -> Floats:
    """Return the net matching points (e,) of clouds i and j (e,) at relative poses (e, 3), counted both ways.

    Of two stretches of a recording, the share of all points that match shows how long they overlap, not whether the place is
    right. Each point with a match counts for the place, each in view without a match against it, and others do not count.

    Parameters
    ----------
    free : observed free space of each cloud; None = all points count as in view. gate : farthest match, m.
    """

    def weight(found: Correspondences, pairs: CloudPairs, T_i_j: Floats) -> Floats:
        missed = (found.row >= 0) & ~found.good
        if free is not None:
            missed &= _in_view(raster.clouds, free, pairs.i, T_i_j, found)
        # The points looked up stand for those left out.
        asked = np.maximum((found.row >= 0).sum(axis=1), 1)
        return np.asarray((found.good - OverlapPolicy.against * missed) * (raster.clouds.counts[pairs.j] / asked)[:, None])

    (both,) = _both_ways(raster, i, j, T_i_j, gate, weight)
    return np.asarray(np.linalg.eigvalsh(both)[:, 0])


def _both_ways(raster: CloudRasters, i: Ints, j: Ints, T_i_j: Floats, gate: float, *weights: Weights) -> Floats:
    """Return for each kind of weights the sums w n n^T (k, e, 2, 2), in the frames of i, over the points of both clouds."""

    def one_way(i: Ints, j: Ints, T_i_j: Floats) -> Floats:
        sums, pairs = np.zeros((len(weights), len(i), 2, 2)), pairs_of(raster.clouds, i, j, OverlapPolicy.points)
        for found in correspondences(raster, pairs, T_i_j, gate):
            some = found.pairs
            normals = se2.rotate(T_i_j[some, 2, None], raster.clouds.normals[found.row])
            for own, weight in zip(sums, weights, strict=True):
                own[some] = np.einsum("en,enk,enl->ekl", weight(found, pairs.rows(some), T_i_j[some]), normals, normals)
        return sums

    turn = se2.rotation(T_i_j[:, 2])[:, :2, :2]
    return np.asarray(one_way(i, j, T_i_j) + turn @ one_way(j, i, se2.inverse(T_i_j)) @ np.swapaxes(turn, 1, 2))


def _in_view(clouds: Clouds, free: Sequence[FreeSpace], i: Ints, T_i_j: Floats, found: Correspondences) -> Bools:
    """Return which points (e, n) were in view from the places at which clouds i (e,) were seen."""
    points = se2.transform(T_i_j[:, None, :], clouds.points[found.row])
    return np.array([seen_beyond(free[k], p)[1] > 0 for k, p in zip(i.tolist(), points, strict=True)], dtype=bool)


def surface_cells(clouds: Clouds, poses: Floats) -> sparse.csr_matrix:
    """Return which surface cells (columns) each cloud (rows) sees; a cell is a square of the map and one of some facings."""
    usable, many = np.flatnonzero(clouds.lines), OverlapPolicy.facings
    cell, facing = np.empty((len(usable), 2), dtype=np.int32), np.empty(len(usable), dtype=np.int8)
    for part in chunks(len(usable)):
        rows, owner = usable[part], clouds.owner[usable[part]]
        cell[part] = np.floor(se2.transform_each(poses, owner, clouds.points[rows]) / OverlapPolicy.surface_cell)
        bearing = se2.bearing(se2.rotate_each(poses[:, 2], owner, clouds.normals[rows]))
        facing[part] = np.floor(bearing * (many / (2.0 * np.pi)) + 0.5).astype(np.intp) % many
    cell -= cell.min(axis=0, initial=0)
    wide = int(cell[:, 1].max(initial=0)) + 1
    row, key = (np.concatenate(parts) for parts in zip(*_seen_cells(clouds.owner[usable], cell, facing, wide), strict=True))
    _, column = np.unique(key, return_inverse=True)
    shape = (len(clouds), int(column.max(initial=-1)) + 1)
    seen = sparse.csr_matrix((np.ones(len(column)), (row, column)), shape=shape)
    seen.data[:] = 1.0
    return seen


def _seen_cells(
    owner: NDArray[np.signedinteger], cell: NDArray[np.int32], facing: NDArray[np.int8], wide: int
) -> Iterator[tuple[Wides, Wides]]:
    """Yield clouds and numbers of the surface cells of points (p,), some points at a time, each pair once or a few times."""
    for part in chunks(max(len(owner), 1)):
        key = (cell[part, 0].astype(WIDE) * wide + cell[part, 1]) * OverlapPolicy.facings + facing[part]
        many = int(key.max(initial=0)) + 1
        yield np.divmod(np.unique(owner[part].astype(WIDE) * many + key), many)
