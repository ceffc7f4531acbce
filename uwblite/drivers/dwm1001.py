"""DWM1001 with PANS R2: the binary interface (TLV) of the UART. Sans-I/O.

Type, length, value; little-endian. Every answer begins ``40 01 error``; blocks follow when the error is 0::

    -> 32 00           <- 40 01 00 | 5A 02 status            is there a new fix? (cleared by reading)
    -> 0C 00           <- 40 01 00 | 41 0D position | 49 L n  n x (address 2, distance 4 mm, quality 1, position 13)

There is no checksum: blocks are believed only behind a header, with a known type, a length that fits it and values
that a module can send. The head of an answer inside a block means that the block broke off. The firmware closes a
request after 0.76 ms without a byte, so a request must be written in one write.
Sources: DWM1001 firmware API guide 2.3; the vendor's host code.
"""

import struct
from dataclasses import dataclass

from ..errors import ProtocolError
from .events import Corrupt, RangeReading, corrupt

BAUD = 115200
MAX_RANGE_MM = 200_000
"""mm; the radio reaches 60 m, anything above this is a damaged frame."""
MAX_PLACE_MM = 10_000_000
"""mm; nobody sets up anchors further than this from the origin."""

ERRORS = {
    0: "ok", 1: "unknown command or broken request", 2: "internal error", 3: "invalid parameter", 4: "busy",
    5: "not permitted",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Answer:
    """Head of an answer."""

    stamp: float
    """s, arrival of its first byte."""
    error: int
    """Key of ERRORS."""


@dataclass(frozen=True, slots=True)
class Position:
    """The module's own estimate of a position; uwblite does not use it."""

    stamp: float
    x: float
    y: float
    z: float
    """m."""
    quality: int
    """0..100."""


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances of the latest fix."""

    stamp: float
    """s, arrival of the block's first byte."""
    readings: tuple[RangeReading, ...]
    anchors: tuple[Position, ...] = ()
    """Configured positions of the anchors, in the order of `readings`; empty when an anchor answers."""


@dataclass(frozen=True, slots=True)
class Status:
    """Status word."""

    stamp: float
    bits: int

    @property
    def location_ready(self) -> bool:
        """A fix has come since the last status request."""
        return bool(self.bits & 1)

    @property
    def joined(self) -> bool:
        """The module is part of a network."""
        return bool(self.bits & 2)


@dataclass(frozen=True, slots=True)
class UpdateRate:
    """Periods of the fixes."""

    stamp: float
    normal: float
    stationary: float
    """s."""


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """Configuration word of cfg_get."""

    stamp: float
    anchor: bool
    initiator: bool
    bridge: bool
    stationary_detection: bool
    measurement_mode: int
    """0 = two-way ranging."""
    low_power: bool
    location_engine: bool
    encryption: bool
    leds: bool
    bluetooth: bool
    firmware_update: bool
    uwb_mode: int
    """0 off, 1 passive, 2 active."""


@dataclass(frozen=True, slots=True)
class Value:
    """Any other block that is a number."""

    stamp: float
    name: str
    """"firmware", "configuration", "hardware", "pan_id", "node_id", "sensitivity", "interrupts", "ble_address"."""
    value: int


@dataclass(frozen=True, slots=True)
class Block:
    """A block of a known type that is passed on undecoded (anchor list)."""

    stamp: float
    kind: int
    data: bytes


Event = Answer | Position | Distances | Status | UpdateRate | NodeConfig | Value | Block | Corrupt

REQUESTS = {
    "pos_get": 0x02, "upd_rate_get": 0x04, "cfg_get": 0x08, "loc_get": 0x0C, "baddr_get": 0x10, "stnry_cfg_get": 0x12,
    "reset": 0x14, "ver_get": 0x15, "panid_get": 0x2F, "nodeid_get": 0x30, "status_get": 0x32, "int_cfg_get": 0x35,
}  # fmt: skip
LOC_GET, STATUS_GET = b"\x0c\x00", b"\x32\x00"
_VALUES = {
    0x47: (2, "interrupts"), 0x4A: (1, "sensitivity"), 0x4D: (2, "pan_id"), 0x4E: (8, "node_id"),
    0x50: (4, "firmware"), 0x51: (4, "configuration"), 0x52: (4, "hardware"), 0x5F: (6, "ble_address"),
}  # fmt: skip
_LENGTHS = {0x41: 13, 0x45: 4, 0x46: 2, 0x5A: 2, **{kind: size for kind, (size, _) in _VALUES.items()}}
_STATUS_MASK = 0x01EF
_HEAD_AS_STATUS = 0x0140
"""``40 01``, the head of the next answer, read as a status: user data and an update pending in a node with no network."""
_POSITION = struct.Struct("<iiiB")
_TAG_ROW = struct.Struct("<HIBiiiB")
_ANCHOR_ROW = struct.Struct("<QIB")


def request(name: str, value: bytes = b"") -> bytes:
    """Build a request that reads something, or `reset`.

    Parameters
    ----------
    name : key of REQUESTS.
    value : payload, for requests that take one.

    Returns
    -------
    bytes : to be written in one write.

    Raises
    ------
    ProtocolError : no such request, or a payload too long.
    """
    if name not in REQUESTS:
        raise ProtocolError(f"no TLV request {name!r}; known are {', '.join(sorted(REQUESTS))}")
    if len(value) > 255:
        raise ProtocolError(f"TLV request {name}: {len(value)} bytes of payload, at most 255 are possible")
    return bytes((REQUESTS[name], len(value))) + value


def short_id(address: int) -> str:
    """Return the four hexadecimal digits by which PANS names a node: the low 16 bits of its address."""
    return f"{address & 0xFFFF:04X}"


class TlvProtocol:
    """Bytes of the module in, blocks and Corrupt out. Holds at most one block (257 bytes)."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._marks: list[tuple[int, float]] = []
        self._inside = False
        self._taken = 0

    def feed(self, data: bytes, stamp: float) -> list[Event]:
        """Take bytes that arrived at `stamp` s and return the events they complete.

        Parameters
        ----------
        data : bytes from the port.
        stamp : arrival, s, clock of the host.

        Returns
        -------
        list of events, in the order of the bytes.
        """
        events: list[Event] = []
        for start in range(0, len(data), 512):
            self._marks.append((len(self._buffer), stamp))
            self._buffer += data[start : start + 512]
            self._scan(events)
        return events

    def reset(self) -> None:
        """Forget what is half received: a request was given up, its answer must not run into the next one."""
        self._buffer.clear()
        self._marks.clear()
        self._inside, self._taken = False, 0

    def _scan(self, events: list[Event]) -> None:
        buffer, at, noise = self._buffer, 0, 0
        while at < len(buffer):
            size = self._size(at)
            if size == 0:
                break
            if size < 0:
                self._inside = False
                at -= size
                continue
            self._report(noise, at, events)
            piece = bytes(buffer[at : at + size])
            event = _decode(piece, self._stamp_at(at))
            if isinstance(event, Corrupt):
                events.append(event)
                self._inside = False
                at += 1
                self._taken = at
            else:
                events.append(event)
                self._inside = not (isinstance(event, Answer) and event.error)
                at += size
                self._taken = at
                if size > 3:
                    # The last bytes may be the head of the next answer, if this block had lost as many.
                    at -= next((k for k in (4, 3, 2, 1) if _may_begin(piece[-k:])), 0)
            noise = at
        self._report(noise, at, events)
        self._forget(at)

    def _size(self, at: int) -> int:
        """Return the size of the head or block at `at`; 0 = wait for more bytes; -n = the first n bytes are noise."""
        buffer = self._buffer
        if buffer[at] == 0x40:
            # Bytes that were taken already are believed to be a head only together with the block that follows.
            want = 5 if at < self._taken else 3
            head = bytes(buffer[at : at + want])
            if not _may_begin(head):
                return -1
            return 3 if len(head) == want else 0
        if not self._inside or at < self._taken:
            following = buffer.find(0x40, at + 1)
            return at - (following if following >= 0 else len(buffer))
        length = _block_length(bytes(buffer[at : at + 3]))
        if length < 0:
            return -1
        end = at + 2 + length if length else len(buffer) + 1
        inner = at + 1
        while (inner := buffer.find(b"\x40\x01", inner, min(end, len(buffer)))) >= 0:
            if inner + 5 <= min(end, len(buffer)) and _may_begin(bytes(buffer[inner : inner + 5])):
                return at - inner
            inner += 1
        return 0 if end > len(buffer) else end - at

    def _report(self, start: int, end: int, events: list[Event]) -> None:
        start = max(start, self._taken)
        if end > start:
            events.append(corrupt(bytes(self._buffer[start:end]), "no TLV answer"))

    def _forget(self, count: int) -> None:
        if count:
            rest = len(self._buffer) - count
            self._marks = [(0, self._stamp_at(count))] + [(i - count, t) for i, t in self._marks if i > count] if rest else []
            del self._buffer[:count]
            self._taken = max(0, self._taken - count)

    def _stamp_at(self, offset: int) -> float:
        return next(when for at, when in reversed(self._marks) if at <= offset)


def _may_begin(data: bytes) -> bool:
    """Tell whether bytes can be ``40 01 error type length``, or the beginning of it."""
    if data[:2] != b"\x40\x01"[: len(data[:2])] or (len(data) > 2 and data[2] > 5):
        return False
    return len(data) < 4 or (data[2] == 0 and _block_length(data[3:5]) >= 0)


def _block_length(head: bytes) -> int:
    """Return the length in a block's head (type, length, count), 0 = not all here yet, -1 = no such block."""
    kind = head[0]
    if kind not in _LENGTHS and kind not in (0x48, 0x49, 0x56):
        return -1
    if len(head) < 2:
        return 0
    length = head[1]
    if kind in _LENGTHS:
        return length if length == _LENGTHS[kind] else -1
    if kind == 0x56:
        return length if length else -1
    row, most = (13, 15) if kind == 0x48 else (20, 12)
    count, rest = divmod(length - 1, row)
    if rest or not 0 <= count <= most or (len(head) > 2 and head[2] != count):
        return -1
    return length if len(head) > 2 else 0


def _decode(piece: bytes, stamp: float) -> Event:
    """Decode a head or a block of the right size."""
    kind, value = piece[0], piece[2:]
    if kind == 0x40:
        return Answer(stamp, piece[2])
    if kind == 0x41:
        x, y, z, quality = _POSITION.unpack(value)
        if quality > 100 or max(abs(x), abs(y), abs(z)) > MAX_PLACE_MM:
            return corrupt(piece, "position or quality out of range")
        return Position(stamp, x / 1000, y / 1000, z / 1000, quality)
    if kind == 0x45:
        normal, stationary = struct.unpack("<HH", value)
        return UpdateRate(stamp, normal / 10, stationary / 10)
    if kind == 0x46:
        return _decode_config(value, stamp)
    if kind == 0x5A:
        bits = int.from_bytes(value, "little")
        damaged = bits & ~_STATUS_MASK or bits == _HEAD_AS_STATUS
        return corrupt(piece, "status that no module has") if damaged else Status(stamp, bits)
    if kind in _VALUES:
        return Value(stamp, _VALUES[kind][1], int.from_bytes(value, "little"))
    if kind == 0x56:
        return Block(stamp, kind, value)
    return _decode_distances(piece, stamp)


def _decode_config(value: bytes, stamp: float) -> NodeConfig:
    low, high = value
    return NodeConfig(
        stamp, bool(high & 32), bool(high & 16), bool(high & 8), bool(high & 4), high & 3, bool(low & 128),
        bool(low & 64), bool(low & 32), bool(low & 16), bool(low & 8), bool(low & 4), low & 3,
    )  # fmt: skip


def _decode_distances(piece: bytes, stamp: float) -> Event:
    rows = piece[3:]
    readings, anchors = [], []
    if piece[0] == 0x49:
        for address, distance, quality, x, y, z, position_quality in _TAG_ROW.iter_unpack(rows):
            readings.append((address, distance, quality))
            anchors.append(Position(stamp, x / 1000, y / 1000, z / 1000, position_quality))
    else:
        readings = list(_ANCHOR_ROW.iter_unpack(rows))
    far = any(max(abs(a.x), abs(a.y), abs(a.z)) * 1000 > MAX_PLACE_MM for a in anchors)
    if far or any(distance > MAX_RANGE_MM or quality > 100 for _, distance, quality in readings):
        return corrupt(piece, "distance or quality out of range")
    if len({address for address, _, _ in readings}) < len(readings):
        return corrupt(piece, "one anchor twice in a fix")
    return Distances(stamp, tuple([RangeReading(short_id(a), d / 1000, q) for a, d, q in readings]), tuple(anchors))
