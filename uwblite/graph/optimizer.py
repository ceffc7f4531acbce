"""Successive optimisations, as noise is learnt or kernels are tightened: their common pattern is analysed once."""

from .graph import Graph, linearize
from .normal_equations import NormalEquations
from .problem_checks import check
from .solver import SolverConfig, SolverSummary, minimise


class Optimizer:
    """Optimises graphs; of graphs that follow each other with the same unknowns and edges the pattern is analysed once."""

    def __init__(self) -> None:
        self._normal: NormalEquations | None = None

    def optimize(self, graph: Graph, config: SolverConfig) -> tuple[Graph, SolverSummary]:
        """Return the graph at the nearest minimum of its cost, and how the search went; see solver.optimize."""
        check(graph)
        linearized = linearize(graph)
        if self._normal is None or not self._normal.suits(graph, linearized):
            self._normal = NormalEquations(graph, linearized)
        return minimise(graph, linearized, self._normal, config)
