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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Bools, Floats, Ints, chunks, evenly
from ..grid.occupancy_grid import FREE
from .hypotheses import MATCHES, SAME, apart, refined
from .range_model import FEW, PER_RANGE, Ranges, range_likelihood
from .verdict import CERTAIN, FEW_BESIDE, FEW_ENDS, SURE
from .walls import INDEPENDENT_RAYS, MOST_CELLS, ON_WALL, STRANGE, Rays, Walls

CELL = 0.1
"""m; cell of the likelihood field."""
LEVELS = 3
"""Levels above the field; the coarsest has cells of 0.8 m."""
_SPREAD = float(np.hypot(ON_WALL, CELL))
"""m; of a point about its wall: as everywhere, and within its cell."""
FARTHEST = 12.0
"""m; points farther away are not matched: 0.05 rad is there 0.6 m."""
_HEADINGS = 126
"""Headings that are tried, 0.05 rad apart."""
_POINTS = 72
"""Points of the scans that are matched, no two in one square of that spread."""
_MOST_NODES = 60_000
"""Most nodes of a level that are expanded, and most squares, and poses, that are tried by ranges; where more are equally good,
the search is given up: too little was measured."""
_RIVAL = 0.75
"""Poses whose score is this share of the best one's are kept."""
_MOST_RIVALS = 4096
"""Poses that may be as good before the search is not complete."""
MOST_PLACES = 32
"""Poses that are returned; twice as many nodes are followed down for a lower bound of the best pose's score."""
_GROSS = 0.1
"""m by which ranges may be off on average beyond the best place's."""
UNIT = 1_000_000
"""Operations of a unit of work at most: 1 to 2 ms on one core."""
_PER_POINT, _PER_PLACE, _PER_REFINED = 3, 10, 60 * MATCHES
"""Operations for a point of a scan at a place, for a range to a place, and for a range in a refinement."""
_PER_LOOK = UNIT // MOST_PLACES
"""Operations in whose time the places near one are looked up: of as many as are returned in a unit of work."""


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

    def centres(self, cells: NDArray[np.signedinteger], size: int = 1) -> Floats:
        """Return the centres (n, 2) of squares, m, by row and column (n, 2) of their lowest cells."""
        return np.asarray(self.origin + (cells[:, ::-1] + 0.5 * size) * self.cell)


def field_of(walls: Walls) -> Field:
    """Return the likelihood field of walls."""
    g, top = walls.geometry, 2**LEVELS
    size = np.array([g.cols, g.rows]) * g.resolution
    cell = max(CELL, float(np.sqrt(np.prod(size + 2 * FARTHEST) / MOST_CELLS)))
    margin = int(np.ceil(FARTHEST / cell)) + 2 * top
    wide, high = (np.ceil(size / cell).astype(int) + 2 * margin).tolist()
    origin = g.origin - margin * cell
    x, y = origin[0] + (np.arange(wide) + 0.5) * cell, origin[1] + (np.arange(high) + 0.5) * cell
    likelihood, free = np.empty((high, wide), np.uint8), np.empty((high, wide), bool)
    for row in range(high):
        distance = walls.distances(x, np.full(wide, y[row]))
        likelihood[row] = np.rint(_WHOLE * np.exp(-0.5 * np.square(distance / max(_SPREAD, cell))))
        free[row] = walls.state_at(x, np.full(wide, y[row])) == FREE
    above = [maximum_filter(likelihood, 2**k, origin=-(2 ** (k - 1)), mode="nearest") for k in range(1, LEVELS + 1)]
    rows, cols = (n // top for n in free.shape)
    some = free[: rows * top, : cols * top].reshape(rows, top, cols, top).any(axis=(1, -1))
    return Field(cell, origin, (likelihood, *above), free, margin, np.argwhere(some).astype(np.intp) * top)


_WHOLE = float(np.iinfo(np.uint8).max)
"""Likelihood of a cell in which a wall is."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where the robot may be."""

    poses: Floats
    """(c, 3)."""
    complete: bool
    """No equally good place was left out."""


Steps = Generator[int, None, Places]
"""A running search; it yields the operations of every unit of work and returns its result."""
_UNDECIDED = Places(np.zeros((0, *se2.POSE)), False)


def units(count: int, each: int) -> Iterator[slice]:
    """Yield parts of so many items, of a unit of work at most, where an item takes so many operations."""
    return chunks(count, max(1, UNIT // max(each, 1)))


def places(field: Field | None, rays: Rays, ranges: Ranges, bounds: tuple[Floats, Floats]) -> Steps:
    """Search the map; return poses that explain the measurements about as well as the best one, the best first.

    Parameters
    ----------
    rays : of the last metres, in the present frame of the base. ranges : of the window.
    bounds : corners (2,) of the area in which the robot may be, m.
    """
    seen = np.zeros((0, 2)) if field is None else _thinned(rays)
    anchors, found = len(np.unique(ranges.anchor)), replace(_UNDECIDED, complete=True)
    if field is not None and len(seen) >= (FEW_BESIDE if anchors > 2 else FEW_ENDS):
        found = yield from _by_scans(field, seen, float(rays.hit.mean()), ranges)
        if len(seen) >= FEW_ENDS and (len(found.poses) or not len(ranges)):
            return found
    if anchors < 2:
        return _UNDECIDED
    ranged = yield from _by_ranges(ranges, bounds)
    return Places(np.concatenate([found.poses, ranged.poses]), found.complete and ranged.complete)


def _thinned(rays: Rays) -> Floats:
    """Return points (p, 2) on walls, at most _POINTS of them."""
    points = rays.ends[rays.hit & (np.hypot(*rays.ends.T) < FARTHEST)]
    _, first = np.unique(np.floor(points / _SPREAD).astype(np.intp), axis=0, return_index=True)
    chosen = np.sort(first)
    return points[chosen[evenly(len(chosen), _POINTS)]]


def _by_scans(field: Field, points: Floats, share: float, ranges: Ranges) -> Steps:
    """Match points (p, 2), of a share of all rays, by branch and bound where the ranges allow it."""
    top = 2**LEVELS
    squares = field.squares[(yield from _allowed(field.centres(field.squares, top), top * field.cell, ranges))]
    if not len(squares):
        return _UNDECIDED
    headings = np.linspace(0.0, 2.0 * np.pi, _HEADINGS, endpoint=False)
    offsets = _offsets(field, points, headings)
    yield _PER_PLACE * offsets.size
    turns, every = np.arange(_HEADINGS), []
    for part in units(_HEADINGS, squares.size):
        few = np.repeat(turns[part], len(squares))
        every.append(np.column_stack([few, np.tile(squares, (len(turns[part]), 1))]).astype(np.int32))
        yield every[-1].size
    nodes, complete, least = np.concatenate(every), True, 0.0
    scores = yield from _scored(field, LEVELS, offsets, nodes)
    for level in range(LEVELS, 0, -1):
        best, found = yield from _dive(field, level, offsets, nodes, scores)
        least = max(least, _RIVAL * found.max(initial=0.0))
        kept = np.flatnonzero(scores >= least)
        if len(kept) > _MOST_NODES:
            complete, nodes, scores = False, best, found
            break
        nodes = _children(nodes[kept], level - 1)
        yield nodes.size
        scores = yield from _scored(field, level - 1, offsets, nodes)
    kept = np.flatnonzero(scores >= max(least, _RIVAL * scores.max(initial=0.0)))
    kept = kept[field.free[nodes[kept, 1], nodes[kept, 2]]]
    yield len(scores)
    kept = kept[np.argsort(-scores[kept], kind="stable")]
    yield nodes[kept].size
    poses = np.column_stack([field.centres(nodes[kept, 1:]), se2.wrap_angle(headings[nodes[kept, 0]])])
    if not len(ranges):
        return (yield from _distinct(poses, MOST_PLACES, complete))
    return (yield from _likeliest(poses, share * scores[kept], ranges, complete))


def _likeliest(poses: Floats, scores: Floats, ranges: Ranges, complete: bool) -> Steps:
    """Return the best of poses (n, 3) by scores (n,), in whose order they are, and by the ranges together.

    Ranges distinguish places along a wall, which scans do not.
    """
    tried = poses[:_MOST_RIVALS]
    # As many rays, each likelier on a wall than beside it, as count as independent.
    scans = -INDEPENDENT_RAYS * np.log(STRANGE) * scores[: len(tried)]
    tried = yield from _likely(tried, ranges, 0.5 * CELL, scans)
    return (yield from _distinct(tried, MOST_PLACES, complete and len(poses) <= _MOST_RIVALS))


def _likely(poses: Floats, ranges: Ranges, wider: float, scans: Floats | float = 0.0) -> Generator[int, None, Floats]:
    """Return the likely ones of poses (n, 3), the likeliest first, by some of the ranges and by scans (n,).

    Of poses of a grid every sigma of a range is wider, see range_likelihood.
    """
    few, weight = ranges.rows(evenly(len(ranges), FEW)), np.zeros(len(poses)) + scans
    for part in units(len(poses), PER_RANGE * len(few)):
        weight[part] += range_likelihood(poses[part], few, wider)
        yield PER_RANGE * len(few) * len(poses[part])
    order = np.argsort(-weight, kind="stable")
    return poses[order[weight[order] >= weight[order[:1]] - 2.0 * CERTAIN]]


def _offsets(field: Field, points: Floats, headings: Floats) -> Ints:
    """Return by how many cells of the flat field (h, p) each point lies from the robot's cell."""
    cells = np.rint(se2.rotate(headings[:, None], points[None]) / field.cell).astype(np.intp)
    return cells[..., 1] * field.free.shape[1] + cells[..., 0]


def _scored(field: Field, level: int, offsets: Ints, nodes: NDArray[np.int32]) -> Generator[int, None, Floats]:
    """Return the bounds (n,) of nodes (n, 3), heading, row, column: mean likelihood of the points, 0..1."""
    flat, wide = field.levels[level].reshape(-1), field.free.shape[1]
    scores = np.empty(len(nodes))
    for part in units(len(nodes), _PER_POINT * offsets.shape[1]):
        heading, row, col = nodes[part].T.astype(np.intp)
        values = flat.take(offsets[heading] + (row * wide + col)[:, None], mode="clip")
        scores[part] = values.sum(axis=1, dtype=np.intp) / (_WHOLE * offsets.shape[1])
        yield _PER_POINT * values.size
    return scores


def _dive(
    field: Field, level: int, offsets: Ints, nodes: NDArray[np.int32], scores: Floats
) -> Generator[int, None, tuple[NDArray[np.int32], Floats]]:
    """Return good poses as nodes (n, 3), found by following the best ones down, and their scores (n,)."""
    best, found = nodes[_highest(scores)], np.zeros(0)
    yield len(scores)
    for below in range(level - 1, -1, -1):
        best = _children(best, below)
        found = yield from _scored(field, below, offsets, best)
        order = _highest(found)
        best, found = best[order], found[order]
    return best, found


def _highest(scores: Floats) -> Ints:
    """Return the indices of the highest scores, the first of equal ones, best first; without sorting them all."""
    many = 2 * MOST_PLACES
    least = np.partition(scores, -many)[-many] if len(scores) > many else -np.inf
    some = np.flatnonzero(scores >= least)
    return some[np.argsort(-scores[some], kind="stable")[:many]]


def _children(nodes: NDArray[np.int32], level: int) -> NDArray[np.int32]:
    """Return the four quarters, of a level, of each node."""
    quarters = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1]], dtype=np.int32)
    return np.asarray((nodes[:, None] + quarters * 2**level).reshape(-1, quarters.shape[1]))


def _allowed(centres: Floats, size: float, ranges: Ranges) -> Generator[int, None, Bools]:
    """Return in which squares (n,) of a size, m, the robot may be by its ranges alone, for any heading.

    The tag was within |t| of its present place: a range disagrees if it is off by more than that, half the diagonal and four
    sigmas. NLOS makes ranges long: a place too near an anchor counts as half a disagreement.
    """
    if not len(ranges) or not len(centres):
        return np.ones(len(centres), bool)
    cost = np.zeros(len(centres))
    slack = np.hypot(*ranges.tags.T) + np.sqrt(0.5) * size + SURE * ranges.sigma
    for part in units(len(ranges), _PER_PLACE * len(centres)):
        for place, value, most in zip(ranges.places[part], ranges.values[part], slack[part], strict=True):
            off = value - np.hypot(*(centres - place).T)
            # A range that is one metre off counts like one that is ten metres off.
            cost += np.clip(np.abs(off) - most, 0.0, 1.0) * np.where(off > 0.0, 0.5, 1.0)
        yield _PER_PLACE * len(slack[part]) * len(centres)
    return np.asarray(cost <= cost.min() + _GROSS * len(ranges))


def _by_ranges(ranges: Ranges, bounds: tuple[Floats, Floats]) -> Steps:
    """Try places and headings by the ranges alone."""
    headings = np.arange(0.0, 2.0 * np.pi, SAME[1])
    step = max(SAME[0], float(np.sqrt(np.prod(bounds[1] - bounds[0]) / _MOST_NODES)))
    axes = [np.arange(low, high + step, step) for low, high in zip(*bounds, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = cells[(yield from _allowed(cells, step, ranges))]
    if len(cells) * len(headings) > _MOST_NODES:
        return _UNDECIDED
    poses = np.column_stack([np.repeat(cells, len(headings), axis=0), np.tile(headings, len(cells))])
    likely = yield from _likely(poses, ranges, np.sqrt(0.5) * step)
    found, few = (yield from _distinct(likely, _MOST_RIVALS, True)), ranges.rows(evenly(len(ranges), FEW))
    tried = found.poses
    for part in units(len(tried), _PER_REFINED * len(few)):
        tried[part] = refined(tried[part], few)
        yield _PER_REFINED * len(few) * len(tried[part])
    tried = yield from _likely(tried, ranges, 0.0)
    return (yield from _distinct(tried, MOST_PLACES, found.complete))


def _distinct(poses: Floats, most: int, complete: bool) -> Steps:
    """Return the first of poses (n, 3), best first, that are not near an earlier one, at most so many."""
    tree, left, kept = cKDTree(poses[:, :2], compact_nodes=False, balanced_tree=False), np.ones(len(poses), bool), list[int]()
    yield _PER_PLACE * len(poses)
    for k in range(len(poses)):
        if not left[k]:
            continue
        if len(kept) == most:
            return Places(poses[kept], False)
        kept.append(k)
        # Only what is near is compared: every place with all that are left would take the square of their number.
        near = np.array(tree.query_ball_point(poses[k, :2], SAME[0] + CELL), dtype=np.intp)
        left[near[~apart(poses[k], poses[near])]] = False
        yield _PER_LOOK + _PER_PLACE * len(near)
    return Places(poses[kept], complete)
