"""UWB boards with binary frames: Nooploop LinkTrack (Tag_Frame0) and Ai-Thinker BU03. Sans-I/O.

LinkTrack, 921600 bit/s by default, 128 bytes, little-endian: ``55 01``, id, role, position, velocity, eight ranges (24-bit
signed, mm, 0 = none) at byte 22, ..., local time (4, ms) at byte 108, ..., sum of all bytes before. Other frames begin
``55 xx``. Source: the maker's nlink_unpack, as many programs carry it.

BU03, 115200 bit/s, 37 bytes: ``AA 25 01``, eight ranges (32-bit, mm, 0 = none), a byte, ``55``; some end after the ranges.
No sum is known: a frame is accepted when no range is beyond 65 m, which is 16 bits of each that must be zero, and its end
or the next head follows. Sources: bytes shown by users, users' programs.
"""

import struct
from dataclasses import dataclass
from typing import Any

from .clock import DeviceClock
from .events import Action, Lost, Note, RangeEpoch, RangeReading
from .framing import FixedPackets, PacketReader, to_next
from .session import Driver

ANCHORS = 8
LINKTRACK_BAUD = 921600
BU03_BAUD, BU03_SIZE, BU03_SHORT, BU03_HEAD, BU03_END = 115200, 37, 35, b"\xaa\x25\x01", 0x55
MUCH = 50
"""Frames in a row without a range after which it is reported."""


@dataclass(frozen=True, slots=True)
class TagFrame:
    """The ranges of one round."""

    stamp: float
    """s, arrival of its first byte."""
    time: int | None
    """ms, the tag's clock, wraps at 2**32; None = not sent."""
    readings: tuple[RangeReading, ...]


class LinkTrackProtocol(FixedPackets):
    """Bytes of the tag in, TagFrame and Corrupt out."""

    noise, head, size = "no tag frame", b"\x55\x01", 128

    def is_good(self, packet: bytearray) -> bool:
        """Return whether the sum is right."""
        return sum(packet[:-1]) & 0xFF == packet[-1]

    def decode(self, frame: bytes, stamp: float) -> TagFrame:
        """Decode a frame."""
        millimetres = [int.from_bytes(frame[22 + 3 * i : 25 + 3 * i], "little", signed=True) for i in range(ANCHORS)]
        (time,) = struct.unpack_from("<I", frame, 108)
        return TagFrame(stamp, time, _readings(millimetres))


class Bu03Protocol(PacketReader):
    """Bytes of the tag in, TagFrame and Corrupt out."""

    noise, smallest = "no range frame", BU03_SHORT

    def size_at(self, buffer: bytearray, at: int) -> int:
        """Return the size of the frame at `at`; 0 = wait for more; -n = none begins in the next n bytes."""
        if buffer[at] != BU03_HEAD[0]:
            return to_next(buffer, at, BU03_HEAD[0])
        frame = bytes(buffer[at : at + BU03_SIZE])
        if frame[:3] != BU03_HEAD[: len(frame)] or any(any(frame[i : i + 2]) for i in range(5, min(len(frame), BU03_SHORT), 4)):
            return -1
        if frame[BU03_SHORT:] == BU03_HEAD[:2]:
            return BU03_SHORT
        if len(frame) < BU03_SIZE:
            return 0
        return BU03_SIZE if frame[-1] == BU03_END else -1

    def decode(self, frame: bytes, stamp: float) -> TagFrame:
        """Decode a frame."""
        return TagFrame(stamp, None, _readings(struct.unpack_from("<8I", frame, 3)))


def _readings(millimetres: Any) -> tuple[RangeReading, ...]:
    return tuple(RangeReading(str(i), mm / 1000, 100) for i, mm in enumerate(millimetres) if mm > 0)


class TagFrameDriver(Driver):
    """A LinkTrack or BU03 tag. Nothing is ever sent.

    Parameters
    ----------
    protocol : bytes to TagFrame.
    title : for people. baud : bit/s.
    """

    def __init__(self, protocol: LinkTrackProtocol | Bu03Protocol, title: str, baud: int) -> None:
        super().__init__(protocol, title)
        self.baud = baud
        self._clock = DeviceClock(1e-3, 1 << 32)
        self._empty = 0

    def take(self, event: TagFrame) -> list[Action]:
        """Turn a frame into ranges."""
        self.ready = True
        actions: list[Action] = []
        stamp = event.stamp
        if event.time is not None:
            reading = self._clock.read(event.time, stamp)
            stamp = reading.stamp
            if reading.missing:
                actions.append(Lost(stamp, reading.missing))
        self._empty = 0 if event.readings else self._empty + 1
        if self._empty == MUCH:
            text = "uwb: frames come, but without ranges: set tag and anchors to two-way ranging, not to time differences"
            actions += self.say_once(Note("warning", "uwb-no-ranges", text))
        return [*actions, RangeEpoch(stamp, event.readings)] if event.readings else actions
