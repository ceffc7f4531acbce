"""Connected components of a graph; a component without a fixed unknown may move as a whole."""

import numpy as np

from ..arrays import Bools, Ints, connected
from .distance_edges import PointDistanceEdges
from .graph import Graph, PriorEdges
from .point_edges import LandmarkEdges
from .range_edges import RangeEdges
from .unknowns import free_unknowns


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
