"""Orderings and factorisations of sparse, symmetric, positive definite matrices, chosen by structure.

A trajectory measured against a few anchors is a narrow band with a border: reverse Cuthill-McKee, LAPACK's banded
Cholesky, and a Schur complement for the border. Once closures tie distant poses together the band fills, and minimum
degree with SuperLU in its symmetric mode needs the fewest operations. The order is found on the graph of nodes, a
third of the matrix's size, and used for every factorisation.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.csgraph import depth_first_order, reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from .errors import SolverError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_WIDEST_BAND = 2
"""Distance in the band, poses, up to which the banded factorisation wins (docs/performance.md)."""
_WIDEST_BORDER = 48
"""Scalars in the border up to which the banded factorisation wins."""


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""


class Layout(Protocol):
    """Where the values of a lower triangle go before they are factorised."""

    def factor(self, values: Floats) -> Factor:
        """Factorise the matrix with these values; raise SolverError where it is not positive definite."""


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """Order of elimination of a graph's poses."""

    order: Ints
    """(m,) poses, first eliminated first."""
    in_band: int
    """How many of them form a narrow band: all or none; none = the matrix is to be treated as sparse."""


def choose_ordering(pairs: Ints, poses: int, others: int, subtrees: bool = False) -> Ordering:
    """Choose in which order to eliminate the poses; anchors and calibration, which touch many of them, come after.

    Parameters
    ----------
    pairs : (b, 2) poses that share an edge.
    poses : how many there are.
    others : scalars that come after the poses.
    subtrees : keep to the sparse form, with every subtree of the elimination contiguous: for the selected inverse.
    """
    if poses < 2:
        return Ordering(np.arange(poses), 0)
    if not subtrees and others <= _WIDEST_BORDER:
        order = reverse_cuthill_mckee(_adjacency(pairs, poses).tocsr(), symmetric_mode=True).astype(np.int64)
        position = np.empty(poses, dtype=np.int64)
        position[order] = np.arange(poses)
        if np.max(np.abs(position[pairs[:, 0]] - position[pairs[:, 1]]), initial=0) <= _WIDEST_BAND:
            return Ordering(order, poses)
    factor = _superlu(_adjacency(pairs, poses), "MMD_AT_PLUS_A")
    order = np.argsort(factor.perm_c)
    return Ordering(order[_postorder(factor.L)] if subtrees else order, 0)


def _postorder(lower: sparse.csc_matrix) -> Ints:
    """Return the order in which every subtree of the elimination tree is contiguous and ends at its root.

    The parent of a column is its first row below the diagonal. A depth-first walk from the roots, read backwards, is
    such an order; it costs no fill and makes neighbours in the order neighbours in the factor.
    """
    n = lower.shape[0]
    column = np.repeat(np.arange(n), np.diff(lower.indptr))
    parent = np.minimum.reduceat(np.where(lower.indices > column, lower.indices, n), lower.indptr[:-1])
    tree = sparse.csr_matrix((np.ones(n), (parent, np.arange(n))), shape=(n + 1, n + 1))
    return depth_first_order(tree, n, return_predecessors=False)[:0:-1].astype(np.int64)


def _adjacency(pairs: Ints, nodes: int) -> sparse.csc_matrix:
    """Return a positive definite matrix with a graph's pattern."""
    a, b = pairs[pairs[:, 0] != pairs[:, 1]].T
    each = np.arange(nodes)
    rows, columns = np.concatenate([each, a, b]), np.concatenate([each, b, a])
    values = np.ones(len(rows))
    values[:nodes] += len(rows)
    return sparse.csc_matrix((values, (rows, columns)), shape=(nodes, nodes))


def _superlu(matrix: sparse.csc_matrix, order: str) -> SuperLU:
    """Factorise without pivoting; one-column panels suit factors as sparse as these (half the time of the default)."""
    options = {"SymmetricMode": True, "Equil": False}
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=2, panel_size=1, options=options)


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """The lower triangle of a symmetric matrix as one array: blocks row by row, then full rows at the end."""

    row: Ints
    """(b,) first row of each block; a block on the diagonal is square and only its lower triangle counts."""
    column: Ints
    """(b,) first column."""
    height: Ints
    """(b,) rows, at most 3."""
    width: Ints
    """(b,) columns, at most 3."""
    size: int
    """Rows of the matrix."""
    full: int
    """How many of them, the last, are full."""

    @property
    def start(self) -> Ints:
        """Place (b,) of each block's first value."""
        size = self.height * self.width
        return np.cumsum(size) - size

    @property
    def full_start(self) -> int:
        """Place of the first value of the full rows."""
        return int(np.sum(self.height * self.width))

    def full_entries(self) -> tuple[Ints, Ints, Ints]:
        """Return row, column and place of every value of the full rows in the lower triangle."""
        row, column = np.divmod(np.arange(self.full * self.size), self.size)
        inside = column <= row + self.size - self.full
        return row[inside] + self.size - self.full, column[inside], self.full_start + np.nonzero(inside)[0]

    def entries(self) -> tuple[Ints, Ints, Ints]:
        """Return row, column and place of every value in the lower triangle."""
        start, found = self.start, [self.full_entries()]
        for i, j in np.ndindex(3, 3):
            has = (i < self.height) & (j < self.width) & (self.row + i >= self.column + j)
            found.append((self.row[has] + i, self.column[has] + j, start[has] + i * self.width[has] + j))
        rows, columns, places = (np.concatenate(part) for part in zip(*found, strict=True))
        return rows, columns, places


_SHAPES = ((3, 3), (2, 3), (3, 2), (2, 2))
"""Shapes of blocks between poses and anchors."""


def _both_triangles(blocks: Blocks) -> tuple[Ints, ...]:
    """Return row, column, height, width, start and step down and across of the blocks of both triangles, by column."""
    apart = blocks.row != blocks.column
    one, start = np.ones_like(blocks.row), blocks.start
    lower = (blocks.row, blocks.column, blocks.height, blocks.width, start, blocks.width, one)
    upper = (blocks.column, blocks.row, blocks.width, blocks.height, start, one, blocks.width)
    both = [np.concatenate([a, b[apart]]) for a, b in zip(lower, upper, strict=True)]
    order = np.argsort(both[1] * blocks.size + both[0])
    return tuple(a[order] for a in both)


class SparseLayout:
    """Both triangles in compressed columns."""

    def __init__(self, blocks: Blocks) -> None:
        """Find for every entry of the compressed columns its place among the values."""
        n, inner = blocks.size, blocks.size - blocks.full
        row, column, height, width, start, down, across = _both_triangles(blocks)
        own = row == column
        above = np.cumsum(height) - height
        above -= np.maximum.accumulate(np.where(np.diff(column, prepend=-1) > 0, above, 0))
        in_blocks = np.bincount(column, height, n).astype(np.int64)
        tall = np.full(n, n)
        for k in range(3):
            has = own & (k < width)
            tall[column[has] + k] = in_blocks[column[has]] + blocks.full
        indptr = np.concatenate([[0], np.cumsum(tall)])
        indices, source = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1], dtype=np.int64)
        for h, w in _SHAPES:
            some = np.nonzero((height == h) & (width == w))[0]
            r, own_some, at_column = row[some], own[some], column[some]
            for i, j in np.ndindex(h, w):
                at = indptr[at_column + j] + (above[some] + i)
                indices[at] = r + i
                place = start[some] + (i * down[some] + j * across[some])
                if i < j:
                    place = np.where(own_some, start[some] + (j * down[some] + i * across[some]), place)
                source[at] = place
        full = blocks.full_start + np.arange(blocks.full)[:, None] * n
        each = np.arange(n)
        for f in range(blocks.full):
            at = indptr[1 : inner + 1] - blocks.full + f
            indices[at], source[at] = inner + f, full[f] + each[:inner]
            at = indptr[inner + f] + each
            indices[at], source[at] = (
                each,
                np.where(each <= inner + f, full[f] + each, full[np.maximum(each - inner, 0), 0] + inner + f),
            )
        self._source = source
        self._matrix = sparse.csc_matrix((np.zeros(len(indices)), indices, indptr), shape=(n, n))

    def factor(self, values: Floats) -> SuperLU:
        """Factorise the matrix with these values; it is used up by the next call."""
        np.take(values, self._source, out=self._matrix.data)
        try:
            return _superlu(self._matrix, "NATURAL")
        except RuntimeError as problem:
            raise SolverError(f"the normal equations are singular ({problem}); add a prior or more measurements") from None


class BandedLayout:
    """A band, a border that is full, and the corner between them."""

    def __init__(self, blocks: Blocks, in_band: int) -> None:
        """Find where the values go; the first `in_band` rows form the band."""
        rows, columns, places = blocks.entries()
        size = blocks.size
        self._band, self._border = in_band, size - in_band
        inside = rows < in_band
        self._half = int(np.max((rows - columns)[inside], initial=0)) + 1
        self._from_band, self._from_border = places[inside], places[~inside]
        self._to_band = (rows - columns)[inside] + columns[inside] * self._half
        self._to_border = columns[~inside] + (rows[~inside] - in_band) * size

    def factor(self, values: Floats) -> "BandedFactor":
        """Factorise the matrix with these values."""
        band = np.zeros(self._band * self._half)
        band[self._to_band] = values[self._from_band]
        border = np.zeros(self._border * (self._band + self._border))
        border[self._to_border] = values[self._from_border]
        return BandedFactor(band.reshape(self._band, self._half), border.reshape(self._border, self._band + self._border))


class BandedFactor:
    """Cholesky factor of a banded matrix with a border.

    With H = [[A, B^T], [B, C]]: A = L L^T in the band, S = C - B A^-1 B^T in full.
    """

    def __init__(self, band: Floats, border: Floats) -> None:
        self._n = len(band)
        self._factor, failed = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if failed:
            raise SolverError("the normal equations are singular; add a prior or more measurements")
        self._rows = border[:, : self._n]
        self._solved = self._inside(self._rows.T)
        corner = border[:, self._n :]
        self._corner, failed = lapack.dpotrf(corner - np.tril(self._rows @ self._solved), lower=1)
        if failed:
            raise SolverError("the normal equations are singular; add a prior or more measurements")

    def _inside(self, right: Floats) -> Floats:
        return lapack.dpbtrs(self._factor, right, lower=1)[0] if right.size else right

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""
        first, last = right[: self._n], right[self._n :]
        inner = self._inside(first)
        if not len(last):
            return inner
        outer = lapack.dpotrs(self._corner, last - self._rows @ inner, lower=1)[0]
        outer = outer.reshape(last.shape)
        return np.concatenate([inner - self._solved @ outer, outer])
