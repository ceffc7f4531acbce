"""Search in the local sub-map of the keyframes before, for steps that descent from the odometry's guess leaves uncertain.

After a fast turn or a gap, the neighbouring cloud alone overlaps too little; the last few clouds together show the previous
view. Every pose in the window is scored (see raster_search), matching descends from the best few and from the
guesses, and free space decides between them: for two scans at their true poses hardly any surface of the one stands in the
free space of the other. A step with two distinct places of similar score is ambiguous and counts as not found. Places along
a bare wall count as one place: the match leaves that direction free, and fixes the others.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from .cloud_rasters import rasterize
from .clouds import Clouds
from .pair_alignment import Aligned, align_pairs
from .raster_search import Window, best_poses
from .scan_matching import measured, pair_points
from .visibility import nearest_by_bearing, pair_violations

_VIEWS = 6
"""Keyframes before the step that make its local sub-map."""
_SPAN = 10.0
"""Half the edge of the square around the robot within which points are matched, m: farther ones only take time."""
_FARTHEST = 1.2
"""Largest half-width of the search, m."""
_TURNING = 0.5
"""Share of the odometry's turn that is added to the half-width of the search in heading."""
_STARTS = 4
"""Places of the search from which matching descends."""
_POINTS = 120
"""Points looked up per place."""
_FIRST_GATE, _LAST_GATE = 0.3, 0.15
"""Farthest match in the first and in the last iteration, m."""
_ITERATIONS = 12
_CELL, _REACH = 0.1, 0.5
"""Cell of the raster of nearest points and distance up to which a point is near, m."""
_DISTINCT = 0.15
"""Places farther apart than this, m or rad, are distinct."""
_MATCH_VARIANCE = 0.03**2 * 8.0
"""Variance of one match, m^2; eight together weigh as one."""
_SAME = 3.0
"""Standard deviations up to which a match cannot separate two places."""
_MARGIN = 0.08
"""Least difference between the scores of the best place and of every distinct one."""
_CONTRADICTED = 0.12
"""Share in free space that is too large for a true place."""
_LEAST = 0.45
"""Least score of a step: share of points that match, less the share that stands in free space."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundStep:
    """Outcome of a search."""

    pose: Floats
    """(3,) of the next keyframe in the one before."""
    score: float
    """Share of points that match less the share that stands in free space."""
    second: float
    """Score of the best distinct place; -1 = there is none."""
    through: float
    """Share that stands in free space where matching near to the odometry's guess ends, or at the guess if it goes away."""

    @property
    def clear(self) -> bool:
        """Whether enough matches, and no distinct place matches nearly as well."""
        return self.score >= _LEAST and self.second < self.score - _MARGIN

    @property
    def contradicts(self) -> bool:
        """Whether the odometry's guess is wrong whatever is right: surfaces would stand in free space there."""
        return self.through > _CONTRADICTED


class StepSearch:
    """The clouds of all keyframes, ready for searches."""

    def __init__(self, clouds: Clouds, distance: float, angle: float) -> None:
        """Take half-widths of the search in x and y, m, and in heading, rad."""
        self._clouds, self._distance, self._angle = clouds, distance, angle
        self._nearest = nearest_by_bearing(clouds)

    def find(self, k: int, first: int, steps: Floats, guesses: Floats) -> FoundStep:
        """Search for the pose of keyframe k + 1 in keyframe k.

        Parameters
        ----------
        first : keyframe from which on the steps before k are sound.
        steps : (n, 3) from every keyframe to the next.
        guesses : (g, 3) poses to start from, too; the first is the odometry's, the middle of the search.
        """
        views = np.arange(max(first, k + 1 - _VIEWS), k + 1)
        pair = _sub_map_and_next(self._clouds, views, _chained(steps, views), k + 1)
        raster = rasterize(pair, _CELL, _REACH)
        motion = guesses[0]
        distance = min(self._distance + 2.0 * float(np.hypot(motion[0], motion[1])), _FARTHEST)
        window = Window(distance, self._angle + _TURNING * abs(float(motion[2])))
        rows = pair_points(pair, np.ones(1, dtype=np.intp), _POINTS).of(0)
        starts = np.concatenate([guesses, best_poses(pair, raster, rows, motion, window, _STARTS)])
        target = np.zeros(len(starts), dtype=np.intp)
        points = pair_points(pair, target + 1, _POINTS)
        tried = align_pairs(pair, raster, target, starts, points, _FIRST_GATE, _LAST_GATE, _ITERATIONS)
        through = self.through(k, tried.pose)
        score = tried.share - through
        best = int(np.argmax(score))
        measurably = _measurably(best, tried)
        # Along a bare wall only the odometry measures the distance.
        alike = np.flatnonzero(~measurably & (score >= score[best] - _MARGIN))
        best = int(alike[np.argmin(np.hypot(*(tried.pose[alike] - motion)[:, :2].T))])
        distinct = _apart(tried.pose[best], tried.pose) & measurably
        second = float(score[distinct].max(initial=-1.0))
        near = np.flatnonzero(~_apart(motion, tried.pose))
        there = through[near[np.argmax(score[near])]] if len(near) else self.through(k, motion[None])[0]
        return FoundStep(tried.pose[best], float(score[best]), second, float(there))

    def through(self, k: int, poses: Floats) -> Floats:
        """Return the shares (c,) of either scan that would stand in free space for poses (c, 3) of keyframe k + 1 in k."""
        return pair_violations(self._clouds, self._nearest, k, k + 1, poses)


def _apart(pose: Floats, others: Floats) -> Bools:
    """Return which other poses (c, 3) are distinct from one."""
    off = se2.between(pose, others)
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) > _DISTINCT) | (np.abs(off[:, 2]) > _DISTINCT))


def _measurably(best: int, tried: Aligned) -> Bools:
    """Return which places (c,) differ from the best one in a direction that its match measures."""
    one = slice(best, best + 1)
    z, sqrt_information = measured(tried.factors.rows(one), tried.pose[one], np.full(1, _MATCH_VARIANCE))
    off = se2.between(z[0], tried.pose) @ sqrt_information[0].T
    differs = np.sqrt(np.sum(off**2, axis=1)) > _SAME
    differs[best] = False  # though an alignment that has not converged may be a large step from its minimum
    return np.asarray(differs)


def _chained(steps: Floats, views: Ints) -> Floats:
    """Return the poses (v, 3) of following keyframes in the last of them, chained by steps (n, 3)."""
    poses = np.zeros((len(views), 3))
    for n in range(len(views) - 2, -1, -1):
        poses[n] = se2.compose(poses[n + 1], se2.inverse(steps[views[n]]))
    return poses


def _sub_map_and_next(clouds: Clouds, views: Ints, poses: Floats, following: int) -> Clouds:
    """Return two clouds: those of the views (v,), at poses (v, 3), as one, and the following keyframe's."""
    rows, last = (
        slice(int(clouds.offsets[a]), int(clouds.offsets[b + 1])) for a, b in ((views[0], views[-1]), (following, following))
    )
    own = poses[clouds.owner[rows] - views[0]]
    points = np.concatenate([se2.transform(own, clouds.points[rows]), clouds.points[last]])
    normals = np.concatenate([se2.rotate(own[:, 2], clouds.normals[rows]), clouds.normals[last]])
    variance = np.concatenate([clouds.normal_variance[rows], clouds.normal_variance[last]])
    size = rows.stop - rows.start
    owner = np.repeat(np.arange(2, dtype=np.int32), [size, len(points) - size])
    pair = Clouds(np.array([0, size, len(points)]), points, normals, owner, variance, clouds.work)
    return pair.only(np.abs(points).max(axis=1) < _SPAN)
