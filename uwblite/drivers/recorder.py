"""The recorder: several devices, one loop, one log.

One thread waits on all ports at once. Each port has a session that decides what to send and what was measured; the
recorder writes measurements as log lines, reconnects devices that vanish, reports when one falls silent, and counts what
was lost. It reads no clock of its own: the caller hands in `monotonic`, and stamps become wall time by one offset fixed
at the start, so that a clock set by NTP in mid-run moves nothing.
"""

import selectors
from collections.abc import Callable

from ..errors import DeviceError
from .events import Action, Corrupt, Lost, Measurement, Note, Param, Reopen, Send, SetBaud, SetDtr
from .link import Host, Link, Mounting, doubts, summary_lines
from .log_file import LogFile, LogText

HOUSEKEEPING = 0.25
"""s between looks at silent devices and the status line."""
OPENING = 0.02
"""s between looks while a port is being opened."""
DAMAGE_REPORT = 5.0
"""s between COMMENT lines about loss and damage."""
CLOCK_SET = 0.5
"""s by which the computer's clock must be set to be reported."""
POLL = 0.005
"""s between reads of a port that cannot be waited on."""


class Recorder:
    """Record until asked to stop; `on_note` gets the seconds since the start and each thing a person must know."""

    def __init__(
        self,
        links: list[Link],
        log: LogFile,
        host: Host,
        mounting: Mounting | None = None,
        on_note: Callable[[float, Note], None] | None = None,
    ) -> None:
        self.links, self.log, self._host = links, log, host
        self._now, self._on_note = host.monotonic, on_note or (lambda _t, _n: None)
        self._set_by = 0.0
        """s, by how much the computer's clock was set since the start."""
        self._selector = selectors.DefaultSelector()
        self.start = self._now()
        self._text = LogText(log, mounting or Mounting(), host)
        self.end = self._damage_due = self.start

    # ---- running

    def run(self, *, duration: float | None, stopping: Callable[[], bool], on_status: Callable[[], None] | None = None) -> None:
        """Record for a `duration`, s, or until `stopping`, which is asked several times a second, as `on_status` is called.

        Raises
        ------
        DataError : the log cannot be written any more.
        """
        until = None if duration is None else self.start + duration
        next_look = self.start
        try:
            while not stopping():
                now = self._now()
                if until is not None and now >= until:
                    break
                self._serve(now, next_look if until is None else min(next_look, until))
                if now >= next_look:
                    self._housekeeping(now)
                    opening = any(link.opening for link in self.links)
                    next_look = now + (OPENING if opening else HOUSEKEEPING)
                    if on_status:
                        on_status()
                self._text.flush()
        finally:
            self.end = self._now()
            self._finish()

    def _serve(self, now: float, until: float) -> None:
        """Read the devices when bytes come, at most until a time, s, and send what was due at time `now`, s.

        All that had come by then was read: where this computer stood still, no device was silent.
        """
        blind = [link for link in self.links if link.port is not None and link.port.fileno() is None]
        deadlines = [d for link in self.links if link.port and (d := link.session.deadline()) is not None]
        timeout = max(0.0, min([until, *deadlines]) - now)
        if blind:
            timeout = min(timeout, POLL)
        ready = [key.data for key, _ in self._selector.select(timeout)]
        for link in [*ready, *blind]:
            self._read(link)
        for link in self.links:
            if link.port is not None:
                deadline = link.session.deadline()
                if deadline is not None and deadline <= now:
                    self._do(link, link.session.tick(self._now()), self._now())

    def _read(self, link: Link) -> None:
        if link.port is None:
            return
        try:
            data = link.port.read()
        except DeviceError as error:
            self._down(link, str(error))
            return
        if data:
            now = self._now()
            link.last_data = now
            link.counts.bytes += len(data)
            self._do(link, link.session.feed(data, now), now)

    def _do(self, link: Link, actions: list[Action], now: float) -> None:
        counts = link.counts
        for action in actions:
            if isinstance(action, Measurement):
                self._message(link, action.stamp, now)
                self._text.write(action, link)
            elif isinstance(action, Send | SetBaud | SetDtr):
                if not self._send(link, action):
                    return
            elif isinstance(action, Corrupt):
                counts.corrupt[action.why] += 1
                link.new_corrupt += 1
            elif isinstance(action, Lost):
                counts.lost += action.count
                link.new_lost += action.count
            elif isinstance(action, Note):
                self._note(link, link.named(action))
            elif isinstance(action, Param):
                self._text.param(link.param_name(action.name), action.value)
            elif isinstance(action, Reopen) and not link.is_held_up(now):
                self._down(link, action.why)
                return

    def _send(self, link: Link, action: Send | SetBaud | SetDtr) -> bool:
        try:
            link.send(action)
        except DeviceError as error:
            self._down(link, str(error))
        return link.port is not None

    def _message(self, link: Link, stamp: float, now: float) -> None:
        if ended := link.received(stamp, now):
            self._note(link, Note("info", f"{link.name}-data-again", f"{link.name}: {ended}"))
            link.stated.clear()

    # ---- the log

    def begin(self, lines: list[str]) -> None:
        """Write the head of the log; lines are comments, without the word COMMENT."""
        self._text.head(lines)

    def note(self, note: Note) -> None:
        """Write a Note as COMMENT and report it to the caller."""
        self._text.comment(f"{note.level} {note.name}: {note.text}")
        self._on_note(self._now() - self.start, note)

    def _note(self, link: Link, note: Note) -> None:
        """Say something of a device, once until it gives data again: one that comes and goes would fill the log."""
        if note.name not in link.stated:
            link.stated.add(note.name)
            self.note(note)

    # ---- devices that come and go

    def _housekeeping(self, now: float) -> None:
        if self.log.restore():
            text = f"{self.log.path} was deleted; it is written again, with all that was in it"
            self.note(Note("warning", "log-deleted", text))
        self._look_at_clock(now)
        for link in self.links:
            link.update_rate(now)
            if link.port is None:
                if now >= link.retry_at:
                    self._up(link, now)
            else:
                self._watch(link, now)
        if now >= self._damage_due:
            self._damage_due = now + DAMAGE_REPORT
            self._report_damage()

    def _look_at_clock(self, now: float) -> None:
        by = 0.0 if self._host.wall is None else self._host.wall() - now - self._host.wall_offset - self._set_by
        if abs(by) > CLOCK_SET:
            self._set_by += by
            text = f"this computer's clock was set by {by:+.1f} s, or it slept; the stamps of this log go on as before"
            self.note(Note("warning", "clock-set", text))

    def _report_damage(self) -> None:
        hurt = [link for link in self.links if link.new_lost or link.new_corrupt]
        if hurt:
            self._text.comment("; ".join(f"{link.name}: lost {link.new_lost}, corrupt {link.new_corrupt}" for link in hurt))
        for link in hurt:
            link.new_lost = link.new_corrupt = 0

    def _watch(self, link: Link, now: float) -> None:
        note, hangs = link.watch(now)
        if note:
            self._note(link, note)
        if hangs:
            self._down(link, "silent")

    def _up(self, link: Link, now: float) -> None:
        port = link.connect(now, self._host.open_port)
        if isinstance(port, DeviceError):
            self._note(link, Note("error", f"{link.name}-cannot-open", f"{link.name}: {port}; trying again"))
        elif port is not None:
            fileno = port.fileno()
            if fileno is not None:
                self._selector.register(fileno, selectors.EVENT_READ, link)
            self._note(link, Note("info", f"{link.name}-connected", f"{link.name}: {link.url} open"))
            self._do(link, link.session.start(now), now)

    def _down(self, link: Link, why: str) -> None:
        if link.port is None:
            return
        fileno = link.port.fileno()
        if fileno is not None:
            self._selector.unregister(fileno)
        link.disconnect(self._now())
        self._note(link, Note("warning", f"{link.name}-gone", f"{link.name}: {why}; opening it again"))

    # ---- the end

    def summary(self) -> list[str]:
        size = f"{self.log.bytes / 1e6:.2f} MB in {self.log.path}"
        return [f"recorded {self.end - self.start:.1f} s, {size}", *summary_lines(self.links, self.start, self.end)]

    def doubts(self) -> list[str]:
        return doubts(self.links, self.start, self.end)

    def _finish(self) -> None:
        for link in self.links:
            self._do(link, link.session.stop(), self.end)
            never = link.finish()
            if never:
                self._note(link, Note("error", f"{link.name}-cannot-open", never))
        self._selector.close()
        self._report_damage()
        for line in self.summary():
            self._text.comment(line)
        self._text.flush()
