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
from scipy.linalg import lapack
from scipy.sparse.linalg import SuperLU

from .. import se2
from ..arrays import TINY, Floats, Ints, chunks
from ..errors import SINGULAR, SolverError
from .eliminated import TRACE, BlockEquations, BlockFactor, jacobian_rows
from .graph import Edges, Graph, edge_weights
from .normal_equations import NormalEquations, filled
from .selected_inverse import selected_inverse
from .unknowns import Unknowns


class MarginalsPolicy:
    """Numerical tolerances, and bounds on the memory."""

    dependent: float = 1e-13
    """Pivot, as a share of its diagonal entry, below which a direction counts as unmeasured."""
    open: float = 1.0 / TRACE
    """m^2; variance of an anchor that no edge touches, that of a direction with a trace of damping."""
    variances: Floats = np.geomspace(1e-4, 4.0, 12)[:, None]
    """Of common errors, from a hundredth to twice the size that is expected."""
    columns_at_once: int = 16
    """Columns of an inverse, each of which has the length of all unknowns."""


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
    count, size = poses.shape
    x, y = (poses[:, :2] - poses[:, :2].mean(axis=0)).T
    moves = np.tile(np.eye(size), (count, 1, 1))
    moves[:, 0, 2], moves[:, 1, 2] = -y, x
    fit = np.zeros((size, count, size))
    fit[:, :, :2] = np.linalg.pinv(moves[:, :2].reshape(-1, size)).reshape(size, count, 2)
    left = np.eye(poses.size) - moves.reshape(-1, size) @ fit.reshape(size, -1)
    whole = (left @ covariance @ left.T).reshape(count, size, count, size)
    return np.asarray(whole[np.arange(count), :, np.arange(count), :])


def shape_error(poses: Floats, covariance: Floats) -> float:
    """Return the rms error of places (m) that is expected after alignment by a similarity.

    sqrt(tr(P C P) / k) with P = 1 - Q Q^T, where Q (2 k, 4) spans translation, rotation and scale of the whole.

    Parameters
    ----------
    poses : (k, 3), spread so that they represent all. covariance : (3 k, 3 k) of them with each other.
    """
    places = poses[:, :2] - poses[:, :2].mean(axis=0)
    own = covariance.reshape(*poses.shape, *poses.shape)[:, :2, :, :2].reshape(places.size, places.size)
    turn = places @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    q = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(poses), 1)), turn.ravel(), places.ravel()]))[0]
    return float(np.sqrt(max(np.trace(own) - np.trace(q.T @ own @ q), 0.0) / len(poses)))


class Marginals:
    """The inverse of a graph's normal equations, and the covariances of its unknowns given all its measurements.

    An undetermined direction (a mirror image, a floating part of the graph) has a variance of about 1e12 in units of its
    curvature.
    """

    def __init__(self, graph: Graph, normal: NormalEquations, among: ArrayLike, further: BlockEquations | None) -> None:
        self._graph, self.unknowns, self._gradient = graph, normal.unknowns, normal.gradient
        self._factor = _factor(normal, further)
        self.unseen = np.append(normal.diagonal <= 0, False)
        """(size + 1,) scalars that no edge touches."""
        self._chosen = np.asarray(among, dtype=np.intp)

    @cached_property
    def covariances(self) -> Covariances:
        """Covariances of single unknowns, and among the chosen poses."""
        blocks = self._block_diagonal()
        among = self.among(self.unknowns.number["poses"][self._chosen].ravel())
        return Covariances(blocks["poses"], blocks["anchors"], np.sqrt(blocks["calibration"][:, 0, 0]), self._chosen, among)

    def estimated(self, edges: Edges, shifts: sparse.csr_matrix) -> Floats:
        """Return the values (k,) of errors that edges of the graph have in common, estimated with all other unknowns.

        The errors u are unknowns with the prior N(0, g): u = -(A + 1 / g)^-1 S^T P r, where P = W - W J (J^T W J)^-1 J^T W and
        A = S^T P S (best linear unbiased prediction: C. R. Henderson, Biometrics 31, 1975), in the mean over g by marginal
        likelihood.

        Parameters
        ----------
        shifts : S (e d, k), change of their whitened residuals by each error of the size that is expected.
        """
        total, explained, seen = self.score(edges, shifts)
        products, variances = total - explained, MarginalsPolicy.variances
        values, vectors = np.linalg.eigh(0.5 * (products + products.T))
        inside, z = 1.0 + variances * np.maximum(values, 0.0), vectors.T @ seen
        worth = 0.5 * np.sum(variances * z**2 / inside - np.log(inside), axis=1)
        likely = np.exp(worth - worth.max())
        return np.asarray(-vectors @ (likely @ (variances / inside) / likely.sum() * z))

    def score(self, edges: Edges, shifts: sparse.csr_matrix) -> tuple[Floats, Floats, Floats]:
        """Return S^T W S (k, k), its part S^T W J H^-1 J^T W S that the graph explains, and S^T P r (k,); see estimated."""
        weighted, slopes = self._weighted(edges, shifts), self.slopes(edges, shifts)
        moves = self.solve(slopes.toarray())
        seen = weighted.T @ edges.residuals(self._graph).ravel() - moves.T @ self._gradient
        return (weighted.T @ shifts).toarray(), slopes.T @ moves, seen

    def slopes(self, edges: Edges, shifts: sparse.csr_matrix) -> sparse.csc_matrix:
        """Return J^T W S (unknowns, k) of errors of edges; see estimated."""
        jacobian = jacobian_rows(edges.linearize(self._graph), self.unknowns)
        return sparse.csc_matrix(jacobian.T @ self._weighted(edges, shifts))

    def _weighted(self, edges: Edges, shifts: sparse.csr_matrix) -> sparse.csr_matrix:
        """Return W S."""
        weights = edge_weights(edges, self._graph)
        return sparse.csr_matrix(sparse.diags(np.repeat(weights, shifts.shape[0] // len(weights))) @ shifts)

    def _block_diagonal(self) -> dict[str, Floats]:
        """Return by block of unknowns the covariance of each with itself."""
        found = {}
        for name, number in self.unknowns.number.items():
            rows, columns = np.broadcast_arrays(number[:, :, None], number[:, None, :])
            found[name] = rows, columns
        row, column = (np.concatenate([pair[k].ravel() for pair in found.values()]) for k in (0, 1))
        free = row >= 0
        values = np.zeros(len(row))
        values[free] = selected_inverse(self._factor, row[free], column[free])
        values[self.unseen[row] & (row == column)] = np.inf
        shapes = {name: rows.shape for name, (rows, _) in found.items()}
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])[:-1]
        return {name: v.reshape(shapes[name]) for name, v in zip(shapes, np.split(values, ends), strict=True)}

    def solve(self, right: Floats) -> Floats:
        """Return H^-1 times right (size, m)."""
        return np.asarray(self._factor.solve(right))

    def columns(self, numbers: Ints) -> Floats:
        """Return columns (size + 1, m) of the covariance; the last row and the columns of fixed scalars (-1) are 0."""
        right = np.zeros((self.unknowns.size + 1, len(numbers)))
        right[numbers, np.arange(len(numbers))] = 1.0
        right[-1] = 0.0
        right[:-1] = self.solve(right[:-1])
        return right

    def among(self, numbers: Ints) -> Floats:
        """Return the covariance (m, m) of scalars with each other; that of fixed ones (-1) is 0."""
        parts = [self.columns(numbers[part])[numbers] for part in chunks(len(numbers), MarginalsPolicy.columns_at_once)]
        return np.concatenate([np.zeros((len(numbers), 0)), *parts], axis=1)


def _factor(normal: NormalEquations, further: BlockEquations | None) -> SuperLU | BlockFactor:
    """Factorise H, and further measurements with it, where it is regular, else with a trace of damping that leaves open
    directions open."""
    seen = normal.diagonal > 0
    once = np.where(seen, normal.diagonal, 1.0)
    try:
        factor = _damped(normal, further, np.where(seen, 0.0, 1.0))
        pivots = factor.U.diagonal()[factor.perm_c[: len(seen)]]
        if np.all(pivots > MarginalsPolicy.dependent * once):
            return factor
    except SolverError:
        pass
    return _damped(normal, further, np.where(seen, TRACE * once, 1.0))


def _damped(normal: NormalEquations, further: BlockEquations | None, damping: Floats) -> SuperLU | BlockFactor:
    return cast(SuperLU, normal.factor(damping)) if further is None else BlockFactor(normal, further, damping)


def marginals(graph: Graph, among: ArrayLike = (), further: Callable[[Unknowns], BlockEquations] | None = None) -> Marginals:
    """Return the marginal covariances (J^T W J)^-1 at the graph's estimates, with the robust weights as they stand.

    Parameters
    ----------
    among : poses (k,) whose joint covariance is wanted.
    further : gives measurements beside the graph's edges by the numbers of its unknowns, see graph/eliminated.py.
    """
    normal = filled(graph, last=())
    return Marginals(graph, normal, among, None if further is None else further(normal.unknowns))


class JointCovariance:
    """Covariances among some poses of a graph given all its measurements: of all their pairs at once."""

    def __init__(self, graph: Graph, poses: Ints) -> None:
        normal = filled(graph, last=poses)
        whole = _end_of_inverse(cast(SuperLU, _factor(normal, None)), normal.unknowns.number["poses"][poses].ravel())
        self._graph, self._row = graph, np.full(len(graph.poses), -1)
        self._row[poses] = np.arange(len(poses))
        self._blocks = whole.reshape(len(poses), *se2.POSE, len(poses), *se2.POSE).swapaxes(1, 2)

    def relative(self, i: ArrayLike, j: ArrayLike) -> Floats:
        """Return the covariances (m, 3, 3) of between(X_i, X_j) in its own coordinates, for chosen poses i (m,), j (m,)."""
        i, j = np.atleast_1d(np.asarray(i, dtype=np.intp)), np.atleast_1d(np.asarray(j, dtype=np.intp))
        found = np.empty((len(i), *se2.POSE, *se2.POSE))
        for part in chunks(len(i)):
            by_a, by_b = se2.between_jacobians(self._graph.poses[i[part]], self._graph.poses[j[part]])
            a, b = self._row[i[part]], self._row[j[part]]
            mixed = by_a @ self._blocks[a, b] @ by_b.transpose(0, 2, 1)
            own = by_a @ self._blocks[a, a] @ by_a.transpose(0, 2, 1) + by_b @ self._blocks[b, b] @ by_b.transpose(0, 2, 1)
            found[part] = own + mixed + mixed.transpose(0, 2, 1)
        return found


def _end_of_inverse(factor: SuperLU, numbers: Ints) -> Floats:
    """Return the inverse (m, m) at numbers (m,), 0 at fixed scalars (-1), from the end of H = L D L^T behind the first."""
    first = np.min(numbers, initial=len(factor.perm_c), where=numbers >= 0)
    end = np.sort(factor.perm_c[first:]).astype(np.intp)
    root, row = factor.L[:, end][end].toarray(order="F"), np.searchsorted(end, factor.perm_c[numbers])
    if len(end):
        root = lapack.dtrtri(root, lower=1, unitdiag=1, overwrite_c=1)[0]
    root /= np.sqrt(factor.U.diagonal()[end])[:, None]
    found = np.pad(root.T @ root, (0, 1))[np.ix_(row, row)]
    found[numbers < 0] = found[:, numbers < 0] = 0.0
    return np.asarray(found)


def calibration_covariance(graph: Graph) -> Floats:
    """Return the covariance (c, c) of the calibration values at the graph's estimates; 0 where they are fixed.

    Raises
    ------
    SolverError : the measurements leave a direction open.
    """
    normal = filled(graph)
    number = normal.unknowns.number["calibration"][:, 0]
    free, covariance = np.flatnonzero(number >= 0), np.zeros((len(number), len(number)))
    right = np.zeros((normal.unknowns.size, len(free)))
    right[number[free], np.arange(len(free))] = 1.0
    found = normal.factor(np.where(normal.diagonal > 0, 0.0, 1.0)).solve(right)[number[free]]
    # SuperLU accepts negative pivots.
    if not np.all(np.diagonal(found) > 0.0):
        raise SolverError(SINGULAR)
    covariance[np.ix_(free, free)] = 0.5 * (found + found.T)
    return covariance


def anchor_covariance(graph: Graph, anchors: Ints) -> Floats:
    """Return the covariance (2a, 2a) of the places of some free anchors (a,); huge in directions that are open."""
    found = marginals(graph)
    number = found.unknowns.number["anchors"][anchors].ravel()
    covariance, unseen = found.among(number), np.flatnonzero(found.unseen[number])
    covariance[unseen, unseen] = MarginalsPolicy.open
    return covariance


def added_unknown(graph: Graph, edges: Edges, shifts: Floats) -> tuple[Floats, Floats]:
    """Estimate, each alone, further unknowns of some edges of an optimised graph, to first order.

    With J, r and W of the whole graph and s the change of the residuals by one unit of the unknown: its value is -b / a and its
    standard deviation a^-1/2, with a = s^T P s and b = s^T P r, P = W - W J H^-1 J^T W (C. R. Rao, Large sample tests of
    statistical hypotheses, 1948). The part that the graph explains by its own unknowns is subtracted.

    Parameters
    ----------
    edges : of the graph. shifts : (k, e, d) changes of their whitened residuals by one unit of each unknown.

    Returns
    -------
    (k,) values and (k,) standard deviations, in the unknowns' units; infinite where the graph explains the shifts wholly.
    """
    if not len(shifts):
        return np.zeros(0), np.zeros(0)
    total, explained, score = marginals(graph).score(edges, sparse.csr_matrix(shifts.reshape(len(shifts), -1).T))
    whole = np.diagonal(total)
    left = whole - np.diagonal(explained)
    seen = left > TINY * whole
    divisor = np.where(seen, left, 1.0)
    return np.where(seen, -score / divisor, 0.0), np.where(seen, 1.0 / np.sqrt(divisor), np.inf)
