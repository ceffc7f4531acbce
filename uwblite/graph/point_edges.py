"""Landmarks seen from poses as points: a kind of edge in imported graphs (g2o EDGE_SE2_XY)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, Shape
from ..config import documented
from .graph import EdgeTable, Graph, Linearization, whiten
from .robust import SQUARED, Kernel


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LandmarkEdges(EdgeTable):
    """Position of a landmark, which is stored as an anchor, in the frame of a pose: e = X^-1 a - z."""

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"pose": "poses", "anchor": "anchors"}
    ROWS: ClassVar[Mapping[str, Shape]] = {"position": (2,), "sqrt_information": (2, 2)}

    pose: Ints
    """(e,) index of the pose that saw it."""
    anchor: Ints
    """(e,) index of the landmark."""
    position: Floats
    """(e, 2) measured position in the frame of the pose, m."""
    sqrt_information: Floats
    """(e, 2, 2) L with information = L^T L."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by pose and landmark."""
        poses = graph.poses[self.pose]
        seen = se2.rotate(-poses[:, 2], graph.anchors[self.anchor] - poses[:, :2])
        c, s = se2.cos_sin(poses[:, 2])
        by_anchor = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
        by_theta = np.stack([seen[:, 1], -seen[:, 0]], axis=1)
        by_pose = np.concatenate([-by_anchor, by_theta[:, :, None]], axis=2)
        root = self.sqrt_information
        blocks = ("poses", self.pose, root @ by_pose), ("anchors", self.anchor, root @ by_anchor)
        return Linearization(whiten(root, seen - self.position), blocks)


def seen_anchors(graph: Graph) -> Floats:
    """Return the anchors (a, 2); those without a place (nan) stand where the first pose with one sees them."""
    places = np.full_like(graph.anchors, np.nan)
    for e in graph.edges:
        if isinstance(e, LandmarkEdges):
            seen = se2.transform(graph.poses[e.pose], e.position)
            first = np.flatnonzero(np.isfinite(seen).all(axis=1) & np.isnan(places[e.anchor, 0]))[::-1]
            places[e.anchor[first]] = seen[first]
    return np.where(np.isnan(graph.anchors), places, graph.anchors)
