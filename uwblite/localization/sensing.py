"""Measurements as they come in: those that wait for the odometry, and scans as rays in the frame of the base."""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Floats
from ..config import documented
from ..grid.occupancy_grid import GridConfig
from ..odometry.attached import beam_origins
from ..odometry.odometer import Odometer
from ..sensor_log import LaserScans, SensorMounting
from .walls import Rays

_FARTHEST = 1000.0
"""m; a longer reading is invalid, whatever reach the device states."""
TRACK_RAYS = 180
"""Rays of a scan that are matched."""
LEAD = 5.0
"""s; a stamp farther ahead of the odometry is not used before others confirm it: a single one is a fault of the clock.
One as far behind is not explained by delay."""
CONFIRMED = 4
"""Different stamps, all so far ahead, after which the odometry was silent for so long, or its clock was set."""


@documented
@dataclass(frozen=True, slots=True)
class Scanner:
    """Geometry of a lidar, with the field names of sensor_msgs/LaserScan."""

    angle_min: float
    """rad."""
    angle_increment: float
    """rad."""
    time_increment: float = 0.0
    """s between rays."""
    range_min: float = 0.02
    range_max: float = 30.0
    """m."""

    @classmethod
    def of(cls, scans: LaserScans, sign: float = 1.0) -> "Scanner":
        """Return that of some scans, which are played backwards with a negative sign."""
        sweep = sign * scans.time_increment
        return cls(scans.angle_min, scans.angle_increment, sweep, scans.range_min, scans.range_max)

    @property
    def usable(self) -> bool:
        """Whether it gives the direction of each ray; a broken header does not."""
        return bool(np.isfinite((self.angle_min, self.angle_increment, self.time_increment)).all())


@dataclass(frozen=True, slots=True)
class Range:
    """A range, as it waits for the odometry: index of the anchor in the map, and of the robot's tag."""

    anchor: int
    metres: float
    tag: int


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A scan that the odometry has not reached."""

    stamp: float
    """s, of the first ray, on the odometry's clock."""
    readings: Floats
    """(b,) m."""
    scanner: Scanner

    @property
    def end(self) -> float:
        """s, of the last ray; of the first one in a recording that is played backwards."""
        return max(self.stamp, self.stamp + self.scanner.time_increment * max(len(self.readings) - 1, 0))


class Waiting:
    """Measurements that are ahead of the odometry."""

    def __init__(self) -> None:
        self._entries: list[tuple[float, Range | Scan]] = []
        self.refused = 0
        """Measurements that were left out: so far ahead of an odometry that was not silent, or as far behind it."""

    def add(self, until: float, entry: Range | Scan) -> None:
        """Keep a measurement until the odometry has reached a time, s."""
        if np.isfinite(until):
            self._entries.append((until, entry))

    def put_back(self, entries: list[tuple[float, Range | Scan]]) -> None:
        """Keep measurements that were reached for the next step."""
        self._entries = entries + self._entries

    def latest(self, now: float) -> float:
        """Return until when sensors have measured, s, where the odometry's last stamp is now; -inf = not beyond it."""
        ahead = {until for until, _ in self._entries if until > now}
        near = [until for until in ahead if until <= now + LEAD]
        return max(near) if near else min(ahead) if len(ahead) >= CONFIRMED else -np.inf

    def refuse(self, now: float) -> None:
        """Leave out measurements that are too far ahead of an odometry that has just been measured."""
        kept = [w for w in self._entries if w[0] <= now + LEAD]
        self.refused += len(self._entries) - len(kept)
        self._entries = kept

    def reached(self, now: float) -> list[tuple[float, Range | Scan]]:
        """Return those that the odometry has reached, in the order of their times, and keep the others."""
        due = sorted((w for w in self._entries if w[0] <= now), key=lambda w: w[0])
        self._entries = [w for w in self._entries if w[0] > now]
        recent = [w for w in due if w[0] >= now - LEAD]
        self.refused += len(due) - len(recent)
        return recent


def scan_rays(odometer: Odometer, mounting: SensorMounting, scan: Scan) -> Rays:
    """Return thinned rays in the present frame of the base, each moved by the odometry at its own time."""
    stamp, readings, scanner = scan.stamp, scan.readings, scan.scanner
    last = max(len(readings) - 1, 0)
    hit = (readings >= scanner.range_min) & (readings <= min(scanner.range_max, _FARTHEST))
    empty = (np.isposinf(readings) | (readings > scanner.range_max)) & ~hit
    ray = np.flatnonzero(hit | empty)
    ray = ray[:: max(1, -(-len(ray) // TRACK_RAYS))]
    ends = odometer.at(np.array([stamp, stamp + scanner.time_increment * last]))
    first, sweep = se2.between(odometer.pose, ends[:1]), se2.between(ends[:1], ends[1:])
    laser = beam_origins(first, sweep, np.zeros(len(ray), np.intp), ray / max(last, 1), mounting)
    sign = -1.0 if mounting.laser_flipped else 1.0
    bearing = laser[:, 2] + sign * (scanner.angle_min + scanner.angle_increment * ray)
    # A ray without a reading shows that there is no wall so far.
    reach = np.where(hit[ray], readings[ray], min(GridConfig().max_clear_distance, scanner.range_max))
    return Rays(laser[:, :2] + reach[:, None] * np.stack(se2.cos_sin(bearing), axis=1), laser[:, :2], hit[ray])
