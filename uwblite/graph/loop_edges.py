"""Which edges of a graph close loops: all relative poses but the first between successive poses."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Bools
from .graph import Edges, Graph
from .pose_edges import RelativePoseEdges
from .robust import Kernel


def closing(graph: Graph) -> list[Bools | None]:
    """Return for each kind of edges which of them (e,) close loops; None for what is no relative pose."""
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
    """Return the graph with a robust kernel on every edge but relative poses that close no loop."""

    def parts() -> Iterator[Edges]:
        for e, loop in zip(graph.edges, closing(graph), strict=True):
            if loop is None:
                yield replace(e, kernel=kernel)  # type: ignore[type-var]
                continue
            for chosen, used in ((~loop, e.kernel), (loop, kernel)):
                if chosen.any():
                    yield replace(e.rows(chosen), kernel=used)  # type: ignore[type-var]

    return replace(graph, edges=tuple(parts()))
