"""A map's walls for comparison with scans: the nearest wall of every place, and the cells that a ray must not pass.

A scan's point lies on a wall when the nearest occupied cell is near; across the wall's line it measures the pose. A ray
that ends in free space hit an object that is not in the map, and one that passes an occupied cell contradicts the map; both
lower the likelihood of a pose, but do not move it. Points in unknown space do not count.
"""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

from .. import se2
from ..arrays import Bools, Floats, Table, evenly, unique_rows
from ..grid.geometry import GridGeometry
from ..grid.occupancy_grid import FREE, OCCUPIED, UNKNOWN, GridConfig, OccupancyGrid
from ..lidar.object_likelihood import ObjectPolicy
from ..lidar.point_cloud import Lines, estimate_normals, make_tree
from ..lidar.visibility import VisibilityPolicy

_Cell = TypeVar("_Cell", np.int8, np.signedinteger[Any])

PER_RAY, PER_FACTOR = 140, 45
"""Operations on elements of arrays for the agreement of a ray with the map at a pose, and for its quadratic form."""
REACH = 0.5
"""m; largest distance of a neighbouring wall."""
UNIFORM_VARIANCE = 1.0 / 12.0
"""Of a uniform distribution of width 1."""
_NORMAL_RADIUS, _LEAST_CELLS = 0.2, 3.0
"""m, neighbourhood of a wall's line, and its least radius in cells."""
_STRAIGHT = 0.6
"""Least linearity of a line through single cells."""
_BEHIND = 0.013
"""m; the surface behind the first occupied cells' centres. A cell before it is occupied where more than a third of the rays
that reach it end in it (GridConfig.p_hit and p_miss): from 0.43 sigma of the lidar before the surface on; 0.03 m at 3 m."""
_SMOOTH, _ONE_SIDE = 1.5, 0.1
"""Cells, smoothing of free space, and its slope per cell from which on it lies to one side; at a thick wall it is 0.27."""
MOST_CELLS = 4_000_000
"""Cells of the table of nearest walls (4 bytes each), or of their likelihood; a larger map gets coarser ones."""
ON_WALL, _FINE = 0.1, GridConfig().resolution
"""m; standard deviation of an end about the wall in cells of the second: cells, lidar noise and a pose that is not refined."""
STRANGE = 0.1
"""Likelihood of an end that lies on no wall, of one on a wall being 1: people, and things that were moved."""
ELSEWHERE = -0.35
"""Log-likelihood of a ray at the best place of a building that is not the map's: rooms are alike in part."""
INDEPENDENT_RAYS = 15.0
"""Rays per metre of driving that count as independent when places are compared."""
_LOOKS, _BEFORE = np.linspace(0.0, 1.0, 11)[1:], VisibilityPolicy.margin
"""Places along a ray, as shares of its length, at which it is tested for passing a wall, up to so far before its end, m: beyond
that it may be the wall on which the ray ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays(Table):
    """Thinned rays (p,) of a scan in the frame of the base."""

    ends: Floats
    """(p, 2) m; for a ray without a reading, the place up to which there is no wall."""
    origins: Floats
    """(p, 2) m, of the laser at each ray."""
    hit: Bools
    """Whether the ray ended on something."""

    def moved(self, pose: Floats) -> "Rays":
        """Return the rays in the frame in which the base has this pose (3,)."""
        return Rays(se2.transform(pose, self.ends), se2.transform(pose, self.origins), self.hit)

    def spread(self, count: int) -> "Rays":
        """Return at most so many rays, evenly spread."""
        return self.rows(evenly(len(self.hit), count))


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How scans agree with the map at poses (h,)."""

    log_likelihood: Floats
    """Of all rays, by which places of the map are compared; 0 = all agree with the map."""
    odds: Floats
    """Mean log-likelihood of the rays against rays elsewhere, times the share of the ends that lie in known space."""
    on_wall: Floats
    """Share of the rays' ends, 0..1, that lie on a wall, of those in known space."""
    known: Floats
    """Ends in known space."""


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Occupied cells with the lines through them, and the states of all cells."""

    geometry: GridGeometry
    states: NDArray[np.int8]
    """(rows, cols) FREE, OCCUPIED or UNKNOWN."""
    points: Floats
    """(n, 2) m, on the walls' lines; without any wall one that `nearest` does not name."""
    normals: Floats
    """(n, 2) unit, towards the free side; 0 where there is no line."""
    one_sided: Bools
    """(n,) the wall was seen from the side of its normal alone."""
    normal_variance: Floats
    """(n,) rad^2, of the normal's angle, by the scatter of the cells about the line and by their rounding."""
    cell: float
    """m; of the table of nearest walls."""
    origin: Floats
    """(2,) m, its lower left corner."""
    missing: float
    """Likelihood that a ray towards a wall comes back without a reading."""
    nearest: NDArray[np.signedinteger]
    """(x, y) nearest wall point of each of its cells, with a line or without one; -1 = none within reach."""

    def times(self, factor: float) -> "Walls":
        """Return the walls of a map that is so many times larger."""
        g = self.geometry
        geometry = replace(g, resolution=factor * g.resolution, origin=factor * g.origin)
        lengths = {name: factor * getattr(self, name) for name in ("points", "cell", "origin")}
        return replace(self, geometry=geometry, **lengths)

    @property
    def rounding(self) -> float:
        """m; by how much farther from the surface the cells of a coarse map lie than those of a fine one."""
        return float(np.sqrt(max(self.geometry.resolution**2 - _FINE**2, 0.0)))

    def state_at(self, x: Floats, y: Floats) -> NDArray[np.int8]:
        """Return the states (...) of the cells at places (...), m; UNKNOWN outside."""
        g = self.geometry
        return _looked_up(self.states, (y - g.origin[1]) / g.resolution, (x - g.origin[0]) / g.resolution)

    def nearest_at(self, x: Floats, y: Floats) -> NDArray[np.signedinteger]:
        """Return the nearest wall points (...) of places (...), m; -1 where none is within reach."""
        return _looked_up(self.nearest, (x - self.origin[0]) / self.cell, (y - self.origin[1]) / self.cell)

    def distances(self, x: Floats, y: Floats) -> Floats:
        """Return the distances (...) of places (...) to the nearest wall point, m; inf beyond reach."""
        near = self.nearest_at(x, y)
        q = self.points[near]
        return np.where(near >= 0, np.hypot(x - q[..., 0], y - q[..., 1]), np.inf)

    def factors(self, poses: Floats, rays: Rays, scale: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the quadratic form of the point-to-line distances about poses (h, 3).

        Parameters
        ----------
        scale : m, width of the Geman-McClure kernel on the distance.

        Returns
        -------
        hessian (h, 3, 3) : sum of w J^T J, J = (n, n . d(R p)/dtheta), as lidar.scan_matching.
        spurious (h, 3, 3) : the part of it by the scatter of the normals alone, see scan_matching.measured_part.
        gradient (h, 3) : sum of w J^T r. weight (h,) : sum of w.
        """
        ends = rays.ends[rays.hit]
        rx, ry = _turned(poses, ends)
        x, y = rx + poses[:, :1], ry + poses[:, 1:2]
        near = self.nearest_at(x, y)
        nx, ny = (self.normals[:, k].take(near) for k in (0, 1))
        dx, dy = x - self.points[:, 0].take(near), y - self.points[:, 1].take(near)
        ox, oy = _turned(poses, rays.origins[rays.hit] - ends)
        good = (near >= 0) & (nx * nx + ny * ny > 0.5)
        good &= (nx * ox + ny * oy > 0.0) | ~self.one_sided.take(near)
        r = nx * dx + ny * dy
        w = good / np.square(1.0 + np.square(r / scale))
        jacobian = np.stack([nx, ny, ny * rx - nx * ry], axis=1)
        weighted = jacobian * w[:, None]
        # The tangent (-ny, nx) replaces the normal.
        tangent = np.stack([-ny, nx, nx * rx + ny * ry], axis=1)
        spurious = (tangent * (w * self.normal_variance.take(near))[:, None]) @ tangent.transpose(0, 2, 1)
        return weighted @ jacobian.transpose(0, 2, 1), spurious, np.einsum("hkp,hp->hk", weighted, r), w.sum(axis=1)

    def agreement(self, poses: Floats, rays: Rays, independent: float) -> Agreement:
        """Return how rays (p,), p > 0, of which so many count as independent, agree with the map at poses (h, 3).

        An end on a wall counts log 1, one in free space log 0.1; a ray that passes a wall counts as if it ended in free space.
        Without a reading it has the likelihood of a missing return, to the power of a half: what is dark to one ray is dark to
        its neighbours. One that ends in unknown space is between the two; for the odds it is left out, and the others say so
        much less. Whatever rays meet a thing that was moved, or that the map lacks, they tell one thing: those that end in one
        square count together, and against a place no more than a thing that moves by itself (lidar.object_likelihood).
        """
        (x, y), (ox, oy) = (np.add(_turned(poses, p), poses.T[:2, :, None]) for p in (rays.ends, rays.origins))
        on_wall = np.exp(-0.5 * np.square(self.distances(x, y) / np.hypot(ON_WALL, self.rounding)))
        known = rays.hit & ((self.state_at(x, y) != UNKNOWN) | (on_wall >= 0.5))
        along, across = x - ox, y - oy
        t = _LOOKS[:, None, None] * np.maximum(1.0 - _BEFORE / np.maximum(np.hypot(along, across), _BEFORE), 0.0)
        passed = (self.state_at(ox + t * along, oy + t * across) == OCCUPIED).any(axis=0)
        ends = np.log(STRANGE + (1.0 - STRANGE) * np.where(passed, 0.0, on_wall))
        value = np.where(rays.hit, ends, np.where(passed, 0.5 * np.log(self.missing), 0.0))
        judged, count = known | passed | ~rays.hit, known.sum(axis=1)
        each = np.where(judged, value, 0.5 * np.log(STRANGE)) * (independent / len(rays.hit))
        likelihood = _by_things(each, rays.ends).sum(axis=1)
        fit = (value * judged).sum(axis=1) / np.maximum(judged.sum(axis=1), 1)
        share = (known & (on_wall >= 0.5)).sum(axis=1) / np.maximum(count, 1)
        odds = count / max(rays.hit.sum(), 1) * (fit - ELSEWHERE)
        return Agreement(likelihood, odds, share, count.astype(np.float64))


def _by_things(value: Floats, ends: Floats) -> Floats:
    """Return the log-likelihoods (h, o) of things by those of the rays (h, p) that meet them; ends (p, 2), m, of the rays."""
    _, thing = unique_rows(np.floor(ends / ObjectPolicy.long))
    order = np.argsort(thing, kind="stable")
    whole = np.add.reduceat(value[:, order], np.flatnonzero(np.diff(thing[order], prepend=-1)), axis=1)
    return np.logaddexp(np.log1p(-ObjectPolicy.moves) + whole, np.log(ObjectPolicy.moves))


def _turned(poses: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return x and y (h, p) of points (p, 2) turned by the headings of poses (h, 3)."""
    c, s = (v[:, None] for v in se2.cos_sin(poses[:, 2]))
    px, py = points.T
    return c * px - s * py, s * px + c * py


def _looked_up(table: NDArray[_Cell], i: Floats, j: Floats) -> NDArray[_Cell]:
    """Return the entries (...) of a table in the cells with these coordinates (...), -1 outside."""
    rows, cols = table.shape
    row, col = np.floor(i).astype(np.intp), np.floor(j).astype(np.intp)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return np.where(inside, table.reshape(-1).take(np.where(inside, row * cols + col, 0)), table.dtype.type(-1))


def walls_of(grid: OccupancyGrid) -> Walls:
    """Return the walls of a grid."""
    states, resolution = grid.states(), grid.geometry.resolution
    missing = float(np.clip(grid.missing_share, STRANGE, 1.0)) if np.isfinite(grid.missing_share) else STRANGE
    # Rays clear the cells in front of a wall and noise fills those behind: the mean of all cells lies 2 to 4 cm behind it.
    row, col = np.nonzero((states == OCCUPIED) & binary_dilation(states == FREE))
    if not len(row):
        none, nowhere, nothing = np.zeros(1), np.zeros((1, 2)), np.full((1, 1), -1)
        return Walls(grid.geometry, states, nowhere, nowhere, none > 0.0, none, 1.0, nowhere[0], missing, nothing)
    occupied = grid.geometry.centre_of(row, col)
    sides = _free_side(grid.geometry, states, occupied)
    lines = _lines(occupied, sides, resolution)
    normals = lines.normals * np.where((lines.normals * sides).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    one_sided = np.hypot(*sides.T) > 0.5
    points = lines.centers - _BEHIND * normals * one_sided[:, None]
    cell = max(resolution, float(np.sqrt(np.prod(np.ptp(occupied, axis=0) + 2.0 * REACH) / MOST_CELLS)))
    origin, nearest = _nearest(points, cell)
    return Walls(grid.geometry, states, points, normals, one_sided, lines.normal_variance, cell, origin, missing, nearest)


def _free_side(geometry: GridGeometry, states: NDArray[np.int8], points: Floats) -> Floats:
    """Return the direction (n, 2) in which free space lies from points (n, 2); 0 where it lies on either side alike."""
    free = (states == FREE).astype(np.float64)
    row, col = geometry.cell_of(points)
    slope = np.stack([gaussian_filter(free, _SMOOTH, order)[row, col] for order in ((0, 1), (1, 0))], axis=1)
    return slope / np.maximum(np.hypot(*slope.T), _ONE_SIDE)[:, None]


def _lines(points: Floats, sides: Floats, resolution: float) -> Lines:
    """Fit a line to each cell's neighbours on its own side of the wall, a thin one having two surfaces; resolution in m."""
    radius = max(_NORMAL_RADIUS, _LEAST_CELLS * resolution)
    pairs = make_tree(np.column_stack([points, radius * sides])).query_pairs(radius, output_type="ndarray")
    lines = estimate_normals(points, *np.ascontiguousarray(pairs.T))
    straight = lines.linearity >= _STRAIGHT
    normals = np.where(straight[:, None], lines.normals, 0.0)
    centers = np.where(straight[:, None], lines.centers, points)
    # A few cells in a row seem to have no scatter at all: that of their rounding is certain.
    scatter = resolution**2 * UNIFORM_VARIANCE
    rounded = scatter / np.maximum(lines.neighbours * lines.along, scatter)
    variance = np.where(straight, np.maximum(lines.normal_variance, rounded), 0.0)
    return replace(lines, centers=centers, normals=normals, normal_variance=variance)


def _nearest(points: Floats, cell: float) -> tuple[Floats, NDArray[np.int32]]:
    """Return the corner (2,) of a table around points (n, 2), m, and the nearest point of each of its cells (x, y)."""
    origin = points.min(axis=0) - REACH - cell
    wide, high = (np.ceil((points.max(axis=0) + REACH - origin) / cell).astype(int) + 1).tolist()
    holder = np.full((wide, high), -1, dtype=np.int32)
    holder[tuple(((points - origin) / cell).astype(np.intp).T)] = np.arange(len(points))
    distance, (x, y) = distance_transform_edt(holder < 0, sampling=cell, return_indices=True)
    return origin, np.where(distance <= REACH, holder[x, y], np.int32(-1))
