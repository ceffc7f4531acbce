"""Kobuki base (TurtleBot 2): feedback packets in, wheel odometry out. Read-only, sans-I/O.

The base streams 50 packets a second unasked, 115200 bit/s::

    AA 55 | length | sub-payloads (id, length, data) ... | xor of the length byte and the payload

Little-endian. Used here: basic sensor data (id 01) and inertia (id 04). A packet whose sum is wrong is searched for the
next header from the byte after its own: a new header inside an old payload is what bad cables produce.
Sources: vendor protocol description and kobuki_core 1.4.0. No complete public capture of a packet was found.
"""

import math
import struct
from dataclasses import dataclass
from functools import reduce
from operator import xor

from .clock import ClockMap, Unwrapper
from .events import Corrupt, OdometryPose, corrupt
from .stamped_buffer import StampedBuffer

BAUD = 115200
PERIOD = 0.020
"""s between packets."""
TICK = 0.0024369168713639 * 0.035
"""m of wheel travel per encoder tick: rad per tick times wheel radius (kobuki_core)."""
WHEEL_BASE = 0.230
"""m between the wheels."""
ENCODER_MODULUS = 1 << 16
STAMP_MODULUS = 1 << 16
MAX_SPEED = 0.75
"""m/s; a little above what the base can do."""
MAX_BLIND = ENCODER_MODULUS / 2 * TICK / MAX_SPEED
"""s after which an encoder may have turned by half its range unseen, so that its difference is ambiguous."""

HEADER = b"\xaa\x55"
SIGNATURE = b"\xaa\x55\x00\x01\x0f"
"""Head of every packet; the zero stands for any length."""
BASIC, INERTIA = 0x01, 0x04
LENGTHS = {0x01: 15, 0x03: 3, 0x04: 7, 0x05: 6, 0x06: 2, 0x0A: 4, 0x0B: 4, 0x10: 16, 0x13: 12, 0x15: 21}
"""Data bytes of the sub-payloads; the raw gyro (0x0D) has 2 + 2 n."""
GYRO = 0x0D


@dataclass(frozen=True, slots=True)
class Feedback:
    """One packet, of which odometry needs these fields."""

    stamp: float
    """s, arrival of its first byte."""
    time: int
    """ms, device clock, wraps at 2**16."""
    left: int
    right: int
    """Encoder ticks, wrap at 2**16."""
    heading: float | None
    """rad, of the gyro, counter-clockwise, wraps at pi; None where the packet has no inertia data."""
    turn_rate: float
    """rad/s."""
    bumper: int
    """Bits: 1 right, 2 centre, 4 left."""
    wheel_drop: int
    """Bits: 1 right, 2 left."""
    battery: float
    """V."""


Event = Feedback | Corrupt


class KobukiProtocol:
    """Bytes of the base in, Feedback and Corrupt out. Holds at most one packet.

    Every packet begins ``AA 55 length 01 0F``. The same five bytes inside a packet mean that it broke off and another
    one begins there.
    """

    def __init__(self) -> None:
        self._buffer = StampedBuffer()
        self._taken = 0

    def feed(self, data: bytes, stamp: float) -> list[Event]:
        """Take bytes that arrived at `stamp` s and return the events they complete.

        Parameters
        ----------
        data : bytes from the port.
        stamp : arrival, s, clock of the host.

        Returns
        -------
        list of Feedback or Corrupt.
        """
        events: list[Event] = []
        for start in range(0, len(data), 512):
            self._buffer.append(data[start : start + 512], stamp)
            self._scan(events)
        return events

    def _scan(self, events: list[Event]) -> None:
        buffer, at, noise = self._buffer.data, 0, 0
        while at < len(buffer):
            size = _packet_size(buffer, at)
            if size == 0:
                break
            if size < 0:
                at += -size
                continue
            self._report(noise, at, events)
            packet = bytes(buffer[at : at + size])
            events.append(_decode(packet, self._buffer.stamp_at(at)))
            at += size
            # The last bytes may be the head of the next packet if this one had lost as many: look at them again.
            again = next((k for k in (4, 3, 2, 1) if _may_begin(packet[-k:])), 0)
            self._taken = at
            at -= again
            noise = at
        self._report(noise, at, events)
        self._forget(at)

    def _report(self, start: int, end: int, events: list[Event]) -> None:
        start = max(start, self._taken)
        if end > start:
            events.append(corrupt(bytes(self._buffer.data[start:end]), "no packet"))

    def _forget(self, count: int) -> None:
        self._buffer.drop(count)
        self._taken = max(0, self._taken - count)


def _may_begin(data: bytes) -> bool:
    """Tell whether these bytes can be the head ``AA 55 length 01 0F`` of a packet, or the beginning of it."""
    return all((i == 2 and byte >= 17) or byte == SIGNATURE[i] for i, byte in enumerate(data))


def _packet_size(buffer: bytearray, at: int) -> int:
    """Return the size of the packet at `at`; 0 = wait for more bytes; -n = the first n bytes are noise."""
    if not _may_begin(bytes(buffer[at : at + 5])):
        following = buffer.find(0xAA, at + 1)
        return at - (following if following >= 0 else len(buffer))
    end = at + 4 + buffer[at + 2] if len(buffer) > at + 2 else len(buffer) + 1
    inner = at + 1
    while (inner := buffer.find(HEADER, inner, min(end, len(buffer)))) >= 0:
        if inner + 5 <= min(end, len(buffer)) and _may_begin(bytes(buffer[inner : inner + 5])):
            return at - inner
        inner += 1
    if end > len(buffer):
        return 0
    packet = buffer[at:end]
    if reduce(xor, packet[2:], 0) or not _well_formed(packet[3:-1]):
        return -2
    return end - at


def _well_formed(payload: bytes | bytearray) -> bool:
    """Tell whether the sub-payloads fill the payload exactly and those that are known have their length."""
    at = 0
    while at + 2 <= len(payload):
        kind, size = payload[at], payload[at + 1]
        if size != LENGTHS.get(kind, size) or (kind == GYRO and (size < 2 or size % 2)):
            return False
        at += 2 + size
    return at == len(payload)


def _decode(packet: bytes, stamp: float) -> Feedback:
    """Decode a packet whose sum is right."""
    subs: dict[int, bytes] = {}
    at = 3
    while at < len(packet) - 1:
        subs[packet[at]] = packet[at + 2 : at + 2 + packet[at + 1]]
        at += 2 + packet[at + 1]
    basic = subs[BASIC]
    time, bumper, drop, _cliff, left, right = struct.unpack_from("<HBBBHH", basic)
    heading, rate = None, 0.0
    if INERTIA in subs:
        angle, turn = struct.unpack_from("<hh", subs[INERTIA])
        heading, rate = math.radians(angle / 100), math.radians(turn / 100)
    return Feedback(stamp, time, left, right, heading, rate, bumper, drop, basic[13] / 10)


class KobukiOdometer:
    """Integrate Feedback to a pose in the odom frame: travel from the encoders, heading from the gyro.

    Between two packets the base moves straight along the mean of both headings (Borenstein's chord rule).

    Parameters
    ----------
    start : x, y, theta at the first packet; m, m, rad.
    """

    def __init__(self, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self._x, self._y, self._theta = start
        self._last: Feedback | None = None
        self._last_time = 0.0
        self._clock, self._map = Unwrapper(STAMP_MODULUS, 1e-3), ClockMap()

    def update(self, feedback: Feedback) -> tuple[OdometryPose | None, int, str]:
        """Take one packet.

        Parameters
        ----------
        feedback : from KobukiProtocol.

        Returns
        -------
        pose : with the device's time mapped to the host's; None for a packet sent twice.
        missing : packets lost before this one.
        remark : what a person should know, or "".
        """
        time, reset = self._clock.unwrap(feedback.time, feedback.stamp)
        last, self._last = self._last, feedback
        elapsed, self._last_time = time - self._last_time, time
        remark, missing, speed = "", 0, 0.0
        if reset:
            self._map = ClockMap()
        if last is not None and not reset:
            if elapsed <= 0:
                return None, 0, ""
            missing = max(0, round(elapsed / PERIOD) - 1)
        self._map.add(time, feedback.stamp)
        if last is not None and (reset or elapsed > MAX_BLIND):
            remark = "the base was not heard for too long or restarted: its motion meanwhile is unknown, pose held"
        elif last is not None:
            speed = self._move(last, feedback, elapsed)
        pose = OdometryPose(self._map.host(time), self._x, self._y, self._theta, speed, feedback.turn_rate)
        return pose, missing, remark

    def _move(self, last: Feedback, now: Feedback, elapsed: float) -> float:
        left, right = (_wrapped(b - a) * TICK for a, b in ((last.left, now.left), (last.right, now.right)))
        travel = (left + right) / 2
        if last.heading is None or now.heading is None:
            turn = (right - left) / WHEEL_BASE
        else:
            turn = math.remainder(now.heading - last.heading, 2 * math.pi)
        middle = self._theta + turn / 2
        self._x += travel * math.cos(middle)
        self._y += travel * math.sin(middle)
        self._theta = math.remainder(self._theta + turn, 2 * math.pi)
        return travel / elapsed


def _wrapped(difference: int) -> int:
    """Return an encoder difference as a signed 16-bit number."""
    return (difference + ENCODER_MODULUS // 2) % ENCODER_MODULUS - ENCODER_MODULUS // 2
