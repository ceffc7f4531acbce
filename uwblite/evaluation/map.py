"""How far a map is from the truth: distances between named columns (the paper's Table I), which need no alignment of frames,
and how well its cells lie on the walls."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, dots
from ..grid.columns import find_column

REACH = 4.0
"""Distance up to which a column or a wall counts as visible, m: the reach of a URG-04LX."""
_OBSERVATIONS = 200
"""Used of each column, evenly spread over the path."""
_STEP, _APART = 0.05, 0.5
"""m between samples on true surfaces, a cell of the map; and between viewpoints, which then differ in direction."""
_VIEWS = 24
"""Nearest viewpoints tried for each point of a surface."""
_SHORT = 0.02
"""m by which a ray stops short of the surface, which otherwise would hide itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Named round columns."""

    names: tuple[str, ...]
    positions: Floats
    """(n, 2) m; nan where a column was not found."""
    radii: Floats
    """(n,) m."""


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkErrors:
    """Distances between columns in the map against the true ones."""

    pairs: tuple[tuple[str, str], ...]
    """Pairs whose columns were both found."""
    true_distances: Floats
    """(p,) m."""
    distances: Floats
    """(p,) m, in the map."""
    errors: Floats
    """(p,) m, absolute error of each distance."""
    mean: float
    """Mean absolute error, m: the paper's figure; nan where no pair was found."""
    missing: tuple[str, ...]
    """Columns that were not found in the map."""


@dataclass(frozen=True, slots=True, eq=False)
class WallErrors:
    """Occupied cells against the true surfaces."""

    tolerance: float
    """m."""
    precision: float
    """Share of the occupied cells that lie within the tolerance of a true surface."""
    recall: float
    """Share of the visible true surface that has an occupied cell within the tolerance."""


def find_columns(occupied: Floats, expected: Landmarks, *, search_radius: float = 1.0, cell: float = 0.05) -> Landmarks:
    """Return where the columns stand in a map.

    Parameters
    ----------
    occupied : (n, 2) m, centres of the occupied cells, in the frame of the expected places.
    expected : where the columns should be, and their radii.
    search_radius : m; limited to 0.45 of the distance to the nearest other column, so that columns are not confused.
    cell : m, size of a cell.
    """
    gaps = np.hypot(*(expected.positions[:, None] - expected.positions[None]).transpose(2, 0, 1))
    np.fill_diagonal(gaps, np.inf)
    reach = np.minimum(search_radius, 0.45 * gaps.min(axis=1, initial=np.inf))
    rows = zip(expected.positions, expected.radii, reach, strict=True)
    places = [find_column(occupied, place, radius, limit, cell) for place, radius, limit in rows]
    return Landmarks(expected.names, np.array(places).reshape(-1, 2), expected.radii)


def landmark_errors(columns: Landmarks, truth: Landmarks, pairs: tuple[tuple[str, str], ...] | None = None) -> LandmarkErrors:
    """Compare distances between columns found in a map with the true ones; `pairs` of names, None = all pairs."""
    place = dict(zip(columns.names, columns.positions, strict=True))
    missing = tuple(name for name in truth.names if name not in place or not np.isfinite(place[name]).all())
    observations = {name: place[name][None] for name in truth.names if name not in missing}
    return _distance_errors(observations, truth, pairs, missing)


def landmark_errors_along(
    truth: Landmarks, true_poses: Floats, poses: Floats, pairs: tuple[tuple[str, str], ...] | None = None
) -> LandmarkErrors:
    """Compare distances between columns as a trajectory would draw them with the true ones.

    Every observation draws a column once more. The error of a pair is the mean over all combinations of an observation of one
    with an observation of the other: it also judges a map too smeared to find a column in it.

    Parameters
    ----------
    truth : true columns, frame of the truth.
    true_poses, poses : (n, 3) T_truth_base and T_map_base at the same stamps.
    pairs : names; None = all pairs.
    """
    observations = {}
    for name, place in zip(truth.names, truth.positions, strict=True):
        from_base = se2.transform(se2.inverse(true_poses), place)
        seen = np.flatnonzero(np.hypot(*from_base.T) <= REACH)
        seen = seen[np.unique(np.linspace(0, len(seen) - 1, min(_OBSERVATIONS, len(seen))).astype(np.intp))]
        if len(seen):
            observations[name] = se2.transform(poses[seen], from_base[seen])
    return _distance_errors(observations, truth, pairs, tuple(name for name in truth.names if name not in observations))


def _distance_errors(
    observations: dict[str, Floats], truth: Landmarks, pairs: tuple[tuple[str, str], ...] | None, missing: tuple[str, ...]
) -> LandmarkErrors:
    if pairs is None:
        pairs = tuple((a, b) for i, a in enumerate(truth.names) for b in truth.names[i + 1 :])
    judged = tuple((a, b) for a, b in pairs if a in observations and b in observations)
    true_place = dict(zip(truth.names, truth.positions, strict=True))
    true_distances = np.array([np.hypot(*(true_place[a] - true_place[b])) for a, b in judged])
    measured = [np.hypot(*(observations[a][:, None] - observations[b][None]).transpose(2, 0, 1)) for a, b in judged]
    errors = np.array([np.mean(np.abs(d - t)) for d, t in zip(measured, true_distances, strict=True)])
    distances = np.array([np.mean(d) for d in measured])
    mean = float(np.mean(errors)) if judged else float("nan")
    return LandmarkErrors(judged, true_distances, distances, errors, mean, missing)


def wall_errors(
    occupied: Floats, walls: Floats, columns: Floats, viewpoints: Floats, *, tolerance: float = 0.10, reach: float = REACH
) -> WallErrors:
    """Compare occupied cells with the true surfaces.

    Parameters
    ----------
    occupied : (n, 2) m, centres of the occupied cells, frame of the truth.
    walls : (w, 4) m, x1, y1, x2, y2 of straight surfaces.
    columns : (c, 3) m, x, y, radius of round ones.
    viewpoints : (v, 2) m, the true path; only surface that can be seen from it within `reach` m counts for the recall.
    tolerance : m.
    """
    surface = sample_surfaces(walls, columns, _STEP)
    if not len(occupied) or not len(surface):
        return WallErrors(tolerance, 0.0, 0.0)
    distance = cKDTree(surface).query(occupied)[0]
    visible = surface[visible_from(surface, walls, columns, viewpoints, reach)]
    covered = cKDTree(occupied).query(visible)[0] <= tolerance if len(visible) else np.zeros(1, dtype=bool)
    return WallErrors(tolerance, float(np.mean(distance <= tolerance)), float(np.mean(covered)))


def sample_surfaces(walls: Floats, columns: Floats, step: float) -> Floats:
    """Return points (n, 2), m, on walls (w, 4) and around columns (c, 3), about `step` m apart."""
    points = [np.empty((0, 2))]
    for x1, y1, x2, y2 in walls:
        n = max(1, round(float(np.hypot(x2 - x1, y2 - y1)) / step))
        u = (np.arange(n) + 0.5) / n
        points.append(np.stack([x1 + u * (x2 - x1), y1 + u * (y2 - y1)], axis=1))
    for x, y, radius in columns:
        n = max(8, round(2.0 * np.pi * radius / step))
        angle = 2.0 * np.pi * np.arange(n) / n
        points.append(np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1))
    return np.concatenate(points)


def visible_from(points: Floats, walls: Floats, columns: Floats, viewpoints: Floats, reach: float) -> Bools:
    """Return which points (n,) on surfaces one of the nearest viewpoints (v, 2) sees, m; surfaces hide one another."""
    if not len(viewpoints):
        return np.zeros(len(points), dtype=bool)
    coarse = viewpoints[np.unique(np.round(viewpoints / _APART).astype(np.intp), axis=0, return_index=True)[1]]
    count = min(_VIEWS, len(coarse))
    distance, view = cKDTree(coarse).query(points, k=count, distance_upper_bound=reach)
    point, rank = np.nonzero(np.isfinite(np.atleast_2d(distance.reshape(len(points), count))))
    start = coarse[view.reshape(len(points), count)[point, rank]]
    gap = points[point] - start
    end = start + gap * (1.0 - _SHORT / np.maximum(np.hypot(*gap.T), 2.0 * _SHORT))[:, None]
    free = ~_blocked(start, end, walls, columns)
    seen = np.zeros(len(points), dtype=bool)
    seen[point[free]] = True
    return seen


def _blocked(start: Floats, end: Floats, walls: Floats, columns: Floats) -> Bools:
    """Return which of the straight lines (n,) from start (n, 2) to end (n, 2) cross a wall or a column."""
    way = end - start
    blocked = np.zeros(len(start), dtype=bool)
    for x1, y1, x2, y2 in walls:
        first, last = np.array([x1, y1]), np.array([x2, y2])
        sides = _cross(last - first, start - first) * _cross(last - first, end - first)
        blocked |= (sides < 0.0) & (_cross(way, first - start) * _cross(way, last - start) < 0.0)
    length2 = np.maximum(dots(way, way), 1e-12)
    for x, y, radius in columns:
        u = np.clip(dots([x, y] - start, way) / length2, 0.0, 1.0)
        blocked |= np.hypot(*(start + u[:, None] * way - [x, y]).T) < radius - _SHORT
    return blocked


def _cross(one: Floats, other: Floats) -> Floats:
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
