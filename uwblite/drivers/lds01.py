"""Hitachi-LG HLS-LFCD2, sold as LDS-01: the lidar of the first TurtleBot3. Sans-I/O.

230400 bit/s; ``b`` starts the motor and the stream, ``e`` stops them. Sixty packets a turn, 42 bytes, little-endian::

    FA | A0 + number | speed (2, 0.1 rev/min) | 6 x (intensity (2), range (2, mm), reserved (2)) | sum | sum

Readings are one degree apart, clockwise. The two last bytes are equal; sources differ on how they are computed: the
complement of the sum of the bytes before, or that sum plus one. Both are tried, and a unit that uses neither is accepted
when the bytes are equal. Sources: the maker's driver hls_lfcd_lds_driver (layout, commands; it checks no sum), users'
decoders (sums).
"""

import math
import struct

from .events import Action, Corrupt, Send
from .framing import FixedPackets
from .session import Script
from .spinning import Fan, Samples, SpinningDriver

BAUD = 230400
START, STOP = b"b", b"e"
FIRST, PACKETS, READINGS = 0xA0, 60, 6
DEGREE = 1.0 / 360.0
"""Turns."""
FAN = Fan(360, 0.12, 3.5)
TRUST = 2 * PACKETS
"""Packets with equal last bytes and another sum than the known ones, after which equality is enough: two turns."""


class Lds01Protocol(FixedPackets):
    """Bytes of the lidar in, Samples and Corrupt out."""

    head, size = b"\xfa", 42

    def __init__(self) -> None:
        super().__init__()
        self._other_sums = 0

    def is_good(self, packet: bytearray) -> bool:
        """Return whether it is one of a turn's packets, and ends in two equal bytes."""
        return FIRST <= packet[1] < FIRST + PACKETS and packet[-1] == packet[-2]

    def decode(self, frame: bytes, stamp: float) -> Samples | Corrupt:
        if not self._sum_is_right(frame):
            return Corrupt("packet with a wrong sum")
        (speed,) = struct.unpack_from("<H", frame, 2)
        fields = struct.unpack_from("<" + "HHH" * READINGS, frame, 4)
        first = (frame[1] - FIRST) * READINGS
        turned = tuple([(first + i) * DEGREE for i in range(READINGS)])
        ranges = tuple([mm / 1000 if mm else math.nan for mm in fields[1::3]])
        return Samples(stamp, None, DEGREE * 600.0 / max(speed, 1), turned, turned, ranges)

    def _sum_is_right(self, packet: bytes) -> bool:
        total = sum(packet[:-2])
        if packet[-1] in ((~total) & 0xFF, (total + 1) & 0xFF):
            self._other_sums = 0
            return True
        self._other_sums += 1
        return self._other_sums > TRUST


class Lds01Driver(SpinningDriver):
    """An LDS-01."""

    baud = BAUD
    title = "Hitachi-LG LDS-01"

    def __init__(self) -> None:
        super().__init__(Lds01Protocol(), FAN)
        self._latest: Samples | None = None

    def take(self, event: Samples) -> list[Action]:
        """Turn packets into scans. One counts when the next one's angles follow.

        Where bytes were lost, the beginning of one and the end of another have a right sum once in 128 times.
        """
        before, self._latest = self._latest, event
        if before is None:
            return []
        step = (event.turned[0] - before.turned[-1]) % 1.0
        return super().take(before) if step < 1.5 * DEGREE else [Corrupt("packet before a gap")]

    def start_up(self) -> Script[bool]:
        yield Send(START)
        return True

    def stop(self) -> list[Action]:
        return [Send(STOP)]
