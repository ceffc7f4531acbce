"""Edges between a pose and an anchor: UWB ranges."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, Shape
from ..config import documented
from .calibration import RANGING
from .graph import Block, Edges, Graph, Linearization

_NEAREST = 1e-3
"""Least distance of tag and anchor, m: for smaller ones the direction is not defined, and the distance is clamped."""
_LEAST_SQUARE = 1e-4
"""m^2; a range shorter than the anchor's height keeps a horizontal distance of a centimetre."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class RangeEdges(Edges):
    """Distance between the tag, carried by a pose, and an anchor (paper: UWB distance edges).

    The tag stands at ``u = lever_arm + R(turn) tag + velocity delay`` in the frame of the pose; with the planar
    distance D = |x + R(theta) u - a|, the expected range is ``(1 + scale) sqrt(D^2 + height^2 + q) + bias``.

    A squared height q below 0 is not possible, but descent may pass there. What q adds for q > 0 is then subtracted: with
    P^2 = D^2 + height^2, the expected distance is ``2 P - sqrt(P^2 - q)``, smooth at q = 0; it is negative at the anchor.
    """

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"pose": "poses", "anchor": "anchors", "calibration": "calibration"}
    ROWS: ClassVar[Mapping[str, Shape]] = {"lever_arm": (2,), "velocity": (2,), "tag": (2,), "calibration": (len(RANGING),)}
    SHARED: ClassVar[tuple[str, ...]] = ("tag",)

    pose: Ints
    """(e,) keyframe before the range."""
    anchor: Ints
    """(e,)."""
    ranges: Floats
    """(e,) m, measured."""
    sigma: Floats
    """(e,) m."""
    lever_arm: Floats
    """(e, 2) position of the base at the moment of ranging in the frame of the pose, m: the lever arm in time."""
    turn: Floats
    """(e,) heading of the base at the moment of ranging in the frame of the pose, rad."""
    velocity: Floats
    """(e, 2) velocity of the tag in the frame of the pose, m/s."""
    tag: Floats
    """(2,) nominal position of the tag on the base, m."""
    height: Floats
    """(e,) height of the anchor above the tag, m, where it is given, else 0."""
    calibration: Ints
    """(e, 6) indices of RANGING: scale, bias (m), q (m^2, unknown squared height), tag x, tag y (m, corrections), delay (s);
    -1 = no unknown (taken as 0)."""
    stamps: Floats = field(default_factory=lambda: np.zeros(0))
    """(e,) s, where known; not used by the graph."""
    late: Floats = field(default_factory=lambda: np.zeros(0))
    """(e,) m, known delay of each range; empty = none is known."""

    def tag_positions(self, poses: Floats) -> Floats:
        """Return where the tag was at each range (e, 2), map frame, by its nominal position on the base."""
        arm = self.lever_arm + se2.rotate(self.turn, np.broadcast_to(self.tag, (len(self), 2)))
        return se2.transform(poses[self.pose], arm)

    def headings(self, poses: Floats) -> Floats:
        """Return the heading of the base at each range (e,), map frame, rad."""
        return se2.wrap_angle(poses[self.pose, 2] + self.turn)

    @property
    def corrected(self) -> Floats:
        """The ranges (e,) without their known delays, m."""
        return self.ranges - self.late if len(self.late) else self.ranges

    def planar_ranges(self) -> Floats:
        """Return the measured distances (e,) in the plane, m."""
        return np.sqrt(np.maximum(self.corrected**2 - self.height**2, _LEAST_SQUARE))

    def _geometry(self, graph: Graph) -> tuple[Floats, Floats, Floats, Floats]:
        """Return R(theta) u (2, e), the vector anchor -> tag (2, e), P and sqrt(P^2 + |q|) (2, e), the calibration (6, e)."""
        padded = np.append(graph.calibration.values, 0.0)
        cal = padded[self.calibration.T if len(padded) > 1 else np.full((len(RANGING), 1), -1)]
        *_, x, y, delay = cal
        tx, ty = self.tag[0] + x, self.tag[1] + y
        c, s = se2.cos_sin(self.turn)
        ux = self.lever_arm[:, 0] + (c * tx - s * ty) + self.velocity[:, 0] * delay
        uy = self.lever_arm[:, 1] + (s * tx + c * ty) + self.velocity[:, 1] * delay
        c, s = self._heading(graph)
        arm = np.stack([c * ux - s * uy, s * ux + c * uy])
        offset = graph.poses[:, :2].T.take(self.pose, axis=1) + arm - graph.anchors.T.take(self.anchor, axis=1)
        squared = offset[0] ** 2 + offset[1] ** 2 + self.height**2
        return arm, offset, np.sqrt(np.maximum(np.stack([squared, squared + np.abs(cal[2])]), _NEAREST**2)), cal

    def _heading(self, graph: Graph) -> tuple[Floats, Floats]:
        """Return cosine and sine (e,) of the poses' headings; most poses have several ranges."""
        c, s = se2.cos_sin(graph.poses[:, 2])
        return c.take(self.pose), s.take(self.pose)

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by pose, anchor and the calibration that is free."""
        arm, offset, reach, cal = self._geometry(graph)
        below, scale = cal[2] < 0.0, (1.0 + cal[0]) / self.sigma
        distance = np.where(below, 2.0 * reach[0] - reach[1], reach[1])
        direction = offset * (scale * np.where(below, 2.0 / reach[0] - 1.0 / reach[1], 1.0 / reach[1]))
        by_theta = direction[1] * arm[0] - direction[0] * arm[1]
        by_pose = np.stack([direction[0], direction[1], by_theta])[None].transpose(2, 0, 1)
        blocks: list[Block] = [("poses", self.pose, by_pose), ("anchors", self.anchor, -direction[None].transpose(2, 0, 1))]
        columns = [distance / self.sigma, 1.0 / self.sigma, scale / (2.0 * reach[1])]
        if graph.free_columns(self.calibration[:, 3:]).any():
            columns += self._by_tag_and_delay(graph, direction)
        blocks += graph.calibration_blocks(self.calibration, [column[None] for column in columns])
        residuals = (((1.0 + cal[0]) * distance + cal[1] - self.corrected) / self.sigma)[:, None]
        return Linearization(residuals, tuple(blocks))

    def _by_tag_and_delay(self, graph: Graph, direction: Floats) -> tuple[Floats, ...]:
        """Return the derivatives (e,) by tag x, tag y and delay."""
        (x, y), (vx, vy) = direction, self.velocity.T
        c, s = self._heading(graph)
        ct, st = se2.cos_sin(graph.poses[self.pose, 2] + self.turn)
        return ct * x + st * y, ct * y - st * x, (c * x + s * y) * vx + (c * y - s * x) * vy
