"""Covariances among chosen unknowns of an optimised graph: the inverse of the matrix that remains once all others are
eliminated."""

from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU

from .. import se2
from ..arrays import Floats, Ints
from ..errors import SINGULAR, SolverError
from .factorization import Factor
from .graph import Graph
from .marginals import factor_of
from .normal_equations import filled

_PAIRS_AT_ONCE = 1 << 14
"""Pairs of poses whose covariances are computed together; a bound on the memory."""
_COLUMNS_AT_ONCE = 256
"""Columns of a factor that are made dense together; a bound on the memory."""


class JointCovariance:
    """Covariances among some poses of a graph given all its measurements: of all their pairs at once."""

    def __init__(self, graph: Graph, poses: Ints) -> None:
        """Eliminate all other unknowns; the rest of the factor is that of the poses' own information matrix."""
        number, first, lower, pivots, place = _end(graph, poses)
        self._graph = graph
        self._lower = _inverse(lower, pivots)
        self._row = np.where(number >= first, place[np.maximum(number - first, 0)], -1)

    def relative(self, i: ArrayLike, j: ArrayLike) -> Floats:
        """Return the covariances (m, 3, 3) of between(X_i, X_j) in its own coordinates, for chosen poses i (m,), j (m,)."""
        i, j = np.atleast_1d(np.asarray(i, dtype=np.intp)), np.atleast_1d(np.asarray(j, dtype=np.intp))
        found = np.empty((len(i), 3, 3))
        for first in range(0, len(i), _PAIRS_AT_ONCE):
            part = slice(first, first + _PAIRS_AT_ONCE)
            a, b = i[part], j[part]
            by_a, by_b = se2.between_jacobians(self._graph.poses[a], self._graph.poses[b])
            mixed = by_a @ self._among(a, b) @ by_b.transpose(0, 2, 1)
            own = by_a @ self._among(a, a) @ by_a.transpose(0, 2, 1) + by_b @ self._among(b, b) @ by_b.transpose(0, 2, 1)
            found[part] = own + mixed + mixed.transpose(0, 2, 1)
        return found

    def _among(self, a: Ints, b: Ints) -> Floats:
        """Return the covariances (m, 3, 3) between poses a (m,) and b (m,)."""
        row, column = self._row[a][:, :, None], self._row[b][:, None, :]
        covariance = self._lower[np.maximum(row, column), np.minimum(row, column)]
        return np.asarray(covariance * ((row >= 0) & (column >= 0)))


def calibration_covariance(graph: Graph) -> Floats:
    """Return the covariance (c, c) of the calibration values at the graph's estimates; 0 where they are fixed.

    Raises
    ------
    SolverError : the measurements leave a direction open.
    """
    normal = filled(graph)
    number = normal.unknowns.number["calibration"][:, 0]
    free, covariance = np.flatnonzero(number >= 0), np.zeros((len(number), len(number)))
    found = _inverse_among(normal.factor(np.where(normal.diagonal > 0, 0.0, 1.0)), number[free], normal.unknowns.size)
    # SuperLU accepts negative pivots.
    if not np.all(np.diagonal(found) > 0.0):
        raise SolverError(SINGULAR)
    covariance[np.ix_(free, free)] = 0.5 * (found + found.T)
    return covariance


def anchor_covariance(graph: Graph, anchors: Ints) -> Floats:
    """Return the covariance (2a, 2a) of the places of some free anchors (a,); huge in directions that are open."""
    normal = filled(graph, subtrees=True)
    number = normal.unknowns.number["anchors"][anchors].ravel()
    covariance = _inverse_among(factor_of(normal), number, normal.unknowns.size)
    unseen = np.flatnonzero(normal.diagonal[number] <= 0.0)
    covariance[unseen, unseen] = _OPEN
    return np.asarray(covariance)


_OPEN = 1e12
"""m^2; of what no edge touches."""


def _end(graph: Graph, poses: Ints) -> tuple[Ints, int, Floats, Floats, Ints]:
    """Return the end of a graph's factor H = L D L^T: the part after all poses but some, behind which anchors and calibration
    stand, are eliminated.

    Returns
    -------
    Places of the poses' scalars (n, 3), -1 = fixed; the first of the end; L2 (m, m), D2 (m,) and each unknown's row in them.
    """
    normal = filled(graph, last=poses)
    number = normal.unknowns.number["poses"]
    first = int(np.sum(number >= 0)) - int(np.sum(number[poses] >= 0))
    factor = cast(SuperLU, factor_of(normal))
    place = factor.perm_c[first:].astype(np.intp)
    inside = np.sort(place)
    lower, pivots = factor.L, factor.U.diagonal()[inside]
    # These contain two further copies of the factor, and the matrix.
    del normal, factor
    return number, first, _dense(lower, inside), pivots, np.searchsorted(inside, place)


def _inverse_among(factor: Factor, number: Ints, size: int) -> Floats:
    """Return the rows and columns (n, n) that belong to unknowns (n,) in the inverse of a factorised matrix of so many rows."""
    right = np.zeros((size, len(number)))
    right[number, np.arange(len(number))] = 1.0
    return factor.solve(right)[number]


def _inverse(lower: Floats, pivots: Floats) -> Floats:
    """Return the lower triangle of (L2 D2 L2^T)^-1 = W^T W, W = D2^-1/2 L2^-1; L2 is used up."""
    whitened = lapack.dtrtri(lower, lower=1, unitdiag=1, overwrite_c=1)[0]
    whitened /= np.sqrt(pivots)[:, None]
    return np.asarray(lapack.dlauum(whitened, lower=1, overwrite_c=1)[0])


def _dense(matrix: sparse.csc_matrix, rows: Ints) -> Floats:
    """Return some rows (n,) of a square matrix and the same columns as a dense matrix (n, n), by columns in memory."""
    block = np.empty((len(rows), len(rows)), order="F")
    for first in range(0, len(rows), _COLUMNS_AT_ONCE):
        part = slice(first, first + _COLUMNS_AT_ONCE)
        block[:, part] = matrix[:, rows[part]][rows].toarray()
    return block
