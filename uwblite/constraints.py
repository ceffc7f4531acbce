"""What the user knows beforehand: surveyed anchors, pinned poses, distances, closures that must or must not be.

Surveyed anchors and pinned poses are given in the user's own frame. When the first estimate stands in the frame of the
odometry, a rigid motion found from them brings it over; which of them agree is found at the same time, so that an anchor
that was moved since does not bend the map but is named.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from . import se2
from .config import setting
from .distance_edges import AnchorDistanceEdges
from .errors import ConfigError
from .evaluate import align
from .graph import Edges, Graph, PriorEdges
from .pose_edges import RelativePoseEdges
from .robust import Kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class KnownAnchor:
    """An anchor whose place is known."""

    id: str = ""
    """As the radio says it."""
    position: tuple[float, float] = (0.0, 0.0)
    """m, the user's frame."""
    sigma: float = setting(0.05, above=0.0)
    """Standard deviation of x and of y, m."""
    movable: bool = False
    """From an earlier map: it may have been moved since."""


@dataclass(frozen=True, slots=True)
class KnownPose:
    """Where the robot was at a time."""

    stamp: float = 0.0
    """s, on the recording's clock."""
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, theta in the user's frame; m, m, rad."""
    sigma: tuple[float, float, float] = setting((0.05, 0.05, 0.05), above=0.0)
    """Standard deviations; m, m, rad. A large one (100) says that this one is not known."""
    recording: int = setting(1, minimum=1)
    """Which of several recordings the stamp belongs to: 1, 2, ... as they are named to `map`."""


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """The distance between two anchors."""

    anchors: tuple[str, str] = ("", "")
    """Their ids."""
    distance: float = 0.0
    """m."""
    sigma: float = setting(0.02, above=0.0)
    """m."""


@dataclass(frozen=True, slots=True)
class KnownLandmark:
    """Something that the lidar sees, by its place in the map as it comes out without distances to it."""

    name: str = ""
    """Any."""
    position: tuple[float, float] = (0.0, 0.0)
    """m, map frame. Of a column, about its centre; of anything else, the very point that was measured from."""
    radius: float = setting(0.0, minimum=0.0)
    """Of a round column, m: its centre is then sought nearby. 0 = not a column."""


@dataclass(frozen=True, slots=True)
class KnownLandmarkDistance:
    """The true distance between two landmarks; of columns, between their centres."""

    landmarks: tuple[str, str] = ("", "")
    """Their names."""
    distance: float = setting(0.0, above=0.0)
    """m."""
    sigma: float = setting(0.02, above=0.0)
    """m; of landmarks that are no columns it includes how well their places were read off the map."""


@dataclass(frozen=True, slots=True)
class KnownClosure:
    """Two times at which the robot was at the same place, or places at a known pose to each other."""

    stamps: tuple[float, float] = (0.0, 0.0)
    """s, on the recording's clock."""
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose of the robot at the second time as seen from the first; m, m, rad."""
    sigma: tuple[float, float, float] = setting((0.1, 0.1, 0.1), above=0.0)
    """m, m, rad."""
    recordings: tuple[int, int] = setting((1, 1), minimum=1)
    """Which of several recordings the stamps belong to."""


@dataclass(frozen=True, slots=True)
class ForbiddenClosure:
    """Two times whose places must not be matched with each other: they only look alike."""

    stamps: tuple[float, float] = (0.0, 0.0)
    """s, on the recording's clock."""
    within: float = 10.0
    """It holds for all poses that are this near in time to the two, s."""
    recordings: tuple[int, int] = setting((1, 1), minimum=1)
    """Which of several recordings the stamps belong to."""


@dataclass(frozen=True, slots=True)
class Constraints:
    """Everything that is known beforehand."""

    anchors: tuple[KnownAnchor, ...] = ()
    poses: tuple[KnownPose, ...] = ()
    distances: tuple[KnownDistance, ...] = ()
    closures: tuple[KnownClosure, ...] = ()
    forbidden: tuple[ForbiddenClosure, ...] = ()
    landmarks: tuple[KnownLandmark, ...] = ()
    landmark_distances: tuple[KnownLandmarkDistance, ...] = ()

    def __add__(self, other: "Constraints") -> "Constraints":
        """Return both together; of one anchor's places the other's counts."""
        named = {a.id for a in other.anchors}
        return Constraints(
            tuple(a for a in self.anchors if a.id not in named) + other.anchors,
            self.poses + other.poses,
            self.distances + other.distances,
            self.closures + other.closures,
            self.forbidden + other.forbidden,
            self.landmarks + other.landmarks,
            self.landmark_distances + other.landmark_distances,
        )

    @property
    def places(self) -> bool:
        """Whether they say where the map lies."""
        return bool(self.anchors or self.poses)

    def allowed(self, clock: "Clock", i: Ints, j: Ints) -> Bools:
        """Tell which pairs (n,) of the clock's poses may be matched with each other."""
        allowed = np.ones(len(i), dtype=bool)
        for ban in self.forbidden:
            near = [clock.off(s, r) <= ban.within for s, r in zip(ban.stamps, ban.recordings, strict=True)]
            allowed &= ~((near[0][i] & near[1][j]) | (near[1][i] & near[0][j]))
        return allowed


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """When the poses of a graph were."""

    stamps: Floats
    """(n,) s, each on the clock of its recording."""
    session: Ints
    """(n,) recording of each: 0, 1, ..."""

    def off(self, stamp: float, recording: int) -> Floats:
        """Return how far (n,), s, each pose is from a stamp of a recording (1, 2, ...); inf for those of others."""
        return np.where(self.session == recording - 1, np.abs(self.stamps - stamp), np.inf)

    def nearest(self, stamp: float, recording: int) -> int:
        """Return the pose nearest to a stamp.

        Raises
        ------
        ConfigError : there is no such recording, or the stamp lies outside it.
        """
        own = self.stamps[self.session == recording - 1]
        if not len(own):
            raise ConfigError(f"constraints: there is no recording {recording}; there are {int(self.session.max()) + 1}")
        if not own.min() - 1.0 <= stamp <= own.max() + 1.0:
            where = f"recording {recording}" if self.session.max() > 0 else "the recording"
            raise ConfigError(f"constraints: stamp {stamp:g} lies outside {where} ({own.min():g} to {own.max():g} s)")
        return int(np.argmin(self.off(stamp, recording)))


@dataclass(frozen=True, slots=True, eq=False)
class Applied:
    """A graph with what is known beforehand in it."""

    graph: Graph
    """In the user's frame, where that is known, with the further edges."""
    motion: Floats
    """(3,) T_new_old: what the frame was moved by."""
    moved: dict[str, float]
    """Anchors that are not where they were said to be, by id: how far off they are, m."""


def apply(known: Constraints, graph: Graph, anchor_ids: tuple[str, ...], placed: Bools, clock: Clock) -> Applied:
    """Bring a first estimate into the user's frame and add what is known to its edges.

    Parameters
    ----------
    known : what is known.
    graph : first estimate; its first pose is held.
    anchor_ids : (a,) names of its anchors.
    placed : (a,) which of them have a position.
    clock : when its poses were.

    Raises
    ------
    ConfigError : an anchor is not in the recording, or a stamp lies outside it.
    """
    known = _present(known, anchor_ids)
    index = {name: k for k, name in enumerate(anchor_ids)}
    motion, moved = _fit(known, graph, index, placed, clock)
    graph = replace(graph, poses=se2.compose(motion, graph.poses), anchors=se2.transform(motion, graph.anchors))
    edges = [*_anchor_priors(known, index, moved), *_pose_priors(known, clock)]
    edges += [*_distances(known, index), *_closures(known, clock)]
    if known.places:
        graph = replace(graph, fixed_poses=np.zeros(len(graph.poses), dtype=bool))
        edges += _gauge(known, graph, moved)
    return Applied(graph.with_edges(*edges), motion, moved)


def _present(known: Constraints, anchor_ids: tuple[str, ...]) -> Constraints:
    """Return what concerns this recording; anchors of an earlier map that are not heard any more are left out."""
    wanted = {a.id for a in known.anchors if not a.movable} | {name for d in known.distances for name in d.anchors}
    missing = sorted(wanted - set(anchor_ids))
    if missing:
        raise ConfigError(f"constraints: no ranges to anchor {missing[0]}; the recording has {', '.join(anchor_ids) or 'none'}")
    return replace(known, anchors=tuple(a for a in known.anchors if a.id in anchor_ids))


def _fit(
    known: Constraints, graph: Graph, index: dict[str, int], placed: Bools, clock: Clock
) -> tuple[Floats, dict[str, float]]:
    """Return the rigid motion (3,) that brings most known places together, and anchors that do not join in."""
    if known.poses:
        first = min(known.poses, key=lambda p: p.sigma)
        motion = se2.compose(np.array(first.pose), se2.inverse(graph.poses[clock.nearest(first.stamp, first.recording)]))
        return motion, _strayed(known, graph, index, placed, motion)
    anchors = [a for a in known.anchors if placed[index[a.id]]]
    here = np.array([graph.anchors[index[a.id]] for a in anchors]).reshape(-1, 2)
    there = np.array([a.position for a in anchors]).reshape(-1, 2)
    if len(anchors) < 2:
        shift = (there - here)[0] if len(anchors) else np.zeros(2)
        return np.array([*shift, 0.0]), {}
    motion = consensus(here, there, np.array([_tolerance(a) for a in anchors]))
    return motion, _strayed(known, graph, index, placed, motion)


def _tolerance(anchor: KnownAnchor) -> float:
    """Return how far a first estimate may lie from a known place, m; biases are not yet known well then."""
    return 3.0 * anchor.sigma + 0.6


def consensus(here: Floats, there: Floats, tolerance: Floats) -> Floats:
    """Return the motion of the pair of places that most others agree with, fitted to all of these."""
    best: tuple[float, Bools] = (-np.inf, np.ones(len(here), dtype=bool))
    for i, j in combinations(range(len(here)), 2):
        motion = align(here[[i, j]], there[[i, j]])
        error = np.hypot(*(se2.transform(motion, here) - there).T) / tolerance
        worth = float(np.sum(np.maximum(1.0 - error**2, 0.0)))
        if worth > best[0]:
            best = (worth, error < 1.0)
    agree = best[1] if best[1].sum() > 1 else np.ones(len(here), dtype=bool)
    return align(here[agree], there[agree])


def _strayed(known: Constraints, graph: Graph, index: dict[str, int], placed: Bools, motion: Floats) -> dict[str, float]:
    strayed = {}
    for a in known.anchors:
        if a.movable and placed[index[a.id]]:
            off = float(np.hypot(*(se2.transform(motion, graph.anchors[index[a.id]]) - np.array(a.position))))
            if off > _tolerance(a):
                strayed[a.id] = round(off, 3)
    return strayed


def _anchor_priors(known: Constraints, index: dict[str, int], moved: dict[str, float]) -> list[Edges]:
    """Surveyed anchors are believed; those of an earlier map under a kernel that lets go of a moved one."""
    edges: list[Edges] = []
    for movable, kernel in ((False, Kernel()), (True, Kernel("geman-mcclure", 4.0))):
        anchors = [a for a in known.anchors if a.movable == movable and a.id not in moved]
        if anchors:
            place = np.array([index[a.id] for a in anchors], dtype=np.int64)
            value = np.array([a.position for a in anchors])
            root = np.array([np.eye(2) / a.sigma for a in anchors])
            edges.append(PriorEdges("anchors", place, value, root, kernel))
    return edges


def _pose_priors(known: Constraints, clock: Clock) -> list[Edges]:
    if not known.poses:
        return []
    place = np.array([clock.nearest(p.stamp, p.recording) for p in known.poses], dtype=np.int64)
    root = np.array([np.diag(1.0 / np.array(p.sigma)) for p in known.poses])
    return [PriorEdges("poses", place, np.array([p.pose for p in known.poses]), root)]


def _distances(known: Constraints, index: dict[str, int]) -> list[Edges]:
    if not known.distances:
        return []
    ends = np.array([[index[name] for name in d.anchors] for d in known.distances], dtype=np.int64)
    values = np.array([[d.distance, d.sigma] for d in known.distances])
    return [AnchorDistanceEdges(ends[:, 0], ends[:, 1], values[:, 0], values[:, 1])]


def _closures(known: Constraints, clock: Clock) -> list[Edges]:
    if not known.closures:
        return []
    ends = [[clock.nearest(s, r) for s, r in zip(c.stamps, c.recordings, strict=True)] for c in known.closures]
    i, j = np.array(ends, dtype=np.int64).T
    root = np.array([np.diag(1.0 / np.array(c.sigma)) for c in known.closures])
    return [RelativePoseEdges(i, j, np.array([c.pose for c in known.closures]), root)]


def _gauge(known: Constraints, graph: Graph, moved: dict[str, float]) -> list[Edges]:
    """Hold the heading of the first pose where one known place alone leaves it open."""
    if known.poses or sum(a.id not in moved for a in known.anchors) > 1:
        return []
    root = np.diag([0.0, 0.0, 1e4])[None]
    return [PriorEdges("poses", np.zeros(1, dtype=np.int64), graph.poses[:1].copy(), root)]
