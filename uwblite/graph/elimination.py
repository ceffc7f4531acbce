"""Symbolic elimination of sparse, symmetric matrices: order, elimination tree and work, from the pattern alone.

Anchors and calibration, which touch nearly every pose, are a border that is eliminated last by a Schur complement; many of them
are the last rows of the sparse matrix instead. A chain whose closures reach back a few poses is a narrow band: reverse
Cuthill-McKee and LAPACK's banded Cholesky. Once closures tie distant poses together the band fills, and minimum degree with
SuperLU in its symmetric mode needs fewer operations. The order is found on the graph of poses, a third of the matrix's size.

The elimination tree is found from the pattern: entries of a computed factor that cancel, or underflow along a ring of a hundred
poses, would cut it. With it the number of entries of each column is known (J. Gilbert, E. Ng, B. Peyton, An efficient algorithm
to compute row and column counts for sparse Cholesky factorization, SIAM J. Matrix Anal. Appl. 1994).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree, reverse_cuthill_mckee
from scipy.sparse.linalg import spilu

from ..arrays import WIDE, Ints
from .graph import WIDTHS


class EliminationPolicy:
    """Which factorisation suits which pattern (docs/lab/performance.md)."""

    widest_band: int = 16
    """Distance in the band, poses, up to which the banded factorisation wins."""
    widest_border: int = 48
    """Scalars in a border; more of them stay in the sparse matrix."""
    little_work: float = 4e8
    """Multiplications of a factorisation that always pay, a tenth of a second; so many in a band's envelope are not counted."""
    per_pose: float = 1e5
    """Multiplications for each pose beyond which iteration takes less time. In one hall all poses are connected; a hundred
    times the paper's graph takes a third of that."""
    per_complex: int = 4
    """Multiplications in one of complex numbers."""
    alone: float = 6.0
    """Time of a multiplication in a single column relative to one in many columns together: measured with SuperLU."""
    small: int = 3000
    wide: float = 0.1
    """Rows up to which any pattern is counted, and the mean share of the rows that each reaches back in the band of a matrix
    that fills up in any order; for the streets of a town it is a fiftieth."""


def adjacency(pairs: Ints, nodes: int) -> sparse.csc_matrix:
    """Return a positive definite matrix with the pattern of a graph, by pairs (b, 2) of nodes that share an edge."""
    a, b = _apart(pairs)
    each = np.arange(nodes)
    rows, indptr = _compressed(np.concatenate([each, a, b]), np.concatenate([each, b, a]), nodes)
    values = np.where(rows == np.repeat(each, np.diff(indptr)), 1.0 + len(rows), 1.0)
    return sparse.csc_matrix((values, rows, indptr), shape=(nodes, nodes))


def _apart(pairs: Ints) -> tuple[Ints, Ints]:
    """Return the two nodes (p,), (p,) of each pair (b, 2) of different ones."""
    one, other = pairs[:, 0], pairs[:, 1]
    different = np.flatnonzero(one != other)
    return one.take(different), other.take(different)


def _compressed(minor: Ints, major: Ints, nodes: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the different entries of a matrix (nodes, nodes) in compressed form: the ascending minor indices of every major
    one, and where each of these begins (nodes + 1,). One sort of numbers takes a third of the time of sparse.coo_matrix."""
    keys = np.sort(major.astype(WIDE, copy=False) * nodes + minor)
    keys = keys[np.flatnonzero(np.diff(keys, prepend=-1))]
    major = (keys // max(nodes, 1)).astype(np.intp)
    ends = np.cumsum(np.bincount(major, minlength=nodes), dtype=np.int32)
    return (keys % max(nodes, 1)).astype(np.int32), np.append(np.zeros(1, dtype=np.int32), ends)


def _lower_triangle(pairs: Ints, order: Ints) -> sparse.csr_matrix:
    """Return the pattern below the diagonal of the matrix with its nodes in this order; columns ascend in every row."""
    place = np.argsort(order)
    one, other = map(place.take, _apart(pairs))
    columns, indptr = _compressed(np.minimum(one, other), np.maximum(one, other), len(order))
    return sparse.csr_matrix((np.ones(len(columns)), columns, indptr), shape=(len(order), len(order)))


def narrow_order(pattern: sparse.csc_matrix) -> tuple[Ints, Ints]:
    """Return the order (n,) of a narrow band, by reverse Cuthill-McKee, and how far (n,) each row reaches in it.

    Parameters
    ----------
    pattern : see adjacency.
    """
    order = reverse_cuthill_mckee(pattern.T, symmetric_mode=True).astype(np.intp)
    place = np.argsort(order)
    first = np.minimum.reduceat(place[pattern.indices], pattern.indptr[:-1]) if len(order) else order
    return order, (place - first)[order]


def fills_in_any_order(reach: Ints) -> bool:
    """Return whether a large matrix, whose rows reach so far (n,) in a narrow order, fills up in any order.

    Such a matrix connects arbitrary unknowns. Counting by minimum degree takes many seconds for it, and less time than the
    factorisation for all others.
    """
    return len(reach) > EliminationPolicy.small and float(np.mean(reach)) > EliminationPolicy.wide * len(reach)


def slower_than_iteration(multiplications: float, poses: int) -> bool:
    """Return whether a factorisation takes longer than iteration."""
    return multiplications > max(EliminationPolicy.little_work, EliminationPolicy.per_pose * poses)


def minimum_degree(pattern: sparse.csc_matrix) -> Ints:
    """Return the order (n,) of elimination by multiple minimum degree.

    SuperLU finds it before it factorises. Its incomplete factorisation, which drops all fill, then takes almost no time.

    Parameters
    ----------
    pattern : see adjacency.
    """
    options = {"SymmetricMode": True, "Equil": False}
    factor = spilu(pattern, 1.0, 1.0, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, relax=2, panel_size=1, options=options)
    return np.asarray(np.argsort(factor.perm_c))


def elimination_tree(pairs: Ints, order: Ints) -> Ints:
    """Return the parent (n,) of each column of the matrix with its nodes in this order; n = none.

    The spanning tree with the earliest nodes has the same connected sets of earlier nodes as the graph.
    """
    n = len(order)
    lower = _lower_triangle(pairs, order)
    # The weight of a pair is its later node, and none is 0.
    lower.data[:] = np.repeat(np.arange(1.0, n + 1.0), np.diff(lower.indptr))
    spanning = minimum_spanning_tree(lower).tocoo()
    begins, ends = np.minimum(spanning.row, spanning.col), np.maximum(spanning.row, spanning.col)
    sequence = np.argsort(ends, kind="stable")
    parent, above = [n] * n, list(range(n))
    for k, node in zip(begins[sequence].tolist(), ends[sequence].tolist(), strict=True):
        while above[k] != k:
            above[k] = k = above[above[k]]
        parent[k] = above[k] = node
    return np.array(parent, dtype=np.intp)


def postorder(pairs: Ints, order: Ints) -> tuple[Ints, Ints]:
    """Return an order (n,) that fills the same and has every subtree contiguous, ending at its root, and its elimination tree.

    A depth-first walk from the roots, read backwards, is such an order. It makes neighbours in the order neighbours in the
    factor: minimum degree halves all chains at the same time, and in its own order a factorisation takes twice as long.
    """
    n, parent = len(order), elimination_tree(pairs, order)
    tree = sparse.csr_matrix((np.ones(n), (parent, np.arange(n))), shape=(n + 1, n + 1))
    walk = depth_first_order(tree, n, return_predecessors=False)[:0:-1].astype(np.intp)
    return order[walk], np.append(np.argsort(walk), n)[parent[walk]]


def _pairs_of(matrix: sparse.csc_matrix) -> Ints:
    """Return the pairs (b, 2) of columns with an entry in a symmetric matrix."""
    column = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
    below = matrix.indices > column
    return np.stack([column[below], matrix.indices[below]], axis=1).astype(np.intp)


def order_of_columns(matrix: sparse.csc_matrix) -> Ints:
    """Return the order (n,) of elimination of a symmetric matrix by minimum degree, with every subtree contiguous."""
    pairs = _pairs_of(matrix)
    return postorder(pairs, minimum_degree(adjacency(pairs, matrix.shape[0])))[0]


def column_sizes(pairs: Ints, order: Ints, width: Ints, parent: Ints) -> Ints:
    """Return the scalars (n,) in each node's columns of the factor, its own among them, for the nodes in this order.

    Row i of the factor has entries along the tree's paths from the neighbours of i up to i. The count along these paths: each
    neighbour of i adds one, and one is subtracted where two paths meet and above i.

    Parameters
    ----------
    width : (n,) scalars of each node. order, parent : (n,) with every subtree contiguous, see postorder.
    """
    n, scalars = len(order), width[order].astype(np.intp)
    lower = _lower_triangle(pairs, order)
    below, row = lower.indices.astype(np.intp), np.repeat(np.arange(n), np.diff(lower.indptr))
    change = np.bincount(below, scalars[row], n + 1).astype(np.float64)
    again = np.flatnonzero(row[1:] == row[:-1]) + 1
    change -= np.bincount(_common_ancestors(parent, below[again - 1], below[again]), scalars[row[again]], n + 1)
    tied = np.zeros(n, dtype=bool)
    tied[row] = True
    change[:-1] += np.where(tied, 0, scalars)
    change -= np.bincount(parent, scalars, n + 1)
    total = np.append(0.0, np.cumsum(change[:-1]))
    first = list(range(n + 1))
    for node, above in enumerate(parent.tolist()):
        first[above] = min(first[above], first[node])
    return np.rint(total[1:] - total[first[:-1]]).astype(np.intp)


def _common_ancestors(parent: Ints, one: Ints, other: Ints) -> Ints:
    """Return where the paths up from nodes `one` and from later nodes `other` meet, in a tree in postorder.

    The nodes from one up to the other lie below the node where the paths meet, and one of them is its child: so it is the
    highest of their parents.
    """
    highest = [parent]
    while 2 << len(highest) - 1 <= len(parent):
        half = 1 << len(highest) - 1
        highest.append(np.maximum(highest[-1], np.append(highest[-1][half:], np.zeros(half, dtype=np.intp))))
    step = np.log2(np.maximum(other - one, 1)).astype(np.intp)
    table = np.stack(highest)
    return np.asarray(np.maximum(table[step, one], table[step, other - (1 << step)]))


def count_multiplications(pairs: Ints, order: Ints, width: Ints, parent: Ints) -> float:
    """Return the multiplications of a factorisation with the nodes in this order, in units of one of a dense matrix.

    Columns with the pattern of the next one are multiplied together; others are slower because of memory access.

    Parameters
    ----------
    width : (n,) scalars of each node. order, parent : (n,) with every subtree contiguous, see postorder.
    """
    sizes, scalars = column_sizes(pairs, order, width, parent), width[order]
    continued = np.append(sizes, 0)[parent] == sizes - scalars
    return float(scalars @ (np.square(sizes, dtype=np.float64) * np.where(continued, 1.0, EliminationPolicy.alone)))


def multiplications_of(matrix: sparse.csc_matrix) -> float:
    """Return the multiplications of a factorisation of a symmetric, complex matrix by minimum degree; infinite where it fills
    up."""
    pairs, width = _pairs_of(matrix), np.ones(matrix.shape[0], dtype=np.intp)
    pattern = adjacency(pairs, len(width))
    if fills_in_any_order(narrow_order(pattern)[1]):
        return np.inf
    order, parent = postorder(pairs, minimum_degree(pattern))
    return EliminationPolicy.per_complex * count_multiplications(pairs, order, width, parent)


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """Order of elimination of a graph's poses."""

    order: Ints
    """(m,) poses, first eliminated first."""
    bordered: bool = False
    """Everything else is a border."""
    banded: bool = False
    """The poses are a narrow band."""
    iterative: bool = False
    """A factor would fill up: see schwarz_cg.py."""
    work: float = 0.0
    """Multiplications of a factorisation, where they are many enough to be counted; more than there are, where they are few."""


def choose_ordering(pairs: Ints, poses: int, width: Ints, last: Ints | None = None) -> Ordering:
    """Choose in which order to eliminate the poses; anchors and calibration, which touch many of them, come after.

    Parameters
    ----------
    pairs : (b, 2) nodes that share an edge; the first nodes are the poses.
    width : (n,) scalars of each node.
    last : keep to the sparse form, for the inverse: these poses come after the others, whose subtrees are contiguous.
    """
    policy, each = EliminationPolicy, np.arange(poses)
    if poses < 2:
        return Ordering(each)
    among = pairs.take(np.flatnonzero(np.maximum(pairs[:, 0], pairs[:, 1]) < poses), axis=0)
    if last is not None:
        # What remains when all others are eliminated is full.
        among = np.concatenate([among, last[np.stack(np.triu_indices(len(last), 1), axis=1)]])
        walk = postorder(among, minimum_degree(adjacency(among, poses)))[0]
        return Ordering(walk[np.argsort(np.isin(walk, last), kind="stable")])
    pattern = adjacency(among, poses)
    bordered = int(width[poses:].sum()) <= policy.widest_border
    order, reach = narrow_order(pattern)
    if bordered and reach.max() <= policy.widest_band:
        return Ordering(order, bordered=True, banded=True)
    if fills_in_any_order(reach):
        return Ordering(each, iterative=True)
    order = minimum_degree(pattern)
    if bordered:
        most = WIDTHS["poses"] * float(np.sum((WIDTHS["poses"] * (reach + 1.0)) ** 2))
        if most <= policy.little_work:
            return Ordering(order, bordered=True, work=most)
    order, parent = postorder(among, order)
    if bordered:
        multiplications = count_multiplications(among, order, width, parent)
    else:
        every, parent = postorder(pairs, np.concatenate([order, np.arange(poses, len(width))]))
        multiplications = count_multiplications(pairs, every, width, parent)
    if slower_than_iteration(multiplications, poses):
        return Ordering(each, iterative=True)
    return Ordering(order, bordered, work=multiplications)
