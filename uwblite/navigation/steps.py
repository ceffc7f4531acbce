"""Steps between the cells of a map, and the cheapest path over them (Dijkstra's algorithm).

A large map is searched twice. Its cells are parted into blocks, and the cells of a block that hang together are a region:
regions that touch make a graph a hundred times smaller, in which exactly that is connected that is connected by cells (compare
Botea, Mueller, Schaeffer 2004, Near optimal hierarchical path-finding). The cheapest chain of regions is then searched cell
by cell, with the regions beside it, in pieces of bounded size; long stretches through open space are straight lines.

A node is the flat index of a cell, or, from the number of all cells on, a tight place.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from ..arrays import Bools, Floats, Ints
from ..grid.geometry import STRIP
from .clearance import AT_ONCE, ClearanceMap
from .smoothing import along_lines, walk_back

STEPS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""Rows and columns to the eight neighbours of a cell."""
_NEAR_TIGHT = 1.3
"""Cells from a tight place to the nodes that it is joined to: the centre of the next cell but half a cell."""
BLOCK = 16
"""Cells along the edge of a block; STRIP is a multiple of it."""
_LEG = BLOCK
"""Regions of a chain over which a straight way through open space needs no search: its ends lie half a block beside the
cheapest path, which makes it up to (0.5 / 8)^2 / 2 = 0.2 % dearer before it is smoothed."""


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Parts of blocks whose cells hang together."""

    label: NDArray[np.int32]
    """(rows, cols) number of a cell's region, from 1; 0 = the robot may not stand there."""
    sizes: Ints
    """(n,) cells of each; regions and then tight places, as in `graph`."""
    centres: Floats
    """(n, 2) m."""
    graph: csr_matrix
    """(n, n) about what it costs from one centre to the next; symmetric."""


@dataclass(frozen=True, slots=True, eq=False)
class StepSearch:
    """Searches over the cells of a map."""

    clearance: ClearanceMap
    joins: csr_matrix
    """(tight places, cells and tight places) costs of the steps from tight places."""
    regions: Regions | None
    """Of a large map."""

    def places(self, nodes: Ints) -> Floats:
        """Return the places (k, 2) of nodes (k,), m."""
        grid, found = self.clearance.geometry, np.empty((len(nodes), 2))
        cell = nodes < grid.cells
        found[cell] = grid.centre_of(*np.divmod(nodes[cell], grid.cols))
        found[~cell] = self.clearance.tight[nodes[~cell] - grid.cells]
        return found

    def around(self, place: Floats, reach: float) -> tuple[Ints, Floats]:
        """Return the nodes (k,) up to a distance, m, and their places (k, 2)."""
        grid = self.clearance.geometry
        row, col = (int(v) for v in grid.cell_of(np.clip(place, grid.origin - reach, grid.corner + reach)))
        cells = int(np.ceil(reach / grid.resolution))
        low = max(row - cells, 0), max(col - cells, 0)
        window = self.clearance.half[low[0] : max(row + cells + 1, 0), low[1] : max(col + cells + 1, 0)]
        rows, cols = np.nonzero(window >= self.clearance.least)
        nodes = np.concatenate([(rows + low[0]) * grid.cols + cols + low[1], np.arange(len(self.clearance.tight)) + grid.cells])
        places = self.places(nodes)
        near = np.hypot(*(places - place).T) <= reach
        return nodes[near], places[near]

    def path(self, first: int, last: int) -> Ints | None:
        """Return the nodes (k,) of the cheapest path, neighbours or with open ways between them; None = there is none."""
        if self.regions is None:
            return self._search(self.nodes(), first, last)
        start, end = self._region(np.array([first, last])).tolist()
        costs, before = dijkstra(self.regions.graph, indices=start, return_predecessors=True)
        if not np.isfinite(costs[end]):
            return None
        chain = walk_back(before, start, end)
        stops = np.append(np.arange(0, max(len(chain) - 1, 1), _LEG), len(chain) - 1)
        nodes = np.array([first, *(self._roomiest(int(chain[k])) for k in stops[1:-1]), last])
        places = self.places(nodes)
        open_ = along_lines(self.clearance, places[:-1], places[1:]).open
        found = [nodes[:1]]
        for a, b in self._pieces(chain, stops, open_):
            part = nodes[b : b + 1] if open_[a] else self._search(self.nodes(chain[stops[a] : stops[b] + 1]), *nodes[[a, b]])
            assert part is not None  # regions of a chain are connected
            found.append(part[part != found[-1][-1]])
        return np.concatenate(found)

    def reachable(self, first: int) -> Iterator[Ints]:
        """Yield the nodes (k,) that can be reached, in parts."""
        if self.regions is None:
            nodes = self.nodes()
            yield nodes[np.isfinite(dijkstra(self.graph(nodes), indices=np.searchsorted(nodes, first)))]
            return
        reached = np.isfinite(dijkstra(self.regions.graph, indices=self._region(np.array([first]))[0]))
        count, grid = len(reached) - len(self.clearance.tight), self.clearance.geometry
        for rows in grid.strips():
            label = self.regions.label[rows].ravel()
            yield np.flatnonzero(np.append(False, reached[:count])[label]) + rows.start * grid.cols
        yield np.flatnonzero(reached[count:]) + grid.cells

    def nearest(self, first: int, place: Floats, allowed: Bools | None = None) -> int:
        """Return the node that can be reached, is allowed (n,), and is nearest to a place (2,), m; -1 = there is none."""
        best, away = -1, np.inf
        for part in self.reachable(first):
            nodes = part if allowed is None else part[allowed[part]]
            far = np.hypot(*(self.places(nodes) - place).T)
            if far.min(initial=np.inf) < away:
                best, away = int(nodes[np.argmin(far)]), float(far.min())
        return best

    def way_out(self, first: int, allowed: Bools) -> Ints | None:
        """Return the nodes (k,) of the cheapest path towards the nearest allowed cell (rows, cols) that can be reached.

        It ends where it comes to an allowed cell; None = there is none.
        """
        good = np.concatenate([allowed.ravel(), np.zeros(len(self.clearance.tight), dtype=np.bool_)])
        last = self.nearest(first, self.places(np.array([first]))[0], good)
        path = None if last < 0 else self.path(first, last)
        return None if path is None else path[: 1 + int(np.argmax(good[path]))]

    # ---- cells

    def nodes(self, chain: Ints | None = None) -> Ints:
        """Return the nodes (n,), sorted, of the map, or of a chain of regions and those beside them."""
        clearance, grid = self.clearance, self.clearance.geometry
        tight = np.arange(len(clearance.tight)) + grid.cells
        if chain is None or self.regions is None:
            return np.concatenate([np.flatnonzero(clearance.passable()), tight])
        regions = self.regions
        wanted = np.zeros(len(regions.sizes), dtype=np.bool_)
        wanted[chain] = wanted[regions.graph[chain].indices] = True
        count = len(wanted) - len(tight)
        spread = 2 * BLOCK * grid.resolution
        low, high = regions.centres[wanted].min(axis=0) - spread, regions.centres[wanted].max(axis=0) + spread
        (top, left), (bottom, right) = (grid.cell_of(np.clip(v, grid.origin, grid.corner)) for v in (low, high))
        found = np.append(False, wanted[:count])[regions.label[top : bottom + 1, left : right + 1]]
        row, col = np.nonzero(found)
        return np.concatenate([(row + top) * grid.cols + col + left, tight[wanted[count:]]])

    def _search(self, nodes: Ints, first: int, last: int) -> Ints | None:
        start, end = np.searchsorted(nodes, (first, last)).tolist()
        costs, before = dijkstra(self.graph(nodes), indices=start, return_predecessors=True)
        return nodes[walk_back(before, start, end)] if np.isfinite(costs[end]) else None

    def graph(self, nodes: Ints) -> csr_matrix:
        """Return the costs (n, n) of the steps between nodes (n,): their lengths times the mean cost of a metre at the ends."""
        grid = self.clearance.geometry
        cells = nodes[nodes < grid.cells]
        row, col = np.divmod(cells, grid.cols)
        top, left = row.min(initial=grid.rows) - 1, col.min(initial=grid.cols) - 1
        width = int(col.max(initial=0)) - left + 2
        number = np.full((int(row.max(initial=0)) - top + 2) * width, -1, dtype=np.int32)
        at = (row - top) * width + col - left
        number[at] = np.arange(len(cells), dtype=np.int32)
        half = (0.5 * grid.resolution * self.clearance.cell_cost(row, col)).astype(np.float64)
        targets = np.stack([number[at + dr * width + dc] for dr, dc in STEPS], axis=1)
        there = targets >= 0
        for k, (dr, dc) in enumerate(STEPS):
            if dr and dc:  # see ClearanceMap.passable
                there[:, k] &= there[:, STEPS.index((dr, 0))] & there[:, STEPS.index((0, dc))]
        costs = (half[:, None] + half[targets]) * np.hypot(*np.array(STEPS).T)
        starts = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
        graph = csr_matrix((costs[there], targets[there], starts), shape=(len(cells), len(cells)))
        if len(cells) == len(nodes):
            return graph
        joins = self.joins[nodes[len(cells) :] - grid.cells][:, nodes].tocoo()
        shape, rows = (len(nodes), len(nodes)), joins.row + len(cells)
        graph.resize(shape)
        one_way = coo_matrix((joins.data, (rows, joins.col)), shape=shape).tocsr()
        return graph + one_way.maximum(one_way.T)

    # ---- regions

    def _region(self, nodes: Ints) -> Ints:
        """Return the regions (k,) of nodes (k,)."""
        assert self.regions is not None
        return numbers(self.clearance, self.regions.label, len(self.regions.sizes), nodes)

    def _pieces(self, chain: Ints, stops: Ints, open_: Bools) -> list[tuple[int, int]]:
        """Part a chain (k,) at some of its stops (s,): beside open ways, and where a piece is too large."""
        assert self.regions is not None
        beside = np.add.reduceat(self.regions.sizes[(part := self.regions.graph[chain]).indices], part.indptr[:-1])
        cut = open_[1:] | open_[:-1] | (np.diff(np.cumsum(beside)[stops[1:]] // AT_ONCE) > 0)
        return list(pairwise([0, *(np.flatnonzero(cut) + 1).tolist(), len(open_)]))

    def _roomiest(self, region: int) -> int:
        """Return the node of a region where a metre costs least: of such nodes the roomiest, and of these the one
        nearest to the middle of its block.
        """
        assert self.regions is not None
        count, grid = len(self.regions.sizes) - len(self.clearance.tight), self.clearance.geometry
        if region >= count:
            return region - count + grid.cells
        top, left = BLOCK * (np.array(grid.cell_of(self.regions.centres[region])) // BLOCK)
        row, col = np.nonzero(self.regions.label[top : top + BLOCK, left : left + BLOCK] == region + 1)
        away = np.hypot(row - 0.5 * (BLOCK - 1), col - 0.5 * (BLOCK - 1))
        row, col = row + top, col + left
        best = np.lexsort((away, -self.clearance.half[row, col].astype(np.intp), self.clearance.cell_cost(row, col)))[0]
        return int(row[best] * grid.cols + col[best])


def step_search(clearance: ClearanceMap) -> StepSearch:
    """Prepare searches over a map's cells."""
    joins = _joins(clearance)
    large = int(np.count_nonzero(clearance.passable())) > AT_ONCE
    return StepSearch(clearance, joins, regions_of(clearance, joins) if large else None)


def _joins(clearance: ClearanceMap) -> csr_matrix:
    """Return the costs (tight places, cells and tight places) of the steps from each tight place to what is near."""
    grid, tight = clearance.geometry, clearance.tight
    shape = (len(tight), grid.cells + len(tight))
    at = np.rint(2.0 * (tight - grid.origin) / grid.resolution).astype(np.intp)  # half cells
    names = at[:, 1] * (2 * grid.cols + 1) + at[:, 0]
    order = np.argsort(names)
    one, other, ends = [], [], []
    steps = range(-ceil(2.0 * _NEAR_TIGHT), ceil(2.0 * _NEAR_TIGHT) + 1)
    for dy in steps:
        for dx in steps:
            if not 0.0 < 0.5 * np.hypot(dx, dy) <= _NEAR_TIGHT:
                continue
            x, y = at[:, 0] + dx, at[:, 1] + dy
            row, col = y // 2, x // 2
            cell = (x % 2 == 1) & (y % 2 == 1) & grid.inside(row, col)
            cell[cell] = clearance.half[row[cell], col[cell]] >= clearance.least
            name = y * (2 * grid.cols + 1) + x
            found = order[np.minimum(np.searchsorted(names[order], name), len(order) - 1)]
            same = (names[found] == name) & (x >= 0) & (x <= 2 * grid.cols)
            which = np.flatnonzero(cell | same)
            one.append(which)
            other.append(np.where(cell, row * grid.cols + col, found + grid.cells)[which])
            ends.append(grid.origin + 0.5 * grid.resolution * np.stack([x, y], axis=1)[which])
    start, end = np.concatenate(one), np.concatenate(other)
    lines = along_lines(clearance, tight[start], np.concatenate(ends))
    kept = lines.clear
    return csr_matrix((lines.costs[kept], (start[kept], end[kept])), shape=shape)


def regions_of(clearance: ClearanceMap, joins: csr_matrix) -> Regions:
    """Return the regions of a map, with the costs of the steps from tight places to cells and tight places."""
    grid = clearance.geometry
    label, count = np.zeros((grid.rows, grid.cols), dtype=np.int32), 0
    row, col = (n.ravel().astype(np.float64) for n in np.indices((STRIP, grid.cols)))
    sums: list[Floats] = []
    pairs: list[tuple[Ints, Ints]] = []
    for rows in grid.strips():
        part, more = _parted(clearance.passable(rows))
        inner = part.ravel().astype(np.intp)
        values = (None, col[: len(inner)], row[: len(inner)] + rows.start, clearance.cell_cost(rows).ravel())
        sums.append(np.stack([np.bincount(inner, v, more + 1)[1:] for v in values]))
        label[rows] = np.where(part > 0, part + count, 0)
        count += more
        above = np.arange(max(rows.start, BLOCK), rows.stop, BLOCK)
        pairs += (
            _touching(label[above - 1], label[above]),
            _touching(label[rows].T[BLOCK - 1 : -1 : BLOCK], label[rows].T[BLOCK::BLOCK]),
        )
        corner = np.arange(BLOCK, grid.cols, BLOCK)
        four = [[label[above + dr][:, corner + dc] for dc in (-1, 0)] for dr in (-1, 0)]
        whole = np.all(four, axis=(0, 1))
        pairs += [_touching(four[0][k] * whole, four[1][1 - k]) for k in (0, 1)]
    size, across, along, cost = np.concatenate(sums, axis=1)
    centres = np.concatenate([grid.centre_of(along / size, across / size), clearance.tight])
    a, b = (end - 1 for end in np.divmod(np.unique(np.concatenate([p * (count + 1) + q for p, q in pairs])), count + 1))
    costs = 0.5 * np.hypot(*(centres[a] - centres[b]).T) * (cost[a] / size[a] + cost[b] / size[b])
    joined = joins.tocoo()
    sizes = np.concatenate([size.astype(np.intp), np.ones(len(clearance.tight), dtype=np.intp)])
    end = numbers(clearance, label, len(sizes), joined.col.astype(np.intp))
    one, other = np.concatenate([a, joined.row + count]), np.concatenate([b, end])
    # Of several steps between two of them the cheapest counts.
    order = np.lexsort((weights := np.concatenate([costs, joined.data]), other, one))
    first = np.append(True, np.any(np.diff(np.stack([one, other])[:, order]) != 0, axis=0))
    chosen = order[first]
    half = csr_matrix((weights[chosen], (one[chosen], other[chosen])), shape=(len(sizes), len(sizes)))
    return Regions(label, sizes, centres, half.maximum(half.T))


def numbers(clearance: ClearanceMap, label: NDArray[np.int32], count: int, nodes: Ints) -> Ints:
    """Return the regions (k,) of nodes (k,), of so many regions and tight places, by the cells' numbers."""
    cells, tight = clearance.geometry.cells, len(clearance.tight)
    return np.where(nodes < cells, label.ravel()[np.minimum(nodes, cells - 1)] - 1, nodes - cells + count - tight)


def _parted(passable: Bools) -> tuple[NDArray[np.int32], int]:
    """Return numbers from 1 of what hangs together in each block of some rows (rows, cols), and how many there are."""
    rows, cols = passable.shape
    down, across = -(-rows // BLOCK), -(-cols // BLOCK)
    apart = np.zeros((down, BLOCK + 1, across, BLOCK + 1), dtype=np.bool_)
    whole = np.pad(passable, ((0, down * BLOCK - rows), (0, across * BLOCK - cols)))
    apart[:, :-1, :, :-1] = whole.reshape(down, BLOCK, across, BLOCK)
    label, count = ndimage.label(apart.reshape(down * (BLOCK + 1), -1))
    label = label.reshape(apart.shape)[:, :-1, :, :-1].reshape(whole.shape)[:rows, :cols]
    return np.ascontiguousarray(label, dtype=np.int32), int(count)


def _touching(one: NDArray[np.int32], other: NDArray[np.int32]) -> tuple[Ints, Ints]:
    """Return the regions (k,), (k,) on both sides of borders (borders, n), each pair about once."""
    both = np.stack([one, other])[:, (one > 0) & (other > 0)].astype(np.intp)
    first, second = both[:, np.append(True, np.any(np.diff(both, axis=1) != 0, axis=0))] if both.size else both
    return first, second
