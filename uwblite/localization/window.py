"""Measurements of the last metres of driving, in the present frame of the robot: the input of a start.

Earlier poses are relative to the present one, by the odometry. The present pose of the robot determines all of them,
so that a start is a search over one pose.
"""

from dataclasses import dataclass, field

import numpy as np

from .. import se2
from ..arrays import Floats, concatenated
from .hypotheses import WALL_SIGMA
from .range_model import BIAS_SIGMA, DRIFT, KnownAnchors, Ranges
from .walls import Rays

LENGTH = 10.0
"""m driven, beyond which a measurement is removed: the odometry has then drifted by decimetres."""
_TURNING = 1.0
"""m of driving that count for a turn by one radian."""
_LOOK_EVERY, _RANGE_EVERY = 0.4, 0.25
"""m driven between the scans, and between the ranges to one anchor, that are kept."""
_ALIKE = 3
"""Ranges to one anchor that a standing robot keeps."""
_STANDING, _LOOK_AGAIN = 0.05, 1.0
"""m driven, below which a scan replaces the last one, and s after which it does: people who hid the walls move on."""
RAYS = 48
"""Rays kept of a scan."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowRange:
    """A range within the window."""

    anchor: int
    """Its number in the map."""
    metres: float
    odom: Floats
    """(3,) T_odom_base at its time."""
    tag: Floats
    """(2,) of the tag on the base, m."""
    way: float
    """Odometer at its time, m."""
    stamp: float
    """s."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowLook:
    """A scan within the window."""

    rays: Rays
    odom: Floats
    """(3,) T_odom_base of the rays' frame."""
    way: float
    """Odometer at its time, m."""
    stamp: float
    """s."""


@dataclass(slots=True, eq=False)
class Window:
    """Measurements of the last metres, the oldest first (mutable)."""

    entries: list[WindowRange | WindowLook] = field(default_factory=list)

    @property
    def ranges(self) -> list[WindowRange]:
        """Of all anchors."""
        return [e for e in self.entries if isinstance(e, WindowRange)]

    @property
    def looks(self) -> list[WindowLook]:
        """Scans."""
        return [e for e in self.entries if isinstance(e, WindowLook)]

    def since(self, stamp: float) -> "Window":
        """Return a window of the measurements after a time, s."""
        return Window([e for e in self.entries if e.stamp > stamp])

    def add_range(self, entry: WindowRange) -> None:
        """Keep a range, unless the robot has hardly moved since the last few to the same anchor."""
        own = [r for r in self.ranges if r.anchor == entry.anchor]
        if len(own) < _ALIKE or entry.way - own[-_ALIKE].way >= _RANGE_EVERY:
            self._add(entry)

    def wants_look(self, way: float, stamp: float, after: float = -np.inf) -> bool:
        """Return whether a scan is wanted, at a way, m, and a time, s; or the last one is not newer than `after`."""
        looks = self.looks
        if not looks or way - looks[-1].way >= _LOOK_EVERY or looks[-1].stamp <= after:
            return True
        return way - looks[-1].way < _STANDING and stamp - looks[-1].stamp >= _LOOK_AGAIN

    def add_look(self, look: WindowLook) -> None:
        """Keep a scan; that of a robot that stands replaces the last one."""
        looks = self.looks
        if looks and look.way - looks[-1].way < _STANDING:
            self.entries.remove(looks[-1])
        self._add(look)

    def _add(self, entry: WindowRange | WindowLook) -> None:
        """Keep a measurement, and forget those that are LENGTH before it."""
        self.entries = [e for e in [*self.entries, entry] if entry.way - e.way <= LENGTH]

    def seen(self, odom: Floats, way: float, length: float) -> tuple[Rays, Floats]:
        """Return the rays of the last so many metres, in the present frame of the base, and how long ago (p,) each is, m."""
        looks = [k for k in self.looks if way - k.way <= length]
        if not looks:
            return Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)), np.zeros(0)
        rays, of = concatenated([k.rays for k in looks]), np.repeat(np.arange(len(looks)), [len(k.rays.hit) for k in looks])
        poses = se2.between(odom, np.array([k.odom for k in looks]))
        ends, origins = (se2.transform_each(poses, of, p) for p in (rays.ends, rays.origins))
        return Rays(ends, origins, rays.hit), np.array([way - k.way for k in looks])[of]

    def ranges_since(self, anchors: KnownAnchors, odom: Floats, way: float) -> Ranges:
        """Return the ranges, with the tag's places in the present frame of the base."""
        rows = self.ranges
        k = np.array([r.anchor for r in rows], dtype=np.intp)
        metres, ways = np.array([(r.metres, r.way) for r in rows]).reshape(-1, 2).T
        then, tag = np.array([r.odom for r in rows]).reshape(-1, len(odom)), np.array([r.tag for r in rows]).reshape(-1, 2)
        measured = (metres - anchors.bias[k]) / (1.0 + anchors.scale)
        level = np.sqrt(np.maximum(measured**2 - anchors.rise[k], WALL_SIGMA**2))
        sigma = np.sqrt(anchors.sigma[k] ** 2 + BIAS_SIGMA**2 + (DRIFT * (way - ways)) ** 2)
        tags = se2.transform(se2.between(odom, then), tag)
        return Ranges(k, anchors.positions[k], tags, level, sigma, ways, *anchors.noise[k].T)


def way_of(step: Floats) -> float:
    """Return the length of a step (3,), m, with its turn counted as a distance."""
    return float(np.hypot(step[0], step[1]) + _TURNING * abs(step[2]))
