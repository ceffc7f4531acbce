"""Edges of points: landmarks seen from poses (g2o EDGE_SE2_XY), and given distances between anchors and between points."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import TINY, Floats, Ints, Shape
from ..config import documented
from .graph import Edges, Graph, Linearization, whiten


@documented
@dataclass(frozen=True, slots=True, eq=False)
class AnchorDistanceEdges(Edges):
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

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both anchors."""
        residuals, along = _distance_error(self, graph.anchors[self.i] - graph.anchors[self.j])
        by_i = along[:, None]
        return Linearization(residuals, (("anchors", self.i, by_i), ("anchors", self.j, -by_i)))


@documented
@dataclass(frozen=True, slots=True, eq=False)
class PointDistanceEdges(Edges):
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

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses."""
        one, other = graph.poses[self.i], graph.poses[self.j]
        arm_i, arm_j = se2.rotate(one[:, 2], self.point_i), se2.rotate(other[:, 2], self.point_j)
        residuals, along = _distance_error(self, one[:, :2] + arm_i - other[:, :2] - arm_j)
        by_i = np.column_stack([along, along[:, 1] * arm_i[:, 0] - along[:, 0] * arm_i[:, 1]])[:, None]
        by_j = np.column_stack([-along, along[:, 0] * arm_j[:, 1] - along[:, 1] * arm_j[:, 0]])[:, None]
        return Linearization(residuals, (("poses", self.i, by_i), ("poses", self.j, by_j)))


def _distance_error(edges: AnchorDistanceEdges | PointDistanceEdges, offset: Floats) -> tuple[Floats, Floats]:
    """Return whitened residuals (e, 1) and their derivatives (e, 2) by the offset (e, 2) of two points."""
    # The direction of smaller distances is not defined.
    length = np.maximum(np.hypot(*offset.T), TINY)
    return ((length - edges.distance) / edges.sigma)[:, None], offset / (length * edges.sigma)[:, None]


def distances(edges: AnchorDistanceEdges | PointDistanceEdges, graph: Graph) -> Floats:
    """Return the distances (e,), m, at the graph's estimates."""
    return edges.residuals(graph)[:, 0] * edges.sigma + edges.distance


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LandmarkEdges(Edges):
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
