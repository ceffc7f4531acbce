"""The pose graph: what is unknown (poses, anchors, calibration) and the edges that measure it.

Edges of one kind are one dataclass of arrays. Each kind offers ``residuals(graph)`` and ``linearize(graph)``; both
are whitened, so that the sum of squares is chi2 in units of the measurements' standard deviations. A new sensor is
one more dataclass here and one more row in the numeric-Jacobian test; the solver does not change.

Unknowns live in three blocks: ``poses`` (n, 3) T_map_base, ``anchors`` (a, 2) in the map frame and ``calibration``
(c,), a vector of named scalars. They are updated by addition (angles wrapped). Pose residuals use the chart of g2o,
e = Z^-1 (Xi^-1 Xj), so that chi2 compares with g2o's.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Protocol, cast

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


def pick_rows(edges: Any, which: Ints) -> Any:
    """Return some of the edges of a kind (rows of every array but those its SHARED names); kernel and kind stay."""
    shared = getattr(edges, "SHARED", ())
    own = {f.name: getattr(edges, f.name) for f in fields(edges)}
    arrays = {n: v for n, v in own.items() if isinstance(v, np.ndarray) and len(v) and n not in shared}
    per_edge = {n: v[which] for n, v in arrays.items()}
    return replace(edges, **per_edge)


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

    def with_estimates_of(self, solved: "Graph") -> "Graph":
        """Return the graph with the estimates of another, its own edges kept."""
        return self.updated(solved.poses, solved.anchors, solved.calibration.values)

    def chi2(self) -> float:
        """Return the sum of squared whitened residuals, robust kernels and weights applied."""
        return sum(edge_cost(e, e.residuals(self)) for e in self.edges)


def edge_cost(edges: Edges, residuals: Floats) -> float:
    """Return the robust, weighted cost of whitened residuals (e, d) of these edges."""
    rho = edges.kernel.rho(np.einsum("ed,ed->e", residuals, residuals))
    return float(np.sum(rho if edges.weights is None else rho * edges.weights))


def _whiten(sqrt_information: Floats, values: Floats) -> Floats:
    return np.einsum("eij,ej...->ei...", sqrt_information, values)


# An edge between poses has the error e = Z^-1 (Xi^-1 Xj); with m = tj - ti - R(theta_i) z its plane part is
# R(theta_i + theta_z)^T m. All its whitened derivatives are combinations of three columns, those by x, y and theta of
# Xj in the map frame: below they are the *axes*, (3, e) each. Edges run along the last, contiguous axis: ten times the
# speed of one small matrix product per edge.


def _map_axes(sqrt_information: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the columns (3, e) of L [R(heading)^T 0; 0 1]."""
    x, y, turn = np.ascontiguousarray(sqrt_information.transpose(2, 1, 0))
    c, s = se2.cos_sin(heading)
    return x * c - y * s, x * s + y * c, turn


def _relative_residuals(
    axes: tuple[Floats, Floats, Floats], z: Floats, xi: Floats, xj: Floats
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return whitened residuals (3, e) and the vector m (2, e); poses are (3, e)."""
    c, s = se2.cos_sin(xi[2])
    mx = xj[0] - xi[0] - (c * z[0] - s * z[1])
    my = xj[1] - xi[1] - (s * z[0] + c * z[1])
    return axes[0] * mx + axes[1] * my + axes[2] * se2.wrap_angle(xj[2] - xi[2] - z[2]), (mx, my)


def _turned_about(axes: tuple[Floats, Floats, Floats], pivot: Floats, point: Floats) -> Floats:
    """Return the derivative (3, e) by the heading of a pose at the pivot whose edge ends at the point."""
    return axes[0] * (point[1] - pivot[1]) - axes[1] * (point[0] - pivot[0]) - axes[2]


def _by_pose(*columns: Floats) -> Floats:
    """Return a Jacobian (e, d, k) from its columns (d, e)."""
    return np.stack(columns).transpose(2, 1, 0)


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

    SHARED: ClassVar[tuple[str, ...]] = ()

    def __len__(self) -> int:
        return len(self.i)

    def rows(self, which: Ints) -> "RelativePoseEdges":
        """Return the edges with these indices."""
        return cast(RelativePoseEdges, pick_rows(self, which))

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        return _whiten(self.sqrt_information, se2.between(self.T_i_j, se2.between(graph.poses[self.i], graph.poses[self.j])))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses."""
        xi, xj = graph.poses[self.i].T, graph.poses[self.j].T
        axes = _map_axes(self.sqrt_information, xi[2] + self.T_i_j[:, 2])
        residuals, _ = _relative_residuals(axes, self.T_i_j.T, xi, xj)
        by_i, by_j = _by_pose(-axes[0], -axes[1], _turned_about(axes, xi, xj)), _by_pose(*axes)
        return Linearization(residuals.T, (("poses", self.i, by_i), ("poses", self.j, by_j)))


@dataclass(frozen=True, slots=True, eq=False)
class OdometryEdges:
    """Motion from pose i to pose j by the wheels, corrected by the wheels' calibration.

    With distance scale 1 + s and heading error delta = k dtheta + b length + g duration, the measured motion
    (dx, dy, dtheta) is taken as ``(R(delta / 2) (1 + s) (dx, dy), dtheta + delta)``. The error is divided by 1 + s in
    x and y and by 1 + k in heading: it is the wheels' own, before the correction. Without that, noise alone would
    draw s and k towards wheels that count less (errors in variables).
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

    SHARED: ClassVar[tuple[str, ...]] = ()

    def __len__(self) -> int:
        return len(self.i)

    def corrected(self, graph: Graph) -> Floats:
        """Return the motion (e, 3) with the present calibration applied."""
        return self._corrected(graph)[0]

    def own_scale(self, graph: Graph) -> Floats:
        """Return by what (e, 3) an error of the corrected motion is divided to be one of the wheels' own."""
        s, k, _, _ = np.append(graph.calibration.values, 0.0)[self.calibration].T
        return np.maximum(np.stack([1.0 + s, 1.0 + s, 1.0 + k], axis=1), _LEAST_SCALE)

    def _corrected(self, graph: Graph) -> tuple[Floats, Floats, Floats]:
        padded = np.append(graph.calibration.values, 0.0)
        s, k, b, g = padded[self.calibration].T
        delta = k * self.motion[:, 2] + b * self.length + g * self.duration
        direction = se2.rotate(delta / 2.0, self.motion[:, :2])
        z = np.concatenate([direction * (1.0 + s)[:, None], (self.motion[:, 2] + delta)[:, None]], axis=1)
        return z, direction, s

    def rows(self, which: Ints) -> "OdometryEdges":
        """Return the edges with these indices."""
        return cast(OdometryEdges, pick_rows(self, which))

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        d = se2.between(graph.poses[self.i], graph.poses[self.j])
        return _whiten(self.sqrt_information, se2.between(self.corrected(graph), d) / self.own_scale(graph))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration in use."""
        xi, xj = graph.poses[self.i].T, graph.poses[self.j].T
        z, direction, s = self._corrected(graph)
        stretch = self.own_scale(graph)
        axes = _map_axes(self.sqrt_information / stretch[:, None, :], xi[2] + z[:, 2])
        residuals, m = _relative_residuals(axes, z.T, xi, xj)
        by_i, by_j = _by_pose(-axes[0], -axes[1], _turned_about(axes, xi, xj)), _by_pose(*axes)
        blocks: list[Block] = [("poses", self.i, by_i), ("poses", self.j, by_j)]
        if np.any(self.calibration >= 0):
            nx, ny = se2.rotate(xi[2], direction).T
            half = 0.5 * (1.0 + s)
            shift = axes[0] * m[0] + axes[1] * m[1]
            # A scale held at its least no longer changes what errors are divided by.
            across, turning = np.where(stretch[:, 1:] > _LEAST_SCALE, 1.0 / stretch[:, 1:], 0.0).T
            by_scale = -axes[0] * nx - axes[1] * ny - shift * across
            by_delta = axes[0] * (m[1] + half * ny) - axes[1] * (m[0] + half * nx) - axes[2]
            by_turn = by_delta * self.motion[:, 2] - (residuals - shift) * turning
            columns = (by_scale, by_turn, by_delta * self.length, by_delta * self.duration)
            for index, column in zip(self.calibration.T, columns, strict=True):
                if np.any(index >= 0):
                    blocks.append(("calibration", np.maximum(index, 0), _by_pose(np.where(index >= 0, column, 0.0))))
        return Linearization(residuals.T, tuple(blocks))


_LEAST_SCALE = 0.1
"""Wheels that count more than ten times what they do are not believed: nothing is divided by less."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanEdges:
    """Pose of cloud j in cloud i by scan matching, with the lidar's mounting and clock as unknowns.

    Clouds stand in the base frame through the nominal mounting and the clock they were made with. The true frame of cloud
    i is ``S_i = X_i o exp(twist_i (delay - made_with)) o C`` with the mounting correction C = (x, y, theta); the edge
    measures S_i^-1 S_j.
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
    made_with: float = 0.0
    """Delay with which the clouds were made, s."""
    kernel: Kernel = SQUARED
    weights: Floats | None = None

    SHARED: ClassVar[tuple[str, ...]] = ("calibration",)

    def __len__(self) -> int:
        return len(self.i)

    def _sensor_poses(self, graph: Graph, poses: Ints, twist: Floats) -> tuple[Floats, Floats]:
        """Return S (e, 3), and the heading (e,) of the base at the true time of the cloud."""
        x = graph.poses[poses]
        if not np.any(self.calibration >= 0):
            return x, x[:, 2]
        padded = np.append(graph.calibration.values, 0.0)
        moved = se2.compose(x, se2.exp(twist * (padded[self.calibration[3]] - self.made_with)))
        return se2.compose(moved, padded[self.calibration[:3]]), moved[:, 2]

    def relative(self, graph: Graph) -> Floats:
        """Return the pose (e, 3) of cloud j in cloud i at the present estimates."""
        si = self._sensor_poses(graph, self.i, self.twist_i)[0]
        return se2.between(si, self._sensor_poses(graph, self.j, self.twist_j)[0])

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 3)."""
        return _whiten(self.sqrt_information, se2.between(self.T_i_j, self.relative(graph)))

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration in use."""
        xi, xj = graph.poses[self.i].T, graph.poses[self.j].T
        from_pose, heading_i = self._sensor_poses(graph, self.i, self.twist_i)
        to_pose, heading_j = self._sensor_poses(graph, self.j, self.twist_j)
        si, sj = from_pose.T, to_pose.T
        axes = _map_axes(self.sqrt_information, si[2] + self.T_i_j[:, 2])
        residuals, _ = _relative_residuals(axes, self.T_i_j.T, si, sj)
        by_i = _by_pose(-axes[0], -axes[1], _turned_about(axes, xi, sj))
        by_j = _by_pose(axes[0], axes[1], -_turned_about(axes, xj, sj))
        blocks: list[Block] = [("poses", self.i, by_i), ("poses", self.j, by_j)]
        if np.any(self.calibration >= 0):
            c, s = (to - at for at, to in zip(se2.cos_sin(heading_i), se2.cos_sin(heading_j), strict=True))
            by_turn = axes[2] + _turned_about(axes, si, sj)
            by_delay = self._along(axes, graph, heading_j, self.twist_j) - self._along(axes, graph, heading_i, self.twist_i)
            by_delay += by_turn * self.twist_i[:, 2]
            columns = (axes[0] * c + axes[1] * s, axes[1] * c - axes[0] * s, by_turn, by_delay)
            for index, column in zip(self.calibration, columns, strict=True):
                if index >= 0:
                    blocks.append(("calibration", np.full(len(self), index), _by_pose(column)))
        return Linearization(residuals.T, tuple(blocks))

    def _along(self, axes: tuple[Floats, Floats, Floats], graph: Graph, heading: Floats, twist: Floats) -> Floats:
        """Return the derivative (3, e) by the time for which S moves with a base of these headings (e,)."""
        c, s = se2.cos_sin(heading)
        x, y = np.append(graph.calibration.values, 0.0)[self.calibration[:2]]
        vx, vy = twist[:, 0] - twist[:, 2] * y, twist[:, 1] + twist[:, 2] * x
        return axes[0] * (c * vx - s * vy) + axes[1] * (s * vx + c * vy) + axes[2] * twist[:, 2]


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
    stamps: Floats = field(default_factory=lambda: np.zeros(0))
    """(e,) s, where known; not used by the graph."""

    SHARED: ClassVar[tuple[str, ...]] = ("tag",)

    def __len__(self) -> int:
        return len(self.pose)

    def _geometry(self, graph: Graph) -> tuple[Floats, Floats, Floats, Floats]:
        """Return R(theta) u (2, e), the vector anchor -> tag (2, e), the slant distance (e,) and the calibration (6, e)."""
        cal = np.append(graph.calibration.values, 0.0)[self.calibration.T]
        pose, anchor = graph.poses[self.pose].T, graph.anchors[self.anchor].T
        c, s = se2.cos_sin(self.turn)
        tx, ty = self.tag[0] + cal[3], self.tag[1] + cal[4]
        ux = self.lever_arm[:, 0] + (c * tx - s * ty) + self.velocity[:, 0] * cal[5]
        uy = self.lever_arm[:, 1] + (s * tx + c * ty) + self.velocity[:, 1] * cal[5]
        c, s = se2.cos_sin(pose[2])
        arm = np.stack([c * ux - s * uy, s * ux + c * uy])
        offset = pose[:2] + arm - anchor
        squared = offset[0] ** 2 + offset[1] ** 2 + self.height**2 + cal[2]
        return arm, offset, np.sqrt(np.maximum(squared, _NEAREST**2)), cal

    def distances(self, graph: Graph) -> Floats:
        """Return the slant distances (e,) between tag and anchors at the present estimates, m."""
        return self._geometry(graph)[2]

    def rows(self, which: Ints) -> "RangeEdges":
        """Return the edges with these indices."""
        return cast(RangeEdges, pick_rows(self, which))

    def residuals(self, graph: Graph) -> Floats:
        """Return whitened residuals (e, 1), expected minus measured."""
        _, _, distance, cal = self._geometry(graph)
        return (((1.0 + cal[0]) * distance + cal[1] - self.ranges) / self.sigma)[:, None]

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by pose, anchor and the calibration in use."""
        arm, offset, distance, cal = self._geometry(graph)
        scale = (1.0 + cal[0]) / self.sigma
        direction = offset * (scale / distance)
        by_theta = direction[1] * arm[0] - direction[0] * arm[1]
        by_pose = np.stack([direction[0], direction[1], by_theta])[None].transpose(2, 0, 1)
        blocks: list[Block] = [("poses", self.pose, by_pose), ("anchors", self.anchor, -direction[None].transpose(2, 0, 1))]
        if np.any(self.calibration >= 0):
            columns = self._by_calibration(graph.poses[self.pose, 2], direction, distance, scale)
            for index, column in zip(self.calibration.T, columns, strict=True):
                if np.any(index >= 0):
                    blocks.append(("calibration", np.maximum(index, 0), np.where(index >= 0, column, 0.0)[:, None, None]))
        residuals = (((1.0 + cal[0]) * distance + cal[1] - self.ranges) / self.sigma)[:, None]
        return Linearization(residuals, tuple(blocks))

    def _by_calibration(self, theta: Floats, direction: Floats, distance: Floats, scale: Floats) -> tuple[Floats, ...]:
        """Return the derivatives (e,) by scale, bias, q, tag x, tag y and delay."""
        (x, y), (vx, vy) = direction, self.velocity.T
        c, s = se2.cos_sin(theta)
        ct, st = se2.cos_sin(theta + self.turn)
        by_delay = (c * x + s * y) * vx + (c * y - s * x) * vy
        return distance / self.sigma, 1.0 / self.sigma, scale / (2.0 * distance), ct * x + st * y, ct * y - st * x, by_delay


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
