"""Devices that print text lines and are only listened to: bytes to lines, lines to columns, and the driver they share."""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .continuity import WITNESSES, Continuity, LinkHealth
from .events import Action, Corrupt, Lost
from .framing import LineReader
from .session import ByteProtocol, Driver

EARLY = 0.02
"""s by which a line may come earlier than any before: the quickest way is known to that after a few lines."""
LATE = 0.05
"""s by which a line may come later than the quickest, on a damaged link; a busy computer, on a sound one, by any time."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Line:
    """A line that was understood."""

    stamp: float
    """s, arrival of its first byte."""
    content: Any
    """What the parser of its lines made of it."""


def columns_of(text: str, columns: tuple[str, ...], prefix: str, words: Collection[str] = ()) -> dict[str, Any] | str | None:
    """Return the numbers in named columns of a line, of `words` the texts; ``-`` = skip.

    Columns are parted by commas, semicolons or blanks. A str says why the line is damaged; None = it has another prefix.
    """
    start = text.rfind(prefix) if prefix else 0
    if start < 0:
        return None
    fields = re.split(r"[,;\s]+", text[start + len(prefix) :].strip(" ,;\t"))
    if len(fields) != len(columns):
        return f"{len(fields)} columns instead of {len(columns)}"
    named = ((name, field) for name, field in zip(columns, fields, strict=True) if name != "-")
    values = {name: field if name in words else _number(field) for name, field in named}
    wrong = next((name for name, value in values.items() if value is None), None)
    return f"column {wrong} is not a number" if wrong else values


def _number(text: str) -> float | None:
    """Return the number that a column holds, None = it holds none, or one that nothing counts to."""
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    return value if abs(value) < _MOST else None


_MOST = 1e18
"""Nanoseconds since 1970 are below."""


def named_columns(text: str, known: Collection[str], what: str) -> tuple[str, ...]:
    """Return the columns that a user names, parted by commas; ``-`` = skip.

    A known name that ends in a colon stands for all that begin so.

    Raises
    ------
    ConfigError : a name is unknown, or stands twice.
    """
    names = tuple(name.strip() for name in text.split(","))
    wrong = [n for n in names if n != "-" and (names.count(n) > 1 or n[: n.find(":") + 1 or None] not in known)]
    if wrong:
        listed = ", ".join(name + "NAME" * name.endswith(":") for name in known)
        raise ConfigError(f"{what}: column {wrong[0]!r}; known are {listed}, - to skip, each once")
    return names


_COLOUR = re.compile(rb"\x1b\[[\d;]*m")


class LineProtocol:
    """Bytes in, Line and Corrupt out. Holds at most one line.

    `parse` makes a line its content; a str says why it is damaged; None = it is not meant for us.
    """

    def __init__(self, parse: Callable[[str], Any], most: int = 4096) -> None:
        self._parse, self._most = parse, most
        self.reset()

    def reset(self) -> None:
        self._lines = LineReader(self._most)

    def feed(self, data: bytes, stamp: float) -> list[Line | Corrupt]:
        events: list[Line | Corrupt] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
            elif (text := _COLOUR.sub(b"", line.data).strip()) and not line.cut:
                content = self._content(text)
                if isinstance(content, str):
                    events.append(Corrupt(content))
                elif content is not None:
                    events.append(Line(line.stamp_at(0), content))
        return events

    def _content(self, line: bytes) -> Any:
        try:
            text = line.decode()
        except UnicodeDecodeError:
            text = "\0"
        return self._parse(text) if text.replace("\t", " ").isprintable() else "line with characters that nobody prints"


class LineDriver(Driver, ABC):
    """A device that is only listened to, perhaps with its own time in what it sends. Nothing is ever sent."""

    first_is_whole = False
    """The first line cannot be the end of one that began before the port was opened."""

    def __init__(self, protocol: ByteProtocol, title: str, baud: int, clock: DeviceClock) -> None:
        super().__init__(protocol, title)
        self.baud, self.clock, self.health = baud, clock, LinkHealth()
        self._series = Continuity(self.follows, "line that")
        self._cut = False

    def spacing(self, event: Line | Corrupt) -> float | None:
        """Return that the time between two lines without a time of their own is learnt."""
        return 0.0 if isinstance(event, Line) and self.time_of(event.content) is None else None

    def begin(self) -> None:
        """Discard half a line, and pass over the first one, of which the port may have shown only the end."""
        super().begin()
        self._cut = not self.first_is_whole

    def damaged(self) -> None:
        if not self._cut:
            self.health.damage(self.now)
        self._cut = False

    def take(self, event: Line) -> list[Action]:
        """Turn a line into what was measured. One that leaps counts only if the next one goes on from it."""
        if self._cut:
            self._cut = False
            return []
        return self._series.confirmed(event, WITNESSES[self.health.is_damaged(event.stamp)], self.measured)

    @abstractmethod
    def measured(self, line: Line) -> list[Action]:
        """Return what a line means that goes on from the one before."""

    @abstractmethod
    def time_of(self, content: Any) -> float | None:
        """Return the device's time in a line, its own unit; None = there is none."""

    def follows(self, before: Line, after: Line) -> bool:
        """Return whether the device's clock can have gone on so: a digit that is lost makes another number."""
        t0, t1 = self.time_of(before.content), self.time_of(after.content)
        if t0 is None or t1 is None or (late := self.clock.lateness(t1, after.stamp)) is None:
            return True
        usual = self.clock.lateness(t0, before.stamp) or 0.0
        most = max(LATE, usual + EARLY) if self.health.is_damaged(after.stamp) else math.inf
        return (t1 - t0) * self.clock.tick >= -1e-9 and min(usual, 0.0) - EARLY <= late <= most

    def timed(self, line: Line) -> tuple[float, float | None, list[Action]]:
        """Return the stamp of a line, s, the time since the one before by the device, s, and what is missing in between."""
        time = self.time_of(line.content)
        if time is None:
            return line.stamp, None, []
        reading = self.clock.read(time, line.stamp)
        return reading.stamp, reading.elapsed, [Lost(reading.missing)] if reading.missing else []

    def stop(self) -> list[Action]:
        return self._series.unconfirmed()
