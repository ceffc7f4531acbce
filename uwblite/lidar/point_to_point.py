"""Iterative closest point as in the paper: nearest neighbours within a fixed distance, motion in closed form."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Floats, as_array, require_finite, require_shape
from ..config import documented, setting
from .point_cloud import as_points, make_tree


@documented
@dataclass(frozen=True, slots=True)
class IcpConfig:
    """How two clouds are aligned."""

    max_correspondence_distance: float = setting(0.15, above=0.0)
    """m; points farther apart are not matched (the paper's d)."""
    max_iterations: int = setting(50, minimum=1)
    """Most iterations for one pair of clouds."""
    tolerance_translation: float = setting(5e-4, advanced=True)
    """m; a smaller step in both senses ends the iteration."""
    tolerance_rotation: ClassVar[float] = 2.5e-4
    """rad."""
    min_sigma: float = setting(0.01, advanced=True)
    """m; residuals smaller than that do not make the result more certain."""
    min_matches: int = setting(10, minimum=1, advanced=True)
    """A match of fewer pairs of points is rejected."""
    fitness_sigma: float = float("inf")
    """m^2; a match with a greater mean squared distance between nearest points is rejected (the paper's sigma)."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Pose of the source in the target, and its covariance."""

    T_target_source: Floats
    """(3,) m, m, rad; the last iterate where not converged."""
    converged: bool
    """The pose is usable."""
    reason: str
    """Why it stopped, in words."""
    iterations: int
    overlap: float
    """Share of the source points that found a partner, 0..1."""
    rmse: float
    """m, root mean square distance of inliers from their partner."""
    fitness: float
    """m^2, mean squared distance from the source points to the nearest target point, whatever the distance; inf where
    a cloud is empty."""
    information: Floats
    """(3, 3) inverse covariance of the pose in the chart e = between(measured, true) = x, y, theta in the source's
    frame."""


def align(
    target: cKDTree | ArrayLike, source: ArrayLike, T_target_source: ArrayLike = (0.0, 0.0, 0.0),
    config: IcpConfig | None = None,
) -> Registration:
    """Find the pose of the source in the target's frame from an initial guess.

    The motion that minimises the squared distances of matched points is known in closed form (the planar case of Umeyama's
    solution), see se2.align.

    Parameters
    ----------
    target : (m, 2) points, m, or their tree where there are many sources, see make_tree. source : (n, 2) points in their own
        frame, m. T_target_source : (3,) initial guess; m, m, rad.

    Raises
    ------
    DataError : points or guess have another shape, or are not finite.
    """
    config = config or IcpConfig()
    target = target if isinstance(target, cKDTree) else make_tree(as_points(target, "target"))
    source, pose = as_points(source, "source"), as_array(T_target_source, "T_target_source").copy()
    require_shape(pose, "T_target_source", se2.POSE)
    require_finite(pose, "T_target_source")
    for name, size in (("target", target.n), ("source", len(source))):
        if size < config.min_matches:
            return _failure(pose, f"the {name} has {size} points, fewer than {config.min_matches}")
    bound = np.nextafter(config.max_correspondence_distance, np.inf)
    small, iteration = False, 0
    while not small and iteration < config.max_iterations:
        iteration += 1
        index = target.query(se2.transform(pose, source), distance_upper_bound=bound)[1]
        matched = index < target.n
        if matched.sum() < config.min_matches:
            reason = f"no overlap: {matched.sum()} of {len(source)} source points have a partner"
            pose[2] = se2.wrap_angle(pose[2])
            return replace(_failure(pose, reason), iterations=iteration, overlap=float(matched.mean()))
        near, far = source[matched], target.data[index[matched]]
        before, pose = pose, se2.align(near, far)
        way, turn = np.hypot(*(pose - before)[:2]), abs(se2.wrap_angle(pose[2] - before[2]))
        small = bool(way <= config.tolerance_translation and turn <= config.tolerance_rotation)
    pose[2] = se2.wrap_angle(pose[2])
    fitness, converged, reason = fitness_score(target, source, pose), small, "step below tolerance"
    if not small:
        reason = f"stopped after {iteration} iterations, still moving"
    elif fitness > config.fitness_sigma:
        converged, reason = False, f"fitness score {fitness:.3g} m2 above {config.fitness_sigma:.3g} m2"
    square = float(np.sum((se2.transform(pose, near) - far) ** 2))
    variance = max(square / max(2 * len(near) - len(pose), 1), config.min_sigma**2)
    return Registration(
        T_target_source=pose, converged=converged, reason=reason, iterations=iteration,
        overlap=len(near) / len(source), rmse=float(np.sqrt(square / len(near))), fitness=fitness,
        information=_information(near) / variance,
    )


def fitness_score(target: cKDTree, points: Floats, T_target_source: Floats) -> float:
    """Return the mean squared distance, m^2, from source points (m, 2) to the nearest target points; inf without any."""
    if target.n == 0 or len(points) == 0:
        return float("inf")
    return float(np.mean(target.query(se2.transform(T_target_source, points))[0] ** 2))


def _failure(pose: Floats, reason: str) -> Registration:
    return Registration(pose, False, reason, 0, 0.0, float("inf"), float("inf"), np.zeros((len(pose), len(pose))))


def _information(points: Floats) -> Floats:
    """Return sum J^T J (3, 3) over source points (m, 2); by e = between(measured, true), J = R [1, perp(s)] and R^T R = 1."""
    x, y = points.T
    one, zero = np.ones(len(points)), np.zeros(len(points))
    jacobian = np.concatenate([np.column_stack([one, zero, -y]), np.column_stack([zero, one, x])])
    return np.asarray(jacobian.T @ jacobian)
