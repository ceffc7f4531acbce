"""Odometry edges, their noise and the scale of their turns, from the settings and from the recording."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .. import se2
from ..arrays import BEYOND_NOISE, MAD_TO_SIGMA, MOST, TINY, Bools, Floats, Ints, spread, weighted_median
from ..config import setting
from ..graph.calibration import CalibrationConfig, odometry_indices
from ..graph.graph import Calibration, Graph, edge_weights
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..graph.robust import Kernel
from ..sensor_log import Odometry
from .keyframes import Keyframes

_ENOUGH = 40
"""Least number of steps from which a noise or a scale is learnt."""
_LEAST_FACTOR = 0.1
"""Least factor on a standard deviation of wheels, and the inverse of the largest."""


@dataclass(frozen=True, slots=True)
class OdometryNoiseConfig:
    """Random errors of the wheels; systematic ones are calibrated."""

    distance: float = 0.018
    """Standard deviation of position along and across after one metre, m; grows with the square root of the distance."""
    heading_per_metre: float = 0.008
    """Standard deviation of heading after one metre, rad; grows with the square root of the distance."""
    heading_per_turn: float = 0.03
    """Standard deviation of heading after one radian of turning, rad; grows with the square root of the angle."""
    standing: float = 0.0005
    """Standard deviation of position (m) and heading (rad) of a robot that stands."""
    kernel: Kernel = setting(Kernel("cauchy", 5.0), advanced=True)
    """Robust kernel: a step that slipped must not bend the rest; none = squared errors (the paper)."""


def wheel_edges(keyframes: Keyframes, config: OdometryNoiseConfig, calibration: Calibration) -> OdometryEdges:
    """Return the edges between consecutive keyframes of one recording."""
    n = len(keyframes) - 1
    by_path = np.array([config.distance, config.distance, config.heading_per_metre]) ** 2 * keyframes.path[:, None]
    by_turn = np.array([0.0, 0.0, config.heading_per_turn]) ** 2 * keyframes.turned[:, None]
    variance = config.standing**2 + by_path + by_turn + keyframes.slack**2
    return OdometryEdges(
        np.arange(n),
        np.arange(1, n + 1),
        keyframes.motion,
        keyframes.length,
        drift_time(keyframes),
        variance[:, None] ** -0.5 * np.eye(variance.shape[1]),
        odometry_indices(calibration, n),
        kernel=config.kernel,
    )


def sideways_priors(odometry: Odometry, priors: CalibrationConfig) -> CalibrationConfig:
    """Return the priors of the calibration without those of sideways motion where the odometry has hardly any."""
    steps = odometry.steps
    aside = se2.rotate(-steps[:, 2] / 2.0, steps[:, :2])[:, 1]
    if np.abs(aside).sum() > _OMNI * np.hypot(steps[:, 0], steps[:, 1]).sum():
        return priors
    return replace(priors, sideways_scale=0.0, sideways_per_metre=0.0, ahead_per_sideways=0.0)


_OMNI = 0.1
"""Share of sideways motion from which on wheels drive sideways; rounding and slow clocks cause a small share in any."""


def drift_time(keyframes: Keyframes) -> Floats:
    """Return the time (k-1,) of each step in which its heading drifts, s: a log that pauses for an hour drifts one second."""
    return np.where(keyframes.slack[:, 2] > 0.0, np.minimum(keyframes.duration, 1.0), keyframes.duration)


def reestimate_wheel_noise(wheels: OdometryEdges, steps: RelativePoseEdges, graph: Graph) -> OdometryEdges:
    """Scale the wheels' noise along, across and in heading so that it explains their differences from measured steps.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    steps : steps between neighbouring poses that the lidar measured. Directions that a step does not see do not count, nor
        those that it measures much worse than the wheels do, where these differ by much more.
    """
    if len(steps) < _ENOUGH:
        return wheels
    own = np.searchsorted(wheels.i, steps.i)
    off = se2.between(steps.T_i_j, wheels.corrected(graph)[own]) / wheels.own_scale(graph)[own]
    off = np.einsum("eij,ej->ei", wheels.end_sqrt_information[own], off)
    information = np.swapaxes(steps.sqrt_information, 1, 2) @ steps.sqrt_information
    covariance = np.linalg.pinv(information, rcond=TINY, hermitian=True)
    seen = np.einsum("eij,eji->ei", covariance, information) > MOST
    in_wheels = wheels.end_sqrt_information[own]
    sigma = np.sqrt(np.einsum("eij,ejk,eik->ei", in_wheels, covariance, in_wheels))
    well, factor = seen & (sigma < _MUCH_WORSE), np.ones(off.shape[1])
    for k in np.flatnonzero(well.sum(axis=0) >= _ENOUGH):
        by_all, by_best = (_growing(off[some[:, k], k], own[some[:, k]]) for some in (seen, well))
        factor[k] = np.clip(by_all if by_all < _ALIKE * by_best else by_best, _LEAST_FACTOR, 1.0 / _LEAST_FACTOR)
    return replace(wheels, sqrt_information=wheels.sqrt_information / factor)


_MUCH_WORSE, _ALIKE = 6.0, 2.0
"""Ratio of a measured step's standard deviation to that of the wheels, from which on their difference may show its errors; it
does where the noise by all steps is so many times that by the better ones."""


def _growing(off: Floats, step: Ints) -> float:
    """Return the robust standard deviation of differences (m,) of steps (m,) by how it grows with the way.

    Errors of wheels add up. That of one cloud's pose, or of its stamp, is in the steps before and after it with opposite signs.
    So the sum over n following steps has n times the variance of the wheels or more, and the least quotient of all n is the
    nearest to it (the slope of a variogram, without its nugget).
    """
    begins = np.flatnonzero(np.diff(step, prepend=-2) != 1)
    place = np.arange(len(step)) - np.repeat(begins, np.diff(np.append(begins, len(step))))
    least = spread(off)
    for n in _SUMS:
        number = np.cumsum(place % n == 0) - 1
        sums = np.bincount(number, off)[np.bincount(number) == n]
        if len(sums) >= _ENOUGH // 2:
            least = min(least, spread(sums) / np.sqrt(n))
    return float(least)


_SUMS = (2, 4, 8)
"""Numbers of following steps whose differences are summed: up to two metres, over which errors of the floor are alike."""


def stamp_jitter(wheels: OdometryEdges, steps: RelativePoseEdges, graph: Graph) -> float:
    """Return the standard deviation of the scans' stamps, s, by what they add to one step and take from the next.

    A stamp late by t between two steps, at a turn rate w, changes the turns by the wheels over them by w t and -w t. So the
    residuals r and s of steps that turn alike have var((r - s) / w) - var((r + s) / w) = 4 var(t). Where few steps leave that
    open, the expected variance counts: the mean of a normal distribution that is cut off at 0.

    Parameters
    ----------
    wheels : edges between neighbouring poses. steps : steps between neighbouring poses that the lidar measured.
    """
    own = np.searchsorted(wheels.i, steps.i)
    turn = wheels.corrected(graph)[own, 2]
    off, rate = se2.wrap_angle(steps.T_i_j[:, 2] - turn), turn / np.maximum(wheels.duration[own], TINY)
    alike = np.minimum(turn[1:] * turn[:-1], np.minimum(turn[1:] ** 2, turn[:-1] ** 2)) > _TURNING**2
    first = np.flatnonzero(alike & (np.diff(steps.i) == 1))
    if len(first) < _ENOUGH // 2:
        return 0.0
    mean = 0.5 * (rate[first] + rate[first + 1])
    apart, together = (spread((off[first] + sign * off[first + 1]) / mean) for sign in (-1.0, 1.0))
    variance, error = 0.25 * (apart**2 - together**2), 0.25 * np.hypot(apart**2, together**2) * np.sqrt(_OF_SPREAD / len(first))
    z = max(float(variance / max(error, TINY)), -_SURELY)
    density, below = math.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi), 0.5 * math.erfc(-z / math.sqrt(2.0))
    return float(np.sqrt(error * (z + density / below)))


_SURELY = 30.0
"""Standard deviations below 0 beyond which nothing is left of a normal distribution cut off at 0."""
_OF_SPREAD = 5.44
"""Variance of the square of a robust standard deviation of n values, by its fourth power and by 1 / n: 4 of 1.36 / n."""


def by_stamps(wheels: OdometryEdges, graph: Graph, jitter: float) -> Floats:
    """Return the covariance (e, 3, 3) of steps between scans whose stamps err, by x, y and heading in the frame of pose i.

    A late stamp adds what the robot moves meanwhile. At a scan it moves as over the step before or the one after: a robot that
    turns back within a step turns fast at both ends of it.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses. jitter : standard deviation of the stamps, s.
    """
    if not len(wheels):
        return np.zeros((0, 3, 3))
    motion = wheels.corrected(graph)
    # However late, it adds no more than the step's own motion.
    late = se2.log(motion) * (jitter / np.maximum(wheels.duration, max(jitter, TINY)))[:, None]
    over = late[:, :, None] * late[:, None, :]
    # Of the ends of a recording one neighbour is unknown.
    follows = (wheels.i[1:] == wheels.j[:-1])[:, None, None]
    earlier = np.concatenate([over[:1], np.where(follows, over[:-1], over[1:])])
    later = np.concatenate([np.where(follows, over[1:], over[:-1]), over[-1:]])
    # A turn before the step turns the whole step.
    before, after = np.tile(np.eye(motion.shape[1]), (len(motion), 1, 1)), se2.rotation(motion[:, 2])
    before[:, 0, 2], before[:, 1, 2] = -motion[:, 1], motion[:, 0]
    both = (matrix @ part @ np.swapaxes(matrix, 1, 2) for matrix, part in ((before, earlier + over), (after, over + later)))
    return np.asarray(0.5 * sum(both))


def displaced(off: Floats) -> Bools:
    """Return which scans (k - 1,) between two steps, of which each is off by (k, 3), m, m, rad, are alone displaced.

    What is left in the sum of both steps is at most half of either; a turn moves what a scan sees, two metres away.
    """
    off = off * np.array([1.0, 1.0, 2.0])
    limit = BEYOND_NOISE * MAD_TO_SIGMA * float(np.linalg.norm(np.median(np.abs(off), axis=0)))
    into, out = off[:-1], off[1:]
    least = np.minimum(np.linalg.norm(into, axis=1), np.linalg.norm(out, axis=1))
    return np.asarray((least > limit) & (np.linalg.norm(into + out, axis=1) < 0.5 * least))


def noise_at(graph: Graph, wheels: OdometryEdges, certainty: Floats) -> OdometryEdges:
    """Return the wheels with the noise that their residuals show at poses that a lidar determines.

    A patch of floor causes the same error in all steps on it, so that errors of sums of steps grow faster than with the square
    root of the distance: the greater of both variances counts. Poses err too, and follow the wheels by their weight: an error
    with variance w, assumed as 1, and a measurement with variance v leave a residual with (w + v) / (1 + v)^2.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    certainty : (n, 3, 3) information of each pose, x, y, theta in the map, by measurements other than the wheels.
    """
    if len(wheels) < _SUMS[-1]:
        return wheels
    frame, covariance = se2.rotation(graph.poses[:, 2]), np.linalg.inv(certainty + _UNKNOWN * np.eye(certainty.shape[1]))
    of_pose = np.einsum("nia,nij,nja->na", frame, covariance, frame)
    root = np.einsum("eii->ei", wheels.sqrt_information) / wheels.own_scale(graph)
    ends, roots = (np.pad(np.cumsum(v, axis=0), ((1, 0), (0, 0))) for v in (wheels.residuals(graph), root))
    variances = np.full((2, root.shape[1]), np.nan)
    for variance, n in zip(variances, (1, _SUMS[-1]), strict=True):
        # Windows that cross the boundary of two recordings are excluded.
        first = np.flatnonzero(wheels.j[n - 1 :] - wheels.i[: len(wheels) - n + 1] == n)
        summed, mean = (ends[first + n] - ends[first]) / np.sqrt(n), (roots[first + n] - roots[first]) / n
        added = (of_pose[wheels.i[first]] + of_pose[wheels.j[first + n - 1]]) * mean**2 / n
        good = added < 1.0  # known better than by the wheels
        for k in np.flatnonzero(good.sum(axis=0) >= _ENOUGH):
            own = added[good[:, k], k]
            variance[k] = spread(summed[good[:, k], k] * (1.0 + own)) ** 2 - np.median(own)
    factor = np.sqrt(np.clip(variances.max(axis=0), _LEAST_FACTOR**2, _LEAST_FACTOR**-2))
    return replace(wheels, sqrt_information=wheels.sqrt_information / np.where(np.isnan(factor), 1.0, factor))


_UNKNOWN = 1e-3
"""Information of a pose that nothing measures, 1/m^2 and 1/rad^2."""


def variance_factors(graph: Graph, wheels: OdometryEdges, sound: Floats, before: Floats) -> Floats:
    """Return the factors (3,) on the assumed variances of wheels along, across and in heading that their residuals ask for.

    The squared residuals of right variances add up to the redundancy of the steps (W. Foerstner, Ein Verfahren zur Schaetzung
    von Varianz- und Kovarianzkomponenten, 1979). The assumed variances count as much as _ASSUMED_COUNTS redundant steps.

    Parameters
    ----------
    graph : at its optimum, with all edges. wheels : of them. sound : (e,) probability that the wheels did not slip.
    before : (3,) factors in use.
    """
    squared = (edge_weights(wheels, graph) * sound) @ wheels.residuals(graph) ** 2
    found = (_ASSUMED_COUNTS + before * squared) / (_ASSUMED_COUNTS + redundancy(graph, wheels, sound))
    return np.asarray(np.clip(found, _LEAST_FACTOR**2, _LEAST_FACTOR**-2))


_ASSUMED_COUNTS = 4.0
"""Standard deviations that are assumed are right but for a factor of 1.4, as those learnt from four steps are."""


def redundancy(graph: Graph, wheels: OdometryEdges, sound: Floats) -> Floats:
    """Return how many (3,) of the steps along, across and in heading all other measurements of a graph show as well.

    It is the trace of a matrix as large as there are steps, estimated by vectors of unrelated signs, those of chirps (M.
    Hutchinson, A stochastic estimator of the trace, 1989).
    """
    from ..graph.marginals import added_unknown  # loads scipy, which a check of a recording does without

    phase = np.outer(np.arange(1, _PROBES + 1), np.arange(len(wheels)) ** 2) * _GOLDEN
    directions = wheels.motion.shape[1]
    shifts = np.einsum("ke,e,cd->cked", np.where(phase % 1.0 < 0.5, -1.0, 1.0), np.sqrt(sound), np.eye(directions))
    unknown = added_unknown(graph, wheels, shifts.reshape(-1, *shifts.shape[2:]))[1]
    return np.asarray(np.mean(unknown.reshape(directions, -1) ** -2.0, axis=1))


_PROBES = 8
"""Vectors of signs."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Rate at which the frequency of the first chirp grows: no ratio is farther from all fractions."""


_TURNING = 0.1
"""rad; steps that turn by less, on average of lidar and wheels, do not show a ratio."""
_PARTS = 8
"""Of a recording, equal in turning steps, whose scales are compared."""
_SAME = 0.05
"""Difference of scales that floors and tyres explain."""


class TurnScale(NamedTuple):
    """Relative error of the turns of one recording's wheels, measured by the lidar from step to step."""

    value: float
    """Turn by the lidar / turn by the wheels - 1, 1: what ``heading_scale`` should be."""
    sigma: float
    """Standard deviation, by the scatter of the parts, 1."""

    def contradicts(self, heading_scale: float) -> bool:
        """Return whether a scale from the whole estimate cannot be that of the steps."""
        return abs(heading_scale - self.value) > max(BEYOND_NOISE * self.sigma, _SAME)


def turn_scales(wheels: OdometryEdges, steps: ScanEdges, graph: Graph) -> dict[int, TurnScale]:
    """Return the scale of turns by the position of its ``heading_scale`` in the calibration block.

    A single turn that the wheels missed would have a squared influence in least squares. The ratio of two noisy turns is the
    direction of the vector (wheels, lidar), whose weighted median over the steps favours neither.

    Parameters
    ----------
    wheels : edges between consecutive keyframes. steps : scan edges; those between consecutive keyframes count.
    graph : its calibration holds the drifts per metre and per second.
    """
    row, lidar = _neighbours(wheels, steps)
    drift = np.append(graph.calibration.values, 0.0)[wheels.calibration[row, 2:4]]
    turned = wheels.motion[row, 2] + drift[:, 0] * wheels.length[row] + drift[:, 1] * wheels.duration[row]
    # Wheels that count nothing at all stand still or are broken: this is no scale error.
    clear = (np.abs(turned) + np.abs(lidar) > 2.0 * _TURNING) & np.any(wheels.motion[row] != 0.0, axis=1)
    of_recording = wheels.calibration[row, 1]
    found = {}
    for index in np.unique(of_recording[clear & (of_recording >= 0)]).tolist():
        own = clear & (of_recording == index)
        if own.sum() >= _ENOUGH:
            found[index] = _scale(lidar[own], turned[own])
    return found


def _neighbours(wheels: OdometryEdges, steps: ScanEdges) -> tuple[Ints, Floats]:
    """Return the rows (s,) of the wheels' edges that scan edges measure as well, in their order, and turns (s,), rad."""
    own = np.flatnonzero(np.abs(steps.i - steps.j) == 1)
    first = np.minimum(steps.i, steps.j)[own]
    row = np.minimum(np.searchsorted(wheels.i, first), len(wheels) - 1)
    same = wheels.i[row] == first
    turned = np.where(steps.j > steps.i, steps.T_i_j[:, 2], -steps.T_i_j[:, 2])[own]
    order = np.argsort(row[same], kind="stable")
    return row[same][order], turned[same][order]


def _scale(lidar: Floats, wheels: Floats) -> TurnScale:
    """Return the scale of turning steps (s,) in the order of time."""
    weight, direction, centre = np.hypot(lidar, wheels), np.arctan2(lidar, wheels), np.arctan(1.0)
    for _ in range(2):
        # Left and right turns give one direction, known up to half a turn.
        direction = centre + se2.wrap_angle(2.0 * (direction - centre)) / 2.0
        centre = weighted_median(direction, weight)
    parts = np.array_split(np.arange(len(weight)), _PARTS)
    scatter = np.std([weighted_median(direction[part], weight[part]) for part in parts], ddof=1)
    return TurnScale(float(np.tan(centre)) - 1.0, float((1.0 + np.tan(centre) ** 2) * scatter / np.sqrt(_PARTS)))
