"""One session drives any device: bytes go through the device's protocol, and what comes out resumes its script.

A *driver* is what one kind of device needs: a protocol (bytes to events, sans-I/O) and a *script*, a generator that reads
like the conversation it holds. It yields actions (bytes to send, measurements, notes); to wait, it yields a `Wait`, and
gets back an event of the protocol, or None when the time is over::

    def script(self):
        yield Send(b"QT\\n")
        reply = yield Wait(self.now + 0.4)

Measurements that the device sends unasked are handled by `take`, whatever the script waits for: they may come late, while the
script already looks for a device that had fallen silent. A device that only talks needs no script of its own. Nothing here
opens a port or reads a clock: the caller brings `now`, seconds of a monotonic clock.
"""

import math
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from types import UnionType
from typing import Any, Protocol, TypeVar

from .backlog import Backlog
from .events import Action, Corrupt, Note, Send


@dataclass(frozen=True, slots=True)
class Wait:
    """Wait for the next event, at most until this time."""

    until: float | None
    """s; None = for ever."""


Result = TypeVar("Result")
Script = Generator[Action | Wait, Any, Result]
"""Yields actions and waits, gets events, returns a result to the script that called it."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Who answered on a port, for people."""

    title: str
    details: tuple[tuple[str, str], ...] = ()
    """(name, value)."""
    findings: tuple[Note, ...] = ()
    """What about it needs mending."""


class ByteProtocol(Protocol):
    """Bytes to events, sans-I/O."""

    def feed(self, data: bytes, stamp: float) -> list[Any]:
        """Take bytes that arrived at `stamp` s and return the events they complete, in the order of the bytes."""

    def reset(self) -> None:
        """Forget what is half received."""


class Driver:
    """What one kind of device needs; kinds derive from this.

    A driver lives as long as the recording: what it learned (a clock, a pose, known anchors) stays after a reconnect.
    """

    baud = 115200
    """bit/s to open the port with."""
    frame: type | None = None
    """Of the events that are frames of a steady stream."""
    rhythm = 0.0
    """s between two of them; 0 = it is to be learnt."""

    def __init__(self, protocol: ByteProtocol, title: str) -> None:
        self.protocol, self.title = protocol, title
        self.now = 0.0
        """s, host clock: the time of what is being handled."""
        self.ready = False
        """The device was found and identified."""
        self._told: set[str] = set()

    def begin(self) -> None:
        """Forget what was half received: the port was just opened."""
        self.protocol.reset()

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return the events that bytes complete."""
        return self.protocol.feed(data, now)

    def spacing(self, event: Any) -> float | None:
        """Return how long after the one before the device sends a frame, s; None = the event is none, or has its own time."""
        return self.rhythm if self.frame is not None and isinstance(event, self.frame) else None

    def members(self, event: Any) -> tuple[str, ...]:
        """Return what a frame contains of a round that has each once, such as anchors; none = each frame is a round."""
        return ()

    def take(self, event: Any) -> Iterable[Action]:
        """Return what an event means that the device may send unasked."""
        return ()

    def damaged(self) -> None:
        """Note that bytes were damaged: frames may have been lost with them, how many is not known."""

    def script(self) -> Script[None]:
        """Hold the conversation; by default, send nothing."""
        yield Wait(None)

    def stop(self) -> list[Action]:
        """Return what to send so that the device falls quiet."""
        return []

    def identity(self) -> Identity:
        """Say who answered, once `ready`."""
        return Identity(self.title)

    # ---- words of a script

    def say_once(self, *notes: Note) -> list[Action]:
        """Return the notes that were not reported yet."""
        fresh = [note for note in notes if note.name not in self._told]
        self._told.update(note.name for note in fresh)
        return list(fresh)

    def sleep(self, seconds: float) -> Script[list[Any]]:
        """Wait and return the events that came meanwhile."""
        until, events = self.now + seconds, []
        while (event := (yield Wait(until))) is not None:
            events.append(event)
        return events

    def listen(self, kind: type | UnionType, patience: float) -> Script[None]:
        """Wait until nothing of a kind came for so long, s."""
        until = self.now + patience
        while (event := (yield Wait(until))) is not None:
            if isinstance(event, kind):
                until = self.now + patience

    def ask(self, request: bytes, answers: Callable[[Any], bool], patience: float, tries: int = 1) -> Script[Any]:
        """Send a request, again if need be, and return the first event that answers it; None = none came."""
        for _ in range(tries):
            yield Send(request)
            until = self.now + patience
            while (event := (yield Wait(until))) is not None:
                if answers(event):
                    return event
        return None


class Session:
    """Start-up, running and recovery of one device, without a port."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._script: Script[None] | None = None
        self._due: float | None = None
        self._backlog = Backlog()
        self.last_event = -math.inf
        """s, when the device last sent something that was understood."""

    @property
    def baud(self) -> int:
        return self.driver.baud

    def start(self, now: float) -> list[Action]:
        """Begin, or begin again after a reconnect, at time `now`, s."""
        self.driver.now = now
        actions = self._handle(self._backlog.release())
        self.driver.begin()
        self._script = self.driver.script()
        return [*actions, *self._resume(None)]

    def feed(self, data: bytes, now: float) -> list[Action]:
        """Take bytes that arrived at time `now`, s."""
        self.driver.now = now
        actions: list[Action] = []
        for event in self.driver.parse(data, now):
            if not isinstance(event, Corrupt):
                self.last_event = now
            held = self._backlog.take(event, now, self.driver.spacing(event), self.driver.members(event))
            actions += self._handle(held)
        return actions

    def tick(self, now: float) -> list[Action]:
        """Do what is due at time `now`, s."""
        self.driver.now = now
        actions = self._handle(self._backlog.due(now))
        due = self.deadline()
        return [*actions, *self._resume(None)] if due is not None and now >= due else actions

    def deadline(self) -> float | None:
        """Return the time at which `tick` wants to be called, s; None = when bytes come."""
        held = self._backlog.deadline()  # the script does not know yet that they came
        return self._due if held is None else held

    @property
    def is_catching_up(self) -> bool:
        """Frames that came after a pause wait for those behind them."""
        return self._backlog.deadline() is not None

    def stop(self) -> list[Action]:
        """Return what to send so that the device falls quiet."""
        return [*self._handle(self._backlog.release()), *self.driver.stop()]

    def _handle(self, events: list[Any]) -> list[Action]:
        actions: list[Action] = []
        for event in events:
            if isinstance(event, Corrupt):
                self.driver.damaged()
                actions.append(event)
            else:
                actions += self.driver.take(event)
            actions += self._resume(event)
        return actions

    def _resume(self, event: Any) -> list[Action]:
        """Let the script go on to its next wait."""
        actions: list[Action] = []
        while self._script is not None:
            try:
                step = self._script.send(event)
            except StopIteration:
                self._script, self._due = None, None
                break
            if isinstance(step, Wait):
                self._due = step.until
                break
            actions.append(step)
            event = None
        return actions
