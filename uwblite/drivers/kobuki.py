"""Kobuki base (TurtleBot 2): feedback packets in, wheel odometry out. Read-only, sans-I/O.

The base streams 50 packets a second unasked, 115200 bit/s::

    AA 55 | length | sub-payloads (id, length, data) ... | xor of the length byte and the payload

Little-endian. Used here: basic sensor data (id 01) and inertia (id 04); whatever else a firmware sends is skipped by its
length. Sources: vendor protocol description and kobuki_core 1.4.0. No complete public capture of a packet was found.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import xor

from ..clocks.device_clock import BACKWARD, DeviceClock
from .continuity import Continuity, device_time
from .events import Action, Corrupt, Lost, OdometryPose, Pose
from .framing import HeadedFrames
from .odometer import BaseDriver, WheelOdometer, way_of

PERIOD = 0.020
"""s between packets."""
TICK = 0.0024369168713639 * 0.035
"""m of wheel travel per encoder tick: rad per tick times wheel radius (kobuki_core)."""
WHEEL_BASE = 0.230
"""m between the wheels."""
ENCODER_MODULUS = STAMP_MODULUS = 1 << 16
MAX_SPEED = 0.75
"""m/s; a little above what the base can do."""
MAX_BLIND = ENCODER_MODULUS / 2 * TICK / MAX_SPEED
"""s after which an encoder may have turned by half its range unseen, so that its difference is ambiguous."""
MAX_GUESS = 2 * MAX_BLIND
"""s up to which the smaller of the possible travels is taken all the same: it is right below half the top speed."""
FASTEST, FASTEST_TURN = 3.0, 4 * math.pi
"""m/s, rad/s; no base moves or is carried faster. A sum of eight bits passes one in 256 damaged packets."""
LOW_BATTERY = 13.5
"""V; a full battery has 16.5 V, the base switches off at 13.2 V."""

SIGNATURE = b"\xaa\x55\x00\x01\x0f"
"""Head of every packet; the zero stands for any length."""
BASIC, INERTIA = 0x01, 0x04
SHORTEST = 17
"""Bytes of the payload: the basic sensor data with their head."""


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
    wheel_drop: int
    """Bits: 1 right, 2 left."""
    battery: float
    """V."""


class KobukiProtocol(HeadedFrames):
    """Bytes of the base in, Feedback and Corrupt out."""

    lead, head_size, noise = SIGNATURE[0], len(SIGNATURE), "no packet"

    def frame_size(self, head: bytes) -> int:
        fits = all((i == 2 and byte >= SHORTEST) or byte == SIGNATURE[i] for i, byte in enumerate(head))
        return -1 if not fits else 4 + head[2] if len(head) > 2 else 0

    def decode(self, frame: bytes, stamp: float) -> Feedback | Corrupt:
        if reduce(xor, frame[2:], 0):
            return Corrupt("packet with a wrong sum")
        subs: dict[int | None, bytes] = {}
        for kind, data in _sub_payloads(frame[3:-1]):
            subs.setdefault(kind, data)
        if None in subs:
            return Corrupt("packet whose parts do not fill it")
        basic, inertia = subs[BASIC], subs.get(INERTIA, b"")
        time, _bumper, drop, _cliff, left, right = struct.unpack_from("<HBBBHH", basic)
        heading, rate = None, 0.0
        if len(inertia) >= 4:
            angle, turn = struct.unpack_from("<hh", inertia)
            heading, rate = math.radians(angle / 100), math.radians(turn / 100)
        return Feedback(stamp, time, left, right, heading, rate, drop, basic[13] / 10)


def _sub_payloads(payload: bytes) -> Iterator[tuple[int | None, bytes]]:
    """Yield id and data of the parts, which begin with both the id and the length; (None, b"") where the last is cut off."""
    place = 0
    while place + 2 <= len(payload):
        end = place + 2 + payload[place + 1]
        yield payload[place], payload[place + 2 : end]
        place = end
    if place != len(payload):
        yield None, b""


class KobukiDriver(BaseDriver):
    """A Kobuki base. Nothing is ever sent."""

    frame, rhythm = Feedback, PERIOD

    def __init__(self, start: Pose = (0.0, 0.0, 0.0)) -> None:
        odometer = WheelOdometer(TICK, WHEEL_BASE, ENCODER_MODULUS, start)
        super().__init__(KobukiProtocol(), "Kobuki base", odometer, LOW_BATTERY)
        self._clock = DeviceClock(1e-3, STAMP_MODULUS, period=PERIOD)
        self._series = Continuity(_follows, "packet that", summed=True)
        self._packets = 0
        self._last: Feedback | None = None

    def take(self, event: Feedback) -> list[Action]:
        """Turn packets into poses. One that leaps, and the first, count only if the next one goes on from it."""
        return self._series.confirmed(event, 1, self._pose)

    def stop(self) -> list[Action]:
        return self._series.unconfirmed()

    def _pose(self, event: Feedback) -> list[Action]:
        self._packets += 1
        self.ready = self._packets > 2
        reading, last, self._last = self._clock.read(event.time, event.stamp), self._last or event, event
        if reading.elapsed is not None and reading.elapsed <= 0:
            return [Corrupt("packet sent twice")]
        elapsed = reading.elapsed or max(event.stamp - last.stamp, PERIOD)
        leapt = _way(event.left - last.left, event.right - last.right) > FASTEST * (elapsed + PERIOD)
        restarted = leapt or (reading.reset and _began_again(last, event))
        if restarted:
            self._odometer.forget()
        # The gyro's angle is absolute, so the heading holds over any gap; the travel is ambiguous after a long one.
        travel, _ = self._odometer.update(event.left, event.right, event.heading, still=elapsed > MAX_GUESS)
        actions: list[Action] = [Lost(reading.missing)] if reading.missing else []
        if restarted or elapsed > MAX_BLIND:
            silent = f"sent nothing for {elapsed:.1f} s: how far it went"
            actions.append(self.gap("restarted, the pose is held: its motion" if restarted else silent))
        actions += self.state(event.wheel_drop, event.battery)
        return [*actions, OdometryPose(reading.stamp, *self._odometer.pose, travel / elapsed, event.turn_rate)]


def _began_again(last: Feedback, event: Feedback) -> bool:
    """Return whether clock and wheels count from zero rather than go on: the base was switched on meanwhile."""
    elapsed, seconds = event.stamp - last.stamp, event.time * 1e-3
    further = (event.time - last.time) % STAMP_MODULUS * 1e-3
    goes_on = further <= elapsed and _way(event.left - last.left, event.right - last.right) <= FASTEST * (further + PERIOD)
    return not goes_on and seconds <= elapsed + BACKWARD and _way(event.left, event.right) <= FASTEST * (seconds + PERIOD)


def _way(left: int, right: int) -> float:
    return way_of((left, right), ENCODER_MODULUS, TICK)


def _follows(before: Feedback, after: Feedback) -> bool:
    """Return whether clock, wheels and gyro can have gone on so."""
    seconds = device_time((after.time - before.time) * 1e-3, after.stamp - before.stamp, STAMP_MODULUS * 1e-3)
    if seconds is None:
        return False
    moved = _way(after.left - before.left, after.right - before.right)
    turned = math.remainder((after.heading or 0.0) - (before.heading or 0.0), 2 * math.pi)
    most = max(seconds, 0.0) + PERIOD
    return moved <= FASTEST * most and abs(turned) <= FASTEST_TURN * most
