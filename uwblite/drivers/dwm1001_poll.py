"""Reading a DWM1001 that answers TLV: status until a fix is ready, then the fix; what to send next, given answers and time.

The module carries no clock, so a fix is stamped between the last "not ready" and the first "ready" (`fix_timer`); to keep
that short without polling all the time, polls are dense only around the moment the next fix is due.
TLV has no checksum: on a link that has shown damage, and when an anchor is new, a fix is read twice and must agree.
"""

from .dwm1001 import LOC_GET, STATUS_GET
from .dwm1001_blocks import Distances, Status
from .events import Action, Corrupt, Lost, RangeEpoch, RangeReading, Send
from .fix_timer import FixTimer

ANSWER = 0.060
"""s to wait for an answer; the longest takes 9 ms, and USB and a busy computer add some."""
BROKEN_ANSWER = 0.015
"""s to wait for the rest of an answer once part of it was damaged."""
DENSE, SPARSE, IDLE = 0.004, 0.008, 0.020
"""s between polls: when a fix is due; when it is late; when none has come for a while."""
LEAD, LONGER_LEAD = 0.010, 0.025
"""s before a fix is due at which polling begins; added when the first poll found the fix already there."""
DISTRUST = 5.0
"""s for which a link counts as damaged after a corrupt byte."""
READS = 5
"""Times a fix is read before it is given up."""


class FixPoller:
    """Polls one module.

    Parameters
    ----------
    now : s.
    period : s between fixes.
    known : anchors heard before; grows.
    distrust_until : s; until then the link counts as damaged.
    """

    def __init__(self, now: float, period: float, known: set[str], distrust_until: float) -> None:
        self.due = now
        """s, when `tick` wants to be called."""
        self.failures = 0
        """Answers that did not come, since the last that did."""
        self.last_fix = now
        self._period, self._known, self._distrust = period, known, distrust_until
        self._timer = FixTimer()
        self._waiting = ""
        self._sent = now
        self._not_ready: float | None = None
        self._stamp: float | None = None
        self._candidate: tuple[RangeReading, ...] | None = None
        self._candidate_at = now
        self._latest: tuple[RangeReading, ...] | None = None
        self._reads = 0
        self._lead = LEAD
        self._damaged = self._guess = False

    def tick(self, now: float) -> list[Action]:
        """Poll, or give up waiting for an answer: it was damaged on the way, or the module is gone."""
        if not self._waiting:
            return self._ask("status", now)
        self.failures += 1
        self._distrust, self._damaged = now + DISTRUST, True
        lost = Corrupt(b"", "no answer in time")
        if self._waiting == "fix":
            return [lost, *self._ask("fix", now)]
        # Reading the status clears it, so the answer that was lost may have announced a fix: look for one.
        stamp = self._timer.time(self._not_ready, self._sent + 0.002, self._period)
        self._stamp, self._guess = self._sent if stamp is None else stamp, True
        return [lost, *self._read_fix(now)]

    def damaged(self, now: float) -> None:
        """Take note of bytes that are no answer."""
        self._distrust = now + DISTRUST
        if self._waiting:
            self.due = min(self.due, now + BROKEN_ANSWER)

    def refused(self, now: float) -> None:
        """Take note of an error that the module answered."""
        self._waiting, self.due = "", now + SPARSE

    def status(self, status: Status, now: float) -> list[Action]:
        """Take a status."""
        if self._waiting != "status":
            return []
        self.failures = 0
        stamp = self._timer.time(self._not_ready, now, self._period) if status.location_ready else None
        if stamp is None:
            self._not_ready = self._sent
            return self._rest(now)
        # Polling that begins after the fix cannot tell when it came: begin earlier until a poll finds none.
        self._lead = self._lead + LONGER_LEAD if self._not_ready is None else max(LEAD, self._lead / 2)
        self._stamp, self._guess = stamp, False
        return self._read_fix(now)

    def fix(self, event: Distances, now: float) -> list[Action]:
        """Take the answer to loc_get."""
        if self._waiting != "fix" or self._stamp is None:
            return []
        self._reads += 1
        self.failures = 0
        readings, suspect = event.readings, now < self._distrust
        doubtful = suspect or not self._known.issuperset(reading.anchor_id for reading in readings)
        if not doubtful or readings != self._candidate:
            self._candidate_at = self._sent
        if doubtful and readings != self._candidate:
            self._candidate = readings
            if self._reads < READS:
                return self._ask("fix", now)
            self._damaged, self._stamp = True, None
            return [Corrupt(b"", f"a fix read {READS} times never came twice alike"), *self._rest(now)]
        # While it was read again and again, newer fixes may have taken its place.
        turns = max(0, int((self._candidate_at - self._stamp) / self._period))
        stamp, self._stamp, self._candidate = self._stamp + turns * self._period, None, None
        if (self._guess or suspect) and readings == self._latest:
            return self._rest(now)
        if self._latest is not None and stamp < self.last_fix + self._period / 2:
            # A new fix cannot be that close to the last one.
            stamp, turns = min(now, stamp + self._period), turns + 1
        return [*self._accept(stamp, readings, as_found=not (turns or self._guess)), *self._rest(now)]

    def _accept(self, stamp: float, readings: tuple[RangeReading, ...], *, as_found: bool) -> list[Action]:
        gap, damaged, self._damaged = stamp - self.last_fix, self._damaged, False
        self.last_fix, self._latest = stamp, readings
        self._timer.accept(stamp, as_found=as_found)
        self._known.update(reading.anchor_id for reading in readings)
        lost: list[Action] = []
        if damaged and gap > 1.6 * self._period:
            lost.append(Lost(stamp, round(gap / self._period) - 1))
        return [*lost, RangeEpoch(stamp, readings)] if readings else lost

    def _read_fix(self, now: float) -> list[Action]:
        self._not_ready, self._candidate, self._reads = None, None, 0
        return self._ask("fix", now)

    def _ask(self, what: str, now: float) -> list[Action]:
        self._waiting, self.due, self._sent = what, now + ANSWER, now
        return [Send(STATUS_GET if what == "status" else LOC_GET)]

    def _rest(self, now: float) -> list[Action]:
        """Choose when to poll next."""
        due = self.last_fix + self._period - min(self._lead, self._period)
        late = now - due
        wait = DENSE if late < self._lead + LEAD else SPARSE if late < 10.0 else IDLE
        if not self._timer.settled:
            due, wait = now, DENSE  # nothing is known yet of when the next one comes
        self._waiting, self.due = "", max(now + wait, due)
        return []
