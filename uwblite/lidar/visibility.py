"""Visibility between clouds: free space of one, and surfaces of others that stand in it.

If the relative pose of two clouds is right, hardly any surface of the one stands in the other's free space;
people, glass and doors cause a few per cent. If it is wrong, half of the surfaces do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, Ints
from .clouds import Clouds
from .free_space import FreeSpace, contradiction, free_space, seen_beyond
from .submaps import Submaps


@dataclass(frozen=True, slots=True)
class VisibilityPolicy:
    """Free space around clouds, and visits whose views are compared."""

    bearings: ClassVar[int] = 120
    """Bins of the free space around a keyframe: so wide that the points of a wall 5 m away leave none empty."""
    margin: ClassVar[float] = 0.3
    """How far inside the free space a point must stand to count, m."""
    views: ClassVar[int] = 8
    """Keyframes of a sub-map whose free space is used."""
    revisit: ClassVar[float] = 2.0
    """Keyframes nearer to each other than this are at one place, m."""
    apart: ClassVar[float] = 10.0
    """Travelled distance between two visits, m."""
    revisits: ClassVar[int] = 400
    """Most revisits that are compared."""
    common: ClassVar[int] = 10
    """Points of the other that a visit must be able to see to be compared."""
    neighbours: ClassVar[int] = 64
    """Keyframes around one among which another visit is sought."""


def nearest_by_bearing(clouds: Clouds) -> Floats:
    """Return how far (k, bearings), m, the nearest point of each cloud is in every direction; inf where there is none."""
    distance, bearing = np.hypot(clouds.points[:, 0], clouds.points[:, 1]), se2.bearing(clouds.points)
    many = VisibilityPolicy.bearings
    bins = np.clip(((bearing + np.pi) * (many / (2.0 * np.pi))).astype(np.intp), 0, many - 1)
    nearest = np.full(len(clouds) * many, np.inf)
    np.minimum.at(nearest, clouds.owner.astype(np.intp) * many + bins, distance)
    return nearest.reshape(-1, many)


def in_free_space(free: Floats, i: Ints, x: Floats, y: Floats) -> tuple[Bools, Bools]:
    """Return which points x, y (e, n), m, stand in the space that was free around clouds i (e,), and which were in view.

    Parameters
    ----------
    free : (k, bearings) m, see FreeSpace.ranges; of all clouds.
    """
    distance = np.sqrt(x * x + y * y)
    bins = ((np.arctan2(y, x) + np.pi) * (VisibilityPolicy.bearings / (2.0 * np.pi))).astype(np.intp)
    bins *= bins < VisibilityPolicy.bearings
    until = free[i[:, None], bins]
    return distance < until - VisibilityPolicy.margin, (until > 0.0) & (distance < until + VisibilityPolicy.margin)


def observed_free_space(clouds: Clouds, submaps: Submaps, poses: Floats) -> list[FreeSpace]:
    """Return the observed free space of each sub-map, from some of its keyframes.

    Parameters
    ----------
    clouds : one per keyframe. poses : (k, 3) T_map_base of the keyframes.
    """
    nearest = nearest_by_bearing(clouds)
    free = []
    for first, last, reference in zip(submaps.first, submaps.last, submaps.reference, strict=True):
        views = np.unique(np.linspace(first, last - 1, VisibilityPolicy.views).round().astype(np.intp))
        free.append(free_space(se2.between(poses[reference], poses[views]), nearest[views]))
    return free


def static_points(submaps: Submaps, free: Sequence[FreeSpace]) -> Submaps:
    """Return sub-maps without dynamic points: those in the free space of most of their own keyframes with a view of them.

    People who walk beside the robot leave trails in a sub-map that no other sub-map shows.
    """
    kept = np.ones(len(submaps.clouds.points), dtype=bool)
    for k, own in enumerate(free):
        rows = slice(submaps.clouds.offsets[k], submaps.clouds.offsets[k + 1])
        through, in_view = seen_beyond(own, submaps.clouds.cloud(k)[0], VisibilityPolicy.margin)
        kept[rows] = 2 * through <= in_view
    return replace(submaps, clouds=submaps.clouds.only(kept))


def violates_free_space(free_a: FreeSpace, points_a: Floats, free_b: FreeSpace, points_b: Floats, T_a_b: Floats) -> float:
    """Return the larger share of either sub-map's points that would stand in observed free space of the other, 0..1.

    Parameters
    ----------
    free_a, free_b : see observed_free_space. points_a (n, 2), points_b (m, 2), m : each in its own frame.
    T_a_b : (3,) pose of b in a.
    """
    one, _ = contradiction(free_a, se2.transform(T_a_b, points_b), VisibilityPolicy.margin)
    other, _ = contradiction(free_b, se2.transform(se2.inverse(T_a_b), points_a), VisibilityPolicy.margin)
    return max(one, other)


def pair_violations(clouds: Clouds, nearest: Floats, i: int, j: int, poses: Floats) -> Floats:
    """Return the larger share (c,) of either of two clouds that would stand in free space for poses (c, 3) of j in i, 0..1.

    Parameters
    ----------
    nearest : see nearest_by_bearing; of all clouds.
    """
    here, there = (free_space(np.zeros((1, 3)), nearest[k : k + 1]) for k in (i, j))
    own, other = (clouds.cloud(k)[0] for k in (i, j))
    return np.array([violates_free_space(here, own, there, other, pose) for pose in poses])


def dynamic_share(submaps: Submaps, free: Sequence[FreeSpace], poses: Floats, recording: Ints) -> float:
    """Return the share of a sub-map in the next one's free space, which only people, glass and drift can cause.

    Parameters
    ----------
    free : see observed_free_space. poses : (k, 3) T_map_base of the keyframes. recording : (k,) recording of each.

    Returns
    -------
    The share that one pair in ten of sub-maps driven one after the other exceeds, 0..1; 0 where there is no such pair.
    """
    reference = submaps.reference
    pairs = np.flatnonzero(np.diff(recording[reference]) == 0)
    steps = se2.between(poses[reference[pairs]], poses[reference[pairs + 1]])
    points = [submaps.clouds.cloud(k)[0] for k in range(len(submaps))]
    shares = [
        violates_free_space(free[k], points[k], free[k + 1], points[k + 1], step)
        for k, step in zip(pairs.tolist(), steps, strict=True)
    ]
    return float(np.quantile(shares, 0.9)) if shares else 0.0


def free_space_violation(clouds: Clouds, poses: Floats, path: Floats, recording: Ints) -> tuple[float, int]:
    """Return the share of points of one visit that stand in the free space of another visit to the same place.

    Parameters
    ----------
    clouds : one per keyframe. poses : (k, 3) T_map_base. path : (k,) travelled distance, m. recording : (k,) recording.

    Returns
    -------
    share : of the points that the other visit could see, 0..1.
    visits : different keyframes on the smaller side of the comparisons, earlier or later. One keyframe that is compared with
        many contributes one person in its view to all comparisons.
    """
    i, j = _revisits(poses, path, recording)
    nearest = nearest_by_bearing(clouds)
    through, seen, compared = 0.0, 0.0, []
    for a, b in zip([*i.tolist(), *j.tolist()], [*j.tolist(), *i.tolist()], strict=True):
        points = se2.transform(se2.between(poses[a], poses[b]), clouds.cloud(b)[0])
        share, visible = contradiction(free_space(np.zeros((1, 3)), nearest[a : a + 1]), points, VisibilityPolicy.margin)
        if visible * len(points) >= VisibilityPolicy.common:
            through += share * visible * len(points)
            seen += visible * len(points)
            compared.append((min(a, b), max(a, b)))
    visits = min((len(set(side)) for side in zip(*compared, strict=True)), default=0)
    return through / max(seen, 1.0), visits


def _revisits(poses: Floats, path: Floats, recording: Ints) -> tuple[Ints, Ints]:
    """Return pairs (p,), (p,) of keyframes that lie together but were not driven one after the other."""
    many, c = min(VisibilityPolicy.neighbours, len(poses)), VisibilityPolicy
    distance, other = cKDTree(poses[:, :2]).query(poses[:, :2], k=many, distance_upper_bound=c.revisit)
    distance, other = distance.reshape(len(poses), -1), other.reshape(len(poses), -1)
    other = np.minimum(other, len(poses) - 1)
    again = (np.abs(path[other] - path[:, None]) > VisibilityPolicy.apart) | (recording[other] != recording[:, None])
    again &= np.isfinite(distance)
    i = np.flatnonzero(again.any(axis=1))
    i = i[np.unique(np.linspace(0, len(i) - 1, min(VisibilityPolicy.revisits, len(i))).round().astype(np.intp))]
    return i, other[i, np.argmax(again[i], axis=1)].astype(np.intp)
