"""Hokuyo URG-04LX: the SCIP 2.0 protocol, and of SCIP 1.1 what is needed to leave it. Sans-I/O.

A request is two letters, fixed-width decimal parameters and LF. A reply is::

    echo of the request LF | status (2) sum LF | line LF ... | LF

The sum of a line is ``(sum of its bytes & 0x3F) + 0x30``. Numbers are coded six bits a character, most significant
first, each plus 0x30; distances are a run of 2- or 3-character numbers cut into lines of 64 characters, so that values
straddle lines. In the text lines of VV, PP and II the ``;`` before the sum is not summed, and some units print wrong
sums there: those sums are never fatal. Sources: SCIP 2.0 specification C-42-03320B; captures of three units.

Range values below DMIN (20 mm) are codes, not distances: see ``scip_commands``, where the requests are too.
"""

import re
from dataclasses import dataclass

from .events import Corrupt
from .framing import LineReader, RawLine

TIME_MODULUS = 1 << 24
"""The time stamp is a counter of 24 bit, 1 ms each: it wraps every 4 h 39 min 37 s."""
MAX_LINE = 256
MAX_LINES = 400
LONGEST_ECHO = 40


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply without distances."""

    stamp: float
    """s, arrival of its first byte."""
    command: str
    """The request as echoed, for example ``PP`` or ``TM1``."""
    status: str
    """Two characters; one character from a unit in SCIP 1.1."""
    lines: tuple[str, ...] = ()
    """Payload lines without sums."""

    def fields(self) -> dict[str, str]:
        return {key: value for key, colon, value in (line.partition(":") for line in self.lines) if colon}


@dataclass(frozen=True, slots=True)
class Distances:
    """The distances of one sweep."""

    stamp: float
    """s, arrival of the reply's first byte."""
    command: str
    """``GD``, ``GS``, ``MD`` or ``MS``."""
    time: int
    """ms, device clock, 0 .. 2**24 - 1, at the first step."""
    values: tuple[int, ...]
    """mm, one per step or cluster; below DMIN they are codes."""
    start: int
    end: int
    """First and last step."""
    cluster: int
    """Steps merged into one value."""
    remaining: int
    """Scans still to come; 0 in an endless stream."""


Event = Reply | Distances | Corrupt


# ---- coding


def checksum(data: bytes) -> int:
    """Return the sum character of a line: ``(sum & 0x3F) + 0x30``."""
    return (sum(data) & 0x3F) + 0x30


def decode_number(data: bytes) -> int:
    value = 0
    for char in data:
        value = value << 6 | (char - 0x30)
    return value


def decode_values(data: bytes, width: int) -> tuple[int, ...]:
    """Decode joined data characters, 0x30..0x6F, 2 or 3 a value."""
    if width == 2:
        return tuple([(a << 6) + b - 0xC30 for a, b in zip(data[0::2], data[1::2], strict=True)])
    columns = zip(data[0::3], data[1::3], data[2::3], strict=True)
    return tuple([(a << 12) + (b << 6) + c - 0x30C30 for a, b, c in columns])


# ---- decoder

_SCAN_ECHO = re.compile(rb"(M[DS]\d{13}|G[DS]\d{10})(;[A-Za-z0-9 ._+@]{0,16})?$")
_TEXT_ECHO = re.compile(rb"(VV|PP|II|BM|QT|RS|RT|TM[012]|SS\d{6}|CR\d\d|HS[01]|SCIP2\.0|%ST)(;[A-Za-z0-9 ._+@]{0,16})?$")
WITH_LINES = ("VV", "PP", "II")
"""Requests that are answered by lines of text."""
_NOT_DATA = bytes(set(range(256)) - set(range(0x30, 0x70)))


class ScipProtocol:
    """Bytes of the sensor in, Reply, Distances and Corrupt out.

    An echo is searched for at the end of every line, so noise before it costs only itself. A frame that does not
    decode is searched for an echo further down, so a frame that broke off does not take the next one with it.
    At most MAX_LINES lines of MAX_LINE bytes are held.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._lines = LineReader(MAX_LINE, keep=LONGEST_ECHO, ends=(b"\n",))
        self._frame: list[tuple[float, bytes]] = []
        self._text_owner = ""

    def feed(self, data: bytes, stamp: float) -> list[Event]:
        events: list[Event] = []
        for line in self._lines.feed(data, stamp):
            if not isinstance(line, Corrupt):
                self._take_line(line, events)
                continue
            if self._frame:
                events.append(Corrupt("frame with a line too long"))
                self._frame = []
            events.append(line)
        return events

    def _take_line(self, line: RawLine, events: list[Event]) -> None:
        data = line.data.rstrip(b"\r")
        if not data:
            self._close(events)
            return
        echo = _SCAN_ECHO.search(data) or (None if self._frame else _TEXT_ECHO.search(data))
        if echo:
            self._close(events, cut=True)
            if echo.start():
                events.append(Corrupt("noise before an echo"))
            self._frame = [(line.stamp_at(echo.start()), data[echo.start() :])]
        elif self._frame:
            self._frame.append((line.stamp_at(0), data))
            if len(self._frame) > MAX_LINES:
                self._close(events)
        elif self._text_owner and re.match(rb"[A-Z]{4}:", data):
            # Some units print an empty line in the middle of VV; the rest still belongs to it.
            text = data.decode("ascii", "replace")
            events.append(Reply(line.stamp_at(0), self._text_owner, "00", (_strip_sum(text),)))
        else:
            events.append(Corrupt("line outside a frame"))

    def _close(self, events: list[Event], cut: bool = False) -> None:
        """Decode the frame held; `cut` : its closing empty line never came."""
        frame, self._frame = self._frame, []
        if not frame:
            return
        event = _decode([line for _, line in frame], frame[0][0], cut)
        if isinstance(event, Corrupt):
            for i in range(1, len(frame) - 1):
                echo = _TEXT_ECHO.search(frame[i][1])
                if echo:
                    later = _decode([frame[i][1][echo.start() :], *(line for _, line in frame[i + 1 :])], frame[i][0], cut)
                    if isinstance(later, Reply):
                        events.append(event)
                        event = later
                        break
        self._text_owner = event.command if isinstance(event, Reply) and event.command in WITH_LINES else ""
        events.append(event)


def _decode(frame: list[bytes], stamp: float, cut: bool) -> Event:
    """Decode echo, status and lines of one frame."""
    if cut and frame[0] in (b"VV", b"PP", b"II", b"TM1"):
        return Corrupt("frame cut off")
    if len(frame) < 2:
        return Corrupt("echo without a status")
    command, status = frame[0], frame[1]
    if len(status) == 1 and status in b"0123456789ABCDE":
        return Reply(stamp, command.decode("ascii"), status.decode("ascii"), tuple(_text(frame[2:])))
    if len(status) != 3 or not status[:2].isalnum() or checksum(status[:2]) != status[2]:
        return Corrupt("status with a wrong sum")
    code = status[:2].decode("ascii")
    if (command[:1], code) in ((b"G", "00"), (b"M", "99")):
        return _decode_scan(frame, stamp)
    if command[:2] == b"TM" and len(frame) > 2:
        return _decode_time(frame, stamp)
    return Reply(stamp, command.decode("ascii"), code, tuple(_text(frame[2:])))


def _decode_time(frame: list[bytes], stamp: float) -> Event:
    time = frame[2]
    if len(time) != 5 or checksum(time[:4]) != time[4] or time[:4].translate(None, _NOT_DATA) != time[:4]:
        return Corrupt("time with a wrong sum")
    return Reply(stamp, frame[0].decode("ascii"), frame[1][:2].decode("ascii"), (str(decode_number(time[:4])),))


def _decode_scan(frame: list[bytes], stamp: float) -> Event:
    for line in frame[2:]:
        if checksum(line[:-1]) != line[-1]:
            return Corrupt("data line with a wrong sum")
    if len(frame) < 4 or len(frame[2]) != 5:
        return Corrupt("scan without a time or data")
    data = b"".join([line[:-1] for line in frame[3:]])
    width = 3 if frame[0][1:2] == b"D" else 2
    if data.translate(None, _NOT_DATA) != data or len(data) % width:
        return Corrupt("data characters lost or foreign")
    command = frame[0].decode("ascii").partition(";")[0]
    start, end, cluster = int(command[2:6]), int(command[6:10]), max(1, int(command[10:12]))
    values = decode_values(data, width)
    steps = end - start + 1
    if not steps // cluster <= len(values) <= -(-steps // cluster):
        return Corrupt(f"scan with {len(values)} values instead of {steps // cluster}")
    remaining = int(command[13:15]) if command[0] == "M" else 0
    return Distances(stamp, command[:2], decode_number(frame[2][:4]), values, start, end, cluster, remaining)


def _text(lines: list[bytes]) -> list[str]:
    return [_strip_sum(line.decode("ascii", "replace")) for line in lines]


def _strip_sum(line: str) -> str:
    """Cut ``;`` and the sum character off a text line; a line without them is left alone."""
    return line[:-2] if line[-2:-1] == ";" else line
