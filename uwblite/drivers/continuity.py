"""Replacement for a check sum: a reading that continues the one before is accepted, one that jumps waits for others.

A changed bit makes another digit of a digit, and nothing in a line without a sum shows it. Two readings that agree by
chance are rare, so a leap counts only when the next readings go on from it; a leap away and back is damage. What is left is
what a sum would find and this cannot: a wrong reading that lies as near to the one before as a right one could.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from .events import Action, Corrupt, RangeEpoch, RangeReading

DISTRUST = 60.0
"""s for which a link counts as damaged after bytes that were no line or frame."""
WITNESSES, STRANGERS = (1, 2), 5
"""Readings that must agree with one that leaps, on a clean link and on a damaged one; and with the first of an anchor."""
SPREAD = 0.15
"""m by which two ranges of one anchor may differ at rest, on a damaged link; on a clean one an outlier is the radio's."""
SPEED = 1.5
"""m/s; robots for indoors are slower."""
MOST_GAP, STALE = 0.2, 1.0
"""s, on a damaged link: ranges that lie further apart are compared as if they were so close; and they are not compared at
all, unless that is less than three times the least that lay between two ranges of an anchor lately."""
MOST_ANCHORS = 256
"""That are remembered."""
FORGET = 10.0
"""s after which an anchor that was seen too seldom is given up."""

LEAP = 0.25
"""s by which the clocks of device and host may have gone on differently between two frames: the host reads late, or a frame
was damaged and its sum is right by chance, one in 256 for sums of eight bits."""

Item = TypeVar("Item")


def device_time(counted: float, elapsed: float, turn: float) -> float | None:
    """Return the time between two frames by the device's clock, s; None = it did not keep pace with the host's.

    The clocks went on by `counted` and `elapsed`, s; that of the device wraps after `turn`, s.
    """
    ahead = math.remainder(counted - elapsed, turn)
    return elapsed + ahead if abs(ahead) < LEAP else None


class Continuity(Generic[Item]):
    """A series of readings without a sum, or with a weak one.

    Parameters
    ----------
    follows : (earlier, later) -> whether one can go on from the other. what : begins the words on those that are given up.
    summed : with a sum, one that leaps and from which the next goes on, as from the one before, came late; else it is damage.
    """

    def __init__(self, follows: Callable[[Item, Item], bool], what: str = "reading that", *, summed: bool = False) -> None:
        self._follows, self._what, self._summed = follows, what, summed
        self.last: Item | None = None
        """The latest that passed."""
        self.waiting: list[Item] = []
        """Those that leapt and go on from each other."""

    def take(self, item: Item, witnesses: int) -> tuple[list[Item], list[Item]]:
        """Return the readings that pass now, in their order, and those that are given up.

        One that leaps passes when so many `witnesses` agree with it; 0 = at once.
        """
        dropped: list[Item] = []
        if witnesses == 0:
            passed = [*self.waiting, item]
        elif self.last is not None and self._follows(self.last, item):
            passed, dropped = [item], self.waiting
            if self._summed and self.waiting and self._follows(self.waiting[-1], item):
                passed, dropped = [*self.waiting, item], []
        elif self.waiting and self._follows(self.waiting[-1], item):
            passed = [*self.waiting, item]
            if len(self.waiting) < witnesses:
                passed, self.waiting = [], passed
        else:
            passed, dropped, self.waiting = [], self.waiting, [item]
        if passed:
            self.last, self.waiting = item, []
        return passed, dropped

    def confirmed(self, item: Item, witnesses: int, use: Callable[[Item], Iterable[Action]]) -> list[Action]:
        """Return what the readings mean that pass with the next one, and Corrupt for those that are given up."""
        passed, dropped = self.take(item, witnesses)
        given_up: list[Action] = [Corrupt(f"{self._what} leaps away and back")] * len(dropped)
        return [*given_up, *(action for each in passed for action in use(each))]

    def unconfirmed(self) -> list[Action]:
        """Return Corrupt for the readings that still wait at the end."""
        return [Corrupt(f"{self._what} nothing confirmed")] * len(self.waiting)


class LinkHealth:
    """Whether bytes were damaged lately."""

    def __init__(self) -> None:
        self._damaged = -math.inf

    def damage(self, now: float) -> None:
        self._damaged = now

    def is_damaged(self, now: float) -> bool:
        return now - self._damaged < DISTRUST


Ranged = tuple[RangeEpoch, RangeReading]


class RangeGuard:
    """Ranges that no sum protects: on a damaged link one that leaps, and a new anchor, must be seen again."""

    def __init__(self, health: LinkHealth) -> None:
        self._health, self._damaged = health, False
        self._intervals: deque[float] = deque(maxlen=50)
        """s, between two ranges of one anchor."""
        self._anchors: dict[str, Continuity[Ranged]] = {}

    def take(self, epoch: RangeEpoch, now: float) -> list[Action]:
        """Return the rounds whose ranges pass now, each with its own stamp, and Corrupt for ranges that are given up."""
        self._damaged = self._health.is_damaged(now)
        passed: list[Ranged] = []
        given_up = self._forgotten(epoch.stamp)
        for reading in epoch.readings:
            series = self._anchors.setdefault(reading.anchor_id, Continuity(self._follows))
            before, witnesses = series.last, STRANGERS if series.last is None else WITNESSES[True]
            through, dropped = series.take((epoch, reading), witnesses if self._damaged else 0)
            if before is not None and through:
                self._intervals.append(through[-1][0].stamp - before[0].stamp)
            passed, given_up = passed + through, given_up + dropped
        return self._sorted_out(passed, given_up)

    def finish(self) -> list[Action]:
        """Return what still waits at the end: ranges, or Corrupt."""
        return self._sorted_out([], self._forgotten(math.inf))

    def _sorted_out(self, passed: list[Ranged], given_up: list[Ranged]) -> list[Action]:
        if not self._damaged:
            passed, given_up = passed + given_up, []
        rounds: dict[float, list[Ranged]] = {}
        for item in sorted(passed, key=lambda item: item[0].stamp):
            rounds.setdefault(item[0].stamp, []).append(item)
        damaged: list[Action] = [Corrupt("range that leaps away and back, or of an anchor seen once")] * len(given_up)
        epochs = (RangeEpoch(t, tuple([reading for _, reading in items]), items[0][0].spread) for t, items in rounds.items())
        return [*damaged, *epochs]

    def _follows(self, before: Ranged, after: Ranged) -> bool:
        seconds = max(after[0].stamp - before[0].stamp, 0.0)
        if seconds > max(STALE, 3 * min(self._intervals, default=0.0)):
            return False
        return abs(after[1].range - before[1].range) <= SPREAD + SPEED * min(seconds, MOST_GAP)

    def _forgotten(self, stamp: float) -> list[Ranged]:
        forgotten: list[Ranged] = []
        for name, series in list(self._anchors.items()):
            if series.waiting and stamp - series.waiting[-1][0].stamp > FORGET:
                forgotten, series.waiting = forgotten + series.waiting, []
                if series.last is None:
                    del self._anchors[name]
        while len(self._anchors) > MOST_ANCHORS:
            forgotten += self._anchors.pop(next(iter(self._anchors))).waiting
        return forgotten
