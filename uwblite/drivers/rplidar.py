"""Slamtec RPLIDAR A1, A2, A3: express and standard scan. Sans-I/O.

115200 bit/s (A1, A2M8) or 256000 (A2M7, A2M12, A3); requests and replies are in `slamtec`. Express scan streams capsules
of 84 bytes, 32 readings each, little-endian::

    A | xor low, 5 | xor high | first angle (15 bits, degrees * 64), new-scan bit | 16 x 5 bytes:
    range and angle offset, range and angle offset (14 bits mm, 2 bits), low bits of both offsets (2 x 4 bits)

Angles run clockwise. The readings stand between the first angle of their capsule and that of the next, each less its
offset (1/8 degree). Standard scan streams nodes of 5 bytes (start bit and its inverse, quality; check bit, angle
(degrees * 64); range (mm * 4)), which have three check bits only: they are accepted sixteen at a time, in a row, with
rising angles. Sources: RPLIDAR interface protocol; the maker's SDK (order of the bits, angle formula, start-up).
"""

import math
import struct
from functools import reduce
from operator import xor

from . import slamtec
from .events import Action, Corrupt, Send, SetBaud
from .framing import PacketReader, to_next
from .session import Script
from .spinning import Fan, Samples

BAUDS = (115200, 256000)
STOP, STANDARD, INFO, HEALTH, PERIODS = (slamtec.request(command) for command in (0x25, 0x20, 0x50, 0x52, 0x59))
EXPRESS = slamtec.request(0x82, bytes(5))
PERIODS_REPLY, STANDARD_REPLY, EXPRESS_REPLY = 0x15, 0x81, 0x82
KINDS = {slamtec.INFO_REPLY: 20, slamtec.HEALTH_REPLY: 3, PERIODS_REPLY: 4, STANDARD_REPLY: 5, EXPRESS_REPLY: 84}
CAPSULE, CABINS = 84, 16
NODE, TOGETHER = 5, 16
TURN = 360 * 64
"""Angles are 1/64 degree."""
MOST_STEP = 60 * 64
"""A capsule or sixteen nodes span less than 60 degrees; more means that some were lost."""
SAME_SPAN = 0.3
"""Share by which the spans of two capsules may differ; twice the span means a lost capsule, and the motor is slower."""
MOST_MISFITS = 8
"""Capsules in a row after which the motor has another speed."""
MOST_NODE_STEP = 15 * 64
"""Between two nodes; 2000 readings a second at 15 turns are 2.7 degrees apart."""
FAN = Fan(720, 0.15, 12.0)
"""A1: 12 m; 4000 readings a second at 5.5 turns."""
USUAL_PERIODS = (476e-6, 238e-6)
"""s between readings, standard and express; the SDK's figures where the unit sends none."""


USUAL_SPEED = 660
"""PWM that the SDK sets: ten turns a second of an A2."""


def motor(speed: int) -> bytes:
    """Return the request that sets the motor's PWM, 0..1023; only adapters of A2 and A3 obey."""
    return slamtec.request(0xF0, struct.pack("<H", speed))


class RpLidarProtocol(PacketReader):
    """Bytes of the lidar in, Samples, Reply and Corrupt out.

    A capsule is decoded when the next one has come. What kind of stream comes is in the reply that announces it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.periods = USUAL_PERIODS
        """s between readings, standard and express."""
        self._stream = 0
        self._waiting: tuple[float, bytes] | None = None
        self._span, self._misfits = 0, 0

    def reset(self) -> None:
        super().reset()
        self._stream, self._waiting, self._span = 0, None, 0
        self.smallest = slamtec.DESCRIPTOR

    def feed(self, data: bytes, stamp: float) -> list[Samples | slamtec.Reply | Corrupt]:
        return [event for event in super().feed(data, stamp) if event is not None]

    def is_checked(self, lead: int) -> bool:
        return lead != slamtec.SYNC

    def size_at(self, buffer: bytearray, offset: int) -> int:
        if buffer[offset] == slamtec.SYNC and (size := slamtec.reply_size(buffer, offset, KINDS)) >= 0:
            return size
        if self._stream == EXPRESS_REPLY:
            return _capsule_size(buffer, offset)
        return _nodes_size(buffer, offset) if self._stream == STANDARD_REPLY else to_next(buffer, offset, slamtec.SYNC)

    def decode(self, frame: bytes, stamp: float) -> Samples | slamtec.Reply | None:
        """Decode a capsule, sixteen nodes or a reply; None where a capsule waits for the next one."""
        if len(frame) == CAPSULE:
            return self._capsule(frame, stamp)
        if len(frame) == NODE * TOGETHER:
            return self._nodes(frame, stamp)
        reply = slamtec.decode_reply(frame)
        if reply.kind == PERIODS_REPLY:
            standard, express = struct.unpack("<HH", reply.payload)
            self.periods = (standard * 1e-6, express * 1e-6) if standard and express else self.periods
        elif reply.kind in (STANDARD_REPLY, EXPRESS_REPLY):
            self._stream, self._waiting = reply.kind, None
            self.smallest = CAPSULE if reply.kind == EXPRESS_REPLY else NODE * TOGETHER
        return reply

    def _capsule(self, frame: bytes, stamp: float) -> Samples | None:
        """Decode the capsule that waited, between its first angle and that of this one."""
        before, self._waiting = self._waiting, (stamp, frame)
        (angle,) = struct.unpack_from("<H", frame, 2)
        if before is None or angle & 0x8000:
            return None
        (first,) = struct.unpack_from("<H", before[1], 2)
        first &= 0x7FFF
        span = (angle - first) % TURN
        if not self._follows(span):
            return None
        return _decode_capsule(before[1], before[0], first, span / (2 * CABINS), self.periods[1])

    def _follows(self, span: int) -> bool:
        """Return whether two capsules stand so far apart as two in a row do; otherwise some were lost between them."""
        fits = 0 < span <= MOST_STEP and abs(span - self._span) < SAME_SPAN * span
        self._misfits = 0 if fits else self._misfits + 1
        if fits or not self._span or self._misfits > MOST_MISFITS:
            self._span = span
        return fits

    def _nodes(self, frame: bytes, stamp: float) -> Samples:
        nodes = list(struct.iter_unpack("<BHH", frame))
        turned = tuple([(angle >> 1) / TURN % 1.0 for _, angle, _ in nodes])
        ranges = tuple([quarters / 4000 if quarters else math.nan for _, _, quarters in nodes])
        # The stamp is that of the first node, each node being sent when it was measured.
        return Samples(stamp + (TOGETHER - 1) * self.periods[0], None, self.periods[0], turned, turned, ranges)


def _capsule_size(buffer: bytearray, offset: int) -> int:
    capsule = buffer[offset : offset + CAPSULE]
    if capsule[0] >> 4 != 0xA or (len(capsule) > 1 and capsule[1] >> 4 != 0x5):
        return -1
    if len(capsule) < CAPSULE:
        return 0
    total = (capsule[0] & 0x0F) | (capsule[1] & 0x0F) << 4
    return CAPSULE if reduce(xor, capsule[2:]) == total else -1


def _nodes_size(buffer: bytearray, offset: int) -> int:
    """Sixteen nodes in a row with right check bits whose angles rise."""
    last = None
    for start in range(offset, min(offset + NODE * TOGETHER, len(buffer) - NODE + 1), NODE):
        flags, angle, _ = struct.unpack_from("<BHH", buffer, start)
        if (flags & 1) == (flags >> 1 & 1) or not angle & 1 or angle >> 1 >= TURN + 64:
            return -1
        if last is not None and ((angle >> 1) - (last >> 1)) % TURN > MOST_NODE_STEP:
            return -1
        last = angle
    return NODE * TOGETHER if offset + NODE * TOGETHER <= len(buffer) else 0


def _decode_capsule(capsule: bytes, stamp: float, first: int, step: float, period: float) -> Samples:
    """Decode 32 readings from `first`, 1/64 degree, that stand `step` apart."""
    turned, bearings, ranges = [], [], []
    for cabin, (one, two, offsets) in enumerate(struct.iter_unpack("<HHB", capsule[4:])):
        for k, word, low in ((0, one, offsets & 0x0F), (1, two, offsets >> 4)):
            angle = first + step * (2 * cabin + k)
            whole = angle // TURN
            turned.append(angle / TURN - whole)
            # An offset is in 1/8 degree, an angle in 1/64.
            bearings.append((angle - 8 * (low | (word & 3) << 4)) / TURN - whole)
            ranges.append((word >> 2) / 1000 if word > 3 else math.nan)
    return Samples(stamp, None, period, tuple(turned), tuple(bearings), tuple(ranges))


class RpLidarDriver(slamtec.SlamtecDriver):
    """An RPLIDAR; `express` = 4000 readings a second and more, where the firmware has it (from 1.17)."""

    title, dtr = "Slamtec RPLIDAR", False

    def __init__(self, express: bool = True, baud: int = BAUDS[0]) -> None:
        super().__init__(RpLidarProtocol(), FAN)
        self.baud, self._express = baud, express

    def start_up(self) -> Script[bool]:
        """Find the bit rate, stop what a dead host has left running, ask who is there, start motor and stream."""
        for baud in (self.baud, *(other for other in BAUDS if other != self.baud)):
            yield SetBaud(baud)
            yield from self.quiet(STOP)
            if (yield from self.greet(INFO, HEALTH)):
                self.baud = baud
                return (yield from self._stream())
        return False

    def _stream(self) -> Script[bool]:
        yield from self.ask(PERIODS, slamtec.answers(PERIODS_REPLY), 0.2)
        yield Send(motor(USUAL_SPEED))
        if self._express and (yield from self.begin_stream(EXPRESS, EXPRESS_REPLY)):
            return True
        return (yield from self.begin_stream(STANDARD, STANDARD_REPLY))

    def stop(self) -> list[Action]:
        return [Send(STOP), Send(motor(0)), *super().stop()]
