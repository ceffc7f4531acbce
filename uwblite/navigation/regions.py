"""Regions of a large map: parts of its blocks whose cells hang together, with a graph far smaller than that of the cells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_matrix

from ..arrays import Bools, Floats, Ints
from .clearance import ClearanceMap

BLOCK = 16
"""Cells along the edge of a block."""
STRIP = 64
"""Rows that are looked at together; a multiple of BLOCK."""


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


def regions_of(clearance: ClearanceMap, joins: csr_matrix) -> Regions:
    """Return the regions of a map.

    Parameters
    ----------
    joins : (tight places, cells and tight places) costs of the steps from tight places.
    """
    grid = clearance.geometry
    label, count = np.zeros((grid.rows, grid.cols), dtype=np.int32), 0
    sums: list[Floats] = []
    pairs: list[tuple[Ints, Ints]] = []
    for start in range(0, grid.rows, STRIP):
        rows = slice(start, min(start + STRIP, grid.rows))
        part, more = _parted(clearance.passable(rows))
        part[part > 0] += count
        label[rows] = part
        inner = part.ravel() - count
        keep = inner > 0
        row, col = np.divmod(np.flatnonzero(keep), grid.cols)
        values = (None, col, row + start, clearance.cell_cost(rows).ravel()[keep])
        sums.append(np.stack([np.bincount(inner[keep] - 1, v, more) for v in values]))
        count += more
        above = np.arange(max(start, BLOCK), rows.stop, BLOCK)
        pairs += _touching(label[above - 1], label[above]), _touching(part.T[BLOCK - 1 : -1 : BLOCK], part.T[BLOCK::BLOCK])
        corner = np.arange(BLOCK, grid.cols, BLOCK)
        four = [[label[above + dr][:, corner + dc] for dc in (-1, 0)] for dr in (-1, 0)]
        whole = np.all(four, axis=(0, 1))
        pairs += [_touching(four[0][k] * whole, four[1][1 - k]) for k in (0, 1)]
    size, col, row, cost = np.concatenate(sums, axis=1)
    centres = np.concatenate([grid.centre_of(row / size, col / size), clearance.tight])
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
