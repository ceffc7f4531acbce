"""Anchors at given poses: the small problem that is solved for them after a step has moved the poses.

An anchor with ranges along a line may lie anywhere on an arc: its distance across the line and its height are interchangeable.
A linear step leaves the arc, the cost of its ranges rises, and damping that stops the anchor stops the poses as well. Solved
alone at the new poses, anchors return to the arc (embedded point iterations: Y. Jeong, D. Nister, D. Steedly, R.
Szeliski, I. S. Kweon, Pushing the envelope of modern methods for bundle adjustment, CVPR 2010).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Bools
from .graph import Graph, Linearization, edge_costs
from .unknowns import free_unknowns


def with_anchors_solved(
    graph: Graph,
    before: Sequence[float],
    trial: Graph,
    linearized: list[Linearization],
    solve: Callable[[Graph], Graph],
) -> tuple[Graph, list[Linearization]]:
    """Return a trial and its linearisation with the anchors solved for at its poses, where only these make its cost too high.

    Parameters
    ----------
    graph : before the step. before : cost of each kind of its edges.
    solve : returns a graph at its optimum, or near it.
    """
    touched = [{name for name, *_ in lin.blocks} for lin in linearized]
    kinds = [k for k, names in enumerate(touched) if "anchors" in names or "poses" not in names]
    now = edge_costs(trial, linearized)
    elsewhere = sum(cost - before[k] for k, cost in enumerate(now) if k not in kinds)
    problem = anchor_subproblem(graph, trial, linearized, kinds) if elsewhere <= 0.0 else None
    if problem is None:
        return trial, linearized
    solved = solve(problem)
    if not solved.chi2() < sum(now[k] for k in kinds):
        return trial, linearized
    trial = trial.with_estimates_of(solved)
    return trial, [e.linearize(trial) if k in kinds else linearized[k] for k, e in enumerate(trial.edges)]


def anchor_subproblem(graph: Graph, trial: Graph, linearized: Sequence[Linearization], kinds: Sequence[int]) -> Graph | None:
    """Return the problem of a graph's anchors, and of the calibration values of their edges alone, at the poses of a trial.

    It starts from the graph's anchors. None where no pose or no anchor is free.

    Parameters
    ----------
    linearized : at the trial.
    kinds : of the edges that count: those of anchors, and priors of calibration values.
    """
    free = free_unknowns(graph)
    if not free["poses"].any() or not free["anchors"].any():
        return None
    inner = free["calibration"] & _touched(len(free["calibration"]), [linearized[k] for k in kinds])
    inner &= ~_touched(len(inner), [lin for k, lin in enumerate(linearized) if k not in kinds])
    values = np.where(inner, graph.calibration.values, trial.calibration.values)
    return replace(
        graph.updated(trial.poses, graph.anchors, values),
        edges=tuple(graph.edges[k] for k in kinds),
        fixed_poses=np.ones(len(free["poses"]), dtype=bool),
        fixed_calibration=~inner,
    )


def _touched(values: int, linearized: Sequence[Linearization]) -> Bools:
    """Return which calibration values (values,) some edges depend on."""
    found = np.zeros(values, dtype=bool)
    for lin in linearized:
        for name, index, _ in lin.blocks:
            if name == "calibration":
                found[index] = True
    return found
