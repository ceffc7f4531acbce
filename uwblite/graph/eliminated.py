"""Gauss-Newton steps of a graph with further unknowns in small blocks, of which each touches many poses and no other block.

With the graph's normal equations H x = -g, and of the further measurements G among poses, B between blocks and poses and
D among blocks, which is block diagonal, the blocks are eliminated:

    (H + G - B^T D^-1 B) x = -(g + g_x - B^T D^-1 g_s),    s = -D^-1 (g_s + B x).

The matrix ties all poses that touch one block, so it is never made: conjugate gradients multiply by its parts. A factor of
another matrix that measures alike, for example of a graph in which pairs of poses stand for the blocks, preconditions. For
covariances the blocks stay in the matrix, as its last unknowns: then it is sparse.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..arrays import Floats
from .elimination import pairs_of, with_subtrees_contiguous
from .factorization import superlu
from .normal_equations import NormalEquations
from .schwarz_cg import conjugate_gradients

_RESIDUAL, _MOST = 1e-3, 300
"""Relative residual at which conjugate gradients end, and most of their steps."""


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Normal equations of measurements of poses and blocks (b) of a few unknowns (k) each."""

    among: sparse.csr_matrix
    """(n, n) G."""
    across: sparse.csr_matrix
    """(b k, n) B."""
    own: Floats
    """(b, k, k) D; regular where it is eliminated."""
    slope: Floats
    """(n,) g_x."""
    own_slope: Floats
    """(b, k) g_s."""


def blocks_of(by_graph: sparse.csr_matrix, by_block: sparse.csr_matrix, residual: Floats, k: int) -> Blocks:
    """Return the normal equations of whitened residuals (m,) with Jacobians (m, n) and (m, b k)."""
    among, across = sparse.csr_matrix(by_graph.T @ by_graph), sparse.csr_matrix(by_block.T @ by_graph)
    entries, count = (by_block.T @ by_block).tocoo(), by_block.shape[1] // k
    own = np.zeros((count, k, k))
    np.add.at(own, (entries.row // k, entries.row % k, entries.col % k), entries.data)
    return Blocks(among, across, own, by_graph.T @ residual, (by_block.T @ residual).reshape(count, k))


def summed(one: Blocks, other: Blocks) -> Blocks:
    """Return the normal equations of the measurements of both."""
    slope, own_slope = one.slope + other.slope, one.own_slope + other.own_slope
    return Blocks(one.among + other.among, one.across + other.across, one.own + other.own, slope, own_slope)


def step(normal: NormalEquations, blocks: Blocks, precondition: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step of the graph's unknowns (n,) and of the blocks (b, k).

    Parameters
    ----------
    normal : of the graph, in the sparse layout (NormalEquations with subtrees).
    precondition : multiplies (n,) by about the inverse of the reduced matrix.

    Raises
    ------
    SolverError : the matrix is not positive definite.
    """
    inverse, matrix = np.linalg.inv(blocks.own), normal.matrix + blocks.among

    def within(values: Floats) -> Floats:
        return np.einsum("bij,bj->bi", inverse, values.reshape(blocks.own_slope.shape)).ravel()

    def times(x: Floats) -> Floats:
        return np.asarray(matrix @ x - blocks.across.T @ within(blocks.across @ x))

    right = -(normal.gradient + blocks.slope - blocks.across.T @ within(blocks.own_slope))
    x, _ = conjugate_gradients(times, right, precondition, _RESIDUAL, _MOST)
    return x, -within(blocks.own_slope.ravel() + blocks.across @ x).reshape(blocks.own_slope.shape)


class WithBlocks:
    """Factor of [[H + G, B^T], [B, D]] that solves for the graph's unknowns: the inverse of H + G - B^T D^-1 B.

    Every subtree of the elimination is contiguous, which the selected inverse needs: else ranges of columns hold unrelated
    poses, and each hands on the rows of all others.
    """

    def __init__(self, matrix: sparse.csc_matrix, blocks: Blocks) -> None:
        """Factorise.

        Parameters
        ----------
        matrix : (n, n) H.

        Raises
        ------
        SolverError : the matrix is singular.
        """
        count = len(blocks.own)
        own = sparse.bsr_matrix((blocks.own, np.arange(count), np.arange(count + 1)))
        whole = sparse.bmat([[matrix + blocks.among, blocks.across.T], [blocks.across, own]], format="csc")
        self._size, self._more = matrix.shape[0], whole.shape[0] - matrix.shape[0]
        self._order = with_subtrees_contiguous(pairs_of(whole), whole.shape[0])
        self._place = np.argsort(self._order)
        self._lu = superlu(sparse.csc_matrix(whole[self._order][:, self._order]), "NATURAL")
        self.L, self.U = self._lu.L, self._lu.U
        self.perm_r, self.perm_c = self._lu.perm_r[self._place], self._lu.perm_c[self._place]

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""
        whole = np.concatenate([right, np.zeros((self._more, *right.shape[1:]))])
        return np.asarray(self._lu.solve(whole[self._order])[self._place[: self._size]])
