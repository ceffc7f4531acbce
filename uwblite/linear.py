"""Normal equations of a graph: the sparsity pattern analysed once, filled often, factorised by structure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from .errors import SolverError
from .graph import Graph, Linearization

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCKS = (("poses", 3), ("anchors", 2), ("calibration", 1))
"""Blocks of unknowns in the order of the stacked vector, and the scalars of one unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Where each scalar of the graph stands in the vector of free unknowns."""

    number: dict[str, Ints]
    """By block (unknowns, scalars): position in the vector, -1 = held fixed."""
    size: int
    """Length of the vector."""

    @staticmethod
    def of(graph: Graph) -> "Unknowns":
        """Number the free scalars of a graph, poses first."""
        fixed_poses = graph.fixed_poses
        if fixed_poses is None:
            fixed_poses = np.arange(len(graph.poses)) == 0
        counts = (len(graph.poses), len(graph.anchors), len(graph.calibration.values))
        masks = (fixed_poses, graph.fixed_anchors, graph.fixed_calibration)
        number, size = {}, 0
        for (name, width), count, fixed in zip(BLOCKS, counts, masks, strict=True):
            free = np.ones(count, dtype=bool) if fixed is None else ~fixed
            first = size + width * (np.cumsum(free) - 1)
            number[name] = np.where(free[:, None], first[:, None] + np.arange(width), -1).astype(np.int64)
            size += width * int(free.sum())
        return Unknowns(number, size)

    def spread(self, name: str, vector: Floats) -> Floats:
        """Return the part of a vector that belongs to a block, (unknowns, scalars), 0 where held fixed."""
        return np.append(vector, 0.0)[self.number[name]]

    def moved(self, graph: Graph, step: Floats) -> Graph:
        """Return the graph moved by a step, headings wrapped into (-pi, pi]."""
        poses = graph.poses + self.spread("poses", step)
        poses[:, 2] = np.pi - np.mod(np.pi - poses[:, 2], 2.0 * np.pi)
        calibration = graph.calibration.values + self.spread("calibration", step)[:, 0]
        return graph.updated(poses, graph.anchors + self.spread("anchors", step), calibration)


class NormalEquations:
    """H = J^T W J and g = J^T W r of a graph's edges; rows and columns are the free unknowns."""

    def __init__(self, unknowns: Unknowns, linearized: Sequence[Linearization]) -> None:
        """Analyse where every product of two Jacobians lands."""
        n = unknowns.size
        self.size = n
        numbers = [[unknowns.number[name][index] for name, index, _ in lin.blocks] for lin in linearized]
        keys = [np.arange(n) * (n + 1)]
        twice = []
        for rows in numbers:
            for p, row in enumerate(rows):
                for q, other in enumerate(rows[: p + 1]):
                    r, c = np.broadcast_arrays(row[:, :, None], other[:, None, :])
                    kept = (r >= 0) & (c >= 0)
                    if p == q:
                        kept = kept & (r >= c)
                    keys.append(np.where(kept, np.minimum(r, c) * n + np.maximum(r, c), n * n).ravel())
                    twice.append(np.where((p != q) & (r == c), 2.0, 1.0).ravel())
        self._twice = np.concatenate(twice) if twice else np.zeros(0)
        unique, position = np.unique(np.concatenate(keys), return_inverse=True)
        if not len(unique) or unique[-1] != n * n:
            unique = np.append(unique, n * n)
        self._slots = len(unique)
        self._diagonal, self._position = position[:n], position[n:]
        self._gradient_rows = [np.where(row >= 0, row, n).ravel() for rows in numbers for row in rows]
        upper, lower = np.divmod(unique[:-1], n)
        strict = np.nonzero(upper != lower)[0]
        order = np.arange(len(unique) - 1)
        full = sparse.csc_matrix(
            (np.r_[order, order[strict]] + 1.0, (np.r_[upper, lower[strict]], np.r_[lower, upper[strict]])), shape=(n, n)
        )
        full.sort_indices()
        self._source = full.data.astype(np.int64) - 1
        self._indices, self._indptr = full.indices, full.indptr
        self.values: Floats = np.zeros(self._slots)
        self.gradient: Floats = np.zeros(n)

    def fill(self, linearized: Sequence[Linearization], weights: Sequence[Floats | None]) -> None:
        """Fill H and g from whitened Jacobians and a weight per edge."""
        products, gradient = [], np.zeros(self.size + 1)
        slot = 0
        for lin, weight in zip(linearized, weights, strict=True):
            jacobians = [jac for _, _, jac in lin.blocks]
            weighted = jacobians if weight is None else [jac * weight[:, None, None] for jac in jacobians]
            for p, left in enumerate(weighted):
                by = np.einsum("edk,ed->ek", left, lin.residuals)
                gradient += np.bincount(self._gradient_rows[slot], by.ravel(), self.size + 1)
                slot += 1
                products += [np.einsum("edk,edl->ekl", left, jac).ravel() for jac in jacobians[: p + 1]]
        stacked = np.concatenate(products) if products else np.zeros(0)
        self.values = np.bincount(self._position, stacked * self._twice, self._slots)
        self.gradient = np.asarray(gradient[:-1])

    @property
    def diagonal(self) -> Floats:
        """The diagonal of H."""
        return self.values[self._diagonal]

    def factor(self, damping: Floats | None = None) -> "Factor":
        """Factorise H + diag(damping).

        Raises
        ------
        SolverError : the matrix is not positive definite to working precision.
        """
        values = self.values.copy()
        if damping is not None:
            values[self._diagonal] += damping
        return Factor(sparse.csc_matrix((values[self._source], self._indices, self._indptr), shape=(self.size, self.size)))


class Factor:
    """A factorised symmetric positive definite matrix."""

    def __init__(self, matrix: sparse.csc_matrix) -> None:
        try:
            self._lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as problem:
            raise SolverError(f"the normal equations are singular ({problem}); add a prior or more measurements") from None

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (n,) or (n, m)."""
        return self._lu.solve(right)
