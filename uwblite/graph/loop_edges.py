"""Which edges of a graph close loops: all relative poses but the first between successive poses."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools
from .graph import Edges, Graph
from .pose_edges import RelativePoseEdges
from .robust import Kernel


def closing(graph: Graph) -> list[Bools | None]:
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
        for e, loop in zip(graph.edges, closing(graph), strict=True):
            if loop is None:
                yield replace(e, kernel=kernel)  # type: ignore[type-var]
                continue
            for chosen, used in ((~loop, e.kernel), (loop, kernel)):
                if chosen.any():
                    yield replace(e.rows(chosen), kernel=used)  # type: ignore[type-var]

    return replace(graph, edges=tuple(parts()))


@dataclass(frozen=True, slots=True)
class Misfit:
    """How far loop closures are off in an optimised graph."""

    closures: int
    off: int
    """How many of them are off by more than _OFF standard deviations."""
    worst: tuple[int, int]
    """The poses of the closure with the largest error; -1 where there is none."""

    @property
    def most(self) -> bool:
        """Most closures are off: they contradict each other, or their stated precision is too high."""
        return 2 * self.off > self.closures


_OFF = 4.0
"""Whitened norm, standard deviations; one good closure in a thousand is farther off."""


def misfit(graph: Graph) -> Misfit:
    """Return how far the loop closures of a graph are off."""
    loops = [e.rows(loop) for e, loop in zip(graph.edges, closing(graph), strict=True) if loop is not None and loop.any()]
    if not loops:
        return Misfit(0, 0, (-1, -1))
    i, j = (np.concatenate([getattr(e, end) for e in loops]) for end in ("i", "j"))
    norms = np.concatenate([np.linalg.norm(e.residuals(graph), axis=1) for e in loops])
    worst = int(np.argmax(norms))
    return Misfit(len(norms), int(np.count_nonzero(norms > _OFF)), (int(i[worst]), int(j[worst])))
