"""Parts of a graph that no edge ties to anything fixed: each may stand anywhere as a whole."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..arrays import Ints
from .graph import Graph, PriorEdges
from .unknowns import free_unknowns


def floating_components(graph: Graph) -> Ints:
    """Return for each pose (n,) the first pose of its part, -1 where a fixed unknown or a prior holds the part."""
    n, nodes = len(graph.poses), len(graph.poses) + len(graph.anchors)
    first = {"poses": 0, "anchors": n}
    links, tied = [np.zeros((2, 0), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for edges in graph.edges:
        ends = [first[name] + index for name, index, _ in edges.linearize(graph).blocks if name in first]
        links += [np.stack([ends[0], end]) for end in ends[1:]]
        tied += ends if isinstance(edges, PriorEdges) else []
    free = free_unknowns(graph)
    tied += [first[name] + np.flatnonzero(~free[name]) for name in first]
    one, other = np.concatenate(links, axis=1)
    label = connected_components(csr_matrix((np.ones(len(one)), (one, other)), shape=(nodes, nodes)), directed=False)[1]
    begins = np.unique(label[:n], return_index=True)
    start = np.full(nodes, -1)
    start[begins[0]] = begins[1]
    start[label[np.concatenate(tied)]] = -1
    return np.asarray(start[label[:n]])
