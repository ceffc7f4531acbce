"""LDROBOT LD06, LD19 and STL-19P: packets of twelve readings, streamed unasked. Sans-I/O.

230400 bit/s, 47 bytes, little-endian::

    54 2C | speed (2, degrees/s) | start angle (2, 0.01 degrees) | 12 x (range (2, mm), intensity (1))
    | end angle (2) | time (2, ms, wraps at 30000) | CRC-8, polynomial 0x4D

Angles run clockwise. Between start and end angle the readings are evenly spaced; a range of 0 is none.
Sources: LD19 development manual 2.3 (its example packet is a test); the maker's driver ldlidar_stl_ros2.
"""

import math
import struct

from ..clocks.device_clock import DeviceClock
from .continuity import Continuity, device_time
from .events import Action
from .framing import FixedPackets
from .spinning import Fan, Samples, SpinningDriver

BAUD = 230400
SIZE, READINGS = 47, 12
CLOCK_MODULUS, CLOCK_TICK = 30000, 1e-3
RATE = 4500.0
"""Readings per second of LD06 and LD19; the STL-19P has 5000."""
MOST_SPEED = 20 * 360
"""Degrees/s; the motor turns 5 to 13 times a second."""
FAN = Fan(450, 0.02, 12.0)


def _crc_table(polynomial: int) -> bytes:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial if value & 0x80 else value << 1) & 0xFF
        table.append(value)
    return bytes(table)


_CRC = _crc_table(0x4D)


def crc8(data: bytes | bytearray) -> int:
    """Return the check byte of a packet."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


class LdLidarProtocol(FixedPackets):
    """Bytes of the lidar in, Samples and Corrupt out."""

    head, size = b"\x54\x2c", SIZE

    def is_good(self, packet: bytearray) -> bool:
        return crc8(packet[:-1]) == packet[-1] and _is_sound(packet)

    def decode(self, frame: bytes, stamp: float) -> Samples:
        speed, start = struct.unpack_from("<HH", frame, 2)
        fields = struct.unpack_from("<" + "HB" * READINGS + "HH", frame, 6)
        end, time = fields[-2:]
        step = (end - start) % 36000 / (READINGS - 1)
        turned = tuple([(start + step * i) / 36000 % 1.0 for i in range(READINGS)])
        ranges = tuple([mm / 1000 if mm else math.nan for mm in fields[:-2:2]])
        period = step / 100 / speed if speed else 1.0 / RATE
        return Samples(stamp, time, period, turned, turned, ranges)


def _is_sound(packet: bytearray) -> bool:
    """Return whether the angles are angles and fit the speed; in the manual's example they span twice what the rate gives."""
    (speed, start), (end,) = struct.unpack_from("<HH", packet, 2), struct.unpack_from("<H", packet, SIZE - 5)
    if speed > MOST_SPEED or start >= 36000 or end >= 36000:
        return False
    return bool((end - start) % 36000 <= 100.0 * (3.0 * speed * READINGS / RATE + 1.0))


class LdLidarDriver(SpinningDriver):
    """An LD06, LD19 or STL-19P. Nothing is ever sent."""

    baud = BAUD
    title = "LDROBOT LD06/LD19"

    def __init__(self) -> None:
        clock = DeviceClock(CLOCK_TICK, CLOCK_MODULUS, period=READINGS / RATE)
        super().__init__(LdLidarProtocol(), FAN, clock)
        self._series = Continuity(_follows, "packet whose time", summed=True)

    def take(self, event: Samples) -> list[Action]:
        """Turn packets into scans. One whose time leaps, and the first, count only if the next one goes on from it."""
        return self._series.confirmed(event, 1, super().take)


def _follows(before: Samples, after: Samples) -> bool:
    """Return whether the clock can have gone on so."""
    counted = ((after.clock or 0) - (before.clock or 0)) * CLOCK_TICK
    return device_time(counted, after.stamp - before.stamp, CLOCK_MODULUS * CLOCK_TICK) is not None
