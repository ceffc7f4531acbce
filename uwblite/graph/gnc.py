"""Graduated non-convexity: decide which edges of chosen kinds are outliers while optimising.

The truncated square min(r^2, c^2) is approached from a nearly convex surrogate as mu rises from about 0; each edge's
weight follows in closed form from its residual (H. Yang, P. Antonante, V. Tzoumas, L. Carlone, Graduated Non-Convexity
for Robust Spatial Perception, RA-L 2020, equation 14)::

    w = 0                             r^2 >= (mu + 1) / mu c^2
    w = 1                             r^2 <= mu / (mu + 1) c^2
    w = c / r sqrt(mu (mu + 1)) - mu  between

The search starts from the residuals of the given estimate instead of an optimum with all edges as inliers, and takes a step
for each mu, which changes little.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from .. import se2
from ..arrays import Bools, Floats
from .graph import Edges, Graph, Linearization, PriorEdges, linearize
from .normal_equations import NormalEquations
from .pose_edges import RelativePoseEdges
from .problem_checks import check
from .robust import SQUARED, Kernel
from .solver import Optimizer, Progress, SolverConfig, SolverSummary, minimise


class OutlierPolicy:
    """What an outlier is, and the way to it."""

    probability: float = 1e-3
    """Of a sound edge to be taken for an outlier."""
    factor: float = 2.0
    """On mu from step to step; one linear system is solved for each."""
    reach: float = 100.0
    """Residual, in thresholds, beyond which an edge starts with weight 0; it may still come back."""
    strict: float = 100.0
    """mu at which the surrogate is the truncated square to within a per cent of the threshold."""


def _threshold(dimensions: int) -> float:
    """Return the whitened norm beyond which an edge of so many dimensions is an outlier."""
    return float(np.sqrt(chdtri(dimensions, OutlierPolicy.probability)))


def optimize_tightening(
    graph: Graph, chosen: Collection[int], scales: Sequence[float], solver: SolverConfig, together: bool = False
) -> Graph:
    """Optimise with a Geman-McClure kernel on chosen kinds of edges that is tightened, scale by scale, standard deviations.

    A scale that no residual exceeds would reject nothing: it is left out, but for the last.

    Parameters
    ----------
    chosen : their positions in ``graph.edges``.
    together : the kernels of all other edges are wider by the same ratio, until the last scale. Of two steps of the odometry,
        the one that gave way before would else stay torn, although the other explains the closures better.
    """
    optimizer, given = Optimizer(), graph.edges
    for scale in scales:
        if scale != scales[-1] and _worst(graph, dict.fromkeys(chosen, scale)) <= 1.0:
            continue
        kernel, wider = Kernel("geman-mcclure", scale), scale / scales[-1] if together else 1.0
        others = [replace(e.kernel, scale=wider * e.kernel.scale) for e in given]
        edges = tuple(replace(e, kernel=kernel if k in chosen else others[k]) for k, e in enumerate(given))
        graph = optimizer.optimize(replace(graph, edges=edges), solver)[0]
    return graph


def truncated_weight(squared: Floats, mu: float) -> Floats:
    """Return the weights (e,) of residuals whose squares (e,) are given in units of the squared threshold."""
    between = np.sqrt(mu * (mu + 1.0) / np.maximum(squared, np.sqrt(np.finfo(np.float64).tiny))) - mu
    return np.clip(np.where(squared >= (mu + 1.0) / mu, 0.0, between), 0.0, 1.0)


def optimize_gnc(
    graph: Graph,
    thresholds: Mapping[int, float],
    solver: SolverConfig = SolverConfig(),
    progress: Progress | None = None,
    allowed: float = np.inf,
) -> tuple[Graph, SolverSummary, dict[int, Floats]]:
    """Optimise a graph and find the outliers among chosen kinds of edges.

    Parameters
    ----------
    graph : estimates to start from and edges; a kind's own weights stay as factors, its kernel is not used.
    thresholds : by position in ``graph.edges``, the whitened norm, in standard deviations, above which an edge is an
        outlier.
    solver : of the last optimisation, with the weights decided.
    progress : called with (done, most) after every step, `most` being an estimate.
    allowed : work, multiplications; half of it for the steps that find the weights, the rest for the last optimisation.

    Returns
    -------
    The graph with the weights found; how the last optimisation went; by position the weights (e,), 0 = outlier, 1 = inlier.
    """
    check(graph)
    edges = tuple(replace(e, kernel=SQUARED) if k in thresholds else e for k, e in enumerate(graph.edges))
    plain = replace(graph, edges=edges)
    linearized = linearize(plain)
    normal = NormalEquations(plain, linearized)
    mu = 1.0 / max(2.0 * min(_worst(plain, thresholds), OutlierPolicy.reach**2) - 1.0, 1.0 / OutlierPolicy.strict)
    few = replace(solver, max_iterations=1)
    most = max(1, int(np.ceil(np.log(OutlierPolicy.strict / mu) / np.log(OutlierPolicy.factor))))
    current, spent = plain, 0.0
    for step in range(most):
        weights = {k: truncated_weight(s, mu) for k, s in _squared(current, thresholds).items()}
        current, summary = minimise(*_weighted(current, plain, weights), normal, few)
        spent += summary.work
        if progress is not None:
            progress(step + 1, most + 1)
        mu *= OutlierPolicy.factor
        if spent >= 0.5 * allowed or all(np.all((w == 0.0) | (w == 1.0)) for w in weights.values()):
            break
    weights = {k: (s < 1.0).astype(np.float64) for k, s in _squared(current, thresholds).items()}
    current, summary = minimise(*_weighted(current, plain, weights), normal, solver, None, allowed - spent)
    summary = replace(summary, work=summary.work + spent)
    if progress is not None:
        progress(most + 1, most + 1)
    return current, summary, weights


def outlier_thresholds(graph: Graph) -> dict[int, float]:
    """Return by position the threshold of each kind of edges that may hold outliers: priors and successive poses do not."""
    kinds = enumerate(zip(graph.edges, closing_edges(graph), strict=True))
    suspects = [(k, e) for k, (e, loop) in kinds if len(e) and (loop is None or loop.any()) and not isinstance(e, PriorEdges)]
    return {k: _threshold(e.residuals(graph).shape[1]) for k, e in suspects}


def _squared(graph: Graph, thresholds: Mapping[int, float]) -> dict[int, Floats]:
    residuals = {k: graph.edges[k].residuals(graph) for k in thresholds}
    return {k: np.einsum("ed,ed->e", r, r) / thresholds[k] ** 2 for k, r in residuals.items()}


def _worst(graph: Graph, thresholds: Mapping[int, float]) -> float:
    """Return the largest squared residual in units of its squared threshold, 0 without any."""
    return max((float(np.max(s)) for s in _squared(graph, thresholds).values() if len(s)), default=0.0)


def _weighted(current: Graph, plain: Graph, weights: Mapping[int, Floats]) -> tuple[Graph, list[Linearization]]:
    """Return the present estimates with the plain graph's edges weighted, and their linearisation."""
    edges = tuple(replace(e, weights=weights[k] * e.own_weights) if k in weights else e for k, e in enumerate(plain.edges))
    graph = replace(current, edges=edges)
    return graph, linearize(graph)


def closing_edges(graph: Graph) -> list[Bools | None]:
    """Return for each kind of edges which of them (e,) close loops; None for kinds that are no relative poses."""
    seen = np.zeros(len(graph.poses), dtype=bool)
    found: list[Bools | None] = []
    for e in graph.edges:
        if not isinstance(e, RelativePoseEdges):
            found.append(None)
            continue
        lower, step = np.minimum(e.i, e.j), np.abs(e.j - e.i) == 1
        first = np.zeros(len(e), dtype=bool)
        first[np.unique(np.where(step, lower, -1), return_index=True)[1]] = True
        found.append(~(first & step & ~seen[lower]))
        seen[lower[step]] = True
    return found


def with_kernel(graph: Graph, kernel: Kernel) -> Graph:
    """Return the graph with a robust kernel on every edge except relative poses that close no loop."""

    def parts() -> Iterator[Edges]:
        for e, loop in zip(graph.edges, closing_edges(graph), strict=True):
            if loop is None:
                yield replace(e, kernel=kernel)
                continue
            for chosen, used in ((~loop, e.kernel), (loop, kernel)):
                if chosen.any():
                    yield replace(e.rows(chosen), kernel=used)

    return replace(graph, edges=tuple(parts()))


@dataclass(frozen=True, slots=True)
class Misfit:
    """How far loop closures are off in an optimised graph."""

    closures: int
    off: int
    """How many of them are outliers."""
    worst: tuple[int, int]
    """The poses of the closure with the largest error; -1 where there is none."""

    @property
    def most(self) -> bool:
        """Most closures are off: they contradict each other, or their stated precision is too high."""
        return 2 * self.off > self.closures


def misfit(graph: Graph) -> Misfit:
    """Return how far the loop closures of a graph are off."""
    loops = [e.rows(loop) for e, loop in zip(graph.edges, closing_edges(graph), strict=True) if loop is not None and loop.any()]
    if not loops:
        return Misfit(0, 0, (-1, -1))
    i, j = (np.concatenate([getattr(e, end) for e in loops]) for end in ("i", "j"))
    norms = np.concatenate([np.linalg.norm(e.residuals(graph), axis=1) for e in loops])
    worst = int(np.argmax(norms))
    return Misfit(len(norms), int(np.count_nonzero(norms > _threshold(se2.POSE[0]))), (int(i[worst]), int(j[worst])))
