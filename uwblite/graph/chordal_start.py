"""A start for pose graphs that needs no estimates: headings first, then places, each by linear least squares.

With headings as complex numbers z = exp(i theta), |z_j - z_i exp(i theta_ij)|^2 summed over edges is quadratic; its minimum
over all complex numbers, each then scaled to magnitude 1, gives the headings, and those the places. (D. Martinec, T. Pajdla,
Robust rotation and translation estimation in multiview reconstruction, CVPR 2007; L. Carlone, R. Tron, K. Daniilidis,
F. Dellaert, Initialization techniques for 3D SLAM, ICRA 2015.)
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import Bools, Complexes, Floats, Ints
from ..errors import SolverError
from .elimination import multiplications_of, slower_than_iteration
from .factorization import superlu
from .graph import Graph
from .pose_edges import RelativePoseEdges
from .unknowns import free_unknowns


def chordal_start(graph: Graph) -> Graph | None:
    """Return the graph with poses from its relative poses alone, None where these close no loop or leave a pose open, or
    connect so many poses with so many others that the matrix would fill up.

    What is fixed stays; anchors stay as well.
    """
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    free = free_unknowns(graph)["poses"]
    free[0] &= not free.all()
    if sum(map(len, relative)) <= free.sum():
        return None
    i, j, T = (np.concatenate([getattr(e, name) for e in relative]) for name in ("i", "j", "T_i_j"))
    information = np.concatenate([np.sum(e.sqrt_information**2, axis=1) * e.own_weights[:, None] for e in relative])
    z = se2.unit_complex(graph.poses[:, 2])
    places = se2.as_complex(graph.poses)
    try:
        z = _solved((i, j), se2.unit_complex(T[:, 2]), np.zeros(len(i), complex), information[:, 2], z, free)
        z /= np.maximum(np.abs(z), np.finfo(np.float64).tiny)
        step = z[i] * se2.as_complex(T)
        places = _solved((i, j), np.ones(len(i), complex), step, information[:, :2].mean(axis=1), places, free)
    except SolverError:
        return None
    poses = np.column_stack([places.real, places.imag, np.angle(z)])
    if not np.isfinite(poses).all():
        return None
    return replace(graph, poses=np.where(free[:, None], poses, graph.poses))


def _solved(
    ends: tuple[Ints, Ints], factor: Complexes, step: Complexes, weight: Floats, values: Complexes, free: Bools
) -> Complexes:
    """Return the complex numbers (n,) with x_j = factor x_i + step (e,) in least squares, those that are not free as given."""
    (i, j), e, root = ends, np.arange(len(weight)), np.sqrt(weight)
    entries = np.concatenate([root + 0j, -root * factor]), (np.concatenate([e, e]), np.concatenate([j, i]))
    A = sparse.csc_matrix(entries, shape=(len(i), len(values)))
    right = root * step - A[:, ~free] @ values[~free]
    inner = A[:, free].conj().T
    solved = values.copy()
    normal = (inner @ inner.conj().T).tocsc()
    if slower_than_iteration(multiplications_of(normal), normal.shape[0]):
        raise SolverError("the matrix would fill up")
    solved[free] = superlu(normal, "MMD_AT_PLUS_A").solve(inner @ right)
    return solved
