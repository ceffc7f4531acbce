"""Emulated bases, whose wheels and gyro follow a played odometry: a Kobuki, a Create 2, and one that prints ticks."""

import math
import struct
from collections.abc import Iterator

from .world import Feed, Pose, WorldClock


class WheeledDevice:
    """A base with two wheels.

    Parameters
    ----------
    poses : odometry to play; before the first and after the last the base stands.
    clock : world time.
    clock_start : ms on its clock at power-up.
    clock_skew : relative error of its crystal.
    on_packet : called with (host time, x, y, theta) of each packet sent.
    """

    PERIOD = 0.020
    """s between packets."""
    METRES_PER_TICK = 0.0024369168713639 * 0.035
    WHEEL_BASE = 0.230
    """m."""

    def __init__(
        self, poses: Iterator[Pose], clock: WorldClock, *, clock_start: int = 0, clock_skew: float = 0.0, on_packet=None
    ) -> None:
        self._feed, self._clock = Feed(poses), clock
        self._from = self._feed.pop()
        self._ms, self._skew = clock_start, clock_skew
        self._on_packet = on_packet or (lambda *_: None)
        self._left = self._right = 0.0
        self._travelled = self._from
        self._sent = 0
        self._began: float | None = None

    def power_up(self, now: float) -> None:
        """USB was unplugged; the base itself stays on and counts on."""

    def next_time(self, now: float) -> float:
        """Return when the next packet is due, host s."""
        if self._began is None:
            self._began = now
        return self._began + self._sent * self.PERIOD

    def receive(self, data: bytes, now: float) -> bytes:
        """Take commands; there are no motors."""
        return b""

    def advance(self, now: float) -> bytes:
        """Return the packets due up to host time `now`."""
        out = b""
        while (due := self.next_time(now)) <= now:
            self._sent += 1
            out += self._packet(due)
        return out

    def _pose(self, time: float) -> Pose:
        while self._feed.head is not None and self._feed.head.time <= time:
            self._from = self._feed.pop()
        a, b = self._from, self._feed.head
        if b is None or time <= a.time:
            return Pose(time, a.x, a.y, a.theta)
        u = (time - a.time) / (b.time - a.time)
        turn = math.remainder(b.theta - a.theta, 2 * math.pi)
        return Pose(time, a.x + u * (b.x - a.x), a.y + u * (b.y - a.y), a.theta + u * turn)

    def _packet(self, due: float) -> bytes:
        pose = self._pose(max(0.0, self._clock.world(due)))
        before, self._travelled = self._travelled, pose
        dx, dy = pose.x - before.x, pose.y - before.y
        turn = math.remainder(pose.theta - before.theta, 2 * math.pi)
        middle = before.theta + turn / 2
        travel = math.cos(middle) * dx + math.sin(middle) * dy
        self._left += (travel - turn * self.WHEEL_BASE / 2) / self.METRES_PER_TICK
        self._right += (travel + turn * self.WHEEL_BASE / 2) / self.METRES_PER_TICK
        self._on_packet(due, pose.x, pose.y, pose.theta)
        assert self._began is not None
        ms = self._ms + math.floor((due - self._began) * 1000 * (1 + self._skew))
        return self.encode(ms, round(self._left), round(self._right), pose.theta, turn / self.PERIOD)

    def encode(self, ms: int, left: int, right: int, theta: float, turn_rate: float) -> bytes:
        """Return a packet: the base's clock, the ticks of its wheels, what its gyro measures (rad, rad/s)."""
        raise NotImplementedError


class KobukiDevice(WheeledDevice):
    """A Kobuki: fifty feedback packets a second; versions, serial number and gains where they are asked for."""

    _input = b""
    _asked: tuple[tuple[int, bytes], ...] = ()

    def receive(self, data: bytes, now: float) -> bytes:
        """Take commands; what they ask for comes with the next packet."""
        self._input += data
        while (at := self._input.find(b"\xaa\x55")) >= 0 and len(self._input) >= at + 4 + (self._input + b"\0\0\0")[at + 2]:
            payload = self._input[at + 3 : at + 3 + self._input[at + 2]]
            self._input = self._input[at + 4 + len(payload) :]
            asked = {0x0A: b"\4\0\1\0", 0x0B: b"\0\2\1\0", 0x13: bytes(12)}
            if payload[:2] == b"\x09\x02":
                self._asked += tuple((kind, asked[kind]) for bit, kind in ((1, 0x0A), (2, 0x0B), (8, 0x13)) if payload[2] & bit)
            elif payload[:1] == b"\x0e":
                self._asked += ((0x15, struct.pack("<B3I", 0, 100_000, 100, 2000)),)
        return b""

    def encode(self, ms: int, left: int, right: int, theta: float, turn_rate: float) -> bytes:
        """Return a feedback packet."""
        angle = round(math.degrees(math.remainder(theta, 2 * math.pi)) * 100)
        rate = max(-32768, min(32767, round(math.degrees(turn_rate) * 100)))
        subs = [
            (0x01, struct.pack("<HBBBHHbbBBBB", ms & 0xFFFF, 0, 0, 0, left & 0xFFFF, right & 0xFFFF, 0, 0, 0, 0, 160, 0)),
            (0x03, b"\0\0\0"),
            (0x04, struct.pack("<hh3x", max(-32768, min(32767, angle)), rate)),
            (0x05, struct.pack("<HHH", 2000, 2000, 2000)),
            (0x06, b"\x05\x05"),
            (0x0D, struct.pack("<BB6h", self._sent & 0xFF, 6, 0, 0, rate, 0, 0, rate)),
            (0x10, struct.pack("<H4H6x", 0, 4095, 4095, 4095, 4095)),
            *self._asked,
        ]
        self._asked = ()
        return encode_packet(subs)


class Create2Device(WheeledDevice):
    """An iRobot Create 2: streams the packets that it was asked for, every 15 ms."""

    PERIOD = 0.015
    METRES_PER_TICK = math.pi * 0.072 / 508.8
    WHEEL_BASE = 0.235
    WORDS = (19, 20, 22, 23, 25, 26, 27, 28, 29, 30, 31, 33, 39, 40, 41, 42, 43, 44, 46, 47, 48, 49, 50, 51, 54, 55, 56, 57)
    """Packets of two bytes; the others, of 7 to 58, have one."""

    def power_up(self, now: float) -> None:
        """The port was opened again; a stream that was asked for goes on."""
        self.packets = getattr(self, "packets", b"")
        self.streaming, self.awake, self._input = bool(self.packets), False, b""

    def receive(self, data: bytes, now: float) -> bytes:
        """Take ``128``, ``148 n packets`` and ``150 flag``."""
        self._input += data
        while self._input:
            code, more = self._input[0], self._input[1:]
            size = {148: 2 + (more[0] if more else 0), 150: 2}.get(code, 1)
            if len(self._input) < size:
                break
            self._input = self._input[size:]
            if code == 128:
                self.awake = True
            elif code == 148 and self.awake:
                self.packets, self.streaming = more[1 : size - 1], True
            elif code == 150:
                self.streaming = bool(more[0])
        return b""

    def advance(self, now: float) -> bytes:
        """Return the frames due up to host time `now`; the wheels count also while nobody listens."""
        out = super().advance(now)
        return out if self.streaming else b""

    def encode(self, ms: int, left: int, right: int, theta: float, turn_rate: float) -> bytes:
        """Return a frame of the stream."""
        values = {22: 15800, 43: left & 0xFFFF, 44: right & 0xFFFF}
        body = b"".join(bytes([p]) + values.get(p, 0).to_bytes(1 + (p in self.WORDS), "big") for p in self.packets)
        frame = bytes((19, len(body))) + body
        return frame + bytes([-sum(frame) & 0xFF])


class TickLineDevice(WheeledDevice):
    """A hobby controller that prints ``ms,left,right`` fifty times a second."""

    METRES_PER_TICK = 0.0001
    WHEEL_BASE = 0.30

    def encode(self, ms: int, left: int, right: int, theta: float, turn_rate: float) -> bytes:
        """Return a line."""
        return f"{ms},{left},{right}\r\n".encode()


class GyroLineDevice(WheeledDevice):
    """A gyro that prints ``ms,rate`` a hundred times a second, rate in degrees per second, with a bias."""

    PERIOD = 0.01
    BIAS = 0.8
    """degrees/s."""

    def encode(self, ms: int, left: int, right: int, theta: float, turn_rate: float) -> bytes:
        """Return a line."""
        return f"{ms},{math.degrees(turn_rate) + self.BIAS:.3f}\r\n".encode()


def encode_packet(subs: list[tuple[int, bytes]]) -> bytes:
    """Build a packet from sub-payloads (id, data), together at most 255 bytes with their headers."""
    payload = b"".join(bytes((kind, len(data))) + data for kind, data in subs)
    total = len(payload)
    for byte in payload:
        total ^= byte
    return b"\xaa\x55" + bytes([len(payload)]) + payload + bytes([total])
