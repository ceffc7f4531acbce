"""DWM1001 with PANS R2: the binary interface (TLV) of the UART. Sans-I/O.

Type, length, value; little-endian. Every answer begins ``40 01 error``; blocks follow when the error is 0::

    -> 32 00           <- 40 01 00 | 5A 02 status            is there a new fix? (cleared by reading)
    -> 0C 00           <- 40 01 00 | 41 0D position | 49 L n  n x (address 2, distance 4 mm, quality 1, position 13)

There is no checksum: blocks are accepted only behind a header, with a known type, a length that fits it and values
that a module can send. The head of an answer inside a block means that the block broke off. The firmware closes a
request after 0.76 ms without a byte, so a request must be written in one write.
Sources: DWM1001 firmware API guide 2.3; the vendor's host code.
"""

from .dwm1001_blocks import Answer, Event, block_length, decode
from .events import Corrupt
from .framing import HeadedFrames

BAUD = 115200

LOC_GET, STATUS_GET = b"\x0c\x00", b"\x32\x00"
QUERIES = {"ver_get": b"\x15\x00", "nodeid_get": b"\x30\x00", "panid_get": b"\x2f\x00", "cfg_get": b"\x08\x00",
           "upd_rate_get": b"\x04\x00"}  # fmt: skip
"""What a module is asked once; nothing is ever set."""


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

    def measure(self, at: int) -> int:
        """Return the size of the head or block at `at`; 0 = wait for more bytes; -n = the first n bytes are noise."""
        buffer = self.pending.data
        if buffer[at] == self.lead:
            # Bytes that were taken already are accepted as a head only together with the block that follows.
            want = 5 if at < self.taken else 3
            head = bytes(buffer[at : at + want])
            return (3 if len(head) == want else 0) if _may_begin(head) else self._noise(-1)
        if not self._inside or at < self.taken:
            following = buffer.find(self.lead, at + 1)
            return self._noise(at - (following if following >= 0 else len(buffer)))
        length = block_length(bytes(buffer[at : at + 3]))
        if length < 0:
            return self._noise(-1)
        end = at + 2 + length if length else len(buffer) + 1
        broken = self.head_inside(at + 1, min(end, len(buffer)))
        if broken:
            return self._noise(at - broken)
        return 0 if end > len(buffer) else end - at

    def decode(self, frame: bytes, stamp: float) -> Event:
        """Decode a head or a block."""
        event = decode(frame, stamp)
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
