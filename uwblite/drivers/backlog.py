"""When frames would have come that the link or a busy computer held back.

All frames of a pause arrive at its end. One that comes after a pause waits, with those behind it, until they come no faster
than usual: the last one came at its own time, those before it at their usual distances. Where they do not fill the pause, the
rest of it was silence. But frames that came together before anything else go on from those before the pause: behind damaged
bytes others are missing, because a buffer has overflowed, and an answer shows that the stream was begun anew. A round of
several frames, one for each anchor, begins where one of its members comes again: rounds have the usual distance, and each
frame its usual place in the round.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

from .events import Corrupt

PAUSE, LEAST_PAUSE = 3.0, 0.1
"""Times the usual distance of frames, and s, that a pause is longer than: shorter lumps are usual."""
LOOK, MOST_LOOK, FAST = 4.0, 0.5, 8
"""Usual distances, at most so many s, in which fewer frames than FAST show that they come no faster than usual; of a faster
stream fewer than it sends in so much longer that they are looked for in LEAST_PAUSE: usual lumps are no end."""
MEMORY, USUAL = 256, 0.9
"""Distances that are remembered, and the share of them that is usual."""
MOST = 1 << 16
"""Events that wait at most."""


@dataclass(frozen=True, slots=True)
class _Held:
    """An event that waits."""

    event: Any
    spacing: float | None
    """s, usual distance of a frame from the one before; None = it is no frame."""
    period: float = 0.0
    """s, usual distance of a frame's round from the one before."""
    members: tuple[str, ...] = ()
    """Of a round, in the frame; none = it is a round."""


class Backlog:
    """The events of one device in their order, frames of a steady stream with the arrivals that they would have had."""

    def __init__(self) -> None:
        self._last: float | None = None
        """s, arrival of the last frame that does not wait."""
        self._steps: deque[float] = deque(maxlen=MEMORY)
        self._begun, self._periods = -math.inf, deque[float](maxlen=MEMORY)
        """s, first frame of its round, and from each round to the next."""
        self._came: set[str] = set()
        """Members of the round that came."""
        self._places: dict[str, float] = {}
        """s by which each member's frame comes after the first of its round."""
        self._waiting: list[_Held] = []

    def take(self, event: Any, now: float, spacing: float | None, members: tuple[str, ...] = ()) -> list[Any]:
        """Return the events that need not wait at time `now`, s; a frame has a `stamp`, the arrival of its first byte, s.

        Parameters
        ----------
        spacing : s, usual distance from the frame before, 0 = it is to be learnt; None = the event is no frame of a stream.
        members : of a round, which has each once, those in the frame; none = each frame is a round.
        """
        if not self._waiting and spacing is None:
            return [event]
        held = _Held(event, None)
        if spacing is not None:
            longest, mean = _usual(self._steps) if spacing == 0.0 else (spacing, spacing)
            step = 0.0 if self._last is None else event.stamp - self._last
            if not self._waiting and (longest == 0.0 or step <= max(PAUSE * longest, LEAST_PAUSE)):
                self._remember(event.stamp, members)
                return [event]
            held = _Held(event, mean, _usual(self._periods)[1] if spacing == 0.0 else spacing, members)
        self._waiting.append(held)
        answered = spacing is None and not isinstance(event, Corrupt) and _interrupted(self._waiting) > 0
        return self.release() if answered else self.due(now)

    def deadline(self) -> float | None:
        """Return the time at which events that wait need not do so any longer, s."""
        if not self._waiting:
            return None
        frames = [held for held in self._waiting[-MEMORY:] if held.spacing is not None]
        if not frames:  # so much else came behind them
            return -math.inf
        spacing = max(frames[-1].spacing or 0.0, LEAST_PAUSE / MEMORY)
        many = max(FAST, math.ceil(FAST / LOOK * LEAST_PAUSE / spacing))
        return float(frames[-many:][0].event.stamp + min(many * spacing * LOOK / FAST, MOST_LOOK))

    def due(self, now: float) -> list[Any]:
        """Return the events that need not wait any longer at time `now`, s."""
        deadline = self.deadline()
        return self.release() if deadline is not None and (now >= deadline or len(self._waiting) >= MOST) else []

    def release(self) -> list[Any]:
        waiting, self._waiting = self._waiting, []
        frames = [held for held in waiting if held.spacing is not None]
        if not frames or self._last is None:
            return [held.event for held in waiting]
        # Time from the beginning of the present round, as they are sent.
        sent, came, time = [], set(self._came), 0.0
        for held in frames:
            if self._begins(came, held.members):
                time, came = time + held.period, set()
            came.update(held.members)
            sent.append(time + max((self._places.get(name, 0.0) for name in held.members), default=0.0))
        # None came before it was sent.
        begun = min(held.event.stamp - each for held, each in zip(frames, sent, strict=True))
        latest = frames[-FAST:]
        together = latest[-1].event.stamp - latest[0].event.stamp < (sent[-1] - sent[-len(latest)]) * LOOK / FAST
        if together and begun - self._begun <= max(PAUSE * frames[-1].period, LEAST_PAUSE):
            begun = min(begun, self._begun)  # nothing shows when the last was sent: they go on from those before the pause
        last = begun + sent[-1]
        shrink = min(1.0, (last - self._begun) / max(sent[-1], 1e-9))
        kept = _interrupted(waiting)
        times = iter([self._begun + each for each in sent[:kept]] + [last - shrink * (sent[-1] - each) for each in sent[kept:]])
        events = []
        for held in waiting:
            event = held.event
            if held.spacing is not None:
                event = replace(event, stamp=min(event.stamp, max(next(times), self._last)))
                self._remember(event.stamp, held.members)
            events.append(event)
        return events

    def _begins(self, came: set[str], members: tuple[str, ...]) -> bool:
        return not members or not came.isdisjoint(members)

    def _remember(self, stamp: float, members: tuple[str, ...]) -> None:
        if self._last is not None:
            self._steps.append(stamp - self._last)
        if self._last is None or self._begins(self._came, members):
            if self._last is not None:
                self._periods.append(stamp - self._begun)
            self._begun, self._came = stamp, set()
        self._came.update(members)
        self._places.update(dict.fromkeys(members, stamp - self._begun))
        self._last = stamp


def _interrupted(waiting: list[_Held]) -> int:
    """Return how many frames stand before the first event that is none, having come faster than they were sent."""
    frames = list(takewhile(lambda held: held.spacing is not None, waiting))
    if len(frames) == len(waiting) or not frames:
        return 0
    came, sent = frames[-1].event.stamp - frames[0].event.stamp, sum(held.spacing or 0.0 for held in frames[1:])
    return len(frames) if came < sent * LOOK / FAST else 0


def _usual(steps: deque[float]) -> tuple[float, float]:
    """Return the longest usual distance, and the mean of all that are no pause, s."""
    longest = sorted(steps)[math.ceil(USUAL * len(steps)) - 1] if steps else 0.0
    usual = [step for step in steps if step <= PAUSE * longest]
    return longest, sum(usual) / max(len(usual), 1)
