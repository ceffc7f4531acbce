"""Conjugate gradients for long chains of poses with many edges between distant poses.

Where thousands of poses share a few rooms and each is matched with many others, a factorisation fills up: the 14,000 poses of
five hours in one hall need 100 million entries and minutes. Iteration solves their least squares well if errors of all
wavelengths are reduced together: short ones piece by piece of the chain, long ones by moving whole pieces as rigid bodies (a
two-level additive Schwarz method; Smith, Bjorstad and Gropp, Domain Decomposition, 1996). The number of iterations hardly
depends on the length of the chain. Anchors and calibration belong to the coarse level; where they are thousands, which would
make it as large as the matrix, they are in pieces of their own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.csgraph import connected_components, depth_first_order

from ..arrays import Bools, Floats, Ints
from ..errors import SINGULAR, SolverError

_PIECE = 24
"""Poses of a piece."""
_ENOUGH = 1e-3
"""Relative error of a solution: the next step of the descent corrects it."""
_MOST = 300
"""Most iterations; the result by then is still a descent step."""
_MOST_COARSE = 1000
"""Number of unknowns other than poses up to which each is in the coarse level."""
_PER_PRODUCT = 4
"""Multiplications of a factorisation in the time of one multiplication of a matrix-vector product, which memory access
limits."""
_USUAL = 60
"""Expected iterations, from halls, sites and warehouses of 1,000 to 15,000 poses."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A chain cut into pieces."""

    number: Ints
    """(p, w) places of each piece's unknowns in the vector of all; the length of that vector where there are fewer."""
    basis: sparse.csr_matrix
    """(n, c) motions of the coarse level: three of each piece as a rigid body, and each unknown that is no pose."""

    def work(self, steps: float, entries: int) -> float:
        """Return the work, in multiplications of a factorisation, of preparing a solution (the inverses of the pieces and the
        factor of the coarse matrix) and of iterations with a matrix of so many entries."""
        return _work((*self.number.shape, int(self.basis.shape[1])), steps, entries)


def _work(shape: tuple[int, int, int], steps: float, entries: int) -> float:
    """Return the same of pieces of so many unknowns and a coarse matrix of so many rows."""
    pieces, wide, coarse = map(float, shape)
    step = _PER_PRODUCT * (entries + pieces * wide**2 + coarse**2)
    return pieces * wide**3 + coarse**3 / 3.0 + steps * step


def expected_work(poses: int, others: int, entries: int) -> float:
    """Return the work of a solution to be expected, in multiplications of a factorisation.

    Parameters
    ----------
    poses : in one chain or a few. others : scalars that are no poses. entries : of the matrix.
    """
    pieces, wide = -(-poses // _PIECE), 3 * _PIECE
    apart = others > _MOST_COARSE
    pieces, coarse = pieces + (-(-others // wide) if apart else 0), 3 * pieces + (0 if apart else others)
    return _work((pieces, wide, coarse), _USUAL, entries)


def chains(pairs: Ints, poses: int, linked: Bools) -> tuple[Ints, Bools]:
    """Return poses (poses,) in an order in which most share an edge with the next one, and which of them (poses - 1,) do.

    As they are numbered, where that makes chains; else in the order of a depth-first walk through the graph.

    Parameters
    ----------
    pairs : (b, 2) poses that share an edge. linked : (poses - 1,) which of them do so with the next one, as numbered.
    """
    if _makes_chains(linked):
        return np.arange(poses), linked
    links = sparse.csr_matrix((np.ones(len(pairs)), pairs.T), shape=(poses + 1, poses + 1))
    part = connected_components(links, directed=False)[1][:poses]
    begin = np.unique(part, return_index=True)[1]
    # One further node is the start of the walk through every part.
    rooted = links + sparse.csr_matrix((np.ones(len(begin)), (np.full(len(begin), poses), begin)), shape=links.shape)
    order = depth_first_order(rooted, poses, directed=False, return_predecessors=False)[1:].astype(np.intp)
    linked = np.asarray((links + links.T)[order[:-1], order[1:]]).ravel() > 0.0
    # A star has no chains, and the coarse level has no place for pieces of one pose each.
    return order, linked if _makes_chains(linked) else np.ones_like(linked)


def _makes_chains(linked: Bools) -> bool:
    return bool(np.count_nonzero(~linked) * _PIECE <= max(len(linked), _PIECE**2))


def cut(number: Ints, poses: Floats, size: int, linked: Bools) -> Pieces:
    """Cut the free poses of a graph into pieces, none of which goes on from one chain to another.

    Two chains in one piece, such as the end of a recording and the start of the next, move independently, which the coarse
    level cannot represent: every such piece costs tens of iterations.

    Parameters
    ----------
    number : (k, 3) place of each pose's x, y, theta in the vector of unknowns, in the order of the chain.
    poses : (k, 3) about which they move.
    size : n, length of the vector.
    linked : (k - 1,) which poses share an edge with the next one.
    """
    each = np.arange(len(number))
    begin = np.maximum.accumulate(np.where(np.append(True, ~linked), each, 0))
    within = (each - begin) % _PIECE
    piece = np.cumsum(within == 0) - 1
    pieces = int(piece[-1]) + 1
    places = np.full((pieces, 3 * _PIECE), size)
    places[piece[:, None], 3 * within[:, None] + np.arange(3)] = number
    centre = np.stack([np.bincount(piece, column) for column in poses[:, :2].T], axis=1) / np.bincount(piece)[:, None]
    arm = poses[:, :2] - centre[piece]
    other = np.setdiff1d(np.arange(size), number)
    if len(other) > _MOST_COARSE:
        apart = np.append(other, np.full(-len(other) % places.shape[1], size)).reshape(-1, places.shape[1])
        places, other = np.concatenate([places, apart]), other[:0]
    one = np.ones(len(number))
    # A turn about the middle moves a pose at the arm (u, v) by (-v, u).
    rows = np.concatenate([*number.T, number[:, 0], number[:, 1], other])
    columns = np.concatenate([3 * piece, 3 * piece + 1, *[3 * piece + 2] * 3, 3 * pieces + np.arange(len(other))])
    values = np.concatenate([one, one, one, -arm[:, 1], arm[:, 0], np.ones(len(other))])
    return Pieces(places, sparse.csr_matrix((values, (rows, columns)), shape=(size, 3 * pieces + len(other))))


class LocalPlaces:
    """Where the entries of a sparse matrix stand in the dense blocks of the pieces."""

    def __init__(self, matrix: sparse.csc_matrix, pieces: Pieces) -> None:
        """Find the entries whose row and column belong to one piece."""
        count, self._width = pieces.number.shape
        owner, within = np.full(matrix.shape[0] + 1, -1), np.zeros(matrix.shape[0] + 1, dtype=np.intp)
        owner[pieces.number] = np.arange(count)[:, None]
        within[pieces.number] = np.arange(self._width)
        owner[-1] = -1
        column = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
        self._source = np.flatnonzero((owner[column] >= 0) & (owner[matrix.indices] == owner[column]))
        row, column = matrix.indices[self._source], column[self._source]
        self._target = (owner[row] * self._width + within[row]) * self._width + within[column]
        self._nobody = pieces.number == matrix.shape[0]

    def blocks(self, data: Floats) -> Floats:
        """Return the blocks (p, w, w) by the matrix's data; 1 on the diagonal where a piece has no unknown."""
        found = np.zeros(self._nobody.size * self._width)
        found[self._target] = data[self._source]
        found = found.reshape(len(self._nobody), self._width, self._width)
        each = np.arange(self._width)
        found[:, each, each] += self._nobody
        return found


class TwoLevelFactor:
    """Solves with a symmetric, positive definite matrix by conjugate gradients."""

    def __init__(self, matrix: sparse.csc_matrix, pieces: Pieces, local: LocalPlaces) -> None:
        """Invert the pieces' blocks and factorise the coarse matrix.

        Raises
        ------
        SolverError : one of them is singular.
        """
        self._pieces, self._onto = pieces, pieces.basis.T.tocsr()
        self.work = 0.0
        """Work of all iterations so far, in multiplications of a factorisation."""
        try:
            self._local = np.linalg.inv(local.blocks(matrix.data))
        except np.linalg.LinAlgError as problem:
            raise SolverError(f"{SINGULAR} ({problem})") from None
        # Pairs of clouds without weight left zeros. The matrix is symmetric: its columns are used as rows, which multiply
        # faster.
        columns = matrix.copy()
        columns.eliminate_zeros()
        self._matrix = columns.T
        self._coarse, failed = lapack.dpotrf(_seen_by(columns, pieces.basis, self._onto), lower=1, overwrite_a=1)
        if failed:
            raise SolverError(SINGULAR)

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m).

        Raises
        ------
        SolverError : the matrix is not positive definite.
        """
        if right.ndim == 2:
            return np.stack([self.solve(column) for column in right.T], axis=1)
        solution, steps = conjugate_gradients(self._matrix.__matmul__, right, self._nearly, _ENOUGH, _MOST)
        self.work += self._pieces.work(steps, self._matrix.nnz) - self._pieces.work(0, 0)
        return solution

    @property
    def nnz(self) -> int:
        """Entries of the blocks and of the coarse factor."""
        return int(self._local.size + self._coarse.size)

    def _nearly(self, residual: Floats) -> Floats:
        """Return the approximate solution of the two levels for a residual."""
        number = self._pieces.number
        found = np.zeros(len(residual) + 1)
        found[number] = (self._local @ np.append(residual, 0.0)[number][:, :, None])[:, :, 0]
        coarse = lapack.dpotrs(self._coarse, self._onto @ residual, lower=1)[0]
        return np.asarray(found[:-1] + self._pieces.basis @ coarse.ravel())


def iterated(factor: object) -> float:
    """Return the work of all iterations with a factor so far, in multiplications of a factorisation; 0 for others."""
    return factor.work if isinstance(factor, TwoLevelFactor) else 0.0


def conjugate_gradients(
    times: Callable[[Floats], Floats], right: Floats, nearly: Callable[[Floats], Floats], enough: float, most: int
) -> tuple[Floats, int]:
    """Solve with a symmetric, positive definite matrix by preconditioned conjugate gradients; return how many steps it took.

    Parameters
    ----------
    times : multiplies by the matrix. right : (n,). nearly : multiplies by about its inverse.
    enough : the residual, in the metric of `nearly`, as a share of the first at which it ends. most : steps.

    Raises
    ------
    SolverError : the matrix is not positive definite.
    """
    solution, residual = np.zeros(len(right)), right.copy()
    direction = nearly(residual)
    energy = first = float(residual @ direction)
    for step in range(most):
        if not energy > enough**2 * first:
            return solution, step
        image = times(direction)
        curvature = float(direction @ image)
        if not curvature > 0.0:
            raise SolverError(SINGULAR)
        solution += (energy / curvature) * direction
        residual -= (energy / curvature) * image
        near = nearly(residual)
        before, energy = energy, float(residual @ near)
        direction = near + (energy / before) * direction
    return solution, most


def _seen_by(matrix: sparse.csc_matrix, basis: sparse.csr_matrix, onto: sparse.csr_matrix) -> Floats:
    """Return basis^T matrix basis (c, c), nearly full, a few columns at a time; `onto` is basis^T by rows."""
    by_column = basis.tocsc()
    seen = np.empty((basis.shape[1], basis.shape[1]), order="F")
    for first in range(0, basis.shape[1], _COLUMNS_AT_ONCE):
        part = slice(first, first + _COLUMNS_AT_ONCE)
        seen[:, part] = (onto @ (matrix @ by_column[:, part])).toarray()
    return seen


_COLUMNS_AT_ONCE = 256
"""Columns of the coarse matrix made at once; a bound on the memory."""
