"""Estimation of a robot's pose from its ranges and scans, each with the odometry at its time.

The start is unknown. While the robot drives, the whole map is searched with the last metres' ranges and scans
(search); the resulting poses become hypotheses, each an extended Kalman filter (hypotheses), and are weighted again
with every search. Only when one is a few hundred times likelier than every other place, and than a place in another
building, the pose counts as found (verdict). From then on that filter tracks, at a millisecond a scan; where measurements
contradict the map, the pose counts as lost, and the search begins again with the measurements since then.
"""

from dataclasses import dataclass, field

import numpy as np

from .. import se2
from ..arrays import Floats
from ..config import documented
from ..odometry.odometer import Odometer
from . import hypotheses, verdict
from .comparison import Comparison, PlaceSearch
from .hypotheses import Hypotheses
from .known_map import KnownMap
from .range_model import repeated
from .running_fit import SUPPORT, full_agreement
from .search import MOST_PLACES
from .walls import ELSEWHERE, INDEPENDENT_RAYS, PER_FACTOR, PER_RAY, Agreement, Rays, Walls
from .window import RAYS, Window, WindowLook, WindowRange, way_of

_FRESH_WAY = _UNFELT = 0.1
"""m; the error of a scan taken so far from the last one is independent of the last one's; nearer, in proportion. And m and rad,
motion between two scans that the wheels do not measure, of a robot that is pushed or whose wheels are frozen."""
_STILL = 1e-3
"""m; a robot that has driven less stands, and its scans repeat one another: each is as new as after so much."""
_SEARCH_TIME = 0.5
"""s between two searches."""
_STANDS = np.zeros(se2.POSE)
_SCANS_DIFFER = "the scans do not fit the walls any more"


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LocalizerState:
    """Present estimate of the robot's pose."""

    stamp: float
    """s, of the last odometry."""
    pose: Floats
    """(3,) T_map_base, of the likeliest hypothesis; nan where there is none."""
    covariance: Floats
    """(3, 3) m, m, rad; map frame; of all hypotheses together while there are several."""
    quality: float
    """0..1: how likely this pose is against all others, times how well the last measurements agree with the map there."""
    odometry: Floats
    """(3,) T_odom_base at the same time, as the wheels have it: pose * odometry^-1 is T_map_odom."""
    lost: bool
    """The pose is not known, or not to half a metre; `pose` is the best guess."""
    reason: str = ""
    """Why it is not known, for people."""
    alternatives: Floats = field(default_factory=lambda: hypotheses.none(0).poses)
    """(k, 3) other poses that are possible, the likeliest first."""
    moved_anchors: tuple[str, ...] = ()
    """Anchors whose ranges have disagreed for long with a pose on which all other measurements agree."""
    age: float = 0.0
    """s since anything was measured at all, where that is too long."""
    silent: dict[str, float] = field(default_factory=dict)
    """Sensors that send nothing while they should, and for how long, s."""


class PoseEstimator:
    """Find and track a robot in a known map.

    The caller updates the odometer, the odometry of the last seconds: its last pose is the present one.
    """

    def __init__(self, known: KnownMap, odometer: Odometer) -> None:
        anchors = known.anchors
        self.known = known
        self.ends = np.zeros(2)
        """Of rays on walls, and in known space, while the pose was known."""
        self.work = 0
        """Operations on elements of arrays since the caller last set it to 0."""
        self.tracks = False
        """Whether one place is tracked, however vague the pose has become."""
        self._tracked = False
        """Whether one was tracked before."""
        self._odometer = odometer
        self._bank = hypotheses.none(len(anchors.ids))
        self._anew = False
        """Whether hypotheses begin anew with the running search, which scans determine: single ranges move a filter that began
        with ten metres along a wall to a place that is none. By ranges alone they hold more than the window does."""
        self._places = PlaceSearch(known)
        self._searched_ranges = 0
        """Ranges that had come when the running search began."""
        self._window = Window()
        self._way = self._scan_way = 0.0
        self._noise = anchors.noise
        self._range_way = np.full(len(anchors.ids), -np.inf)
        """(a,) m, odometer at the last range to each anchor."""
        self._search_stamp = -np.inf
        self._confirmed: tuple[float, Floats] | None = None
        """Odometer and T_map_odom at the first of the searches that agree."""
        self._running = full_agreement(len(anchors.ids))
        self._reason = "nothing has been measured yet"

    def move(self, step: Floats) -> None:
        """Drive by one step (3,) of the odometry, m, m, rad."""
        self._bank = hypotheses.moved(self._bank, step)
        self.work += hypotheses.PER_MOVE * self._bank.covariance.size * self._bank.mean.shape[1]
        self._way += way_of(step)

    def wander(self, sigma: float) -> None:
        """Add unmeasured motion, a standard deviation in m and rad; measurements before and after it cannot be combined."""
        self._bank = hypotheses.moved(self._bank, _STANDS, sigma)
        self._window, self._confirmed = Window(), None
        self._places.drop()

    def use_range(self, anchor: int, metres: float, tag: Floats, stamp: float, then: Floats) -> None:
        """Take a range of the tag at a place (2,) of the base, m, at a time, s, at which the odometry had a pose (3,)."""
        self._window.add_range(WindowRange(anchor, metres, then, tag, self._way, stamp))
        if not len(self._bank):
            return
        anchors, (white, length) = self.known.anchors, self._noise[anchor]
        arm = se2.transform(se2.between(self._odometer.pose, then), tag)
        driven = self._way - self._range_way[anchor]
        share = 1.0 / float(repeated((white / anchors.sigma[anchor]) ** 2, length, driven))
        self._range_way[anchor] = self._way
        bank, weight, likelihood, anywhere = hypotheses.ranged(self._bank, anchors, anchor, metres, arm, share)
        self.work += hypotheses.PER_UPDATE * bank.covariance.size
        self._bank = hypotheses.reweighted(bank, likelihood if len(bank) > 1 else np.zeros(1))
        best = int(np.argmax(bank.log_weight))
        self._running.add_range(anchor, float(weight[best]), float(likelihood[best] - anywhere[best]), stamp)

    def use_scan(self, rays: Rays) -> None:
        """Take a scan's rays, in the present frame of the base."""
        odometer, walls = self._odometer, self.known.walls
        if walls is None or not len(rays.hit):
            return
        # As the laser is mounted, by the best hypothesis.
        turn = self._bank.mean[np.argmax(self._bank.log_weight), hypotheses.LASER] if len(self._bank) else 0.0
        some = rays.moved(np.array([0.0, 0.0, turn])).spread(RAYS)
        doubted_since = self._running.matched if self.tracks and self._running.in_doubt() else -np.inf
        if self._window.wants_look(self._way, odometer.stamp, doubted_since):
            self._window.add_look(WindowLook(some, odometer.pose.copy(), self._way, odometer.stamp))
        if not len(self._bank):
            return
        driven, self._scan_way = self._way - self._scan_way, self._way
        before = self._bank
        self._bank, found = self._matched(before, walls, rays, some, driven)
        if self.tracks and driven <= _STILL:
            # The robot stands, by its wheels; where a place nearby fits and is far likelier, it was pushed, or they are frozen.
            pushed, there = self._matched(hypotheses.moved(self._bank, _STANDS, _UNFELT), walls, rays, some, 1.0)
            if there.odds[0] > max(0.0, found.odds[0] + verdict.CERTAIN / hypotheses.INDEPENDENT):
                self.wander(_UNFELT)
                self._bank, found = pushed, there
        if self.tracks and (found.odds[0] < ELSEWHERE or found.known[0] < 0.5 * int(some.hit.sum())):
            # A scan that does not agree as a whole must not move the pose: walls that are not in the map lie near others.
            self._bank = before
        if len(self._bank) > 1:
            self._bank = hypotheses.reweighted(self._bank, found.log_likelihood)
        best = int(np.argmax(self._bank.log_weight))
        if self.tracks:
            self.ends += found.known[best] * np.array([found.on_wall[best], 1.0])
        self._running.add_scan(float(found.odds[best]), odometer.stamp)

    def search_or_check(self, *, free: bool) -> None:
        """Look whether the pose still holds; do some units of a search, or begin one where it is time for it.

        Free: no scan was used in this step, and there is time to search. Every scan brings a free step.
        """
        if self.tracks and (why := self._doubted()):
            self._lose(why, self._running.agreed())
        elif not self.tracks and self._running.jumped():
            self._lose("the ranges do not fit what was measured before; was the robot carried?", self._running.agreed())
        odom, now = self._odometer.pose, self._odometer.stamp
        if not self.tracks and len(self._window.ranges) > 2 * self._searched_ranges:
            # The new ones leave far fewer places to compare: sooner done than what is under way.
            self._places.drop()
            self._search_stamp = -np.inf
        if free and not self._places.idle:
            compared, done = self._places.advance(self._bank.rows(slice(0 if self._anew else None)), odom)
            self.work += done
            if compared is None:
                return
            if not self.tracks:
                self._decide_by(compared)
            elif compared.elsewhere:
                self._lose(_SCANS_DIFFER, self._running.matched)
            return
        if free and now - self._search_stamp >= _SEARCH_TIME and (not self.tracks or self._running.in_doubt()):
            self._search_stamp = now
            # For a doubtful pose, places are compared by the measurements since scans fitted there: ranges may agree with a
            # wrong place by chance.
            window = self._window.since(self._running.matched) if self.tracks else self._window
            self._searched_ranges = len(window.ranges)
            self._anew = not self.tracks and bool(window.looks)
            self._places.begin(window, odom, self._way, self._bank.poses if self._anew else self._bank.poses[:0])

    def state(self, wheels: Floats) -> LocalizerState:
        """Return the pose at the time of the last odometry, which is wheels (3,) in the odometry frame."""
        bank, running = self._bank, self._running
        stamp, odometry = self._odometer.stamp, wheels.copy()
        far = tuple(self.known.anchors.ids[k] for k in running.moved_anchors())
        if not len(bank):
            nothing = np.full_like(wheels, np.nan)
            unknown = np.full((len(wheels), len(wheels)), np.nan)
            return LocalizerState(stamp, nothing, unknown, 0.0, odometry, True, self._reason, moved_anchors=far)
        order = np.argsort(-bank.log_weight, kind="stable")
        best = int(order[0])
        share, covariance = hypotheses.mixed(bank, best)
        fit = np.exp(running.scans) if self._window.looks else running.ranges / SUPPORT
        quality = float(share[best]) * float(np.clip(fit, 0.0, 1.0)) * (1.0 if self.tracks else 0.5)
        pose, covariance = bank.poses[best].copy(), covariance + self.known.covariance_at(bank.poses[best, :2])
        reason = verdict.vague(covariance) if self.tracks else self._reason
        return LocalizerState(stamp, pose, covariance, quality, odometry, bool(reason), reason, bank.poses[order[1:]], far)

    def _matched(self, bank: Hypotheses, walls: Walls, rays: Rays, some: Rays, driven: float) -> tuple[Hypotheses, Agreement]:
        """Return hypotheses corrected by a scan, and how some of its rays, turned as the laser is, agree with the map there.

        Driven is how far the robot has come since its last scan, m.
        """
        bank = hypotheses.matched(bank, walls, rays, min(max(driven, _STILL) / _FRESH_WAY, 1.0))
        self.work += len(bank) * (hypotheses.MATCHES * PER_FACTOR * len(rays.hit) + PER_RAY * len(some.hit))
        return bank, walls.agreement(bank.poses, some, INDEPENDENT_RAYS * min(driven, 1.0))

    def _doubted(self) -> str:
        """Return why the pose counts as lost; "" = it does not.

        A pose that ranges support is rejected only where another place explains the later measurements better.
        """
        if self._window.looks and self._running.scans_contradict():
            return "" if self._running.ranges_vouch(self._odometer.stamp) else _SCANS_DIFFER
        return "the ranges do not fit the anchors any more" if self._running.ranges_contradict() else ""

    def _lose(self, why: str, since: float) -> None:
        """Begin again with the measurements since a time, s."""
        self.tracks, self._confirmed, self._reason = False, None, why
        self._window = self._window.since(since)
        self._places.drop()
        self._running.forget_anchors()
        self._search_stamp = -np.inf

    def _decide_by(self, found: Comparison) -> None:
        """Weight all hypotheses again by the result of a search, and decide."""
        if not len(found.bank):
            self._bank, self._reason = found.bank, verdict.too_little(found.rays, found.ranges)
            return
        best = int(np.argmax(found.weight))
        # Several poses that were tried may have moved to one place, which counts once.
        self._bank = hypotheses.pruned(found.hypotheses, MOST_PLACES, -2.0 * verdict.CERTAIN)
        ranges, pose = found.ranges, self._bank.poses[0].copy()
        alone = found.complete and verdict.odds_of_place(self._bank) > verdict.LIKELY
        agreed = self._agreed(pose if alone else None)
        odds = verdict.map_odds(float(found.scans[best]), float(found.known[best]), pose, ranges, agreed, self._tracked)
        self._reason = (
            verdict.undecided(self._bank, found.complete)
            or verdict.imprecise(self._bank.pose_covariances[0])
            or odds.nowhere
            or verdict.other_unit(self.known.walls, pose, found.rays, found.independent, ranges)
        )
        if not self._reason and odds.total < verdict.CERTAIN:
            self._reason = "found; a little more driving will confirm it"
        if not self._reason:
            self.tracks = self._tracked = True
            self._bank = hypotheses.pruned(self._bank, 1, -1.0)
            self._running.restart(bool(self._window.looks))

    def _agreed(self, pose: Floats | None) -> float:
        """Return over how many metres driven searches found the same place likely, that of a pose (3,) now; None = none."""
        odom, first = self._odometer.pose, self._confirmed
        if pose is None:
            self._confirmed = None
            return 0.0
        if first is None or hypotheses.apart(pose, se2.compose(first[1], odom)[None])[0]:
            self._confirmed = first = (self._way, se2.compose(pose, se2.inverse(odom)))
        return self._way - first[0]
