"""Emulated UWB boards that only talk: Makerfabs, BU01, BU03, DWM3001CDK, LinkTrack, and lines of columns."""

import math
import struct
from collections.abc import Iterator

from .world import Epoch, Feed, WorldClock


class UwbBoard:
    """A tag.

    Parameters
    ----------
    epochs : ranging rounds to play.
    clock : world time.
    write : (epoch, number, ms since power-up) -> bytes.
    on_fix : called with (host time, readings) for each round.
    """

    def __init__(self, epochs: Iterator[Epoch], clock: WorldClock, write, on_fix=None) -> None:
        self._feed, self._clock, self._write = Feed(epochs), clock, write
        self._on_fix = on_fix or (lambda *_: None)
        self._number = 0
        self.power_up(0.0)

    def power_up(self, now: float) -> None:
        """Start again."""
        self._power = now
        self.asked = True

    def next_time(self, now: float) -> float:
        """Return when the next round is over, host s."""
        return self._clock.host(self._feed.head.time) if self._feed.head is not None else math.inf

    def receive(self, data: bytes, now: float) -> bytes:
        """Ignore what the host sends."""
        return b""

    def advance(self, now: float) -> bytes:
        """Return what was ranged up to host time `now`."""
        out = b""
        while self._feed.head is not None and (due := self._clock.host(self._feed.head.time)) <= now:
            epoch = self._feed.pop()
            self._number += 1
            self._on_fix(due, answered(epoch, self._number) if self._write is dwm3001 else epoch.readings)
            out += self._write(epoch, self._number, math.floor(1000 * (due - self._power)))
        return out


def slots(epoch: Epoch) -> list[int]:
    """Return mm by the number of the anchor, 0..7, 0 = none; boards that number their anchors take the last hex digit."""
    found = [0] * 8
    for address, mm, _ in epoch.readings:
        found[address % 8] = mm
    return found


def makerfabs(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write as the DW1000 example of Makerfabs prints."""
    rows = (f"from: {a:X}\t Range: {mm / 1000:.2f} m\t RX power: -65.10 dBm\r\n" for a, mm, _ in epoch.readings)
    return "".join(rows).encode()


def makerfabs_at(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write as the AT firmware of Makerfabs does."""
    found = slots(epoch)
    ranges, ids = ",".join(str(round(mm / 10)) for mm in found), ",".join(str(i if mm else -1) for i, mm in enumerate(found))
    return f"AT+RANGE=tid:0,mask:0F,seq:{number % 256},range:({ranges}),ancid:({ids})\r\n".encode()


def bu01(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write as a BU01 does."""
    return "".join(f"an{i}:{mm / 1000:.2f}m\r\n" for i, mm in enumerate(slots(epoch)) if mm).encode()


def answered(epoch: Epoch, number: int) -> list[tuple[int, int, int]]:
    """Return the readings of a round of a DWM3001CDK: in every tenth one anchor does not answer."""
    return epoch.readings[1:] if number % 10 == 0 else epoch.readings


def dwm3001(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write as the CLI firmware of the DWM3001CDK does."""
    angles = '"LPDoA_deg":0.00,"LAoA_deg":0.00,"LFoM":0,"RAoA_deg":0.00,"CFO_100ppm":622'
    rows = [f'{{"Addr":"0x{a:04X}","Status":"Ok","D_cm":{round(mm / 10)},{angles}}}' for a, mm, _ in epoch.readings]
    if len(answered(epoch, number)) < len(rows):
        rows[0] = rows[0].partition("Ok")[0] + 'Err"}'
    return f'{{"Block":{number}, "results":[{",".join(rows)}]}}\r\n'.encode()


def bu03(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write as a BU03 does."""
    return b"\xaa\x25\x01" + struct.pack("<8I", *slots(epoch)) + b"\x00\x55"


def linktrack(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write a Tag_Frame0 of a LinkTrack."""
    frame = bytearray(128)
    frame[:4] = b"\x55\x01\x00\x02"
    for i, mm in enumerate(slots(epoch)):
        frame[22 + 3 * i : 25 + 3 * i] = mm.to_bytes(3, "little", signed=True)
    frame[108:112] = ms.to_bytes(4, "little")
    frame[127] = sum(frame[:-1]) & 0xFF
    return bytes(frame)


def columns(epoch: Epoch, number: int, ms: int) -> bytes:
    """Write lines of time (ms), anchor, range (mm), quality."""
    return "".join(f"UWB {ms};{a:04X};{mm};{q}\n" for a, mm, q in epoch.readings).encode()


BOARDS = {
    "makerfabs": makerfabs, "makerfabs-at": makerfabs_at, "bu01": bu01, "bu03": bu03, "dwm3001": dwm3001,
    "linktrack": linktrack, "line": columns,
}  # fmt: skip
"""Name of the kind, as `uwblite record` has it -> what it writes."""
