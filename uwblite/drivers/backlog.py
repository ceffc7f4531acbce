"""When frames would have come that the link or a busy computer held back.

All frames of a pause arrive at its end. One that comes after a pause waits, with those behind it, until they come no faster
than usual: the last one came at its own time, those before it at their usual distances. Where they do not fill the pause, the
rest of it was silence.
"""

import math
from collections import deque
from dataclasses import replace
from typing import Any

PAUSE, LEAST_PAUSE = 3.0, 0.1
"""Times the usual distance of frames, and s, that a pause is longer than: shorter lumps are usual."""
LOOK, MOST_LOOK, FAST = 4.0, 0.5, 8
"""Usual distances, at most so many s, in which fewer frames than FAST show that they come no faster than usual."""
MEMORY, USUAL = 256, 0.9
"""Distances that are remembered, and the share of them that is usual: a board may send the ranges of a round together."""
MOST = 1 << 16
"""Events that wait at most."""


class Backlog:
    """The events of one device in their order, frames of a steady stream with the arrivals that they would have had."""

    def __init__(self) -> None:
        self._last: float | None = None
        """s, arrival of the last frame that does not wait."""
        self._steps: deque[float] = deque(maxlen=MEMORY)
        self._waiting: list[tuple[Any, float | None]] = []
        """Events, and for frames their usual distances from the one before, s."""

    def take(self, event: Any, now: float, spacing: float | None) -> list[Any]:
        """Return the events that need not wait at time `now`, s.

        Parameters
        ----------
        event : a frame has a `stamp`, the arrival of its first byte, s.
        spacing : s, usual distance from the frame before, 0 = it is to be learnt; None = the event is no frame of a stream.
        """
        if not self._waiting and spacing is None:
            return [event]
        if spacing is not None:
            longest, mean = self._learnt() if spacing == 0.0 else (spacing, spacing)
            step = 0.0 if self._last is None else event.stamp - self._last
            if not self._waiting and (longest == 0.0 or step <= max(PAUSE * longest, LEAST_PAUSE)):
                self._remember(event.stamp)
                return [event]
            spacing = mean
        self._waiting.append((event, spacing))
        return self.due(now)

    def deadline(self) -> float | None:
        """Return the time at which events that wait need not do so any longer, s."""
        frames = [(event.stamp, spacing) for event, spacing in self._waiting[-MEMORY:] if spacing is not None]
        if not frames:
            return None
        return float(frames[-FAST:][0][0] + min(LOOK * frames[-1][1], MOST_LOOK))

    def due(self, now: float) -> list[Any]:
        """Return the events that need not wait any longer at time `now`, s."""
        deadline = self.deadline()
        return self.release() if deadline is not None and (now >= deadline or len(self._waiting) >= MOST) else []

    def release(self) -> list[Any]:
        """Return all events that wait."""
        waiting, self._waiting = self._waiting, []
        frames = [(event.stamp, spacing) for event, spacing in waiting if spacing is not None]
        if not frames or self._last is None:
            return [event for event, _ in waiting]
        length, last = sum(spacing for _, spacing in frames), frames[-1][0]
        shrink = min(1.0, (last - self._last) / length)
        time, events = last - shrink * length, []
        for event, spacing in waiting:
            if spacing is not None:
                time += shrink * spacing
                event = replace(event, stamp=min(event.stamp, time))
                self._remember(event.stamp)
            events.append(event)
        return events

    def _remember(self, stamp: float) -> None:
        if self._last is not None:
            self._steps.append(stamp - self._last)
        self._last = stamp

    def _learnt(self) -> tuple[float, float]:
        """Return the longest usual distance, and the mean of all that are no pause, s."""
        longest = sorted(self._steps)[math.ceil(USUAL * len(self._steps)) - 1] if self._steps else 0.0
        steps = [step for step in self._steps if step <= PAUSE * longest]
        return longest, sum(steps) / max(len(steps), 1)
