"""From bytes to text lines, each byte with the stamp of the piece it came in."""

import re
from dataclasses import dataclass

from .events import Corrupt, corrupt
from .framing import StampedBuffer


@dataclass(frozen=True, slots=True)
class Line:
    """A line without its end."""

    data: bytes
    end: bytes
    """What ended it."""
    marks: tuple[tuple[int, float], ...]
    """(offset, s): the arrival of the bytes from there on."""
    cut: bool = False
    """Its beginning was dropped because it was too long."""

    def stamp_at(self, offset: int) -> float:
        """Return the arrival of the byte at `offset`, s."""
        return next(when for at, when in reversed(self.marks) if at <= offset)


class LineReader:
    """Text lines.

    Parameters
    ----------
    most : bytes; of a longer line only the end is kept.
    keep : bytes of it that are kept at least.
    ends : what ends a line.
    """

    def __init__(self, most: int, *, keep: int = 0, ends: tuple[bytes, ...] = (b"\r", b"\n")) -> None:
        self._pending = StampedBuffer()
        self._most, self._step = most, most - keep
        self._ends = re.compile(b"|".join(re.escape(end) for end in ends))
        self._look_back = max(map(len, ends)) - 1
        self._cut = False

    @property
    def pending(self) -> int:
        """Number of bytes not yet decoded."""
        return len(self._pending.data)

    def feed(self, data: bytes, stamp: float) -> list[Line | Corrupt]:
        """Take bytes that arrived at `stamp` s; return the lines they complete, and Corrupt for what was too long."""
        lines: list[Line | Corrupt] = []
        if not data:
            return lines
        begin = max(0, self.pending - self._look_back)
        self._pending.append(data, stamp)
        at = 0
        for match in self._ends.finditer(bytes(self._pending.data), begin):
            cut = at
            while match.start() - cut > self._most:
                lines.append(self._too_long(cut))
                cut += self._step
            text = bytes(self._pending.data[cut : match.start()])
            lines.append(Line(text, match[0], self._pending.marks(cut, match.end()), self._cut))
            at, self._cut = match.end(), False
        while self.pending - at > self._most:
            lines.append(self._too_long(at))
            at += self._step
        self._pending.drop(at)
        return lines

    def _too_long(self, at: int) -> Corrupt:
        self._cut = True
        return corrupt(bytes(self._pending.data[at : at + self._step]), "line too long")
