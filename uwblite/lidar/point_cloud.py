"""Planar point clouds (n, 2): filters, and the lines through the neighbourhoods of their points.

Points are finite, in metres, in any one frame, and keep their order.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import WIDE, Bools, Floats, Ints, Table, Wides, as_array, require_finite, require_shape, run_starts, stable_order

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def make_tree(points: Floats) -> "cKDTree":
    """Return a kd-tree of points (n, 2) with the quick build: sliding midpoint splits, loose boxes."""
    from scipy.spatial import cKDTree  # a quarter of a second, which a check of a recording does without

    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def as_points(points: ArrayLike, name: str = "points") -> Floats:
    """Return points (n, 2), m, as an array.

    Raises
    ------
    DataError : they have another shape, are no numbers, or one is not finite.
    """
    array = as_array(points, name)
    array = array.reshape(-1, 2) if not array.size else array
    require_shape(array, name, ("n", 2))
    require_finite(array, name)
    return array


def voxel_filter(points: ArrayLike, size: float) -> Floats:
    """Return the mean (m, 2) of the points (n, 2) in each occupied square of an edge, m, by x and y of the squares."""
    points = as_points(points)
    return mean_by_key(cell_number(np.zeros(len(points), dtype=WIDE), points, size), points)[1]


def statistical_outlier_filter(points: ArrayLike, neighbours: int, std_ratio: float) -> Bools:
    """Return which points (n, 2), m, have a mean distance to their nearest neighbours of at most mean + std_ratio * standard
    deviation of that distance over the whole cloud; a small cloud uses all its points."""
    points = as_points(points)
    k = min(neighbours, len(points) - 1)
    if k < 1:
        return np.ones(len(points), bool)
    mean = make_tree(points).query(points, k=list(range(2, k + 2)))[0].mean(axis=1)
    return np.asarray(mean <= mean.mean() + std_ratio * mean.std())


def radius_outlier_filter(points: ArrayLike, radius: float, min_neighbours: int) -> Bools:
    """Return which points (n, 2), m, have at least min_neighbours others within the radius, m, inclusive."""
    points = as_points(points)
    if min_neighbours < 1 or len(points) == 0:
        return np.ones(len(points), bool)
    bound = np.nextafter(radius, np.inf)
    farthest = make_tree(points).query(points, k=[min_neighbours + 1], distance_upper_bound=bound)[0]
    return np.asarray(farthest[:, 0] <= radius)


def cell_number(owner: Ints, points: Floats, size: float) -> Wides:
    """Return a number (p,) that points (p, 2) have in common which have one owner (p,) and lie in one square."""
    x, y = np.floor(np.ascontiguousarray(points.T) / size).astype(WIDE)
    x -= x.min(initial=0)
    y -= y.min(initial=0)
    return np.asarray((owner * (x.max(initial=0) + 1) + x) * (y.max(initial=0) + 1) + y)


def mean_by_key(key: Wides, values: Floats) -> tuple[Ints, Floats]:
    """Return one row of each key (m,), by key, and the means (m, v) of the values (p, v) that share a key (p,)."""
    order = stable_order(key)
    first = run_starts(key[order])
    if not len(first):
        return first, values
    count = np.diff(np.append(first, len(key)))[:, None]
    return order[first], np.add.reduceat(values.take(order, axis=0), first, axis=0) / count


def neighbour_pairs(owner: Ints, points: Floats, radius: float) -> tuple[Ints, Ints]:
    """Return the pairs (p,), (p,) of points (n, 2) of one owner (n,) that are within a radius, m, of each other, each once.

    With squares as wide as the radius, both points are in one square or in two that touch. Squares are numbered column by
    column, an empty one behind each column and an empty column behind each owner, so that those that touch one are three runs.
    """
    x, y = np.ascontiguousarray(points.T)
    column, row = (np.floor(values / radius).astype(WIDE) for values in (x, y))
    column -= column.min(initial=0)
    row -= row.min(initial=0)
    high = row.max(initial=0) + 2
    square = (owner * (column.max(initial=0) + 2) + column) * high + row
    order = stable_order(square)
    square, x, y = (values.take(order) for values in (square, x, y))
    # What follows in the same square or lies in the next one of its column, then the three squares of the next column.
    here = np.arange(len(order))
    first = np.concatenate([here + 1, np.searchsorted(square, square + high - 1)])
    count = np.searchsorted(square, np.concatenate([square + 1, square + high + 1]), "right") - first
    i = np.repeat(np.concatenate([here, here]), count)
    j = np.arange(len(i)) + np.repeat(first + count - np.cumsum(count), count)
    near = np.flatnonzero((x.take(j) - x.take(i)) ** 2 + (y.take(j) - y.take(i)) ** 2 <= radius**2)
    return order.take(i.take(near)), order.take(j.take(near))


@dataclass(frozen=True, slots=True, eq=False)
class Lines(Table):
    """The straight line fitted to the surroundings of each point."""

    centers: Floats
    """(n, 2) m, mean of the point and its neighbours."""
    normals: Floats
    """(n, 2) unit vectors across the line; their sign is arbitrary. Zero where there is no line."""
    linearity: Floats
    """(n,) 1 - smaller / larger eigenvalue of the neighbourhood's covariance: 1 a line, 0 a round blob or a lone point."""
    neighbours: Ints
    """(n,) points in the neighbourhood, the point itself included."""
    normal_variance: Floats
    """(n,) rad^2, variance of the normal's angle by the scatter about the line; 0 where there is no line."""
    along: Floats
    """(n,) m^2, variance of the neighbourhood along the line."""


_ROUNDING = 1e-12
"""Share of the scatter of a neighbourhood below which it is rounding error of differences of sums."""


def estimate_normals(points: Floats, i: Ints, j: Ints, min_neighbours: int = 2) -> Lines:
    """Fit a line to the neighbours of every point: principal axes of the 2x2 covariance, in closed form.

    With the covariance [[a, b], [b, c]] the line's direction is atan2(2 b, a - c) / 2 and the eigenvalues are
    ((a + c) +- hypot(a - c, 2 b)) / 2. A least-squares line through k points has an angle of variance
    small / ((k - 2) large) in these eigenvalues.

    Parameters
    ----------
    points : (n, 2), m. i, j : (p,) pairs of them that are neighbours. min_neighbours : others that it needs to give a line.
    """
    n = len(points)
    dx, dy = (column.take(j) - column.take(i) for column in np.ascontiguousarray(points.T))
    both = np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
    count = both + 1.0
    mx = (np.bincount(i, dx, n) - np.bincount(j, dx, n)) / count
    my = (np.bincount(i, dy, n) - np.bincount(j, dy, n)) / count
    # Squares overwrite the values: less memory traffic.
    xy = dx * dy
    dx *= dx
    dy *= dy
    a = (np.bincount(i, dx, n) + np.bincount(j, dx, n)) / count - mx * mx
    b = (np.bincount(i, xy, n) + np.bincount(j, xy, n)) / count - mx * my
    c = (np.bincount(i, dy, n) + np.bincount(j, dy, n)) / count - my * my
    trace, gap = a + c, np.hypot(a - c, 2.0 * b)
    large, small = 0.5 * (trace + gap), 0.5 * (trace - gap)
    # For points on one line only rounding error remains, which depends on the order of the pairs.
    small = np.where(small > _ROUNDING * trace, small, 0.0)
    valid = (both >= min_neighbours) & (large > 0.0)
    ratio = np.divide(small, large, out=np.ones(n), where=valid)
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    normals = np.where(valid, np.stack([-np.sin(angle), np.cos(angle)]), 0.0).T
    return Lines(
        centers=points + np.stack([mx, my], axis=-1),
        normals=normals,
        linearity=1.0 - ratio,
        neighbours=both + 1,
        normal_variance=np.where(valid, ratio / np.maximum(count - 2.0, 1.0), 0.0),
        along=large,
    )
