"""What makes a problem solvable: finite starts, measurements, and a fixed unknown in each component, lest it move."""

import numpy as np

from ..arrays import TINY, Bools, Ints, connected
from ..errors import SolverError
from .graph import Edges, Graph, Linearization, PriorEdges
from .point_edges import LandmarkEdges, PointDistanceEdges
from .range_edges import RangeEdges
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
    for name, values in edges.columns().items():
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
        doubtful = gram[np.abs(np.linalg.det(gram)) <= TINY * np.prod(np.einsum("eii->ei", gram), axis=1)]
        total -= int(np.sum(gram.shape[1] - np.linalg.matrix_rank(doubtful, hermitian=True)))
    return total


def floating_components(graph: Graph) -> Ints:
    """Return for each pose (n,) the first pose of its part, -1 where a fixed unknown or a prior fixes the part."""
    n, nodes = len(graph.poses), len(graph.poses) + len(graph.anchors)
    first = {"poses": 0, "anchors": n}
    links, tied = [np.zeros((2, 0), dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for edges in graph.edges:
        ends = [first[name] + index for name, index, _ in edges.linearize(graph).blocks if name in first]
        links += [np.stack([ends[0], end]) for end in ends[1:]]
        tied += ends if isinstance(edges, PriorEdges) else []
    free = free_unknowns(graph)
    tied += [first[name] + np.flatnonzero(~free[name]) for name in first]
    one, other = np.concatenate(links, axis=1)
    label = connected(one, other, nodes)
    begins = np.unique(label[:n], return_index=True)
    start = np.full(nodes, -1)
    start[begins[0]] = begins[1]
    start[label[np.concatenate(tied)]] = -1
    return np.asarray(start[label[:n]])


def given_anchors(graph: Graph) -> Bools:
    """Return which anchors (a,) are given: fixed, or with a prior."""
    given = ~free_unknowns(graph)["anchors"]
    for e in graph.edges:
        if isinstance(e, PriorEdges) and e.block == "anchors":
            given[e.index] = True
    return given


def tied_chains(graph: Graph, chains: Ints) -> Bools:
    """Return for each pose (n,) whether ranges or landmarks connect its chain with chain 0 or with given landmarks."""
    count = int(chains.max(initial=0)) + 1
    given = np.flatnonzero(given_anchors(graph)) if not (chains == 0).any() else np.zeros(0, dtype=np.intp)
    ends = [(np.zeros(len(given), dtype=np.intp), count + given)]
    for e in graph.edges:
        if isinstance(e, PointDistanceEdges):
            ends.append((chains[e.i], chains[e.j]))
        elif isinstance(e, RangeEdges | LandmarkEdges):
            ends.append((chains[e.pose], count + e.anchor))
    one, other = (np.concatenate(column) for column in zip(*ends, strict=True))
    label = connected(one, other, count + len(graph.anchors))
    return np.asarray(label[chains] == label[0], dtype=np.bool_)
