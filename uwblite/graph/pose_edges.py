"""Edges between two poses: matched scans and loop closures, wheels, and a lidar whose mounting is unknown.

Residuals use the chart of g2o, e = Z^-1 (Xi^-1 Xj), so that chi2 compares with g2o's.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Shape
from ..config import documented
from .calibration import LASER, ODOMETRY, OMNI, TURNING, WHEELS
from .graph import Block, Edges, Graph, Linearization

_LEAST_SCALE = 0.1
"""Least scale that errors are divided by: odometry is not ten times too long."""


class _Relative:
    """The errors e = Z^-1 (Si^-1 Sj) of frames that poses carry, and their derivatives.

    With m = tj - ti - R(theta_i) z the plane part of e is R(theta_i + theta_z)^T m. All whitened derivatives are combinations
    of three columns, those by x, y and theta of Sj in the map frame: the *axes*, (3, e) each. Edges run along the last,
    contiguous axis: ten times the speed of one small matrix product per edge.
    """

    def __init__(self, z: Floats, sqrt_information: Floats, si: Floats, sj: Floats) -> None:
        """Compute the whitened residuals (3, e); measured poses are (e, 3), those of the frames (3, e)."""
        x, y, turn = np.ascontiguousarray(sqrt_information.transpose(2, 1, 0))
        c, s = se2.cos_sin(si[2] + z[:, 2])
        self.axes = x * c - y * s, x * s + y * c, turn
        self.si, self.sj = si, sj
        c, s = se2.cos_sin(si[2])
        mx = sj[0] - si[0] - (c * z[:, 0] - s * z[:, 1])
        my = sj[1] - si[1] - (s * z[:, 0] + c * z[:, 1])
        self.m = mx, my
        self.residuals = self.along(mx, my) + turn * se2.wrap_angle(sj[2] - si[2] - z[:, 2])

    def along(self, x: Floats, y: Floats) -> Floats:
        """Return the derivative (3, e) by a motion of Sj in the direction x, y (e,) of the map."""
        return self.axes[0] * x + self.axes[1] * y

    def turned_about(self, pivot: Floats) -> Floats:
        """Return the derivative (3, e) by a turn of Si, or back of Sj, about a point (2 or 3, e)."""
        return self.axes[0] * (self.sj[1] - pivot[1]) - self.axes[1] * (self.sj[0] - pivot[0]) - self.axes[2]

    def by_poses(self, i: Ints, j: Ints, xi: Floats, xj: Floats) -> tuple[Block, Block]:
        """Return the blocks by poses at xi, xj (3, e), which carry the frames."""
        x, y, turn = self.axes
        by_j = turn if xj is self.sj else -self.turned_about(xj)
        return ("poses", i, _jacobian(-x, -y, self.turned_about(xi))), ("poses", j, _jacobian(x, y, by_j))


def _poses_at(poses: Floats, index: Ints) -> Floats:
    """Return x, y, theta (3, e) of the poses at the ends of edges, contiguous: rows taken in one go, four times as fast."""
    return np.ascontiguousarray(poses.T).take(index, axis=1)


def _jacobian(*columns: Floats) -> Floats:
    """Return a Jacobian (e, d, k) from its columns (d, e)."""
    return np.stack(columns).transpose(2, 1, 0)


@documented
@dataclass(frozen=True, slots=True, eq=False)
class RelativePoseEdges(Edges):
    """Pose j as seen from pose i: loop closures, scan matches, and edges read from files."""

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"i": "poses", "j": "poses"}
    ROWS: ClassVar[Mapping[str, Shape]] = {"T_i_j": se2.POSE, "sqrt_information": se2.POSE * 2}

    i: Ints
    """(e,) index of the pose measured from."""
    j: Ints
    """(e,) index of the pose measured."""
    T_i_j: Floats
    """(e, 3) measured pose."""
    sqrt_information: Floats
    """(e, 3, 3) L with information = L^T L in the chart e = Z^-1 (Xi^-1 Xj); may be singular."""

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses."""
        xi, xj = _poses_at(graph.poses, self.i), _poses_at(graph.poses, self.j)
        error = _Relative(self.T_i_j, self.sqrt_information, xi, xj)
        return Linearization(error.residuals.T, error.by_poses(self.i, self.j, xi, xj))


@documented
@dataclass(frozen=True, slots=True, eq=False)
class OdometryEdges(Edges):
    """Motion from pose i to pose j by odometry, corrected by its calibration.

    With distance scale 1 + s and heading error delta = k dtheta + b length + g duration, the measured motion
    (dx, dy, dtheta) is taken as ``(R(delta / 2) (1 + s) (dx, dy), dtheta + delta)``. The error is divided by 1 + s ahead and by
    1 + k in heading: as that of the raw odometry. Else noise would bias s and k towards smaller motions (errors in variables).
    So is an error to the side where wheels count such motion. Elsewhere it is a motion that they do not count, and would bias s
    towards larger ones. It is the error in the middle of the step: a heading error anywhere along the step displaces the end,
    on average, by half the distance times the error, and the remaining error across is independent of it.

    The wheels turn about the point (-p, 0) of the base, and measure the motion of a frame there. To their motion v to the left
    ``v q + u r`` is added and to their motion u ahead ``v w``, both in the frame in the middle of the step.
    """

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"i": "poses", "j": "poses", "calibration": "calibration"}
    ROWS: ClassVar[Mapping[str, Shape]] = {"motion": se2.POSE, "sqrt_information": se2.POSE * 2, "calibration": (len(WHEELS),)}

    i: Ints
    j: Ints
    motion: Floats
    """(e, 3) T_i_j by the raw odometry."""
    length: Floats
    """(e,) signed distance travelled, m."""
    duration: Floats
    """(e,) s."""
    sqrt_information: Floats
    """(e, 3, 3), of the error in the middle of the step."""
    calibration: Ints
    """(e, 8) indices of WHEELS: s, k, b (rad/m), g (rad/s), p (m/rad), q, r (rad), w (rad); -1 = no unknown (taken as 0)."""
    slips: Floats | None = None
    """(e,) probability that the wheels slip over each step, by what is no scan; not yet in the information. None = none."""

    def corrected(self, graph: Graph) -> Floats:
        """Return the motion (e, 3) with the present calibration applied."""
        turning = self._turning_point(graph)
        return se2.compose(turning, se2.compose(self._corrected(graph)[0], se2.inverse(turning)))

    def own_scale(self, graph: Graph) -> Floats:
        """Return by what (e, 3) an error of the corrected motion, ahead, to the side and in heading, is divided."""
        s, k = np.append(graph.calibration.values, 0.0)[self.calibration[:, :2]].T
        return np.maximum(np.stack([1.0 + s, 1.0 + s * self._count_sideways, 1.0 + k], axis=1), _LEAST_SCALE)

    @property
    def _count_sideways(self) -> Bools:
        """(e,) whether the wheels count motion to the side, which then has a scale of its own."""
        return np.asarray(self.calibration[:, WHEELS.index(OMNI[0])] >= 0)

    @property
    def end_sqrt_information(self) -> Floats:
        """(e, 3, 3), of the error of pose j in its own frame."""
        x, y = 0.5 * se2.rotate(-self.motion[:, 2], self.motion[:, :2]).T
        root = self.sqrt_information.copy()
        root[:, :, 2] += y[:, None] * root[:, :, 0] - x[:, None] * root[:, :, 1]
        return root

    def _corrected(self, graph: Graph) -> tuple[Floats, Floats, Floats]:
        padded = np.append(graph.calibration.values, 0.0)
        s, k, b, g, _, *slip = padded[self.calibration].T
        delta = k * self.motion[:, 2] + b * self.length + g * self.duration
        way = self.motion[:, :2]
        if np.any(slip):
            left, ahead = self._ways()
            q, r, w = slip
            way = way + se2.rotate(self.motion[:, 2] / 2.0, np.stack([w * left, q * left + r * ahead], axis=1))
        direction = se2.rotate(delta / 2.0, way)
        z = np.concatenate([direction * (1.0 + s)[:, None], (self.motion[:, 2] + delta)[:, None]], axis=1)
        return z, direction, s

    def _ways(self) -> Floats:
        """Return the motion (2, e) to the left and ahead, in the frame in the middle of the step, m."""
        ahead, left = se2.rotate(-self.motion[:, 2] / 2.0, self.motion[:, :2]).T
        return np.stack([left, ahead])

    def _turning_point(self, graph: Graph) -> Floats:
        """Return the frame (e, 3) on the base whose motion the wheels measure."""
        p = np.append(graph.calibration.values, 0.0)[self.calibration[:, WHEELS.index(TURNING)]]
        return np.stack([-p, np.zeros_like(p), np.zeros_like(p)], axis=1)

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration that is free."""
        xi, xj = _poses_at(graph.poses, self.i), _poses_at(graph.poses, self.j)
        turning = self._turning_point(graph)
        si, sj = (se2.compose(graph.poses[k], turning).T for k in (self.i, self.j))
        z, direction, s = self._corrected(graph)
        stretch = self.own_scale(graph)
        root = self.end_sqrt_information / stretch[:, None, :]
        error = _Relative(z, root, si, sj)
        blocks: list[Block] = [*error.by_poses(self.i, self.j, xi, xj)]
        used = graph.free_columns(self.calibration)
        if used.any():
            nx, ny = se2.rotate(xi[2], direction).T
            half = 0.5 * (1.0 + s)
            axes, (mx, my) = error.axes, error.m
            shift = error.along(mx, my)
            # A scale clamped at its least value no longer changes the divisor of errors.
            shrinks = np.where(stretch > _LEAST_SCALE, 1.0 / stretch, 0.0)
            shrinks[:, 1] *= self._count_sideways
            off = se2.rotate(-si[2] - z[:, 2], np.stack([mx, my], axis=1)) * shrinks[:, :2]
            by_scale = -axes[0] * nx - axes[1] * ny - np.einsum("eij,ej->ie", root[:, :, :2], off)
            by_delta = axes[0] * (my + half * ny) - axes[1] * (mx + half * nx) - axes[2]
            by_turn = by_delta * self.motion[:, 2] - (error.residuals - shift) * shrinks[:, 2]
            columns = [by_scale, by_turn, by_delta * self.length, by_delta * self.duration]
            if used[len(ODOMETRY) :].any():
                cos, sin = (before - after for before, after in zip(se2.cos_sin(xi[2]), se2.cos_sin(xj[2]), strict=True))
                columns.append(error.along(cos, sin))
                # The middle of the step is turned by (delta + dtheta) / 2.
                cos, sin = se2.cos_sin(xi[2] + z[:, 2] / 2.0)
                left, ahead = (1.0 + s) * self._ways()
                to_left, to_ahead = axes[0] * sin - axes[1] * cos, -axes[0] * cos - axes[1] * sin
                columns += [to_left * left, to_left * ahead, to_ahead * left]
            blocks += graph.calibration_blocks(self.calibration, columns)
        return Linearization(error.residuals.T, tuple(blocks))


@documented
@dataclass(frozen=True, slots=True, eq=False)
class ScanEdges(Edges):
    """Pose of cloud j in cloud i by scan matching, with the lidar's mounting and clock as unknowns.

    Clouds are in the base frame by the nominal mounting and the clock with which they were made. The true frame of cloud
    i is ``S_i = X_i o exp(twist_i (delay - made_with)) o C`` with the mounting correction C = (x, y, theta); the edge
    measures S_i^-1 S_j.
    """

    UNKNOWNS: ClassVar[Mapping[str, str]] = {"i": "poses", "j": "poses", "calibration": "calibration"}
    ROWS: ClassVar[Mapping[str, Shape]] = {
        **dict.fromkeys(("T_i_j", "twist_i", "twist_j"), se2.POSE),
        "sqrt_information": se2.POSE * 2,
        "calibration": (len(LASER),),
    }
    SHARED: ClassVar[tuple[str, ...]] = ("calibration",)

    i: Ints
    j: Ints
    T_i_j: Floats
    """(e, 3) measured pose of cloud j in cloud i."""
    sqrt_information: Floats
    """(e, 3, 3) in the chart e = Z^-1 (Si^-1 Sj); singular in directions that the scans do not measure."""
    twist_i: Floats
    """(e, 3) velocity of the base at cloud i in its own frame, m/s, m/s, rad/s."""
    twist_j: Floats
    """(e, 3) velocity at cloud j."""
    calibration: Ints
    """(4,) indices of LASER: C's x, y, theta and the delay, s; -1 = no unknown (taken as 0)."""
    made_with: float = 0.0
    """Delay with which the clouds were made, s."""

    def sensor_poses(self, graph: Graph, poses: Ints, twist: Floats) -> tuple[Floats, tuple[Floats, Floats]]:
        """Return S (e, 3), and cosine and sine (e,) of the base's heading at the true time of the cloud."""
        # A pose has one cloud, and many edges: what they have in common is computed once.
        row = np.zeros(len(graph.poses), dtype=np.intp)
        row[poses] = np.arange(len(poses))
        if len(poses) > len(row) and np.array_equal(twist[row].take(poses, axis=0), twist):
            sensor, heading = self._at_their_time(graph, graph.poses, twist[row])
            return sensor.take(poses, axis=0), (heading[0].take(poses), heading[1].take(poses))
        return self._at_their_time(graph, graph.poses[poses], twist)

    def _at_their_time(self, graph: Graph, base: Floats, twist: Floats) -> tuple[Floats, tuple[Floats, Floats]]:
        """Return the same by the poses (e, 3) of the base and its velocities (e, 3) at the nominal times of the clouds."""
        if not np.any(self.calibration >= 0):
            return base, se2.cos_sin(base[:, 2])
        x, y, turn, delay = np.append(graph.calibration.values, 0.0)[self.calibration]
        if delay != self.made_with:
            base = se2.compose(base, se2.exp(twist * (delay - self.made_with)))
        c, s = se2.cos_sin(base[:, 2])
        sensor = np.stack([base[:, 0] + (c * x - s * y), base[:, 1] + (s * x + c * y), se2.wrap_angle(base[:, 2] + turn)])
        return sensor.T, (c, s)

    def relative(self, graph: Graph) -> Floats:
        """Return the pose (e, 3) of cloud j in cloud i at the present estimates."""
        si = self.sensor_poses(graph, self.i, self.twist_i)[0]
        return se2.between(si, self.sensor_poses(graph, self.j, self.twist_j)[0])

    def linearize(self, graph: Graph) -> Linearization:
        """Return whitened residuals and Jacobians by both poses and the calibration that is free."""
        xi, xj = _poses_at(graph.poses, self.i), _poses_at(graph.poses, self.j)
        from_pose, heading_i = self.sensor_poses(graph, self.i, self.twist_i)
        to_pose, heading_j = self.sensor_poses(graph, self.j, self.twist_j)
        si, sj = from_pose.T, to_pose.T
        error = _Relative(self.T_i_j, self.sqrt_information, si, sj)
        blocks: list[Block] = [*error.by_poses(self.i, self.j, xi, xj)]
        if graph.free_columns(self.calibration[None]).any():
            c, s = (to - at for at, to in zip(heading_i, heading_j, strict=True))
            by_turn = error.axes[2] + error.turned_about(si)
            x, y = np.append(graph.calibration.values, 0.0)[self.calibration[:2]]

            def by_time(heading: tuple[Floats, Floats], twist: Floats) -> Floats:
                """Return the derivative (3, e) by the time for which S moves with a base of these headings' cosine and sine."""
                (c, s), vx, vy = heading, twist[:, 0] - twist[:, 2] * y, twist[:, 1] + twist[:, 2] * x
                return error.along(c * vx - s * vy, s * vx + c * vy) + error.axes[2] * twist[:, 2]

            by_delay = by_time(heading_j, self.twist_j) - by_time(heading_i, self.twist_i) + by_turn * self.twist_i[:, 2]
            columns = (error.along(c, s), error.along(-s, c), by_turn, by_delay)
            blocks += graph.calibration_blocks(np.broadcast_to(self.calibration, (len(self), len(columns))), columns)
        return Linearization(error.residuals.T, tuple(blocks))
