"""Marginal covariances of an optimised graph, from the factor of its normal equations."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import se2
from .factorization import Factor
from .graph import Graph
from .linear import NormalEquations, Unknowns
from .solver import edge_weights

Floats = NDArray[np.float64]


class Marginals:
    """Covariances of the unknowns of a graph, given all its measurements; 0 where an unknown is held fixed."""

    def __init__(self, graph: Graph, unknowns: Unknowns, factor: Factor) -> None:
        self._graph, self._unknowns, self._factor = graph, unknowns, factor
        self.poses = self._block_diagonal("poses")
        """(n, 3, 3) of x, y, theta in the map frame, m and rad."""
        self.anchors = self._block_diagonal("anchors")
        """(a, 2, 2) m^2, map frame."""
        self.calibration = np.sqrt(self._block_diagonal("calibration")[:, 0, 0])
        """(c,) standard deviations, unit by name."""

    def _columns(self, numbers: NDArray[np.int64]) -> Floats:
        """Return columns (size + 1, m) of the covariance; row -1 and the columns of held scalars (-1) are 0."""
        right = np.zeros((self._unknowns.size + 1, len(numbers)))
        right[numbers, np.arange(len(numbers))] = 1.0
        right[-1] = 0.0
        right[:-1] = self._factor.solve(right[:-1])
        return right

    def _block_diagonal(self, name: str) -> Floats:
        number = self._unknowns.number[name]
        count, width = number.shape
        blocks = np.zeros((count, width, width))
        for first in range(0, count, 128):
            part = number[first : first + 128]
            columns = self._columns(part.ravel()).reshape(-1, len(part), width)
            blocks[first : first + 128] = columns[part[:, :, None], np.arange(len(part))[:, None, None], np.arange(width)]
        return blocks

    def relative(self, i: ArrayLike, j: ArrayLike) -> Floats:
        """Return the covariances (m, 3, 3) of between(X_i, X_j) in its own coordinates, for pairs of poses i (m,), j (m,)."""
        i, j = np.atleast_1d(np.asarray(i)), np.atleast_1d(np.asarray(j))
        number = self._unknowns.number["poses"]
        sources, at = np.unique(i, return_inverse=True)
        columns = self._columns(number[sources].ravel()).reshape(-1, len(sources), 3)
        cross = columns[number[j][:, :, None], at[:, None, None], np.arange(3)]
        by_i, by_j = se2.between_jacobians(self._graph.poses[i], self._graph.poses[j])
        mixed = by_j @ cross @ by_i.transpose(0, 2, 1)
        own = by_i @ self.poses[i] @ by_i.transpose(0, 2, 1) + by_j @ self.poses[j] @ by_j.transpose(0, 2, 1)
        return own + mixed + mixed.transpose(0, 2, 1)


def marginals(graph: Graph) -> Marginals:
    """Return the marginal covariances at the graph's estimates, (J^T W J)^-1 with the robust weights as they stand."""
    linearized = [edges.linearize(graph) for edges in graph.edges]
    normal = NormalEquations(graph, linearized, banded=False)
    normal.fill(linearized, [edge_weights(edges, graph) for edges in graph.edges])
    return Marginals(graph, normal.unknowns, normal.factor(1e-12 * np.where(normal.diagonal > 0, normal.diagonal, 1.0)))
