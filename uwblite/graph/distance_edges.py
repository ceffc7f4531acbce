"""Given distances between anchors, and between points seen from poses."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, Shape
from ..config import documented
from .graph import EdgeTable, Graph, Linearization
from .robust import SQUARED, Kernel

_LEAST = 1e-6
"""Least distance, m: for smaller ones the direction is not defined."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class AnchorDistanceEdges(EdgeTable):
    """Distance between two anchors: e = |a_i - a_j| - d."""

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"i": "anchors", "j": "anchors"}

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

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both anchors."""
        offset = graph.anchors[self.i] - graph.anchors[self.j]
        length = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), _LEAST)
        by_i = (offset / (length * self.sigma)[:, None])[:, None, :]
        residuals = ((length - self.distance) / self.sigma)[:, None]
        return Linearization(residuals, (("anchors", self.i, by_i), ("anchors", self.j, -by_i)))


@documented
@dataclass(frozen=True, slots=True, eq=False)
class PointDistanceEdges(EdgeTable):
    """Distance between two points that are fixed to poses: e = |X_i p_i - X_j p_j| - d.

    The points are landmarks as seen from the two poses: their distance in the map has to be the measured one.
    """

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"i": "poses", "j": "poses"}
    ROWS: ClassVar[Mapping[str, Shape]] = {"point_i": (2,), "point_j": (2,)}

    i: Ints
    """(e,) index of one pose."""
    j: Ints
    """(e,) index of the other."""
    point_i: Floats
    """(e, 2) m, in the frame of pose i."""
    point_j: Floats
    """(e, 2) m, in the frame of pose j."""
    distance: Floats
    """(e,) m."""
    sigma: Floats
    """(e,) m."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def _arms(self, graph: Graph) -> tuple[Floats, Floats, Floats, Floats]:
        """Return both points as seen from their poses, turned into the map (e, 2), their offset (e, 2) and distance (e,)."""
        one, other = graph.poses[self.i], graph.poses[self.j]
        arm_i, arm_j = se2.rotate(one[:, 2], self.point_i), se2.rotate(other[:, 2], self.point_j)
        offset = one[:, :2] + arm_i - other[:, :2] - arm_j
        return arm_i, arm_j, offset, np.maximum(np.hypot(offset[:, 0], offset[:, 1]), _LEAST)

    def lengths(self, graph: Graph) -> Floats:
        """Return the distances (e,), m, at the graph's estimates."""
        return self._arms(graph)[3]

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses."""
        arm_i, arm_j, offset, length = self._arms(graph)
        along = offset / (length * self.sigma)[:, None]
        by_i = np.column_stack([along, along[:, 1] * arm_i[:, 0] - along[:, 0] * arm_i[:, 1]])[:, None, :]
        by_j = np.column_stack([-along, along[:, 0] * arm_j[:, 1] - along[:, 1] * arm_j[:, 0]])[:, None, :]
        residuals = ((length - self.distance) / self.sigma)[:, None]
        return Linearization(residuals, (("poses", self.i, by_i), ("poses", self.j, by_j)))
