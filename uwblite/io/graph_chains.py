"""Initial poses of a graph file that has none: along its relative poses, from given or fixed unknowns."""

import math
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from .. import se2
from ..arrays import Floats, Ints
from ..graph.components import given_anchors
from ..graph.graph import Graph, PriorEdges
from ..graph.point_edges import seen_anchors
from ..graph.pose_edges import RelativePoseEdges


def along_edges(graph: Graph) -> tuple[Graph, Ints]:
    """Return a graph with a start for its poses, and for the landmarks that edges see or priors place; and chains (n,).

    Chain 0 stands in the map's frame: what is given, what has a prior, and what edges tie to these; in a graph that holds
    nothing anywhere, the part of the first pose, which is the origin. Every other chain, which only ranges and landmarks
    may tie to it, begins at the origin and wants a place.

    Parameters
    ----------
    graph : poses and anchors that are given, nan where none is.
    """
    poses, anchors = graph.poses, graph.anchors.copy()
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    steps = [np.concatenate([getattr(e, name) for e in relative]) for name in ("i", "j", "T_i_j")] if relative else None
    priors: dict[str, dict[int, Floats]] = {"poses": {}, "anchors": {}}
    for e in graph.edges:
        if isinstance(e, PriorEdges):
            priors[e.block] |= dict(zip(e.index.tolist(), e.value, strict=True))
    for anchor, place in priors["anchors"].items():
        anchors[anchor] = place if np.isnan(anchors[anchor, 0]) else anchors[anchor]
    chains = np.zeros(len(poses), dtype=np.intp)
    given = bool(np.isfinite(poses[:, 0]).any() or given_anchors(graph).any())
    poses = chained_poses(poses, *steps) if steps and np.isfinite(poses[:, 0]).any() else poses
    while len(lost := np.flatnonzero(np.isnan(poses[:, 0]))):
        pinned = [k for k in lost.tolist() if k in priors["poses"]]
        start = poses.copy()
        start[pinned[0] if pinned else lost[0]] = priors["poses"][pinned[0]] if pinned else 0.0
        reached = chained_poses(start, *steps) if steps else start
        if not pinned and given:
            chains[np.isnan(poses[:, 0]) & ~np.isnan(reached[:, 0])] = chains.max() + 1
        poses, given = reached, True
    framed = replace(graph, anchors=anchors, poses=np.where((chains == 0)[:, None], poses, np.nan))
    return replace(graph, anchors=seen_anchors(framed), poses=poses), chains


def chained_poses(poses: Floats, i: Ints, j: Ints, T_i_j: Floats) -> Floats:
    """Return poses (n, 3) with the unknown ones reached from known ones along edges, steps i -> i + 1 preferred.

    Parameters
    ----------
    poses : (n, 3) given poses, nan where unknown; where all are, the first pose is the origin.
    i, j, T_i_j : (e,), (e,), (e, 3) measured poses of j in i.

    Returns
    -------
    (n, 3); nan where no edges lead.
    """
    n, known = len(poses), ~np.isnan(poses[:, 0])
    if known.all():
        return poses
    if not known.any():
        known[0], poses = True, np.zeros((n, 3))
    # One further node represents everything known; its links are the shortest.
    given = np.flatnonzero(known)
    rows = np.concatenate([i, np.full(len(given), n)])
    cols = np.concatenate([j, given])
    cost = np.concatenate([np.where(np.abs(j - i) == 1, 2.0, 3.0), np.ones(len(given))])
    key = np.minimum(rows, cols) * (n + 1) + np.maximum(rows, cols)
    key, link = np.unique(key, return_index=True)
    links = csr_matrix((cost[link], (key // (n + 1), key % (n + 1))), shape=(n + 1, n + 1))
    order, parent = breadth_first_order(minimum_spanning_tree(links), n, directed=False)
    node = order[1:][~known[order[1:]]].astype(np.intp)
    parent = parent[node].astype(np.intp)
    edge = link[np.searchsorted(key, np.minimum(node, parent) * (n + 1) + np.maximum(node, parent))]
    step = np.where((j[edge] == node)[:, None], T_i_j[edge], se2.inverse(T_i_j[edge]))
    result = np.where(known[:, None], poses, np.nan)
    for k, p, (dx, dy, turn) in zip(node.tolist(), parent.tolist(), step.tolist(), strict=True):
        x, y, theta = result[p].tolist()
        c, sn = math.cos(theta), math.sin(theta)
        result[k] = x + c * dx - sn * dy, y + sn * dx + c * dy, math.remainder(theta + turn, 2.0 * math.pi)
    return result
