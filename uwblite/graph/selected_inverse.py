"""Chosen entries of the inverse of a sparse matrix from its factor: block-wise Takahashi recursion.

With H = L D L^T the inverse Z satisfies Z L = L^-T D^-1, whose part below the diagonal is 0. For a range J of columns
with rows R below it that L touches,

    Z_RJ = -Z_RR Y,    Z_JJ = L_JJ^-T D_J^-1 L_JJ^-1 - Y^T Z_RJ,    Y = L_RJ L_JJ^-1,

so that Z is found from the last columns to the first, each range needing only what a later one, its parent, has
computed already (K. Takahashi, J. Fagan, M.-S. Chin, Formation of a sparse bus impedance matrix and its application to
short circuit study, 1973). Ranges of a few dozen columns make the work one of dense products.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU

from ..arrays import Floats, Ints
from ..errors import SolverError
from .eliminated import BlockFactor

_WIDEST, _OVERHEAD = 64, 1e4
"""Columns of a range at most, and the fixed cost of one, in entries: calls of library functions take time."""


class _Front(NamedTuple):
    """A range of columns and the rows below that they touch."""

    rows: Ints
    """The columns themselves, then R; ascending."""
    width: int

    def panel(self, lower: sparse.csc_matrix) -> Floats:
        """Return (rows, width) of L."""
        start, end = int(self.rows[0]), int(self.rows[0]) + self.width
        inside = slice(lower.indptr[start], lower.indptr[end])
        panel = np.zeros((len(self.rows), self.width))
        column = np.repeat(np.arange(self.width), np.diff(lower.indptr[start : end + 1]))
        panel[np.searchsorted(self.rows, lower.indices[inside]), column] = lower.data[inside]
        return panel


def selected_inverse(factor: SuperLU | BlockFactor, rows: Ints, columns: Ints) -> Floats:
    """Return entries (k,) of the inverse of a symmetric matrix, at rows and columns (k,) where the matrix itself is not empty.

    0 where it holds a zero that its factor need not fill.

    Raises
    ------
    SolverError : the factor was pivoted off the diagonal: the matrix was not positive definite.
    """
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise SolverError("covariances need a positive definite matrix; add a prior on what nothing measures")
    position = factor.perm_c.astype(np.intp)
    first, second = np.minimum(position[rows], position[columns]), np.maximum(position[rows], position[columns])
    order = np.argsort(first, kind="stable")
    found = np.empty(len(rows))
    lower, pivots = factor.L, factor.U.diagonal()
    lower.sort_indices()
    fronts = [_Front(np.append(np.arange(start, end), below), end - start) for start, end, below in _ranges(lower)]
    starts = np.array([front.rows[0] for front in fronts])
    # A front needs the one, its parent, that holds the first row of its R.
    above = [int(np.searchsorted(starts, f.rows[f.width], "right")) - 1 if len(f.rows) > f.width else -1 for f in fronts]
    bounds = np.append(np.searchsorted(first[order], starts), len(order))
    waiting = np.bincount([parent for parent in above if parent >= 0], minlength=len(fronts))
    inverses: dict[int, Floats] = {}
    for s in range(len(fronts) - 1, -1, -1):
        front, parent = fronts[s], above[s]
        below = None
        if parent >= 0:
            at = np.searchsorted(fronts[parent].rows, front.rows[front.width :])
            below = inverses[parent][np.ix_(at, at)]
        inverse = _front_inverse(front.panel(lower), pivots[front.rows[: front.width]], below)
        if waiting[s]:
            inverses[s] = inverse
        if parent >= 0:
            waiting[parent] -= 1
            if not waiting[parent]:
                del inverses[parent]
        here = order[bounds[s] : bounds[s + 1]]
        column = np.minimum(np.searchsorted(front.rows, second[here]), len(front.rows) - 1)
        present = front.rows[column] == second[here]
        found[here] = np.where(present, inverse[first[here] - starts[s], column], 0.0)
    return found


def _ranges(lower: sparse.csc_matrix) -> list[tuple[int, int, Ints]]:
    """Return start, end and rows below of ranges of columns, joined while that saves work.

    Rows below are passed on to the range that contains the first of them.
    """
    handed: dict[int, Ints] = {}
    done: list[tuple[int, int, Ints]] = []
    start, end, below = 0, 0, np.zeros(0, dtype=np.intp)
    for first, last in _within_subtrees(lower):
        touched = [lower.indices[lower.indptr[first] : lower.indptr[last]]]
        touched += [handed.pop(c) for c in range(first, last) if c in handed]
        if len(below) and below[0] < last:
            touched.append(below)
        own = np.unique(np.concatenate(touched).astype(np.intp))
        own = own[own >= last]
        both = np.union1d(below[below >= last], own)
        apart = (end - start + len(below)) ** 2 + (last - first + len(own)) ** 2 + _OVERHEAD
        if end > start and (last - start > _WIDEST or (last - start + len(both)) ** 2 > apart):
            done.append((start, end, below))
            if len(below) and below[0] >= last:
                target = int(below[0])
                handed[target] = np.union1d(handed[target], below) if target in handed else below
            start, both = first, own
        end, below = last, both
    return [*done, (start, end, below)]


def _within_subtrees(lower: sparse.csc_matrix) -> list[tuple[int, int]]:
    """Cut the columns into ranges that lie within the subtree of their last: they touch no more rows than it does."""
    n = lower.shape[0]
    column = np.repeat(np.arange(n, dtype=lower.indices.dtype), np.diff(lower.indptr))
    parent = np.minimum.reduceat(np.where(lower.indices > column, lower.indices, n), lower.indptr[:-1]).tolist()
    deepest = list(range(n + 1))
    for j, above in enumerate(parent):
        deepest[above] = min(deepest[above], deepest[j])
    cuts, end = [], n
    while end:
        start = max(deepest[end - 1], end - _WIDEST)
        cuts.append((start, end))
        end = start
    return cuts[::-1]


def _front_inverse(panel: Floats, pivots: Floats, below: Floats | None) -> Floats:
    """Return Z over the rows of a front from its columns of L; below : Z_RR, None = there is no R."""
    w = panel.shape[1]
    unit = np.tril(lapack.dtrtri(panel[:w], lower=1, unitdiag=1)[0], -1) + np.eye(w)
    corner = (unit.T / pivots) @ unit
    if below is None:
        return corner
    y = panel[w:] @ unit
    side = -(below @ y)
    return np.block([[corner - y.T @ side, side.T], [side, below]])
