"""iRobot Create 2 and Roomba 500 to 900: wheel odometry from the encoder counts of the Open Interface. Sans-I/O.

115200 bit/s. ``128`` starts the interface (passive mode: the robot drives as its buttons command, nothing moves by itself),
``148 n packets...`` streams packets every 15 ms, big-endian::

    13h | length | 7, bumps and wheel drops (1) | 43, left encoder (2) | 44, right encoder (2) | 22, mV (2) | check

where the sum of all bytes is 0 modulo 256. ``150 0`` pauses the stream. Encoders wrap at 2**16. Packets 19 and 20
(distance and angle since the last time) are wrong on some firmware and not used. Source: iRobot, Create 2 Open Interface
specification; users (packets 19 and 20).
"""

import math
import struct
from dataclasses import dataclass

from ..clocks.clock_map import rhythm_map
from .events import Action, Corrupt, Lost, OdometryPose, Pose, Send
from .framing import FixedPackets
from .odometer import BaseDriver, WheelOdometer, way_of
from .session import Script

BAUD = 115200
PERIOD = 0.015
"""s between frames."""
TICKS_PER_TURN, WHEEL_DIAMETER, WHEEL_BASE = 508.8, 0.072, 0.235
"""1, m, m; the specification's."""
TICK = math.pi * WHEEL_DIAMETER / TICKS_PER_TURN
"""m of wheel travel per encoder tick."""
MODULUS = 1 << 16
MAX_SPEED = 0.6
"""m/s; a little above what the robot can do."""
MAX_BLIND = MODULUS / 2 * TICK / MAX_SPEED
"""s after which an encoder may have turned by half its range unseen."""
HEAD, PACKETS = 0x13, bytes((7, 43, 44, 22))
LAYOUT = struct.Struct(">BB BB BH BH BH B".replace(" ", ""))
START, STREAM, PAUSE = b"\x80", bytes((0x94, len(PACKETS))) + PACKETS, b"\x96\x00"
SILENCE = 1.0
"""s without a frame after which the stream is asked for again."""
STALL = 0.3
"""s by which a frame may come late because the computer stalled; later, frames were lost."""
LOW_VOLTAGE = 13.0
"""V."""


@dataclass(frozen=True, slots=True)
class Encoders:
    """One frame."""

    stamp: float
    """s, arrival of its first byte."""
    left: int
    right: int
    """Encoder ticks, wrap at 2**16."""
    wheel_drop: int
    """Bits: 1 right, 2 left."""
    voltage: float
    """V."""


class Create2Protocol(FixedPackets):
    """Bytes of the robot in, Encoders and Corrupt out."""

    head, size = bytes((HEAD, LAYOUT.size - 3, PACKETS[0])), LAYOUT.size

    def is_good(self, packet: bytearray) -> bool:
        """Return whether the sum is right, and the packets are those that were asked for."""
        return sum(packet) & 0xFF == 0 and bytes(packet[place] for place in (2, 4, 7, 10)) == PACKETS

    def decode(self, frame: bytes, stamp: float) -> Encoders:
        _, _, _, bumps, _, left, _, right, _, millivolts, _ = LAYOUT.unpack(frame)
        return Encoders(stamp, left, right, bumps >> 2 & 3, millivolts / 1000)


class Create2Driver(BaseDriver):
    """A Create 2 or Roomba. It is only listened to: the stream is asked for, no motor is ever moved.

    One that was switched on with its clean button held for 10 s talks at 19200 bit/s.
    """

    frame, rhythm = Encoders, PERIOD

    def __init__(self, start: Pose = (0.0, 0.0, 0.0), baud: int = BAUD) -> None:
        self.baud = baud
        super().__init__(Create2Protocol(), "iRobot Create 2", WheelOdometer(TICK, WHEEL_BASE, MODULUS, start), LOW_VOLTAGE)
        self._last: Encoders | None = None
        self._new_clock()

    def _new_clock(self) -> None:
        self._frames, self._map = 0, rhythm_map()

    def begin(self) -> None:
        """Forget half a frame; the encoders counted on."""
        super().begin()
        self._new_clock()

    def script(self) -> Script[None]:
        """Ask for the stream, again whenever it stops: the robot falls asleep after five minutes, or was switched off."""
        while True:
            yield Send(START)
            yield from self.sleep(0.05)
            yield Send(STREAM)
            yield from self.listen(Encoders | Corrupt, SILENCE)

    def damaged(self) -> None:
        self._new_clock()

    def take(self, event: Encoders) -> list[Action]:
        self.ready, last, self._last = True, self._last, event
        actions: list[Action] = []
        stamp = self._stamp(event)
        pause = event.stamp - last.stamp if last is not None else 0.0
        if pause > STALL:
            actions.append(Lost(round(pause / PERIOD) - 1))
        way = 0.0 if last is None else way_of((event.left - last.left, event.right - last.right), MODULUS, TICK)
        if pause > MAX_BLIND or way > MAX_SPEED * max(pause, STALL):  # more than it can drive: the counts began again
            self._odometer.forget()
            why = f"sent nothing for {pause:.1f} s" if pause > MAX_BLIND else "restarted"
            actions.append(self.gap(f"{why}, the pose is held: its motion"))
        travel, turn = self._odometer.update(event.left, event.right)
        actions += self.state(event.wheel_drop, event.voltage)
        elapsed = max(pause, PERIOD)
        return [*actions, OdometryPose(stamp, *self._odometer.pose, travel / elapsed, turn / elapsed)]

    def _stamp(self, event: Encoders) -> float:
        """Return the host time of a frame: they come every 15 ms, and the computer or its adapter hands them on in lumps."""
        self._frames += 1
        if self._last is not None and self._frames > 1 and event.stamp - self._map.host(self._frames * PERIOD) > STALL:
            self._new_clock()
        self._map.add(self._frames * PERIOD, event.stamp)
        return self._map.host(self._frames * PERIOD)

    def stop(self) -> list[Action]:
        return [Send(PAUSE)]
