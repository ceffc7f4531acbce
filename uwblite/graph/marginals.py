"""Covariances of the unknowns of an optimised graph, from the sparse factor of its normal equations.

With the same factor a further unknown that the model does not have is estimated without solving the graph again (score test).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from ..arrays import Floats, Ints
from ..errors import SolverError
from .eliminated import Blocks, WithBlocks, rows_of
from .factorization import counted
from .graph import Edges, Graph, edge_weights
from .normal_equations import NormalEquations, filled
from .selected_inverse import selected_inverse
from .unknowns import Unknowns


@dataclass(frozen=True, slots=True, eq=False)
class Covariances:
    """Marginal covariances of all unknowns, and the joint one of some poses.

    Zero where an unknown is fixed, infinite on the diagonal where no edge touches it.
    """

    poses: Floats
    """(n, 3, 3) of x, y, theta, map frame, m and rad."""
    anchors: Floats
    """(a, 2, 2) m^2, map frame."""
    calibration: Floats
    """(c,) standard deviations, unit by name."""
    chosen: Ints
    """(k,) poses whose joint covariance is known."""
    among: Floats
    """(3 k, 3 k) of the k chosen poses with each other, x, y, theta of each in turn."""


def about_best_fit(poses: Floats, covariance: Floats) -> Floats:
    """Return the covariances (k, 3, 3) of poses in the frame that fits all of them best, not that of the first pose.

    The fit is the rigid motion ``xi = A^+ e`` of least squares that the errors e of the places have in common; what is left at
    each pose is ``e_i - G_i xi``.

    Parameters
    ----------
    poses : (k, 3), spread so that they represent all. covariance : (3 k, 3 k) of them with each other.
    """
    count = len(poses)
    x, y = (poses[:, :2] - poses[:, :2].mean(axis=0)).T
    moves = np.tile(np.eye(3), (count, 1, 1))
    moves[:, 0, 2], moves[:, 1, 2] = -y, x
    fit = np.zeros((3, count, 3))
    fit[:, :, :2] = np.linalg.pinv(moves[:, :2].reshape(-1, 3)).reshape(3, count, 2)
    left = np.eye(3 * count) - moves.reshape(-1, 3) @ fit.reshape(3, -1)
    whole = (left @ covariance @ left.T).reshape(count, 3, count, 3)
    return np.asarray(whole[np.arange(count), :, np.arange(count), :])


def shape_error(poses: Floats, covariance: Floats) -> float:
    """Return the rms error of places (m) that is expected after alignment by a similarity.

    sqrt(tr(P C P) / k) with P = 1 - Q Q^T, where Q (2 k, 4) spans translation, rotation and scale of the whole.

    Parameters
    ----------
    poses : (k, 3), spread so that they represent all. covariance : (3 k, 3 k) of them with each other.
    """
    places = poses[:, :2] - poses[:, :2].mean(axis=0)
    own = covariance.reshape(len(poses), 3, len(poses), 3)[:, :2, :, :2].reshape(places.size, places.size)
    turn = places @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    q = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(poses), 1)), turn.ravel(), places.ravel()]))[0]
    return float(np.sqrt(max(np.trace(own) - np.trace(q.T @ own @ q), 0.0) / len(poses)))


_VARIANCES = np.geomspace(1e-4, 4.0, 12)[:, None]
"""Variances of common errors, from a hundredth to twice the size that is expected."""
_DEPENDENT = 1e-13
"""Pivot, as a share of its diagonal entry, below which a direction counts as unmeasured."""


class Marginals:
    """The inverse of a graph's normal equations, and the covariances of its unknowns given all its measurements.

    An undetermined direction (a mirror image, a floating part of the graph) has a variance of about 1e12 in units of its
    curvature.
    """

    def __init__(self, graph: Graph, normal: NormalEquations, among: ArrayLike = (), further: Blocks | None = None) -> None:
        self._graph, self.unknowns, self._gradient = graph, normal.unknowns, normal.gradient
        self._factor = factor_of(normal, further)
        self._unseen = np.append(normal.diagonal <= 0, False)
        self._among = np.asarray(among, dtype=np.intp)

    @cached_property
    def covariances(self) -> Covariances:
        """Covariances of single unknowns, and among the chosen poses."""
        blocks = self._block_diagonal()
        chosen = self.unknowns.number["poses"][self._among].ravel()
        parts = [chosen[k : k + _COLUMNS_AT_ONCE] for k in range(0, max(len(chosen), 1), _COLUMNS_AT_ONCE)]
        among = np.concatenate([self.columns(part)[chosen] for part in parts], axis=1)
        return Covariances(blocks["poses"], blocks["anchors"], np.sqrt(blocks["calibration"][:, 0, 0]), self._among, among)

    def estimated(self, edges: Edges, shifts: sparse.csr_matrix) -> Floats:
        """Return the values (k,) of errors that edges of the graph have in common, estimated with all other unknowns.

        The errors u are unknowns with the prior N(0, g): u = -(A + 1 / g)^-1 S^T P r, where P = W - W J (J^T W J)^-1 J^T W and
        A = S^T P S (best linear unbiased prediction: C. R. Henderson, Biometrics 31, 1975), in the mean over g by marginal
        likelihood.

        Parameters
        ----------
        shifts : S (e d, k), change of their whitened residuals by each error of the size that is expected.
        """
        weighted, slopes = self._weighted(edges, shifts), self.slopes(edges, shifts)
        moves = self._factor.solve(slopes.toarray())
        seen = weighted.T @ edges.residuals(self._graph).ravel() - moves.T @ self._gradient
        products = (weighted.T @ shifts).toarray() - slopes.T @ moves
        values, vectors = np.linalg.eigh(0.5 * (products + products.T))
        inside, z = 1.0 + _VARIANCES * np.maximum(values, 0.0), vectors.T @ seen
        worth = 0.5 * np.sum(_VARIANCES * z**2 / inside - np.log(inside), axis=1)
        likely = np.exp(worth - worth.max())
        return np.asarray(-vectors @ (likely @ (_VARIANCES / inside) / likely.sum() * z))

    def slopes(self, edges: Edges, shifts: sparse.csr_matrix) -> sparse.csc_matrix:
        """Return J^T W S (unknowns, k) of errors of edges; see estimated."""
        jacobian = rows_of(edges.linearize(self._graph), self.unknowns)
        return sparse.csc_matrix(jacobian.T @ self._weighted(edges, shifts))

    def _weighted(self, edges: Edges, shifts: sparse.csr_matrix) -> sparse.csr_matrix:
        """Return W S."""
        weights = edge_weights(edges, self._graph)
        return sparse.csr_matrix(sparse.diags(np.repeat(weights, shifts.shape[0] // len(weights))) @ shifts)

    def _block_diagonal(self) -> dict[str, Floats]:
        """Return by block of unknowns the covariance of each with itself."""
        numbers = self.unknowns.number
        rows = {name: np.broadcast_to(n[:, :, None], (*n.shape, n.shape[1])) for name, n in numbers.items()}
        columns = {name: np.broadcast_to(n[:, None, :], (*n.shape, n.shape[1])) for name, n in numbers.items()}
        row, column = (np.concatenate([part[name].ravel() for name in numbers]) for part in (rows, columns))
        free = row >= 0
        values = np.zeros(len(row))
        values[free] = selected_inverse(self._factor, row[free], column[free])
        values[self._unseen[row] & (row == column)] = np.inf
        ends = np.cumsum([part.size for part in rows.values()])[:-1]
        return {name: v.reshape(rows[name].shape) for name, v in zip(numbers, np.split(values, ends), strict=True)}

    def solve(self, right: Floats) -> Floats:
        """Return H^-1 times right (size, m)."""
        return np.asarray(self._factor.solve(right))

    def columns(self, numbers: Ints) -> Floats:
        """Return columns (size + 1, m) of the covariance; the last row and the columns of fixed scalars (-1) are 0."""
        right = np.zeros((self.unknowns.size + 1, len(numbers)))
        right[numbers, np.arange(len(numbers))] = 1.0
        right[-1] = 0.0
        right[:-1] = self._factor.solve(right[:-1])
        return right


def factor_of(normal: NormalEquations, further: Blocks | None = None) -> SuperLU | WithBlocks:
    """Factorise H, and further measurements with it, where it is regular, else with a trace of damping that leaves open
    directions open."""
    diagonal = normal.diagonal
    seen = diagonal > 0
    try:
        factor = _factor(normal, further, np.where(seen, 0.0, 1.0))
        pivots = factor.U.diagonal()[factor.perm_c[: len(seen)]]
        if np.all(pivots > _DEPENDENT * np.where(seen, diagonal, 1.0)):
            return factor
    except SolverError:
        pass
    return _factor(normal, further, np.where(seen, 1e-12 * diagonal, 1.0))


def _factor(normal: NormalEquations, further: Blocks | None, damping: Floats) -> SuperLU | WithBlocks:
    if further is None:
        return cast(SuperLU, normal.factor(damping))
    found = WithBlocks(sparse.csc_matrix(normal.matrix + sparse.diags(damping)), further)
    counted(found, normal.spent)
    return found


def marginals(graph: Graph, among: ArrayLike = (), further: Callable[[Unknowns], Blocks] | None = None) -> Marginals:
    """Return the marginal covariances (J^T W J)^-1 at the graph's estimates, with the robust weights as they stand.

    Parameters
    ----------
    further : gives measurements beside the graph's edges by the numbers of its unknowns, see graph/eliminated.py.
    """
    normal = filled(graph, subtrees=True)
    return Marginals(graph, normal, among, None if further is None else further(normal.unknowns))


_COLUMNS_AT_ONCE = 16
"""Columns of an inverse solved for at once; a bound on the memory, since each has the length of all unknowns."""


def added_unknown(graph: Graph, edges: Edges, shifts: Floats) -> tuple[Floats, Floats]:
    """Estimate, each alone, further unknowns of some edges of an optimised graph, to first order.

    With J, r and W of the whole graph and s the change of the residuals by one unit of the unknown: its value is -b / a and its
    standard deviation a^-1/2, with a = s^T W s - s^T W J H^-1 J^T W s and b = s^T W r - s^T W J H^-1 J^T W r (C. R. Rao, Large
    sample tests of statistical hypotheses, 1948). The part that the graph explains by its own unknowns is subtracted.

    Parameters
    ----------
    edges : of the graph. shifts : (k, e, d) changes of their whitened residuals by one unit of each unknown.

    Returns
    -------
    (k,) values and (k,) standard deviations, in the unknowns' units; infinite where the graph explains the shifts wholly.
    """
    normal = filled(graph, subtrees=True)
    lin, weighted = edges.linearize(graph), edge_weights(edges, graph)[:, None] * shifts
    right = np.asarray(rows_of(lin, normal.unknowns).T @ weighted.reshape(len(shifts), -1).T)
    solved = factor_of(normal).solve(right)
    total = np.einsum("ked,ked->k", shifts, weighted)
    left = total - np.einsum("nk,nk->k", right, solved)
    score = np.einsum("ked,ed->k", weighted, lin.residuals) - solved.T @ normal.gradient
    seen = left > _ROUNDING * total
    divisor = np.where(seen, left, 1.0)
    return np.where(seen, -score / divisor, 0.0), np.where(seen, 1.0 / np.sqrt(divisor), np.inf)


_ROUNDING = 1e-9
"""Share of the shifts below which the remainder is rounding error."""
