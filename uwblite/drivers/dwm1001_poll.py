"""Reading a DWM1001 that answers TLV: status until a fix is ready, then the fix.

The module carries no clock. Reading the status clears it, so a fix that one poll finds was made after the poll before was
sent and before this answer came: its stamp is the middle of that bracket, wrong by at most half its width. A fix may be
replaced by the next one before it is read; so the status is asked once more afterwards, and where it announces another
fix, the bracket covers both. Over a slow link the fix itself is read all the time, and other readings are a new one. TLV
has no checksum: a fix is read twice and must agree, unless the link is too slow for that and has shown no damage.
"""

from typing import Any

from ..clocks.device_clock import GAP
from .dwm1001_tlv import ERRORS, LOC_GET, STATUS_GET, Answer, Distances, Status
from .events import Corrupt, Lost, Note, RangeEpoch, RangeReading, Send
from .session import Driver, Script, Wait

PATIENCE = 0.030, 3.0
"""s, and round trips, to wait for an answer: the longest takes 9 ms, USB and a busy computer add some."""
FIRST_TRIP, MAX_TRIP = 0.15, 0.5
"""s; a round trip until one was measured, and the longest that is waited for."""
SLOW = 0.2
"""Share of a period: with a longer round trip the fix itself is read instead of the status."""
BROKEN_ANSWER = 0.015
"""s to wait for the rest of an answer once part of it was damaged."""
DENSE, SPARSE, IDLE = 0.004, 0.008, 0.020
"""s between polls: when a fix is due; when it is late by LATE; when none has come for LONG_AGO."""
LATE, LONG_AGO = 0.05, 10.0
LEAD, MORE_LEAD, LESS_LEAD = 0.010, 0.010, 0.98
"""s before a fix is due at which polling begins; added when that was too late; factor per fix when it was not."""
DISTRUST = 5.0
"""s for which a link counts as damaged after a corrupt byte."""
QUICK = 0.12
"""Share of a period: with a shorter round trip every fix is read twice."""
READS = 5
"""Times a fix is read before it is given up."""
WIDE, SEVERAL, WIDEST = 0.2, 5, 0.6
"""s; so many fixes in turn with a wider bracket are worth a note; s; one with a still wider bracket counts as lost and is not
logged."""
MAX_FAILURES = 40
"""Requests without an answer after which the module is started again."""
UNJOINED = 3.0
"""s without a fix after which a tag is reported to have no network."""


NOT_JOINED = Note(
    "warning",
    "not-joined",
    "uwb: the tag has not joined a network: one anchor must be the initiator and on, all nodes need the same network id, and"
    " none may be in firmware-update mode",
)


def _slow(width: float) -> Note:
    text = f"uwb: answers are slow: the time of a range is known to {width:.1f} s only, and beyond {WIDEST} s it is not logged"
    return Note("warning", "uwb-slow", f"{text}; read the module's stream instead (`shell`), or connect it directly")


Readings = tuple[RangeReading, ...]
Bracket = tuple[float, float]


class FixPoller:
    """Polls one module, as part of its driver's script; `period` s between fixes."""

    def __init__(self, driver: Driver, period: float) -> None:
        self._driver, self._period = driver, period
        self._distrust_until = 0.0
        self._known: set[str] = set()
        self._last_fix = driver.now
        self._latest: Readings | None = None

    def script(self) -> Script[None]:
        """Poll until the module answers no more."""
        self._trip: float | None = None
        self._failures, self._lead = 0, LEAD
        self._low: float | None = None  # s, when the last look was sent that would have shown any fix made before it
        # Bracket and readings of a fix, and the bracket to take if another fix is found to be close behind.
        self._pending: tuple[Bracket, Readings, Bracket] | None = None
        self._wide = 0  # fixes in turn with a wide bracket
        self._hidden = False  # an answer was lost that may have announced a fix
        self._stale = False  # the status may still announce a fix that was read without asking for the status
        self._missed = self._latest is not None  # a fix may have been missed
        while self._failures < MAX_FAILURES:
            if self._trip is not None and self._trip > SLOW * self._period:
                yield from self._watch_fixes()
            else:
                yield from self._watch_status()

    def _watch_fixes(self) -> Script[None]:
        """Read the fix; other readings than before are a new one."""
        if self._pending:
            yield from self._accept(self._pending[2], self._pending[1])
        self._stale, sent = True, self._driver.now
        readings = yield from self._read_fix()
        if readings is not None:
            if self._low is not None and readings != self._latest:
                self._missed |= self._driver.now - self._low > GAP * self._period
                yield from self._accept((max(self._low, sent - self._period), self._driver.now), readings)
            self._low, self._latest = sent, readings
        yield from self._driver.sleep(DENSE)

    def _watch_status(self) -> Script[None]:
        """Ask whether a fix is ready, and read it."""
        sent = self._driver.now
        status = yield from self._ask(STATUS_GET, Status)
        if status is None:
            self._hidden = self._missed = True
            return
        since, self._low = self._low, sent
        if status.location_ready or self._hidden:
            bracket = None if since is None else (since, self._driver.now)
            self._missed |= bracket is not None and bracket[1] - bracket[0] > GAP * self._period
            yield from self._take(bracket, sure=status.location_ready and not self._stale)
            self._hidden = self._stale = False
            return
        self._stale = False
        if self._pending:
            yield from self._accept(*self._pending[:2])
        yield from self._rest(status)

    def _take(self, bracket: Bracket | None, *, sure: bool) -> Script[None]:
        """Read a fix that was announced; it counts when the next status is known."""
        sent = self._driver.now
        readings = yield from self._read_fix()
        before = self._pending[1] if self._pending else self._latest
        since = self._pending[0][0] if self._pending else self._last_fix
        soon = bracket is not None and bracket[1] - since < self._period / 2
        if readings is not None and readings == before and (soon or not sure):
            return  # a damaged status, or a lost one that announced nothing: no fix is that close to another
        pending, self._pending = self._pending, None
        self._missed |= readings is None or (pending is not None and readings == pending[1])
        if pending and readings == pending[1]:
            self._pending = pending[2], pending[1], pending[2]  # what was read first was this fix already
            return
        if pending:
            yield from self._accept(pending[2], pending[1])
        if readings is not None and bracket is not None:
            newest = sent - self._period  # what is read is the last fix: it is no older than that
            either = max(bracket[0], newest), self._driver.now
            self._pending = (max(bracket[0], newest), bracket[1]) if sure else either, readings, either

    def _accept(self, bracket: Bracket, readings: Readings) -> Script[None]:
        """Log a fix; where its bracket holds several, the last of them was read."""
        low, high = bracket
        stamp, unsure = (low + high) / 2, high - low > WIDEST
        self._wide = self._wide + 1 if high - low > WIDE else 0
        if self._wide >= SEVERAL:
            yield from self._driver.say_once(_slow(high - low))
        gap = round((stamp - self._last_fix) / self._period) - 1 if self._latest is not None else 0
        if (gap > 0 and self._missed) or unsure:
            yield Lost(max(0, gap) + unsure)
        narrow = high - low < 2 * (DENSE + (self._trip or 0.0)) + LEAD
        self._lead = max(LEAD, self._lead * LESS_LEAD) if narrow else min(self._lead + MORE_LEAD, self._period / 2)
        self._last_fix, self._latest = stamp, readings
        # Of a bracket that holds several fixes the last one was read, and it may stand nearer to the end than the middle.
        self._pending, self._missed = None, high - low > GAP * self._period
        self._known.update(reading.anchor_id for reading in readings)
        if readings and not unsure:
            yield RangeEpoch(stamp, readings, (high - low) / 2)

    def _rest(self, status: Status) -> Script[None]:
        """Wait until the next fix may come."""
        now = self._driver.now
        if not status.joined and now - self._last_fix > UNJOINED:
            yield from self._driver.say_once(NOT_JOINED)
        due = now if self._latest is None else self._last_fix + self._period - self._lead - (self._trip or 0.0)
        late = now - self._last_fix - self._period
        pause = DENSE if late < LATE else SPARSE if late < LONG_AGO else IDLE
        yield from self._driver.sleep(max(due - now, pause))

    def _read_fix(self) -> Script[Readings | None]:
        """Read the fix until it came twice alike where that is asked for; None = it never did."""
        before: Readings | None = None
        for _ in range(READS):
            answer = yield from self._ask(LOC_GET, Distances)
            if answer is None:
                continue
            readings: Readings = answer.readings
            fresh = not self._known.issuperset(reading.anchor_id for reading in readings)
            quick = self._trip is None or self._trip < QUICK * self._period
            if readings == before or not (quick or fresh or self._driver.now < self._distrust_until):
                return readings
            if not quick and before is not None:
                # Over a slow link the next fix comes before this one is read again: an anchor that is in both is one.
                self._known |= {r.anchor_id for r in readings} & {r.anchor_id for r in before}
            before = readings
        yield Corrupt(f"a fix read {READS} times never came twice alike")
        return None

    def _ask(self, request: bytes, kind: type) -> Script[Any]:
        """Return the answer to a request, None where none came."""
        sent, damaged = self._driver.now, False
        until = sent + PATIENCE[0] + PATIENCE[1] * (FIRST_TRIP if self._trip is None else self._trip)
        yield Send(request)
        while (event := (yield Wait(until))) is not None:
            if isinstance(event, kind):
                self._failures = 0
                self._trip = min(MAX_TRIP, max(self._driver.now - sent, 0.9 * (self._trip or 0.0)))
                return event
            if isinstance(event, Corrupt):
                damaged, self._distrust_until = True, self._driver.now + DISTRUST
                until = min(until, self._driver.now + BROKEN_ANSWER)
            elif isinstance(event, Answer) and event.error:
                text = f"uwb: the module answers error {event.error}, {ERRORS[event.error]}"
                yield from self._driver.say_once(Note("warning", f"uwb-error-{event.error}", text))
                yield from self._driver.sleep(SPARSE)
                return None
        self._failures += 1
        yield Corrupt("no answer in time")
        self._distrust_until = self._driver.now + DISTRUST
        if not damaged:
            # It may only be late: let it pass, so that it is not taken for the answer to the next request.
            self._trip = min(MAX_TRIP, 2 * (self._trip or FIRST_TRIP))
            yield from self._driver.sleep(self._trip)
        return None
