"""Sparse Levenberg-Marquardt over stacked edges.

The cost is F(x) = sum_e w_e rho(|r_e(x)|^2) with whitened residuals r_e. One iteration replaces it by the quadratic

    q(h) = F + 2 g^T h + h^T H h,    g = sum J_e^T w_e rho' r_e,    H = sum J_e^T w_e rho' J_e,

that is, iteratively reweighted least squares: rho' = weight(|r|^2) is evaluated at the start of the step. The step solves

    (H + lambda D) h = -g,    D = largest diag(H) so far (1 where an unknown is measured by nothing),

Marquardt's scaling: lambda is a pure number, and directions that are not measured do not change. D never shrinks (J. J. More,
The Levenberg-Marquardt algorithm, 1978): an anchor that comes into line with its poses loses all curvature across that line.
A step that decreases F is taken, and lambda is multiplied by max(1/3, 1 - (2 ratio - 1)^3), with the ratio of the real decrease
to the predicted one, h^T (lambda D h - g); otherwise it is multiplied by 2, 4, 8, ... (K. Madsen, H. B. Nielsen, O. Tingleff,
Methods for non-linear least squares problems, 2004, algorithm 3.16).

Where a step turns poses by much and misses its prediction, it is tried in two ways that agree to first order, each pose on its
own and link by link along the trajectory, and the one with the lower cost is taken: an error of the odometry that bends a path
of hundreds of metres is corrected in five steps instead of hundreds (after E. Olson, J. Leonard, S. Teller, Fast iterative
alignment of pose graphs with poor initial estimates, ICRA 2006).

Near the minimum H hardly changes: a step after one of little effect uses the factor of that one. Where its predicted decrease
is negligible and there are no robust kernels, it is the last, and its cost is the predicted one. The search ends where the
decrease to come is negligible: without robust kernels it is extrapolated from the last two as a geometric series, with them,
as reweighting converges linearly at an unknown rate, it is the last one itself. Work is counted, not timed, so that the same
graph gives the same result.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats
from ..config import documented, require_permitted, setting
from ..errors import SolverError
from .factorization import Factor
from .graph import Edges, Graph, Linearization, kernel_weights, linearize, linearized_cost
from .normal_equations import NormalEquations
from .problem_checks import check, independent_residuals, what_is_not_finite
from .schwarz_cg import iterated
from .unknowns import Unknowns, linked_poses, move_by_arcs, move_by_links, turns_much
from .work import ENTRIES

Progress = Callable[[int, int], None]
"""Called as progress(iterations done, most iterations)."""


@documented
@dataclass(frozen=True, slots=True)
class SolverConfig:
    """When the optimisation ends, and how small its first steps are."""

    max_iterations: int = setting(100, minimum=1)
    """Most iterations, each of which solves one linear system."""
    relative_decrease: float = setting(1e-7, above=0.0, advanced=True)
    """Stop when chi2 is about to decrease by no more than this fraction of it."""
    gradient_tolerance: float = setting(1e-9, above=0.0, advanced=True)
    """Stop when no gradient component exceeds this, in standard deviations: max |g_i| / sqrt(H_ii)."""
    initial_damping: ClassVar[float] = 1e-10
    """First lambda; 1e-10 starts with a Gauss-Newton step, 1e-3 with a smaller one, for poor starting values."""

    def __post_init__(self) -> None:
        require_permitted(self)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class SolverSummary:
    """Summary of an optimisation, with the reason for its end."""

    converged: bool
    """False only when the iterations or the work allowed were used up, or no step helped."""
    reason: str
    """Which rule ended the search."""
    iterations: int
    """Linear systems solved."""
    chi2_initial: float
    """Robust, weighted cost at the start."""
    chi2: float
    """Robust, weighted cost at the end."""
    unknowns: int
    """Free scalars."""
    solved: Graph = field(repr=False)
    """The graph at the end."""
    chi2_history: Floats = field(default_factory=lambda: np.zeros(0))
    """(iterations,) cost tried by each step."""
    work: float = 0.0
    """Multiplications of the factorisations."""

    @property
    def dof(self) -> int:
        """Independent residuals of the edges in use minus free unknowns; counting them takes as long as a step."""
        return independent_residuals(self.solved, linearize(self.solved)) - self.unknowns

    @property
    def chi2_per_dof(self) -> float:
        """About 1 where the noise model is right; nan without redundancy."""
        return self.chi2 / dof if (dof := self.dof) > 0 else float("nan")


def _weights_if_any(edges: Edges, residuals: Floats) -> Floats | None:
    return None if edges.weights is None and edges.kernel.name == "none" else kernel_weights(edges, residuals)


def optimize(
    graph: Graph, config: SolverConfig = SolverConfig(), progress: Progress | None = None, allowed: float = np.inf
) -> tuple[Graph, SolverSummary]:
    """Return the graph at the nearest minimum of its cost, and how the search went.

    Parameters
    ----------
    graph : estimates to start from, what is fixed, and the edges; it is not changed.
    allowed : work, multiplications, after which the search ends.

    Raises
    ------
    SolverError : nothing is free, there is no edge, or estimates or measurements are not finite.
    """
    return Optimizer().optimize(graph, config, progress, allowed)


def minimise(
    graph: Graph,
    linearized: list[Linearization],
    normal: NormalEquations,
    config: SolverConfig,
    progress: Progress | None = None,
    allowed: float = np.inf,
) -> tuple[Graph, SolverSummary]:
    """Optimise a graph whose edges are already linearised and analysed; weights and kernels may have changed since.

    The list of linearisations is empty afterwards.
    """
    descent = _Descent(graph, linearized, normal, config, allowed)
    chi2_initial, reason = descent.chi2, descent.prepare()
    while not reason:
        reason = descent.step()
        if progress is not None:
            progress(len(descent.history), config.max_iterations)
        reason = reason or descent.prepare()
    graph, history, converged = descent.graph, np.array(descent.history), reason in (NO_DECREASE, GRADIENT)
    chi2, size = descent.chi2, normal.unknowns.size
    return graph, SolverSummary(converged, reason, len(history), chi2_initial, chi2, size, graph, history, descent.work)


class DescentPolicy:
    """When the damping changes, a factor is used again, and a step is the last."""

    negligible: float = 1e-12
    """chi2 that never matters, and its share that the rounding of thousands of residuals hides."""
    little: float = 1e-4
    """Share of chi2 above which a predicted decrease that was not reached is no sign of a minimum, even in a coarse search."""
    free: float = 1e-2
    """lambda up to which small steps indicate a minimum and not only strong damping."""
    patience: int = 8
    """Accepted steps that together indicate a minimum if their decrease was negligible, for any damping."""
    near: float = 5e-2
    nearly_free: float = 1e-6
    """A step that decreased chi2 by less than this share, with less damping, hardly changed H: the next uses its factor."""
    as_predicted: float = 0.9
    """Share of the predicted decrease from which on the other way of moving has little to gain."""
    quadratic: float = 0.5
    """Share of the predicted decrease below which the cost is not quadratic along a step, and predicts no later ones."""
    many: float = 1e3
    """Unknowns from which on the first lambda falls with their squared number: the damping of all poses of a chain, which move
    together, is to be softer than one of its steps."""
    first: float = 1e-5
    most: float = 1e12
    """lambda at least after a step that failed, and at most."""


class _Descent:
    """State of a search: the estimate, the edges linearised there, and the damping of the next step."""

    def __init__(
        self, graph: Graph, linearized: list[Linearization], normal: NormalEquations, config: SolverConfig, allowed: float
    ) -> None:
        self.graph, self.linearized, self.normal, self.config = graph, linearized, normal, config
        self.work, self.allowed = 0.0, allowed
        self.chi2 = linearized_cost(graph, linearized)
        if not np.isfinite(self.chi2):
            raise SolverError(what_is_not_finite(graph, linearized))
        self.history: list[float] = []
        self.moved = True
        """The gradient is of an estimate before this one."""
        self.current = False
        """H is of the estimate, and not of one before it."""
        self.factor: Factor | None = None
        """To be used again; None = factorise."""
        self.damping = config.initial_damping / max(normal.unknowns.size / DescentPolicy.many, 1.0) ** 2
        self.raised_by, self.last_decrease = 2.0, np.inf
        self.decreases: list[float] = []
        self.scale = np.zeros(normal.unknowns.size)
        self.linked = linked_poses(len(graph.poses), linearized)
        self.robust = any(edges.kernel.name != "none" for edges in graph.edges)

    def prepare(self) -> str:
        """Bring the normal equations to the estimate; return why the search ends here, "" where it goes on."""
        again = self.factor is None
        if self.moved or (again and not self.current):
            at = self.linearized or linearize(self.graph)
            weights = [_weights_if_any(e, lin.residuals) for e, lin in zip(self.graph.edges, at, strict=True)]
            self.normal.fill(at, weights, again)
            # The normal equations contain all of it now; the Jacobians of a recording of hours are large.
            at.clear()
            self.linearized, self.current = [], again
            diagonal = self.normal.diagonal
            curvature = np.where(diagonal > 0, diagonal, 1.0)
            self.scale = np.maximum(self.scale, curvature)
            if np.max(np.abs(self.normal.gradient) / np.sqrt(curvature)) <= self.config.gradient_tolerance:
                return GRADIENT
        if self.work >= self.allowed:
            return ALL_WORK_DONE
        return USED_UP if len(self.history) == self.config.max_iterations else ""

    def step(self) -> str:
        """Try a step, and take it where the cost falls; return why the search ends with it, "" where it goes on."""
        reused, before = self.factor is not None, iterated(self.factor)
        self.factor, step, promised = _solve_step(self.normal, self.damping * self.scale, self.factor)
        steps = iterated(self.factor) - before if reused else iterated(self.factor)
        self.graph.work[ENTRIES] += int(steps)
        self.work += steps if reused else steps + self.normal.work
        negligible = self.config.relative_decrease * self.chi2 + DescentPolicy.negligible
        if reused and not self.robust and 0 < promised <= negligible:
            self.graph, self.chi2 = move_by_arcs(self.graph, self.normal.unknowns, step), self.chi2 - promised
            self.history.append(self.chi2)
            return NO_DECREASE
        enough = self.chi2 - DescentPolicy.as_predicted * promised
        trial = cheaper_move(self.graph, self.normal.unknowns, step, self.linked, enough)
        self.history.append(trial[-1])
        self.moved = promised > 0 and trial[-1] <= self.chi2
        rest = promised, negligible, reused
        over = self._take(trial, *rest) if self.moved else self._refuse(*rest)
        if not over and self.damping > DescentPolicy.most:
            # At a minimum no step helps either: then the remaining decrease is below the rounding error.
            lost = np.max(self.normal.gradient**2 / self.scale) <= DescentPolicy.negligible * self.chi2
            return NO_DECREASE if lost else STUCK
        return NO_DECREASE if over else ""

    def _take(self, trial: "_Trial", promised: float, negligible: float, reused: bool) -> bool:
        """Continue from the trial, with less damping; return whether the remaining decrease is negligible."""
        graph, linearized, chi2 = trial
        decrease = self.chi2 - chi2
        # The reweighting of a robust kernel halves the remaining decrease with every step, at best.
        to_come = extrapolated(decrease, np.inf if self.robust else self.last_decrease, promised)
        over = to_come <= negligible and self.damping <= DescentPolicy.free
        self.decreases = [*self.decreases[1 - DescentPolicy.patience :], decrease]
        over = over or (len(self.decreases) == DescentPolicy.patience and sum(self.decreases) <= negligible)
        near = not reused and decrease <= DescentPolicy.near * self.chi2 and self.damping <= DescentPolicy.nearly_free
        self.factor = self.factor if near else None
        self.graph, self.linearized, self.last_decrease, self.chi2 = graph, linearized, decrease, chi2
        self.damping, self.raised_by = self.damping * relaxed(decrease / promised), 2.0
        return over

    def _refuse(self, promised: float, negligible: float, reused: bool) -> bool:
        """Reject the step, with more damping unless it used an old factor; return whether its decrease was to be negligible."""
        self.factor = None
        if reused:
            return False
        if 0 < promised <= min(negligible, DescentPolicy.little * self.chi2) and self.damping <= DescentPolicy.free:
            return True
        self.damping, self.raised_by = max(self.damping * self.raised_by, DescentPolicy.first), self.raised_by * 2.0
        return False


NO_DECREASE = "chi2 no longer decreases"
GRADIENT = "gradient negligible"
STUCK = "no step decreases chi2"
USED_UP = "iterations used up"
ALL_WORK_DONE = "the work allowed is done"


def _solve_step(normal: NormalEquations, damping: Floats, factor: Factor | None) -> tuple[Factor | None, Floats, float]:
    """Return the factor used (an earlier one where given), the step and its predicted decrease; not positive: no factor."""
    try:
        if factor is not None:
            step = factor.solve(-normal.gradient)
            return factor, step, -float(step @ normal.gradient)
        factor = normal.factor(damping)
        step = factor.solve(-normal.gradient)
    except SolverError:
        return None, np.zeros(len(damping)), -1.0
    return factor, step, float(step @ (damping * step - normal.gradient))


_Trial = tuple[Graph, list[Linearization], float]


def cheaper_move(graph: Graph, unknowns: Unknowns, step: Floats, linked: Bools, enough: float) -> _Trial:
    """Return the graph moved by a step, linearised there, and its cost.

    Where the step turns poses by much, and the first way of moving them costs more than enough, by whichever way costs less.
    """
    straight = _trial_at(move_by_arcs(graph, unknowns, step))
    if straight[2] <= enough or not linked.any() or not turns_much(unknowns, step):
        return straight
    along = _trial_at(move_by_links(graph, unknowns, step, linked))
    return along if along[2] < straight[2] else straight


def _trial_at(graph: Graph) -> _Trial:
    linearized = linearize(graph)
    return graph, linearized, linearized_cost(graph, linearized)


def extrapolated(decrease: float, last: float, promised: float) -> float:
    """Return the sum of the geometric series that the last two decreases begin, where the steps reach their predicted
    decrease; else, and behind the first, as much again."""
    if not np.isfinite(last) or decrease < DescentPolicy.quadratic * promised:
        return max(decrease, promised)
    return decrease * (decrease / (last - decrease)) if decrease < last else np.inf


def relaxed(ratio: float) -> float:
    """Return the factor of lambda after a step that decreased the cost by this ratio of the predicted decrease."""
    return max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)


class Optimizer:
    """Optimises graphs; of graphs that follow each other with the same unknowns and edges the pattern is analysed once."""

    def __init__(self) -> None:
        self._normal: NormalEquations | None = None

    def optimize(
        self, graph: Graph, config: SolverConfig, progress: Progress | None = None, allowed: float = np.inf
    ) -> tuple[Graph, SolverSummary]:
        """Return the graph at the nearest minimum of its cost, and how the search went; see solver.optimize."""
        check(graph)
        linearized = linearize(graph)
        if self._normal is None or not self._normal.suits(graph, linearized):
            self._normal = NormalEquations(graph, linearized)
        return minimise(graph, linearized, self._normal, config, progress, allowed)
