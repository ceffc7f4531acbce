"""From bytes to frames: the one place that waits for the rest of a frame, and that finds the next one after damage.

Bytes come in pieces of any size; each keeps the time at which its own piece arrived, so that noise before a frame does
not lend it its time. A binary protocol is a `FrameReader` that returns how long a frame is and what it contains; a protocol of
text lines uses a `LineReader`. What is no frame becomes `Corrupt`.
"""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from .events import Corrupt

CHUNK = 512
"""Bytes looked at together, so that noise of any length is kept at most in pieces of this size."""


class StampedBuffer:
    """Bytes in the order of their arrival, each with the stamp of its own piece."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._marks: list[tuple[int, float]] = []

    def append(self, piece: bytes, stamp: float) -> None:
        self._marks.append((len(self.data), stamp))
        self.data += piece

    def stamp_at(self, offset: int) -> float:
        """Return the arrival of the byte at `offset`, s."""
        return next(when for first, when in reversed(self._marks) if first <= offset)

    def marks(self, start: int, end: int) -> tuple[tuple[int, float], ...]:
        """Return (offset from `start`, arrival, s) of the pieces between two offsets."""
        if len(self._marks) == 1:
            return ((0, self._marks[0][1]),)
        inner = [(first - start, when) for first, when in self._marks if start < first < end]
        return ((0, self.stamp_at(start)), *inner)

    def drop(self, count: int) -> None:
        if count >= len(self.data):
            self.clear()
        elif count:
            self._marks = [(0, self.stamp_at(count))] + [(first - count, when) for first, when in self._marks if first > count]
            del self.data[:count]

    def clear(self) -> None:
        self.data.clear()
        self._marks.clear()


class FrameReader(ABC):
    """Binary frames; a protocol derives from this and defines `measure` and `decode`.

    A frame is decoded when it is complete. If it is damaged, the search for the next one goes on at its second byte, so a
    frame that broke off does not take the next one with it. At most one frame and CHUNK bytes are kept.
    """

    noise = "no frame"
    """What bytes between frames are called in the counters."""

    def __init__(self) -> None:
        self.pending = StampedBuffer()
        self.taken = 0
        """Bytes of `pending` that belong to a frame that was decoded."""
        self._told = 0

    @abstractmethod
    def decode(self, frame: bytes, stamp: float) -> Any:
        """Return the event that a frame of the right size holds, or Corrupt; `stamp` s, arrival of its first byte."""

    @abstractmethod
    def measure(self, offset: int) -> int:
        """Return the size of the frame at `offset`; 0 = it is not complete; -n = the first n bytes are noise."""

    def overlap(self, frame: bytes) -> int:
        """Return how many of the last bytes may be the head of the next frame, if this one had lost as many."""
        return 0

    def feed(self, data: bytes, stamp: float) -> list[Any]:
        """Take bytes that arrived at `stamp` s and return the events they complete, in the order of the bytes."""
        events: list[Any] = []
        for start in range(0, len(data), CHUNK):
            self.pending.append(data[start : start + CHUNK], stamp)
            self._scan(events)
        return events

    def reset(self) -> None:
        """Discard a frame that is only half received."""
        self.pending.clear()
        self.taken = self._told = 0

    def _scan(self, events: list[Any]) -> None:
        buffer, offset, noise = self.pending.data, 0, 0
        while offset < len(buffer) and (size := self.measure(offset)):
            if size < 0:
                offset -= size
                continue
            self._report(noise, offset, events)
            frame = bytes(buffer[offset : offset + size])
            event = self.decode(frame, self.pending.stamp_at(offset))
            events.append(event)
            self._told = offset + size
            if isinstance(event, Corrupt):
                offset = self.taken = offset + 1
            else:
                offset = self.taken = offset + size
                offset -= self.overlap(frame)
            noise = offset
        self._report(noise, offset, events)
        self.pending.drop(offset)
        self.taken, self._told = max(0, self.taken - offset), max(0, self._told - offset)

    def _report(self, start: int, end: int, events: list[Any]) -> None:
        start = max(start, self._told)
        if end > start:
            events.append(Corrupt(self.noise))


class HeadedFrames(FrameReader):
    """Frames whose head tells their size; a protocol derives from this and defines `frame_size` and `decode`.

    A head cannot occur inside a frame by chance: one found there means that the frame broke off.
    """

    lead = 0
    """First byte of every frame."""
    head_size = 2
    """Bytes by which a frame is known: as many as `frame_size` is shown."""

    @abstractmethod
    def frame_size(self, head: bytes) -> int:
        """Return the size of the frame that begins so; 0 = more bytes are needed to say, -1 = none begins so."""

    def measure(self, offset: int) -> int:
        buffer = self.pending.data
        size = self.frame_size(bytes(buffer[offset : offset + self.head_size]))
        if size < 0:
            following = buffer.find(self.lead, offset + 1)
            return offset - (following if following >= 0 else len(buffer))
        end = offset + size if size else len(buffer) + 1
        broken = self.head_inside(offset + 1, min(end, len(buffer)))
        if broken:
            return offset - broken
        return size if end <= len(buffer) else 0

    def head_inside(self, start: int, end: int) -> int:
        """Return where a whole head stands between two offsets, 0 = nowhere."""
        buffer, offset = self.pending.data, start
        while 0 <= (offset := buffer.find(self.lead, offset, end)) <= end - self.head_size:
            if self.frame_size(bytes(buffer[offset : offset + self.head_size])) >= 0:
                return offset
            offset += 1
        return 0

    def overlap(self, frame: bytes) -> int:
        sizes = range(min(self.head_size, len(frame)) - 1, 0, -1)
        return next((k for k in sizes if self.frame_size(frame[-k:]) >= 0), 0)


class PacketReader(FrameReader):
    """Frames that prove themselves by a check; a protocol derives from this and defines `size_at` and `decode`.

    A head in noise may claim more bytes than ever come. Where a whole frame stands behind a head that still waits, or inside
    a frame that has no check, that head was noise.
    """

    smallest = 1
    """Bytes of the smallest frame, before which nobody looks for one."""

    @abstractmethod
    def size_at(self, buffer: bytearray, offset: int) -> int:
        """Return the size of the good frame at `offset`; 0 = wait for more; -n = none begins in the next n bytes."""

    def is_checked(self, lead: int) -> bool:
        """Return whether frames that begin with this byte have a check."""
        return True

    def measure(self, offset: int) -> int:
        buffer = self.pending.data
        size, behind = self.size_at(buffer, offset), offset + 1
        end = len(buffer) if size == 0 else offset + size if size > 0 and not self.is_checked(buffer[offset]) else offset
        while behind + self.smallest <= end:
            inner = self.size_at(buffer, behind)
            if inner > 0 and behind + inner <= end:
                return offset - behind
            behind += max(1, -inner)
        return size


class FixedPackets(PacketReader):
    """Packets of one size behind one head; a protocol derives from this and defines `is_good` and `decode`."""

    head: bytes
    """First bytes of every packet."""
    size: int
    """Bytes of a packet."""

    def __init__(self) -> None:
        super().__init__()
        self.smallest = self.size

    @abstractmethod
    def is_good(self, packet: bytearray) -> bool:
        """Return whether a whole packet with the right head has a right check, and holds what the device can send."""

    def size_at(self, buffer: bytearray, offset: int) -> int:
        if buffer[offset] != self.head[0]:
            return to_next(buffer, offset, self.head[0])
        packet = buffer[offset : offset + self.size]
        if packet[: len(self.head)] != self.head[: len(packet)]:
            return -1
        if len(packet) < self.size:
            return 0
        return self.size if self.is_good(packet) else -1


def to_next(buffer: bytearray, place: int, *firsts: int) -> int:
    """Return -n, the distance from `place` to the next byte after it that can begin a frame, for `size_at`."""
    places = [offset for first in firsts if (offset := buffer.find(first, place + 1)) >= 0]
    return place - min(places, default=len(buffer))


@dataclass(frozen=True, slots=True)
class RawLine:
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
        return next(when for first, when in reversed(self.marks) if first <= offset)


class LineReader:
    """Text lines; of one longer than `most` bytes the end is kept, at least `keep` of them."""

    def __init__(self, most: int, *, keep: int = 0, ends: tuple[bytes, ...] = (b"\r", b"\n")) -> None:
        self._pending = StampedBuffer()
        self._most, self._step = most, most - keep
        self._ends = re.compile(b"|".join(re.escape(end) for end in ends))
        self._look_back = max(map(len, ends)) - 1
        self._cut = False

    @property
    def pending(self) -> int:
        return len(self._pending.data)

    def feed(self, data: bytes, stamp: float) -> list[RawLine | Corrupt]:
        """Take bytes that arrived at `stamp` s; return the lines they complete, and Corrupt for what was too long."""
        lines: list[RawLine | Corrupt] = []
        if not data:
            return lines
        begin = max(0, self.pending - self._look_back)
        self._pending.append(data, stamp)
        offset = 0
        for match in self._ends.finditer(bytes(self._pending.data), begin):
            cut = self._shortened(offset, match.start(), lines)
            text = bytes(self._pending.data[cut : match.start()])
            lines.append(RawLine(text, match[0], self._pending.marks(cut, match.end()), self._cut))
            offset, self._cut = match.end(), False
        self._pending.drop(self._shortened(offset, self.pending, lines))
        return lines

    def _shortened(self, begin: int, end: int, lines: list[RawLine | Corrupt]) -> int:
        """Return where the part that is kept of a line begins, and note each step of one that is too long."""
        while end - begin > self._most:
            lines.append(Corrupt("line too long"))
            begin, self._cut = begin + self._step, True
        return begin
