"""How far a map is from the truth: distances between named columns (the paper's Table I), which need no alignment of frames."""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Floats, evenly
from ..grid.columns import find_column

REACH = 4.0
"""Distance up to which a column counts as visible, m: the reach of a URG-04LX."""
_OBSERVATIONS = 200
"""Used of each column, evenly spread over the path."""


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
        seen = seen[evenly(len(seen), _OBSERVATIONS)]
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
