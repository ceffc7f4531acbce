"""What the user gives beforehand: surveyed anchors, pinned poses, distances, closures that must or must not be.

Surveyed anchors and pinned poses are given in the user's own frame. ``constraint_edges`` brings the first estimate there.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from .arrays import Bools, Floats, Ints
from .config import documented, setting
from .errors import ConfigError

_SURVEYED, _BY_TAPE, _BY_EYE = 0.05, 0.02, 0.1
"""Usual standard deviations of a surveyed place, a measured distance and a place that was recognised; m, rad of a heading."""


@documented
@dataclass(frozen=True, slots=True)
class GivenAnchor:
    """An anchor whose place is known."""

    id: str = ""
    """As in the recording."""
    position: tuple[float, float] = (0.0, 0.0)
    """m, the user's frame."""
    sigma: float = setting(_SURVEYED, above=0.0)
    """Standard deviation of x and of y, m."""
    movable: bool = False
    """From an earlier map: it may have been moved since."""


@documented
@dataclass(frozen=True, slots=True)
class GivenPose:
    """Where the robot was at a time."""

    stamp: float = 0.0
    """s, on the recording's clock."""
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, theta in the user's frame; m, m, rad."""
    sigma: tuple[float, float, float] = setting((_SURVEYED, _SURVEYED, _SURVEYED), above=0.0)
    """Standard deviations; m, m, rad. A large one (100) leaves this one free."""
    recording: int = setting(1, minimum=1)
    """Which of several recordings the stamp belongs to: 1, 2, ... as they are named to `map`."""


@documented
@dataclass(frozen=True, slots=True)
class GivenDistance:
    """The distance between two anchors."""

    anchors: tuple[str, str] = ("", "")
    """Their ids."""
    distance: float = 0.0
    """m."""
    sigma: float = setting(_BY_TAPE, above=0.0)
    """m."""


@documented
@dataclass(frozen=True, slots=True)
class GivenLandmark:
    """A landmark in the scans, by its place in the map made without distances to it."""

    name: str = ""
    """Any."""
    position: tuple[float, float] = (0.0, 0.0)
    """m, map frame. Of a column, about its centre; of anything else, the very point that was measured from."""
    radius: float = setting(0.0, minimum=0.0)
    """Of a round column, m: its centre is then sought nearby. 0 = not a column."""


@documented
@dataclass(frozen=True, slots=True)
class GivenLandmarkDistance:
    """The true distance between two landmarks; of columns, between their centres."""

    landmarks: tuple[str, str] = ("", "")
    """Their names."""
    distance: float = setting(0.0, above=0.0)
    """m."""
    sigma: float = setting(_BY_TAPE, above=0.0)
    """m; of landmarks that are no columns it includes how well their places were read off the map."""


@documented
@dataclass(frozen=True, slots=True)
class GivenClosure:
    """Two times at which the robot was at the same place, or places at a known pose to each other."""

    stamps: tuple[float, float] = (0.0, 0.0)
    """s, on the recording's clock."""
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose of the robot at the second time as seen from the first; m, m, rad."""
    sigma: tuple[float, float, float] = setting((_BY_EYE, _BY_EYE, _BY_EYE), above=0.0)
    """m, m, rad."""
    recordings: tuple[int, int] = setting((1, 1), minimum=1)
    """Which of several recordings the stamps belong to."""


@documented
@dataclass(frozen=True, slots=True)
class ForbiddenClosure:
    """Two times whose places must not be matched with each other: they only look the same."""

    stamps: tuple[float, float] = (0.0, 0.0)
    """s, on the recording's clock."""
    within: float = 10.0
    """It holds for all poses that are this near in time to the two, s."""
    recordings: tuple[int, int] = setting((1, 1), minimum=1)
    """Which of several recordings the stamps belong to."""


@documented
@dataclass(frozen=True, slots=True)
class Constraints:
    """Everything that is known beforehand."""

    anchors: tuple[GivenAnchor, ...] = ()
    poses: tuple[GivenPose, ...] = ()
    distances: tuple[GivenDistance, ...] = ()
    closures: tuple[GivenClosure, ...] = ()
    forbidden: tuple[ForbiddenClosure, ...] = ()
    landmarks: tuple[GivenLandmark, ...] = ()
    landmark_distances: tuple[GivenLandmarkDistance, ...] = ()

    def __add__(self, other: "Constraints") -> "Constraints":
        """Return both together; of one anchor's places the other's counts."""
        named = {a.id for a in other.anchors}
        left = replace(self, anchors=tuple(a for a in self.anchors if a.id not in named))
        return Constraints(*(getattr(left, f.name) + getattr(other, f.name) for f in fields(Constraints)))

    @property
    def places(self) -> bool:
        """Whether they determine the frame of the map."""
        return bool(self.anchors or self.poses)

    @property
    def of_anchors(self) -> bool:
        """Whether they say where anchors are, or how far apart."""
        return bool(self.anchors or self.distances)

    def allowed(self, clock: "Clock", i: Ints, j: Ints) -> Bools:
        """Return which pairs (n,) of the clock's poses may be matched with each other."""
        allowed = np.ones(len(i), dtype=bool)
        for ban in self.forbidden:
            near = [clock.off(s, r) <= ban.within for s, r in zip(ban.stamps, ban.recordings, strict=True)]
            allowed &= ~((near[0][i] & near[1][j]) | (near[1][i] & near[0][j]))
        return allowed


@documented
@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """When the poses of a graph were."""

    stamps: Floats
    """(n,) s, each on the clock of its recording."""
    recording: Ints
    """(n,) recording of each: 0, 1, ..."""

    def off(self, stamp: float, recording: int) -> Floats:
        """Return how far (n,), s, each pose is from a stamp of a recording (1, 2, ...); inf for those of others."""
        return np.where(self.recording == recording - 1, np.abs(self.stamps - stamp), np.inf)

    def nearest(self, stamp: float, recording: int) -> int:
        """Return the pose nearest to a stamp.

        Raises
        ------
        ConfigError : there is no such recording, or the stamp lies outside it.
        """
        own = self.stamps[self.recording == recording - 1]
        if not len(own):
            raise ConfigError(f"constraints: there is no recording {recording}; there are {int(self.recording.max()) + 1}")
        if not own.min() - 1.0 <= stamp <= own.max() + 1.0:
            where = f"recording {recording}" if self.recording.max() > 0 else "the recording"
            raise ConfigError(f"constraints: stamp {stamp:g} lies outside {where} ({own.min():g} to {own.max():g} s)")
        return int(np.argmin(self.off(stamp, recording)))
