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
class BlockEquations:
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


def sum_of_blocks(rows: Ints, columns: Ints, values: Floats, shape: tuple[int, int]) -> sparse.csr_matrix:
    """Return the sum of blocks (m, a, b) in rows (m, a) and columns (m, b) of a matrix; a number below 0 is fixed."""
    row, column = np.broadcast_to(rows[:, :, None], values.shape), np.broadcast_to(columns[:, None], values.shape)
    free = (row >= 0) & (column >= 0)
    return sparse.csr_matrix((values[free], (row[free], column[free])), shape=shape)


def jacobian_rows(linearized: Linearization, unknowns: Unknowns) -> sparse.csr_matrix:
    """Return the Jacobian (e d, n) of measurements (e) by the unknowns of a graph."""
    columns = np.concatenate([unknowns.number[name][index] for name, index, _ in linearized.blocks], axis=1)
    values = np.concatenate([jacobian for *_, jacobian in linearized.blocks], axis=2)
    rows = np.arange(linearized.residuals.size).reshape(linearized.residuals.shape)
    return sum_of_blocks(rows, columns, values, (rows.size, unknowns.size))


TRACE = 1e-12
"""Damping, as a share of the diagonal: unmeasured directions keep their values."""


def factor(normal: NormalEquations, blocks: BlockEquations, order: Ints | None = None) -> "BlockFactor":
    """Return the factor of the normal equations of a graph and of blocks, with a trace of damping; see BlockFactor."""
    diagonal = normal.diagonal + blocks.among.diagonal()
    return BlockFactor(normal, blocks, np.where(diagonal > 0.0, TRACE * diagonal, 1.0), order)


class BlockFactor:
    """Factor of [[H + G, B^T], [B, D]] that solves for the graph's unknowns: the inverse of H + G - B^T D^-1 B.

    Every subtree of the elimination is contiguous, which the selected inverse needs: otherwise ranges of columns contain
    unrelated poses, and each passes on the rows of all others.
    """

    def __init__(self, normal: NormalEquations, blocks: BlockEquations, damping: Floats, order: Ints | None = None) -> None:
        """Factorise.

        Parameters
        ----------
        normal : of the graph, in the order for the inverse. damping : (n,) of its unknowns.
        order : of elimination, of an earlier factor of measurements with the same pattern.

        Raises
        ------
        SolverError : the matrix is singular.
        """
        count = len(blocks.own)
        own = sparse.csr_matrix(sparse.bsr_matrix((blocks.own, np.arange(count), np.arange(count + 1))))
        own.eliminate_zeros()
        matrix = normal.matrix + sparse.diags(damping) + blocks.among
        whole = sparse.bmat([[matrix, blocks.across.T], [blocks.across, own]], format="csc")
        self._size, self._more = normal.unknowns.size, own.shape[0]
        whole.sort_indices()
        self.order = order_of_columns(whole) if order is None else order
        self._place = np.argsort(self.order)
        self._lu = superlu(sparse.csc_matrix(whole[self.order][:, self.order]), "NATURAL")
        self.perm_r, self.perm_c = self._lu.perm_r[self._place], self._lu.perm_c[self._place]
        self.nnz = int(self._lu.nnz)
        counted(self, normal.spent)

    @property
    def L(self) -> sparse.csc_matrix:
        """Lower triangle; SuperLU copies its factor when it is read."""
        return self._lu.L

    @property
    def U(self) -> sparse.csc_matrix:
        """Upper triangle."""
        return self._lu.U

    def step(self, normal: NormalEquations, blocks: BlockEquations) -> tuple[Floats, Floats]:
        """Return the step of the graph's unknowns (n,) and of the blocks (b, k) by these slopes."""
        found = -self._solve(np.concatenate([normal.gradient + blocks.slope, blocks.own_slope.ravel()]))
        return found[: self._size], found[self._size :].reshape(blocks.own_slope.shape)

    def solve(self, right: Floats) -> Floats:
        """Solve for the graph's unknowns by right-hand sides (n,) or (n, m)."""
        return self._solve(np.concatenate([right, np.zeros((self._more, *right.shape[1:]))]))[: self._size]

    def _solve(self, right: Floats) -> Floats:
        """Solve for all unknowns (n + b k, ...)."""
        return np.asarray(self._lu.solve(right[self.order])[self._place])
