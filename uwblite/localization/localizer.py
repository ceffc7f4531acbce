"""A robot's pose in a map that is there already, as its measurements come in.

Nothing is known at the start. While the robot drives, the last metres' ranges and scans are searched for in the whole map
(search); what is found lives on as hypotheses, each an extended Kalman filter of its own (hypotheses), and is weighted again
with every search. Only when one explains what was measured, twice in a row, and every other place is a few hundred times
less likely, the pose counts as found. From then on that filter tracks, at a millisecond a scan; where measurements
and map fall apart, the pose counts as lost, and the search begins again with what was measured since.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from .. import se2
from ..arrays import Floats
from ..radio.trilateration import TrilaterationConfig, usable
from ..sensor_log import SensorMounting
from . import hypotheses, verdict
from .comparison import LOOK_BACK, SCAN_EVIDENCE, Comparison, PlaceSearch
from .gyro_turns import GyroTurns
from .hypotheses import RangeFacts
from .known_map import KnownMap
from .odometer import Odometer
from .range_likelihood import range_moments
from .records import LocalizerState, Scanner
from .running_fit import FIT_LOST, FIT_SOUND, full_agreement
from .sensing import Range, Scan, Waiting, scan_rays
from .window import RAYS, Window, WindowLook, WindowRange, way_of

MAP_COVARIANCE = np.diag(np.square((0.02, 0.02, 0.005)))
"""m^2, rad^2; what the map itself is off by: its errors are alike in neighbouring scans, and no filter averages them."""
_FRESH_WAY = 0.1
"""m; a scan taken so far from the last one errs independently of it; a nearer one in proportion."""
_LEAST_FRESH, _STANDING_FRESH = 0.1, 0.02
"""Least share of a scan that is new; the second for a robot that stands: its scans repeat one another."""
_SEARCH_WAY, _SEARCH_TIME = 0.5, 0.5
"""m driven and s between two searches."""
_UNIT_WAY = 1.0
"""m driven between two comparisons of the map's unit with the sensors'."""
_MOST, _FORGET = 40, -14.0
"""Hypotheses, and log-weight below which one goes."""
_MOST_PARTS = 4
"""Into how many parts the window is divided at most: a quarter of ten metres holds what a start needs."""
_PATIENCE = 0.5
"""s by which a measurement may be ahead of the odometry before the odometry counts as silent."""
_UNSEEN_SPEED = 0.3
"""m/s and rad/s; how fast a robot may move while its odometry is silent."""
_SCANS_DIFFER = "the scans do not fit the walls any more"


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
        self._places = PlaceSearch(known)
        self._searched = Window()
        """What the search that is under way goes by."""
        self._names = {name: k for k, name in enumerate(known.anchors.ids)}
        heights = [self.mounting.height_difference(name) or 0.0 for name in known.anchors.ids]
        self._square = np.square(heights) + known.anchors.rise
        self._window = Window()
        self._waiting = Waiting()
        self._parts = 1
        """Into how many parts the window is divided, of which the newest is searched for."""
        self._way = self._scan_way = self._search_way = self._unit_way = 0.0
        self._search_stamp = -np.inf
        self._certain = False
        self._confirmed: tuple[float, Floats] | None = None
        """Odometer and T_map_odom of the first of the searches that agree."""
        self._running = full_agreement(len(known.anchors.ids))
        self._reason = "nothing has been measured yet"
        self.strangers: dict[str, int] = {}
        """Ranges to anchors that are not in the map, by id."""
        self.ends = np.zeros(2)
        """Of rays on walls, and in known space, while the pose was known."""

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
        """Take the heading of a gyro, s and rad from any zero; once its bias is known, the wheels turn as it does."""
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
                self._waiting.add(stamp, Range(self._names[name], value, tag))
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
            scan = Scan(stamp + self.known.laser_delay, readings, self.scanner)
            self._waiting.add(scan.end, scan)
        self._work_off()
        return self.state()

    def state(self) -> LocalizerState:
        """Return the pose at the time of the last odometry."""
        bank, running = self._bank, self._running
        stamp, odometry = self._odometer.stamp, self._wheels.copy()
        far = tuple(self.known.anchors.ids[k] for k in running.moved_anchors())
        if not len(bank):
            nan = np.full((4, 3), np.nan)
            return LocalizerState(stamp, nan[0], nan[1:], 0.0, odometry, True, self._reason, moved_anchors=far)
        order = np.argsort(-bank.log_weight, kind="stable")
        best = int(order[0])
        share, covariance = hypotheses.mixture(bank, best)
        fit = np.exp(running.fit - FIT_SOUND) if self._sees() else running.ranges / verdict.RANGES_FOUND
        quality = float(share[best]) * float(np.clip(fit, 0.0, 1.0)) * (1.0 if self._certain else 0.5)
        reason = "" if self._certain else self._reason
        pose, covariance = bank.poses[best].copy(), covariance + MAP_COVARIANCE
        return LocalizerState(stamp, pose, covariance, quality, odometry, not self._certain, reason, bank.poses[order[1:]], far)

    def _sees(self) -> bool:
        return self.known.walls is not None and bool(self._window.looks)

    def _work_off(self) -> None:
        """Use the measurements that the odometry has reached."""
        if not len(self._odometer):
            return
        self._bridge_silence()
        for until, entry in self._waiting.reached(self._odometer.stamp):
            if isinstance(entry, Scan):
                self._use_scan(entry)
            else:
                self._use_range(entry, until)
        self._search_or_check()

    def _bridge_silence(self) -> None:
        """Where the odometry has fallen silent, let the robot stand, and the pose become unsure."""
        gap = self._waiting.latest - self._odometer.stamp
        if gap > _PATIENCE:
            self._odometer.add(self._waiting.latest - 0.1, self._odometer.pose.copy())
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
        self._window.forget(self._way)
        if not len(self._bank):
            return
        arm = se2.transform(se2.between(self._odometer.pose, then), place)
        bank, weight, likelihood, anywhere = hypotheses.ranged(self._bank, fact, arm)
        self._bank = hypotheses.weighed(bank, likelihood if len(bank) > 1 else np.zeros(1))
        best = int(np.argmax(bank.log_weight))
        self._running.add_range(anchor, float(weight[best]), float(likelihood[best] - anywhere[best]), stamp)

    def _use_scan(self, entry: Scan) -> None:
        rays = scan_rays(self._odometer, self._laser, entry)
        if self._window.wants_look(self._way) and len(rays.hit):
            self._window.add_look(WindowLook(rays.spread(RAYS), self._odometer.pose.copy(), self._way, self._odometer.stamp))
        walls = self.known.walls
        if not len(self._bank) or walls is None or not len(rays.hit):
            return
        driven, self._scan_way = self._way - self._scan_way, self._way
        least = _LEAST_FRESH if driven > 1e-3 else _STANDING_FRESH
        before = self._bank
        self._bank = hypotheses.matched(before, walls, rays, float(np.clip(driven / _FRESH_WAY, least, 1.0)))
        found = walls.agreement(self._bank.poses, rays.spread(RAYS))
        if self._certain and found.fit[0] < FIT_LOST:
            # What does not agree as a whole must not move the pose: walls that the map does not hold lie near others.
            self._bank = before
        if len(self._bank) > 1:
            self._bank = hypotheses.weighed(self._bank, SCAN_EVIDENCE * min(driven, 1.0) * found.log_likelihood)
        best = int(np.argmax(self._bank.log_weight))
        if self._certain:
            self.ends += found.known[best] * np.array([found.on_wall[best], 1.0])
        self._running.add_scan(float(found.fit[best]), bool(found.met[best] >= verdict.FEW_ENDS), self._odometer.stamp)

    def _search_or_check(self) -> None:
        """Do a unit of a search that is under way, or begin one where it is time for it."""
        if self._certain and (why := self._doubted()):
            self._lose(why)
        elif not self._certain and self._running.jumped():
            self._lose("the ranges do not fit what was measured before; was the robot carried?")
        odom = self._odometer.pose
        if (found := self._places.advance(odom)) is not None:
            compared = self._places.compared(found, self._bank, self._searched, odom, self._way)
            if not self._certain:
                self._decide_by(compared)
            elif compared.elsewhere:
                self._lose(_SCANS_DIFFER)
        if self._places.idle and (not self._certain or self._running.scans_contradict()) and self._due():
            # Of a pose that ranges vouch for, places are compared by what was measured since it was sound.
            self._searched = self._window.since(self._running.sound) if self._certain else self._window.newest(self._parts)
            self._places.begin(self._searched, odom, self._way)

    def _due(self) -> bool:
        """Return whether it is time for another search, and remember it."""
        now = self._odometer.stamp
        if self._way - self._search_way < _SEARCH_WAY and now - self._search_stamp < _SEARCH_TIME:
            return False
        self._search_way, self._search_stamp = self._way, now
        return True

    def _doubted(self) -> str:
        """Return why the pose counts as lost; "" = it does not.

        One that ranges vouch for is given up only where another place explains better what was measured since.
        """
        if self._way - self._unit_way >= _UNIT_WAY:
            self._unit_way = self._way
            if why := self._other_unit():
                return why
        if self._sees() and self._running.scans_contradict():
            return "" if self._running.ranges_vouch(self._odometer.stamp) else _SCANS_DIFFER
        return "the ranges do not fit the anchors any more" if self._running.ranges_contradict() else ""

    def _other_unit(self) -> str:
        """Return why the map's unit is another one than the sensors', by the last metres; "" = it is not."""
        odom, way = self._odometer.pose, self._way
        rays, ago = self._window.seen(odom, way, LOOK_BACK)
        ranges = self._window.ranges_since(odom, way)
        return verdict.other_unit(self.known.walls, self._bank.poses[0], rays, len(np.unique(ago)), ranges, False)

    def _lose(self, why: str) -> None:
        self._certain, self._confirmed, self._reason = False, None, why
        self._window, self._parts = self._window.since(self._running.agreed()), 1
        self._places.drop()
        self._running.forget_anchors()
        self._search_way, self._search_stamp = self._way, self._odometer.stamp

    def _decide_by(self, found: Comparison) -> None:
        """Weight all hypotheses again by what a search found, and decide."""
        if not len(found.bank):
            self._bank, self._reason = found.bank, verdict.too_little(found.rays, found.ranges)
            return
        self._bank = found.hypotheses
        best = int(np.argmax(self._bank.log_weight))
        fit, known, ranges = float(found.fit[best]), float(found.known[best]), found.ranges
        if known < verdict.FEW_ENDS and len(ranges):
            self._bank = hypotheses.placed(self._bank, best, *range_moments(self._bank.poses[best], ranges))
        pose = self._bank.poses[best].copy()
        fitting = verdict.agreeing(pose, ranges)
        self._reason = verdict.doubt(self._bank, best, found.complete, fit, known, fitting) or verdict.other_unit(
            self.known.walls, pose, found.rays, found.looks, ranges, True
        )
        self._trim(bool(verdict.nowhere(fit, known, fitting)))
        self._bank = hypotheses.pruned(self._bank, _MOST, _FORGET)
        self._decide(pose, verdict.confirming_way(fit, known, fitting))

    def _trim(self, nowhere: bool) -> None:
        """Choose the part of the window that the next search goes by.

        What fits nowhere may be of two places, before and after the robot was carried: its newest half is tried, then
        its newest quarter. Once such a part is enough by itself, the rest is forgotten.
        """
        if self._parts > 1 and not self._reason:
            self._window = self._searched
        self._parts = 2 * self._parts if nowhere and self._parts < _MOST_PARTS else 1

    def _decide(self, pose: Floats, confirm: float) -> None:
        """Take the best hypothesis for the truth where two searches, so many metres apart, came to it without a doubt."""
        if self._reason:
            self._confirmed = None
            return
        self._reason = "found; a little more driving will confirm it"
        odom, confirmed = self._odometer.pose, self._confirmed
        if confirmed is None or hypotheses.apart(pose, se2.compose(confirmed[1], odom)[None])[0]:
            self._confirmed = (self._way, se2.compose(pose, se2.inverse(odom)))
        elif self._way - confirmed[0] >= confirm:
            self._certain = True
            self._bank = hypotheses.pruned(self._bank, 1, -1.0)
            self._running.restart(self._sees())
