"""Solution of a problem and of its parts: the optimum, of which no anchor's squared height is below 0."""

from dataclasses import replace

import numpy as np

from ..graph.calibration import BIAS, HEIGHT, LASER, ODOMETRY, OMNI, RANGE_SCALE, TURNING
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges, ScanEdges
from ..graph.solver import Optimizer, SolverConfig, SolverSummary
from ..graph.unknowns import free_unknowns


class SolutionPolicy:
    """When optimisations end after which others follow: relative decreases of chi2, and most iterations."""

    rough: float = 1e-4
    rough_iterations: int = 12
    comparable: float = 1e-5


def solve(graph: Graph, config: SolverConfig, optimizer: Optimizer | None = None) -> tuple[Graph, SolverSummary]:
    """Return the graph at its optimum without a squared height below 0, and how the last search went; see solver.optimize.

    Heights that come out negative are fixed at 0, and all other unknowns are solved again.

    Parameters
    ----------
    optimizer : of graphs like this one.
    """
    optimizer = optimizer or Optimizer()
    while True:
        solved, summary = optimizer.optimize(graph, config)
        graph = with_nonnegative_heights(solved)
        anything_free = any(free.any() for free in free_unknowns(graph).values())
        if not anything_free or np.array_equal(graph.calibration.values, solved.calibration.values):
            return graph, summary


def with_nonnegative_heights(graph: Graph) -> Graph:
    """Return the graph with negative squared heights set to 0 and fixed."""
    values = graph.calibration.values.copy()
    below = graph.calibration.of_kinds(HEIGHT) & (values < 0.0)
    values[below] = 0.0
    graph = graph.updated(graph.poses, graph.anchors, values)
    return replace(graph, fixed_calibration=graph.fixed_calibration | below)


def rough(solver: SolverConfig) -> SolverConfig:
    """Return the solver settings for an optimisation after which weights are re-estimated and another one follows."""
    iterations = min(solver.max_iterations, SolutionPolicy.rough_iterations)
    return replace(solver, max_iterations=iterations, relative_decrease=max(solver.relative_decrease, SolutionPolicy.rough))


def comparable(solver: SolverConfig) -> SolverConfig:
    """Return the solver settings for an optimisation whose evidence is compared; the chosen one is then continued."""
    return replace(solver, relative_decrease=max(solver.relative_decrease, SolutionPolicy.comparable))


def stretch(graph: Graph, first: int, last: int) -> Graph:
    """Return the problem of wheels and lidar alone on the poses first <= k < last, with priors of their calibration.

    Parameters
    ----------
    graph : its poses of the stretch hang together by odometry.
    """
    inside = list[Edges]()
    for edges in graph.edges:
        if isinstance(edges, (OdometryEdges, ScanEdges)):
            own = (np.minimum(edges.i, edges.j) >= first) & (np.maximum(edges.i, edges.j) < last)
            rows = edges.rows(own)
            inside.append(replace(rows, i=rows.i - first, j=rows.j - first))
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(*LASER, *ODOMETRY, *OMNI, TURNING)
    priors = graph.calibration_priors
    alone = Graph(
        graph.poses[first:last], edges=priors, calibration=graph.calibration, fixed_calibration=fixed, work=graph.work
    )
    return alone.with_edges(*inside)


def at_given_poses(graph: Graph) -> Graph:
    """Return the graph with only anchors and the systematic errors of their ranges free, as far as they were free before."""
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(BIAS, HEIGHT, RANGE_SCALE)
    return replace(graph, fixed_poses=np.ones(len(graph.poses), dtype=bool), fixed_calibration=fixed)
