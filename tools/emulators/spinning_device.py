"""Emulated spinning lidars: LD06, LDS-01, RPLIDAR (express and standard scan), YDLIDAR X2 and X4. Bytes in, bytes out."""

import math
import struct
from collections.abc import Mapping
from functools import cache, reduce
from operator import xor
from types import MappingProxyType

from .world import WorldClock

FAR = math.atan(-21.8 / 155.3) / (2 * math.pi)
"""Turns by which a YDLIDAR's far readings point elsewhere than its motor."""


class SpinningDevice:
    """What all of them do: turn, measure at a fixed rate, send what was measured in groups.

    Parameters
    ----------
    world : has ``look(times, bearings) -> mm``: world s, turns clockwise; 0 = nothing seen.
    clock : world time.
    speed : turns a second. wobble : share by which the motor's speed swings within seven seconds.
    on_turn : called with the host time at which the motor passes zero.
    """

    RATE = 4500.0
    """Readings per second."""
    GROUP = 12
    """Readings sent together."""

    def __init__(self, world, clock: WorldClock, *, speed: float = 10.0, wobble: float = 0.0, on_turn=None) -> None:
        self._world, self._clock = world, clock
        self.speed, self._wobble = speed, wobble
        self._on_turn = on_turn or (lambda _t: None)
        self.streaming = True
        self.motor = True
        self.power_up(0.0)

    def power_up(self, now: float) -> None:
        """Start again."""
        self._began: float | None = None
        self._sent, self._place = 0, 0.0

    @property
    def is_streaming(self) -> bool:
        """Return whether readings are being sent."""
        return self.streaming and self.motor

    def next_time(self, now: float) -> float:
        """Return when the next group is complete, host s."""
        if not self.is_streaming:
            return math.inf
        if self._began is None:
            self._began = now
        return self._began + (self._sent + self.GROUP) / self.RATE

    def receive(self, data: bytes, now: float) -> bytes:
        """Take bytes from the host; a lidar that only streams ignores them."""
        return b""

    def advance(self, now: float) -> bytes:
        """Return the groups complete up to host time `now`."""
        out = b""
        while (due := self.next_time(now)) <= now:
            times, places = self._turn_on(due)
            out += self.encode(due, times, places)
        return out

    def _turn_on(self, due: float) -> tuple[list[float], list[float]]:
        """Return host times and places of the motor, turns, of the readings of a group."""
        times, places = [], []
        for i in range(self.GROUP):
            time = due - (self.GROUP - 1 - i) / self.RATE
            step = self._step(time)
            self._place += step
            if self._place >= 1.0:
                self._place -= 1.0
                self._on_turn(time - self._place / step / self.RATE)
            times.append(time)
            places.append(self._place)
        self._sent += self.GROUP
        return times, places

    def _step(self, time: float) -> float:
        """Return how far the motor turns from one reading to the next, turns."""
        return self.speed * (1.0 + self._wobble * math.sin(2 * math.pi * time / 7.0)) / self.RATE

    def look(self, times: list[float], bearings: list[float]) -> list[int]:
        """Return what is seen, mm, 0 = nothing."""
        return self._world.look([max(0.0, self._clock.world(t)) for t in times], bearings)

    def encode(self, due: float, times: list[float], places: list[float]) -> bytes:
        """Return the frame of a group."""
        raise NotImplementedError


class LdLidarDevice(SpinningDevice):
    """LD06, LD19."""

    def __init__(self, world, clock, *, clock_start: int = 0, clock_skew: float = 0.0, **options) -> None:
        super().__init__(world, clock, **options)
        self._ms, self._skew = clock_start, clock_skew

    def encode(self, due: float, times: list[float], places: list[float]) -> bytes:
        """Return a packet of 47 bytes."""
        mm = self.look(times, places)
        start, end = (round(36000 * place) % 36000 for place in (places[0], places[-1]))
        ms = (self._ms + math.floor((due - self._began) * 1000 * (1 + self._skew))) % 30000
        readings = b"".join(struct.pack("<HB", value, 200 if value else 0) for value in mm)
        return ld_packet(round(360 * self.speed), start, readings, end, ms)


def ld_packet(speed: int, start: int, readings: bytes, end: int, ms: int) -> bytes:
    """Build a packet of an LD06."""
    body = b"\x54\x2c" + struct.pack("<HH", speed, start) + readings + struct.pack("<HH", end, ms)
    crc = 0
    for byte in body:
        crc = _shifted(crc ^ byte)
    return body + bytes([crc])


@cache
def _shifted(crc: int) -> int:
    """Return the CRC after the eight bits of a byte."""
    for _ in range(8):
        crc = (crc << 1 ^ 0x4D if crc & 0x80 else crc << 1) & 0xFF
    return crc


class Lds01Device(SpinningDevice):
    """LDS-01: one reading a degree, so its rate is that of its motor."""

    GROUP = 6

    def __init__(self, world, clock, *, speed: float = 5.0, sum_rule=lambda total: ~total, **options) -> None:
        super().__init__(world, clock, speed=speed, **options)
        self.RATE = 360.0 * speed
        self._sum_rule = sum_rule
        self.streaming = False
        self._due: float | None = None

    def power_up(self, now: float) -> None:
        """Start again, motor off."""
        super().power_up(now)
        self.streaming = False

    def receive(self, data: bytes, now: float) -> bytes:
        """Take ``b`` and ``e``."""
        for byte in data:
            if byte in b"be" and self.streaming != (byte == ord("b")):
                self.streaming, self._due = byte == ord("b"), None
        return b""

    def next_time(self, now: float) -> float:
        """Return when the next six degrees are over, host s."""
        if not self.streaming:
            return math.inf
        if self._due is None:
            self._began, self._due, self._sent = now, now + self._span(now), 0
        return self._due

    def _rpm(self, time: float) -> float:
        return 60 * self.speed * (1.0 + self._wobble * math.sin(2 * math.pi * time / 7.0))

    def _span(self, time: float) -> float:
        return 6 / (6 * self._rpm(time))

    def advance(self, now: float) -> bytes:
        """Return the packets complete up to host time `now`."""
        out = b""
        while (due := self.next_time(now)) <= now:
            number, span = self._sent % 60, self._span(due)
            times = [due - (5 - i) * span / 6 for i in range(6)]
            if number == 0:
                self._on_turn(times[0])
            mm = self.look(times, [(6 * number + i) / 360 for i in range(6)])
            body = struct.pack("<BBH", 0xFA, 0xA0 + number, round(10 * self._rpm(due)))
            body += b"".join(struct.pack("<HHH", 1000 if value else 0, value, 0) for value in mm)
            out += body + bytes([self._sum_rule(sum(body)) & 0xFF]) * 2
            self._sent += 1
            self._due = due + self._span(due)
        return out


def slamtec_reply(kind: int, payload: bytes, stream: bool = False) -> bytes:
    """Build a reply of an RPLIDAR or YDLIDAR; that of a stream says the length of its frames and has no payload."""
    head = b"\xa5\x5a" + struct.pack("<IB", len(payload) | (0x40000000 if stream else 0), kind)
    return head if stream else head + payload


class SlamtecDevice(SpinningDevice):
    """What RPLIDAR and YDLIDAR share: requests ``A5 command``."""

    INFO = struct.pack("<BBBB16s", 0x18, 29, 1, 7, bytes(range(16)))
    COMMANDS: Mapping[int, tuple[bytes, str]] = MappingProxyType({})
    """Command -> reply and what it does: "stop", the name of a stream, or ""."""
    WITH_PAYLOAD = (0x82, 0x84, 0xF0)

    def __init__(self, world, clock, *, health: bytes = b"\0\0\0", **options) -> None:
        self.health = health
        self.mode = ""
        self._pending = bytearray()
        super().__init__(world, clock, **options)

    def power_up(self, now: float) -> None:
        """Start again, silent."""
        super().power_up(now)
        self.streaming = False
        self._pending.clear()

    def receive(self, data: bytes, now: float) -> bytes:
        """Take requests and return the answers."""
        out = b""
        self._pending += data
        while len(self._pending) >= 2:
            if self._pending[0] != 0xA5:
                del self._pending[0]
                continue
            command = self._pending[1]
            size = 2 if command not in self.WITH_PAYLOAD else 4 + self._pending[2] if len(self._pending) > 2 else 3
            if len(self._pending) < size:
                break
            whole = bytes(self._pending[:size])
            del self._pending[:size]
            if size == 2 or reduce(xor, whole) == 0:
                out += self._obey(command, whole, now)
        return out

    def _obey(self, command: int, whole: bytes, now: float) -> bytes:
        reply, action = self.COMMANDS.get(command, (b"", ""))
        if action == "stop":
            self.streaming = False
        elif action:
            self.streaming, self.mode = True, action
            self._began, self._sent = None, 0
            self.begin()
        if self.streaming and not action:
            return b""  # busy
        return slamtec_reply(0x06, self.health) if reply == b"health" else reply

    def begin(self) -> None:
        """Begin a stream."""


def scan_mode_reply(entry: int, mode: int) -> bytes:
    """Answer GET_LIDAR_CONF, which units have from firmware 1.24 and the maker's SDK asks: mode 0 standard, 1 express."""
    microseconds, reply, name = ((500, 0x81, b"Standard"), (250, 0x82, b"Express"))[mode == 1]
    values = {
        0x70: struct.pack("<H", 2),  # number of modes
        0x71: struct.pack("<I", microseconds << 8),
        0x74: struct.pack("<I", 12 << 8),  # m
        0x75: bytes([reply]),
        0x7C: struct.pack("<H", 1),  # the usual mode
        0x7F: name + b"\0",
    }
    return slamtec_reply(0x20, struct.pack("<I", entry) + values[entry]) if entry in values and mode < 2 else b""


class RpLidarDevice(SlamtecDevice):
    """RPLIDAR A1."""

    RATE = 4000.0
    GROUP = 32
    COMMANDS = MappingProxyType({
        0x25: (b"", "stop"),
        0x40: (b"", "stop"),
        0x20: (slamtec_reply(0x81, bytes(5), True), "standard"),
        0x82: (slamtec_reply(0x82, bytes(84), True), "express"),
        0x50: (slamtec_reply(0x04, SlamtecDevice.INFO), ""),
        0x52: (b"health", ""),
        0x59: (slamtec_reply(0x15, struct.pack("<HH", 500, 250)), ""),
    })

    def __init__(self, world, clock, *, speed: float = 5.5, **options) -> None:
        super().__init__(world, clock, speed=speed, **options)

    def _obey(self, command: int, whole: bytes, now: float) -> bytes:
        if command == 0x84 and not self.streaming:
            return scan_mode_reply(*struct.unpack_from("<IH", whole[3:-1].ljust(6, b"\0")))
        return super()._obey(command, whole, now)

    def begin(self) -> None:
        """Begin a stream; standard scan has half the rate."""
        self.RATE, self.GROUP = (4000.0, 32) if self.mode == "express" else (2000.0, 1)
        self._first = True
        self._ahead: list[int] = []

    def _look_ahead(self, due: float, place: float) -> int:
        """Return what a reading sees; the world is asked for several at once, over which the motor runs evenly."""
        if not self._ahead:
            step, together = self._step(due), range(32)
            self._ahead = self.look([due + i / self.RATE for i in together], [(place + i * step) % 1.0 for i in together])[::-1]
        return self._ahead.pop()

    def encode(self, due: float, times: list[float], places: list[float]) -> bytes:
        """Return a capsule of 84 bytes or a node of 5."""
        if self.mode == "standard":
            mm, angle = self._look_ahead(due, places[0]), round(places[0] * 23040) % 23040
            start = places[0] < self.speed / self.RATE
            return struct.pack("<BHH", (0 if not mm else 188) | (1 if start else 2), angle << 1 | 1, 4 * mm)
        # Near readings point a little elsewhere; the offset is sent in 1/8 degree, six bits.
        mm = self.look(times, places)
        offsets = [min(63, round(8 * 1500 / value)) if value > 100 else 0 for value in mm]
        mm = self.look(times, [p - o / 2880 for p, o in zip(places, offsets, strict=True)])
        body = struct.pack("<H", round(places[0] * 23040) % 23040 | (0x8000 if self._first else 0))
        self._first = False
        for k in range(0, 32, 2):
            words = [mm[k + j] << 2 | offsets[k + j] >> 4 for j in (0, 1)]
            body += struct.pack("<HHB", *words, (offsets[k] & 15) | (offsets[k + 1] & 15) << 4)
        total = reduce(xor, body)
        return bytes((0xA0 | total & 15, 0x50 | total >> 4)) + body


class YdLidarX4Device(SlamtecDevice):
    """YDLIDAR X4. A packet ends where the turn does; the first one of a turn holds the reading at zero alone."""

    RATE = 5000.0
    GROUP = 40
    COMMANDS = MappingProxyType({
        0x65: (b"", "stop"),
        0x60: (slamtec_reply(0x81, bytes(5), True), "start"),
        0x90: (slamtec_reply(0x04, SlamtecDevice.INFO), ""),
        0x91: (b"health", ""),
    })

    def __init__(self, world, clock, *, speed: float = 7.0, **options) -> None:
        super().__init__(world, clock, speed=speed, **options)

    def encode(self, due: float, times: list[float], places: list[float]) -> bytes:
        """Return the packets of a group: one, or three where the turn ends in it."""
        bearings = [p + FAR for p in places]
        for _ in range(3):
            mm = self.look(times, bearings)
            bearings = [p + ydlidar_correction(value) for p, value in zip(places, mm, strict=True)]
        cut = next((i for i in range(1, len(places)) if places[i] < places[i - 1]), 0)
        parts = [slice(0, cut), slice(cut, cut + 1), slice(cut + 1, None)] if cut else [slice(None)]
        return b"".join(
            ydlidar_packet(places[part], mm[part], first=k == 1) for k, part in enumerate(parts) if places[part]
        )


class YdLidarX2Device(YdLidarX4Device):
    """YDLIDAR X2: streams unasked, 3000 readings a second."""

    RATE = 3000.0

    def power_up(self, now: float) -> None:
        """Start again; the stream begins by itself."""
        super().power_up(now)
        self.streaming = True

    def receive(self, data: bytes, now: float) -> bytes:
        """Ignore everything: its receiver is not connected."""
        return b""


def ydlidar_correction(mm: int) -> float:
    """Return by how much a reading points elsewhere than the motor says, turns."""
    return math.atan(21.8 * (155.3 - mm) / (155.3 * mm)) / (2 * math.pi) if mm else FAR


def ydlidar_packet(places: list[float], mm: list[int], first: bool = False) -> bytes:
    """Build a packet of a YDLIDAR."""
    ends = [(round(place * 23040) % 23040) << 1 | 1 for place in (places[0], places[-1])]
    words = [0x55AA, int(first) | len(mm) << 8, *ends, *(4 * value for value in mm)]
    words.insert(4, reduce(xor, words))
    return struct.pack(f"<{len(words)}H", *words)


LIDARS = {
    "ld06": LdLidarDevice, "lds01": Lds01Device, "rplidar": RpLidarDevice, "rplidar-standard": RpLidarDevice,
    "ydlidar-x2": YdLidarX2Device, "ydlidar-x4": YdLidarX4Device,
}  # fmt: skip
"""Name of the kind, as `uwblite record` has it -> its emulator."""
