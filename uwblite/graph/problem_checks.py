"""Checks of a least-squares problem: free unknowns, measurements, finite values; and its degrees of freedom."""

import numpy as np

from ..arrays import Floats
from ..errors import SolverError
from .graph import Edges, EdgeTable, Graph, Linearization
from .unknowns import free_unknowns


def check(graph: Graph) -> None:
    """Raise SolverError where nothing is free, nothing is measured, or a starting value is not finite."""
    if not any(mask.any() for mask in free_unknowns(graph).values()):
        raise SolverError("nothing to optimise: every pose, anchor and calibration value is fixed")
    if not sum(len(edges) for edges in graph.edges):
        raise SolverError("nothing to optimise: the graph has no edges")
    for name, values in (
        ("poses", graph.poses),
        ("anchors", graph.anchors),
        ("calibration", graph.calibration.values[:, None]),
    ):
        bad = np.nonzero(~np.isfinite(values).all(axis=1))[0]
        if len(bad):
            raise SolverError(f"starting values are not finite: {name}[{bad[0]}] = {values[bad[0]]} ({len(bad)} in all)")


def what_is_not_finite(graph: Graph, linearized: list[Linearization]) -> str:
    """Return which residuals make the cost of a graph infinite or nan."""
    for edges, lin in zip(graph.edges, linearized, strict=True):
        bad = np.nonzero(~np.isfinite(lin.residuals).all(axis=1))[0]
        if len(bad):
            kind, why = type(edges).__name__, _why_not_finite(edges, int(bad[0]))
            return f"residuals are not finite: edge {bad[0]} of {kind} ({len(bad)} in all){why}; remove such measurements"
    return "the cost is not finite although every residual is: weights or residuals are too large"


def _why_not_finite(edges: Edges, number: int) -> str:
    """Return which value of an edge is not finite, or is a sigma of 0; empty where all are sound."""
    for name, values in edges.by_edge().items() if isinstance(edges, EdgeTable) else ():
        if len(values) and not (np.isfinite(values[number]).all() and (name != "sigma" or values[number] > 0.0)):
            return f", its {name} is {values[number].tolist()}"
    return ""


def independent_residuals(graph: Graph, linearized: list[Linearization]) -> int:
    """Count the residuals of edges in use; an edge whose information is singular counts by its rank."""
    total = 0
    for edges, lin in zip(graph.edges, linearized, strict=True):
        used = slice(None) if edges.weights is None else edges.weights > 0
        jacobians = np.concatenate([jac for _, _, jac in lin.blocks], axis=2)[used]
        gram = jacobians @ jacobians.transpose(0, 2, 1)
        total += gram.shape[0] * gram.shape[1]
        doubtful = gram[np.abs(_determinants(gram)) <= 1e-12 * np.prod(np.einsum("eii->ei", gram), axis=1)]
        total -= int(np.sum(gram.shape[1] - np.linalg.matrix_rank(doubtful, hermitian=True)))
    return total


def _determinants(matrices: Floats) -> Floats:
    """Return the determinants (e,) of matrices (e, d, d); of 3 x 3, triple products of rows take a tenth of the time."""
    if matrices.shape[1] != 3:
        return np.asarray(np.linalg.det(matrices))
    return np.einsum("ei,ei->e", matrices[:, 0], np.cross(matrices[:, 1], matrices[:, 2]))
