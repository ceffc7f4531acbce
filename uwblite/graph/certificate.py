"""Whether the minimum that an optimisation found is the global one.

The cost F of every edge is bounded from below by a Hermitian form that touches it at the estimate (TangentForm). With poses as
complex numbers, t for the place and z = exp(i theta) for the heading, the sum is x^H M x + const, and with
Lambda_k = Re(conj(z_k) (M x)_k) at the estimate the matrix

    S = M - diag(Lambda on headings, 0 on places)

has the estimate in its null space. Where S is positive semi-definite, no other poses and anchors have a lower cost:
F(x) >= x^H S x + F(estimate). Otherwise let eta be the smallest number with S + eta D >= 0, D = diag(1 on headings, 0 on
places): no cost is below F(estimate) - eta times the number of headings. -eta is the smallest eigenvalue of the pencil
(S, D). By Sylvester's law of inertia the signs of the pivots of S + eta D show whether a number is above or below it.

Without the tangents this is the Lagrangian dual of the chordal problem (D. Rosen, L. Carlone, A. Bandeira, J. Leonard,
SE-Sync, IJRR 2019; complex: T. Fan, H. Wang, M. Rubenstein, T. Murphey, CPL-SLAM, T-RO 2020) and, with ranges, that of
CORA (A. Papalia, A. Fishberg, B. O'Neill, J. How, D. Rosen, J. Leonard, T-RO 2024), its unit vectors eliminated. The
tangents make it hold for the cost that the solver minimises: angles as angles, information of any shape. What touches with its
gradient, and lies below everywhere:

* of a range: (sqrt(q) - d)^2 is convex in the squared distance q, and so lies above its tangent, which weighs q with
  1 - d / rho at the estimate rho: negative where the range was measured longer than the estimate has it;
* of an angle: delta^2 is convex in 2 - 2 cos(delta), and so lies above the tangent with slope delta / sin(delta);
* of a relative pose: terms of second order about the estimate are replaced by those of the largest information below it that
  is diagonal, and equal in x and y; terms of first order stay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import sparse

from .. import se2
from ..arrays import Bools, Complexes, Floats, Ints
from ..errors import SolverError
from .elimination import multiplications_of
from .factorization import superlu
from .graph import Edges, Graph, PriorEdges
from .point_edges import AnchorDistanceEdges, LandmarkEdges, PointDistanceEdges, distances
from .pose_edges import RelativePoseEdges
from .problem_checks import floating_components
from .range_edges import RangeEdges
from .solver import SolverConfig, optimize
from .unknowns import free_unknowns

_Parts = Sequence[tuple[Ints, Any]]
"""A linear function of the numbers, one an edge: their indices (e,) and coefficients (e,)."""


def outside(graph: Graph) -> str:
    """Return why a graph's cost is not bounded by such forms, or an empty text."""
    for edges in graph.edges:
        if edges.kernel.name != "none":
            return f"the robust kernel {edges.kernel.name} has no relaxation"
        calibrated = isinstance(edges, RangeEdges) and bool(np.any(edges.calibration >= 0))
        calibrated |= isinstance(edges, PriorEdges) and edges.block == "calibration"
        if calibrated or not isinstance(edges, _BOUNDED):
            return "calibration is unknown, and the relaxation has no terms for it"
    return ""


_BOUNDED = (RelativePoseEdges, RangeEdges, PointDistanceEdges, AnchorDistanceEdges, LandmarkEdges, PriorEdges)


class TangentForm:
    """The sum of the forms of a graph's edges, without its constant."""

    def __init__(self, graph: Graph) -> None:
        """Add the forms of all edges.

        Raises
        ------
        SolverError : an angle is half a turn off, or tied to places by singular information.
        """
        n, a = len(graph.poses), len(graph.anchors)
        # The origin is moved to the middle of the places, so that numbers are small for any map frame.
        places = np.concatenate([graph.poses[:, :2], graph.anchors]) - graph.poses[:, :2].mean(axis=0)
        self.x: Complexes = np.concatenate([se2.as_complex(places), se2.unit_complex(graph.poses[:, 2]), [1.0]])
        """(2 n + a + 1,) places of poses and anchors, headings of poses and of the map."""
        self.places = n + a
        """How many of them are places."""
        self._anchor, self._map = n, 2 * n + a
        self._entries: list[tuple[Ints, Ints, Complexes]] = []
        for edges in graph.edges:
            self._add_edges(graph, edges, edges.own_weights)

    def matrix(self) -> sparse.csr_matrix:
        """Return M with x^H M x + const = the sum."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(self.x), len(self.x)))

    def _add_edges(self, graph: Graph, edges: Edges, weights: Floats) -> None:
        if isinstance(edges, RangeEdges):
            arm = edges.tag_positions(graph.poses) - graph.poses[edges.pose, :2]
            parts: _Parts = ((edges.pose, 1.0), self._carried(edges.pose, arm), (self._anchor + edges.anchor, -1.0))
            self._add_square(weights / edges.sigma**2 * (1.0 - edges.ranges / edges.distances(graph)), parts)
        elif isinstance(edges, PointDistanceEdges | AnchorDistanceEdges):
            if isinstance(edges, AnchorDistanceEdges):
                parts = ((self._anchor + edges.i, 1.0), (self._anchor + edges.j, -1.0))
            else:
                one, other = (
                    (self.places + edges.i, se2.as_complex(edges.point_i)),
                    (self.places + edges.j, -se2.as_complex(edges.point_j)),
                )
                parts = ((edges.i, 1.0), one, (edges.j, -1.0), other)
            self._add_square(weights / edges.sigma**2 * (1.0 - edges.distance / distances(edges, graph)), parts)
        elif isinstance(edges, RelativePoseEdges):
            L, r = _weighted(graph, edges, weights)
            i, j = self.places + edges.i, self.places + edges.j
            self._add_pose(L, r, edges.T_i_j[:, 2], i, ((edges.j, 1.0), (edges.i, -1.0)), j)
        elif isinstance(edges, LandmarkEdges):
            L, r = _weighted(graph, edges, weights)
            ends = ((self._anchor + edges.anchor, 1.0), (edges.pose, -1.0))
            self._add_pose(L, r, np.zeros(len(r)), self.places + edges.pose, ends)
        elif isinstance(edges, PriorEdges):
            L, r = _weighted(graph, edges, weights)
            frame, no_turn = np.full(len(r), self._map), np.zeros(len(r))
            if edges.block == "poses":
                self._add_pose(L, r, no_turn, frame, ((edges.index, 1.0),), self.places + edges.index)
            else:
                self._add_pose(L, r, no_turn, frame, ((self._anchor + edges.index, 1.0),))

    def _carried(self, pose: Ints, arm: Floats) -> tuple[Ints, Complexes]:
        """Return the part of a point that is fixed to a pose, given by its offset from the pose in the map frame (e, 2)."""
        heading = self.places + pose
        return heading, se2.as_complex(arm) * np.conj(self.x[heading])

    def _add(self, row: Ints, column: Ints, value: Complexes) -> None:
        """Add 2 Re(conj(x_row) value x_column)."""
        self._entries += [(row, column, value), (column, row, value.conj())]

    def _add_square(self, weight: Floats, parts: _Parts) -> None:
        """Add weight |sum of coefficient x|^2."""
        for k, (row, c) in enumerate(parts):
            self._add(row, row, 0.5 * weight * abs(c) ** 2 + 0j)
            for column, d in parts[:k]:
                self._add(row, column, weight * np.conj(c) * d + 0j)

    def _add_pose(
        self, L: Floats, r: Floats, turned: Floats, frame: Ints, ends: _Parts, end_heading: Ints | None = None
    ) -> None:
        """Add the tangents of |r|^2, r = L (place in the frame, turned back (e,), then heading) whitened (e, d)."""
        tau, kappa = _largest_below(L)
        g = np.einsum("eji,ej->ei", L, r)
        self._add_offset(tau, se2.as_complex(g) * se2.unit_complex(turned), frame, ends)
        if end_heading is not None:
            self._add_turn(kappa, g[:, 2], frame, end_heading)

    def _add_offset(self, tau: Floats, g: Complexes, frame: Ints, ends: _Parts) -> None:
        """Add tau |u - u'|^2 + 2 Re(conj(g) u) for the sum u of the ends, as seen in the frame; u' is the estimate."""
        self._add_square(tau, ends)
        b = g - tau * np.conj(self.x[frame]) * sum(sign * self.x[end] for end, sign in ends)
        for end, sign in ends:
            self._add(frame, end, sign * b.conj())

    def _add_turn(self, kappa: Floats, g: Floats, i: Ints, j: Ints) -> None:
        """Add the tangent of kappa psi^2 + 2 g psi, psi = how far conj(x_i) x_j turned from the estimate.

        That is kappa delta^2 + const with delta = psi + g / kappa.
        """
        delta = np.divide(g, kappa, out=np.zeros_like(g), where=kappa > 0)
        if np.any(np.abs(delta) >= np.pi) or np.any((kappa <= 0) & (np.abs(g) > 0)):
            raise SolverError("an angle is half a turn off, or tied to places by singular information")
        slope = kappa / np.sinc(delta / np.pi)
        self._add(i, j, -slope * se2.unit_complex(delta) * self.x[i] * np.conj(self.x[j]))


def _weighted(graph: Graph, edges: RelativePoseEdges | LandmarkEdges | PriorEdges, weights: Floats) -> tuple[Floats, Floats]:
    """Return L (e, d, d) and whitened residuals (e, d) with the weights of the edges in them."""
    scale = np.sqrt(weights)
    return edges.sqrt_information * scale[:, None, None], edges.residuals(graph) * scale[:, None]


def _largest_below(L: Floats) -> tuple[Floats, Floats]:
    """Return tau (e,), kappa (e,) with diag(tau, tau, kappa) below L^T L, its own ratio of places and headings kept."""
    information = np.swapaxes(L, 1, 2) @ L
    tau = np.maximum(np.linalg.eigvalsh(information[:, :2, :2])[:, 0], 0.0)
    if L.shape[2] == 2:
        return tau, np.zeros_like(tau)
    kappa = information[:, 2, 2]
    coupled = np.any(information[:, :2, 2] != 0.0, axis=1)
    scale = 1.0 / np.sqrt(np.maximum(np.stack([tau, tau, kappa], axis=1), np.finfo(np.float64).tiny))
    share = np.clip(np.linalg.eigvalsh(scale[:, :, None] * information * scale[:, None, :])[:, 0], 0.0, 1.0)
    share = np.where(coupled, share, 1.0)
    return tau * share, kappa * share


@dataclass(frozen=True, slots=True)
class CertificatePolicy:
    """Rounding errors, and the effort of a bound."""

    share: ClassVar[float] = 1e-6
    least: ClassVar[float] = 1e-3
    """Share of chi2, and chi2 itself, by which a global minimum may be above its bound."""
    rounding: ClassVar[float] = 1e-15
    """Error of a factor's pivots as a share of the largest of them."""
    polished: ClassVar[SolverConfig] = SolverConfig(relative_decrease=rounding, max_iterations=30)
    """The bound is as good as the gradient is small."""
    halvings: ClassVar[int] = 12
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
    negligible = CertificatePolicy.share * chi2 + CertificatePolicy.least
    try:
        minimum, summary = optimize(graph, CertificatePolicy.polished, None, allowed)
        S, D = certificate_matrix(minimum)
        if np.isfinite(allowed) and summary.work + (2 + CertificatePolicy.halvings) * multiplications_of(S) > allowed:
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
    negligible = max(negligible, CertificatePolicy.rounding * headings * float(abs(S.diagonal()).max()))
    if _is_positive(S, D * negligible / headings):
        return negligible
    if negligible >= chi2 or not _is_positive(S, D * chi2 / headings):
        return np.inf
    low, high = np.log(negligible), np.log(chi2)
    for _ in range(CertificatePolicy.halvings):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _is_positive(S, D * np.exp(middle) / headings) else (middle, high)
    return float(np.exp(high))


def _is_positive(S: sparse.csc_matrix, added: Floats) -> bool:
    """Return whether S + diag(added) is positive definite, by the pivots of its factor."""
    try:
        factor = superlu(sparse.csc_matrix(S + sparse.diags(added)), "MMD_AT_PLUS_A")
    except SolverError:
        return False
    return bool(np.array_equal(factor.perm_r, factor.perm_c) and np.all(factor.U.diagonal().real > 0.0))
