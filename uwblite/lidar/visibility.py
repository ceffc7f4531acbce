"""What two clouds show of each other: surface that they have in common, and surfaces of one in the free space of the other.

In corridors the walls match at any shift along them: of two similar places most points match, but not the few surfaces that
face along the corridor. So only the direction with the least matching surface counts: with the normals n of points and weights
w, a direction u has the sum u^T (sum w n n^T) u, and eigenvalues give the least of all directions.

Seen from one place, the space is free in every direction as far as the nearest surface. A point of another cloud well in front
of it contradicts their relative pose; one behind it was hidden. If the pose is right, people, glass and doors cause a few per
cent of such points, within one visit to a place as between two; if it is wrong, half of the surfaces do.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import WIDE, Bools, Floats, Ints, Wides, chunks, evenly
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .scan_matching import CloudPairs, Correspondences, correspondences, pairs_of
from .submaps import Submaps

if TYPE_CHECKING:
    from scipy import sparse


class OverlapPolicy:
    """Surface that two clouds have in common."""

    noise: float = 0.005
    """Share of the points added in every direction: fewer points that face it, as along a bare wall, are noise of normals."""
    against: float = 2.0
    """Weight of a point in view without a match relative to one with a match, by the ratio of likelihoods: in the true
    place five of six points match, in a wrong one that looks the same half of them; log((1/2) / (1/6)) / log((5/6) /
    (1/2)) = 2.2."""
    points: int = 1000
    """Most points of either cloud that are looked up."""
    surface_cell: float = 0.5
    """Size of a surface cell, m: about what a cloud's normal is the same over in a room."""
    facings: int = 8
    """Directions in which such a cell may face."""


class VisibilityPolicy:
    """Free space around clouds, and visits whose views are compared."""

    bearings: int = 120
    """Bins of the free space around a keyframe: so wide that the points of a wall 5 m away leave none empty."""
    margin: float = 0.3
    """How far inside the free space a point must stand to count, m."""
    views: int = 8
    """Keyframes of a sub-map whose free space is used."""
    revisit: float = 2.0
    """Keyframes nearer to each other than this are at one place, m."""
    apart: float = 10.0
    """Travelled distance between two visits, m."""
    revisits: int = 400
    """Most revisits that are compared."""
    common: int = 10
    """Points of the other that a visit must be able to see to be compared."""
    neighbours: int = 64
    """Keyframes around one among which another visit is sought."""
    usual: float = 0.9
    """Share of the pairs of sub-maps of which no more stands in the next one's free space than is said of all."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Extent of the free space around v places, by bearing."""

    poses: Floats
    """(v, 3) of the places in the cloud's frame; m, m, rad."""
    ranges: Floats
    """(v, b) m, distance up to which each of b equal parts of the circle was free, from -pi on; 0 where nothing is known."""


def free_space(poses: Floats, nearest: Floats) -> FreeSpace:
    """Make the free space of v places; a bearing is free only as far as its neighbours, because rays graze walls and edges.

    Parameters
    ----------
    poses : (v, 3) T_cloud_base of each; m, m, rad.
    nearest : (v, b) m, distance of the nearest surface in each part of the circle, from -pi on; inf = nothing is known.
    """
    reach = np.where(np.isfinite(nearest), nearest, 0.0)
    free = reach.copy()
    free[:, 1:] = np.minimum(free[:, 1:], reach[:, :-1])
    free[:, :-1] = np.minimum(free[:, :-1], reach[:, 1:])
    return FreeSpace(poses, free)


def nearest_by_bearing(clouds: Clouds) -> Floats:
    """Return how far (k, bearings), m, the nearest point of each cloud is in every direction; inf where there is none."""
    many, (x, y) = VisibilityPolicy.bearings, np.ascontiguousarray(clouds.points.T)
    bins = _bins(x.astype(np.float64), y.astype(np.float64), many)
    nearest = np.full(len(clouds) * many, np.inf)
    np.minimum.at(nearest, clouds.owner.astype(np.intp) * many + bins, np.hypot(x, y))
    return nearest.reshape(-1, many)


def free_around(clouds: Clouds) -> list[FreeSpace]:
    """Return the free space around the base of each cloud, as this cloud shows it."""
    return [free_space(np.zeros((1, *se2.POSE)), nearest[None]) for nearest in nearest_by_bearing(clouds)]


def _bins(x: Floats, y: Floats, many: int) -> Ints:
    """Return in which of many parts of the circle, from -pi on, points lie."""
    bins = ((np.arctan2(y, x) + np.pi) * (many / (2.0 * np.pi))).astype(np.intp)
    bins *= bins < many  # Straight behind is one direction; a remainder takes longer.
    return bins


def in_free_space(
    free: Floats, which: Ints, x: Floats, y: Floats, margin: float = VisibilityPolicy.margin
) -> tuple[Bools, Bools]:
    """Return which points x, y (e, n), m, stand by more than a margin, m, in the free space of a row (e,) of ranges (k, b), see
    FreeSpace, and which were in view: in it, or up to the margin behind it."""
    distance, parts = np.sqrt(x * x + y * y), free.shape[1]
    until = free.take(_bins(x, y, parts) + parts * which[:, None])
    return distance < until - margin, (until > 0.0) & (distance < until + margin)


def seen_beyond(free: FreeSpace, points: Floats, margin: float = VisibilityPolicy.margin) -> tuple[Ints, Ints]:
    """Return for each point (m, 2) the number (m,) of places that saw beyond it, and of those from which it was in view."""
    back = se2.inverse(free.poses)[:, :, None]
    (c, s), (px, py) = se2.cos_sin(back[:, 2]), np.ascontiguousarray(points.T)
    x, y = c * px - s * py + back[:, 0], s * px + c * py + back[:, 1]
    through, in_view = in_free_space(free.ranges, np.arange(len(free.poses)), x, y, margin)
    return through.sum(axis=0), in_view.sum(axis=0)


def contradiction(free: FreeSpace, points: Floats, margin: float = VisibilityPolicy.margin) -> tuple[float, float]:
    """Return the share of points (m, 2) in view that lie in observed free space, and the share that was in view, 0..1."""
    if len(points) == 0 or len(free.poses) == 0:
        return 0.0, 0.0
    through, in_view = seen_beyond(free, points, margin)
    seen = in_view > 0
    return float(np.sum((through > 0) & seen) / max(int(seen.sum()), 1)), float(seen.mean())


def observed_free_space(clouds: Clouds, submaps: Submaps, poses: Floats) -> list[FreeSpace]:
    """Return the observed free space of each sub-map, from some of its keyframes with clouds and poses (k, 3) T_map_base."""
    nearest = nearest_by_bearing(clouds)
    free = []
    for first, last, reference in zip(submaps.first, submaps.last, submaps.reference, strict=True):
        views = first + evenly(last - first, VisibilityPolicy.views)
        free.append(free_space(se2.between(poses[reference], poses[views]), nearest[views]))
    return free


def static_points(submaps: Submaps, free: Sequence[FreeSpace]) -> Submaps:
    """Return sub-maps without dynamic points: those in the free space of most of their own keyframes with a view of them."""
    counts = [seen_beyond(own, submaps.clouds.cloud(k)[0]) for k, own in enumerate(free)]
    kept = [2 * through <= in_view for through, in_view in counts]
    return replace(submaps, clouds=submaps.clouds.only(np.concatenate([np.zeros(0, dtype=bool), *kept])))


def violates_free_space(free_a: FreeSpace, points_a: Floats, free_b: FreeSpace, points_b: Floats, T_a_b: Floats) -> float:
    """Return the larger share of points (n, 2), (m, 2), m, of either cloud, each in its own frame, that would stand in observed
    free space of the other, 0..1."""
    one, _ = contradiction(free_a, se2.transform(T_a_b, points_b))
    other, _ = contradiction(free_b, se2.transform(se2.inverse(T_a_b), points_a))
    return max(one, other)


def dynamic_share(submaps: Submaps, free: Sequence[FreeSpace], poses: Floats, recording: Ints) -> float:
    """Return the share of a sub-map in the next one's free space, which only people, glass and drift can cause.

    One pair in ten of sub-maps driven one after the other exceeds it, 0..1; 0 where there is no such pair.

    Parameters
    ----------
    free : see observed_free_space. poses : (k, 3) T_map_base of the keyframes. recording : (k,) recording of each.
    """
    reference = submaps.reference
    pairs = np.flatnonzero(np.diff(recording[reference]) == 0)
    steps = se2.between(poses[reference[pairs]], poses[reference[pairs + 1]])
    points = [submaps.clouds.cloud(k)[0] for k in range(len(submaps))]
    shares = [
        violates_free_space(free[k], points[k], free[k + 1], points[k + 1], step)
        for k, step in zip(pairs.tolist(), steps, strict=True)
    ]
    return float(np.quantile(shares, VisibilityPolicy.usual)) if shares else 0.0


def free_space_violation(clouds: Clouds, poses: Floats, path: Floats, recording: Ints) -> tuple[float, float, int]:
    """Return the share, 0..1, of points of one visit that stand in the free space of another visit to the same place, of those
    that it could see; the same within one visit; and the number of different keyframes on the smaller side of the comparisons
    between visits, earlier or later.

    Parameters
    ----------
    clouds : one per keyframe. poses : (k, 3) T_map_base. path : (k,) travelled distance, m. recording : (k,) recording.
    """
    free, shares, visits = free_around(clouds), [], 0
    for again in (False, True):
        i, j = _together(poses, path, recording, again)
        through, seen, compared = 0.0, 0.0, []
        for a, b in zip([*i.tolist(), *j.tolist()], [*j.tolist(), *i.tolist()], strict=True):
            points = se2.transform(se2.between(poses[a], poses[b]), clouds.cloud(b)[0])
            share, visible = contradiction(free[a], points)
            if visible * len(points) >= VisibilityPolicy.common:
                through += share * visible * len(points)
                seen += visible * len(points)
                compared.append((min(a, b), max(a, b)))
        shares.append(through / max(seen, 1.0))
        visits = min((len(set(side)) for side in zip(*compared, strict=True)), default=0)
    return shares[1], shares[0], visits


def _together(poses: Floats, path: Floats, recording: Ints, again: bool) -> tuple[Ints, Ints]:
    """Return pairs (p,), (p,) of keyframes at one place: the nearest of different visits, or the farthest of one visit."""
    from scipy.spatial import cKDTree  # a quarter of a second, which a check of a recording does without

    c = VisibilityPolicy
    nearest = range(1, min(c.neighbours, len(poses)) + 1)
    distance, other = cKDTree(poses[:, :2]).query(poses[:, :2], k=nearest, distance_upper_bound=c.revisit)
    other = np.minimum(other, len(poses) - 1)
    apart = (np.abs(path[other] - path[:, None]) > c.apart) | (recording[other] != recording[:, None])
    paired = (apart == again) & np.isfinite(distance) & (other != np.arange(len(poses))[:, None])
    i = np.flatnonzero(paired.any(axis=1))
    i = i[evenly(len(i), c.revisits)]
    chosen = np.argmax(paired[i], axis=1) if again else len(nearest) - 1 - np.argmax(paired[i, ::-1], axis=1)
    return i, other[i, chosen].astype(np.intp)


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
    """Return the net matching points (e,) of clouds i and j (e,) at relative poses (e, 3), in the direction that has fewest.

    Of two stretches of a recording, the share of all points that match shows how long they overlap, not whether the place is
    right. Each point with a match counts for the place, each in view without a match against it, and others do not count.
    Points of both clouds count, each by the square of its normal's part in a direction: long walls alone leave one without.

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


def surface_cells(clouds: Clouds, poses: Floats) -> "sparse.csr_matrix":
    """Return which surface cells (columns) each cloud (rows) sees; a cell is a square of the map and one of some facings."""
    from scipy import sparse  # a fifth of a second, which a check of a recording does without

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
