"""The pose graph: what is unknown (poses, anchors, calibration) and the edges that measure it.

Edges of one kind are one dataclass of arrays. Each kind offers ``residuals(graph)`` and ``linearize(graph)``; both
are whitened, so that the sum of squares is chi2 in units of the measurements' standard deviations. A new sensor is
one more dataclass here and one more row in the numeric-Jacobian test; the solver does not change.

Unknowns live in three blocks: ``poses`` (n, 3) T_map_base, ``anchors`` (a, 2) in the map frame and ``calibration``
(c,), a vector of named scalars. They are updated by addition (angles wrapped). Pose residuals use the chart of g2o,
e = Z^-1 (Xi^-1 Xj), so that chi2 compares with g2o's.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from . import se2
from .errors import DataError
from .robust import SQUARED, Kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Block = tuple[str, Ints, Floats]
"""(block name, index (e,) of the unknown in that block, Jacobian (e, d, k) of the whitened residual by it)."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """Whitened residuals of one kind of edges and their Jacobians."""

    residuals: Floats
    """(e, d), in standard deviations."""
    blocks: tuple[Block, ...]
    """An edge may name several unknowns of one block; each is an entry of its own."""


class Edges(Protocol):
    """What every kind of edges offers."""

    @property
    def kernel(self) -> Kernel:
        """Robust kernel applied to each edge's squared whitened norm."""

    @property
    def weights(self) -> Floats | None:
        """(e,) factors on each edge's cost (0 switches it off), None = all 1."""

    def __len__(self) -> int: ...

    def residuals(self, graph: "Graph") -> Floats:
        """Return whitened residuals (e, d)."""

    def linearize(self, graph: "Graph") -> Linearization:
        """Return whitened residuals and Jacobians."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Named scalar unknowns."""

    names: tuple[str, ...] = ()
    values: Floats = field(default_factory=lambda: np.zeros(0))
    """(c,), unit by name: see calibration.py."""

    def index(self, name: str) -> int:
        """Return the position of a name, -1 where it is not an unknown of this graph."""
        return self.names.index(name) if name in self.names else -1

    def get(self, name: str, default: float = 0.0) -> float:
        """Return the value of a name, or the default where it is not an unknown of this graph."""
        i = self.index(name)
        return default if i < 0 else float(self.values[i])


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Estimates, what of them is held fixed, and the measurements between them."""

    poses: Floats
    """(n, 3) T_map_base."""
    anchors: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(a, 2) m, map frame."""
    edges: tuple[Edges, ...] = ()
    calibration: Calibration = field(default_factory=Calibration)
    fixed_poses: NDArray[np.bool_] | None = None
    """(n,) True = held; None = the first pose is held (gauge)."""
    fixed_anchors: NDArray[np.bool_] | None = None
    """(a,) True = held; None = all free."""
    fixed_calibration: NDArray[np.bool_] | None = None
    """(c,) True = held; None = all free."""

    def with_edges(self, *edges: Edges) -> "Graph":
        """Return the graph with further edges; empty ones are left out."""
        return replace(self, edges=self.edges + tuple(e for e in edges if len(e)))

    def updated(self, poses: Floats, anchors: Floats, calibration: Floats) -> "Graph":
        """Return the graph with new estimates."""
        return replace(self, poses=poses, anchors=anchors, calibration=replace(self.calibration, values=calibration))

    def chi2(self) -> float:
        """Return the sum of squared whitened residuals, robust kernels and weights applied."""
        return sum(edge_cost(e, e.residuals(self)) for e in self.edges)


def edge_cost(edges: Edges, residuals: Floats) -> float:
    """Return the robust, weighted cost of whitened residuals (e, d) of these edges."""
    rho = edges.kernel.rho(np.einsum("ed,ed->e", residuals, residuals))
    return float(np.sum(rho if edges.weights is None else rho * edges.weights))


def _whiten(sqrt_information: Floats, values: Floats) -> Floats:
    return np.einsum("eij,ej...->ei...", sqrt_information, values)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoseEdges:
    """Pose j as seen from pose i: loop closures, scan matches, and edges read from files."""

    i: Ints
    """(e,) index of the pose measured from."""
    j: Ints
    """(e,) index of the pose measured."""
    T_i_j: Floats
    """(e, 3) measured pose."""
    sqrt_information: Floats
    """(e, 3, 3) L with information = L^T L in the chart e = Z^-1 (Xi^-1 Xj); may be singular."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __len__(self) -> int:
        return len(self.i)

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        return _whiten(self.sqrt_information, se2.between(self.T_i_j, se2.between(graph.poses[self.i], graph.poses[self.j])))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses."""
        xi, xj = graph.poses[self.i], graph.poses[self.j]
        d = se2.between(xi, xj)
        by_i, by_j = se2.between_jacobians(xi, xj)
        to_edge = self.sqrt_information @ se2.between_jacobians(self.T_i_j, d)[1]
        return Linearization(
            _whiten(self.sqrt_information, se2.between(self.T_i_j, d)),
            (("poses", self.i, to_edge @ by_i), ("poses", self.j, to_edge @ by_j)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEdges:
    """Motion from pose i to pose j by the wheels, corrected by the wheels' calibration.

    With distance scale 1 + s and heading error delta = k dtheta + b length + g duration, the measured motion
    (dx, dy, dtheta) is taken as ``(R(delta / 2) (1 + s) (dx, dy), dtheta + delta)``.
    """

    i: Ints
    j: Ints
    motion: Floats
    """(e, 3) T_i_j by the raw odometry."""
    length: Floats
    """(e,) signed distance travelled, m."""
    duration: Floats
    """(e,) s."""
    sqrt_information: Floats
    """(e, 3, 3)."""
    calibration: Ints
    """(e, 4) indices of s, k, b (rad/m), g (rad/s) in the calibration block; -1 = not an unknown (taken as 0)."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __len__(self) -> int:
        return len(self.i)

    def corrected(self, graph: Graph) -> Floats:
        """Return the motion (e, 3) with the present calibration applied."""
        return self._corrected(graph)[0]

    def _corrected(self, graph: Graph) -> tuple[Floats, Floats, Floats]:
        padded = np.append(graph.calibration.values, 0.0)
        s, k, b, g = padded[self.calibration].T
        delta = k * self.motion[:, 2] + b * self.length + g * self.duration
        direction = se2.rotate(delta / 2.0, self.motion[:, :2])
        z = np.concatenate([direction * (1.0 + s)[:, None], (self.motion[:, 2] + delta)[:, None]], axis=1)
        return z, direction, s

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        d = se2.between(graph.poses[self.i], graph.poses[self.j])
        return _whiten(self.sqrt_information, se2.between(self.corrected(graph), d))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration in use."""
        xi, xj = graph.poses[self.i], graph.poses[self.j]
        z, direction, s = self._corrected(graph)
        d = se2.between(xi, xj)
        by_i, by_j = se2.between_jacobians(xi, xj)
        by_z, by_d = se2.between_jacobians(z, d)
        by_d = self.sqrt_information @ by_d
        blocks: list[Block] = [("poses", self.i, by_d @ by_i), ("poses", self.j, by_d @ by_j)]
        if np.any(self.calibration >= 0):
            by_z = self.sqrt_information @ by_z
            by_scale = _whiten(by_z[:, :, :2], direction)
            turned = np.stack([-direction[:, 1], direction[:, 0]], axis=1) * (0.5 * (1.0 + s))[:, None]
            by_delta = _whiten(by_z, np.concatenate([turned, np.ones((len(s), 1))], axis=1))
            factors = (None, self.motion[:, 2], self.length, self.duration)
            for column, factor in enumerate(factors):
                index = self.calibration[:, column]
                if np.any(index >= 0):
                    by = by_scale if factor is None else by_delta * factor[:, None]
                    blocks.append(("calibration", np.maximum(index, 0), np.where(index[:, None] >= 0, by, 0.0)[:, :, None]))
        return Linearization(_whiten(self.sqrt_information, se2.between(z, d)), tuple(blocks))


@dataclass(frozen=True, slots=True, eq=False)
class ScanEdges:
    """Pose of cloud j in cloud i by scan matching, with the lidar's mounting and clock as unknowns.

    Clouds stand in the base frame through the nominal mounting and clock. The true frame of cloud i is
    ``S_i = X_i o exp(twist_i delay) o C`` with the mounting correction C = (x, y, theta); the edge measures S_i^-1 S_j.
    """

    i: Ints
    j: Ints
    T_i_j: Floats
    """(e, 3) measured pose of cloud j in cloud i."""
    sqrt_information: Floats
    """(e, 3, 3) in the chart e = Z^-1 (Si^-1 Sj); singular along what the scans cannot see."""
    twist_i: Floats
    """(e, 3) velocity of the base at cloud i in its own frame, m/s, m/s, rad/s."""
    twist_j: Floats
    """(e, 3) velocity at cloud j."""
    calibration: Ints
    """(4,) indices of C's x, y, theta and of the delay, s, in the calibration block; -1 = not an unknown (taken as 0)."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __len__(self) -> int:
        return len(self.i)

    def _sensor_poses(self, graph: Graph, poses: Ints, twist: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return S and its Jacobians by X, by C and by the delay."""
        padded = np.append(graph.calibration.values, 0.0)
        correction, delay = padded[self.calibration[:3]], padded[self.calibration[3]]
        x = graph.poses[poses]
        if not np.any(self.calibration >= 0):
            return x, np.broadcast_to(np.eye(3), (len(x), 3, 3)), np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        moved = se2.exp(twist * delay)
        x_moved = se2.compose(x, moved)
        by_x, by_moved = se2.compose_jacobians(x, moved)
        s_by_x_moved, s_by_correction = se2.compose_jacobians(x_moved, correction)
        c, sn = np.cos(twist[:, 2] * delay), np.sin(twist[:, 2] * delay)
        rate = np.stack([c * twist[:, 0] - sn * twist[:, 1], sn * twist[:, 0] + c * twist[:, 1], twist[:, 2]], axis=1)
        by_delay = _whiten(s_by_x_moved, _whiten(by_moved, rate))
        return se2.compose(x_moved, correction), s_by_x_moved @ by_x, s_by_correction, by_delay

    def relative(self, graph: Graph) -> Floats:
        """Return the pose (e, 3) of cloud j in cloud i at the present estimates."""
        si = self._sensor_poses(graph, self.i, self.twist_i)[0]
        return se2.between(si, self._sensor_poses(graph, self.j, self.twist_j)[0])

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        return _whiten(self.sqrt_information, se2.between(self.T_i_j, self.relative(graph)))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration in use."""
        si, si_by_x, si_by_c, si_by_t = self._sensor_poses(graph, self.i, self.twist_i)
        sj, sj_by_x, sj_by_c, sj_by_t = self._sensor_poses(graph, self.j, self.twist_j)
        d = se2.between(si, sj)
        to_edge = self.sqrt_information @ se2.between_jacobians(self.T_i_j, d)[1]
        by_si, by_sj = (to_edge @ by for by in se2.between_jacobians(si, sj))
        blocks: list[Block] = [("poses", self.i, by_si @ si_by_x), ("poses", self.j, by_sj @ sj_by_x)]
        by_c = by_si @ si_by_c + by_sj @ sj_by_c
        columns = [by_c[:, :, k] for k in range(3)] + [_whiten(by_si, si_by_t) + _whiten(by_sj, sj_by_t)]
        for index, column in zip(self.calibration, columns, strict=True):
            if index >= 0:
                blocks.append(("calibration", np.full(len(self), index), column[:, :, None]))
        return Linearization(_whiten(self.sqrt_information, se2.between(self.T_i_j, d)), tuple(blocks))


@dataclass(frozen=True, slots=True, eq=False)
class RangeEdges:
    """Distance between the tag, carried by a pose, and an anchor (paper: UWB distance edges).

    The tag stands at ``u = lever_arm + R(turn) tag + velocity delay`` in the frame of the pose; with the planar
    distance D = |x + R(theta) u - a|, the radio is expected to say ``(1 + scale) sqrt(D^2 + height^2 + q) + bias``.
    """

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
    """(e,) height of the anchor above the tag, m, where it was told, else 0."""
    calibration: Ints
    """(e, 6) indices of scale, bias (m), q (m^2, unknown squared height), tag x, tag y (m, corrections) and delay (s);
    -1 = not an unknown (taken as 0)."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __len__(self) -> int:
        return len(self.pose)

    def _geometry(self, graph: Graph) -> tuple[Floats, Floats, Floats, Floats]:
        """Return u (e, 2), the vector anchor -> tag (e, 2), the slant distance (e,) and the calibration (6, e)."""
        cal = np.append(graph.calibration.values, 0.0)[self.calibration].T
        u = self.lever_arm + se2.rotate(self.turn, self.tag + cal[3:5].T) + self.velocity * cal[5][:, None]
        offset = se2.transform(graph.poses[self.pose], u) - graph.anchors[self.anchor]
        squared = np.einsum("ei,ei->e", offset, offset) + self.height**2 + cal[2]
        return u, offset, np.sqrt(np.maximum(squared, _NEAREST**2)), cal

    def distances(self, graph: Graph) -> Floats:
        """Return the slant distances (e,) between tag and anchors at the present estimates, m."""
        return self._geometry(graph)[2]

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 1), expected minus measured."""
        _, _, distance, cal = self._geometry(graph)
        return (((1.0 + cal[0]) * distance + cal[1] - self.ranges) / self.sigma)[:, None]

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by pose, anchor and the calibration in use."""
        u, offset, distance, cal = self._geometry(graph)
        scale = (1.0 + cal[0]) / self.sigma
        direction = offset / distance[:, None] * scale[:, None]
        theta = graph.poses[self.pose, 2]
        c, s = np.cos(theta), np.sin(theta)
        by_theta = direction[:, 0] * (-s * u[:, 0] - c * u[:, 1]) + direction[:, 1] * (c * u[:, 0] - s * u[:, 1])
        by_pose = np.concatenate([direction, by_theta[:, None]], axis=1)[:, None, :]
        blocks: list[Block] = [("poses", self.pose, by_pose), ("anchors", self.anchor, -direction[:, None, :])]
        if np.any(self.calibration >= 0):
            tag_axes = theta + self.turn
            in_pose = np.stack([c * direction[:, 0] + s * direction[:, 1], c * direction[:, 1] - s * direction[:, 0]], axis=1)
            columns = (
                distance / self.sigma,
                1.0 / self.sigma,
                scale / (2.0 * distance),
                direction[:, 0] * np.cos(tag_axes) + direction[:, 1] * np.sin(tag_axes),
                direction[:, 1] * np.cos(tag_axes) - direction[:, 0] * np.sin(tag_axes),
                np.einsum("ei,ei->e", in_pose, self.velocity),
            )
            for k, column in enumerate(columns):
                index = self.calibration[:, k]
                if np.any(index >= 0):
                    blocks.append(("calibration", np.maximum(index, 0), np.where(index >= 0, column, 0.0)[:, None, None]))
        residuals = (((1.0 + cal[0]) * distance + cal[1] - self.ranges) / self.sigma)[:, None]
        return Linearization(residuals, tuple(blocks))


_NEAREST = 1e-3
"""Tag on top of an anchor, m: nearer than this the direction is not defined, and the distance is held here."""


@dataclass(frozen=True, slots=True, eq=False)
class PriorEdges:
    """Direct knowledge of unknowns of one block: a surveyed anchor, a pinned pose, a plausible calibration."""

    block: str
    """'poses', 'anchors' or 'calibration'."""
    index: Ints
    """(e,) which unknown."""
    value: Floats
    """(e, k) with k = 3, 2, 1 by block; angles in rad."""
    sqrt_information: Floats
    """(e, k, k) L with information = L^T L."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    def __post_init__(self) -> None:
        if self.block not in ("poses", "anchors", "calibration"):
            raise DataError(f"a prior on {self.block!r}: it must be on poses, anchors or calibration")

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, k)."""
        if self.block == "calibration":
            error = graph.calibration.values[self.index][:, None] - self.value
        else:
            error = (graph.poses if self.block == "poses" else graph.anchors)[self.index] - self.value
        if self.block == "poses":
            error[:, 2] = se2.wrap_angle(error[:, 2])
        return _whiten(self.sqrt_information, error)

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians."""
        return Linearization(self.residuals(graph), ((self.block, self.index, self.sqrt_information),))
