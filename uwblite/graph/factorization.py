"""Orderings and factorisations of sparse, symmetric, positive definite matrices, chosen by structure.

Poses measured against a few anchors are a sparse matrix with a border: anchors and calibration, which touch nearly every
pose, are eliminated last by a Schur complement. Inside, a chain whose closures reach back a few poses is a narrow
band: reverse Cuthill-McKee and LAPACK's banded Cholesky. Once closures tie distant poses together the band fills, and
minimum degree with SuperLU in its symmetric mode needs fewer operations. Many anchors are no border any more, but the
last rows of the sparse matrix. The order is found on the graph of poses, a third of the matrix's size, and used for
every factorisation.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.csgraph import depth_first_order, reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from ..arrays import Floats, Ints
from ..errors import SINGULAR, SolverError

_WIDEST_BAND = 16
"""Distance in the band, poses, up to which the banded factorisation wins (docs/performance.md)."""
_WIDEST_BORDER = 48
"""Scalars that make a border; more of them are left to the sparse matrix."""
_LONGEST_LINK = 16
"""Poses; edges that reach farther make no chain."""
_MANY, _TIED = 500, 4
"""From so many poses on, with so many neighbours each, iteration wins over factorisation."""


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """Order of elimination of a graph's poses."""

    order: Ints
    """(m,) poses, first eliminated first."""
    bordered: bool
    """Everything else is a border."""
    banded: bool
    """The poses are a narrow band."""
    iterative: bool = False
    """A factor would fill up: see two_level."""


def choose_ordering(pairs: Ints, poses: int, others: int, subtrees: bool = False, last: Ints | None = None) -> Ordering:
    """Choose in which order to eliminate the poses; anchors and calibration, which touch many of them, come after.

    Parameters
    ----------
    pairs : (b, 2) poses that share an edge.
    others : scalars that come after the poses.
    subtrees : keep to the sparse form, with every subtree of the elimination contiguous: for the selected inverse.
    last : poses that come after the others, in the sparse form.
    """
    if poses < 2:
        return Ordering(np.arange(poses), False, False)
    if not subtrees and last is None and poses >= _MANY and len(pairs) - poses > _TIED * poses:
        return Ordering(np.arange(poses), False, False, iterative=True)
    bordered = not subtrees and last is None and others <= _WIDEST_BORDER
    if bordered:
        order = reverse_cuthill_mckee(_adjacency(pairs, poses).tocsr(), symmetric_mode=True).astype(np.int64)
        position = np.empty(poses, dtype=np.int64)
        position[order] = np.arange(poses)
        if np.max(np.abs(position[pairs[:, 0]] - position[pairs[:, 1]]), initial=0) <= _WIDEST_BAND:
            return Ordering(order, True, True)
    if last is not None:
        return Ordering(_before(pairs, poses, last), False, False)
    factor = superlu(_adjacency(pairs, poses), "MMD_AT_PLUS_A")
    order = np.argsort(factor.perm_c)
    return Ordering(order[postorder(factor.L)] if subtrees else order, bordered, False)


def _before(pairs: Ints, poses: int, last: Ints) -> Ints:
    """Return the order in which some poses come last and the others fill little.

    What is left of a chain is a chain: it is halved again and again by blocks as long as its edges reach, so that few
    of the last poses meet in any one elimination. (Minimum degree runs along the chain and gathers them all.)
    """
    late = np.zeros(poses, dtype=bool)
    late[last[last >= 0]] = True
    reach = int(np.max(np.abs(np.diff(pairs[~late[pairs].any(axis=1)], axis=1)), initial=1))
    if reach > _LONGEST_LINK:
        order = np.argsort(superlu(_adjacency(pairs, poses), "MMD_AT_PLUS_A").perm_c)
    else:
        block = np.arange(poses) // reach + 1
        order = np.lexsort((np.arange(poses), block & -block))
    return np.concatenate([order[~late[order]], order[late[order]]])


def postorder(lower: sparse.csc_matrix) -> Ints:
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


def superlu(matrix: sparse.csc_matrix, order: str) -> SuperLU:
    """Factorise without pivoting; one-column panels suit factors as sparse as these (half the time of the default)."""
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
