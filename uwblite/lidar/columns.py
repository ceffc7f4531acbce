"""Round columns among the rays of many scans: where they stand, and how large they are."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Floats, Ints, Table, connected, dots
from ..odometry.attached import ScanPoints
from .surface_rays import ShapePolicy, SurfaceRays, begins_run, range_sigma, to_circle


class ColumnPolicy:
    """What a round column is."""

    radii: tuple[float, float] = (0.04, 0.8)
    """m, smallest and largest."""
    widest: float = 2.0
    """Largest distance between the ends of a run of rays, m."""
    jump: float = 0.2
    """m, difference of neighbouring ranges that ends a run of rays, beside two standard deviations of them."""
    fewest: int = 10
    """Least number of rays of a run that shows a curvature."""
    views: int = 3
    """Least number of keyframes that see a column."""
    steps: int = 8
    """Steps towards a circle."""
    begin: float = 0.15
    """Gate of the first half of the steps, m."""
    gate: float = 4.0
    """Gate of the other steps, standard deviations of the rays, beside what surfaces are uneven."""
    incidence: float = 0.4
    """Least cosine between a ray and the normal; others hit the edge of a column, where readings are unreliable."""
    share: float = 0.6
    """Share of the rays around it that must end on it."""
    probable: float = 1.22
    """Standard deviations within which at least half of the rays of a column must end: 0.67 if it is a perfect circle."""


_SINGULAR = 1e-14
"""Determinant, m^4, of places on a line."""


@dataclass(frozen=True, slots=True, eq=False)
class Circles(Table):
    """Circles fitted to runs of rays of single scans."""

    keyframe: Ints
    """(c,)."""
    centre: Floats
    """(c, 2) m, frame of the keyframe."""
    radius: Floats
    """(c,) m."""
    rays: Floats
    """(c,) number of rays that show it."""


def fitted_circles(rays: ScanPoints) -> Circles:
    """Fit a circle (I. Kasa 1976) to each run of neighbouring rays, and keep those curved towards the laser, as a column is."""
    rays, number, reach = _short_runs(rays)
    many, c = int(number.max(initial=-1)) + 1, ColumnPolicy
    count = np.maximum(np.bincount(number, minlength=many), 1)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(number, values, many) / count)

    middle, origin = (np.stack([mean(v) for v in places.T], axis=1) for places in (rays.points, rays.origins))
    x, y = (rays.points - middle.take(number, axis=0)).T
    square = x * x + y * y
    xx, xy, yy, right_x, right_y = mean(x * x), mean(x * y), mean(y * y), mean(x * square), mean(y * square)
    determinant = xx * yy - xy * xy
    centre = 0.5 * np.stack([yy * right_x - xy * right_y, xx * right_y - xy * right_x], axis=1)
    centre *= np.divide(1.0, determinant, out=np.zeros(many), where=determinant > _SINGULAR)[:, None]
    radius = np.sqrt(xx + yy + dots(centre, centre))
    off = np.sqrt(mean((np.hypot(*(np.stack([x, y]) - centre.T.take(number, axis=1))) - radius.take(number)) ** 2))
    flat = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy))
    sigma = mean(range_sigma(reach))
    good = (radius > c.radii[0]) & (radius < c.radii[1]) & (off < ShapePolicy.scatter * sigma)
    good &= (count * (flat - off**2) > ShapePolicy.bend * sigma**2) & (dots(centre, origin - middle) < 0.0)
    chosen = np.flatnonzero(good)
    keyframe = rays.keyframe[np.searchsorted(number, chosen)]
    return Circles(keyframe, (middle + centre)[chosen], radius[chosen], count[chosen].astype(np.float64))


def _short_runs(rays: ScanPoints) -> tuple[ScanPoints, Ints, Floats]:
    """Return the rays (m,) of runs no longer than a column is wide, the number of each ray's run, and the rays' lengths, m."""
    c, reach = ColumnPolicy, np.hypot(*(rays.points - rays.origins).T)
    first = np.flatnonzero(begins_run(rays, np.abs(np.diff(reach)) > c.jump + 2.0 * range_sigma(reach[1:])))
    count = np.diff(np.append(first, len(reach)))
    wide = np.hypot(*(rays.points[first + count - 1] - rays.points[first]).T)
    good = (count >= c.fewest) & (wide < c.widest)
    rows, kept = np.flatnonzero(np.repeat(good, count)), count[good]
    return rays.rows(rows), np.repeat(np.arange(len(kept)), kept), reach[rows]


def join_circles(found: Circles, poses: Floats) -> Floats:
    """Return the columns (n, 3), x, y, radius in the map, that circles of several keyframes at poses (k, 3) show."""
    c, at = ColumnPolicy, se2.transform(poses[found.keyframe], found.centre)
    apart = 2.0 * ShapePolicy.on
    one, other = cKDTree(at).query_pairs(apart, output_type="ndarray").T if len(at) else np.zeros((2, 0), dtype=np.intp)
    alike = np.abs(found.radius[one] - found.radius[other]) < apart
    number = connected(one[alike], other[alike], len(at))
    views = np.bincount(np.unique(np.stack([number, found.keyframe]), axis=1)[0].astype(np.intp))
    weight = np.bincount(number, found.rays).astype(np.float64)
    columns = np.stack([np.bincount(number, found.rays * v) / weight for v in (*at.T, found.radius)], axis=1)
    return _apart(columns[views >= c.views], weight[views >= c.views])


def _apart(columns: Floats, weight: Floats) -> Floats:
    """Return the columns (n, 3) that do not stand within another of more weight (n,)."""
    columns = columns[np.argsort(-weight, kind="stable")]
    gap = np.hypot(*(columns[:, None, :2] - columns[None, :, :2]).transpose(2, 0, 1))
    within = gap < columns[:, None, 2] + columns[None, :, 2]
    return np.asarray(columns[~np.tril(within, -1).any(axis=1)])


def nearest_rims(columns: Floats, at: Floats) -> tuple[Ints, Floats]:
    """Return the column (p,) whose rim is nearest to each of points (p, 2), and the distance to it, m; negative within it.

    Parameters
    ----------
    columns : (c, 3), c > 0, x, y, radius. Those of nearest centres are compared, until no wider one can be nearer.
    """
    tree, widest, compared = cKDTree(columns[:, :2]), float(columns[:, 2].max()), 1
    which, away, left = np.zeros(len(at), dtype=np.intp), np.zeros(len(at)), np.arange(len(at))
    while len(left):
        compared = min(2 * compared, len(columns))
        centre, near = tree.query(at.take(left, axis=0), np.arange(compared) + 1)
        rim = centre - columns[near, 2]
        best = rim.argmin(axis=1)[:, None]
        which[left], away[left] = (np.take_along_axis(v, best, axis=1)[:, 0] for v in (near, rim))
        left = left[(centre[:, -1] - widest < away[left]) & (compared < len(columns))]
    return which, away


def rim_distances(columns: Floats, at: Floats, margin: float) -> Floats:
    """Return the distances (p,) of points (p, 2) to the nearest rim of columns (c, 3), m, negative within one; inf beyond a
    margin, m."""
    found = np.full(len(at), np.inf)
    if len(columns):
        # Few points of a map lie near a column.
        reach = float(columns[:, 2].max()) + margin
        rows = np.flatnonzero(np.isfinite(cKDTree(columns[:, :2]).query(at, distance_upper_bound=reach)[0]))
        found[rows] = nearest_rims(columns, at.take(rows, axis=0))[1]
    return np.where(found < margin, found, np.inf)


def around_columns(rays: SurfaceRays, poses: Floats, columns: Floats) -> SurfaceRays:
    """Return the rays from poses (k, 3) that end near columns (c, 3)."""
    at = se2.transform_each(poses, rays.keyframe, rays.points)
    return rays.rows(np.isfinite(rim_distances(columns, at, ShapePolicy.around)))


def on_columns(rays: SurfaceRays, poses: Floats, columns: Floats, first: int) -> SurfaceRays:
    """Return the rays from poses (k, 3) that end on columns (c, 3), numbered as surfaces that begin with `first`."""
    if not len(columns):
        return rays.rows(slice(0))
    c, (at, direction) = ColumnPolicy, rays.in_map(poses)
    nearest, _ = nearest_rims(columns, at)
    shift, _, incidence = to_circle(at - columns[:, :2].take(nearest, axis=0), direction, columns[:, 2].take(nearest))
    good = (incidence < -c.incidence) & (np.abs(shift) < c.gate * rays.sigma + ShapePolicy.uneven)
    return replace(rays, surface=nearest + first).rows(good)


def fitted_columns(rays: SurfaceRays, poses: Floats, columns: Floats) -> Floats:
    """Fit columns (c, 3) to rays from poses (k, 3) that end around them, and keep those that are round."""
    if not len(columns):
        return columns
    c, (at, direction), sigma = ColumnPolicy, rays.in_map(poses), rays.sigma.astype(np.float64)
    own, weight = nearest_rims(columns, at)[0], 1.0 / sigma**2
    for turn in range(c.steps):
        centre, radius = columns[:, :2].take(own, axis=0), columns[:, 2].take(own)
        shift, normal, incidence = to_circle(at - centre, direction, radius)
        gate = c.begin if 2 * turn < c.steps else c.gate * sigma + ShapePolicy.uneven
        near = (incidence < -c.incidence) & (np.abs(shift) < gate)
        robust = np.where(near, weight / (1.0 + (shift / (2.0 * sigma)) ** 2) ** 2, 0.0)
        rows = np.flatnonzero(robust)
        residual = (-shift * incidence).take(rows)
        whole, right = _summed(own.take(rows), robust.take(rows), normal.take(rows, axis=0), residual, len(columns))
        columns = columns + np.linalg.solve(whole + np.eye(columns.shape[1]), right[:, :, None])[:, :, 0]
        columns[:, 2] = np.clip(columns[:, 2], *c.radii)
    ended = (incidence < -c.incidence) & (np.abs(shift) < ShapePolicy.around)
    count, around, probable = (
        np.bincount(own, flags, len(columns)) for flags in (near, ended, near & (np.abs(shift) < c.probable * sigma))
    )
    return np.asarray(columns[(count >= 2 * c.fewest) & (count > c.share * around) & (probable > 0.5 * count)])


def _summed(own: Ints, weight: Floats, normal: Floats, residual: Floats, many: int) -> tuple[Floats, Floats]:
    """Return the normal equations (m, 3, 3) and (m, 3) of as many circles by their rays (p,)."""
    parts = (*normal.T, np.ones(len(normal)))
    whole = [[np.bincount(own, weight * one * other, many) for other in parts] for one in parts]
    right = [np.bincount(own, weight * one * residual, many) for one in parts]
    return np.moveaxis(np.array(whole), -1, 0), np.moveaxis(np.array(right), -1, 0)
