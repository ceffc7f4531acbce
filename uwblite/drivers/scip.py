"""Hokuyo URG-04LX: the SCIP 2.0 protocol, and of SCIP 1.1 what is needed to leave it. Sans-I/O.

A request is two letters, fixed-width decimal parameters and LF. A reply is::

    echo of the request LF | status (2) sum LF | line LF ... | LF

The sum of a line is ``(sum of its bytes & 0x3F) + 0x30``. Numbers are coded six bits a character, most significant
first, each plus 0x30; distances are a run of 2- or 3-character numbers cut into lines of 64 characters, so that values
straddle lines. In the text lines of VV, PP and II the ``;`` before the sum is not summed, and some units print wrong
sums there: those sums are never fatal. Sources: SCIP 2.0 specification C-42-03320B; captures of three units.

Range values below DMIN (20 mm) are codes, not distances: see RANGE_CODES.
"""

import math
import re
from dataclasses import dataclass

from ..errors import ProtocolError
from .events import Corrupt, corrupt

BAUD_RATES = (115200, 19200, 57600, 250000, 500000, 750000)
"""bit/s of the RS-232 port, in the order tried; on USB the rate means nothing."""
TIME_MODULUS = 1 << 24
"""The time stamp is a counter of 24 bit, 1 ms each: it wraps every 4 h 39 min 37 s."""
MAX_LINE = 256
MAX_LINES = 400
LONGEST_ECHO = 40

INF, NAN = math.inf, math.nan

RANGE_CODES: dict[int, tuple[float, str]] = {
    0: (INF, "no echo: nothing within range, or too dark to see"),
    1: (NAN, "low intensity"),
    2: (NAN, "low intensity"),
    3: (NAN, "measurement error"),
    4: (NAN, "measurement error"),
    5: (NAN, "measurement error"),
    6: (INF, "no valid echo; older manuals: possibly beyond 5.7 m"),
    7: (NAN, "too near, or contradicted by its neighbours"),
    8: (NAN, "the two modulation waves disagree in intensity"),
    9: (NAN, "same step failed in the last two scans"),
    **dict.fromkeys(range(10, 18), (NAN, "measurement error")),
    18: (NAN, "strong reflector"),
    19: (NAN, "step cannot be measured"),
}
"""Meaning of range values below DMIN, as REP-117 wants them: +inf = looked and saw nothing, nan = do not use."""

STATUS_BY_COMMAND: dict[str, dict[str, str]] = {
    "BM": {"00": "laser on", "01": "laser malfunction", "02": "laser is on already"},
    "QT": {"00": "laser off, stream stopped"},
    "RS": {"00": "reset"},
    "TM": {"00": "ok", "01": "bad code", "02": "in time-adjust mode already", "03": "left time-adjust mode already",
           "04": "not in time-adjust mode"},
    "SS": {"00": "ok", "01": "not a number", "02": "no such bit rate", "03": "that rate is set already",
           "04": "rate not possible"},
    "CR": {"00": "ok", "01": "not a number", "02": "no such speed", "03": "that speed is set already",
           "04": "speed not possible"},
}  # fmt: skip
STATUS_OF_SCANS = {
    "00": "ok", "01": "start step is not a number", "02": "end step is not a number", "03": "cluster is not a number",
    "04": "end step out of range", "05": "end step is before the start step", "06": "skip is not a number",
    "07": "count is not a number", "10": "laser is off", "98": "resumed after a pause", "99": "data follow",
}  # fmt: skip
STATUS_OF_ALL = {
    "0A": "cannot create the transmission", "0B": "buffer short, or the command was repeated in one batch",
    "0C": "too few parameters", "0D": "too few parameters", "0E": "undefined command", "0F": "undefined command",
    "0G": "string too long", "0H": "string has bad characters", "0I": "in firmware-update mode",
    "0L": "abnormal state", "0M": "unstable",
}  # fmt: skip


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
        """Return the ``KEY:value`` lines of VV, PP and II as a dictionary."""
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
    """mm, one per step or cluster; below DMIN they are RANGE_CODES."""
    start: int
    end: int
    """First and last step."""
    cluster: int
    """Steps merged into one value."""
    remaining: int
    """Scans still to come; 0 in an endless stream."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """What PP says of the unit; defaults are those of the URG-04LX."""

    model: str = "URG-04LX"
    distance_min: int = 20
    distance_max: int = 5600
    """mm."""
    resolution: int = 1024
    """Steps in a full turn."""
    first: int = 44
    last: int = 725
    front: int = 384
    """Steps; `front` looks along the laser's x axis."""
    speed: int = 600
    """rev/min."""

    @property
    def step_angle(self) -> float:
        """Angle between steps, rad."""
        return 2 * math.pi / self.resolution

    @property
    def step_time(self) -> float:
        """Time between steps, s."""
        return 60.0 / self.speed / self.resolution

    @property
    def period(self) -> float:
        """Time of a turn, s."""
        return 60.0 / self.speed


Event = Reply | Distances | Corrupt


# ---- commands


def text_command(name: str) -> bytes:
    """Build a request without parameters.

    Parameters
    ----------
    name : one of VV PP II BM QT RS TM0 TM1 TM2 SCIP2.0.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : not one of these; other commands can hang a URG-04LX until its power is cycled.
    """
    if name not in {"VV", "PP", "II", "BM", "QT", "RS", "TM0", "TM1", "TM2", "SCIP2.0"}:
        raise ProtocolError(f"{name!r} is not a command for a URG-04LX; use VV PP II BM QT RS TM0 TM1 TM2 SCIP2.0")
    return name.encode() + b"\n"


def bit_rate_command(rate: int) -> bytes:
    """Build ``SS``: set the bit rate of the RS-232 port.

    Parameters
    ----------
    rate : bit/s, one of BAUD_RATES.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : a rate that the unit does not have.
    """
    if rate not in BAUD_RATES:
        raise ProtocolError(f"bit rate {rate} is not one of {sorted(BAUD_RATES)}")
    return b"SS%06d\n" % rate


def scan_command(
    start: int = 44, end: int = 725, *, cluster: int = 1, skip: int = 0, count: int | None = 0, wide: bool = True,
    geometry: Geometry | None = None,
) -> bytes:  # fmt: skip
    """Build GD/GS (one scan) or MD/MS (a stream).

    Parameters
    ----------
    start, end : first and last step.
    cluster : steps merged into one value, 0..99 (0 means 1).
    skip : scans left out between two that are sent, 0..9.
    count : scans to send, 0 = until QT; None = GD/GS, one scan now.
    wide : 3 characters a value (up to 5.6 m); False: 2 characters, up to 4.095 m.
    geometry : limits of the unit; default: of the URG-04LX.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : a step, cluster, skip or count that the unit would refuse.
    """
    unit = geometry or Geometry()
    if not unit.first <= start <= end <= unit.last:
        raise ProtocolError(f"steps {start}..{end} are not inside {unit.first}..{unit.last} of the {unit.model}")
    if not 0 <= cluster <= 99 or not 0 <= skip <= 9 or not 0 <= (count or 0) <= 99:
        raise ProtocolError(f"cluster {cluster} (0..99), skip {skip} (0..9) or count {count} (0..99) is out of range")
    letter = "D" if wide else "S"
    if count is None:
        return f"G{letter}{start:04d}{end:04d}{cluster:02d}\n".encode()
    return f"M{letter}{start:04d}{end:04d}{cluster:02d}{skip:01d}{count:02d}\n".encode()


# ---- coding


def checksum(data: bytes) -> int:
    """Return the sum character of a line: ``(sum & 0x3F) + 0x30``."""
    return (sum(data) & 0x3F) + 0x30


def encode_number(value: int, width: int) -> bytes:
    """Code a number in `width` characters of six bits, most significant first."""
    return bytes(((value >> 6 * i) & 0x3F) + 0x30 for i in reversed(range(width)))


def decode_number(data: bytes) -> int:
    """Decode a number of any width."""
    value = 0
    for char in data:
        value = value << 6 | (char - 0x30)
    return value


def decode_values(data: bytes, width: int) -> tuple[int, ...]:
    """Decode joined data characters.

    Parameters
    ----------
    data : characters 0x30..0x6F.
    width : 2 or 3 characters a value.

    Returns
    -------
    tuple of int, mm.
    """
    if width == 2:
        return tuple([(a << 6) + b - 0xC30 for a, b in zip(data[0::2], data[1::2], strict=True)])
    columns = zip(data[0::3], data[1::3], data[2::3], strict=True)
    return tuple([(a << 12) + (b << 6) + c - 0x30C30 for a, b, c in columns])


def to_ranges(values: tuple[int, ...], geometry: Geometry, limit: int | None = None) -> tuple[float, ...]:
    """Convert raw values to metres with REP-117 codes.

    Parameters
    ----------
    values : mm or RANGE_CODES.
    geometry : gives DMIN and DMAX.
    limit : mm, largest value that means something, where it is below DMAX (4095 with 2 characters).

    Returns
    -------
    tuple of float, m; +inf = nothing seen, nan = invalid.
    """
    low, high = geometry.distance_min, min(geometry.distance_max, limit or geometry.distance_max)
    codes = [RANGE_CODES[v][0] if v in RANGE_CODES else NAN for v in range(low)]
    return tuple([codes[v] if v < low else v / 1000 if v < high else INF for v in values])


def parse_geometry(reply: Reply) -> Geometry:
    """Read the reply to PP.

    Parameters
    ----------
    reply : of PP.

    Returns
    -------
    Geometry

    Raises
    ------
    ProtocolError : a field is missing or absurd.
    """
    fields = reply.fields()
    try:
        numbers = {key: int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")}
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"PP: field missing or not a number ({error})") from None
    unit = Geometry(
        fields.get("MODL", "unknown").partition("(")[0], numbers["DMIN"], numbers["DMAX"], numbers["ARES"],
        numbers["AMIN"], numbers["AMAX"], numbers["AFRT"], numbers["SCAN"],
    )  # fmt: skip
    sane = 0 <= unit.distance_min < unit.distance_max and unit.resolution > 0 and unit.speed > 0
    if not (sane and 0 <= unit.first < unit.last <= unit.resolution + unit.front):
        raise ProtocolError(f"PP: absurd geometry {unit}")
    return unit


def status_meaning(command: str, status: str) -> tuple[str, str]:
    """Name a status code.

    Parameters
    ----------
    command : the echo it came with.
    status : two characters.

    Returns
    -------
    kind : "ok", "paused", "resumed", "hardware-fault", "refused" or "scip1".
    text : what it means.
    """
    if len(status) == 1:
        return ("ok", "SCIP 1.1: ok") if status == "0" else ("scip1", "the unit speaks SCIP 1.1; send SCIP2.0")
    known = STATUS_BY_COMMAND.get(command[:2], STATUS_OF_SCANS if command[:1] in "GM" else {})
    text = known.get(status) or STATUS_OF_ALL.get(status)
    if command[:1] in "GM" and status.isdigit():
        number = int(status)
        if 21 <= number <= 49:
            return "paused", f"status {status}: the unit paused to verify itself and comes back by itself"
        if 50 <= number <= 97:
            return "hardware-fault", f"status {status}: hardware fault (laser, motor or the like)"
        if number == 98:
            return "resumed", f"status {status}: {text}"
    good = status in ("00", "99") or (command[:2], status) in {("BM", "02"), ("TM", "02"), ("TM", "03"), ("SS", "03")}
    return "ok" if good else "refused", f"status {status}: {text or 'not in the manual'}"


# ---- decoder

_SCAN_ECHO = re.compile(rb"(M[DS]\d{13}|G[DS]\d{10})(;[A-Za-z0-9 ._+@]{0,16})?$")
_TEXT_ECHO = re.compile(rb"(VV|PP|II|BM|QT|RS|RT|TM[012]|SS\d{6}|CR\d\d|HS[01]|SCIP2\.0|%ST)(;[A-Za-z0-9 ._+@]{0,16})?$")
_WITH_LINES = ("VV", "PP", "II")
_NOT_DATA = bytes(set(range(256)) - set(range(0x30, 0x70)))


class ScipProtocol:
    """Bytes of the sensor in, Reply, Distances and Corrupt out.

    An echo is searched for at the end of every line, so noise before it costs only itself. A frame that does not
    decode is searched for an echo further down, so a frame that broke off does not take the next one with it.
    At most MAX_LINES lines of MAX_LINE bytes are held.
    """

    def __init__(self) -> None:
        self._line = bytearray()
        self._marks: list[tuple[int, float]] = []
        self._frame: list[tuple[float, bytes]] = []
        self._text_owner = ""

    def feed(self, data: bytes, stamp: float) -> list[Event]:
        """Take bytes that arrived at `stamp` s and return the events they complete.

        Parameters
        ----------
        data : bytes from the port.
        stamp : arrival, s, clock of the host.

        Returns
        -------
        list of Reply, Distances or Corrupt.
        """
        events: list[Event] = []
        start = 0
        while start < len(data):
            end = data.find(b"\n", start)
            self._marks.append((len(self._line), stamp))
            self._line += data[start : end if end >= 0 else len(data)]
            if len(self._line) > MAX_LINE:
                self._shorten_line(events)
            if end < 0:
                break
            line = bytes(self._line).rstrip(b"\r")
            self._take_line(line, events)
            self._line.clear()
            self._marks.clear()
            start = end + 1
        return events

    def _shorten_line(self, events: list[Event]) -> None:
        """Give up a line that cannot be one, except its end, which may be the beginning of an echo."""
        if self._frame:
            events.append(corrupt(self._frame[0][1], "frame with a line too long"))
            self._frame = []
        cut = len(self._line) - LONGEST_ECHO
        events.append(corrupt(bytes(self._line[:cut]), "line too long"))
        stamp = self._stamp_at(cut)
        del self._line[:cut]
        self._marks = [(0, stamp)] + [(at - cut, when) for at, when in self._marks if at > cut]

    def _stamp_at(self, offset: int) -> float:
        """Return the arrival of the byte at `offset` of the line; noise before an echo must not lend it its time."""
        return next(when for at, when in reversed(self._marks) if at <= offset)

    def _take_line(self, line: bytes, events: list[Event]) -> None:
        if not line:
            self._close(events)
            return
        echo = _SCAN_ECHO.search(line) or (None if self._frame else _TEXT_ECHO.search(line))
        if echo:
            self._close(events, cut=True)
            if echo.start():
                events.append(corrupt(line[: echo.start()], "noise before an echo"))
            self._frame = [(self._stamp_at(echo.start()), line[echo.start() :])]
        elif self._frame:
            self._frame.append((self._stamp_at(0), line))
            if len(self._frame) > MAX_LINES:
                self._close(events)
        elif self._text_owner and re.match(rb"[A-Z]{4}:", line):
            # Some units print an empty line in the middle of VV; the rest still belongs to it.
            text = line.decode("ascii", "replace")
            events.append(Reply(self._stamp_at(0), self._text_owner, "00", (_strip_sum(text),)))
        else:
            events.append(corrupt(line, "line outside a frame"))

    def _close(self, events: list[Event], cut: bool = False) -> None:
        """Decode the frame held; `cut` says that its closing empty line never came."""
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
        self._text_owner = event.command if isinstance(event, Reply) and event.command in _WITH_LINES else ""
        events.append(event)


def _decode(frame: list[bytes], stamp: float, cut: bool) -> Event:
    """Decode echo, status and lines of one frame."""
    raw = b"\n".join(frame)
    if cut and frame[0] in (b"VV", b"PP", b"II", b"TM1"):
        return corrupt(raw, "frame cut off")
    if len(frame) < 2:
        return corrupt(raw, "echo without a status")
    command, status = frame[0], frame[1]
    if len(status) == 1 and status in b"0123456789ABCDE":
        return Reply(stamp, command.decode("ascii"), status.decode("ascii"), tuple(_text(frame[2:])))
    if len(status) != 3 or not status[:2].isalnum() or checksum(status[:2]) != status[2]:
        return corrupt(raw, "status with a wrong sum")
    code = status[:2].decode("ascii")
    if (command[:1], code) in ((b"G", "00"), (b"M", "99")):
        return _decode_scan(frame, stamp)
    if command[:2] == b"TM" and len(frame) > 2:
        return _decode_time(frame, stamp)
    return Reply(stamp, command.decode("ascii"), code, tuple(_text(frame[2:])))


def _decode_time(frame: list[bytes], stamp: float) -> Event:
    time = frame[2]
    if len(time) != 5 or checksum(time[:4]) != time[4] or time[:4].translate(None, _NOT_DATA) != time[:4]:
        return corrupt(b"\n".join(frame), "time with a wrong sum")
    return Reply(stamp, frame[0].decode("ascii"), frame[1][:2].decode("ascii"), (str(decode_number(time[:4])),))


def _decode_scan(frame: list[bytes], stamp: float) -> Event:
    raw = b"\n".join(frame[:2])
    for line in frame[2:]:
        if checksum(line[:-1]) != line[-1]:
            return corrupt(raw, "data line with a wrong sum")
    if len(frame) < 4 or len(frame[2]) != 5:
        return corrupt(raw, "scan without a time or data")
    data = b"".join([line[:-1] for line in frame[3:]])
    width = 3 if frame[0][1:2] == b"D" else 2
    if data.translate(None, _NOT_DATA) != data or len(data) % width:
        return corrupt(raw, "data characters lost or foreign")
    command = frame[0].decode("ascii").partition(";")[0]
    start, end, cluster = int(command[2:6]), int(command[6:10]), max(1, int(command[10:12]))
    values = decode_values(data, width)
    steps = end - start + 1
    if not steps // cluster <= len(values) <= -(-steps // cluster):
        return corrupt(raw, f"scan with {len(values)} values instead of {steps // cluster}")
    remaining = int(command[13:15]) if command[0] == "M" else 0
    return Distances(stamp, command[:2], decode_number(frame[2][:4]), values, start, end, cluster, remaining)


def _text(lines: list[bytes]) -> list[str]:
    return [_strip_sum(line.decode("ascii", "replace")) for line in lines]


def _strip_sum(line: str) -> str:
    """Cut ``;`` and the sum character off a text line; a line without them is left alone."""
    return line[:-2] if line[-2:-1] == ";" else line
