"""DWM1001 with PANS R2: the binary interface (TLV) of the UART. Sans-I/O.

Type, length, value; little-endian. Every answer begins ``40 01 error``; blocks follow when the error is 0::

    -> 32 00           <- 40 01 00 | 5A 02 status            is there a new fix? (cleared by reading)
    -> 0C 00           <- 40 01 00 | 41 0D position | 49 L n  n x (address 2, distance 4 mm, quality 1, position 13)

There is no checksum: blocks are accepted only behind a header, with a known type, a length that fits it and values
that a module can send. The head of an answer inside a block means that the block broke off. The firmware closes a
request after 0.76 ms without a byte, so a request must be written in one write.
Sources: DWM1001 firmware API guide 2.3; the vendor's host code.
"""

import struct
from dataclasses import dataclass

from .events import Corrupt, RangeReading
from .framing import HeadedFrames

BAUD = 115200

LOC_GET, STATUS_GET = b"\x0c\x00", b"\x32\x00"
VER_GET, NODEID_GET, PANID_GET, CFG_GET, UPD_RATE_GET = b"\x15\x00", b"\x30\x00", b"\x2f\x00", b"\x08\x00", b"\x04\x00"
"""What a module is asked once; nothing is ever set."""


MAX_RANGE_MM = 200_000
"""mm; the radio reaches 60 m, anything above this is a damaged frame."""
MAX_PLACE_MM = 10_000_000
"""mm; largest plausible distance of an anchor from the origin."""

ERRORS = ("ok", "unknown command or broken request", "internal error", "invalid parameter", "busy", "not permitted")


@dataclass(frozen=True, slots=True)
class Answer:
    """Head of an answer."""

    error: int
    """Index into ERRORS."""


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances of the latest fix."""

    readings: tuple[RangeReading, ...]


@dataclass(frozen=True, slots=True)
class Status:
    """Status word."""

    bits: int

    @property
    def location_ready(self) -> bool:
        """A fix has come since the last status request."""
        return bool(self.bits & 1)

    @property
    def joined(self) -> bool:
        """The module is part of a network."""
        return bool(self.bits & JOINED)


JOINED = 2
"""Bit of a status."""


@dataclass(frozen=True, slots=True)
class UpdateRate:
    """Periods of the fixes."""

    normal: float
    stationary: float
    """s."""


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """Configuration word of cfg_get."""

    anchor: bool
    """Not a tag."""
    stationary_detection: bool
    low_power: bool
    uwb_mode: int
    """0 off, 1 passive, 2 ACTIVE."""


ACTIVE = 2


@dataclass(frozen=True, slots=True)
class Value:
    """Any other block that is a number."""

    name: str
    """"firmware", "configuration", "hardware", "pan_id" or "node_id"; of a position, which is not used, its quality."""
    value: int


Fact = Status | UpdateRate | NodeConfig | Value
"""What a module answers of itself."""
Event = Answer | Distances | Fact | Corrupt

_VALUES = {0x4D: (2, "pan_id"), 0x4E: (8, "node_id"), 0x50: (4, "firmware"), 0x51: (4, "configuration"), 0x52: (4, "hardware")}
_LENGTHS = {0x41: 13, 0x45: 4, 0x46: 2, 0x5A: 2, **{kind: size for kind, (size, _) in _VALUES.items()}}
_HEAD_AS_STATUS = 0x0140
"""``40 01``, the head of the next answer, read as a status: user data and an update pending in a node with no network."""
_POSITION = struct.Struct("<iiiB")
_TAG_ROW = struct.Struct("<HIBiiiB")
_ANCHOR_ROW = struct.Struct("<QIB")


def short_id(address: int) -> str:
    """Return the four hexadecimal digits by which PANS names a node: the low 16 bits of its address."""
    return f"{address & 0xFFFF:04X}"


def block_length(head: bytes) -> int:
    """Return the length in a block's head (type, length, count), 0 = not all here yet, -1 = no such block."""
    kind = head[0]
    if kind not in _LENGTHS and kind not in (0x48, 0x49):
        return -1
    if len(head) < 2:
        return 0
    length = head[1]
    if kind in _LENGTHS:
        return length if length == _LENGTHS[kind] else -1
    row, most = (13, 15) if kind == 0x48 else (20, 12)
    count, rest = divmod(length - 1, row)
    if rest or not 0 <= count <= most or (len(head) > 2 and head[2] != count):
        return -1
    return length if len(head) > 2 else 0


def decode(piece: bytes) -> Event:
    """Decode a head or a block of the right size."""
    kind, value = piece[0], piece[2:]
    if kind == 0x40:
        return Answer(piece[2])
    if kind == 0x41:
        x, y, z, quality = _POSITION.unpack(value)
        if quality > 100 or max(abs(x), abs(y), abs(z)) > MAX_PLACE_MM:
            return Corrupt("position or quality out of range")
        return Value("position quality", quality)
    if kind == 0x45:
        normal, stationary = struct.unpack("<HH", value)
        return UpdateRate(normal / 10, stationary / 10)
    if kind == 0x46:
        return _decode_config(value)
    if kind == 0x5A:
        bits = int.from_bytes(value, "little")
        if bits == _HEAD_AS_STATUS:
            return Corrupt("the head of an answer instead of a status")
        return Status(bits)  # a firmware may set bits that the guide does not name
    if kind in _VALUES:
        return Value(_VALUES[kind][1], int.from_bytes(value, "little"))
    return _decode_distances(piece)


def _decode_config(value: bytes) -> NodeConfig:
    low, high = value
    return NodeConfig(bool(high & 32), bool(high & 4), bool(low & 128), low & 3)


def _decode_distances(piece: bytes) -> Event:
    rows = piece[3:]
    if piece[0] == 0x49:
        table = list(_TAG_ROW.iter_unpack(rows))
        readings = [row[:3] for row in table]
        far = any(abs(millimetres) > MAX_PLACE_MM for row in table for millimetres in row[3:6])
    else:
        readings, far = list(_ANCHOR_ROW.iter_unpack(rows)), False
    if far or any(distance > MAX_RANGE_MM or quality > 100 for _, distance, quality in readings):
        return Corrupt("distance or quality out of range")
    if len({address for address, _, _ in readings}) < len(readings):
        return Corrupt("one anchor twice in a fix")
    return Distances(tuple([RangeReading(short_id(a), d / 1000, q) for a, d, q in readings]))


class TlvProtocol(HeadedFrames):
    """Bytes of the module in, blocks and Corrupt out. Holds at most one block (257 bytes)."""

    lead, head_size, noise = 0x40, 5, "no TLV answer"

    def __init__(self) -> None:
        super().__init__()
        self._inside = False

    def reset(self) -> None:
        """Forget what is half received: a request was given up, its answer must not run into the next one."""
        super().reset()
        self._inside = False

    def frame_size(self, head: bytes) -> int:
        """Recognise the head of an answer by the type and length of the block behind it."""
        return 3 if _may_begin(head) else -1

    def measure(self, offset: int) -> int:
        buffer = self.pending.data
        if buffer[offset] == self.lead:
            # Bytes that were taken already are accepted as a head only together with the block that follows.
            want = 5 if offset < self.taken else 3
            head = bytes(buffer[offset : offset + want])
            return (3 if len(head) == want else 0) if _may_begin(head) else self._noise(-1)
        if not self._inside or offset < self.taken:
            following = buffer.find(self.lead, offset + 1)
            return self._noise(offset - (following if following >= 0 else len(buffer)))
        length = block_length(bytes(buffer[offset : offset + 3]))
        if length < 0:
            return self._noise(-1)
        end = offset + 2 + length if length else len(buffer) + 1
        broken = self.head_inside(offset + 1, min(end, len(buffer)))
        if broken:
            return self._noise(offset - broken)
        return 0 if end > len(buffer) else end - offset

    def decode(self, frame: bytes, stamp: float) -> Event:
        event = decode(frame)
        self._inside = not isinstance(event, Corrupt) and not (isinstance(event, Answer) and event.error)
        return event

    def _noise(self, size: int) -> int:
        self._inside = False
        return size


def _may_begin(data: bytes) -> bool:
    """Return whether bytes can be ``40 01 error type length``, or the beginning of it."""
    if data[:2] != b"\x40\x01"[: len(data[:2])] or (len(data) > 2 and data[2] > 5):
        return False
    return len(data) < 4 or (data[2] == 0 and block_length(data[3:5]) >= 0)
