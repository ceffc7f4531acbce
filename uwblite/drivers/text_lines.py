"""Devices that print text lines and are only listened to: bytes to lines, lines to columns, and the driver they share."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .clock import DeviceClock
from .events import Action, Corrupt, Lost, corrupt
from .framing import LineReader
from .session import Driver, Script, Wait

LEAP_TIME = 1.0
"""s by which the device's clock may run ahead of the arrivals between two lines."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Line:
    """A line that was understood."""

    stamp: float
    """s, arrival of its first byte."""
    content: Any
    """What the parser of its lines made of it."""


def columns_of(text: str, columns: tuple[str, ...], prefix: str) -> dict[str, str] | str | None:
    """Part a line by commas, semicolons or blanks.

    Parameters
    ----------
    columns : their names; ``-`` = skip. prefix : text before them.

    Returns
    -------
    dict of column -> text; a str says why the line is damaged; None = it has another prefix and is not meant.
    """
    at = text.rfind(prefix) if prefix else 0
    if at < 0:
        return None
    fields = re.split(r"[,;\s]+", text[at + len(prefix) :].strip(" ,;\t"))
    if len(fields) != len(columns):
        return f"{len(fields)} columns instead of {len(columns)}"
    return {name: field for name, field in zip(columns, fields, strict=True) if name != "-"}


def number_of(text: str) -> float | None:
    """Return the number that a column holds, None = it holds none, or one that nothing counts to."""
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    return value if abs(value) < _MOST else None


_MOST = 1e18
"""Nanoseconds since 1970 are below."""


class LineProtocol:
    """Bytes in, Line and Corrupt out. Holds at most one line.

    Parameters
    ----------
    parse : a line -> its content; a str says why it is damaged; None = it is not meant for us.
    most : bytes of a line.
    """

    def __init__(self, parse: Callable[[str], Any], most: int = 4096) -> None:
        self._parse, self._most = parse, most
        self.reset()

    def reset(self) -> None:
        """Forget half a line."""
        self._lines = LineReader(self._most)

    def feed(self, data: bytes, stamp: float) -> list[Line | Corrupt]:
        """Take bytes that arrived at `stamp` s and return the events they complete, in the order of the bytes."""
        events: list[Line | Corrupt] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
            elif line.data.strip() and not line.cut:
                content = self._parse(line.data.strip().decode("ascii", "replace"))
                if isinstance(content, str):
                    events.append(corrupt(line.data.strip(), content))
                elif content is not None:
                    events.append(Line(line.stamp_at(0), content))
        return events


class LineDriver(Driver):
    """A device that prints lines, perhaps with its own time in them. Nothing is ever sent.

    Parameters
    ----------
    parse : a line -> its content. title : of the device, for people. baud : bit/s.
    time_unit : s per unit of its time.
    """

    def __init__(self, parse: Callable[[str], Any], title: str, baud: int, time_unit: float) -> None:
        super().__init__(LineProtocol(parse), title)
        self.baud, self.clock = baud, DeviceClock(time_unit, proven=False)
        self._unit = time_unit
        self._before: tuple[float, float] | None = None
        """Time of the device, its own unit, and arrival, s, of the last line that was accepted."""
        self._doubted = False

    def script(self) -> Script[None]:
        """Pass over the first line, of which the port may have shown only the end; then listen."""
        yield Wait(None)
        yield from super().script()

    def leaps(self, time: float | None, arrival: float) -> bool:
        """Return whether a line's time leaps: lines have no sum, and a digit that is lost makes another number.

        Of two in a row the second one counts: the device began again.

        Parameters
        ----------
        time : of the device, its own unit; None = the line has none. arrival : s, host clock.
        """
        before, known = self._before, self.clock.proven and self.clock.rate is None
        if time is not None and before is not None and known:
            elapsed, waited = (time - before[0]) * self._unit, max(arrival - before[1], 0.0)
            self._doubted = not self._doubted and not -1e-9 <= elapsed <= waited + LEAP_TIME
        if time is not None and not self._doubted:
            self._before = time, arrival
        return self._doubted

    def timed(self, time: float | None, arrival: float) -> tuple[float, float | None, list[Action]]:
        """Return the stamp of a line, s, the time since the one before by the device, s, and what is missing in between.

        Parameters
        ----------
        time : of the device, its own unit; None = the line has none. arrival : s, host clock.
        """
        if time is None:
            return arrival, None, []
        reading = self.clock.read(time, arrival)
        return reading.stamp, reading.elapsed, [Lost(reading.stamp, reading.missing)] if reading.missing else []
