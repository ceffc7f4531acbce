"""UWB boards with binary frames: Nooploop LinkTrack (Tag_Frame0) and Ai-Thinker BU03; `uwb_line` reads them. Sans-I/O.

LinkTrack, 921600 bit/s by default, 128 bytes, little-endian: ``55 01``, id, role, position, velocity, eight ranges (24-bit
signed, mm, 0 = none) at byte 22, ..., local time (4, ms) at byte 108, ..., sum of all bytes before. Other frames begin
``55 xx``. Source: the maker's nlink_unpack, as many programs carry it.

BU03, 115200 bit/s, 37 bytes: ``AA 25 01``, eight ranges (32-bit, mm, 0 = none), a byte, ``55``; some end after the ranges.
No sum is known: a frame is accepted when no range is beyond 65 m, which is 16 bits of each that must be zero, and its end
or the next head follows. Sources: bytes shown by users, users' programs.
"""

import struct
from typing import Any

from .events import RangeReading
from .framing import FixedPackets, PacketReader, to_next
from .text_lines import Line
from .uwb_line import Ranges

ANCHORS = 8
LINKTRACK_BAUD = 921600
BU03_BAUD, BU03_SIZE, BU03_SHORT, BU03_HEAD, BU03_END = 115200, 37, 35, b"\xaa\x25\x01", 0x55


class LinkTrackProtocol(FixedPackets):
    """Bytes of the tag in, Line and Corrupt out."""

    noise, head, size = "no tag frame", b"\x55\x01", 128

    def is_good(self, packet: bytearray) -> bool:
        return sum(packet[:-1]) & 0xFF == packet[-1]

    def decode(self, frame: bytes, stamp: float) -> Line:
        millimetres = [int.from_bytes(frame[22 + 3 * i : 25 + 3 * i], "little", signed=True) for i in range(ANCHORS)]
        (time,) = struct.unpack_from("<I", frame, 108)
        return Line(stamp, Ranges(_readings(millimetres), time))


class Bu03Protocol(PacketReader):
    """Bytes of the tag in, Line and Corrupt out."""

    noise, smallest = "no range frame", BU03_SHORT

    def size_at(self, buffer: bytearray, offset: int) -> int:
        if buffer[offset] != BU03_HEAD[0]:
            return to_next(buffer, offset, BU03_HEAD[0])
        frame = bytes(buffer[offset : offset + BU03_SIZE])
        if frame[:3] != BU03_HEAD[: len(frame)] or any(any(frame[i : i + 2]) for i in range(5, min(len(frame), BU03_SHORT), 4)):
            return -1
        if frame[BU03_SHORT:] == BU03_HEAD[:2]:
            return BU03_SHORT
        if len(frame) < BU03_SIZE:
            return 0
        return BU03_SIZE if frame[-1] == BU03_END else -1

    def decode(self, frame: bytes, stamp: float) -> Line:
        return Line(stamp, Ranges(_readings(struct.unpack_from("<8I", frame, 3))))


def _readings(millimetres: Any) -> tuple[RangeReading, ...]:
    return tuple(RangeReading(str(i), mm / 1000, 100) for i, mm in enumerate(millimetres) if mm > 0)
