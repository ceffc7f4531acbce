"""Global search for the robot's pose: every pose of the map is tested with the last metres' ranges and scans.

Ranges first: a place that contradicts the measured distances at every heading of the robot is left out. At the remaining
places the scans of the last metres, combined by the odometry, are matched by branch and bound over a pyramid of the
walls' likelihood field, of which each level bounds the one below (W. Hess et al., Real-time loop closure in 2D lidar SLAM,
ICRA 2016); unlike there, all poses near the best score are kept, not the best alone: a place that looks like another one is
not decided here. Where no wall is visible, headings and places are tried by the ranges alone. What is found is refined and
compared by all measurements of the window.

The functions are generators that pause after every unit of work and yield its operations, those on one element of an array:
a caller that must keep pace with a lidar does a few units between two scans.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints
from .range_model import PER_RANGE, Ranges, range_likelihood, refined_by_ranges
from .verdict import FEW_BESIDE, FEW_ENDS
from .walls import Rays, Walls

CELL = 0.1
"""m; cell of the likelihood field."""
LEVELS = 3
"""Levels above the field; the coarsest has cells of 0.8 m."""
_SPREAD = 0.15
"""m; of a point about its wall: the cell, and 0.05 rad at 3 m."""
FARTHEST = 12.0
"""m; points farther away are not matched: 0.05 rad is there 0.6 m."""
_MOST_FIELD = 3_000_000
"""Cells of the field (one byte, four levels); a larger map gets coarser ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """The walls' likelihood, one byte a cell, and its maxima over squares of cells."""

    cell: float
    """m."""
    origin: Floats
    """(2,) lower left corner, m."""
    levels: tuple[NDArray[np.uint8], ...]
    """(rows, cols) each; level k holds the maximum over 2^k x 2^k cells to the upper right."""
    free: Bools
    """(rows, cols) cells in which a robot may stand."""
    margin: int
    """Cells around the map, so that points outside of it find a cell."""
    squares: Ints
    """(k, 2) row and column of the lowest cell of each of the coarsest squares in which a robot may stand."""


def field_of(walls: Walls) -> Field:
    """Return the likelihood field of walls."""
    g = walls.geometry
    size = np.array([g.cols, g.rows]) * g.resolution
    cell = max(CELL, float(np.sqrt((size[0] + 2 * FARTHEST) * (size[1] + 2 * FARTHEST) / _MOST_FIELD)))
    margin = int(np.ceil(FARTHEST / cell)) + 2 ** (LEVELS + 1)
    wide, high = (np.ceil(size / cell).astype(int) + 2 * margin).tolist()
    origin = g.origin - margin * cell
    x, y = origin[0] + (np.arange(wide) + 0.5) * cell, origin[1] + (np.arange(high) + 0.5) * cell
    likelihood, free = np.empty((high, wide), np.uint8), np.empty((high, wide), bool)
    for row in range(high):
        distance = np.minimum(walls.distances(x, np.full(wide, y[row])), 10.0)
        likelihood[row] = np.rint(255.0 * np.exp(-0.5 * np.square(distance / max(_SPREAD, cell))))
        free[row] = walls.state_at(x, np.full(wide, y[row])) == 0
    levels = [likelihood]
    for k in range(LEVELS):
        below, reach = levels[-1], 2**k
        wider = below.copy()
        wider[:, :-reach] = np.maximum(below[:, :-reach], below[:, reach:])
        higher = wider.copy()
        higher[:-reach] = np.maximum(wider[:-reach], wider[reach:])
        levels.append(higher)
    return Field(cell, origin, tuple(levels), free, margin, _squares(free))


def _squares(free: Bools) -> Ints:
    top = 2**LEVELS
    rows, cols = (n // top for n in free.shape)
    some = free[: rows * top, : cols * top].reshape(rows, top, cols, top).any(axis=(1, 3))
    return np.argwhere(some).astype(np.intp) * top


_HEADING = 0.05
"""rad; step of the heading."""
_POINTS = 72
"""Points of the scans that are matched."""
_MOST_NODES = 60_000
"""Most nodes of a level that are expanded; where more are equally good, the search is given up: too little was measured."""
_RIVAL = 0.75
"""Poses whose score is this share of the best one's are kept."""
MOST_PLACES = 32
"""Poses that are returned."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where the robot may be."""

    poses: Floats
    """(c, 3)."""
    complete: bool
    """No equally good place was left out."""


Steps = Generator[int, None, Places]
"""A running search; it yields the operations of every unit of work and returns its result."""
UNIT = 1_000_000
"""Operations of a unit of work at most: 1 to 2 ms on one core."""
_PER_POINT, _PER_PLACE = 3, 10
"""Operations for a point of a scan at a place, and for a range to a place."""


def units(count: int, each: int) -> Iterator[slice]:
    """Yield parts of so many items, of a unit of work at most, where an item takes so many operations."""
    step = max(1, UNIT // max(each, 1))
    return (slice(start, start + step) for start in range(0, count, step))


def places(field: Field | None, rays: Rays, ranges: Ranges, bounds: tuple[Floats, Floats]) -> Steps:
    """Search the map.

    Parameters
    ----------
    rays : of the last metres, in the present frame of the base. ranges : of the window.
    bounds : corners (2,) of the area in which the robot may be, m.

    Returns
    -------
    Poses that explain the measurements about as well as the best one, at most MOST_PLACES, the best first; refined by ranges
    where no scan measures more.
    """
    seen = np.zeros((0, 2)) if field is None else _thinned(rays)
    anchors, found = len(np.unique(ranges.anchor)), Places(np.zeros((0, 3)), True)
    if field is not None and len(seen) >= (FEW_ENDS if anchors < 3 else FEW_BESIDE):
        found = yield from _by_scans(field, seen, float(rays.hit.mean()), ranges)
        if len(seen) >= FEW_ENDS and (len(found.poses) or not len(ranges)):
            return found
    if anchors < 2:
        return Places(np.zeros((0, 3)), False)
    ranged = yield from _by_ranges(ranges, bounds)
    return Places(np.concatenate([found.poses, ranged.poses]), found.complete and ranged.complete)


def _thinned(rays: Rays) -> Floats:
    """Return points (p, 2) on walls, no two in one cell of the field, at most _POINTS of them."""
    near = rays.hit & (np.hypot(*rays.ends.T) < FARTHEST)
    points = rays.ends[near]
    _, first = np.unique(np.floor(points / (1.5 * CELL)).astype(np.intp), axis=0, return_index=True)
    chosen = np.sort(first)
    return points[chosen[np.unique(np.linspace(0, len(chosen) - 1, _POINTS).astype(np.intp))]] if len(chosen) else points[:0]


def _by_scans(field: Field, points: Floats, share: float, ranges: Ranges) -> Steps:
    """Match points (p, 2), of a share of all rays, by branch and bound where the ranges allow it."""
    top = 2**LEVELS
    rows, cols = field.squares.T
    centre = field.origin + (np.stack([cols, rows], axis=1) + 0.5 * top) * field.cell
    allowed = yield from _allowed(centre, 0.75 * top * field.cell, ranges)
    rows, cols = rows[allowed], cols[allowed]
    headings = np.arange(0.0, 2.0 * np.pi - 0.5 * _HEADING, _HEADING)
    if not len(rows):
        return Places(np.zeros((0, 3)), False)
    offsets = _offsets(field, points, headings)
    yield _PER_PLACE * offsets.size
    nodes = yield from _top_nodes(len(headings), rows, cols)
    complete, least = True, 0.0
    scores = yield from _scored(field, LEVELS, offsets, nodes)
    for level in range(LEVELS, 0, -1):
        best, found = yield from _dive(field, level, offsets, nodes, scores)
        least = max(least, _RIVAL * found.max(initial=0.0))
        kept = np.flatnonzero(scores >= least)
        if len(kept) > _MOST_NODES:
            complete, nodes, scores = False, best, found
            break
        nodes = _children(nodes[kept], 2 ** (level - 1))
        yield from _pause(len(nodes))
        scores = yield from _scored(field, level - 1, offsets, nodes)
    kept = np.flatnonzero(scores >= max(least, _RIVAL * scores.max(initial=0.0)))
    yield from _pause(len(scores))
    kept = kept[np.argsort(-scores[kept], kind="stable")]
    yield from _pause(len(kept))
    poses = np.column_stack([field.origin + (nodes[kept, :0:-1] + 0.5) * field.cell, se2.wrap_angle(headings[nodes[kept, 0]])])
    inside = field.free[nodes[kept, 1], nodes[kept, 2]]
    yield from _pause(len(kept))
    if not len(ranges):
        return (yield from _distinct(poses[inside], complete))
    return (yield from _likeliest(poses[inside], share * scores[kept[inside]], ranges, complete))


def _likeliest(poses: Floats, scores: Floats, ranges: Ranges, complete: bool) -> Steps:
    """Return the best of poses (n, 3) by their scores (n,), in whose order they are, and by the ranges together.

    Ranges distinguish places along a wall, which scans do not.
    """
    tried, few = poses[:_MOST_RIVALS], _some(ranges)
    weight = _PER_SCORE * scores[: len(tried)]
    for part in units(len(tried), PER_RANGE * len(few)):
        weight[part] += range_likelihood(tried[part], few, wider=0.5 * CELL)
        yield PER_RANGE * len(few) * len(tried[part])
    order = np.argsort(-weight, kind="stable")
    order = order[weight[order] >= weight[order[:1]] - _RANGE_RIVAL]
    return (yield from _distinct(tried[order], complete and len(tried) == len(poses)))


def _top_nodes(headings: int, rows: Ints, cols: Ints) -> Generator[int, None, NDArray[np.int32]]:
    """Return every heading with every square of the coarsest level, as nodes (n, 3): heading, row, column."""
    nodes = np.empty((headings, len(rows), 3), dtype=np.int32)
    at_once = max(1, _MANY // len(rows))
    for start in range(0, headings, at_once):
        part = nodes[start : start + at_once]
        part[..., 0] = np.arange(start, start + len(part))[:, None]
        part[..., 1], part[..., 2] = rows, cols
        yield from _pause(part.size)
    return nodes.reshape(-1, 3)


def _offsets(field: Field, points: Floats, headings: Floats) -> Ints:
    """Return by how many cells of the flat field (h, p) each point lies from the robot's cell."""
    laid = se2.rotate(headings[:, None], points[None])
    cells = np.rint(laid / field.cell).astype(np.intp)
    return cells[..., 1] * field.free.shape[1] + cells[..., 0]


def _scored(field: Field, level: int, offsets: Ints, nodes: NDArray[np.int32]) -> Generator[int, None, Floats]:
    """Return the bounds (n,) of nodes: mean likelihood of the points, 0..1."""
    flat, wide = field.levels[level].reshape(-1), field.free.shape[1]
    scores = np.empty(len(nodes))
    for part in units(len(nodes), _PER_POINT * offsets.shape[1]):
        heading, row, col = nodes[part].T.astype(np.intp)
        values = flat.take(offsets[heading] + (row * wide + col)[:, None], mode="clip")
        scores[part] = values.sum(axis=1, dtype=np.intp) / (255.0 * offsets.shape[1])
        yield _PER_POINT * values.size
    return scores


def _dive(
    field: Field, level: int, offsets: Ints, nodes: NDArray[np.int32], scores: Floats
) -> Generator[int, None, tuple[NDArray[np.int32], Floats]]:
    """Return good poses as nodes (n, 3), found by following the best ones down, and their scores (n,): the highest is a lower
    bound of the best pose's.
    """
    best, found = nodes[_highest(scores)], np.zeros(0)
    yield from _pause(len(scores))
    for below in range(level - 1, -1, -1):
        best = _children(best, 2**below)
        found = yield from _scored(field, below, offsets, best)
        order = _highest(found)
        best, found = best[order], found[order]
    return best, found


def _pause(count: int) -> Generator[int, None, None]:
    """Pause after work on so many nodes or poses, if that was a unit of work by itself."""
    if count > _MANY:
        yield count


_MANY = 20_000
"""Nodes or poses that take a millisecond or so to make, to compare or to sort."""


def _highest(scores: Floats, count: int = 64) -> Ints:
    """Return the indices of the highest scores, the first of equal ones, best first; without sorting them all."""
    least = np.partition(scores, -count)[-count] if len(scores) > count else -np.inf
    some = np.flatnonzero(scores >= least)
    return some[np.argsort(-scores[some], kind="stable")[:count]]


def _children(nodes: NDArray[np.int32], half: int) -> NDArray[np.int32]:
    """Return the four quarters of each node."""
    shift = np.array([[0, 0, 0], [0, 0, half], [0, half, 0], [0, half, half]], dtype=np.int32)
    return (nodes[:, None] + shift).reshape(-1, 3)


def _allowed(centre: Floats, half: float, ranges: Ranges) -> Generator[int, None, Bools]:
    """Return where (n,) the robot may be by its ranges alone, for any heading, within a half width of a place, m.

    The tag was within |t| of its present place: a range disagrees if it is off by more than that, the cell and four sigmas.
    NLOS makes ranges long: a place too near an anchor counts as half a disagreement. The best places and those with little more
    are kept.
    """
    if not len(ranges) or not len(centre):
        return np.ones(len(centre), bool)
    cost, moved = np.zeros(len(centre)), np.hypot(*ranges.tags.T)
    for part in units(len(ranges), _PER_PLACE * len(centre)):
        some = ranges.rows(np.arange(len(ranges))[part])
        for place, value, way, sigma in zip(some.places, some.values, moved[part], some.sigma, strict=True):
            x, y = (centre - place).T
            off = value - np.sqrt(x * x + y * y)
            beyond = np.abs(off) - way - 1.5 * half - 4.0 * sigma
            # A range that is one metre off counts like one that is ten metres off.
            cost += np.clip(beyond, 0.0, 1.0) * np.where(off > 0.0, 0.5, 1.0)
        yield _PER_PLACE * len(some) * len(centre)
    return np.asarray(cost <= cost.min() + 0.1 * len(ranges))


def _by_ranges(ranges: Ranges, bounds: tuple[Floats, Floats]) -> Steps:
    """Try places and headings by the ranges alone."""
    step = max(0.4, float(np.sqrt(np.prod(bounds[1] - bounds[0]) / 20_000)))
    axes = [np.arange(bounds[0][k], bounds[1][k] + step, step) for k in (0, 1)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = cells[(yield from _allowed(cells, 0.75 * step, ranges))]
    headings = np.arange(0.0, 2.0 * np.pi - 0.05, 0.2)
    if len(cells) * len(headings) > _MOST_NODES:
        return Places(np.zeros((0, 3)), False)
    poses = np.column_stack([np.repeat(cells, len(headings), axis=0), np.tile(headings, len(cells))])
    few, cost = _some(ranges), np.empty(len(poses))
    for part in units(len(poses), PER_RANGE * len(few)):
        cost[part] = -range_likelihood(poses[part], few, wider=0.6 * step)
        yield PER_RANGE * len(few) * len(cost[part])
    order = np.flatnonzero(cost <= cost.min(initial=np.inf) + _RANGE_RIVAL)
    order = order[np.argsort(cost[order], kind="stable")]
    tried = (yield from _distinct(poses[order[:_MOST_RIVALS]], True)).poses
    for part in units(len(tried), _PER_REFINED * len(ranges)):
        tried[part] = refined_by_ranges(tried[part], ranges)
        yield _PER_REFINED * len(tried[part]) * len(ranges)
    return (yield from _distinct(tried, 0 < len(order) <= _MOST_RIVALS))


def _some(ranges: Ranges) -> Ranges:
    """Return forty of the ranges, for the time that all would take."""
    return ranges.rows(np.unique(np.linspace(0, len(ranges) - 1, 40).astype(np.intp)))


_PER_SCORE = 30.0
"""Log-likelihood by which a score of 1 is better than one of 0: of fifteen rays, each about ten times likelier on a wall."""
_MOST_RIVALS = 4096
"""Poses that may be as good before the search is not complete."""
_PER_REFINED = 8 * 60
"""Operations for a range in eight iterations of a refinement."""
_RANGE_RIVAL = 12.0
"""Log-likelihood by which a place may be worse than the best one before it is refined."""


def _distinct(poses: Floats, complete: bool) -> Steps:
    """Return the first of poses (n, 3), best first, that are not near an earlier one."""
    kept, done = np.zeros((0, 3)), 0
    left = poses
    while len(left) and len(kept) < MOST_PLACES:
        kept = np.concatenate([kept, left[:1]])
        done += len(left)
        x, y, turn = (left - left[0]).T
        left = left[(np.hypot(x, y) > _SAME[0]) | (np.abs(se2.wrap_angle(turn)) > _SAME[1])]
        if done > _MANY:
            yield _PER_PLACE * done
            done = 0
    return Places(kept, complete and not len(left))


_SAME = (0.4, 0.2)
"""m and rad; poses that are closer are one place, closer than hypotheses.apart: they are not refined yet."""
