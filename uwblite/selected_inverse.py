"""Chosen entries of the inverse of a sparse matrix from its factor: block-wise Takahashi recursion.

With H = L D L^T the inverse Z satisfies Z L = L^-T D^-1, whose part below the diagonal is 0. For a range J of columns
with rows R below it that L touches,

    Z_RJ = -Z_RR Y,    Z_JJ = L_JJ^-T D_J^-1 L_JJ^-1 - Y^T Z_RJ,    Y = L_RJ L_JJ^-1,

so that Z is found from the last columns to the first, each range needing only what a later one, its parent, has
computed already (K. Takahashi, J. Fagan, M.-S. Chin, Formation of a sparse bus impedance matrix and its application to
short circuit study, 1973). Ranges of a few dozen columns make the work one of dense products.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU

from .errors import SolverError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_RANGE = 48
"""Columns treated together: more means larger products but more zeros among them."""


@dataclass(frozen=True, slots=True, eq=False)
class _Front:
    """A range of columns and the rows below that they touch."""

    rows: Ints
    """The columns themselves, then R; ascending."""
    width: int
    panel: Floats
    """(rows, width) of L."""
    parent: int
    """The range that holds the first row of R; -1 = none."""


def selected_inverse(factor: SuperLU, rows: Ints, columns: Ints) -> Floats:
    """Return entries (k,) of the inverse of a symmetric matrix, at places (k,) where the matrix itself is not empty.

    Parameters
    ----------
    factor : by SuperLU in symmetric mode.
    rows, columns : (k,) places.

    Raises
    ------
    SolverError : the factor was pivoted off the diagonal: the matrix was not positive definite.
    """
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise SolverError("covariances need a positive definite matrix; add a prior on what nothing measures")
    position = factor.perm_c.astype(np.int64)
    first, second = np.minimum(position[rows], position[columns]), np.maximum(position[rows], position[columns])
    order = np.argsort(first, kind="stable")
    found = np.empty(len(rows))
    fronts, pivots = _fronts(factor), factor.U.diagonal()
    bounds = np.searchsorted(first[order], np.arange(len(fronts) + 1) * _RANGE)
    waiting = np.bincount([f.parent for f in fronts if f.parent >= 0], minlength=len(fronts))
    inverses: dict[int, Floats] = {}
    for s in range(len(fronts) - 1, -1, -1):
        front = fronts[s]
        inverse = _front_inverse(front, pivots[front.rows[: front.width]], fronts, inverses)
        if waiting[s]:
            inverses[s] = inverse
        if front.parent >= 0:
            waiting[front.parent] -= 1
            if not waiting[front.parent]:
                del inverses[front.parent]
        here = order[bounds[s] : bounds[s + 1]]
        found[here] = inverse[first[here] - s * _RANGE, np.searchsorted(front.rows, second[here])]
    return found


def _fronts(factor: SuperLU) -> list[_Front]:
    """Cut L into ranges; R of a range is what its columns touch and what the ranges below it hand on."""
    lower = factor.L
    lower.sort_indices()
    n, fronts = lower.shape[0], []
    handed: list[list[Ints]] = [[] for _ in range(0, n, _RANGE)]
    column = np.repeat(np.arange(n), np.diff(lower.indptr))
    for s, start in enumerate(range(0, n, _RANGE)):
        end = min(start + _RANGE, n)
        inside = slice(lower.indptr[start], lower.indptr[end])
        touched = lower.indices[inside].astype(np.int64)
        below = np.unique(np.concatenate([touched[touched >= end], *handed[s]]))
        rows = np.concatenate([np.arange(start, end), below])
        panel = np.zeros((len(rows), end - start))
        panel[np.searchsorted(rows, touched), column[inside] - start] = lower.data[inside]
        parent = int(below[0]) // _RANGE if len(below) else -1
        if parent >= 0:
            handed[parent].append(below[below >= (parent + 1) * _RANGE])
        handed[s].clear()
        fronts.append(_Front(rows, end - start, panel, parent))
    return fronts


def _front_inverse(front: _Front, pivots: Floats, fronts: list[_Front], inverses: dict[int, Floats]) -> Floats:
    """Return Z over the rows of a front."""
    w = front.width
    unit = lapack.dtrtri(front.panel[:w], lower=1, unitdiag=1)[0]
    unit = np.tril(unit, -1) + np.eye(w)
    corner = (unit.T / pivots) @ unit
    if front.parent < 0:
        return corner
    at = np.searchsorted(fronts[front.parent].rows, front.rows[w:])
    below = inverses[front.parent][np.ix_(at, at)]
    y = front.panel[w:] @ unit
    side = -(below @ y)
    inverse = np.empty((len(front.rows), len(front.rows)))
    inverse[:w, :w], inverse[w:, :w], inverse[:w, w:], inverse[w:, w:] = corner - y.T @ side, side, side.T, below
    return inverse
