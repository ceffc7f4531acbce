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
from scipy.sparse.linalg import SuperLU, splu

from ..arrays import WIDE, Floats, Ints
from ..errors import SINGULAR, SolverError
from .elimination import elimination_tree, is_full, minimum_degree, narrow_order, postorder, with_subtrees_contiguous, work
from .schwarz_cg import expected_work
from .work import ENTRIES, FACTORISATIONS, Work

_WIDEST_BAND = 16
"""Distance in the band, poses, up to which the banded factorisation wins (docs/lab/performance.md)."""
_WIDEST_BORDER = 48
"""Most scalars in a border; more of them stay in the sparse matrix."""
_LONGEST_LINK = 16
"""Longest reach of an edge in a chain, poses."""
_MANY, _TIED = 500, 4
"""From so many poses on, with so many neighbours each, iteration may take less work than factorisation: in one hall all poses
are connected, in the rooms of a site or the streets of a town only those nearby."""
MOST_WORK = 4e9
"""Multiplications of a factorisation of others, about a second; a hundred times the paper's graph takes 2.4e9. Edges between
any poses and any others, however few, fill the whole matrix."""


_LARGE, _PANEL = 400_000, 8
"""Entries from which on SuperLU updates so many columns together; one at a time below."""


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
    """A factor would fill up: see schwarz_cg.py."""
    work: float = 0.0
    """Multiplications of a factorisation, where they are many enough to be counted."""


def choose_ordering(pairs: Ints, poses: int, width: Ints, subtrees: bool = False, last: Ints | None = None) -> Ordering:
    """Choose in which order to eliminate the poses; anchors and calibration, which touch many of them, come after.

    Parameters
    ----------
    pairs : (b, 2) nodes that share an edge; the first nodes are the poses.
    width : (n,) scalars of each node.
    subtrees : keep to the sparse form, with every subtree of the elimination contiguous: for the selected inverse.
    last : poses that come after the others, in the sparse form.
    """
    if poses < 2:
        return Ordering(np.arange(poses), False, False)
    among = pairs[(pairs < poses).all(axis=1)]
    if last is not None:
        return Ordering(_before(among, poses, last), False, False)
    if subtrees:
        return Ordering(with_subtrees_contiguous(among, poses), False, False)
    bordered = int(width[poses:].sum()) <= _WIDEST_BORDER
    tied = poses >= _MANY and len(among) - poses > _TIED * poses
    if bordered or tied:
        order, reach = narrow_order(among, poses)
        if bordered and reach.max() <= _WIDEST_BAND:
            return Ordering(order, True, True)
        if tied and is_full(reach):
            return Ordering(np.arange(poses), False, False, iterative=True)
    order = with_subtrees_contiguous(among, poses)
    every = order if bordered else np.concatenate([order, np.arange(poses, len(width))])
    multiplications = work(among if bordered else pairs, every, width)
    entries = 2 * int(np.prod(width[pairs], axis=1, dtype=WIDE).sum())
    if multiplications > (expected_work(poses, int(width[poses:].sum()), entries) if tied else MOST_WORK):
        return Ordering(np.arange(poses), False, False, iterative=True)
    return Ordering(order, bordered, False, work=multiplications)


def _before(pairs: Ints, poses: int, last: Ints) -> Ints:
    """Return the order in which some poses come last and the others fill little.

    The remainder of a chain is a chain: it is halved repeatedly by blocks as long as its edges reach, so that each
    elimination connects few of the last poses. (Minimum degree runs along the chain and connects all of them.)
    """
    late = np.zeros(poses, dtype=bool)
    late[last[last >= 0]] = True
    reach = int(np.max(np.abs(np.diff(pairs[~late[pairs].any(axis=1)], axis=1)), initial=1))
    if reach > _LONGEST_LINK:
        order = minimum_degree(pairs, poses)
    else:
        block = np.arange(poses) // reach + 1
        order = np.lexsort((np.arange(poses), block & -block))
    order = np.concatenate([order[~late[order]], order[late[order]]])
    walk = order[postorder(elimination_tree(pairs, order))]
    return np.concatenate([walk[~late[walk]], order[late[order]]])


def superlu(matrix: sparse.csc_matrix, order: str) -> SuperLU:
    """Factorise without pivoting; panels of few columns suit factors as sparse as these (half the time of the default)."""
    options, panel = {"SymmetricMode": True, "Equil": False}, 1 if matrix.nnz < _LARGE else _PANEL
    try:
        return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=2, panel_size=panel, options=options)
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

    def half(self, right: Floats, transposed: bool = False) -> Floats:
        """Solve with Cholesky's L, or with L^T, for right-hand sides (n,) or (n, m)."""
        # scipy's binding writes beyond an empty array.
        if not right.size:
            return right
        return lapack.dtbtrs(self._factor, right, uplo="L", trans="T" if transposed else "N")[0].reshape(right.shape)

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return int(self._factor.size)


class BorderedFactor:
    """Factor of H = [[A, B^T], [B, C]] with few rows of B: that of A, and Cholesky's of S = C - B A^-1 B^T.

    Where A = L L^T is a band, S = C - V^T V with V = L^-1 B^T: a quarter of the time, since LAPACK's second half, with L^T, is
    the slower one for many columns.
    """

    def __init__(self, inside: Factor, border: Floats) -> None:
        """Complete a factorisation of A by the rows (m, n + m) of [B, C], of C the lower triangle."""
        n = border.shape[1] - len(border)
        self._inside, self._rows = inside, border[:, :n]
        self._solved = inside.half(self._rows.T) if isinstance(inside, BandedFactor) else inside.solve(self._rows.T)
        product = (self._solved.T if isinstance(inside, BandedFactor) else self._rows) @ self._solved
        self._corner, failed = lapack.dpotrf(border[:, n:] - np.tril(product), lower=1)
        if failed:
            raise SolverError(SINGULAR)

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n + m,) or (n + m, k)."""
        n = self._rows.shape[1]
        inner = self._inside.solve(right[:n])
        outer = lapack.dpotrs(self._corner, right[n:] - self._rows @ inner, lower=1)[0].reshape(right[n:].shape)
        further = self._solved @ outer
        if isinstance(self._inside, BandedFactor):
            further = self._inside.half(further, transposed=True)
        return np.concatenate([inner - further, outer])

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return self._inside.nnz + int(self._rows.size)
