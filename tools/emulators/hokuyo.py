"""How Hokuyo's lidars identify themselves, and a real unit's answers from a capture that a user has."""

import gzip
import struct
from dataclasses import dataclass, replace
from pathlib import Path

from uwblite.drivers.scip import Distances, Reply, ScipProtocol

NAMES = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
MODELS = {
    "URG-04LX": (20, 5600, 1024, 44, 725, 384, 600),
    "URG-04LX-UG01": (20, 5600, 1024, 44, 725, 384, 600),
    "UBG-04LX-F01": (20, 5600, 1024, 44, 725, 384, 2142),
    "UHG-08LX": (30, 11000, 1024, 0, 768, 384, 900),
    "UTM-30LX": (23, 60000, 1440, 0, 1080, 540, 2400),
    "UST-10LX": (20, 30000, 1440, 0, 1080, 540, 2400),
    "UST-20LX": (20, 60000, 1440, 0, 1080, 540, 2400),
}
"""Model -> NAMES, as their manuals and users' transcripts have them."""


@dataclass(frozen=True)
class Unit:
    """A unit of some model."""

    model: str = "URG-04LX"
    version: tuple[tuple[str, str], ...] = ()
    """KEY, value of VV; empty = made up."""
    numbers: tuple[int, ...] = MODELS["URG-04LX"]
    """NAMES."""
    answers: tuple[tuple[str, bytes], ...] = ()
    """Request and the whole answer, as a real unit gave it; these are given again byte by byte."""
    values: tuple[int, ...] = ()
    """mm, its scan; empty = what the world looks like."""
    latency: float = 0.0015
    """s between the end of a turn and the first byte of its scan: a real URG-04LX (firmware 3.1.04) answers 101 ms and more
    after a scan's stamp."""

    @property
    def first(self) -> int:
        """First step."""
        return self.numbers[3]

    @property
    def last(self) -> int:
        """Last step."""
        return self.numbers[4]

    @property
    def turn(self) -> float:
        """s."""
        return 60.0 / self.numbers[6]

    @property
    def step_time(self) -> float:
        """s."""
        return self.turn / self.numbers[2]


def model(name: str) -> Unit:
    """Return a unit of a model."""
    return Unit(name, numbers=MODELS[name])


def chunks(path: Path) -> list[tuple[float, bytes]]:
    """Read a capture: records of seconds, microseconds and length, each 32 bits big-endian, and the bytes received."""
    data, found, at = path.read_bytes(), [], 0
    data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    while at + 12 <= len(data):
        seconds, micros, size = struct.unpack_from(">III", data, at)
        found.append((seconds + 1e-6 * micros, data[at + 12 : at + 12 + size]))
        at += 12 + size
    return found


def captured(path: Path) -> Unit:
    """Return the unit of a capture: its answers, its scan, and how late the scan came."""
    protocol, events, raw = ScipProtocol(), [], b""
    for stamp, data in chunks(path):
        events += protocol.feed(data, stamp)
        raw += data
    answers = {part.split(b"\n")[0].decode("ascii", "replace"): part + b"\n\n" for part in raw.split(b"\n\n") if part}
    replies = {event.command: event for event in events if isinstance(event, Reply)}
    (scan,) = [event for event in events if isinstance(event, Distances)]
    fields, info = replies["PP"].fields(), replies["II"]
    unit = Unit(
        fields["MODL"].partition("(")[0], tuple(replies["VV"].fields().items()), tuple(int(fields[name]) for name in NAMES),
        tuple((name, answers[name]) for name in ("VV", "PP") if name in answers), scan.values,
    )  # fmt: skip
    # The clock was read before the first byte of II's answer: the scan is at least so late behind its stamp.
    late = (scan.stamp - info.stamp) - (scan.time - int(info.fields()["TIME"], 16)) / 1000
    return replace(unit, latency=max(0.0, late - unit.turn))
