"""Round columns among the rays of many scans: where they stand, and how large they are."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, connected, dots
from ..odometry.attached import ScanPoints
from .ray_noise import range_sigma


@dataclass(frozen=True, slots=True)
class ColumnConfig:
    """What a round column is."""

    radii: tuple[float, float] = (0.04, 0.8)
    """m, smallest and largest."""
    jump: float = 0.2
    """m, difference of neighbouring ranges that ends a run of rays, beside two standard deviations of them."""
    missing: int = 3
    """Rays that may be missing within a run."""
    fewest: int = 10
    """Least number of rays of a run that shows a curvature."""
    bend: float = 20.0
    """Least chi2 by which a circle fits a run better than a line."""
    scatter: float = 1.4
    """Largest rms distance of a run from its circle, relative to the noise."""
    apart: float = 0.12
    """m between centres up to which two circles may be one column."""
    unlike: float = 0.3
    """Relative difference of the radii up to which they are, beside half the smallest radius."""
    views: int = 3
    """Least number of keyframes that see a column."""
    gates: tuple[float, ...] = (0.15, 0.15, 0.15)
    """m, of the first steps towards a circle."""
    steps: int = 8
    """Steps towards a circle."""
    gate: float = 4.0
    """Gate of the other steps, standard deviations of the rays, beside the slack."""
    slack: float = 0.02
    """m."""
    incidence: float = 0.4
    """Least cosine between a ray and the normal; others hit the edge of a column, where readings are unreliable."""
    around: float = 0.3
    """m from the circle up to which rays are a column's surroundings."""
    share: float = 0.6
    """Share of the rays around it that must end on it."""


_CONFIG = ColumnConfig()


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


def fitted_circles(rays: ScanPoints, config: ColumnConfig = _CONFIG) -> Circles:
    """Fit a circle to each run of neighbouring rays, and keep those that are curved towards the laser, as a column is.

    Least squares of the algebraic distance (I. Kasa 1976): a little too small where little of the circle is seen.
    """
    rays, number, reach = _short_runs(rays, config)
    many = int(number.max(initial=-1)) + 1
    count = np.maximum(np.bincount(number, minlength=many), 1)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(number, values, many) / count)

    middle = np.stack([mean(rays.points[:, 0]), mean(rays.points[:, 1])], axis=1)
    x, y = (rays.points - middle.take(number, axis=0)).T
    square = x * x + y * y
    xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
    centre = 0.5 * _solved(xx, xy, yy, mean(x * square), mean(y * square))
    radius = np.sqrt(xx + yy + (centre**2).sum(axis=1))
    off = np.sqrt(mean((np.hypot(x - centre[:, 0].take(number), y - centre[:, 1].take(number)) - radius.take(number)) ** 2))
    flat = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy))
    sigma = mean(range_sigma(reach))
    origin = np.stack([mean(rays.origins[:, 0]), mean(rays.origins[:, 1])], axis=1) - middle
    good = (radius > config.radii[0]) & (radius < config.radii[1]) & (off < config.scatter * sigma)
    good &= (count * (flat - off**2) > config.bend * sigma**2) & (dots(centre, origin) < 0.0)
    chosen = np.flatnonzero(good)
    keyframe = rays.keyframe[np.searchsorted(number, chosen)]
    return Circles(keyframe, (middle + centre)[chosen], radius[chosen], count[chosen].astype(np.float64))


def _short_runs(rays: ScanPoints, config: ColumnConfig) -> tuple[ScanPoints, Ints, Floats]:
    """Return the rays (m,) of runs no longer than a column is wide, the number of each ray's run, and the rays' lengths, m."""
    reach = np.hypot(*(rays.points - rays.origins).T)
    begins = np.ones(len(reach), dtype=bool)
    begins[1:] = (np.diff(rays.scan) != 0) | (np.diff(rays.ray) > config.missing)
    begins[1:] |= np.abs(np.diff(reach)) > config.jump + 2.0 * range_sigma(reach[1:])
    first = np.flatnonzero(begins)
    count = np.diff(np.append(first, len(reach)))
    wide = np.hypot(*(rays.points[first + count - 1] - rays.points[first]).T)
    good = (count >= config.fewest) & (wide < _WIDEST * config.radii[1])
    rows, kept = np.flatnonzero(np.repeat(good, count)), count[good]
    return rays.rows(rows), np.repeat(np.arange(len(kept)), kept), reach[rows]


_WIDEST = 2.5
"""Largest distance between the ends of a run, relative to the largest radius of a column: 2 without noise."""


def _solved(a: Floats, b: Floats, c: Floats, right_x: Floats, right_y: Floats) -> Floats:
    """Solve [[a, b], [b, c]] z = right, (m, 2); 0 where that is singular."""
    determinant = a * c - b * b
    inverse = np.divide(1.0, determinant, out=np.zeros_like(a), where=determinant > _SINGULAR)
    return np.stack([c * right_x - b * right_y, a * right_y - b * right_x], axis=1) * inverse[:, None]


_SINGULAR = 1e-14
"""m^4."""


def join_circles(found: Circles, poses: Floats, config: ColumnConfig = _CONFIG) -> Floats:
    """Return the columns (n, 3), x, y, radius in the map, that circles of several keyframes at poses (k, 3) show."""
    at = se2.transform(poses[found.keyframe], found.centre)
    one, other = cKDTree(at).query_pairs(config.apart, output_type="ndarray").T if len(at) else np.zeros((2, 0), dtype=np.intp)
    smaller = np.minimum(found.radius[one], found.radius[other])
    alike = np.abs(found.radius[one] - found.radius[other]) < config.unlike * smaller + 0.5 * config.radii[0]
    number = connected(one[alike], other[alike], len(at))
    views = np.bincount(np.unique(np.stack([number, found.keyframe]), axis=1)[0].astype(np.intp))
    weight = np.bincount(number, found.rays).astype(np.float64)
    values = np.column_stack([at, found.radius])
    columns = np.stack([np.bincount(number, found.rays * v) / weight for v in values.T], axis=1)
    return _apart(columns[views >= config.views], weight[views >= config.views])


def _apart(columns: Floats, weight: Floats) -> Floats:
    """Return the columns (n, 3) that do not stand within another of more weight (n,)."""
    gap = np.hypot(*(columns[:, None, :2] - columns[None, :, :2]).transpose(2, 0, 1))
    better = (weight[None] > weight[:, None]) | ((weight[None] == weight[:, None]) & np.tri(len(weight), k=-1, dtype=bool))
    within: Bools = gap < columns[:, None, 2] + columns[None, :, 2]
    return np.asarray(columns[~(within & better).any(axis=1)])


def to_circle(points: Floats, direction: Floats, radius: Floats) -> tuple[Floats, Floats, Floats]:
    """Return how far (m,) points (m, 2) are from a circle about 0 along their rays, the normals (m, 2) there, and the cosine
    of incidence, 0 where a ray misses."""
    along = dots(points, direction)
    inside = radius**2 - dots(points, points) + along**2
    shift = -along - np.sqrt(np.maximum(inside, 0.0))
    normal = (points + shift[:, None] * direction) / radius[:, None]
    return shift, normal, np.where(inside > 0.0, dots(normal, direction), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Columns and the squares of the map near them: few points of a map lie there, and only these are tested."""

    columns: Floats
    """(c, 3) x, y, radius."""
    corner: Floats
    """(2,) m, of the first square."""
    size: float
    """m, of a square."""
    near: Bools
    """(x, y) whether a square is near a column; the outermost ones are not."""

    def inside(self, at: Floats) -> Ints:
        """Return the rows (n,) of points (p, 2) on such squares."""
        x, y = (
            np.clip((at[:, k] - self.corner[k]) * (1.0 / self.size), 0.0, self.near.shape[k] - 1.0).astype(np.intp)
            for k in range(2)
        )
        return np.flatnonzero(self.near.take(x * self.near.shape[1] + y))

    def nearest(self, at: Floats) -> tuple[Ints, Ints, Floats]:
        """Return the rows (n,) of points (p, 2) on such squares, the column nearest to each, and how far its centre is, m."""
        rows = self.inside(at)
        if not len(rows):
            return rows, rows, np.zeros(0)
        away, which = cKDTree(self.columns[:, :2]).query(at.take(rows, axis=0))
        return rows, which, away

    def on_rim(self, at: Floats, margin: float) -> Bools:
        """Return which points (p, 2) are nearer to a column's rim than a margin, m."""
        rows, which, away = self.nearest(at)
        found = np.zeros(len(at), dtype=bool)
        found[rows] = np.abs(away - self.columns[which, 2]) < margin
        return found


_SQUARE, _MOST_SQUARES = 0.2, 1e6
"""Size of a square, m, and the largest number of squares; a larger map gets larger squares."""


def surroundings(columns: Floats, margin: float) -> Surroundings:
    """Return the squares within a margin, m, of columns (c, 3)."""
    if not len(columns):
        return Surroundings(columns, np.zeros(2), _SQUARE, np.zeros((1, 1), dtype=bool))
    reach, wide = columns[:, 2].max() + margin, np.ptp(columns[:, :2], axis=0)
    size = max(_SQUARE, float(np.sqrt(np.prod(wide + 2.0 * reach) / _MOST_SQUARES)))
    corner = columns[:, :2].min(axis=0) - reach - 2.0 * size
    x, y = np.ceil((wide + 2.0 * reach) / size).astype(np.intp) + 4
    middle = corner + (np.stack(np.meshgrid(np.arange(x), np.arange(y), indexing="ij"), axis=-1) + 0.5) * size
    near = cKDTree(columns[:, :2]).query(middle)[0] < reach + size
    return Surroundings(columns, corner, size, near)


_PROBABLE = 1.22
"""Standard deviations within which at least half of the rays of a column must end: 0.67 if it is a perfect circle."""


def refined_columns(columns: Floats, at: Floats, direction: Floats, sigma: Floats, config: ColumnConfig = _CONFIG) -> Floats:
    """Fit columns (c, 3) to the rays that end at (p, 2) in the map, and keep those that are round.

    Parameters
    ----------
    direction : (p, 2) of the rays. sigma : (p,) m, along them.
    """
    if not len(columns):
        return columns
    own = cKDTree(columns[:, :2]).query(at)[1]
    weight = 1.0 / sigma**2
    for turn in range(config.steps):
        centre, radius = columns[:, :2].take(own, axis=0), columns[:, 2].take(own)
        shift, normal, incidence = to_circle(at - centre, direction, radius)
        gate = config.gates[turn] if turn < len(config.gates) else config.gate * sigma + config.slack
        near = (incidence < -config.incidence) & (np.abs(shift) < gate)
        robust = np.where(near, weight / (1.0 + (shift / (2.0 * sigma)) ** 2) ** 2, 0.0)
        rows = np.flatnonzero(robust)
        residual = (-shift * incidence).take(rows)
        whole, right = _summed(own.take(rows), robust.take(rows), normal.take(rows, axis=0), residual, len(columns))
        columns = columns + np.linalg.solve(whole + np.eye(3), right[:, :, None])[:, :, 0]
        columns[:, 2] = np.clip(columns[:, 2], *config.radii)
    ended = (incidence < -config.incidence) & (np.abs(shift) < config.around)
    count, around, probable = (
        np.bincount(own, flags, len(columns)) for flags in (near, ended, near & (np.abs(shift) < _PROBABLE * sigma))
    )
    return np.asarray(columns[(count >= 2 * config.fewest) & (count > config.share * around) & (probable > 0.5 * count)])


def _summed(own: Ints, weight: Floats, normal: Floats, residual: Floats, many: int) -> tuple[Floats, Floats]:
    """Return the normal equations (m, 3, 3) and (m, 3) of as many circles by their rays (p,)."""
    parts, whole, right = (*normal.T, np.ones(len(normal))), np.zeros((many, 3, 3)), np.zeros((many, 3))
    for a in range(3):
        weighted = weight * parts[a]
        right[:, a] = np.bincount(own, weighted * residual, many)
        for b in range(a, 3):
            whole[:, a, b] = whole[:, b, a] = np.bincount(own, weighted * parts[b], many)
    return whole, right
