"""DWM1001 with PANS R2: the binary interface (TLV) of the UART. Sans-I/O.

Type, length, value; little-endian. Every answer begins ``40 01 error``; blocks follow when the error is 0::

    -> 32 00           <- 40 01 00 | 5A 02 status            is there a new fix? (cleared by reading)
    -> 0C 00           <- 40 01 00 | 41 0D position | 49 L n  n x (address 2, distance 4 mm, quality 1, position 13)

There is no checksum: blocks are believed only behind a header, with a known type, a length that fits it and values
that a module can send. The head of an answer inside a block means that the block broke off. The firmware closes a
request after 0.76 ms without a byte, so a request must be written in one write.
Sources: DWM1001 firmware API guide 2.3; the vendor's host code.
"""

from ..errors import ProtocolError
from .dwm1001_blocks import Answer, Event, block_length, decode
from .events import Corrupt, corrupt
from .stamped_buffer import StampedBuffer

BAUD = 115200

REQUESTS = {
    "pos_get": 0x02, "upd_rate_get": 0x04, "cfg_get": 0x08, "loc_get": 0x0C, "baddr_get": 0x10, "stnry_cfg_get": 0x12,
    "reset": 0x14, "ver_get": 0x15, "panid_get": 0x2F, "nodeid_get": 0x30, "status_get": 0x32, "int_cfg_get": 0x35,
}  # fmt: skip
LOC_GET, STATUS_GET = b"\x0c\x00", b"\x32\x00"


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


class TlvProtocol:
    """Bytes of the module in, blocks and Corrupt out. Holds at most one block (257 bytes)."""

    def __init__(self) -> None:
        self._buffer = StampedBuffer()
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
            self._buffer.append(data[start : start + 512], stamp)
            self._scan(events)
        return events

    def reset(self) -> None:
        """Forget what is half received: a request was given up, its answer must not run into the next one."""
        self._buffer.clear()
        self._inside, self._taken = False, 0

    def _scan(self, events: list[Event]) -> None:
        buffer, at, noise = self._buffer.data, 0, 0
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
            event = decode(piece, self._buffer.stamp_at(at))
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
        buffer = self._buffer.data
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
        length = block_length(bytes(buffer[at : at + 3]))
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
            events.append(corrupt(bytes(self._buffer.data[start:end]), "no TLV answer"))

    def _forget(self, count: int) -> None:
        self._buffer.drop(count)
        self._taken = max(0, self._taken - count)


def _may_begin(data: bytes) -> bool:
    """Tell whether bytes can be ``40 01 error type length``, or the beginning of it."""
    if data[:2] != b"\x40\x01"[: len(data[:2])] or (len(data) > 2 and data[2] > 5):
        return False
    return len(data) < 4 or (data[2] == 0 and block_length(data[3:5]) >= 0)
