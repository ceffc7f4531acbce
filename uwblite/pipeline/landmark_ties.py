"""Measured distances between landmarks (columns, corners) as constraints on the poses that see them.

A landmark is a place in the map before its distances are used. It is fixed to keyframes with points there: of each visit, the
keyframe with most of these points keeps the landmark's place in its own frame. A measured distance constrains each
visit of one landmark against each visit of the other, so that walls, odometry and calibration adapt to it; all these edges
together have the weight of the one measurement.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints
from ..constraints import Constraints, GivenLandmark
from ..errors import ConfigError
from ..graph.distance_edges import PointDistanceEdges
from ..graph.graph import Graph
from ..graph.solver import optimize
from ..lidar.clouds import Clouds
from ..lidar.columns import Landmarks, find_columns, fit_circle
from ..problem.solution import rough
from . import map_frame
from .estimate import Estimate, Task
from .lidar_stages import refine_jointly, solve_by_own_errors

_NEAR = 0.4
"""Points count as the landmark's when they lie so near to its place, or to the rim of its column, m."""
_LEAST_POINTS = 3
"""Least number of points of a cloud that make an observation."""
_ONE_VISIT = 3.0
"""Observations belong to one visit while less than this is travelled between two, m."""
_VISITS = 4
"""Visits used of a landmark, those with most points."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Where a landmark stands, seen from some keyframes."""

    keyframe: Ints
    """(v,) one of each visit."""
    position: Floats
    """(v, 2) m, in the frame of that keyframe."""


def observations(landmark: GivenLandmark, clouds: Clouds, poses: Floats, path: Floats) -> Observations:
    """Find the keyframes that see a landmark.

    Parameters
    ----------
    landmark : its place, in the frame of the poses.
    path : (k,) m travelled.

    Raises
    ------
    ConfigError : no cloud has anything there, or no column of that radius.
    """
    points = se2.transform_each(poses, clouds.owner, clouds.points)
    place = np.array(landmark.position)
    near = np.hypot(*(points - place).T) < landmark.radius + _NEAR
    where = f"constraints: landmark {landmark.name!r} at {place[0]:g}, {place[1]:g}"
    if landmark.radius > 0.0:
        column = Landmarks((landmark.name,), place[None], np.array([landmark.radius]))
        place = find_columns(points[near], column, search_radius=_NEAR, cell=0.05).positions[0]
        if not np.isfinite(place).all():
            raise ConfigError(f"{where}: no column of radius {landmark.radius:g} m stands there; look up its place in the map")
    count = np.bincount(clouds.owner[near], minlength=len(poses))
    seen = np.flatnonzero(count >= _LEAST_POINTS)
    if not len(seen):
        raise ConfigError(f"{where}: the lidar saw nothing within {_NEAR:g} m of it; look up its place in the map")
    visit = np.cumsum(np.concatenate([[0], np.diff(path[seen]) > _ONE_VISIT]))
    weight = np.bincount(visit, count[seen])
    best = np.sort(np.argsort(-weight, kind="stable")[:_VISITS])
    best_view = np.array([seen[visit == v][int(np.argmax(count[seen[visit == v]]))] for v in best.tolist()], dtype=np.intp)
    position = se2.transform(se2.inverse(poses[best_view]), place)
    if landmark.radius > 0.0:
        views = zip(best_view.tolist(), position, strict=True)
        position = np.array([_column_in(clouds.cloud(k)[0], at, landmark.radius) for k, at in views])
    return Observations(best_view, position)


def _column_in(points: Floats, place: Floats, radius: float) -> Floats:
    """Return where one cloud has a column (2,): the column's place in the whole map bounds the search in the cloud."""
    near = points[np.hypot(*(points - place).T) < radius + _NEAR]
    centre = fit_circle(near, fit_circle(near, place, radius, 0.2), radius, 0.1)
    return centre if np.hypot(*(centre - place)) < _NEAR else place


def tie_landmarks(estimate: Estimate, task: Task) -> Estimate:
    """Add given distances between landmarks to the map that was made without them.

    Raises
    ------
    ConfigError : there is no lidar, or see ties.
    """
    given, config, scans = task.given, task.config, estimate.scans
    if scans is None:
        raise ConfigError("constraints: distances between landmarks need the lidar, which sees them")
    motion = map_frame.alignment_of(estimate, task)
    tied = ties(given, scans.clouds, se2.compose(motion, estimate.graph.poses), task.recordings.path)
    optimum = optimize(estimate.problem.with_edges(tied.edges), config.solver)[0]
    estimate = replace(estimate, graph=estimate.graph.with_edges(tied.edges)).with_estimates_of(optimum)
    if estimate.joint is not None:
        estimate = solve_by_own_errors(refine_jointly(estimate, task), task).solved(rough(config.solver))[0]
    figures = outcome(task, tied, estimate.graph)
    task.stages.end("landmark distances", distances=figures)
    return estimate


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """Measured distances as edges between the poses that see the landmarks."""

    edges: PointDistanceEdges
    measured: Ints
    """(e,) which distance each is of."""


def ties(constraints: Constraints, clouds: Clouds, poses: Floats, path: Floats) -> Ties:
    """Find the landmarks and tie the poses that see them at the measured distances.

    Raises
    ------
    ConfigError : a landmark is not given of, or is not there.
    """
    listed = {landmark.name: landmark for landmark in constraints.landmarks}
    wanted = [name for d in constraints.landmark_distances for name in d.landmarks]
    missing = sorted(set(wanted) - set(listed))
    if missing:
        raise ConfigError(f"constraints: [[landmark_distance]] names {missing[0]!r}, of which there is no [[landmark]]")
    found = {name: observations(listed[name], clouds, poses, path) for name in dict.fromkeys(wanted)}
    rows: list[tuple[NDArray[Any], ...]] = []
    for number, given in enumerate(constraints.landmark_distances):
        one, other = (found[name] for name in given.landmarks)
        a, b = np.indices((len(one.keyframe), len(other.keyframe))).reshape(2, -1)
        flat = np.ones(len(a))
        ends = (one.keyframe[a], other.keyframe[b], one.position[a], other.position[b])
        # All edges of one measurement together have its weight.
        rows.append((*ends, given.distance * flat, given.sigma * np.sqrt(len(a)) * flat, np.full(len(a), number)))
    i, j, p, q, distance, sigma, measured = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Ties(PointDistanceEdges(i, j, p, q, distance, sigma), measured)


def outcome(task: Task, tied: Ties, graph: Graph) -> list[dict[str, object]]:
    """Return the distances in the map, ready for a report; note those that differ from the measured ones."""
    lengths = tied.edges.lengths(graph)
    figures: list[dict[str, object]] = []
    for number, given in enumerate(task.given.landmark_distances):
        length = float(np.mean(lengths[tied.measured == number]))
        names = " - ".join(given.landmarks)
        figures.append({"landmarks": names, "measured": given.distance, "map": round(length, 4)})
        if abs(length - given.distance) > 3.0 * given.sigma:
            task.stages.note("landmark-distance", **figures[-1])
    return figures
