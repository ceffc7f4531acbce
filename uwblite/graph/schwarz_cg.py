"""Conjugate gradients for long chains of poses with many edges between distant poses, whose factor would fill up.

Iteration solves their least squares well if errors of all wavelengths are reduced together: short ones piece by piece of the
chain, long ones by moving whole pieces as rigid bodies (a two-level additive Schwarz method; Smith, Bjorstad and Gropp, Domain
Decomposition, 1996). The number of iterations hardly depends on the length of the chain. Anchors and calibration belong to the
coarse level; where they are thousands, which would make it as large as the matrix, they are in pieces of their own.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from ..arrays import Bools, Floats, Ints, chunks
from ..errors import SINGULAR, SolverError


class SchwarzPolicy:
    """Sizes of the two levels, and when the iteration ends."""

    piece: int = 24
    """Poses of a piece."""
    enough: float = 1e-3
    """Relative error of a solution: the next step of the descent corrects it."""
    most: int = 300
    """Iterations; the result by then is still a descent step."""
    most_coarse: int = 1000
    """Number of unknowns other than poses up to which each is in the coarse level."""
    per_product: int = 4
    """Multiplications of a factorisation in the time of one of a matrix-vector product, which memory access limits."""
    columns_at_once: int = 256
    """Of the coarse matrix; a bound on the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A chain cut into pieces."""

    number: Ints
    """(p, w) places of each piece's unknowns in the vector of all; the length of that vector where there are fewer."""
    basis: sparse.csr_matrix
    """(n, c) motions of the coarse level: three of each piece as a rigid body, and each unknown that is no pose."""

    def work(self, steps: float = 0.0, entries: int = 0) -> float:
        """Return the work, in multiplications of a factorisation, of the inverses of the pieces and the factor of the coarse
        matrix, and of iterations with a matrix of so many entries."""
        pieces, wide, coarse = map(float, (*self.number.shape, self.basis.shape[1]))
        step = SchwarzPolicy.per_product * (entries + pieces * wide**2 + coarse**2)
        return pieces * wide**3 + coarse**3 / 3.0 + steps * step


def cut(number: Ints, poses: Floats, size: int, linked: Bools) -> Pieces:
    """Cut the free poses of a graph into pieces, none of which goes on from one chain to another.

    Two chains in one piece, such as the end of a recording and the start of the next, move independently, which the coarse
    level cannot represent: every such piece costs tens of iterations. Where poses make no chains, as those of a star, a piece
    of each would make the coarse level as large as the matrix: they are cut as they are numbered.

    Parameters
    ----------
    number : (k, 3) place of each pose's x, y, theta in the vector of unknowns, in the order of the chain.
    poses : (k, 3) about which they move.
    size : n, length of the vector.
    linked : (k - 1,) which poses share an edge with the next one.
    """
    piece_size, motions = SchwarzPolicy.piece, number.shape[1]
    # Chains that are shorter than a piece, more than a few of them, are none.
    if np.count_nonzero(~linked) * piece_size > max(len(linked), piece_size**2):
        linked = np.ones_like(linked)
    each = np.arange(len(number))
    begin = np.maximum.accumulate(np.where(np.append(True, ~linked), each, 0))
    within = (each - begin) % piece_size
    piece = np.cumsum(within == 0) - 1
    pieces = int(piece[-1]) + 1
    places = np.full((pieces, motions * piece_size), size)
    places[piece[:, None], motions * within[:, None] + np.arange(motions)] = number
    centre = np.stack([np.bincount(piece, column) for column in poses[:, :2].T], axis=1) / np.bincount(piece)[:, None]
    arm = poses[:, :2] - centre[piece]
    other = np.setdiff1d(np.arange(size), number)
    if len(other) > SchwarzPolicy.most_coarse:
        apart = np.append(other, np.full(-len(other) % places.shape[1], size)).reshape(-1, places.shape[1])
        places, other = np.concatenate([places, apart]), other[:0]
    # A turn about the middle moves a pose at the arm (u, v) by (-v, u).
    rows = np.concatenate([number.ravel(), number[:, 0], number[:, 1], other])
    own, turn = motions * piece[:, None] + np.arange(motions), motions * piece + 2
    columns = np.concatenate([own.ravel(), turn, turn, motions * pieces + np.arange(len(other))])
    values = np.concatenate([np.ones(number.size), -arm[:, 1], arm[:, 0], np.ones(len(other))])
    return Pieces(places, sparse.csr_matrix((values, (rows, columns)), shape=(size, motions * pieces + len(other))))


def local_blocks(matrix: sparse.csc_matrix, number: Ints) -> Floats:
    """Return the dense blocks (p, w, w) of a matrix at the unknowns (p, w) of pieces; 1 on the diagonal where one has no
    unknown."""
    size, (count, wide) = matrix.shape[0], number.shape
    place = np.full(size + 1, -1)
    place[number] = np.arange(number.size).reshape(number.shape)
    column, row = np.repeat(place[:-1], np.diff(matrix.indptr)), place[matrix.indices]
    inside = np.flatnonzero((column >= 0) & (row // wide == column // wide))
    flat = np.bincount(row[inside] * wide + column[inside] % wide, matrix.data[inside], count * wide * wide)
    blocks = flat.astype(np.float64, copy=False).reshape(count, wide, wide)
    blocks[:, np.arange(wide), np.arange(wide)] += number == size
    return blocks


class TwoLevelFactor:
    """Solves with a symmetric, positive definite matrix by conjugate gradients."""

    def __init__(self, matrix: sparse.csc_matrix, pieces: Pieces) -> None:
        """Invert the pieces' blocks and factorise the coarse matrix.

        Raises
        ------
        SolverError : one of them is singular.
        """
        self._pieces, self._onto = pieces, pieces.basis.T.tocsr()
        self.work = 0.0
        """Work of all iterations so far, in multiplications of a factorisation."""
        try:
            self._local = np.linalg.inv(local_blocks(matrix, pieces.number))
        except np.linalg.LinAlgError as problem:
            raise SolverError(f"{SINGULAR} ({problem})") from None
        # Pairs of clouds without weight left zeros. The matrix is symmetric: its columns are used as rows, which multiply
        # faster.
        columns = matrix.copy()
        columns.eliminate_zeros()
        self._matrix = columns.T
        coarse, by_column = np.empty((pieces.basis.shape[1],) * 2, order="F"), pieces.basis.tocsc()
        for part in chunks(len(coarse), SchwarzPolicy.columns_at_once):
            coarse[:, part] = (self._onto @ (columns @ by_column[:, part])).toarray()
        self._coarse, failed = lapack.dpotrf(coarse, lower=1, overwrite_a=1)
        if failed:
            raise SolverError(SINGULAR)

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m), each to a small share of its residual in the metric of the two levels.

        Raises
        ------
        SolverError : the matrix is not positive definite.
        """
        if right.ndim == 2:
            return np.stack([self.solve(column) for column in right.T], axis=1)
        solution, residual = np.zeros(len(right)), right.copy()
        direction, steps = self._nearly(residual), 0
        energy = first = float(residual @ direction)
        while energy > SchwarzPolicy.enough**2 * first and steps < SchwarzPolicy.most:
            image = self._matrix @ direction
            curvature = float(direction @ image)
            if not curvature > 0.0:
                raise SolverError(SINGULAR)
            solution += (energy / curvature) * direction
            residual -= (energy / curvature) * image
            near = self._nearly(residual)
            before, energy = energy, float(residual @ near)
            direction = near + (energy / before) * direction
            steps += 1
        self.work += self._pieces.work(steps, self._matrix.nnz) - self._pieces.work()
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
