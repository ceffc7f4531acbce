"""Faults on the line: what a bad cable, a bump or a flat battery do to the bytes of a device.

A fault is written ``KIND[=VALUE][@START[+SECONDS]]``; times in s since the emulator started, without them always::

    noise=0.01          one byte in a hundred replaced by a random one
    insert=0.01         a random byte put in after one in a hundred
    drop=0.01           one byte in a hundred lost
    garbage=200         so many random bytes at START
    silent@20+5         the device sends nothing for 5 s
    unplug@20+3         the port vanishes for 3 s
    hang@30             the device answers nothing until it is unplugged
    baud                the host has set another speed: every byte is wrong
    sums=0.1            one scan in ten has a wrong sum            (lidar)
    duplicate=0.05      one frame in twenty comes twice            (lidar; base and tag: the chunk is repeated)
    status=55@10        hardware status instead of scans           (lidar; 21-49 pause with +SECONDS, 50-97 fault)
"""

import math
import random
import re
from dataclasses import dataclass

KINDS = (
    "noise", "insert", "drop", "garbage", "silent", "unplug", "hang", "baud", "sums", "duplicate", "status",
)  # fmt: skip


@dataclass
class Fault:
    """One fault."""

    kind: str
    value: float = 0.0
    start: float = 0.0
    seconds: float = math.inf
    done: bool = False

    def active(self, time: float) -> bool:
        """Return whether it acts at `time` s."""
        return self.start <= time < self.start + self.seconds


def parse_fault(text: str) -> Fault:
    """Read a fault; ValueError says what is wrong."""
    match = re.fullmatch(r"([a-z]+)(?:=([\d.]+))?(?:@([\d.]+)(?:\+([\d.]+))?)?", text)
    if not match or match[1] not in KINDS:
        raise ValueError(f"fault {text!r}: write KIND=VALUE@START+SECONDS with a kind of {', '.join(KINDS)}")
    kind, value, start, seconds = match.groups()
    return Fault(kind, float(value or 0), float(start or 0), float(seconds) if seconds else math.inf)


class FaultyLine:
    """Damages bytes on their way to the host.

    Parameters
    ----------
    faults : what to do.
    seed : of the damage.
    """

    def __init__(self, faults: list[Fault], seed: int = 0) -> None:
        self.faults, self.random = faults, random.Random(seed)
        self.damaged = 0
        """Bytes changed, lost or put in."""

    def share(self, kind: str, time: float) -> float:
        """Return the share of an active fault of this kind, 0 without."""
        return max((f.value for f in self.faults if f.kind == kind and f.active(time)), default=0.0)

    def is_active(self, kind: str, time: float) -> bool:
        """Return whether a fault of this kind acts now."""
        return any(f.kind == kind and f.active(time) for f in self.faults)

    def times(self) -> list[float]:
        """Return the moments at which something begins or ends, s."""
        return [t for f in self.faults for t in (f.start, f.start + f.seconds) if math.isfinite(t)]

    def pass_on(self, data: bytes, time: float, duplicates: bool = True) -> bytes:
        """Return what arrives of `data` sent at `time`."""
        for fault in self.faults:
            if fault.kind == "garbage" and not fault.done and time >= fault.start:
                fault.done = True
                data = self.random.randbytes(int(fault.value)) + data
        if not data:
            return data
        if duplicates and self.random.random() < self.share("duplicate", time):
            data *= 2
        if self.is_active("baud", time):
            self.damaged += len(data)
            return self.random.randbytes(max(1, len(data) // 3))
        noise, insert, drop = (self.share(kind, time) for kind in ("noise", "insert", "drop"))
        if not (noise or insert or drop):
            return data
        out = bytearray()
        for byte in data:
            draw = self.random.random()
            if draw < drop:
                self.damaged += 1
                continue
            if draw < drop + noise:
                byte = self.random.randrange(256)
                self.damaged += 1
            out.append(byte)
            if self.random.random() < insert:
                out.append(self.random.randrange(256))
                self.damaged += 1
        return bytes(out)
