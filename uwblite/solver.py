"""Sparse Levenberg-Marquardt over stacked edges.

The cost is F(x) = sum_e w_e rho(|r_e(x)|^2) with whitened residuals r_e. One iteration replaces it by the quadratic

    q(h) = F + 2 g^T h + h^T H h,    g = sum J_e^T w_e rho' r_e,    H = sum J_e^T w_e rho' J_e,

that is, iteratively reweighted least squares: rho' = weight(|r|^2) is taken where the step starts and its own derivative
is left out, so H stays positive semi-definite whatever the kernel. The step solves

    (H + lambda D) h = -g,    D = diag(H) (1 where an unknown is measured by nothing),

which is Marquardt's scaling: it makes lambda a pure number, the same for metres, radians and scale factors, and it
keeps the matrix positive definite where the measurements leave a direction open (an anchor never heard, a closure
whose information is singular): such a direction simply does not move. The model promises the decrease
h^T (lambda D h - g); the ratio of what F really does to that promise decides. A step that decreases F is taken, and
lambda is multiplied by max(1/3, 1 - (2 ratio - 1)^3); otherwise the step is dropped and lambda is multiplied by
nu = 2, 4, 8, ... (H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05; K. Madsen, H. B. Nielsen,
O. Tingleff, Methods for non-linear least squares problems, 2004, algorithm 3.16).

The search ends, and says why, when the promise or the decrease falls below a fraction of F, when every component of
the gradient, in units of its own curvature, is negligible, when the step is, or when the iterations are used up.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import se2
from .errors import ConfigError, SolverError
from .graph import Edges, Graph, Linearization, edge_cost
from .linear import NormalEquations, Unknowns, free_unknowns

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Progress = Callable[[int, int], None]
"""Called as progress(iterations done, most iterations)."""


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """When to stop, and how carefully to start."""

    max_iterations: int = 100
    """Most linear systems solved."""
    relative_decrease: float = 1e-7
    """Stop when a step decreases chi2 by less than this fraction of it."""
    gradient_tolerance: float = 1e-8
    """Stop when no gradient component exceeds this, in standard deviations: max |g_i| / sqrt(H_ii)."""
    step_tolerance: float = 1e-10
    """Stop when no unknown moves by more than this, m or rad."""
    initial_damping: float = 1e-10
    """First lambda; small = trust the starting values."""

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise ConfigError(f"max_iterations must be at least 1, not {self.max_iterations}")
        for name in ("relative_decrease", "gradient_tolerance", "step_tolerance", "initial_damping"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class SolverSummary:
    """What an optimisation did and why it ended."""

    converged: bool
    """False only when the iterations were used up or no step helped."""
    reason: str
    """Which rule ended the search."""
    iterations: int
    """Linear systems solved."""
    chi2_initial: float
    """Robust, weighted cost at the start."""
    chi2: float
    """Robust, weighted cost at the end."""
    dof: int
    """Independent residuals of the edges in use minus free unknowns."""
    damping: float
    """Last lambda."""
    chi2_history: Floats = field(default_factory=lambda: np.zeros(0))
    """(iterations,) cost tried by each step."""
    damping_history: Floats = field(default_factory=lambda: np.zeros(0))
    """(iterations,) lambda of each step."""
    unobserved: dict[str, Ints] = field(default_factory=dict)
    """By block: indices of free unknowns that no edge measures; they stay where they were."""

    @property
    def chi2_per_dof(self) -> float:
        """About 1 where the noise model holds; nan without redundancy."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


def moved(graph: Graph, unknowns: Unknowns, step: Floats) -> Graph:
    """Return the graph moved by a step: poses along the arc of a constant twist, the rest straight.

    With the turn w of a pose and its shift t in the map frame, x -> x + V(w) t: to first order addition, and the shift
    turns with the pose. Long bent chains need about two iterations fewer than with plain addition.
    """
    shift = unknowns.spread("poses", step)
    arc = se2.exp(shift)
    poses = np.empty_like(graph.poses)
    poses[:, :2] = graph.poses[:, :2] + arc[:, :2]
    poses[:, 2] = se2.wrap_angle(graph.poses[:, 2] + shift[:, 2])
    calibration = graph.calibration.values + unknowns.spread("calibration", step)[:, 0]
    return graph.updated(poses, graph.anchors + unknowns.spread("anchors", step), calibration)


def edge_weights(edges: Edges, graph: Graph) -> Floats:
    """Return each edge's share (e,) in the normal equations at these estimates: its own weight times the kernel's."""
    return _weights(edges, edges.residuals(graph))


def _weights(edges: Edges, residuals: Floats) -> Floats:
    kernel = edges.kernel.weight(np.einsum("ed,ed->e", residuals, residuals))
    return kernel if edges.weights is None else kernel * edges.weights


def _or_none(edges: Edges, residuals: Floats) -> Floats | None:
    return None if edges.weights is None and edges.kernel.name == "none" else _weights(edges, residuals)


def optimize(
    graph: Graph, config: SolverConfig = SolverConfig(), progress: Progress | None = None
) -> tuple[Graph, SolverSummary]:
    """Return the graph at the nearest minimum of its cost, and how the search went.

    Parameters
    ----------
    graph : estimates to start from, what is held fixed, and the edges; it is not changed.
    config : stopping rules.
    progress : called after every iteration with (done, most).

    Raises
    ------
    SolverError : nothing is free, there is no edge, or estimates or measurements are not finite.
    """
    _check(graph)
    linearized = _linearize(graph)
    normal = NormalEquations(graph, linearized)
    chi2 = chi2_initial = _cost(graph, linearized)
    if not np.isfinite(chi2):
        raise SolverError(_what_is_not_finite(graph, linearized))
    damping, growth = config.initial_damping, 2.0
    chi2_history: list[float] = []
    damping_history: list[float] = []
    reason, converged, fresh = "", False, False
    while not reason:
        if not fresh:
            normal.fill(linearized, [_or_none(e, lin.residuals) for e, lin in zip(graph.edges, linearized, strict=True)])
            diagonal = normal.diagonal
            scale = np.where(diagonal > 0, diagonal, 1.0)
            fresh = True
            if np.max(np.abs(normal.gradient) / np.sqrt(scale)) <= config.gradient_tolerance:
                reason, converged = "gradient negligible", True
                break
        if len(chi2_history) == config.max_iterations:
            reason = "iterations used up"
            break
        if damping > _MOST_DAMPING:
            reason = "no step decreases chi2"
            break
        damping_history.append(damping)
        step, promised = _step(normal, damping * scale)
        trial = moved(graph, normal.unknowns, step)
        trial_linearized = _linearize(trial)
        trial_chi2 = _cost(trial, trial_linearized)
        chi2_history.append(trial_chi2)
        if progress is not None:
            progress(len(chi2_history), config.max_iterations)
        decrease = chi2 - trial_chi2
        if np.isfinite(trial_chi2) and decrease >= 0 and promised > 0:
            if max(decrease, promised) <= config.relative_decrease * chi2:
                reason, converged = "chi2 no longer decreases", True
            elif np.max(np.abs(step)) <= config.step_tolerance:
                reason, converged = "step negligible", True
            graph, linearized, chi2, fresh = trial, trial_linearized, trial_chi2, False
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * decrease / promised - 1.0) ** 3)
            growth = 2.0
        elif 0 < promised <= 1e-3 * config.relative_decrease * chi2:
            reason, converged = "chi2 no longer decreases", True
        else:
            damping *= growth
            growth *= 2.0
    summary = SolverSummary(
        converged,
        reason,
        len(chi2_history),
        chi2_initial,
        chi2,
        _independent_residuals(graph, linearized) - normal.unknowns.size,
        damping,
        np.array(chi2_history),
        np.array(damping_history),
        _unobserved(normal.unknowns, normal.diagonal),
    )
    return graph, summary


_MOST_DAMPING = 1e12


def _step(normal: NormalEquations, damping: Floats) -> tuple[Floats, float]:
    """Return the damped step and the decrease it promises (not positive: the factorisation failed)."""
    try:
        step = normal.factor(damping).solve(-normal.gradient)
    except SolverError:
        return np.zeros(len(damping)), -1.0
    return step, float(step @ (damping * step - normal.gradient))


def _linearize(graph: Graph) -> list[Linearization]:
    return [edges.linearize(graph) for edges in graph.edges]


def _cost(graph: Graph, linearized: list[Linearization]) -> float:
    return sum(edge_cost(edges, lin.residuals) for edges, lin in zip(graph.edges, linearized, strict=True))


def _check(graph: Graph) -> None:
    if not any(mask.any() for mask in free_unknowns(graph).values()):
        raise SolverError("nothing to optimise: every pose, anchor and calibration value is held fixed")
    if not sum(len(edges) for edges in graph.edges):
        raise SolverError("nothing to optimise: the graph has no edges")
    for name, values in (
        ("poses", graph.poses),
        ("anchors", graph.anchors),
        ("calibration", graph.calibration.values[:, None]),
    ):
        bad = np.nonzero(~np.isfinite(values).all(axis=1))[0]
        if len(bad):
            raise SolverError(f"starting values are not finite: {name}[{bad[0]}] = {values[bad[0]]} ({len(bad)} in all)")


def _what_is_not_finite(graph: Graph, linearized: list[Linearization]) -> str:
    for edges, lin in zip(graph.edges, linearized, strict=True):
        bad = np.nonzero(~np.isfinite(lin.residuals).all(axis=1))[0]
        if len(bad):
            kind = type(edges).__name__
            return f"residuals are not finite: edge {bad[0]} of {kind} ({len(bad)} in all); remove such measurements"
    return "the cost is not finite although every residual is: weights or residuals are too large"


def _independent_residuals(graph: Graph, linearized: list[Linearization]) -> int:
    """Count the residuals of edges in use; an edge whose information is singular counts by its rank."""
    total = 0
    for edges, lin in zip(graph.edges, linearized, strict=True):
        used = slice(None) if edges.weights is None else edges.weights > 0
        jacobians = np.concatenate([jac for _, _, jac in lin.blocks], axis=2)[used]
        if jacobians.shape[1] == 1:
            total += int(np.any(jacobians != 0, axis=(1, 2)).sum())
        else:
            total += int(np.linalg.matrix_rank(jacobians @ jacobians.transpose(0, 2, 1), hermitian=True).sum())
    return total


def _unobserved(unknowns: Unknowns, diagonal: Floats) -> dict[str, Ints]:
    zero = np.append(diagonal <= 0, False)
    return {name: np.nonzero(zero[number].any(axis=1))[0] for name, number in unknowns.number.items()}
