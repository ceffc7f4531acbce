"""Finding a Hokuyo, whatever state a dead host left it in; who it is, and what time it is there.

The order is that of drivers that survived the field: drain, QT, out of SCIP 1.1 or the time-adjust mode where the answer
says so, VV, PP, II, a few TM1 to tie the device clock to the host's. Only commands that every URG-04LX knows are sent;
others can hang it until its power is cycled.
"""

from typing import Any

from ..clocks.device_clock import DeviceClock
from ..errors import ProtocolError
from .events import Note, Param, Reopen, Send, SetBaud
from .scip import TIME_MODULUS, WITH_LINES, Reply, ScipProtocol
from .scip_commands import BAUD_RATES, Geometry, parse_geometry, status_meaning
from .session import Driver, Script

DRAIN = 0.25
"""s to wait for silence before the first word."""
PATIENCE = 0.4
"""s to wait for an answer."""
SETTLE = 0.1
"""s for a flush or another bit rate to take effect."""
PARAMETER_READS = 4
TIME_READS = 8, 40
"""Readings of the clock, at least and at most; a busy computer needs more of them."""
TIME_SPENT = 2.0
"""s after which no more than the least readings are taken: over a slow line more of them show no more."""
GOOD_TIE = 0.002
"""s to which the clocks should be tied to each other."""
NOMINAL_SPREAD = 0.035
"""s by which the nominal delay may be wrong: between the end of the sweep and that of the turn."""
TRUNCATION = 0.5
"""ms; stamps are truncated to 1 ms, half of that makes them unbiased."""


class ScipUnit(Driver):
    """A lidar that speaks SCIP 2.0, up to the moment at which it can measure."""

    def __init__(self, baud: int) -> None:
        super().__init__(ScipProtocol(), "laser scanner")
        self.baud = baud
        self.geometry = Geometry()
        self.facts: dict[str, str] = {}
        """KEY: value of VV, PP and II."""
        self._clock = DeviceClock(1e-3, TIME_MODULUS, latency=self.geometry.period, spread=NOMINAL_SPREAD)

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return Reply, Distances and Corrupt; remember what the unit reports of itself."""
        events = super().parse(data, now)
        for event in events:
            if isinstance(event, Reply) and event.command in WITH_LINES and event.status == "00":
                self.facts.update(event.fields())
        return events

    # ---- finding it

    def _request(self, command: str, tries: int = 2) -> Script[Reply | None]:
        """Return the reply to a command without parameters."""

        def answers(event: Any) -> bool:
            return isinstance(event, Reply) and event.command == command

        reply: Reply | None = yield from self.ask(f"{command}\n".encode(), answers, PATIENCE, tries)
        return reply

    def _find(self) -> Script[bool]:
        """Make the unit quiet, whatever state and bit rate a dead host left it in; False: Reopen was sent."""
        yield from self.sleep(DRAIN)
        for rate in (self.baud, *(rate for rate in BAUD_RATES if rate != self.baud)):
            if rate != self.baud:
                yield SetBaud(rate)
            reply = yield from self._request("QT", 1)
            if reply is None:
                # A single QT may be ignored, or half a command of another program stood before it.
                yield from self._flush()
                reply = yield from self._request("QT", 1)
            if reply is not None:
                self.baud = rate
                return (yield from self._make_quiet(reply))
        text = (
            "lidar: no answer at any bit rate. Unplug it and plug it in again (about one power-up in ten needs that),"
            " check its 5 V supply, and that no other program has the port"
        )
        yield from self.say_once(Note("error", "lidar-silent", text))
        yield Reopen("no answer at any bit rate")
        return False

    def _make_quiet(self, reply: Reply) -> Script[bool]:
        kind, _ = status_meaning(reply.command, reply.status)
        if kind == "scip1":
            switched = yield from self._request("SCIP2.0")
            if switched is not None and status_meaning("SCIP2.0", switched.status)[0] == "scip1":
                text = "lidar: it has SCIP 1.1 only; its firmware (before 3.0) needs the maker's update to SCIP 2.0"
                yield from self.say_once(Note("error", "lidar-scip1-only", text))
                yield Reopen("SCIP 1.1 only")
                return False
            yield from self.say_once(Note("info", "lidar-scip1", "lidar: it woke in SCIP 1.1; switched to SCIP 2.0"))
        elif kind != "ok":
            # Foreign bytes stood before QT, or the unit was left in the time-adjust mode.
            yield from self._flush()
            yield from self._request("TM2")
        if kind != "ok":
            yield from self._request("QT")
        return True

    def _flush(self) -> Script[None]:
        """End the line that the unit may be in, and let its answer pass."""
        yield Send(b"\n")
        yield from self.sleep(SETTLE)

    # ---- who it is, and its clock

    def _greet(self) -> Script[None]:
        for command in WITH_LINES:
            reply = yield from self._request(command)
            if reply is not None and status_meaning(command, reply.status)[0] != "ok":
                yield from self._flush()
                reply = yield from self._request(command)
            if command == "PP":
                yield from self._take_geometry(reply)
        for name, key in (("product", "PROD"), ("firmware", "FIRM"), ("serial", "SERI")):
            if key in self.facts:
                yield Param(f"laser_{name}", self.facts[key].replace(" ", "_"))

    def _take_geometry(self, reply: Reply | None) -> Script[None]:
        """Accept PP when it came twice alike: the sums of its lines are wrong in some units and cannot be asked for.

        Without an answer that of an earlier start holds.
        """
        before, problem = None, "no answer to PP"
        for _ in range(PARAMETER_READS):
            try:
                geometry = parse_geometry(reply) if reply else None
                if geometry and geometry == before:
                    self.geometry = geometry
                    break
                before, problem = geometry or before, "two answers to PP differ" if geometry else problem
            except ProtocolError as error:
                problem = str(error)
            reply = yield from self._request("PP", 1)
        else:
            self.geometry = before or self.geometry
            known = before or self.geometry != Geometry()
            text = f"lidar: {problem}; going on with {'the last answer' if known else 'the limits of a URG-04LX'}"
            yield from self.say_once(Note("warning", "lidar-parameters", text))

    def _tie_clock(self) -> Script[None]:
        """Read the clock a few times in the time-adjust mode; without it, what was measured before stays in force."""
        entered, began = (yield from self._request("TM0")), self.now
        for k in range(TIME_READS[1] if entered and status_meaning("TM0", entered.status)[0] == "ok" else 0):
            sent = self.now
            if k >= TIME_READS[0] and (self._clock.tied < GOOD_TIE or sent - began > TIME_SPENT):
                break
            reply = yield from self._request("TM1", 1)
            if reply is None or not reply.lines:
                break
            self._clock.tie(int(reply.lines[0]) + TRUNCATION, sent, reply.stamp)
        yield from self._request("TM2")
