"""Normal equations of a graph with further unknowns in small blocks, each connected with many poses and no other block.

With the graph's normal equations H x = -g, and of the further measurements G among poses, B between blocks and poses and
D among blocks, which is block diagonal:

    [[H + G, B^T], [B, D]] [x, s] = -[g + g_x, g_s].

If the blocks were eliminated first, the matrix of the poses would connect all poses of one block. With the blocks it is sparse,
and minimum degree eliminates unknowns with many connections late.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..arrays import Floats, Ints
from .elimination import order_of_columns
from .factorization import counted, superlu
from .graph import Linearization
from .normal_equations import NormalEquations
from .unknowns import Unknowns


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Normal equations of measurements of poses and blocks (b) of a few unknowns (k) each."""

    among: sparse.csr_matrix
    """(n, n) G."""
    across: sparse.csr_matrix
    """(b k, n) B."""
    own: Floats
    """(b, k, k) D."""
    slope: Floats
    """(n,) g_x."""
    own_slope: Floats
    """(b, k) g_s."""


def entries(rows: Ints, columns: Ints, values: Floats, shape: tuple[int, int]) -> sparse.csr_matrix:
    """Return the sum of blocks (m, a, b) in rows (m, a) and columns (m, b) of a matrix; a number below 0 is fixed."""
    row, column = np.broadcast_to(rows[:, :, None], values.shape), np.broadcast_to(columns[:, None], values.shape)
    free = (row >= 0) & (column >= 0)
    return sparse.csr_matrix((values[free], (row[free], column[free])), shape=shape)


def rows_of(linearized: Linearization, unknowns: Unknowns) -> sparse.csr_matrix:
    """Return the Jacobian (e d, n) of measurements (e) by the unknowns of a graph."""
    columns = np.concatenate([unknowns.number[name][index] for name, index, _ in linearized.blocks], axis=1)
    values = np.concatenate([jacobian for *_, jacobian in linearized.blocks], axis=2)
    return sparse_rows(np.repeat(columns, values.shape[1], axis=0), values.reshape(-1, values.shape[2]), unknowns.size)


def sparse_rows(columns: Ints, values: Floats, size: int) -> sparse.csr_matrix:
    """Return the matrix (m, size) with values (m, k) in these columns (m, k); a column below 0 is fixed."""
    free = columns >= 0
    ends = np.concatenate([[0], np.cumsum(free.sum(axis=1))])
    return sparse.csr_matrix((values[free], columns[free], ends), shape=(len(columns), size))


_TRACE = 1e-12
"""Damping, as a share of the diagonal: unmeasured directions keep their values."""


def factor(normal: NormalEquations, blocks: Blocks, order: Ints | None = None) -> "WithBlocks":
    """Return the factor of the normal equations of a graph and of blocks.

    Parameters
    ----------
    normal : of the graph, in the sparse layout (NormalEquations with subtrees).
    order : of an earlier factor of measurements with the same pattern.

    Raises
    ------
    SolverError : the matrix is singular, in spite of the damping.
    """
    diagonal = normal.diagonal + blocks.among.diagonal()
    damping = sparse.diags(np.where(diagonal > 0.0, _TRACE * diagonal, 1.0))
    found = WithBlocks(sparse.csc_matrix(normal.matrix + damping), blocks, order)
    counted(found, normal.spent)
    return found


class WithBlocks:
    """Factor of [[H + G, B^T], [B, D]] that solves for the graph's unknowns: the inverse of H + G - B^T D^-1 B.

    Every subtree of the elimination is contiguous, which the selected inverse needs: otherwise ranges of columns contain
    unrelated poses, and each passes on the rows of all others.
    """

    def __init__(self, matrix: sparse.csc_matrix, blocks: Blocks, order: Ints | None = None) -> None:
        """Factorise.

        Parameters
        ----------
        matrix : (n, n) H.
        order : of elimination, of a matrix with the same pattern.

        Raises
        ------
        SolverError : the matrix is singular.
        """
        count = len(blocks.own)
        own = sparse.csr_matrix(sparse.bsr_matrix((blocks.own, np.arange(count), np.arange(count + 1))))
        own.eliminate_zeros()
        whole = sparse.bmat([[matrix + blocks.among, blocks.across.T], [blocks.across, own]], format="csc")
        self._size, self._more = matrix.shape[0], whole.shape[0] - matrix.shape[0]
        whole.sort_indices()
        self.order = order_of_columns(whole) if order is None else order
        self._place = np.argsort(self.order)
        self._lu = superlu(sparse.csc_matrix(whole[self.order][:, self.order]), "NATURAL")
        self.perm_r, self.perm_c = self._lu.perm_r[self._place], self._lu.perm_c[self._place]

    @property
    def L(self) -> sparse.csc_matrix:
        """Lower triangle; SuperLU copies its factor when it is read."""
        return self._lu.L

    @property
    def U(self) -> sparse.csc_matrix:
        """Upper triangle."""
        return self._lu.U

    @property
    def nnz(self) -> int:
        """Entries of the factor."""
        return int(self._lu.nnz)

    def step(self, normal: NormalEquations, blocks: Blocks) -> tuple[Floats, Floats]:
        """Return the step of the graph's unknowns (n,) and of the blocks (b, k) by these slopes."""
        found = -self.solve_all(np.concatenate([normal.gradient + blocks.slope, blocks.own_slope.ravel()]))
        return found[: self._size], found[self._size :].reshape(blocks.own_slope.shape)

    def solve(self, right: Floats) -> Floats:
        """Solve for the graph's unknowns by right-hand sides (n,) or (n, m)."""
        return self.solve_all(np.concatenate([right, np.zeros((self._more, *right.shape[1:]))]))[: self._size]

    def solve_all(self, right: Floats) -> Floats:
        """Solve for all unknowns by right-hand sides (n + b k,) or (n + b k, m)."""
        return np.asarray(self._lu.solve(right[self.order])[self._place])
