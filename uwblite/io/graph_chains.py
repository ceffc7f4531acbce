"""Initial poses of a graph file that has none: along its relative poses."""

import math

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from .. import se2
from ..arrays import Floats, Ints


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
    # One more node stands for everything known; its links are the shortest.
    given = np.flatnonzero(known)
    rows = np.concatenate([i, np.full(len(given), n)])
    cols = np.concatenate([j, given])
    cost = np.concatenate([np.where(np.abs(j - i) == 1, 2.0, 3.0), np.ones(len(given))])
    key = np.minimum(rows, cols) * (n + 1) + np.maximum(rows, cols)
    key, link = np.unique(key, return_index=True)
    links = csr_matrix((cost[link], (key // (n + 1), key % (n + 1))), shape=(n + 1, n + 1))
    order, parent = breadth_first_order(minimum_spanning_tree(links), n, directed=False)
    node = order[1:][~known[order[1:]]].astype(np.int64)
    parent = parent[node].astype(np.int64)
    edge = link[np.searchsorted(key, np.minimum(node, parent) * (n + 1) + np.maximum(node, parent))]
    step = np.where((j[edge] == node)[:, None], T_i_j[edge], se2.inverse(T_i_j[edge]))
    result = np.where(known[:, None], poses, np.nan)
    for k, p, (dx, dy, turn) in zip(node.tolist(), parent.tolist(), step.tolist(), strict=True):
        x, y, theta = result[p].tolist()
        c, sn = math.cos(theta), math.sin(theta)
        result[k] = x + c * dx - sn * dy, y + sn * dx + c * dy, math.remainder(theta + turn, 2.0 * math.pi)
    return result
