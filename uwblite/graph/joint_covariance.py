"""Covariances among chosen poses of an optimised graph: what is left once all others are eliminated."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.linalg import lapack

from ..arrays import Floats, Ints
from .graph import Graph
from .marginals import factor_of, relative_covariances
from .normal_equations import filled

_PAIRS_AT_ONCE = 1 << 14
"""Pairs of poses whose covariances are computed together; a bound on the memory."""
_COLUMNS_AT_ONCE = 256
"""Columns of a factor that are made dense together; a bound on the memory."""


class JointCovariance:
    """Covariances among some poses of a graph given all its measurements: of all their pairs at once."""

    def __init__(self, graph: Graph, poses: Ints) -> None:
        """Eliminate everything else; the rest of the factor is that of the poses' own information matrix.

        With the chosen poses last, H = L D L^T ends in a dense block L2 D2 L2^T, their information once all others are
        marginalised out, and its inverse is W^T W with W = D2^-1/2 L2^-1.
        """
        number, size, lower, pivots, place = _last_block(graph, poses)
        whitened = lapack.dtrtri(lower, lower=1, unitdiag=1, overwrite_c=1)[0]
        whitened /= np.sqrt(pivots)[:, None]
        self._graph = graph
        self._lower: Floats = lapack.dlauum(whitened, lower=1, overwrite_c=1)[0]
        self._row = np.where(number >= size, place[np.maximum(number - size, 0)], -1)

    def relative(self, i: ArrayLike, j: ArrayLike) -> Floats:
        """Return the covariances (m, 3, 3) of between(X_i, X_j) in its own coordinates, for chosen poses i (m,), j (m,)."""
        i, j = np.atleast_1d(np.asarray(i, dtype=np.int64)), np.atleast_1d(np.asarray(j, dtype=np.int64))
        found = np.empty((len(i), 3, 3))
        for first in range(0, len(i), _PAIRS_AT_ONCE):
            part = slice(first, first + _PAIRS_AT_ONCE)
            a, b = i[part], j[part]
            own = self._among(a, a), self._among(b, b)
            found[part] = relative_covariances(self._graph, a, b, *own, self._among(a, b))
        return found

    def _among(self, a: Ints, b: Ints) -> Floats:
        """Return the covariances (m, 3, 3) between poses a (m,) and b (m,)."""
        row, column = self._row[a][:, :, None], self._row[b][:, None, :]
        covariance = self._lower[np.maximum(row, column), np.minimum(row, column)]
        return np.asarray(covariance * ((row >= 0) & (column >= 0)))


def _last_block(graph: Graph, poses: Ints) -> tuple[Ints, int, Floats, Floats, Ints]:
    """Return the end of the factor with these poses last: their places among the unknowns (k, 3), -1 = fixed, and what it
    takes to read it: where the block begins, L2 (n, n), the diagonal of D2 (n,), and each unknown's row in them (n,)."""
    normal = filled(graph, last=poses)
    factor, number, size = factor_of(normal), normal.unknowns.number["poses"], normal.unknowns.size
    # Behind the chosen poses stand only anchors and calibration.
    first = int(np.sum(number >= 0)) - int(np.sum(number[poses] >= 0))
    place = factor.perm_c[np.arange(first, size)].astype(np.int64)
    inside = np.sort(place)
    lower, pivots = factor.L, factor.U.diagonal()[inside]
    # They hold the factor twice more, and what it was made of.
    del normal, factor
    return number, first, _dense(lower, inside), pivots, np.searchsorted(inside, place)


def _dense(matrix: sparse.csc_matrix, rows: Ints) -> Floats:
    """Return some rows (n,) of a square matrix and the same columns as a dense matrix (n, n), by columns in memory."""
    block = np.empty((len(rows), len(rows)), order="F")
    for first in range(0, len(rows), _COLUMNS_AT_ONCE):
        part = slice(first, first + _COLUMNS_AT_ONCE)
        block[:, part] = matrix[:, rows[part]][rows].toarray()
    return block
