"""Prior knowledge given by the user, as edges of a graph in the user's frame.

A rigid motion found from surveyed anchors and pinned poses brings the first estimate there; an anchor of an earlier map that
was moved since is found at the same time, and does not bend the map.

A landmark (column, corner) is a place in the map before its distances are used. Of each visit, the keyframe with most points
there keeps its place in its own frame, and a measured distance constrains each visit of one landmark against each of the other;
all these edges together have the weight of the one measurement.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..constraints import Clock, Constraints, GivenAnchor, GivenLandmark
from ..errors import ConfigError
from ..graph.graph import Edges, Graph, PriorEdges
from ..graph.point_edges import AnchorDistanceEdges, PointDistanceEdges, distances
from ..graph.pose_edges import RelativePoseEdges
from ..graph.robust import Kernel
from ..graph.solver import optimize
from ..grid.columns import find_column, fit_circle
from ..lidar.clouds import Clouds
from ..loop_closure.candidates import CandidatePolicy
from ..problem.solution import rough
from ..se2 import align
from . import map_frame
from .estimate import Estimate, Task
from .lidar_stages import refine_jointly, solve_by_own_errors


class GivenPolicy:
    """When places agree with what is given, and which clouds see a landmark."""

    gate: float = CandidatePolicy.sigmas
    """Standard deviations within which a place or a distance agrees."""
    unsure: float = 0.6
    """m, more of a first estimate, whose biases are not yet known well."""
    moved: float = 4.0
    """Standard deviations beyond which an anchor of an earlier map counts hardly: the scale of its kernel."""
    heading: float = 1e-4
    """rad; standard deviation of a heading that is fixed."""
    near: float = 0.4
    """m; points count as the landmark's when they lie so near to its place, or to the rim of its column."""
    least_points: int = 3
    """Of a cloud, that make an observation."""
    one_visit: float = 3.0
    """m; observations belong to one visit while less than this is travelled between two."""
    visits: int = 4
    """Visits used of a landmark, those with most points."""
    noise: float = 0.05
    """m, of a map's points on a column: the cells of the search, of which a fit takes points of four and then of two."""


def apply_given(estimate: Estimate, task: Task) -> Estimate:
    """Bring the estimate into the user's frame, where one is given, and add what is given to the edges.

    Raises
    ------
    ConfigError : an anchor is not in the recording, a stamp lies outside it, or places are given together with `align`.
    """
    constraints, config = task.constraints, task.config
    if constraints.places and config.align != "odometry":
        raise ConfigError("given places say where the map lies; leave out align, or the places")
    applied = apply(constraints, estimate.graph, estimate.anchor_ids, estimate.placed, task.recordings.clock)
    for anchor, off in applied.moved.items():
        task.stages.note("moved-anchor", anchor=anchor, distance=off)
    solved = optimize(applied.graph.with_edges(*estimate.odometry_and_ranges), config.solver)[0]
    task.stages.end("constraints", moved=sorted(applied.moved), shift=applied.motion.tolist())
    return replace(estimate, graph=applied.graph).with_estimates_of(solved).with_hypotheses_moved(applied.motion)


@dataclass(frozen=True, slots=True, eq=False)
class Applied:
    """A graph in the user's frame with what is given."""

    graph: Graph
    motion: Floats
    """(3,) T_new_old."""
    moved: dict[str, float]
    """Distance from its given place, m, of each anchor that is not there."""


def apply(constraints: Constraints, graph: Graph, anchor_ids: tuple[str, ...], placed: Bools, clock: Clock) -> Applied:
    """Bring a first estimate, whose first pose is fixed, into the user's frame and add the prior knowledge to its edges."""
    constraints = _present(constraints, anchor_ids)
    index = {name: k for k, name in enumerate(anchor_ids)}
    motion, moved = _fit(constraints, graph, index, placed, clock)
    graph = replace(graph, poses=se2.compose(motion, graph.poses), anchors=se2.transform(motion, graph.anchors))
    edges = _edges(constraints, index, moved, clock)
    if constraints.places:
        graph = replace(graph, fixed_poses=np.zeros(len(graph.poses), dtype=bool))
        edges += _gauge(constraints, graph, moved)
    return Applied(graph.with_edges(*edges), motion, moved)


def _present(constraints: Constraints, anchor_ids: tuple[str, ...]) -> Constraints:
    """Return what concerns this recording; anchors of an earlier map without ranges now are left out."""
    wanted = {a.id for a in constraints.anchors if not a.movable}.union(*(d.anchors for d in constraints.distances))
    missing = sorted(wanted - set(anchor_ids))
    if missing:
        raise ConfigError(f"constraints: no ranges to anchor {missing[0]}; the recording has {', '.join(anchor_ids) or 'none'}")
    return replace(constraints, anchors=tuple(a for a in constraints.anchors if a.id in anchor_ids))


def _fit(
    constraints: Constraints, graph: Graph, index: dict[str, int], placed: Bools, clock: Clock
) -> tuple[Floats, dict[str, float]]:
    """Return T_new_old (3,) by the surest given pose, or else by the anchors that agree, and the movable ones that do not."""
    if constraints.poses:
        surest = min(constraints.poses, key=lambda p: max(p.sigma))
        motion = se2.compose(np.array(surest.pose), se2.inverse(graph.poses[clock.nearest(surest.stamp, surest.recording)]))
        return motion, _strayed(constraints, graph, index, placed, motion)
    anchors = [a for a in constraints.anchors if placed[index[a.id]]]
    estimated = np.array([graph.anchors[index[a.id]] for a in anchors]).reshape(-1, 2)
    surveyed = np.array([a.position for a in anchors]).reshape(-1, 2)
    if len(anchors) < 2:
        shift = (surveyed - estimated)[0] if len(anchors) else np.zeros(2)
        return np.array([*shift, 0.0]), {}
    motion = consensus(estimated, surveyed, np.array([_tolerance(a) for a in anchors]))
    return motion, _strayed(constraints, graph, index, placed, motion)


def consensus(estimated: Floats, surveyed: Floats, tolerance: Floats) -> Floats:
    """Return the motion of the pair of places that most others agree with, fitted to all of these."""
    best: tuple[float, Bools] = (-np.inf, np.ones(len(estimated), dtype=bool))
    for i, j in combinations(range(len(estimated)), 2):
        motion = align(estimated[[i, j]], surveyed[[i, j]])
        error = np.hypot(*(se2.transform(motion, estimated) - surveyed).T) / tolerance
        worth = float(np.sum(np.maximum(1.0 - error**2, 0.0)))
        if worth > best[0]:
            best = (worth, error < 1.0)
    agree = best[1] if best[1].sum() > 1 else np.ones(len(estimated), dtype=bool)
    return align(estimated[agree], surveyed[agree])


def _tolerance(anchor: GivenAnchor) -> float:
    return GivenPolicy.gate * anchor.sigma + GivenPolicy.unsure


def _strayed(constraints: Constraints, graph: Graph, index: dict[str, int], placed: Bools, motion: Floats) -> dict[str, float]:
    """Return how far the anchors of an earlier map that were moved are from there, m."""
    strayed = {}
    for a in constraints.anchors:
        if a.movable and placed[index[a.id]]:
            off = float(np.hypot(*(se2.transform(motion, graph.anchors[index[a.id]]) - np.array(a.position))))
            if off > _tolerance(a):
                strayed[a.id] = off
    return strayed


def _edges(constraints: Constraints, index: dict[str, int], moved: dict[str, float], clock: Clock) -> list[Edges]:
    """Return what is given; the places of an earlier map have a kernel that gives up an anchor that was moved."""
    edges = list[Edges]()
    for movable, kernel in ((False, Kernel()), (True, Kernel("geman-mcclure", GivenPolicy.moved))):
        if anchors := [a for a in constraints.anchors if a.movable == movable and a.id not in moved]:
            place = np.array([index[a.id] for a in anchors], dtype=np.intp)
            root = np.array([np.eye(2) / a.sigma for a in anchors])
            edges.append(PriorEdges("anchors", place, np.array([a.position for a in anchors]), root, kernel=kernel))
    if poses := constraints.poses:
        place = np.array([clock.nearest(p.stamp, p.recording) for p in poses], dtype=np.intp)
        edges.append(PriorEdges("poses", place, np.array([p.pose for p in poses]), _roots([p.sigma for p in poses])))
    if given := constraints.distances:
        one, other = np.array([[index[name] for name in d.anchors] for d in given], dtype=np.intp).T
        edges.append(AnchorDistanceEdges(one, other, *np.array([[d.distance, d.sigma] for d in given]).T))
    if closures := constraints.closures:
        ends = [[clock.nearest(s, r) for s, r in zip(c.stamps, c.recordings, strict=True)] for c in closures]
        i, j = np.array(ends, dtype=np.intp).T
        edges.append(RelativePoseEdges(i, j, np.array([c.pose for c in closures]), _roots([c.sigma for c in closures])))
    return edges


def _roots(sigmas: Sequence[tuple[float, ...]]) -> Floats:
    return np.array([np.diag(1.0 / np.array(sigma)) for sigma in sigmas])


def _gauge(constraints: Constraints, graph: Graph, moved: dict[str, float]) -> list[Edges]:
    """Fix the heading of the first pose where only one place is given, which does not determine it."""
    if constraints.poses or sum(a.id not in moved for a in constraints.anchors) > 1:
        return []
    root = np.diag([0.0, 0.0, 1.0 / GivenPolicy.heading])[None]
    return [PriorEdges("poses", np.zeros(1, dtype=np.intp), graph.poses[:1].copy(), root)]


def observations(landmark: GivenLandmark, clouds: Clouds, poses: Floats, path: Floats) -> tuple[Ints, Floats]:
    """Return a keyframe (v,) of each visit to a landmark, and where this stands in its frame (v, 2), m.

    Raises
    ------
    ConfigError : no cloud has anything there, or no column of that radius.
    """
    points = se2.transform_each(poses, clouds.owner, clouds.points)
    place = np.array(landmark.position)
    reach = GivenPolicy.near
    near = np.hypot(*(points - place).T) < landmark.radius + reach
    where = f"constraints: landmark {landmark.name!r} at {place[0]:g}, {place[1]:g}"
    if landmark.radius > 0.0:
        place = find_column(points[near], place, landmark.radius, reach, cell=GivenPolicy.noise)
        if not np.isfinite(place).all():
            raise ConfigError(f"{where}: no column of radius {landmark.radius:g} m stands there; look up its place in the map")
    count = np.bincount(clouds.owner[near], minlength=len(poses))
    seen = np.flatnonzero(count >= GivenPolicy.least_points)
    if not len(seen):
        raise ConfigError(f"{where}: the lidar saw nothing within {reach:g} m of it; look up its place in the map")
    visit = np.cumsum(np.concatenate([[0], np.diff(path[seen]) > GivenPolicy.one_visit]))
    weight = np.bincount(visit, count[seen])
    best = np.sort(np.argsort(-weight, kind="stable")[: GivenPolicy.visits])
    best_view = np.array([seen[visit == v][int(np.argmax(count[seen[visit == v]]))] for v in best.tolist()], dtype=np.intp)
    position = se2.transform(se2.inverse(poses[best_view]), place)
    if landmark.radius > 0.0:
        views = zip(best_view.tolist(), position, strict=True)
        position = np.array([_column_in(clouds.cloud(k)[0], at, landmark.radius) for k, at in views])
    return best_view, position


def _column_in(points: Floats, place: Floats, radius: float) -> Floats:
    """Return where one cloud has a column (2,): the column's place in the whole map bounds the search in the cloud."""
    near = points[np.hypot(*(points - place).T) < radius + GivenPolicy.near]
    centre = fit_circle(near, fit_circle(near, place, radius, 4.0 * GivenPolicy.noise), radius, 2.0 * GivenPolicy.noise)
    return centre if np.hypot(*(centre - place)) < GivenPolicy.near else place


def tie_landmarks(estimate: Estimate, task: Task) -> Estimate:
    """Add given distances between landmarks to the map that was made without them.

    Raises
    ------
    ConfigError : there is no lidar, or see ties.
    """
    constraints, config, scans = task.constraints, task.config, estimate.scans
    if scans is None:
        raise ConfigError("constraints: distances between landmarks need the lidar, which sees them")
    motion = map_frame.alignment_of(estimate, task)
    tied = ties(constraints, scans.clouds, se2.compose(motion, estimate.graph.poses), task.recordings.path)
    optimum = optimize(estimate.problem.with_edges(tied.edges), config.solver)[0]
    estimate = replace(estimate, graph=estimate.graph.with_edges(tied.edges)).with_estimates_of(optimum)
    if estimate.joint is not None:
        estimate = solve_by_own_errors(refine_jointly(estimate, task), task).solved(rough(config.solver))[0]
    task.stages.end("landmark distances", distances=outcome(task, tied, estimate.graph))
    return estimate


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """Measured distances between landmarks."""

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
    views = {name: observations(listed[name], clouds, poses, path) for name in dict.fromkeys(wanted)}
    rows: list[tuple[NDArray[Any], ...]] = []
    for number, given in enumerate(constraints.landmark_distances):
        (i, p), (j, q) = (views[name] for name in given.landmarks)
        a, b = np.indices((len(i), len(j))).reshape(2, -1)
        flat = np.ones(len(a))
        ends = (i[a], j[b], p[a], q[b])
        # All edges of one measurement together have its weight.
        rows.append((*ends, given.distance * flat, given.sigma * np.sqrt(len(a)) * flat, np.full(len(a), number)))
    i, j, p, q, distance, sigma, measured = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Ties(PointDistanceEdges(i, j, p, q, distance, sigma), measured)


def outcome(task: Task, tied: Ties, graph: Graph) -> list[dict[str, object]]:
    """Return the distances in the map, and note those that differ from the measured ones."""
    lengths = distances(tied.edges, graph)
    figures: list[dict[str, object]] = []
    for number, given in enumerate(task.constraints.landmark_distances):
        length = float(np.mean(lengths[tied.measured == number]))
        names = " - ".join(given.landmarks)
        figures.append({"landmarks": names, "measured": given.distance, "map": length})
        if abs(length - given.distance) > GivenPolicy.gate * given.sigma:
            task.stages.note("landmark-distance", **figures[-1])
    return figures
