"""Where further anchors help most: dilution of precision over the free space of a map.

A range of standard deviation s from a point p to an anchor at a measures the position of p along u = (p - a) / |p - a|: it adds
u u^T / s^2 to the information about p. With I(p) the sum over the anchors and a weak prior,

    error(p) = sqrt(trace((I(p) + 1 / s_0^2)^-1)),

which for equal s is s times the horizontal dilution of precision (R. B. Langley, Dilution of Precision, GPS World 1999).
Anchors are chosen one by one so that the mean error over the free space falls most, then exchanged one by one while that
lowers it further (V. V. Fedorov, Theory of Optimal Experiments, 1972).
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from ..arrays import TINY, Bools, Floats, Ints
from ..errors import ConfigError
from ..grid.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from .line_of_sight import CELL, blocked

SIGMA_LINE_OF_SIGHT, SIGMA_BEHIND_WALLS = 0.1, 0.5
"""m; of a range in line of sight, and of one through walls, whose delay is not known."""
_PRIOR = 3.0
"""m; standard deviation of the position without ranges: it bounds the error where no anchor is in reach."""
_MOST_POINTS, _MOST_CANDIDATES = 1500, 400
"""Cells at which the error is evaluated, and places offered to anchors: the time goes with their product."""
_APART, _FROM_WALLS = 1.0, 0.5
"""m between anchors; from walls: nearer to metal and corners, reflections disturb the antenna (docs/driving.md)."""
_SWEEPS = 10
"""Most rounds of exchanges; two or three are usually enough."""


@dataclass(frozen=True, slots=True, eq=False)
class AnchorPlan:
    """Places for further anchors and the expected errors with them."""

    places: Floats
    """(n, 2) m, map frame, the most useful first."""
    points: Floats
    """(m, 2) m, places of the free space at which the error is given."""
    errors: Floats
    """(n + 1, m) m, expected error of a position: with today's anchors, with the first new one, ..."""


def plan_anchors(grid: OccupancyGrid, anchors: Floats, count: int, *, reach: float = 25.0) -> AnchorPlan:
    """Choose places for further anchors.

    Parameters
    ----------
    grid : the map; anchors are put into free space half a metre from walls, or anywhere in it where there is no such place.
    anchors : (a, 2) today's anchors, m.
    count : how many more.
    reach : m up to which a radio reaches.

    Raises
    ------
    ConfigError : the map has no free space, or too few places for so many anchors.
    """
    occupied, free, low, cell = _coarse(grid)
    points, candidates = _places(free, _MOST_POINTS), _wall_cells(occupied, free, cell)
    if len(points) == 0:
        raise ConfigError("the map has no free space to plan anchors for")
    candidates = candidates if len(candidates) >= count else _places(free, _MOST_CANDIDATES)

    def metres(cells: Ints) -> Floats:
        return low + cell * (cells[:, ::-1] + 0.5)

    at, offered, walls = metres(points), metres(candidates), metres(np.argwhere(occupied))
    today = _information(at, anchors, walls, reach).sum(axis=0)
    gains = _information(at, offered, walls, reach)
    chosen = _choose(today, gains, offered, _near(offered, anchors), count)
    errors = [position_errors(today + gains[chosen[:k]].sum(axis=0)) for k in range(count + 1)]
    return AnchorPlan(offered[chosen], at, np.array(errors))


def position_errors(information: Floats) -> Floats:
    """Return sqrt(trace(P)) (...), m, of information (..., 3) as xx, xy, yy, with the prior."""
    xx, xy, yy = np.moveaxis(information + np.array([1.0, 0.0, 1.0]) / _PRIOR**2, -1, 0)
    return np.asarray(np.sqrt((xx + yy) / (xx * yy - xy**2)))


def _information(points: Floats, anchors: Floats, walls: Floats, reach: float) -> Floats:
    """Return the information of a range to each anchor at each point (a, m, 3): xx, xy, yy, 1/m^2; walls are points (w, 2)."""
    away = points[None] - anchors[:, None]
    distance = np.maximum(np.hypot(away[..., 0], away[..., 1]), TINY)
    behind = [blocked(points, np.broadcast_to(anchor, points.shape), walls, least=1) for anchor in anchors]
    sigma = np.where(np.reshape(behind, distance.shape), SIGMA_BEHIND_WALLS, SIGMA_LINE_OF_SIGHT)
    weight = sigma**-2.0 * (distance <= reach)
    x, y = np.moveaxis(away / distance[..., None], -1, 0)
    return np.stack([x * x, x * y, y * y], axis=-1) * weight[..., None]


def _choose(today: Floats, gains: Floats, places: Floats, taken: Bools, count: int) -> Ints:
    """Return the indices of the chosen candidates, the most useful first."""
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(_best(today + gains[chosen].sum(axis=0), gains, taken | _near(places, places[chosen])))
    for _ in range(_SWEEPS):
        before = list(chosen)
        for k in range(count):
            others = chosen[:k] + chosen[k + 1 :]
            chosen[k] = _best(today + gains[others].sum(axis=0), gains, taken | _near(places, places[others]))
        if chosen == before:
            break
    ordered: list[int] = []
    while left := [k for k in chosen if k not in ordered]:
        base = today + gains[ordered].sum(axis=0)
        ordered.append(min(left, key=lambda k: float(position_errors(base + gains[k]).mean())))
    return np.array(ordered, dtype=np.intp)


def _best(base: Floats, gains: Floats, taken: Bools) -> int:
    """Return the candidate with which the mean error is least."""
    if taken.all():
        raise ConfigError(f"the map has no room for so many anchors {_APART:g} m apart; ask for fewer")
    means = np.array([np.inf if skip else position_errors(base + gain).mean() for gain, skip in zip(gains, taken, strict=True)])
    return int(np.argmin(means))


def _near(places: Floats, others: Floats) -> Bools:
    """Return which places (n, 2) are nearer to one of the others than anchors should be."""
    return np.asarray((np.linalg.norm(places[:, None] - others[None], axis=2) < _APART).any(axis=1))


def _coarse(grid: OccupancyGrid) -> tuple[Bools, Bools, Floats, float]:
    """Return which coarse cells are blocked and which are free (rows, cols), the lower left corner and the edge, m."""
    together = max(round(CELL / grid.geometry.resolution), 1)
    states = grid.states()
    rows, cols = (-(-n // together) * together for n in states.shape)
    padded = np.full((rows, cols), -1, dtype=states.dtype)
    padded[: states.shape[0], : states.shape[1]] = states
    blocks = padded.reshape(rows // together, together, cols // together, together)
    occupied = (blocks == OCCUPIED).any(axis=(1, -1))
    free = (blocks == FREE).mean(axis=(1, -1)) > 0.5
    return occupied, free & ~occupied, grid.geometry.origin, together * grid.geometry.resolution


def _places(cells: Bools, most: int) -> Ints:
    """Return row and column (n, 2) of cells, thinned evenly to at most so many."""
    found = np.argwhere(cells)
    return found[:: max(-(-len(found) // most), 1)]


def _wall_cells(occupied: Bools, free: Bools, cell: float) -> Ints:
    """Return the free cells (n, 2) of the first row that keeps away from blocked ones, thinned evenly."""
    away = cell * (np.asarray(distance_transform_edt(~occupied)) - 0.5) if occupied.any() else np.full(occupied.shape, np.inf)
    return _places(free & (away >= _FROM_WALLS) & (away < _FROM_WALLS + np.sqrt(2.0) * cell), _MOST_CANDIDATES)
