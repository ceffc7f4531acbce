"""A robot's pose in a map that is there already, as its measurements come in.

Nothing is known at the start. While the robot drives, the last metres' ranges and scans are searched for in the whole map
(search); what is found lives on as hypotheses, each an extended Kalman filter of its own (hypotheses), and is weighted again
with every search. Only when one explains what was measured, twice in a row, and every other place is a few hundred times
less likely, the pose counts as found. From then on that filter tracks, at a millisecond a scan; where measurements
and map fall apart, the pose counts as lost, and the search begins again with what was measured since.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se2
from ..arrays import Floats
from ..radio.trilateration import TrilaterationConfig, usable
from ..sensor_log import SensorMounting
from . import hypotheses, search, verdict
from .gyro_turns import GyroTurns
from .hypotheses import Hypotheses, RangeFacts
from .known_map import KnownMap
from .odometer import Odometer
from .records import LocalizerState, Scanner
from .sensing import TRACK_RAYS, Range, Scan, scan_rays
from .walls import Rays
from .window import RAYS, Ranges, Window, WindowLook, WindowRange, way_of

MAP_COVARIANCE = np.diag(np.square((0.02, 0.02, 0.005)))
"""m^2, rad^2; what the map itself is off by: its errors are alike in neighbouring scans, and no filter averages them."""
_FRESH_WAY = 0.1
"""m; a scan taken so far from the last one errs independently of it; a nearer one in proportion."""
_LEAST_FRESH = 0.1
_STANDING_FRESH = 0.02
"""The same for a robot that stands: its scans repeat one another."""
_SCAN_EVIDENCE = 15.0
"""Rays per metre of driving that count as independent when places are compared."""
_LOOK_BACK = 4.0
"""m driven, of whose scans places are compared."""
_SEARCH_LOOKS = 2.5
"""m driven, of whose scans the search makes one cloud."""
_FORGET = -14.0
"""Log-weight below which a hypothesis goes."""
_FIT_SOUND, _FIT_LOST = -0.3, -0.7
"""Mean log-likelihood of the last scans' rays from which nothing is doubtful, and below which the pose is lost."""
_RANGES_LOST = 0.25
"""Mean weight of ranges below which the pose is lost."""
_CONFIRM, _CONFIRM_ALONE = 0.5, 2.0
"""m driven between two searches that agree; the second where scans or ranges are alone."""
_FORGETTING, _FORGETTING_RANGES = 0.1, 0.2
"""Share of a new scan, and of a new range, in the mean of the last ones: a second of scans, two rounds of four ranges."""
_SEEN = 0.5
"""Share of the last scans that must have met known space for their fit to speak for a pose that ranges contradict."""
_SOUND_WEIGHT = 0.5
"""Weight from which a range speaks for the pose; what was measured since the last one, or the last scan that fits, begins the
search of a robot that is lost."""
_RANGES_SOUND, _RECENT = 0.5, 5.0
"""Mean weight of ranges, the last of them s ago, from which they speak for a pose that scans contradict: it is given up only
for a better one. Rooms that the map holds in part look like that, and people around the robot."""
_SEARCH_WAY, _SEARCH_TIME = 0.5, 1.0
"""m driven and s between two searches."""
_MOST = 40
"""Hypotheses."""
_PATIENCE = 0.5
"""s by which a measurement may be ahead of the odometry before the odometry counts as silent."""
_UNSEEN_SPEED = 0.3
"""m/s and rad/s; how fast a robot may move while its odometry is silent."""


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Places in the map, and how well each explains what was measured."""

    bank: Hypotheses
    """The present hypotheses first."""
    complete: bool
    """No place that is as good was left out."""
    weight: Floats
    """(h,) log-likelihood."""
    fit: Floats
    """(h,) mean log-likelihood of the rays."""
    known: Floats
    """(h,) rays' ends in known space."""
    rays: Rays
    ranges: Ranges


class Localizer:
    """Find and track a robot.

    Parameters
    ----------
    known : the map. mounting : where the robot's sensors sit. scanner : its lidar; None where scans bring it with them.

    Notes
    -----
    Not for several threads at once. Measurements may come out of order by some tenths of a second; one that is
    ahead of the odometry waits for it.
    """

    def __init__(self, known: KnownMap, mounting: SensorMounting | None = None, scanner: Scanner | None = None) -> None:
        self.known, self.mounting, self.scanner = known, mounting or SensorMounting(), scanner
        self._laser = replace(self.mounting, T_base_laser=se2.compose(known.laser_correction, self.mounting.T_base_laser))
        self._odometer, self._turns = Odometer(), GyroTurns()
        self._wheels = np.full(3, np.nan)
        self._bank = hypotheses.none(len(known.anchors.ids))
        self._field = None if known.walls is None else search.field_of(known.walls)
        self._bounds = _bounds(known)
        self._names = {name: k for k, name in enumerate(known.anchors.ids)}
        heights = [self.mounting.height_difference(name) or 0.0 for name in known.anchors.ids]
        self._square = np.square(heights) + known.anchors.rise
        self._window = Window()
        self._waiting: list[tuple[float, int, Range | Scan]] = []
        self._arrived = 0
        self._way = self._scan_way = self._search_way = 0.0
        self._search_stamp = -np.inf
        self._certain = False
        self._confirmed: tuple[float, Floats] | None = None
        self._fit, self._seen, self._ranges_fit = 0.0, 0.0, 1.0
        self._sound = self._ranged = -np.inf
        self._trust = np.full((len(known.anchors.ids), 2), (1.0, 0.0))
        self._reason = "nothing has been measured yet"
        self.strangers: dict[str, int] = {}
        """Ranges to anchors that the map does not know, by id."""
        self.ends = np.zeros(2)
        """Of rays on walls, and in known space, while the pose was known."""

    # ---- what comes in

    def add_odometry(self, stamp: float, x: float, y: float, theta: float) -> LocalizerState:
        """Take a pose of the base in the drifting odometry frame; s, m, m, rad."""
        wheels = np.array([x, y, theta], dtype=np.float64)
        step = self._odometer.add(stamp, self._turns.turned(stamp, wheels))
        if self._odometer.stamp == stamp:
            self._wheels = wheels
        if step is not None:
            self._bank = hypotheses.moved(self._bank, step)
            self._way += way_of(step)
        self._work_off()
        return self.state()

    def add_gyro(self, stamp: float, heading: float) -> LocalizerState:
        """Take the heading of a gyro from any zero, bias and all; s, on the odometry's clock, rad.

        From when its bias is known on, the steps of the wheels turn as it does.
        """
        self._turns.add(stamp, heading)
        return self.state()

    def add_ranges(self, stamp: float, anchor_ids: Sequence[str], metres: ArrayLike, tag: int = 0) -> LocalizerState:
        """Take the ranges of one round.

        Parameters
        ----------
        stamp : s, on the odometry's clock. anchor_ids, metres : (m,) of each range. tag : which of the robot's tags measured.
        """
        values = np.asarray(metres, dtype=np.float64).reshape(-1)
        good = usable(values, TrilaterationConfig())
        for name, value in zip(np.asarray(anchor_ids)[good].tolist(), values[good].tolist(), strict=True):
            if name in self._names:
                self._wait(stamp, Range(self._names[name], value, tag))
            else:
                self.strangers[name] = self.strangers.get(name, 0) + 1
        self._work_off()
        return self.state()

    def add_scan(self, stamp: float, ranges: ArrayLike, scanner: Scanner | None = None) -> LocalizerState:
        """Take a scan.

        Parameters
        ----------
        stamp : s, of the first ray, on the lidar's clock. ranges : (b,) m; inf = nothing seen, nan = invalid.
        scanner : geometry, where it is not the one of before.
        """
        self.scanner = scanner or self.scanner
        if self.scanner is not None and self.known.walls is not None:
            readings = np.asarray(ranges, dtype=np.float64).reshape(-1)
            begin = stamp + self.known.laser_delay
            # A recording that is played backwards has its last ray first.
            end = max(begin, begin + self.scanner.time_increment * max(len(readings) - 1, 0))
            self._wait(end, Scan(stamp + self.known.laser_delay, readings, self.scanner))
        self._work_off()
        return self.state()

    # ---- what is known

    def state(self) -> LocalizerState:
        """Return the pose at the time of the last odometry."""
        bank = self._bank
        stamp = self._odometer.stamp
        odometry = self._wheels.copy()
        if not len(bank):
            nothing = np.full((3, 3), np.nan)
            nowhere = np.full(3, np.nan)
            return LocalizerState(stamp, nowhere, nothing, 0.0, odometry, True, self._reason, moved_anchors=self._moved())
        order = np.argsort(-bank.log_weight, kind="stable")
        best = int(order[0])
        share = np.exp(bank.log_weight)
        share /= share.sum()
        covariance = bank.pose_covariances[best]
        if not self._certain:
            off = se2.between(np.zeros(3), bank.poses - bank.poses[best])
            covariance = np.einsum("h,hij->ij", share, bank.pose_covariances + off[:, :, None] * off[:, None, :])
        fit = np.exp(self._fit - _FIT_SOUND) if self._sees() else self._ranges_fit / verdict.RANGES_FOUND
        quality = float(share[best]) * float(np.clip(fit, 0.0, 1.0)) * (1.0 if self._certain else 0.5)
        reason = "" if self._certain else self._reason
        pose, covariance = bank.poses[best].copy(), covariance + MAP_COVARIANCE
        return LocalizerState(
            stamp, pose, covariance, quality, odometry, not self._certain, reason, bank.poses[order[1:]], self._moved()
        )

    def _moved(self) -> tuple[str, ...]:
        """Return the anchors that most ranges have long disagreed with."""
        far = (self._trust[:, 0] < _MOVED[0]) & (self._trust[:, 1] >= _MOVED[1])
        return tuple(self.known.anchors.ids[k] for k in np.flatnonzero(far))

    def _sees(self) -> bool:
        return self.known.walls is not None and bool(self._window.looks)

    # ---- measurements, in the order of their times

    def _wait(self, until: float, entry: Range | Scan) -> None:
        if np.isfinite(until):
            self._waiting.append((until, self._arrived, entry))
            self._arrived += 1

    def _work_off(self) -> None:
        """Use the measurements that the odometry has reached."""
        if not self._waiting or not len(self._odometer):
            return
        self._bridge_silence()
        now = self._odometer.stamp
        due = sorted((w for w in self._waiting if w[0] <= now), key=lambda w: w[:2])
        self._waiting = [w for w in self._waiting if w[0] > now]
        for until, _, entry in due:
            if isinstance(entry, Scan):
                self._use_scan(entry)
            else:
                self._use_range(entry, until)
        if due:
            self._search_or_check()

    def _bridge_silence(self) -> None:
        """Where the odometry has fallen silent, let the robot stand, and the pose become unsure."""
        latest = max(w[0] for w in self._waiting)
        gap = latest - self._odometer.stamp
        if gap > _PATIENCE:
            self._odometer.add(latest - 0.1, self._odometer.pose.copy())
            self._bank = hypotheses.moved(self._bank, np.zeros(3), _UNSEEN_SPEED * min(gap, 3.0))

    def _use_range(self, entry: Range, stamp: float) -> None:
        anchors, tags, anchor = self.known.anchors, self.mounting.tags, entry.anchor
        fact = RangeFacts(
            anchor, anchors.positions[anchor], entry.metres - float(anchors.bias[anchor]), float(self._square[anchor]),
            float(anchors.sigma[anchor]), anchors.scale,
        )  # fmt: skip
        then = self._odometer.at(np.array([stamp]))[0]
        place = tags[min(max(entry.tag, 0), len(tags) - 1), :2]
        self._window.add_range(WindowRange(fact, then, place, self._way, stamp))
        if not len(self._bank):
            return
        arm = se2.transform(se2.between(self._odometer.pose, then), place)
        bank, weight, likelihood = hypotheses.ranged(self._bank, fact, arm)
        self._bank = hypotheses.weighed(bank, likelihood if len(bank) > 1 else np.zeros(1))
        best = float(weight[int(np.argmax(bank.log_weight))])
        self._trust[anchor] += (_FORGETTING * (best - self._trust[anchor, 0]), 1.0)
        self._ranges_fit += _FORGETTING_RANGES * (best - self._ranges_fit)
        self._ranged = max(self._ranged, stamp)
        if best > _SOUND_WEIGHT:
            self._sound = max(self._sound, stamp)

    def _use_scan(self, entry: Scan) -> None:
        rays = scan_rays(self._odometer, self._laser, entry)
        if self._window.wants_look(self._way) and len(rays.hit):
            self._window.add_look(WindowLook(_every(rays, RAYS), self._odometer.pose.copy(), self._way, self._odometer.stamp))
            self._window.forget(self._way)
        walls = self.known.walls
        if not len(self._bank) or walls is None or not len(rays.hit):
            return
        driven = self._way - self._scan_way
        self._scan_way = self._way
        least = _LEAST_FRESH if driven > 1e-3 else _STANDING_FRESH
        before = self._bank
        self._bank = hypotheses.matched(before, walls, rays, float(np.clip(driven / _FRESH_WAY, least, 1.0)))
        few = _every(rays, RAYS)
        found = walls.agreement(self._bank.poses, few)
        if self._certain and found.fit[0] < _FIT_LOST:
            # What does not agree as a whole must not move the pose: walls that the map does not hold lie near others.
            self._bank = before
        if len(self._bank) > 1:
            self._bank = hypotheses.weighed(self._bank, _SCAN_EVIDENCE * min(driven, 1.0) * found.log_likelihood)
        best = int(np.argmax(self._bank.log_weight))
        informative = bool(found.known[best] >= verdict.FEW_ENDS)
        if self._certain:
            self.ends += found.known[best] * np.array([found.on_wall[best], 1.0])
        self._seen += _FORGETTING * (informative - self._seen)
        if informative:
            self._fit += _FORGETTING * (float(found.fit[best]) - self._fit)
            if found.fit[best] > _FIT_SOUND:
                self._sound = max(self._sound, self._odometer.stamp)

    # ---- the start, and what ends in one

    def _search_or_check(self) -> None:
        if self._certain:
            why = self._doubted()
            if not why:
                return
            self._lose(why)
        if self._due():
            self._search()

    def _due(self) -> bool:
        """Return whether it is time for another search, and remember it."""
        now = self._odometer.stamp
        if self._way - self._search_way < _SEARCH_WAY and now - self._search_stamp < _SEARCH_TIME:
            return False
        self._search_way, self._search_stamp = self._way, now
        return True

    def _doubted(self) -> str:
        """Return why the pose counts as lost; "" = it does not."""
        if self._sees() and self._fit < _FIT_LOST:
            vouched = self._ranges_fit > _RANGES_SOUND and self._odometer.stamp - self._ranged < _RECENT
            if not vouched or (self._due() and self._elsewhere()):
                return "the scans do not fit the walls any more"
        elif self._ranges_fit < _RANGES_LOST and not (self._seen > _SEEN and self._fit > _FIT_SOUND):
            return "the ranges do not fit the anchors any more"
        return ""

    def _elsewhere(self) -> bool:
        """Return whether another place explains better what was measured since the pose was last sound."""
        found = self._compared(self._window.since(self._sound))
        rivals = found.weight[hypotheses.apart(self._bank.poses[0], found.bank.poses)]
        return found.complete and bool(rivals.max(initial=-np.inf) > found.weight[0] + verdict.CERTAIN)

    def _lose(self, why: str) -> None:
        self._certain, self._confirmed, self._reason = False, None, why
        self._window = self._window.since(self._sound)
        self._trust[:] = (1.0, 0.0)
        self._search_way, self._search_stamp = self._way, self._odometer.stamp

    def _compared(self, window: Window) -> _Comparison:
        """Search the whole map for what a window holds, and weight what is found together with the present hypotheses."""
        odom, walls = self._odometer.pose, self.known.walls
        ranges = window.ranges_since(odom, self._way)
        rays, ago = window.seen(odom, self._way, _LOOK_BACK)
        recent = rays.rows(ago <= _SEARCH_LOOKS)
        found = search.places(self._field, walls, recent, ranges, self._bounds)
        bank = self._with_places(found.poses, ranges, recent)
        weight = search.range_likelihood(bank.poses, ranges)
        fit, known = np.zeros(len(bank)), np.zeros(len(bank))
        if walls is not None and len(rays.hit):
            agreement = walls.agreement(bank.poses, rays)
            weight += _SCAN_EVIDENCE * (1.0 + float(ago.max())) * agreement.log_likelihood
            fit, known = agreement.log_likelihood, agreement.known
        return _Comparison(bank, found.complete, weight, fit, known, rays, ranges)

    def _search(self) -> None:
        """Look for the robot in the whole map, weight all hypotheses again, and decide."""
        found = self._compared(self._window)
        if not len(found.bank):
            self._bank, self._reason = found.bank, verdict.too_little(found.rays, found.ranges)
            return
        level = Hypotheses(found.bank.mean, found.bank.covariance, np.zeros(len(found.bank)))
        self._bank = hypotheses.weighed(level, found.weight)
        best = int(np.argmax(self._bank.log_weight))
        fit, known, ranges = float(found.fit[best]), float(found.known[best]), found.ranges
        if known < verdict.FEW_ENDS and len(ranges):
            self._bank = hypotheses.placed(self._bank, best, *search.range_moments(self._bank.poses[best], ranges))
        pose = self._bank.poses[best].copy()
        fitting = verdict.agreeing(pose, ranges)
        self._reason = verdict.doubt(self._bank, best, found.complete, fit, known, fitting)
        self._bank = hypotheses.pruned(self._bank, _MOST, _FORGET)
        self._decide(pose, _CONFIRM if fitting.enough and known >= verdict.FEW_ENDS else _CONFIRM_ALONE)

    def _with_places(self, poses: Floats, ranges: Ranges, rays: Rays) -> Hypotheses:
        """Return the hypotheses with new ones where none is near."""
        for pose in self._bank.poses:
            poses = poses[hypotheses.apart(pose, poses)]
        if not len(poses):
            return self._bank
        scans = self.known.walls is not None and rays.hit.sum() >= verdict.FEW_ENDS
        covariances = np.tile(np.diag(np.square(_SIGMA_SCAN)), (len(poses), 1, 1))
        if not scans:
            hessian, _ = search.range_factors(poses, ranges)
            covariances = np.linalg.inv(hessian + np.diag([0.01, 0.01, 0.1])) + np.diag(np.square(_SIGMA_FLOOR))
        fresh = hypotheses.started(poses, covariances, len(self.known.anchors.ids))
        if scans and self.known.walls is not None:
            fresh = hypotheses.matched(fresh, self.known.walls, _every(rays, TRACK_RAYS), 1.0)
        return hypotheses.joined(self._bank, fresh)

    def _decide(self, pose: Floats, confirm: float) -> None:
        """Take the best hypothesis for the truth where two searches, some way apart, came to it without a doubt."""
        if self._reason:
            self._confirmed = None
            return
        odom = self._odometer.pose
        if self._confirmed is not None:
            way, T_map_odom = self._confirmed
            same = not hypotheses.apart(pose, se2.compose(T_map_odom, odom)[None])[0]
            if same and self._way - way >= confirm:
                self._certain = True
                self._bank = hypotheses.pruned(self._bank, 1, -1.0)
                self._fit, self._seen, self._ranges_fit = 0.0, 1.0 if self._sees() else 0.0, 1.0
                self._trust[:] = (1.0, 0.0)
                return
            if same:
                self._reason = "found; a little more driving will confirm it"
                return
        self._confirmed = (self._way, se2.compose(pose, se2.inverse(odom)))
        self._reason = "found; a little more driving will confirm it"


_SIGMA_SCAN = (0.2, 0.2, 0.06)
"""m, m, rad; of a place that the search found by scans."""
_SIGMA_FLOOR = (0.1, 0.1, 0.03)
"""m, m, rad; drift within the window, on top of what ranges say of a place."""
_MOVED = (0.2, 20.0)
"""Mean weight below which, after so many ranges, an anchor counts as moved."""


def _every(rays: Rays, count: int) -> Rays:
    """Return at most so many rays, evenly spread."""
    return rays.rows(np.unique(np.linspace(0, len(rays.hit) - 1, count).astype(np.int64)))


_RADIO_REACH = 15.0
"""m beyond the outermost anchors; where a robot may be in a map without a grid."""


def _bounds(known: KnownMap) -> tuple[Floats, Floats]:
    """Return the corners (2,) of the area in which the robot may be, m."""
    if known.walls is not None:
        return known.walls.geometry.origin, known.walls.geometry.corner
    return known.anchors.positions.min(axis=0) - _RADIO_REACH, known.anchors.positions.max(axis=0) + _RADIO_REACH
