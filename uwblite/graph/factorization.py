"""Factorisations of sparse, symmetric, positive definite matrices, and layouts of these.

A matrix is kept as blocks of its lower triangle. The places of the values in a layout are found once; each factorisation then
gathers the values with one indexing operation.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU, splu

from .. import se2
from ..arrays import WIDE, Floats, Ints, Table
from ..errors import SINGULAR, SolverError
from .elimination import Ordering
from .graph import WIDTHS
from .schwarz_cg import Pieces, TwoLevelFactor
from .work import ENTRIES, FACTORISATIONS, Work


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""

    @property
    def nnz(self) -> int:
        """Entries of the factor."""


def counted(factor: Factor, work: Work) -> Factor:
    """Return a factor that was made, and count it."""
    work[FACTORISATIONS] += 1
    work[ENTRIES] += factor.nnz
    return factor


def superlu(matrix: sparse.csc_matrix, order: str) -> SuperLU:
    """Factorise without pivoting; single columns suit factors as sparse as these (half the time of the default panels)."""
    options = {"SymmetricMode": True, "Equil": False}
    try:
        return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=2, panel_size=1, options=options)
    except RuntimeError as problem:
        raise SolverError(f"{SINGULAR} ({problem})") from None


class BandedFactor:
    """Cholesky factor of a banded matrix."""

    def __init__(self, band: Floats) -> None:
        """Factorise a matrix given by its lower band (n, half): row j holds column j from the diagonal downwards."""
        self._factor, failed = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if failed:
            raise SolverError(SINGULAR)

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""
        return lapack.dpbtrs(self._factor, right, lower=1)[0].reshape(right.shape)

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return int(self._factor.size)


class BorderedFactor:
    """Factor of H = [[A, B^T], [B, C]] with few rows of B: that of A, and Cholesky's of S = C - B A^-1 B^T."""

    def __init__(self, inside: Factor, border: Floats) -> None:
        """Complete a factorisation of A by the rows (m, n + m) of [B, C], of C the lower triangle."""
        n = border.shape[1] - len(border)
        self._inside, self._rows = inside, border[:, :n]
        self._solved = inside.solve(self._rows.T)
        self._corner, failed = lapack.dpotrf(border[:, n:] - np.tril(self._rows @ self._solved), lower=1)
        if failed:
            raise SolverError(SINGULAR)

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n + m,) or (n + m, k)."""
        n = self._rows.shape[1]
        inner = self._inside.solve(right[:n])
        outer = lapack.dpotrs(self._corner, right[n:] - self._rows @ inner, lower=1)[0].reshape(right[n:].shape)
        return np.concatenate([inner - self._solved @ outer, outer])

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return self._inside.nnz + int(self._rows.size)


class Layout(Protocol):
    """Places of the values."""

    def factor(self, values: Floats) -> Factor:
        """Factorise the matrix with these values; raise SolverError where a factorisation meets a pivot it cannot use."""


@dataclass(frozen=True, slots=True, eq=False)
class Blocks(Table):
    """The lower triangle of a symmetric matrix as one array of blocks, each row by row."""

    row: Ints
    """(b,) first row of each block; a block on the diagonal is square and only its lower triangle counts."""
    column: Ints
    """(b,) first column."""
    height: Ints
    """(b,) rows, at most those of a pose."""
    width: Ints
    """(b,) columns, at most those of a pose."""
    start: Ints
    """(b,) place of the first value."""
    size: int
    """Rows of the matrix."""

    @property
    def places(self) -> int:
        """Length of the array."""
        return int(np.max(self.start + self.height * self.width, initial=0))

    def inside(self, size: int) -> "Blocks":
        """Return the blocks within the first rows and columns; no block crosses this limit."""
        return replace(self.rows(self.row < size), size=size)

    def below(self, size: int) -> "Blocks":
        """Return the blocks whose rows come after the first."""
        return self.rows(self.row >= size)

    def entries(self) -> tuple[Ints, Ints, Ints]:
        """Return row, column and place of every value in the lower triangle."""
        i, j = np.indices(se2.POSE * 2)[..., None]
        i, j, block = np.nonzero((i < self.height) & (j < self.width) & (self.row + i >= self.column + j))
        return self.row[block] + i, self.column[block] + j, self.start[block] + i * self.width[block] + j


def _both_triangles(blocks: Blocks) -> tuple[Ints, ...]:
    """Return row, column, height, width, start and step down and across of the blocks of both triangles, by column."""
    apart = np.flatnonzero(blocks.row != blocks.column)
    row, column, height, width, start = (
        a.astype(np.int32) for a in (blocks.row, blocks.column, blocks.height, blocks.width, blocks.start)
    )
    one = np.ones_like(row)
    lower, upper = (row, column, height, width, start, width, one), (column, row, width, height, start, one, width)
    both = [np.concatenate([a, b[apart]]) for a, b in zip(lower, upper, strict=True)]
    order = np.argsort(both[1].astype(WIDE) * blocks.size + both[0])
    return tuple(a[order] for a in both)


class SparseLayout:
    """Both triangles in compressed columns."""

    def __init__(self, blocks: Blocks) -> None:
        """Find for every entry of the compressed columns its place among the values."""
        n = blocks.size
        row, column, height, width, start, down, across = _both_triangles(blocks)
        # Blocks run along the last axis: numpy's loops are as long as it.
        j = np.arange(WIDTHS["poses"], dtype=np.int32)[:, None]
        i = j[:, :, None]
        own, above = np.flatnonzero(row == column), np.cumsum(height, dtype=np.int32) - height
        above -= np.maximum.accumulate(np.where(np.diff(column, prepend=-1) > 0, above, 0))
        tall = np.bincount(column, height, n).astype(np.intp)[column[own]]
        indptr = np.concatenate([[0], np.cumsum(np.repeat(tall, width[own]))])
        at = indptr.astype(np.int32).take(column + j, mode="clip") + (above + i)
        place = (start + i * down) + j * across
        place[..., own] = start[own] + np.maximum(i, j) * down[own] + np.minimum(i, j)
        has: Ints | slice = np.flatnonzero((i < height) & (j < width)) if np.min(height) < len(j) else slice(None)
        at = at.reshape(-1)[has]
        indices, self._source = np.empty(indptr[-1], dtype=np.int32), np.empty(indptr[-1], dtype=np.intp)
        indices[at] = np.broadcast_to(row + i, place.shape).reshape(-1)[has]
        self._source[at] = place.reshape(-1)[has]
        self._matrix = sparse.csc_matrix((np.zeros(len(indices)), indices, indptr), shape=(n, n))

    def factor(self, values: Floats) -> SuperLU:
        """Factorise the matrix with these values; the next call overwrites it."""
        return superlu(self.matrix(values), "NATURAL")

    def matrix(self, values: Floats) -> sparse.csc_matrix:
        """Return the matrix with these values; the next call overwrites it."""
        # With a mode that cannot fail, numpy fills the array itself and no copy of it.
        np.take(values, self._source, out=self._matrix.data, mode="clip")
        return self._matrix


class IterativeLayout:
    """Both triangles in compressed columns, and pieces of the chain."""

    def __init__(self, blocks: Blocks, pieces: Pieces) -> None:
        self._sparse, self._pieces = SparseLayout(blocks), pieces

    def factor(self, values: Floats) -> TwoLevelFactor:
        """Prepare to solve with these values, up to the next call."""
        return TwoLevelFactor(self._sparse.matrix(values), self._pieces)


class BandedLayout:
    """LAPACK's lower band."""

    def __init__(self, blocks: Blocks) -> None:
        """Find where in the band each value goes."""
        rows, columns, self._from = blocks.entries()
        self._half = int(np.max(rows - columns, initial=0)) + 1
        self._to = (rows - columns) + columns * self._half
        self._size = blocks.size

    def factor(self, values: Floats) -> BandedFactor:
        """Factorise the matrix with these values."""
        band = np.zeros(self._size * self._half)
        band[self._to] = values[self._from]
        return BandedFactor(band.reshape(self._size, self._half))


class BorderedLayout:
    """A large inner matrix, and a border of few full rows."""

    def __init__(self, inside: Layout, blocks: Blocks, size: int) -> None:
        """Find where in the border each value goes; the first `size` rows are inside."""
        rows, columns, self._from = blocks.below(size).entries()
        self._inside, self._shape = inside, (blocks.size - size, blocks.size)
        self._to = columns + (rows - size) * blocks.size

    def factor(self, values: Floats) -> BorderedFactor:
        """Factorise the matrix with these values."""
        border = np.zeros(self._shape)
        border.ravel()[self._to] = values[self._from]
        return BorderedFactor(self._inside.factor(values), border)


def make_layout(blocks: Blocks, ordering: Ordering, poses: int) -> Layout:
    """Return the layout that an ordering asks for; the first `poses` rows are those of poses."""
    if not ordering.bordered:
        return SparseLayout(blocks)
    inside = blocks.inside(poses)
    layout: Layout = BandedLayout(inside) if ordering.banded else SparseLayout(inside)
    return layout if poses == blocks.size else BorderedLayout(layout, blocks, poses)
