"""Estimate of one further unknown that the model does not have, without solving the graph again (score test)."""

import numpy as np

from ..arrays import Floats
from .graph import Edges, Graph, edge_weights
from .marginals import factor_of
from .normal_equations import filled


def added_unknown(graph: Graph, edges: Edges, shifts: Floats) -> tuple[Floats, Floats]:
    """Return values and standard deviations of further unknowns; see added_unknown_and_moves."""
    return added_unknown_and_moves(graph, edges, shifts)[:2]


def added_unknown_and_moves(graph: Graph, edges: Edges, shifts: Floats) -> tuple[Floats, Floats, Floats]:
    """Estimate, each alone, further unknowns of some edges of an optimised graph, to first order.

    With J, r and W of the whole graph and s the change of the residuals by one unit of the unknown: its value is -b / a and its
    standard deviation a^-1/2, with a = s^T W s - s^T W J H^-1 J^T W s and b = s^T W r - s^T W J H^-1 J^T W r (C. R. Rao, Large
    sample tests of statistical hypotheses, 1948). The part that the graph explains by its own unknowns is subtracted.

    Parameters
    ----------
    edges : of the graph. shifts : (k, e, d) changes of their whitened residuals by one unit of each unknown.

    Returns
    -------
    (k,) values and (k,) standard deviations, in the unknowns' units; infinite where the graph explains the shifts wholly. And
    (k, p, 2) the changes of the poses' places with each value, m.
    """
    normal = filled(graph, subtrees=True)
    lin, weighted = edges.linearize(graph), edge_weights(edges, graph)[:, None] * shifts
    right = np.zeros((normal.unknowns.size, len(shifts)))
    for name, index, jacobian in lin.blocks:
        number = normal.unknowns.number[name][index]
        free = number >= 0
        for k, shift in enumerate(weighted):
            np.add.at(right[:, k], number[free], np.einsum("edk,ed->ek", jacobian, shift)[free])
    solved = factor_of(normal).solve(right)
    total = np.einsum("ked,ked->k", shifts, weighted)
    left = total - np.einsum("nk,nk->k", right, solved)
    score = np.einsum("ked,ed->k", weighted, lin.residuals) - solved.T @ normal.gradient
    seen = left > _ROUNDING * total
    divisor = np.where(seen, left, 1.0)
    values = np.where(seen, -score / divisor, 0.0)
    places = np.append(solved, np.zeros((1, len(shifts))), axis=0)[normal.unknowns.number["poses"][:, :2]]
    return values, np.where(seen, 1.0 / np.sqrt(divisor), np.inf), -values[:, None, None] * np.moveaxis(places, 2, 0)


_ROUNDING = 1e-9
"""Share of the shifts below which the remainder is rounding error."""
