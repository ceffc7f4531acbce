"""Iterative closest point: the pose of one cloud in another, how well it is known, and why it is not.

``point_to_line`` (the default) minimises distances across the lines of the target under a robust kernel: a coarse
stage on a part of the points, whose gate shrinks, brings the clouds together; a fine stage on all points finishes.
``point_to_point`` is the paper's plain ICP: nearest neighbours within a fixed distance, closed-form motion.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from .. import se2
from ..arrays import Floats
from ..config import setting
from ..graph.robust import Kernel
from .line_factor import (
    CAUCHY,
    LineFactor,
    LineFactorConfig,
    LineRows,
    line_rows,
    line_system,
    source_rows,
    trusted_part,
    trusted_step,
)
from .point_cloud import PointCloud

_COARSE_TOLERANCE = 10.0
"""The coarse stage hands over at steps so many times the tolerance."""
_GATE_SHRINK = 0.6
"""Per iteration of the coarse stage."""
_LEAST_REACH = 0.15
"""m; a finer table of nearest points is larger and no better."""
_CELLS_PER_REACH = 3
_MOST_SCORED = 250
"""Source points whose nearest neighbours make the fitness score of point_to_line."""


@dataclass(frozen=True, slots=True)
class IcpConfig:
    """How two clouds are aligned."""

    method: Literal["point_to_line", "point_to_point"] = setting("point_to_line", advanced=True)
    """point_to_point is the paper's; it knows neither lines nor corridors."""
    max_correspondence_distance: float = setting(0.15, above=0.0)
    """m; points farther apart are no pair (the paper's d)."""
    max_iterations: int = setting(50, minimum=1)
    """Of all stages together."""
    tolerance_translation: float = setting(5e-4, advanced=True)
    """m; a smaller step in both senses ends the iteration."""
    tolerance_rotation: ClassVar[float] = 2.5e-4
    """rad."""
    coarse_distance: float = setting(1.0, advanced=True)
    """m; gate of the first iteration of point_to_line, from which it shrinks to max_correspondence_distance: about the
    error of the initial guess. No larger than that distance = no coarse stage."""
    coarse_stride: ClassVar[int] = 4
    """The coarse stage takes every so-many-th point."""
    sigma: float = setting(0.02, above=0.0, advanced=True)
    """m, standard deviation of a point about a line by the noise of both clouds; scale of the kernel. (The coarse
    stage widens it with the gate.)"""
    min_sigma: float = setting(0.01, advanced=True)
    """m; residuals smaller than that do not make the result more certain."""
    kernel: Kernel = setting(CAUCHY, advanced=True)
    """On residual / sigma; point_to_line only."""
    max_normal_angle: ClassVar[float] = 0.8
    """rad; points whose normals differ by more are no pair, nor are the two sides of a wall; point_to_line only."""
    degeneracy: ClassVar[float] = 2.0
    """Multiple of the information feigned by scattering normals that a direction must exceed to be measured;
    point_to_line only."""
    min_matches: int = setting(10, minimum=1, advanced=True)
    """Fewer pairs are no registration."""
    fitness_sigma: float = float("inf")
    """m^2; a fitness score above it is no registration (the paper's sigma)."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Where the source lies in the target, and how far to trust that."""

    T_target_source: Floats
    """(3,) m, m, rad; the last iterate where not converged."""
    converged: bool
    """The pose is usable."""
    reason: str
    """Why it stopped, in words."""
    iterations: int
    """Of all stages."""
    num_inliers: int
    """Source points that found a partner."""
    overlap: float
    """num_inliers / number of source points, 0..1."""
    rmse: float
    """m, root mean square distance of inliers from their partner: its line, or the point."""
    fitness: float
    """m^2, mean squared distance from the source points to the nearest target point, whatever the distance; inf where
    a cloud is empty. (point_to_line: of every coarse_stride-th source point, a few hundred at most.)"""
    information: Floats
    """(3, 3) inverse covariance of the pose in the chart e = between(measured, true) = x, y, theta in the source's
    frame; zero in directions that were not measured."""
    weak_sigma: float
    """m, standard deviation of the least known translation; inf where it is not known at all."""
    weak_direction: Floats
    """(2,) unit vector of that translation, target frame."""


def align(
    target: PointCloud, source: PointCloud, T_target_source: Floats, config: IcpConfig | None = None
) -> Registration:
    """Find the pose of the source in the target's frame from an initial guess.

    Parameters
    ----------
    target, source : clouds, each in its own frame.
    T_target_source : (3,) initial guess; m, m, rad.
    config : defaults where None.
    """
    config = config or IcpConfig()
    guess = np.array(T_target_source, dtype=np.float64)
    for name, cloud in (("target", target), ("source", source)):
        if len(cloud) < config.min_matches:
            return _failure(guess, f"the {name} has {len(cloud)} points, fewer than {config.min_matches}", source)
    run = _align_lines if config.method == "point_to_line" else _align_points
    return run(target, source, guess, config)


def fitness_score(target: PointCloud, points: Floats, T_target_source: Floats) -> float:
    """Return the mean squared distance, m^2, from source points (m, 2) to the nearest target points; inf without any."""
    if len(target) == 0 or len(points) == 0:
        return float("inf")
    distance = target.tree.query(se2.transform(T_target_source, points))[0]
    return float(np.mean(distance**2))


def _failure(pose: Floats, reason: str, source: PointCloud, iterations: int = 0, matches: int = 0) -> Registration:
    return Registration(
        T_target_source=pose, converged=False, reason=reason, iterations=iterations, num_inliers=matches,
        overlap=matches / max(len(source), 1), rmse=float("inf"), fitness=float("inf"), information=np.zeros((3, 3)),
        weak_sigma=float("inf"), weak_direction=np.array([1.0, 0.0]),
    )


def _no_overlap(pose: Floats, source: PointCloud, iterations: int, matches: int) -> Registration:
    reason = f"no overlap: {matches} of {len(source)} source points have a partner"
    return _failure(pose, reason, source, iterations, matches)


def _small(step: Floats, config: IcpConfig, factor: float = 1.0) -> bool:
    return bool(
        np.hypot(step[0], step[1]) <= factor * config.tolerance_translation
        and abs(step[2]) <= factor * config.tolerance_rotation
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """Where a stage of point_to_line ended."""

    pose: Floats
    rows: LineRows
    system: LineFactor
    iterations: int
    small: bool
    """The last step was below the tolerance."""


def _descend(
    target: PointCloud, rows: Floats, pose: Floats, config: IcpConfig, two_sided: bool, *,
    gate: float, stride: int, tolerance: float, budget: int,
) -> _Descent:
    """Iterate associate, linearise, step; the gate shrinks to max_correspondence_distance."""
    raster, last = target.raster(max(gate, _LEAST_REACH), stride, _CELLS_PER_REACH), config.max_correspondence_distance
    rows = np.ascontiguousarray(rows[:, ::stride])
    for iteration in range(1, budget + 1):
        final = gate <= last
        # What lies far off before the clouds meet is not yet an outlier: the kernel widens with the gate.
        sigma = config.sigma * max(1.0, gate / last)
        settings = LineFactorConfig(gate, sigma, config.kernel, config.max_normal_angle)
        matched = line_rows(target, raster, rows, pose, settings, two_sided)
        system = line_system(matched, settings)
        small, enough = False, system.matched * stride >= config.min_matches
        if enough:
            step = trusted_step(system.information, system.feigned, system.gradient, config.degeneracy)
            pose = pose + step
            small = final and _small(step, config, tolerance)
        if not enough or small or iteration == budget:
            break
        gate = max(last, gate * _GATE_SHRINK)
    return _Descent(pose, matched, system, iteration, small)


def _align_lines(target: PointCloud, source: PointCloud, guess: Floats, config: IcpConfig) -> Registration:
    rows, two_sided = source_rows(source.centers, source.normals), not (target.oriented and source.oriented)
    pose, used = guess, 0
    if config.coarse_distance > config.max_correspondence_distance:
        coarse = _descend(
            target, rows, pose, config, two_sided, gate=config.coarse_distance, stride=config.coarse_stride,
            tolerance=_COARSE_TOLERANCE, budget=max(1, config.max_iterations // 2),
        )
        pose, used = coarse.pose, coarse.iterations
    end = _descend(
        target, rows, pose, config, two_sided, gate=config.max_correspondence_distance, stride=1, tolerance=1.0,
        budget=max(1, config.max_iterations - used),
    )
    matches, used, pose = end.system.matched, used + end.iterations, _wrapped(end.pose)
    weight = float(np.sum(end.rows.weight))
    if matches < config.min_matches or weight == 0.0:
        return _no_overlap(pose, source, used, matches)
    trusted = trusted_part(end.system.information, end.system.feigned, config.degeneracy)
    square = end.rows.residual**2
    # Neighbouring means share their noise: so many of them tell as much as one point.
    shared = float(np.sum(end.rows.matched * source.neighbours)) / matches
    variance = float(np.sum(end.rows.weight * square)) / weight * shared
    information = trusted * config.sigma**2 / max(variance, config.min_sigma**2)
    scored = source.points[:: max(config.coarse_stride, len(source) // _MOST_SCORED)]
    fitness = fitness_score(target, scored, pose)
    rmse = float(np.sqrt(np.sum(square) / matches))
    return _result(source, pose, end.small, used, matches, rmse, fitness, information, config)


def _align_points(target: PointCloud, source: PointCloud, pose: Floats, config: IcpConfig) -> Registration:
    """Align by nearest neighbours: the motion that minimises their squared distances is known in closed form.

    With a, b the matched points less their means, theta = atan2(sum a x b, sum a . b) and t follows from the means
    (the planar case of Umeyama's solution).
    """
    distance, small, iteration = config.max_correspondence_distance, False, 0
    bound = np.nextafter(distance, np.inf)
    while not small and iteration < config.max_iterations:
        iteration += 1
        moved = se2.transform(pose, source.points)
        index = target.tree.query(moved, distance_upper_bound=bound)[1]
        matched = index < len(target)
        if matched.sum() < config.min_matches:
            return _no_overlap(_wrapped(pose), source, iteration, int(matched.sum()))
        near, far = source.points[matched], target.points[index[matched]]
        mean_near, mean_far = near.mean(axis=0), far.mean(axis=0)
        a, b = near - mean_near, far - mean_far
        theta = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
        new = np.append(mean_far - se2.rotate(theta, mean_near), theta)
        step = np.append(new[:2] - pose[:2], se2.wrap_angle(new[2] - pose[2]))
        pose, small = new, _small(step, config)
    difference = se2.transform(pose, near) - far
    square = float(np.sum(difference**2))
    # By e = between(measured, true) a point's residual has the Jacobian R [1, perp(s)], and R^T R = 1.
    jacobian = np.zeros((len(near), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -near[:, 1], near[:, 0]
    variance = max(square / max(2 * len(near) - 3, 1), config.min_sigma**2)
    information = np.einsum("nij,nik->jk", jacobian, jacobian) / variance
    fitness = fitness_score(target, source.points, pose)
    rotation = _chart(pose)
    information = rotation @ information @ rotation.T
    rmse = float(np.sqrt(square / len(near)))
    return _result(source, _wrapped(pose), small, iteration, len(near), rmse, fitness, information, config)


def _wrapped(pose: Floats) -> Floats:
    return np.append(pose[:2], se2.wrap_angle(pose[2]))


def _chart(pose: Floats) -> Floats:
    """Return A = diag(R, 1): a small e = between(pose, new) is A^T (new - pose)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _result(
    source: PointCloud, pose: Floats, small: bool, iterations: int, matches: int, rmse: float, fitness: float,
    information: Floats, config: IcpConfig,
) -> Registration:
    """Collect the result; information (3, 3) is by the coordinates x, y, theta of the pose."""
    weak_sigma, weak_direction = _weakest(information)
    converged, reason = small, "step below tolerance"
    if not small:
        reason = f"stopped after {iterations} iterations, still moving"
    elif fitness > config.fitness_sigma:
        converged, reason = False, f"fitness score {fitness:.3g} m2 above {config.fitness_sigma:.3g} m2"
    chart = _chart(pose)
    return Registration(
        T_target_source=pose, converged=converged, reason=reason, iterations=iterations, num_inliers=matches,
        overlap=matches / len(source), rmse=rmse, fitness=fitness, information=chart.T @ information @ chart,
        weak_sigma=weak_sigma, weak_direction=weak_direction,
    )


def _weakest(information: Floats) -> tuple[float, Floats]:
    """Return sigma, m, and direction of the least known translation, whatever the heading."""
    turn = information[2, 2]
    known = information[:2, :2] - (np.outer(information[:2, 2], information[2, :2]) / turn if turn > 0.0 else 0.0)
    values, vectors = np.linalg.eigh(known)
    sure = values[0] > 1e-9 * max(values[1], 1.0)
    return float(1.0 / np.sqrt(values[0])) if sure else float("inf"), np.asarray(vectors[:, 0])
