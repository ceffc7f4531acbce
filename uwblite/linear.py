"""Normal equations of a graph: where every product of Jacobians lands is analysed once, the values are filled often.

A *node* is one free unknown: a pose (3 scalars), an anchor (2) or a calibration value (1). The lower triangle of
H = J^T W J is kept as one array: the blocks between nodes that share an edge, one after the other, then the *border*,
full rows for the calibration values, which touch nearly every pose and therefore take no part in the ordering. Scalars
are numbered in the order of elimination, so that vectors need no permutation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .factorization import BandedLayout, Factor, Layout, SparseLayout, choose_ordering
from .graph import Graph, Linearization

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

WIDTHS = {"poses": 3, "anchors": 2, "calibration": 1}
"""Blocks of unknowns, and the scalars of one unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Where each free scalar of a graph stands in the vector of unknowns."""

    number: dict[str, Ints]
    """By block (unknowns, scalars): position in the vector, -1 = held fixed."""
    size: int
    """Length of the vector."""

    def spread(self, name: str, vector: Floats) -> Floats:
        """Return the part of a vector that belongs to a block, (unknowns, scalars), 0 where held fixed."""
        return np.append(vector, 0.0)[self.number[name]]


def free_unknowns(graph: Graph) -> dict[str, NDArray[np.bool_]]:
    """Return by block which unknowns are not held fixed."""
    held = {"poses": graph.fixed_poses, "anchors": graph.fixed_anchors, "calibration": graph.fixed_calibration}
    counts = {"poses": len(graph.poses), "anchors": len(graph.anchors), "calibration": len(graph.calibration.values)}
    free = {name: np.ones(counts[name], dtype=bool) if mask is None else ~mask for name, mask in held.items()}
    if graph.fixed_poses is None:
        free["poses"][:1] = False
    return free


class NormalEquations:
    """H = J^T W J and g = J^T W r of a graph's edges; rows and columns are the free scalars."""

    def __init__(self, graph: Graph, linearized: Sequence[Linearization], banded: bool = True) -> None:
        """Number the unknowns and find where every product lands.

        Parameters
        ----------
        graph : what is free.
        linearized : of every kind of edges; only the indices and shapes of its blocks are read.
        banded : allow the banded factorisation where it is the faster.
        """
        free = free_unknowns(graph)
        counts = [int(mask.sum()) for mask in free.values()]
        self._inner = counts[0] + counts[1]
        width = np.repeat(list(WIDTHS.values()), counts)
        node, first = {}, 0
        for (name, mask), count in zip(free.items(), counts, strict=True):
            node[name] = np.where(mask, first + np.cumsum(mask) - 1, -1)
            first += count
        touched = [[node[name][index] for name, index, _ in lin.blocks] for lin in linearized]
        pairs, which = self._pairs(touched)
        ordering = choose_ordering(pairs, counts[0], self._inner, counts[2], banded)
        order = np.concatenate([ordering.order, np.arange(self._inner, len(width))])
        corner = np.full(len(width) + 1, -1)
        corner[order] = np.cumsum(width[order]) - width[order]
        scalars = {
            name: np.where(node[name] >= 0, corner[node[name]] + np.arange(w)[:, None], -1) for name, w in WIDTHS.items()
        }
        self.unknowns = Unknowns({name: s.T for name, s in scalars.items()}, int(width.sum()))
        rows, columns = self._place_blocks(pairs, corner, width)
        self._place_products(linearized, touched, which, scalars)
        if ordering.in_band:
            in_band = int(width[ordering.order[: ordering.in_band]].sum())
            self._layout: Layout = BandedLayout(rows, columns, self.unknowns.size, in_band)
        else:
            self._layout = SparseLayout(rows, columns, self.unknowns.size)
        self.values: Floats = np.zeros(self._trash + 1)
        self.gradient: Floats = np.zeros(self.unknowns.size)

    def _pairs(self, touched: list[list[Ints]]) -> tuple[Ints, list[Ints]]:
        """Return the pairs (b, 2) of inner nodes that share an edge, every node with itself first; and each edge's pair."""
        m = self._inner
        keys = [np.array([m * m])]
        for nodes in touched:
            for p, a in enumerate(nodes):
                for b in nodes[:p]:
                    low, high = np.minimum(a, b), np.maximum(a, b)
                    keys.append(np.where((low >= 0) & (high < m) & (low < high), low * m + high, m * m))
        unique, which = np.unique(np.concatenate(keys), return_inverse=True)
        apart = np.stack(np.divmod(unique[:-1], max(m, 1)), axis=1)
        pairs = np.concatenate([np.repeat(np.arange(m), 2).reshape(m, 2), apart])
        ends = np.cumsum([len(k) for k in keys])
        return pairs, [part + m for part in np.split(which, ends)[1:-1]]

    def _place_blocks(self, pairs: Ints, corner: Ints, width: Ints) -> tuple[Ints, Ints]:
        """Lay the blocks out in the array of values; return row and column of every value."""
        swap = corner[pairs[:, 0]] < corner[pairs[:, 1]]
        lower, left = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
        size = width[lower] * width[left]
        start = np.cumsum(size) - size
        self._stride = np.append(width[left], 0)
        self._base = np.append(start - corner[lower] * width[left] - corner[left], 0)
        block = np.repeat(np.arange(len(pairs)), size)
        row, column = np.divmod(np.arange(len(block)) - start[block], width[left][block])
        n = self.unknowns.size
        self._border_row = n - (len(width) - self._inner)
        self._border_base = len(block) - self._border_row * n
        self._trash = self._border_base + n * n
        border = np.divmod(np.arange(self._border_row * n, n * n), n)
        rows = np.concatenate([row + corner[lower][block], border[0]])
        columns = np.concatenate([column + corner[left][block], border[1]])
        each = np.arange(n)
        node = np.repeat(np.argsort(corner[:-1]), width[np.argsort(corner[:-1])])
        inner = each < self._border_row
        self._diagonal = np.where(
            inner,
            self._base[np.where(inner, node, 0)] + each * (np.where(inner, width[node], n) + 1),
            self._border_base + each * (n + 1),
        )
        return rows, columns

    def _place_products(
        self, linearized: Sequence[Linearization], touched: list[list[Ints]], which: list[Ints], scalars: dict[str, Ints]
    ) -> None:
        """Find the place of every product of two Jacobian columns of one edge."""
        n, following = self.unknowns.size, iter(which)
        gradient_rows, positions, twice = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, bool)]
        for lin, nodes in zip(linearized, touched, strict=True):
            stacked = np.concatenate([scalars[name][:, index] for name, index, _ in lin.blocks])
            owner = np.repeat(np.arange(len(nodes)), [jac.shape[2] for _, _, jac in lin.blocks])
            pair = {}
            for p, a in enumerate(nodes):
                for q, b in enumerate(nodes[:p]):
                    pair[p, q] = np.where(a == b, a, next(following))
                pair[p, p] = a
            gradient_rows.append(np.where(stacked >= 0, stacked, n).ravel())
            for k, l in zip(*np.tril_indices(len(stacked)), strict=True):
                low, high = np.minimum(stacked[k], stacked[l]), np.maximum(stacked[k], stacked[l])
                inner = high < self._border_row
                block = np.where(inner, pair[owner[k], owner[l]], 0)
                place = np.where(inner, self._base[block] + high * self._stride[block], self._border_base + high * n) + low
                positions.append(np.where(low >= 0, place, self._trash))
                twice.append((low == high) & (low >= 0) if k != l else np.zeros(len(low), bool))
        self._gradient_rows, self._positions = np.concatenate(gradient_rows), np.concatenate(positions)
        self._twice = np.nonzero(np.concatenate(twice))[0]

    def fill(self, linearized: Sequence[Linearization], weights: Sequence[Floats | None]) -> None:
        """Fill H and g from whitened Jacobians and a weight per edge."""
        products, slopes = np.empty(len(self._positions)), np.empty(len(self._gradient_rows))
        at = slope_at = 0
        for lin, weight in zip(linearized, weights, strict=True):
            jacobian = _stacked(lin)
            weighted = jacobian if weight is None else jacobian * weight
            _, k, e = jacobian.shape
            _contract(weighted, lin.residuals.T[:, None], slopes[slope_at : slope_at + k * e].reshape(k, e))
            slope_at += k * e
            for row in range(k):
                block = products[at : at + (row + 1) * e].reshape(row + 1, e)
                _contract(weighted[:, row : row + 1], jacobian[:, : row + 1], block)
                at += (row + 1) * e
        products[self._twice] *= 2.0
        self.values = np.bincount(self._positions, products, self._trash + 1).astype(np.float64, copy=False)
        self.gradient = np.bincount(self._gradient_rows, slopes, self.unknowns.size + 1)[:-1].astype(np.float64, copy=False)

    @property
    def diagonal(self) -> Floats:
        """The diagonal of H."""
        return self.values[self._diagonal]

    def factor(self, damping: Floats) -> Factor:
        """Factorise H + diag(damping).

        Raises
        ------
        SolverError : the matrix is not positive definite to working precision.
        """
        values = self.values.copy()
        values[self._diagonal] += damping
        return self._layout.factor(values)


def _stacked(lin: Linearization) -> Floats:
    """Return the Jacobians of one kind side by side, (d, k, e): the edges, over which everything runs, come last."""
    d = lin.residuals.shape[1]
    stacked = np.empty((d, sum(jac.shape[2] for _, _, jac in lin.blocks), len(lin.residuals)))
    first = 0
    for _, _, jac in lin.blocks:
        stacked[:, first : first + jac.shape[2]] = jac.transpose(1, 2, 0)
        first += jac.shape[2]
    return stacked


def _contract(a: Floats, b: Floats, out: Floats) -> None:
    """Put the sum over the first axis of a b into out."""
    np.multiply(a[0], b[0], out=out)
    for left, right in zip(a[1:], b[1:], strict=True):
        out += left * right
