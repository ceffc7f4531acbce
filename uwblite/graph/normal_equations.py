"""Normal equations of a graph: the place of every product of Jacobians is analysed once, the values are filled often.

A *node* is one free unknown: a pose (3 scalars), an anchor (2) or a calibration value (1). The lower triangle of H = J^T W J is
kept as one array: the blocks between nodes that share an edge, one after the other. Anchors and calibration values share edges
with many poses and are therefore not ordered: they come last. Scalars are numbered in the order of elimination, so that vectors
need no permutation.
"""

from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..arrays import WIDE, Floats, Ints
from .elimination import choose_ordering
from .factorization import Blocks, Factor, IterativeLayout, Layout, SparseLayout, counted, make_layout
from .graph import WIDTHS, Graph, Linearization, kernel_weights, linearize
from .schwarz_cg import cut
from .unknowns import Unknowns, free_unknowns, linked_poses
from .work import PRODUCTS

_Small = NDArray[np.int32]
_NONE, _NOWHERE = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.int32)
_Touched = tuple[Ints, bool]
"""Node (e,) touched by each edge, -1 = fixed; and whether it is a calibration value."""
_Block = tuple[str, Ints, tuple[int, ...]]
"""Name, unknown (e,) touched by each edge, and shape of an edge's Jacobian."""


class NormalEquations:
    """H = J^T W J and g = J^T W r of a graph's edges; rows and columns are the free scalars."""

    def __init__(self, graph: Graph, linearized: Sequence[Linearization], last: ArrayLike | None = None) -> None:
        """Number the unknowns and find the place of every product.

        Parameters
        ----------
        linearized : of every kind of edges; only the indices and shapes of its blocks are read.
        last : order for the inverse, not for speed: these poses are eliminated after the others.
        """
        self.spent = graph.work
        """Counts what is done with these equations."""
        self._analysed = free_unknowns(graph), [_pattern(lin) for lin in linearized]
        free = self._analysed[0]
        counts = [int(mask.sum()) for mask in free.values()]
        self._values = sum(counts[:2])
        width = np.repeat(list(WIDTHS.values()), counts)
        node, first = {}, 0
        for (name, mask), count in zip(free.items(), counts, strict=True):
            node[name] = np.where(mask, first + np.cumsum(mask) - 1, -1)
            first += count
        touched = [[(node[name][index], name == "calibration") for name, index, _ in lin.blocks] for lin in linearized]
        # Unknowns that are fixed for all edges of a kind, such as calibration, have no products.
        self._free = [[bool(np.any(a >= 0)) for a, _ in nodes] for nodes in touched]
        touched = [list(compress(nodes, free)) for nodes, free in zip(touched, self._free, strict=True)]
        pairs, which = self._pairs(touched, len(width))
        at_end = None if last is None else node["poses"][np.asarray(last, dtype=np.intp)]
        ordering = choose_ordering(pairs, counts[0], width, None if at_end is None else np.unique(at_end[at_end >= 0]))
        order = np.concatenate([ordering.order, np.arange(counts[0], len(width))])
        corner = np.full(len(width) + 1, -1)
        corner[order] = np.cumsum(width[order]) - width[order]
        scalars = {
            name: np.where(node[name] >= 0, corner[node[name]] + np.arange(w)[:, None], -1) for name, w in WIDTHS.items()
        }
        self.unknowns = Unknowns({name: s.T for name, s in scalars.items()}, int(width.sum()))
        blocks = self._place_blocks(pairs, corner, width)
        self._place_products(linearized, touched, which, corner)
        if ordering.iterative:
            number = self.unknowns.number["poses"]
            chain = np.flatnonzero(number[:, 0] >= 0)
            linked = (np.diff(chain) == 1) & linked_poses(len(number), linearized)[chain[:-1]]
            pieces = cut(number[chain], graph.poses[chain], self.unknowns.size, linked)
            self._layout: Layout = IterativeLayout(blocks, pieces)
        else:
            self._layout = make_layout(blocks, ordering, WIDTHS["poses"] * counts[0])
        self.work = pieces.work() if ordering.iterative else ordering.work
        """Multiplications of a factorisation, where they are many enough to be counted."""
        self.values: Floats = np.zeros(self._trash + 1)
        self.gradient: Floats = np.zeros(self.unknowns.size)

    def suits(self, graph: Graph, linearized: Sequence[Linearization]) -> bool:
        """Return whether another graph has the same free unknowns, and its linearised edges the same unknowns."""
        free, kinds = self._analysed
        return (
            len(linearized) == len(kinds)
            and all(np.array_equal(free[name], mask) for name, mask in free_unknowns(graph).items())
            and all(_same_pattern(blocks, _pattern(lin)) for blocks, lin in zip(kinds, linearized, strict=True))
        )

    def _pairs(self, touched: list[list[_Touched]], nodes: int) -> tuple[Ints, list[Ints]]:
        """Return the pairs (b, 2) of nodes that share an edge, every node with itself first; and each edge's pair."""
        m, valued = self._values, np.zeros((nodes - self._values + 1, nodes + 1), dtype=bool)
        keys = [np.array([m * m], dtype=WIDE)]
        for low, high, by_value in _touched_pairs(touched):
            if by_value:
                valued[np.where(low >= 0, high - m, -1), low] = True
            else:
                keys.append(np.where((low >= 0) & (low < high), low.astype(WIDE, copy=False) * m + high, m * m))
        unique, which = np.unique(np.concatenate(keys), return_inverse=True)
        apart = np.stack(np.divmod(unique[:-1], max(m, 1)), axis=1).astype(np.intp, copy=False)
        # Every range and step depends on several calibration values: a table finds these pairs faster than sorting.
        valued[-1] = valued[:, -1] = valued[np.arange(nodes - m), np.arange(m, nodes)] = False
        value, other = np.nonzero(valued)
        place = np.zeros(valued.shape, dtype=np.int32)
        place[value, other] = nodes + len(apart) + np.arange(len(value))
        pairs = np.concatenate([np.repeat(np.arange(nodes), 2).reshape(nodes, 2), apart, np.stack([other, value + m], axis=1)])
        which = np.where(which < len(apart), which + nodes, 0)
        following = iter(np.split(which, np.cumsum([len(k) for k in keys])[:-1])[1:])
        return pairs, [
            place[np.where(low >= 0, high - m, -1), low].astype(np.intp) if by_value else next(following)
            for low, high, by_value in _touched_pairs(touched)
        ]

    def _place_blocks(self, pairs: Ints, corner: Ints, width: Ints) -> Blocks:
        """Place the blocks in the array of values."""
        swap = corner[pairs[:, 0]] < corner[pairs[:, 1]]
        lower, left = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
        height, across = width[lower], width[left]
        ends = np.cumsum(height * across)
        blocks = Blocks(corner[lower], corner[left], height, across, ends - height * across, int(width.sum()))
        base = blocks.start - blocks.row * blocks.width - blocks.column
        self._base, self._stride = base.astype(np.int32), blocks.width.astype(np.int32)
        self._trash = blocks.places
        each = np.repeat(np.arange(len(width)), width)
        scalar = np.repeat(corner[:-1] - np.cumsum(width) + width, width) + np.arange(blocks.size)
        self._diagonal = np.empty(blocks.size, dtype=np.intp)
        self._diagonal[scalar] = self._base[each] + scalar * (self._stride[each] + 1)
        return blocks

    def _place_products(
        self, linearized: Sequence[Linearization], touched: list[list[_Touched]], which: list[Ints], corner: Ints
    ) -> None:
        """Find the place of every product of two Jacobian columns of one edge, and of every one with the residual.

        That of column i of node a and column j of node b lands at a start plus i and j times a step in their block. Where a and
        b are the same node, both their products are one entry, which counts twice on the diagonal.
        """
        following, first = iter(which), corner.astype(np.int32)
        products, twice, rows = [_NOWHERE], [_NONE], [_NOWHERE]
        count = 0
        for lin, nodes, free in zip(linearized, touched, self._free, strict=True):
            widths = [jac.shape[2] for _, _, jac in compress(lin.blocks, free)]
            for p, (a, _) in enumerate(nodes):
                others = [b for b, _ in nodes[: p + 1]]
                blocks = [*(np.where(a == b, a, next(following)) for b in others[:p]), a]
                steps = [self._steps(first[a], first[b], block) for b, block in zip(others, blocks, strict=True)]
                equal = [np.flatnonzero((a == b) & (a >= 0)) for b in others[:p]] + [_NONE]
                for i in range(widths[p]):
                    rows.append(np.where(a >= 0, first[a] + i, self.unknowns.size))
                    for q, ((start, by_a, by_b), same) in enumerate(zip(steps, equal, strict=True)):
                        for j in range(widths[q] if q < p else i + 1):
                            place = start + i * by_a + j * by_b
                            if len(same) and i < j:
                                place[same] = (start + j * by_a + i * by_b)[same]
                            if len(same) and i == j:
                                twice.append(same + count)
                            products.append(place)
                            count += len(place)
        self._places, self._twice, self._rows = (np.concatenate(each) for each in (products, twice, rows))

    def _steps(self, a: _Small, b: _Small, block: Ints) -> tuple[_Small, _Small, _Small]:
        """Return place of the first product of nodes with first scalars a, b, and its steps along either."""
        low, high, stride = np.minimum(a, b), np.maximum(a, b), self._stride[block]
        free = low >= 0
        start = np.where(free, self._base[block] + high * stride + low, self._trash)
        return start, np.where(a >= b, stride, 1) * free, np.where(a >= b, 1, stride) * free

    def fill(self, linearized: Sequence[Linearization], weights: Sequence[Floats | None], again: bool = True) -> None:
        """Fill H and g from whitened Jacobians and a weight per edge; g alone, where H is not wanted again."""
        slopes, products = np.empty(len(self._rows)), np.empty(len(self._places) if again else 0)
        row = place = 0
        for lin, weight, free in zip(linearized, weights, self._free, strict=True):
            jacobians = [jac.transpose(1, 2, 0) for _, _, jac in compress(lin.blocks, free)]
            if not jacobians:
                continue
            # The edges, over which everything runs, come last.
            jacobian = np.ascontiguousarray(np.concatenate(jacobians, axis=1))
            weighted = jacobian if weight is None else jacobian * weight
            _, k, e = jacobian.shape
            _sum_of_products(weighted, lin.residuals.T[:, None], slopes[row : row + k * e].reshape(k, e))
            row += k * e
            for column in range(1, k + 1) if again else ():
                block = products[place : place + column * e].reshape(column, e)
                _sum_of_products(weighted[:, column - 1 : column], jacobian[:, :column], block)
                place += column * e
        self.gradient = np.bincount(self._rows, slopes, self.unknowns.size + 1)[:-1].astype(np.float64, copy=False)
        if again:
            products[self._twice] *= 2.0
            self.values = np.bincount(self._places, products, self._trash + 1).astype(np.float64, copy=False)
            self.spent[PRODUCTS] += len(products)

    @property
    def diagonal(self) -> Floats:
        """The diagonal of H."""
        return self.values[self._diagonal]

    @property
    def matrix(self) -> sparse.csc_matrix:
        """H, where the order is that for the inverse."""
        assert isinstance(self._layout, SparseLayout)
        return self._layout.matrix(self.values)

    def factor(self, damping: Floats) -> Factor:
        """Factorise H + diag(damping).

        Raises
        ------
        SolverError : a pivot cannot be used. (SuperLU accepts negative ones: the step then predicts no decrease.)
        """
        values = self.values.copy()
        values[self._diagonal] += damping
        return counted(self._layout.factor(values), self.spent)


def _pattern(lin: Linearization) -> list[_Block]:
    return [(name, index, jac.shape[1:]) for name, index, jac in lin.blocks]


def _same_pattern(one: list[_Block], other: list[_Block]) -> bool:
    return len(one) == len(other) and all(
        a == b and shape == form and (index is place or np.array_equal(index, place))
        for (a, index, shape), (b, place, form) in zip(one, other, strict=True)
    )


def filled(graph: Graph, last: ArrayLike | None = None, like: NormalEquations | None = None) -> NormalEquations:
    """Return the normal equations at the graph's estimates, with the robust weights as they stand; see NormalEquations.

    Parameters
    ----------
    like : normal equations of a graph with the same unknowns and edges, if there are any: they are filled again.
    """
    linearized = linearize(graph)
    normal = NormalEquations(graph, linearized, last) if like is None else like
    normal.fill(linearized, [kernel_weights(e, lin.residuals) for e, lin in zip(graph.edges, linearized, strict=True)])
    return normal


def _touched_pairs(touched: list[list[_Touched]]) -> Iterator[tuple[Ints, Ints, bool]]:
    """Yield the lower and the higher node (e,) of every two that each edge touches, -1 = fixed; and whether one is a value."""
    for nodes in touched:
        for p, (a, a_value) in enumerate(nodes):
            for b, b_value in nodes[:p]:
                yield np.minimum(a, b), np.maximum(a, b), a_value or b_value


def _sum_of_products(a: Floats, b: Floats, out: Floats) -> None:
    """Put the sum over the first axis of a b into out."""
    np.multiply(a[0], b[0], out=out)
    for left, right in zip(a[1:], b[1:], strict=True):
        out += left * right
