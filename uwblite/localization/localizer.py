"""A robot's pose in an existing map, from its measurements as they come in.

Measurements wait here until the odometry has reached them, then they are corrected by the map's calibration and transformed to
the robot's base; the pose is estimated from them in pose_estimator.
"""

import numbers
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se2
from ..arrays import Floats, as_array, require_shape, require_type
from ..clocks.sensor_clock import JUMP, SensorClock
from ..errors import DataError
from ..odometry.gyro import GyroTurns
from ..odometry.odometer import Odometer
from ..sensor_log import SensorMounting, plausible
from .known_map import KnownMap
from .pose_estimator import LocalizerState, PoseEstimator
from .sensing import CONFIRMED, LEAD, Range, Scan, Scanner, Waiting, scan_rays

_PATIENCE = 0.5
"""s by which a measurement may be ahead of the odometry before the odometry counts as silent, until it was seen to be late."""
UNSEEN_SPEED = 0.3
"""m/s and rad/s; how fast a robot may move while its odometry is silent."""
_WORK = 4_000_000
"""Operations of a step from which on it uses no further measurement: after a silence many are due at once, and where the pose
is not known each is compared with many places."""
_BEYOND = 1e8
"""m and rad; a pose or a heading farther from zero is invalid: differences between such numbers lose all digits."""


class Localizer:
    """Find and track a robot.

    Parameters
    ----------
    known : the map. mounting : of the robot's sensors. scanner : its lidar; None where it comes with the scans.

    Notes
    -----
    Not for several threads at once. Measurements may come out of order by some tenths of a second; one that is
    ahead of the odometry waits for it.
    """

    def __init__(self, known: KnownMap, mounting: SensorMounting | None = None, scanner: Scanner | None = None) -> None:
        self.mounting, self.scanner = mounting or SensorMounting(), scanner
        heights = [self.mounting.height_difference(name) or 0.0 for name in known.anchors.ids]
        self.known = known = replace(known, anchors=replace(known.anchors, rise=known.anchors.rise + np.square(heights)))
        self._laser = replace(self.mounting, T_base_laser=se2.compose(known.laser_correction, self.mounting.T_base_laser))
        self._odometer, self._turns, self._waiting = Odometer(), GyroTurns(), Waiting()
        self._estimator = PoseEstimator(known, self._odometer)
        self._wheels, self._measured = np.full_like(known.laser_correction, np.nan), -np.inf
        self._patience = _PATIENCE
        self._astray: list[tuple[float, Floats]] = []
        """Poses whose stamps do not continue the others: as long as it is not clear whether the clock was set."""
        self._refused = 0
        self._range_clock: SensorClock[tuple[int, float, int]] = SensorClock(self.on_time)
        self._scan_clock: SensorClock[tuple[Floats, Scanner]] = SensorClock(self.on_time)
        self._step, self._silences = 0.0, 0
        """Last step of the odometry's stamps, s, and how many were far longer than the one before."""
        self._clock_shift = 0.0
        """s, added to the odometry's stamps so that time goes on where its clock was set back."""
        self._names = {name: k for k, name in enumerate(known.anchors.ids)}
        self._rays = 0
        """Of a scan; 0 = none has come."""
        self.strangers: dict[str, int] = {}
        """Ranges to anchors that are not in the map, by id."""

    @property
    def refused(self) -> int:
        """Measurements that were left out, of whatever kind: stamped seconds apart from all others."""
        return self._waiting.refused + self._refused

    @property
    def work(self) -> int:
        """Operations on elements of arrays in the last step: what a step costs, whatever else the computer does."""
        return self._estimator.work

    @property
    def tracks(self) -> bool:
        """Whether one place is tracked, however vague the pose has become."""
        return self._estimator.tracks

    @property
    def ends(self) -> Floats:
        """(2,) numbers of rays on walls, and in known space, while the pose was known."""
        return self._estimator.ends.copy()

    def add_odometry(self, stamp: float, x: float, y: float, theta: float) -> LocalizerState:
        """Take a pose of the base in the drifting odometry frame; s, m, m, rad."""
        stamp, *pose = _numbers(stamp=stamp, x=x, y=y, theta=theta)
        wheels = np.array(pose)
        self._estimator.work = 0
        wheels[~(np.abs(wheels) < _BEYOND)] = np.nan
        stamp += self._clock_shift
        ahead = len(self._odometer) > 0 and self._odometer.stamp + LEAD < stamp < np.inf
        if ahead or stamp < self._measured - JUMP:
            self._set_aside(stamp, wheels, ahead)
            return self.state()
        self._refused, self._astray = self._refused + len(self._astray), []
        if self._measured < min(stamp, self._odometer.stamp) and stamp <= self._measured + LEAD:
            # It was not silent but late, or rare: the bridged motion is measured now, and the next time the localiser waits
            # longer.
            self._patience = min(2.0 * self._patience, LEAD)
            self._odometer.forget_from(np.nextafter(self._measured, np.inf))
        self._move(stamp, wheels)
        self._waiting.refuse(self._odometer.stamp)
        self._work_off()
        return self.state()

    def add_gyro(self, stamp: float, heading: float) -> LocalizerState:
        """Take the heading of a gyro, s and rad from any zero; once its bias is known, the wheels turn as it does."""
        stamp, heading = _numbers(stamp=stamp, heading=heading)
        if abs(heading) < _BEYOND:
            self._turns.add(self.on_time(stamp), heading)
        return self.state()

    def add_ranges(self, stamp: float, anchor_ids: Sequence[str], metres: ArrayLike, tag: int = 0) -> LocalizerState:
        """Take the ranges of one round.

        Parameters
        ----------
        stamp : s, on the odometry's clock. anchor_ids, metres : (m,) of each range. tag : which of the robot's tags measured.

        Raises
        ------
        DataError : there are more ids than ranges, or fewer; or the robot has no such tag.
        """
        (stamp,) = _numbers(stamp=stamp)
        values = as_array(metres, "metres").reshape(-1)
        if isinstance(anchor_ids, str) or not all(isinstance(name, str) for name in anchor_ids):
            raise DataError(f"anchor_ids must be a list of names, not {anchor_ids!r:.60}")
        if not 0 <= tag < len(self.mounting.tags):
            raise DataError(f"tag {tag} is none of the robot's {len(self.mounting.tags)} tags; they count from 0")
        self._estimator.work = 0
        if len(anchor_ids) != len(values):
            raise DataError(f"{len(anchor_ids)} anchor ids for {len(values)} ranges; one id belongs to each range")
        good = plausible(values)
        for name, value in zip(np.asarray(list(anchor_ids))[good].tolist(), values[good].tolist(), strict=True):
            if name not in self._names:
                self.strangers[name] = self.strangers.get(name, 0) + 1
                continue
            for at, entry in self._range_clock.take(stamp, self._measured, self._silences, (self._names[name], value, tag)):
                self._waiting.add(at, Range(*entry))
        self._work_off()
        return self.state()

    def add_scan(self, stamp: float, ranges: ArrayLike, scanner: Scanner | None = None) -> LocalizerState:
        """Take a scan.

        Parameters
        ----------
        stamp : s, of the first ray, on the lidar's clock. ranges : (b,) m; inf = nothing seen, nan = invalid.
        scanner : geometry, where it is not the one of before.

        Raises
        ------
        DataError : the scan has another number of rays than those before it by the same scanner, and some.
        """
        (stamp,), readings = _numbers(stamp=stamp), as_array(ranges, "ranges")
        if scanner is not None and scanner != self.scanner:
            self.scanner, self._rays = scanner, 0
        self._rays = self._rays or len(readings)
        require_shape(readings, "ranges", (self._rays if len(readings) else 0,))
        self._estimator.work = 0
        if self.scanner is not None and self.scanner.usable and self.known.walls is not None:
            for at, entry in self._scan_clock.take(stamp, self._measured, self._silences, (readings, self.scanner)):
                scan = Scan(at + self.known.laser_delay, *entry)
                self._waiting.add(scan.end, scan)
        self._work_off()
        return self.state()

    def state(self) -> LocalizerState:
        """Return the pose at the time of the last odometry."""
        state = self._estimator.state(self._wheels)
        return replace(state, stamp=state.stamp - self._clock_shift) if self._clock_shift else state

    def on_time(self, stamp: float) -> float:
        """Return a sensor's stamp on a clock that was never set back, s: the sensor's was, if that brings it nearer."""
        return min(stamp + self._clock_shift, stamp, key=lambda t: abs(t - self._odometer.stamp))

    def _set_aside(self, stamp: float, wheels: Floats, ahead: bool) -> None:
        """Take a pose (3,) of the wheels whose stamp does not continue the others.

        After a silence, or because the clock was set, several come in order; one alone is a fault.
        """
        if self._astray and not 0.0 < stamp - self._astray[-1][0] <= LEAD:
            self._refused, self._astray = self._refused + len(self._astray), []
        self._astray.append((stamp, wheels))
        if len(self._astray) < (2 if ahead else CONFIRMED):
            return
        astray, self._astray = self._astray, []
        if not ahead:
            # The first of them was one period after the last one by the old clock.
            shift = self._measured + (astray[1][0] - astray[0][0]) - astray[0][0]
            self._clock_shift += shift
            astray = [(earlier + shift, pose) for earlier, pose in astray]
            self._odometer.forget_from(astray[0][0])
        for at, pose in astray:
            self._move(at, pose)
        self._work_off()

    def _move(self, stamp: float, wheels: Floats) -> None:
        """Move the pose to a later one (3,) of the wheels."""
        step = self._odometer.add(stamp, self._turns.turned(stamp, wheels))
        if self._odometer.stamp == stamp:
            self._silences += stamp - self._measured > self._step + JUMP
            self._step, self._wheels, self._measured = stamp - self._measured, wheels, stamp
        if step is not None:
            self._estimator.move(step)

    def _work_off(self) -> None:
        """Use the measurements that the odometry has reached."""
        if not len(self._odometer):
            return
        self._bridge_silence()
        due = self._waiting.reached(self._odometer.stamp)
        ranged = [until for until, entry in due if isinstance(entry, Range)]
        poses = dict(zip(ranged, self._odometer.at(np.array(ranged)), strict=True)) if ranged else {}
        free = not any(isinstance(entry, Scan) for _, entry in due)
        for k, (until, entry) in enumerate(due):
            if self._estimator.work > _WORK:
                self._waiting.put_back(due[k:])
                break
            if isinstance(entry, Scan):
                self._estimator.use_scan(scan_rays(self._odometer, self._laser, entry))
            else:
                tag = self.mounting.tags[entry.tag, :2]
                self._estimator.use_range(entry.anchor, entry.metres, tag, until, poses[until])
        self._estimator.search_or_check(free=free)

    def _bridge_silence(self) -> None:
        """Where the odometry is silent, let the robot stand, and increase the uncertainty of the pose."""
        latest = self._waiting.latest(self._odometer.stamp)
        gap = latest - self._odometer.stamp
        if gap > self._patience:
            self._odometer.add(latest, self._odometer.pose.copy())
            self._estimator.wander(UNSEEN_SPEED * min(gap, LEAD))


def _numbers(**values: float) -> list[float]:
    """Return numbers as they are; of what is none the name is said."""
    for name, value in values.items():
        require_type(value, name, numbers.Real, "number")
    return [float(value) for value in values.values()]
