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
from scipy.sparse.csgraph import reverse_cuthill_mckee
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
    """Order of elimination of a graph's nodes."""

    order: Ints
    """(m,) nodes, first eliminated first."""
    in_band: int
    """How many of them, from the start, form a narrow band; 0 = the matrix is to be treated as sparse."""


def choose_ordering(pairs: Ints, poses: int, nodes: int, border: int, banded: bool = True) -> Ordering:
    """Choose how to eliminate nodes 0..nodes-1, the first `poses` of them poses, the others anchors.

    Parameters
    ----------
    pairs : (b, 2) nodes that share an edge.
    border : scalars that stay last whatever is chosen.
    banded : allow the banded form.
    """
    if banded and 2 * (nodes - poses) + border <= _WIDEST_BORDER and poses:
        among = pairs[(pairs < poses).all(axis=1)]
        order = reverse_cuthill_mckee(_adjacency(among, poses).tocsr(), symmetric_mode=True).astype(np.int64)
        position = np.empty(poses, dtype=np.int64)
        position[order] = np.arange(poses)
        if np.max(np.abs(position[among[:, 0]] - position[among[:, 1]]), initial=0) <= _WIDEST_BAND:
            return Ordering(np.concatenate([order, np.arange(poses, nodes)]), poses)
    if nodes < 2:
        return Ordering(np.arange(nodes), 0)
    return Ordering(np.argsort(_superlu(_adjacency(pairs, nodes), "MMD_AT_PLUS_A").perm_c).astype(np.int64), 0)


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


class SparseLayout:
    """Both triangles in compressed columns."""

    def __init__(self, rows: Ints, columns: Ints, size: int) -> None:
        """Analyse a lower triangle given by its entries; entries above the diagonal are ignored."""
        source = np.nonzero(rows >= columns)[0]
        r, c = rows[source], columns[source]
        strict = np.nonzero(r > c)[0]
        data = np.concatenate([source, source[strict]]) + 1.0
        where = (np.concatenate([r, c[strict]]), np.concatenate([c, r[strict]]))
        matrix = sparse.csc_matrix((data, where), shape=(size, size))
        matrix.sort_indices()
        self._source = matrix.data.astype(np.int64) - 1
        self._matrix = matrix

    def factor(self, values: Floats) -> SuperLU:
        """Factorise the matrix with these values; it is used up by the next call."""
        np.take(values, self._source, out=self._matrix.data)
        try:
            return _superlu(self._matrix, "NATURAL")
        except RuntimeError as problem:
            raise SolverError(f"the normal equations are singular ({problem}); add a prior or more measurements") from None


class BandedLayout:
    """A band, a border that is full, and the corner between them."""

    def __init__(self, rows: Ints, columns: Ints, size: int, in_band: int) -> None:
        """Analyse a lower triangle given by its entries, of which the first `in_band` rows form the band."""
        self._band, self._border = in_band, size - in_band
        inside = (rows < in_band) & (rows >= columns)
        self._half = int(np.max((rows - columns)[inside], initial=0)) + 1
        self._from_band = np.nonzero(inside)[0]
        self._to_band = (rows - columns)[inside] + columns[inside] * self._half
        below = (rows >= in_band) & (rows >= columns)
        self._from_border = np.nonzero(below)[0]
        self._to_border = columns[below] + (rows[below] - in_band) * size

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
