"""Whether the minimum that an optimisation found is the global one.

The cost F of every edge is bounded from below by a Hermitian form that touches it at the estimate (tangent_forms.py). With
headings z of magnitude 1 their sum is x^H M x + const, and with Lambda_k = Re(conj(z_k) (M x)_k) at the estimate the matrix

    S = M - diag(Lambda on headings, 0 on places)

has the estimate in its null space. Where S is positive semi-definite, no other poses and anchors have a lower cost:
F(x) >= x^H S x + F(estimate). Otherwise let eta be the smallest number with S + eta D >= 0, D = diag(1 on headings, 0 on
places): no cost is below F(estimate) - eta times the number of headings. -eta is the smallest eigenvalue of the pencil
(S, D). By Sylvester's law of inertia the signs of the pivots of S + eta D show whether a number is above or below it.

Without the tangents this is the Lagrangian dual of the chordal problem (D. Rosen, L. Carlone, A. Bandeira, J. Leonard,
SE-Sync, IJRR 2019; complex: T. Fan, H. Wang, M. Rubenstein, T. Murphey, CPL-SLAM, T-RO 2020) and, with ranges, that of
CORA (A. Papalia, A. Fishberg, B. O'Neill, J. How, D. Rosen, J. Leonard, T-RO 2024), its unit vectors eliminated. The
tangents make it hold for the cost that the solver minimises: angles as angles, information of any shape.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ..arrays import Bools, Floats, Ints
from ..errors import SolverError
from .elimination import PER_COMPLEX, work_of
from .graph import Graph
from .problem_checks import floating_components
from .solver import SolverConfig, optimize
from .tangent_forms import TangentForm, outside
from .unknowns import free_unknowns

_SHARE, _NOTHING = 1e-6, 1e-3
"""Share of chi2, and chi2 itself, by which a global minimum may be above its bound: rounding error."""
_ROUNDING = 1e-15
"""Error of a factor's pivots as a share of the largest of them."""
_POLISHED = SolverConfig(relative_decrease=1e-15, max_iterations=30)
"""The bound is as good as the gradient is small."""
_HALVINGS = 12
"""Of the logarithm of eta between negligible and worthless, ten decimal powers: the last is a step of 0.6 %."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """Bound on the global minimum."""

    is_global: bool
    """No poses and anchors cost less, up to rounding."""
    lower_bound: float
    """No poses and anchors have a chi2 below this; 0 where nothing is known."""
    reason: str
    """Reason why the minimum is not certified; empty where it is global."""


def certify(graph: Graph, allowed: float = np.inf) -> Certificate:
    """Return whether an optimised graph is the global minimum of its cost.

    Parameters
    ----------
    graph : a minimum; some more iterations bring it closer before it is judged.
    allowed : work, multiplications; where the certificate would take more, there is none.
    """
    chi2, reason = graph.chi2(), outside(graph)
    if reason:
        return Certificate(False, 0.0, reason)
    negligible = _SHARE * chi2 + _NOTHING
    try:
        minimum, summary = optimize(graph, _POLISHED, None, allowed)
        S, D = certificate_matrix(minimum)
        if np.isfinite(allowed) and summary.work + (2 + _HALVINGS) * PER_COMPLEX * work_of(S) > allowed:
            return Certificate(False, 0.0, "its edges tie so many poses to so many others that the matrix would fill up")
        bound = max(summary.chi2 - _gap(S, D, 0.5 * negligible, summary.chi2), 0.0)
    except SolverError as problem:
        return Certificate(False, 0.0, str(problem))
    is_global = chi2 - bound <= negligible
    return Certificate(is_global, bound, "" if is_global else "a lower minimum is not excluded")


def certificate_matrix(graph: Graph) -> tuple[sparse.csc_matrix, Floats]:
    """Return S (m, m) over the free places and headings and the heading of the map, and the diagonal (m,) of D."""
    form = TangentForm(graph)
    every = form.matrix()
    free, spread = _reduction(graph, form, np.diff(every.indptr) > 0)
    M = (spread.conj().T @ every @ spread).tocsc()
    x, D = np.append(form.x[free], 1.0), np.append(free >= form.places, True)
    return (M - sparse.diags(np.where(D, np.real(np.conj(x) * (M @ x)), 0.0))).tocsc(), D.astype(np.float64)


def _reduction(graph: Graph, form: TangentForm, measured: Bools) -> tuple[Ints, sparse.csr_matrix]:
    """Return which numbers (m - 1,) are free, and the matrix that gives all of them from these and the heading of the map.

    Fixed numbers turn with the map. A place without edges (all numbers,) does not change the cost and keeps its value.
    """
    kinds, floating = free_unknowns(graph), floating_components(graph)
    # The place of a floating part does not change the cost; one of its poses may stay at its value.
    kinds["poses"][floating[floating >= 0]] = False
    places = np.concatenate([kinds["poses"], kinds["anchors"]]) & measured[: form.places]
    is_free = np.concatenate([places, kinds["poses"], [False]])
    free, fixed = np.flatnonzero(is_free), np.flatnonzero(~is_free)
    rows, columns = np.concatenate([free, fixed]), np.minimum(np.arange(len(is_free)), len(free))
    values = np.concatenate([np.ones(len(free)), form.x[fixed]])
    return free, sparse.csr_matrix((values, (rows, columns)), shape=(len(is_free), len(free) + 1))


def _gap(S: sparse.csc_matrix, D: Floats, negligible: float, chi2: float) -> float:
    """Return how far below the estimate the bound lies at most: negligible, up to chi2, or infinite."""
    headings = float(D.sum())
    negligible = max(negligible, _ROUNDING * headings * float(abs(S.diagonal()).max()))
    if _is_positive(S, D * negligible / headings):
        return negligible
    if negligible >= chi2 or not _is_positive(S, D * chi2 / headings):
        return np.inf
    low, high = np.log(negligible), np.log(chi2)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _is_positive(S, D * np.exp(middle) / headings) else (middle, high)
    return float(np.exp(high))


def _is_positive(S: sparse.csc_matrix, added: Floats) -> bool:
    """Return whether S + diag(added) is positive definite, by the pivots of its factor."""
    options = {"SymmetricMode": True, "Equil": False}
    try:
        factor = splu(S + sparse.diags(added), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:
        return False
    return bool(np.array_equal(factor.perm_r, factor.perm_c) and np.all(factor.U.diagonal().real > 0.0))
