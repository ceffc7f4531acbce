"""What the measurements of a simulated recording allow: least squares with true associations and true noise, from the truth.

Poses, anchors, walls, columns and their radii, the range offsets of surfaces, the wheels' calibration, the radio's unit, the
anchors' biases and the antennas' patterns are all unknown. Known are which surface each ray hit, which steps slipped, which
ranges were shadowed by what, and how all errors are distributed: the multipath of an anchor, and what patches of floor add to
steps, as Gaussian processes over the floor. The maximum-likelihood optimum is found by Gauss-Newton from the truth; its
covariance is the Cramer-Rao bound.

    residuals   wheels   log of the step against the calibrated step, (x, y, theta)
                wall     n . (R (p - offset r) + t) - d    n, d of the wall; p a point in the base frame, r the ray's direction
                column   |R (p - offset r) + t - c| - radius
                range    scale |tag - anchor| + bias + patterns - range, white noise + Gaussian process
"""

import one_thread  # noqa: F401

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from simulation import radio, real_rooms
from simulation.recording import Recording, hidden_ranges

from uwblite import se2
from uwblite.evaluation.trajectory import align
from uwblite.graph.calibration import CalibrationConfig
from uwblite.odometry import keyframes
from uwblite.odometry.attached import attach_ranges, choose_scans, scan_points
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.sensor_log import SensorLog

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

ROUNDS = 8
"""Gauss-Newton steps, at most."""
CONVERGED = 1e-5
"""m and rad; the largest step at which the search ends."""
_AT_ONCE = 200_000
"""Rays linearised at once."""
_ANY_PLACE = 10.0
"""m and rad; prior standard deviation of a surface, for those that a single ray hit."""
_ANY_RADIUS = 0.1
"""m; prior standard deviation of a column's radius."""
_GRAZING = 0.3
"""Cosine of incidence below which a ray at a column shows the place of its edge, not of its surface; it is left out."""
_SLIP = 0.5
"""m and rad; standard deviation of a step during a slip."""
_ROUNDING = 2e-4
"""m and rad; of odometry and truth as written, and of steps taken as arcs."""
_WHEELS = 3
"""Unknowns of the wheels: scale of distance, scale of heading, heading per metre."""
_PATTERN = 6
"""Unknowns of an antenna's pattern: cosine and sine of one, two and three times the direction."""
_UNIT = CalibrationConfig().range_scale_sound
"""Relative standard deviation of the unit of a sound radio: what a map assumes, too."""


@dataclass(frozen=True)
class OracleFigures:
    """How far the optimum is from the truth, and how far by the Cramer-Rao bound."""

    ate: float
    """m, of the keyframes after rigid alignment."""
    anchors: float
    """m, rms, in the same alignment; nan without any."""
    bound_ate: float
    """m, expected by the Cramer-Rao bound."""
    bound_anchors: float
    """m."""


@dataclass(frozen=True)
class _Rays:
    """Rays of known surfaces, as points."""

    pose: Ints
    surface: Ints
    points: Floats
    """(p, 2) m, frame of the keyframe."""
    directions: Floats
    """(p, 2) unit, same frame."""
    sd: Floats
    """(p,) m, along the ray."""


class _Layout:
    """Where each unknown stands in the vector of all: poses after the fixed ones, anchors, scalars, four of each surface."""

    def __init__(self, poses: int, anchors: int, surfaces: int, fixed: int = 1) -> None:
        self.poses = (np.arange(poses)[:, None] - fixed) * 3 + np.arange(3)
        begin = 3 * (poses - fixed)
        self.anchors = begin + np.arange(2 * anchors).reshape(-1, 2)
        begin += 2 * anchors
        self.wheels = begin + np.arange(_WHEELS)
        begin += _WHEELS
        self.bias = begin + np.arange(anchors)
        begin += anchors
        self.scale = begin
        begin += 1
        self.patterns = begin + np.arange(_PATTERN * (anchors + 1)).reshape(-1, _PATTERN)
        self.shared = begin + _PATTERN * (anchors + 1)
        """Unknowns in front of those of surfaces."""
        own = self.shared + np.arange(4 * surfaces).reshape(-1, 4)
        self.surfaces, self.offset, self.radius = own[:, :2], own[:, 2], own[:, 3]
        self.size = self.shared + own.size


class Oracle:
    """The least-squares problem of one recording.

    In pieces, the oracle knows of surfaces what a map can see of them: not that metres of wall are one straight line of one
    range offset, nor that what is seen of a column from all sides is one circle.
    """

    def __init__(
        self, recording: Recording, log: SensorLog, lidar: bool = True, pieces: bool = False, first_known: bool = True
    ) -> None:
        self.recording, self.log, self.rooms = recording, log, recording.settings.rooms
        self.frames = keyframes.select(log.odometry, KeyframeConfig())
        self.truth = self._at(self.frames.stamps)
        self.rays = self._rays() if lidar and len(recording.scans) else None
        self.walls, self.columns = recording.plan.walls, recording.plan.columns
        if pieces and self.rays is not None:
            self.rays, self.walls, self.columns = _in_pieces(self.rays, self.truth, self.walls, self.columns)
        self.has_ranges = log.ranges is not None
        seen = np.unique(self.rays.surface) if self.rays is not None else np.zeros(0, dtype=np.intp)
        self.seen = seen
        self.anchors = len(recording.anchors) if self.has_ranges else 0
        self.layout = _Layout(len(self.frames), self.anchors, len(seen), 1 if first_known else 0)
        self.x = self._start()
        self.sharing = np.ones(self.layout.size)
        """Recordings that have each unknown in common: its prior is that of all together."""
        self._whitening = self._wheel_whitening()
        self._range_factors: dict[int, tuple[Floats, bool]] = {}
        """Of the covariance of each anchor's ranges, at the true places."""
        self._excesses: tuple[Floats, Floats, Bools] | None = None

    def _at(self, stamps: Floats) -> Floats:
        r = self.recording
        return np.stack([np.interp(stamps, r.stamps, r.truth[:, k]) for k in range(3)], axis=-1)

    def _rays(self) -> _Rays:
        """Return the rays of the scans at the keyframes, moved to these by the odometry as the estimator does."""
        log, model = self.log, self.recording.settings.laser
        assert log.scans is not None
        owner, chosen = choose_scans(log.scans, self.frames, KeyframeConfig())
        found = scan_points(log, self.frames, owner, chosen)
        surface = self.recording.surfaces[found.scan, found.ray].astype(np.intp)
        kept = surface >= 0
        way = found.points[kept] - found.origins[kept]
        reach = np.hypot(way[:, 0], way[:, 1])
        sd = np.maximum(model.near_sd, model.far_sd * reach)
        return _Rays(found.keyframe[kept], surface[kept], found.points[kept], way / reach[:, None], sd)

    def _start(self) -> Floats:
        """Return the truth as the vector of unknowns."""
        x, layout = np.zeros(self.layout.size), self.layout
        free = layout.poses[:, 0] >= 0
        x[layout.poses[free].ravel()] = self.truth[free].ravel()
        x[layout.scale] = self.recording.settings.radio.scale
        if self.anchors:
            x[layout.anchors] = self.recording.anchors
        for k, surface in enumerate(self.seen.tolist()):
            if surface < len(self.walls):
                x1, y1, x2, y2 = self.walls[surface]
                angle = np.arctan2(x2 - x1, y1 - y2)
                x[layout.surfaces[k]] = angle, np.cos(angle) * x1 + np.sin(angle) * y1
            else:
                x[layout.surfaces[k]] = self.columns[surface - len(self.walls), :2]
        return x

    def poses(self) -> Floats:
        """Return the poses (k, 3), the first at its true place where it is fixed."""
        poses, free = self.truth.copy(), self.layout.poses[:, 0] >= 0
        poses[free] = self.x[self.layout.poses[free]]
        return poses

    def solve(self) -> OracleFigures:
        """Descend from the truth and judge the optimum and its covariance."""
        for _ in range(ROUNDS):
            factor, step = self._step()
            self.x += step
            if np.abs(step).max() < CONVERGED:
                break
        return self._figures(factor)

    def _step(self) -> tuple[tuple[Floats, bool], Floats]:
        """Return the factor of the normal equations with surfaces eliminated, and the Gauss-Newton step (size,)."""
        return step_of(*self.normal(), self.layout.shared)

    def normal(self) -> tuple[sparse.csr_matrix, Floats, Floats]:
        """Return the normal equations at the present estimate: a sparse part, a dense one of what surfaces are not in, and
        the gradient."""
        layout = self.layout
        gradient, matrix = np.zeros(layout.size), np.zeros((layout.shared, layout.shared))
        prior = np.zeros(layout.size)
        prior[layout.surfaces] = _ANY_PLACE**-2
        whole = sparse.diags(prior, format="csr")
        for jacobian, residual in (self._priors(), *self._ray_rows()):
            whole = whole + jacobian.T @ jacobian
            gradient += jacobian.T @ residual
        jacobian, residual = self._wheel_rows()
        near = jacobian[:, : layout.shared]
        matrix += (near.T @ near).toarray()
        gradient += jacobian.T @ residual
        if self.has_ranges:
            self._add_ranges(matrix, gradient)
        return whole, matrix, gradient

    def _rows(self, columns: Ints, values: Floats) -> sparse.csr_matrix:
        """Return rows (m,) that are non-zero in these columns (m, c); a column below 0 is fixed."""
        row = np.broadcast_to(np.arange(len(columns))[:, None], columns.shape)
        free = columns >= 0
        return sparse.csr_matrix((values[free], (row[free], columns[free])), shape=(len(columns), self.layout.size))

    def _wheel_rows(self) -> tuple[sparse.csr_matrix, Floats]:
        frames, poses, layout = self.frames, self.poses(), self.layout
        s, k, b = self.x[layout.wheels]
        turn = frames.motion[:, 2] * k + frames.length * b
        along = se2.rotate(0.5 * turn, frames.motion[:, :2]) * (1.0 + s)
        z = np.concatenate([along, (frames.motion[:, 2] + turn)[:, None]], axis=1)
        error = self._step_error(z, poses)
        columns = np.concatenate(
            [layout.poses[:-1], layout.poses[1:], np.broadcast_to(layout.wheels, (len(z), _WHEELS))], axis=1
        )
        jacobian = np.empty((len(z), 3, 9))
        small = 1e-6
        for c in range(3):
            for side, first in ((0, 0), (1, 3)):
                ends = [poses[:-1].copy(), poses[1:].copy()]
                ends[side][:, c] += small
                jacobian[:, :, first + c] = (_between_error(z, *ends) - error) / small
        ahead = np.stack([-z[:, 1], z[:, 0]], axis=1)
        jacobian[:, :, 6] = -np.concatenate([z[:, :2] / (1.0 + s), np.zeros((len(z), 1))], axis=1)
        for c, turned in ((7, frames.motion[:, 2]), (8, frames.length)):
            jacobian[:, :, c] = -np.concatenate([0.5 * turned[:, None] * ahead, turned[:, None]], axis=1)
        rows = self._rows(np.repeat(columns, 3, axis=0), jacobian.reshape(-1, 9))
        whitening = self._whitening
        return sparse.csr_matrix(whitening @ rows), whitening @ error.ravel()

    def _step_error(self, z: Floats, poses: Floats) -> Floats:
        return _between_error(z, poses[:-1], poses[1:])

    def _wheel_whitening(self) -> sparse.csr_matrix | Floats:
        """Return L (3e, 3e) with L^T L the information of all steps: a heading that errs in mid-step errs sideways too."""
        frames, truth, rooms = self.frames, self.recording.calibration["odometry"], self.rooms
        length, turned = frames.path, frames.turned
        heading = truth["heading_noise_travel"] ** 2 * length + truth["heading_noise_turn"] ** 2 * turned
        if rooms is not None:
            heading = heading + rooms.bump_turn**2 * length / rooms.bump_every
        covariance = np.zeros((len(length), 3, 3))
        covariance[:, 0, 0] = truth["distance_noise"] ** 2 * length
        covariance[:, 1, 1] = heading * length**2 / 3.0
        covariance[:, 1, 2] = covariance[:, 2, 1] = 0.5 * heading * length
        covariance[:, 2, 2] = heading
        covariance += np.eye(3) * _ROUNDING**2
        for slip in self.recording.calibration["slips"]:
            first, last = slip["start"] - 0.1, slip["start"] + slip["seconds"] + 0.1
            during = (frames.stamps[1:] > first) & (frames.stamps[:-1] < last)
            covariance[during] += np.eye(3) * _SLIP**2
        # Along the mean direction of the step, as the noise was made.
        half = np.zeros((len(length), 3, 3))
        c, s = np.cos(0.5 * frames.motion[:, 2]), np.sin(0.5 * frames.motion[:, 2])
        half[:, 0, 0], half[:, 0, 1], half[:, 1, 0], half[:, 1, 1], half[:, 2, 2] = c, s, -s, c, 1.0
        along = sparse.block_diag(half, format="csr")
        if rooms is None:
            return sparse.block_diag(np.linalg.inv(np.linalg.cholesky(covariance)), format="csr") @ along
        whole = sparse.block_diag(covariance).toarray() + self._floor_covariance()
        return np.asarray(solve_triangular(np.linalg.cholesky(whole), along.toarray(), lower=True))

    def _floor_covariance(self) -> Floats:
        """Return the covariance (3e, 3e) of what patches of floor add to way and turn of the steps."""
        rooms, length = self.rooms, self.frames.path
        assert rooms is not None
        middle = 0.5 * (self.truth[1:, :2] + self.truth[:-1, :2])
        alike = _alike(middle, rooms.patch_length) * np.outer(length, length)
        way, turn = np.zeros((3, len(length))), np.zeros((3, len(length)))
        way[0], turn[1], turn[2] = rooms.patch_way, 0.5 * rooms.patch_turn * length, rooms.patch_turn
        effects = [np.einsum("ie,jf,ef->eifj", part, part, alike) for part in (way, turn)]
        return np.asarray((effects[0] + effects[1]).reshape(alike.shape[0] * 3, -1))

    def _priors(self) -> tuple[sparse.csr_matrix, Floats]:
        """Return what is known of the scalars beforehand: the distributions they were drawn from.

        The radio's unit is drawn from none; it is taken for that of a sound radio.
        """
        layout, model = self.layout, self.recording.settings.radio
        pattern = self._antenna_sd() * np.sqrt(0.5 / 3.0)
        offset = self.recording.settings.laser.surface_sd if self.rooms is None else self.rooms.surface_sd
        scalars = [layout.wheels, layout.bias, [layout.scale], layout.patterns.ravel(), layout.offset, layout.radius]
        which = np.concatenate(scalars)
        bias = np.full(len(layout.bias), max(model.bias_sd, 1e-4))
        patterns = np.full(layout.patterns.size, max(pattern, 1e-6))
        offsets, radii = np.full(len(layout.offset), max(offset, 1e-6)), np.full(len(layout.radius), _ANY_RADIUS)
        sd = np.concatenate([[0.05, 0.05, 0.02], bias, [_UNIT], patterns, offsets, radii])
        off = self.x.copy()
        off[layout.scale] -= model.scale
        sd *= np.sqrt(self.sharing[which])
        return self._rows(which[:, None], 1.0 / sd[:, None]), off[which] / sd

    def _antenna_sd(self) -> float:
        """Return the standard deviation of what the direction in which an antenna is hit adds to a range, m."""
        return self.recording.settings.radio.antenna_sd if self.rooms is None else self.rooms.antenna_sd

    def _ray_rows(self) -> Iterator[tuple[sparse.csr_matrix, Floats]]:
        """Yield whitened Jacobians and residuals of the rays, a bounded number at a time."""
        rays, layout = self.rays, self.layout
        if rays is None:
            return
        poses, place = self.poses(), np.searchsorted(self.seen, rays.surface)
        for first in range(0, len(rays.pose), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            own = poses[rays.pose[part]]
            direction = se2.rotate(own[:, 2], rays.directions[part])
            arm = se2.rotate(own[:, 2], rays.points[part]) - self.x[layout.offset[place[part]], None] * direction
            at = own[:, :2] + arm
            surface = self.x[layout.surfaces[place[part]]]
            wall = rays.surface[part] < len(self.walls)
            normal = np.stack([np.cos(surface[:, 0]), np.sin(surface[:, 0])], axis=1)
            flat = (normal * at).sum(axis=1) - surface[:, 1]
            column = np.maximum(rays.surface[part] - len(self.walls), 0)
            radius = np.append(self.columns[:, 2], 1.0)[column] + self.x[layout.radius[place[part]]]
            shift, outwards = _to_circle(at - surface, direction, radius)
            normal = np.where(wall[:, None], normal, outwards)
            incidence = (normal * direction).sum(axis=1)
            residual = np.where(wall, flat, -shift * incidence)
            # Derivatives where the ray should end, not where noise made it end: residual and lever arm of an oblique ray
            # would hold the same noise, and their product would turn every scan, along a wall always to the same side.
            oblique = np.where(np.abs(incidence) > 0.05, incidence, np.inf)
            ahead = -(residual / oblique)[:, None] * direction
            arm, at = arm + ahead, at + ahead
            # A grazing ray errs along the wall; what the estimator could at best know of it is kept finite.
            sd = rays.sd[part] * np.maximum(np.abs(incidence), 0.05)
            sd = np.where(wall | (np.abs(incidence) > _GRAZING), sd, np.inf)
            rows = np.empty((len(wall), 7))
            rows[:, :2] = normal
            rows[:, 2] = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
            rows[:, 3] = np.where(wall, normal[:, 0] * at[:, 1] - normal[:, 1] * at[:, 0], -normal[:, 0])
            rows[:, 4] = np.where(wall, -1.0, -normal[:, 1])
            rows[:, 5], rows[:, 6] = -incidence, np.where(wall, 0.0, -1.0)
            own = np.stack([layout.offset[place[part]], layout.radius[place[part]]], axis=1)
            columns = np.concatenate([layout.poses[rays.pose[part]], layout.surfaces[place[part]], own], axis=1)
            yield self._rows(columns, rows / sd[:, None]), residual / sd

    def _add_ranges(self, matrix: Floats, gradient: Floats) -> None:
        r, log, layout, model = self.recording, self.log, self.layout, self.recording.settings.radio
        assert log.ranges is not None
        attached = attach_ranges(log.ranges, log.odometry, self.frames, log.mounting)
        known = {name: k for k, name in enumerate(r.plan.anchor_ids[: self.anchors])}
        number = np.array([known[i] for i in log.ranges.anchor_ids])[attached.anchor]
        poses, tag_arm = self.poses(), np.asarray(r.settings.tag)
        height = r.settings.anchor_height - r.settings.tag_height
        own = poses[attached.keyframe]
        arm = se2.rotate(own[:, 2], attached.lever_arm + se2.rotate(attached.turn, tag_arm))
        tag = own[:, :2] + arm
        away = tag - self.x[layout.anchors[number]]
        distance = np.sqrt((away**2).sum(axis=1) + height**2)
        bearing = np.arctan2(-away[:, 1], -away[:, 0])
        heading = own[:, 2] + attached.turn
        wave = [_harmonics(bearing - heading), _harmonics(bearing)]
        body, world = layout.patterns[-1], layout.patterns[number]
        patterns = (wave[0] * self.x[body]).sum(axis=1) + (wave[1] * self.x[world]).sum(axis=1)
        scale = self.x[layout.scale]
        residual = scale * distance + self.x[layout.bias[number]] + patterns - attached.ranges
        unit = scale * away / distance[:, None]
        values = np.concatenate(
            [
                unit, (unit[:, 1] * arm[:, 0] - unit[:, 0] * arm[:, 1])[:, None], -unit, np.ones((len(unit), 1)),
                distance[:, None], *wave,
            ], axis=1,
        )
        columns = np.concatenate(
            [
                layout.poses[attached.keyframe], layout.anchors[number], layout.bias[number][:, None],
                np.full((len(unit), 1), layout.scale), np.broadcast_to(body, (len(unit), _PATTERN)), world,
            ], axis=1,
        )
        if self._excesses is None:
            self._excesses = self._excess(number)
        mean, spread, sound = self._excesses
        for anchor in range(self.anchors):
            rows = np.flatnonzero((number == anchor) & sound)
            if not len(rows):
                continue
            if anchor not in self._range_factors:
                covariance = self._covariance(tag[rows]) + np.diag(model.noise_sd**2 + spread[rows] ** 2)
                self._range_factors[anchor] = cho_factor(covariance, lower=True)
            jacobian = self._rows(columns[rows], values[rows])
            used = np.unique(jacobian.indices)
            dense = jacobian[:, used].toarray()
            weighted = cho_solve(self._range_factors[anchor], np.column_stack([dense, residual[rows] + mean[rows]]))
            matrix[np.ix_(used, used)] += dense.T @ weighted[:, :-1]
            gradient[used] += dense.T @ weighted[:, -1]

    def _covariance(self, tag: Floats) -> Floats:
        """Return the covariance (m, m) of the multipath of one anchor at these places."""
        return np.asarray(sum(sd**2 * _alike(tag, length) for sd, length in self._fields()))

    def _fields(self) -> tuple[tuple[float, float], ...]:
        """Return standard deviation and length, m, of each range error that stays with the place."""
        model = self.recording.settings.radio
        return ((model.multipath_sd, model.multipath_length),) if self.rooms is None else self.rooms.range_fields

    def _excess(self, number: Ints) -> tuple[Floats, Floats, Bools]:
        """Return the mean and the spread of what obstacles add to each range, and which ranges are sound at all."""
        r, rooms, log = self.recording, self.rooms, self.log
        assert log.ranges is not None
        model, stated = r.settings.radio, log.ranges.ranges
        pose = self._at(log.ranges.stamps - r.settings.uwb_delay)
        tag = se2.transform(pose, np.asarray(r.settings.tag))
        hidden = hidden_ranges(r)
        shadow = 0.5 * hidden
        for anchor, place in enumerate(r.anchors):
            own = number == anchor
            shadow[own] += r.plan.opacity * radio.crossings(tag[own], place, r.plan.walls, r.plan.columns)
        heavy = np.isin(number + 1, r.settings.nlos_anchors) if r.settings.nlos_anchors else np.ones(len(number), dtype=bool)
        level = np.where(heavy, radio.NLOS_LEVELS[r.settings.nlos][0], radio.NLOS_LEVELS["normal"][0])
        mean = level * np.minimum(shadow, 2.0)
        variance = (0.8 * mean) ** 2
        way = r.anchors[number] - tag
        if rooms is not None:
            behind = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - pose[:, 2] - np.pi)))
            body = real_rooms.body_delay(rooms, behind)
            person = rooms.person_excess * hidden
            mean, variance = mean + body + person, variance + (real_rooms.BODY_SPREAD * body) ** 2 + person**2
        height = r.settings.anchor_height - r.settings.tag_height
        true = model.scale * np.hypot(np.hypot(*way.T), height) + mean
        parts = [model.noise_sd, self._antenna_sd(), model.bias_sd, *(sd for sd, _ in self._fields())]
        usual = float(np.linalg.norm(parts))
        return mean, np.sqrt(variance), np.abs(stated - true) < 4.0 * usual + 5.0 * np.sqrt(variance)

    def _figures(self, factor: tuple[Floats, bool]) -> OracleFigures:
        layout, poses = self.layout, self.poses()
        motion = align(poses[:, :2], self.truth[:, :2])
        off = se2.transform(motion, poses[:, :2]) - self.truth[:, :2]
        nan = float("nan")
        at, anchors = self.truth[1:, :2], nan
        columns = layout.poses[1:, :2]
        if self.anchors:
            error = se2.transform(motion, self.x[layout.anchors]) - self.recording.anchors
            anchors = float(np.sqrt((error**2).sum(axis=1).mean()))
            columns, at = np.concatenate([columns, layout.anchors]), np.concatenate([at, self.recording.anchors])
        unit = np.zeros((layout.shared, columns.size))
        unit[columns.ravel(), np.arange(columns.size)] = 1.0
        covariance = cho_solve(factor, unit, check_finite=False)[columns.ravel()]
        del unit
        # Expected after alignment: a rigid motion fitted to the poses is taken out of poses and anchors alike.
        rigid = np.zeros((columns.size, 3))
        rigid[0::2, 0] = rigid[1::2, 1] = 1.0
        rigid[0::2, 2], rigid[1::2, 2] = -at[:, 1], at[:, 0]
        path = 2 * (len(poses) - 1)
        onto = rigid @ np.linalg.pinv(rigid[:path])
        left = covariance - onto @ covariance[:path]
        left = left - left[:, :path] @ onto.T
        variance = np.diag(left)
        bound = float(np.sqrt(variance[path:].reshape(-1, 2).sum(axis=1).mean())) if self.anchors else nan
        return OracleFigures(
            float(np.sqrt((off**2).sum(axis=1).mean())), anchors, float(np.sqrt(2.0 * variance[:path].mean())), bound
        )


def step_of(
    whole: sparse.csr_matrix, matrix: Floats, gradient: Floats, shared: int
) -> tuple[tuple[Floats, bool], Floats]:
    """Return the factor of normal equations with surfaces eliminated, and the Gauss-Newton step (size,).

    No two surfaces share a ray: their part of the matrix is made of blocks of four, and goes first.

    Parameters
    ----------
    whole : (size, size) sparse part. matrix : (shared, shared) dense part, which is used up. shared : unknowns before surfaces.
    """
    own = _blocks_of_four(whole[shared:, shared:])
    inverse = sparse.block_diag(np.linalg.inv(own), format="csr") if len(own) else sparse.csr_matrix((0, 0))
    across = whole[shared:, :shared]
    onto = inverse @ across
    matrix += (whole[:shared, :shared] - across.T @ onto).toarray()
    factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
    step = np.zeros(len(gradient))
    step[:shared] = -cho_solve(factor, gradient[:shared] - onto.T @ gradient[shared:], check_finite=False)
    step[shared:] = -(inverse @ gradient[shared:]) - onto @ step[:shared]
    return factor, step


def _blocks_of_four(matrix: sparse.csr_matrix) -> Floats:
    """Return the blocks (s, 4, 4) of a block-diagonal matrix (4s, 4s)."""
    entries, blocks = matrix.tocoo(), np.zeros((matrix.shape[0] // 4, 4, 4))
    blocks[entries.row // 4, entries.row % 4, entries.col % 4] = entries.data
    return blocks


def _between_error(z: Floats, first: Floats, second: Floats) -> Floats:
    return se2.between(z, se2.between(first, second))


def _alike(places: Floats, length: float) -> Floats:
    """Return the correlation (m, m) of a smooth field between places (m, 2), see simulation.fields."""
    squared = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * squared / length**2))


def _to_circle(points: Floats, direction: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """Return how far (m,) points (m, 2) are from a circle about 0 along their rays, and the normals (m, 2) there.

    Along the ray, since beyond its tangent the distance to the circle is no longer proportional to the error of a ray.
    """
    along = (points * direction).sum(axis=1)
    inside = radius**2 - (points**2).sum(axis=1) + along**2
    shift = -along - np.sqrt(np.maximum(inside, 0.0))
    return shift, (points + shift[:, None] * direction) / radius[:, None]


def _in_pieces(rays: _Rays, poses: Floats, walls: Floats, columns: Floats) -> tuple[_Rays, Floats, Floats]:
    """Return rays, walls and columns with every wall cut into pieces of either side, and every column into sectors."""
    own, wall = poses[rays.pose], rays.surface < len(walls)
    at = _hits(rays, own, walls, columns)
    line = walls[np.where(wall, rays.surface, 0)]
    along = (line[:, 2:] - line[:, :2]) / np.hypot(*(line[:, 2:] - line[:, :2]).T)[:, None]
    piece = np.floor(np.maximum(((at - line[:, :2]) * along).sum(axis=1), 0.0) / _PIECE).astype(np.intp)
    behind = (along[:, 0] * (own[:, 1] - line[:, 1]) - along[:, 1] * (own[:, 0] - line[:, 0]) > 0.0).astype(np.intp)
    away = at - columns[np.where(wall, 0, rays.surface - len(walls)), :2] if len(columns) else at
    sector = np.floor(np.arctan2(away[:, 1], away[:, 0]) / (2.0 * np.pi / _SECTORS)).astype(np.intp) % _SECTORS
    part = np.where(wall, 2 * piece + behind, sector)
    many = int(part.max(initial=0)) + 1
    found, surface = np.unique(rays.surface * many + part, return_inverse=True)
    parent = found // many
    of_wall = parent < len(walls)
    return replace(rays, surface=surface), walls[parent[of_wall]], columns[parent[~of_wall] - len(walls)]


def _hits(rays: _Rays, own: Floats, walls: Floats, columns: Floats) -> Floats:
    """Return where (p, 2) the rays from poses (p, 3) meet their surfaces: by noisy points, noise would choose the piece."""
    at, direction = se2.transform(own, rays.points), se2.rotate(own[:, 2], rays.directions)
    wall = rays.surface < len(walls)
    line = walls[np.where(wall, rays.surface, 0)]
    normal = np.stack([line[:, 1] - line[:, 3], line[:, 2] - line[:, 0]], axis=1)
    incidence = (normal * direction).sum(axis=1)
    shift = ((line[:, :2] - at) * normal).sum(axis=1) / np.where(incidence == 0.0, np.inf, incidence)
    if len(columns):
        circle = columns[np.where(wall, 0, rays.surface - len(walls))]
        shift = np.where(wall, shift, _to_circle(at - circle[:, :2], direction, circle[:, 2])[0])
    return at + shift[:, None] * direction


_PIECE = 1.0
"""Length of a piece of wall, m."""
_SECTORS = 8
"""Pieces of a column."""


def _harmonics(angle: Floats) -> Floats:
    """Return cosine and sine of one, two and three times an angle (m, 6)."""
    return np.stack([f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)], axis=1)


def solve(recording: Recording, log: SensorLog, lidar: bool = True, pieces: bool = False) -> OracleFigures:
    """Return what the measurements of a recording allow."""
    return Oracle(recording, log, lidar, pieces).solve()
