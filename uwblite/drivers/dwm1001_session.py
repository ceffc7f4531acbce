"""Start-up, polling and recovery of a DWM1001 tag, without a port: what to send next, given answers and time.

Two ways to read it. *TLV* (default): status_get until a fix is ready, then loc_get; distances to 1 mm. *Shell*: the
stream of ``lec``; distances to 1 cm. Either way a module left in the other mode, or streaming for a host that died, is
brought round. The polling itself is in ``dwm1001_poll``.
"""

from .dwm1001 import BAUD, STATUS_GET, TlvProtocol, request
from .dwm1001_advice import advise, not_joined
from .dwm1001_blocks import ERRORS, Answer, Distances, NodeConfig, Status, UpdateRate, Value, short_id
from .dwm1001_blocks import Event as TlvEvent
from .dwm1001_poll import FixPoller
from .dwm1001_shell import (
    ENTER,
    NodeInfo,
    PositionLine,
    Prompt,
    RangeLine,
    ShellProtocol,
    TextLine,
    parse_node_info,
    shell_command,
)
from .events import Action, Corrupt, Note, Param, RangeEpoch, Reopen, Send

DRAIN = 0.25
PATIENCE = 0.25
"""s to wait for an answer during start-up."""
MAX_SILENT_POLLS = 40
"""Polls without an answer before the module is started again."""
MAX_ROUNDS = 8
QUERIES = ("ver_get", "nodeid_get", "panid_get", "cfg_get", "upd_rate_get")


class Dwm1001Session:
    """One DWM1001 tag; see `events.Session` for the methods.

    Parameters
    ----------
    shell : read the text stream instead of polling TLV.
    stream : False: stop after the queries (for a look at what is plugged in).
    """

    def __init__(self, *, shell: bool = False, stream: bool = True) -> None:
        self.baud = BAUD
        self.config: NodeConfig | None = None
        self.rate: UpdateRate | None = None
        self.values: dict[str, int] = {}
        self.info = NodeInfo()
        self.joined: bool | None = None
        self.ready = False
        self._shell, self._stream = shell, stream
        self._told: set[str] = set()
        self._known: set[str] = set()
        self._rounds = 0
        self._distrust_until = 0.0
        self._reset(0.0)

    def _reset(self, now: float) -> None:
        self._tlv, self._lines = TlvProtocol(), ShellProtocol()
        self._step, self._sent, self._tries = "drain", now, 0
        self._due: float | None = now + DRAIN
        self._text_mode = False
        self._streaming = ""
        self._query = 0
        self._texts: list[str] = []
        self._poller: FixPoller | None = None

    @property
    def period(self) -> float:
        """Expected time between fixes, s."""
        return max(0.1, self.rate.normal) if self.rate else 0.1

    # ---- the session interface

    def start(self, now: float) -> list[Action]:
        """Begin, or begin again after a reconnect, at time `now`, s."""
        self._reset(now)
        return []

    def deadline(self) -> float | None:
        """Return when `tick` is due, s."""
        return self._poller.due if self._poller else self._due

    def stop(self) -> list[Action]:
        """Return what ends a stream; polling ends by itself."""
        return [Send(shell_command("lec"))] if self._step == "lines" else []

    def feed(self, data: bytes, now: float) -> list[Action]:
        """Take bytes that arrived at time `now`, s."""
        actions: list[Action] = []
        if self._step in ("drain", "probe") or self._text_mode:
            for event in self._lines.feed(data, now):
                if isinstance(event, Corrupt):
                    actions += [event] if self._text_mode else []
                else:
                    actions += self._text(event, now)
        if not self._text_mode:
            for answer in self._tlv.feed(data, now):
                if isinstance(answer, Corrupt):
                    actions += [answer] if self._step not in ("drain", "probe") else []
                    if self._poller:
                        self._poller.damaged(now)
                else:
                    actions += self._answer(answer, now)
        return actions

    def tick(self, now: float) -> list[Action]:
        """Do what is due."""
        if self._poller:
            return self._poll(self._poller, now) if now >= self._poller.due else []
        if self._due is None or now < self._due:
            return []
        if self._step == "drain":
            return self._after_drain(now)
        if self._step == "query":
            return self._after_query(now)
        if self._step == "lines":
            return self._lines_stopped(now)
        return self._step_failed(now)

    # ---- finding out the mode

    def _say(self, step: str, data: bytes, now: float, wait: float = PATIENCE) -> list[Action]:
        self._step, self._due, self._sent = step, now + wait, now
        return [Send(data)]

    def _after_drain(self, now: float) -> list[Action]:
        if self._streaming:
            # A dead host left a stream running: the same command again stops it.
            command, self._streaming = self._streaming, ""
            self._text_mode = True
            text = f"uwb: a {command} stream was left running; stopped it"
            return [*self._tell("info", "uwb-stream-left", text), *self._say("quiet", shell_command(command), now, 0.5)]
        self._tlv.reset()
        return self._say("probe", STATUS_GET, now)

    def _step_failed(self, now: float) -> list[Action]:
        """Nothing, or nothing fitting, came in time."""
        self._tries += 1
        step = self._step
        if step == "quiet":
            if self._streaming:
                return self._after_drain(now)
            return self._leave_or_use_shell(now)
        if step == "probe":
            if self._text_mode:
                # It echoed: a shell. The two bytes typed are not a command; CR gets a prompt.
                return self._say("prompt", b"\r", now, 0.5)
            if self._tries == 2:
                return self._say("probe", ENTER, now, 0.6)  # wakes a sleeping tag; opens the shell otherwise
            if self._tries < 5:
                return self._say("probe", STATUS_GET, now)
        if step == "prompt" and self._tries < 5:
            return self._leave_or_use_shell(now) if self._text_mode else self._say("prompt", b"\r", now, 1.0)
        if step == "enter" and self._tries < 5:
            return self._say("enter", ENTER if self._tries % 2 == 0 else b"\r", now, 1.2)
        if step == "leave":
            self._text_mode = False
            self._tlv.reset()
            if self._tries < 6:
                return self._say("probe", STATUS_GET, now)
        if step == "info":
            return self._start_lines(now)
        return self._give_up(now)

    def _give_up(self, now: float) -> list[Action]:
        self._rounds += 1
        text = (
            "uwb: no answer. The USB bridge of the DEV board can hang: unplug it and plug it in again;"
            " check that the port is the DWM1001's and that no other program has it"
        )
        note = self._tell("error", "uwb-silent", text)
        self._reset(now)
        return [*note, Reopen("no answer")]

    def _say_once(self, notes: list[Note]) -> list[Action]:
        fresh = [note for note in notes if note.name not in self._told]
        self._told.update(note.name for note in fresh)
        return list(fresh)

    def _tell(self, level: str, name: str, text: str) -> list[Action]:
        return self._say_once([Note(level, name, text)])

    def _leave_or_use_shell(self, now: float) -> list[Action]:
        if self._shell:
            return self._start_info(now)
        return self._say("leave", shell_command("quit"), now, 0.3)

    # ---- shell

    def _text(self, event: Prompt | RangeLine | PositionLine | TextLine, now: float) -> list[Action]:
        if isinstance(event, TextLine):
            if self._step == "info":
                self._texts.append(event.text)
            elif self._step == "probe" and event.text.startswith("DWM1001"):
                self._text_mode = True
            return []
        if isinstance(event, Prompt):
            if self._step in ("probe", "prompt", "enter"):
                self._text_mode = True
                return self._leave_or_use_shell(now)
            if self._step == "info" and self._texts:
                return self._start_lines(now)
            return []
        source = "lep" if isinstance(event, PositionLine) else event.source
        if self._step != "lines":
            self._streaming, self._text_mode = source, True
            if self._step == "probe":
                return self._after_drain(now)
            return []
        if isinstance(event, PositionLine):
            return []
        self._due = now + max(3.0, 3 * self.period)
        self._rounds = self._tries = 0
        return [RangeEpoch(event.stamp, event.readings)] if event.readings else []

    def _start_info(self, now: float) -> list[Action]:
        self._texts, self._tries = [], 0
        return self._say("info", shell_command("si"), now, 1.0)

    def _start_lines(self, now: float) -> list[Action]:
        self.info = parse_node_info(self._texts)
        settings = dict(self.info.settings)
        rate = settings.get("upd_rate_norm", "1")
        notes = self._say_once(advise(
            tag=self.info.mode in ("tn", ""), active=self.info.activity in ("act", ""),
            stationary=settings.get("stat_det") == "1", joined=self.info.connected,
            low_power=settings.get("lp") == "1", period=int(rate) / 10 if rate.isdecimal() else 0.1,
        ))  # fmt: skip
        params = [Param("uwb_tag_id", self.info.short_id)] if self.info.short_id else []
        if self.info.firmware:
            params.append(Param("uwb_tag_firmware", self.info.firmware))
        self.ready, self.joined = True, self.info.connected
        if not self._stream:
            self._step, self._due = "done", None
            return [*params, *notes]
        self._tries = 0
        return [*params, *notes, *self._say("lines", shell_command("lec"), now, max(1.0, 3 * self.period))]

    def _lines_stopped(self, now: float) -> list[Action]:
        self._tries += 1
        if self._tries > 4:
            return self._give_up(now)
        # The command toggles: if the last one switched a stream off that had been running, this one switches it on.
        return self._say("lines", shell_command("lec"), now, max(2.0, 3 * self.period))

    # ---- TLV

    def _answer(self, event: TlvEvent, now: float) -> list[Action]:
        if isinstance(event, Answer):
            if event.error and self._step == "query":
                return self._after_query(now)
            if event.error and self._poller:
                self._poller.refused(now)
                text = f"uwb: the module answers error {event.error}, {ERRORS[event.error]}"
                return self._tell("warning", f"uwb-error-{event.error}", text)
            if event.error and self._step == "probe" and now - self._sent < PATIENCE:
                self._due = min(self._due or now, now + 0.05)
            return []
        if isinstance(event, Status):
            return self._status(event, now)
        if isinstance(event, Distances):
            return self._poller.fix(event, now) if self._poller else []
        if isinstance(event, NodeConfig):
            self.config = event
        elif isinstance(event, UpdateRate):
            self.rate = event
        elif isinstance(event, Value):
            self.values[event.name] = event.value
        wanted = {"ver_get": "hardware", "nodeid_get": "node_id", "panid_get": "pan_id"}
        if self._step == "query":
            name = QUERIES[self._query]
            done = isinstance(event, Value) and event.name == wanted.get(name)
            done |= isinstance(event, NodeConfig) and name == "cfg_get"
            done |= isinstance(event, UpdateRate) and name == "upd_rate_get"
            if done:
                return self._after_query(now)
        return []

    def _status(self, status: Status, now: float) -> list[Action]:
        self.joined = status.joined
        if self._step == "probe":
            self._text_mode, self._tries = False, 0
            if self._shell:
                self._text_mode = True
                return self._say("enter", ENTER, now, 1.2)
            self._query = 0
            return self._say("query", request(QUERIES[0]), now)
        if self._poller is None:
            return []
        self._rounds = 0
        actions = self._poller.status(status, now)
        if not status.joined and now - self._poller.last_fix > 3.0:
            actions += self._say_once([not_joined()])
        return actions

    def _poll(self, poller: FixPoller, now: float) -> list[Action]:
        actions = poller.tick(now)
        if poller.failures:
            self._tlv.reset()
        if poller.failures <= MAX_SILENT_POLLS:
            return actions
        rounds = self._rounds + 1
        self._reset(now)
        self._rounds = rounds
        if rounds > MAX_ROUNDS:
            return self._give_up(now)
        return [Note("warning", "uwb-restart", "uwb: no answer for 2 s; starting the module again")]

    def _after_query(self, now: float) -> list[Action]:
        self._query += 1
        if self._query < len(QUERIES):
            return self._say("query", request(QUERIES[self._query]), now)
        self.ready, self._tries = True, 0
        actions: list[Action] = []
        for name, key, form in (
            ("uwb_tag_id", "node_id", short_id),
            ("uwb_pan_id", "pan_id", short_id),
            ("uwb_tag_firmware", "firmware", lambda v: ".".join(str(b) for b in v.to_bytes(4, "big"))),
        ):
            if key in self.values:
                actions.append(Param(name, form(self.values[key])))
        config = self.config
        if config is not None:
            actions += self._say_once(advise(
                tag=not config.anchor, active=config.uwb_mode == 2, stationary=config.stationary_detection,
                joined=None, low_power=config.low_power, period=self.period,
            ))  # fmt: skip
        if not self._stream:
            self._step, self._due = "done", None
            return actions
        self._step, self._poller = "poll", FixPoller(now, self.period, self._known, self._distrust_until)
        return [*actions, *self._poller.tick(now)]
