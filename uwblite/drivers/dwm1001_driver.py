"""The conversation with a DWM1001 tag: start-up, reading and recovery.

Two ways to read it. *TLV* (default): status until a fix is ready, then the fix (`dwm1001_poll`); distances to 1 mm.
*Shell*: the stream of ``lec``; distances to 1 cm. Either way a module left in the other mode, or streaming for a host
that died, is brought round.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from . import dwm1001_tlv as tlv
from .continuity import LinkHealth, RangeGuard
from .dwm1001_poll import NOT_JOINED, FixPoller
from .dwm1001_shell import ENTER, PositionLine, Prompt, RangeLine, ShellProtocol, TextLine, node_facts
from .events import Action, Corrupt, Lost, Note, Param, RangeEpoch, Reopen, Send
from .session import Driver, Identity, Script, Wait

DRAIN = 0.25
PATIENCE, SETTLE = 1.0, 0.25
"""s to wait for an answer during start-up, as the vendor's host does, and after leaving the shell."""
PROBES = ((tlv.STATUS_GET, PATIENCE), (ENTER, 0.6), (tlv.STATUS_GET, PATIENCE), (tlv.STATUS_GET, PATIENCE), (b"\r", 1.0))
"""What finds out the mode: the status in generic mode; Enter in the shell, which also wakes a sleeping tag."""
QUIET = 0.15, 0.35
"""s: lines may still come at first; after that, a stream that was stopped must be silent."""
QUERIES = (
    (tlv.VER_GET, lambda event: _is_value(event, "hardware")),
    (tlv.NODEID_GET, lambda event: _is_value(event, "node_id")),
    (tlv.PANID_GET, lambda event: _is_value(event, "pan_id")),
    (tlv.CFG_GET, lambda event: isinstance(event, tlv.NodeConfig)),
    (tlv.UPD_RATE_GET, lambda event: isinstance(event, tlv.UpdateRate)),
)
"""What a module is asked once, and what completes the answer."""
SHORTEST_PERIOD = 0.1
"""s between fixes at the highest rate."""
_BRIDGE = "The USB bridge of the DEV board can hang: unplug it and plug it in again"
_PORT = "check that the port is the DWM1001's"
SILENT = Note("error", "uwb-silent", f"uwb: no answer. {_BRIDGE}; {_PORT} and that no other program has it")
_SILENT = "no fix and no answer"
_FOREIGN = "uwb: bytes come, but none that a DWM1001 sends"
UNREADABLE = Note("error", "uwb-unreadable", f"{_FOREIGN}: {_PORT}, and that it talks at {tlv.BAUD} bit/s")
_SHELL = "open a terminal on the port at 115200 bit/s, press Enter twice quickly"


def advise(node: tlv.NodeConfig, *, joined: bool | None, period: float) -> list[Note]:
    """Name every setting that makes ranges rare or absent, the worst first, and how to mend each.

    `joined` : the node is part of a network, None = not known yet. `period` : s between fixes.
    """
    resting = f"stationary detection is on: the rate falls to once in 10 s at rest: {_SHELL}, `acts` shows its arguments;"
    resting += " set accel_en to 0, then `reset` (or set `aurs 1 1` to keep 10 Hz at rest)"
    off, rare = not node.anchor and node.uwb_mode != tlv.ACTIVE, period > SHORTEST_PERIOD
    rows = (
        (node.anchor, "error", "not-a-tag", f"this node is an anchor: {_SHELL}, type `nmt` (it restarts)"),
        (off, "error", "uwb-off", f"the tag's radio is off or passive: {_SHELL}, type `nmt`"),
        (joined is False, NOT_JOINED.level, NOT_JOINED.name, NOT_JOINED.text.removeprefix("uwb: ")),
        (node.stationary_detection, "warning", "stationary-detection", resting),
        (node.low_power, "warning", "low-power", f"low-power mode makes ranges come in bursts: {_SHELL}, type `nmt`"),
        (rare, "warning", "slow-update-rate", f"a fix only every {period:.1f} s: {_SHELL}, type `aurs 1 1` for ten a second"),
    )
    return [Note(level, name, f"uwb: {text}") for hurts, level, name, text in rows if hurts]


class Dwm1001Driver(Driver):
    """One DWM1001 tag, by TLV or its `shell`; without `stream` it stops after the queries, for a look at what is plugged in."""

    baud = tlv.BAUD

    def __init__(self, *, shell: bool = False, stream: bool = True) -> None:
        super().__init__(tlv.TlvProtocol(), "DWM1001 tag")
        self.config: tlv.NodeConfig | None = None
        self.rate: tlv.UpdateRate | None = None
        self.values: dict[str, int] = {}
        self.joined: bool | None = None
        self._shell, self._stream = shell, stream
        self._poller: FixPoller | None = None
        self._health = LinkHealth()
        self._guard = RangeGuard(self._health)
        self._begun = False
        """The stream was begun: its lines count, also those that come late, while the tag is looked for again."""
        self._last_line = 0.0
        """s, when the last line of the stream came."""
        self._missed = False
        self.begin()

    def begin(self) -> None:
        """Forget what was half received; the mode is not known."""
        self._tlv, self._lines = tlv.TlvProtocol(), ShellProtocol()
        self._text = self._binary = True
        self._streaming = self._heard = False
        self._noise: list[Action] = []
        """Bytes that neither mode explains, until the mode is known: what only one of them explains is no damage."""

    @property
    def period(self) -> float:
        """Expected time between fixes, s."""
        return max(SHORTEST_PERIOD, self.rate.normal) if self.rate else SHORTEST_PERIOD

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return the events of the mode that the module is in, of both while that is not known."""
        self._heard = self._heard or bool(data)
        noise: list[Any] = self._tlv.feed(data, now) if self._binary else []
        events: list[Any] = [*(self._lines.feed(data, now) if self._text else []), *noise]
        self._learn(events)
        if not (self._text and self._binary):
            return events
        self._noise += [event for event in noise if isinstance(event, Corrupt)]
        return [event for event in events if not isinstance(event, Corrupt)]

    def _learn(self, events: Iterable[Any]) -> None:
        """Remember what the module answers of itself."""
        for event in events:
            if isinstance(event, tlv.NodeConfig):
                self.config = event
            elif isinstance(event, tlv.UpdateRate):
                self.rate = event
            elif isinstance(event, tlv.Value):
                self.values[event.name] = event.value
            elif isinstance(event, tlv.Status):
                self.joined = event.joined

    def spacing(self, event: Any) -> float | None:
        return self.period if self._begun and isinstance(event, RangeLine) else None

    def damaged(self) -> None:
        if self._begun:
            self._missed = True
            self._health.damage(self.now)

    def take(self, event: Any) -> Iterable[Action]:
        return self._take_line(event) if self._begun and isinstance(event, RangeLine) else ()

    def stop(self) -> list[Action]:
        noise = self._noise if self._text and self._binary else []
        return [*noise, *self._guard.finish(), *([Send(b"lec\r")] if self._streaming else [])]

    def script(self) -> Script[None]:
        """Find the module, learn who it is, and read fixes; begin again when it falls silent."""
        while True:
            if not (yield from self._find()):
                yield from self._noise
                yield from self.say_once(UNREADABLE if self._heard else SILENT)
                yield Reopen("no answer")
                continue
            yield from (self._ask_shell() if self._shell else self._query())
            yield from self._describe()
            self.ready = True
            if not self._stream:
                return
            why = _SILENT
            if self._shell:
                why = yield from self._read_lines()
            else:
                self._poller = self._poller or FixPoller(self, self.period)
                yield from self._poller.script()
            yield Note("warning", "uwb-restart", f"uwb: {why}; starting the module again")

    # ---- finding out the mode, and changing it

    def _find(self) -> Script[bool]:
        """Bring the module into the mode wanted; False = no answer."""
        self.begin()
        shell = yield from self._in_shell()
        if shell is None:
            return False
        if self._shell:
            self._text, self._binary = True, False
            self._lines = self._lines if shell else ShellProtocol()
            prompt = shell or (yield from self.ask(ENTER, lambda e: isinstance(e, Prompt), 1.2, 3))
            return prompt is not None
        if shell:
            self._text, self._binary = True, False
            yield Send(b"quit\r")
            yield from self.sleep(SETTLE)
        self._text, self._binary = False, True
        self._tlv.reset()
        return not shell or (yield from self.ask(tlv.STATUS_GET, lambda e: isinstance(e, tlv.Status), PATIENCE, 4)) is not None

    def _in_shell(self) -> Script[bool | None]:
        """Return whether the module is in its shell, and quiet; None = no answer."""
        left = _source((yield from self.sleep(DRAIN)))
        for probe, patience in () if left else PROBES:
            yield Send(probe)
            until = self.now + patience
            while (event := (yield Wait(until))) is not None and not left:
                if isinstance(event, tlv.Status):
                    return False
                if isinstance(event, Prompt):
                    return True
                left = _source([event])
            if left:
                break
        if not left:
            return None
        self._binary = False
        text = f"uwb: a {left} stream was left running; stopped it"
        yield from self.say_once(Note("info", "uwb-stream-left", text))
        for _ in range(4):
            if left:
                yield Send(left.encode() + b"\r")
                yield from self.sleep(QUIET[0])
                left = _source((yield from self.sleep(QUIET[1])))
        return True

    # ---- shell

    def _ask_shell(self) -> Script[None]:
        texts: list[str] = []
        self.joined = None
        yield Send(b"si\r")
        until = self.now + 1.0
        while (event := (yield Wait(until))) is not None and not (texts and isinstance(event, Prompt)):
            if isinstance(event, TextLine):
                texts.append(event.text)
        self._learn(node_facts(texts))

    def _read_lines(self) -> Script[str]:
        """Read the stream until no more lines come, and return why; the command toggles it, so it is sent until they do, while
        it is echoed."""
        self._streaming = self._begun = self._missed = True
        tries, why = 4, _SILENT
        while tries:
            tries -= 1
            yield Send(b"lec\r")
            until, answered = self.now + max(1.0, 3 * self.period), False
            while (event := (yield Wait(until))) is not None:
                answered = True
                if isinstance(event, RangeLine):
                    until, tries, self._binary = self.now + max(3.0, 3 * self.period), 4, False
                elif isinstance(event, tlv.Answer):
                    tries, why, until = 0, "it restarted and left its shell", self.now
            if not answered:  # not even an echo: it is no longer in its shell
                break
            self._binary = True
        self._streaming = False
        return why

    def _take_line(self, line: RangeLine) -> Iterator[Action]:
        """Log a line. It has no sum: a range that leaps or a new anchor must come again."""
        gap = round((line.stamp - self._last_line) / self.period) - 1 if self._last_line else 0
        if gap > 0 and self._missed:
            yield Lost(gap)
        self._last_line, self._missed = line.stamp, False
        yield from self._guard.take(RangeEpoch(line.stamp, line.readings), self.now)

    # ---- TLV

    def _query(self) -> Script[None]:
        for request, answers in QUERIES:
            yield from self.ask(request, answers, PATIENCE)

    # ---- who it is

    def _describe(self) -> Script[None]:
        """Name the module in the log, and what of its settings hurts."""
        for name, key in (("uwb_tag_id", "node_id"), ("uwb_pan_id", "pan_id")):
            if key in self.values:
                yield Param(name, tlv.short_id(self.values[key]))
        if "firmware" in self.values:
            yield Param("uwb_tag_firmware", self._firmware())
        if self.config is not None:
            # By TLV the polls tell whether it has joined: at first it may not have yet.
            joined = self.joined if self._shell else None
            yield from self.say_once(*advise(self.config, joined=joined, period=self.period))

    def _firmware(self) -> str:
        return ".".join(str(byte) for byte in self.values["firmware"].to_bytes(4, "big"))

    def identity(self) -> Identity:
        details = {}
        node, network = self.values.get("node_id"), self.values.get("pan_id")
        if node is not None:
            details["id"] = tlv.short_id(node)
        if network is not None:
            details["network"] = f"0x{network:04X}"
        if "firmware" in self.values:
            details["firmware"] = self._firmware()
        if self.rate:
            details["period"] = f"{self.rate.normal:.1f} s moving, {self.rate.stationary:.1f} s at rest"
        findings = []
        if self.joined is not None:
            details["network state"] = "joined" if self.joined else "not joined"
            findings += [] if self.joined else [NOT_JOINED]
        if network == 0:
            text = "the network id is 0: in the shell type `nis 0xC0DE` (with 0x), then `reset`"
            findings.append(Note("error", "no-network-id", text))
        title = "DWM1001 anchor" if self.config and self.config.anchor else self.title
        return Identity(title, tuple(details.items()), tuple(findings))


def _is_value(event: Any, name: str) -> bool:
    return isinstance(event, tlv.Value) and event.name == name


def _source(events: list[Any]) -> str:
    """Return the command of the stream that lines among the events belong to, "" where there are none."""
    for event in events:
        if isinstance(event, RangeLine | PositionLine):
            return event.source if isinstance(event, RangeLine) else "lep"
    return ""
