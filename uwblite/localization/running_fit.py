"""Agreement of the last measurements with the tracked pose; from it, whether the pose is lost, and which anchors have moved."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from .sensing import LEAD
from .verdict import CERTAIN, LIKELY
from .walls import ELSEWHERE

SUPPORT, _CONTRADICTION = 0.5, 0.25
"""Weights of a range, and mean weights of the last ones, that support the pose, being more likely than not, and that contradict
it. The search for a lost robot begins with the measurements after the last one that supported the pose. A pose that ranges
support and scans contradict is replaced only by a better one: rooms that are only partly in the map, and people around the
robot, cause this."""
_FORGETTING = 0.1
"""Share of a new scan in the mean of the last ones, a second of scans; of a new range it is twice that, two rounds of four."""
_ENOUGH = 20
"""Ranges of an anchor after which it may count as moved."""


@dataclass(slots=True, eq=False)
class RunningFit:
    """Means of the last measurements, each forgotten in proportion to what follows."""

    trust: Floats
    """(a, 2) of each anchor: mean weight of its ranges, and how many there were."""
    against: Floats
    """(a,) log-likelihood of each anchor's last range at the pose against one from anywhere, since the sum was above 0."""
    scans: float = 0.0
    """Mean odds of the rays against rays elsewhere: above 0 they support the pose."""
    ranges: float = 1.0
    """Mean weight of ranges."""
    before: float = 1.0
    """Mean weight of ranges when that sum was last above 0."""
    first: float = np.inf
    """s, of the first range since then."""
    sound: float = -np.inf
    """s, of the last measurement that supported the pose."""
    ranged: float = -np.inf
    """s, of the last range."""
    matched: float = -np.inf
    """s, of the last scan that fitted."""

    def restart(self, sees: bool) -> None:
        """Begin with full agreement: the pose was found now."""
        self.scans, self.ranges, self.before = -ELSEWHERE if sees else 0.0, 1.0, 1.0
        self.forget_anchors()

    def forget_anchors(self) -> None:
        """Use all anchors again; ranges that contradict already are no jump."""
        self.trust[:], self.against[:], self.before, self.first = (1.0, 0.0), 0.0, self.ranges, np.inf

    def add_range(self, anchor: int, weight: float, ratio: float, stamp: float) -> None:
        """Take the weight, 0..1, of a range at the pose, and the logarithm of how much likelier it is there than anywhere.

        The sum since it was last above 0 is Page's test for a sudden change (Continuous inspection schemes, Biometrika 1954);
        errors of ranges to one anchor are correlated, so that each anchor counts once, with its weight.
        """
        self.against[anchor] = self.trust[anchor, 0] * ratio
        self.first = min(self.first, stamp)
        if self.against.sum() >= 0.0:
            self.against[:], self.before, self.first = 0.0, self.ranges, np.inf
        self.trust[anchor] += (_FORGETTING * (weight - self.trust[anchor, 0]), 1.0)
        self.ranges += 2.0 * _FORGETTING * (weight - self.ranges)
        self.ranged = max(self.ranged, stamp)
        if weight > SUPPORT:
            self.sound = max(self.sound, stamp)

    def add_scan(self, odds: float, stamp: float) -> None:
        """Take the mean odds of a scan's rays at the pose."""
        self.scans += _FORGETTING * (odds - self.scans)
        if odds > 0.0:
            self.sound, self.matched = max(self.sound, stamp), max(self.matched, stamp)

    def in_doubt(self) -> bool:
        """Return whether measurements fit worse than they should: people may be near, or the robot is elsewhere."""
        return self.scans < 0.0 or self._jump() > LIKELY

    def scans_contradict(self) -> bool:
        """Return whether scans fit so badly that the robot is elsewhere."""
        return self.scans < ELSEWHERE

    def ranges_contradict(self) -> bool:
        """Return whether the ranges contradict the pose, and the scans do not support it half as well as they might."""
        return (self.ranges < _CONTRADICTION or self.jumped()) and self.scans < -SUPPORT * ELSEWHERE

    def jumped(self) -> bool:
        """Return whether the ranges, which agreed, now contradict the pose all at once."""
        return self._jump() > CERTAIN

    def _jump(self) -> float:
        """Return the log-likelihood by which ranges that agreed before contradict the pose."""
        return -float(self.against.sum()) if self.before > SUPPORT else 0.0

    def ranges_vouch(self, now: float) -> bool:
        """Return whether recent ranges support the pose."""
        return self.ranges > SUPPORT and now - self.ranged < LEAD

    def agreed(self) -> float:
        """Return until when, s, the measurements supported the pose: by chance some still do after a jump."""
        return min(self.sound, float(np.nextafter(self.first, -np.inf))) if self.jumped() else self.sound

    def moved_anchors(self) -> Ints:
        """Return the anchors that most ranges have long disagreed with."""
        return np.flatnonzero((self.trust[:, 0] < _CONTRADICTION) & (self.trust[:, 1] >= _ENOUGH))


def full_agreement(anchors: int) -> RunningFit:
    """Return the state before anything was measured, for so many anchors."""
    return RunningFit(np.tile((1.0, 0.0), (anchors, 1)), np.zeros(anchors))
