"""YDLIDAR X2 and X4. Sans-I/O.

X4: 128000 bit/s, ``A5 60`` starts the stream and ``A5 65`` stops it. X2: 115200 bit/s, streams unasked. Packets,
little-endian::

    AA 55 | type (bit 0: first of a turn) | number n | first angle (2) | last angle (2) | xor (2) | n x range (2)

Angles are degrees * 128 with bit 0 set, clockwise; ranges mm * 4, 0 = none. The xor is over all words but itself. The
lidar triangulates with a laser beside its receiver, so that a reading points elsewhere than the motor stands, by
``atan(21.8 (155.3 - r) / (155.3 r))``. Source: the maker's YDLidar-SDK, communication protocol (its example is a test).
"""

import math
import struct
from functools import reduce
from operator import xor

from .events import Action, Send
from .framing import PacketReader, to_next
from .session import Script
from .slamtec import DESCRIPTOR, SYNC, Reply, SlamtecDriver, decode_reply, reply_size, request
from .spinning import Fan, Samples, SpinningDriver

BAUD_X4, BAUD_X2 = 128000, 115200
START, STOP, INFO, HEALTH = request(0x60), request(0x65), request(0x90), request(0x91)
KINDS = {0x04: 20, 0x06: 3, 0x81: 5}
"""Replies: information, health, a stream begins."""
STREAM = 0x81
HEAD = b"\xaa\x55"
HEADER = 10
TURN = 360 * 64
"""Angles are 1/64 degree behind their check bit."""
RATE_X4, RATE_X2 = 5000.0, 3000.0
"""Readings per second."""
FAN_X4, FAN_X2 = Fan(720, 0.12, 10.0), Fan(480, 0.12, 8.0)
_OFFSET, _BASE = 21.8, 155.3
"""mm, of the formula above."""
_FAR = math.atan(-_OFFSET / _BASE) / (2.0 * math.pi)
"""Turns, what the formula gives for a far wall: the motor's zero is put there, so that far readings point where it stands."""


class YdLidarProtocol(PacketReader):
    """Bytes of the lidar in, Samples, Reply and Corrupt out."""

    smallest = DESCRIPTOR

    def __init__(self, rate: float) -> None:
        super().__init__()
        self._period = 1.0 / rate

    def is_checked(self, lead: int) -> bool:
        return lead != SYNC

    def size_at(self, buffer: bytearray, offset: int) -> int:
        if buffer[offset] == SYNC:
            return reply_size(buffer, offset, KINDS)
        if buffer[offset] != HEAD[0]:
            return to_next(buffer, offset, HEAD[0], SYNC)
        head = buffer[offset : offset + HEADER]
        if head[:2] != HEAD[: len(head)] or (len(head) > 3 and not head[3]):
            return -1
        if (len(head) > 4 and not head[4] & 1) or (len(head) > 6 and not head[6] & 1):
            return -1
        size = HEADER + 2 * head[3] if len(head) == HEADER else 0
        if not size or offset + size > len(buffer):
            return 0
        return size if reduce(xor, struct.unpack_from(f"<{size // 2}H", buffer, offset)) == 0 else -1

    def decode(self, frame: bytes, stamp: float) -> Samples | Reply:
        if frame[0] == SYNC:
            return decode_reply(frame)
        count = frame[3]
        first, last = (angle >> 1 for angle in struct.unpack_from("<HH", frame, 4))
        quarters = struct.unpack_from(f"<{count}H", frame, HEADER)
        step = (last - first) % TURN / max(count - 1, 1)
        turned = [(first + step * i) / TURN + _FAR for i in range(count)]
        bearings = [t - _FAR + _correction(q / 4) if q > 3 else t for t, q in zip(turned, quarters, strict=True)]
        whole = [math.floor(t) for t in turned]
        motor, sight = (tuple([a - w for a, w in zip(angles, whole, strict=True)]) for angles in (turned, bearings))
        return Samples(stamp, None, self._period, motor, sight, tuple([q / 4000 if q > 3 else math.nan for q in quarters]))


def _correction(mm: float) -> float:
    """Return by how much a reading points elsewhere than the motor stands, turns."""
    return math.atan(_OFFSET * (_BASE - mm) / (_BASE * mm)) / (2.0 * math.pi)


class YdLidarX2Driver(SpinningDriver):
    """A YDLIDAR X2, which streams as long as its motor turns. Nothing is ever sent."""

    baud, title, dtr = BAUD_X2, "YDLIDAR X2", True

    def __init__(self) -> None:
        super().__init__(YdLidarProtocol(RATE_X2), FAN_X2)


class YdLidarX4Driver(SlamtecDriver):
    """A YDLIDAR X4."""

    baud, title, dtr = BAUD_X4, "YDLIDAR X4", True

    def __init__(self) -> None:
        super().__init__(YdLidarProtocol(RATE_X4), FAN_X4)

    def start_up(self) -> Script[bool]:
        """Stop what a dead host has left running, ask who is there, start the stream."""
        yield from self.quiet(STOP)
        if not (yield from self.greet(INFO, HEALTH)):
            return False
        return (yield from self.begin_stream(START, STREAM))

    def stop(self) -> list[Action]:
        return [Send(STOP), *super().stop()]
