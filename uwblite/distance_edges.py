"""Distances between anchors that somebody measured, with a tape say: a kind of edge."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .graph import Graph, Linearization
from .robust import SQUARED, Kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class AnchorDistanceEdges:
    """Distance between two anchors: e = |a_i - a_j| - d."""

    i: Ints
    """(e,) index of one anchor."""
    j: Ints
    """(e,) index of the other."""
    distance: Floats
    """(e,) m."""
    sigma: Floats
    """(e,) m."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __len__(self) -> int:
        return len(self.i)

    def _offset(self, graph: Graph) -> tuple[Floats, Floats]:
        offset = graph.anchors[self.i] - graph.anchors[self.j]
        return offset, np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-6)

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 1)."""
        return ((self._offset(graph)[1] - self.distance) / self.sigma)[:, None]

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both anchors."""
        offset, length = self._offset(graph)
        by_i = (offset / (length * self.sigma)[:, None])[:, None, :]
        residuals = ((length - self.distance) / self.sigma)[:, None]
        return Linearization(residuals, (("anchors", self.i, by_i), ("anchors", self.j, -by_i)))
