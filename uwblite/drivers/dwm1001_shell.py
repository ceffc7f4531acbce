"""DWM1001 with PANS R2: the text shell of the UART. Sans-I/O.

Two CR within a second open the shell, ``quit`` leaves it. ``les``, ``lec`` and ``lep`` switch a stream of lines on and,
given again, off; an empty line repeats the last command, so that a "wake-up" CR toggles a stream. A prompt ``dwm> `` has
no line end, so a prompt, an echo or the rest of an escape sequence may be glued to the front of a line, and at 10 Hz
lines are cut and lose or double characters: what does not parse to the last character is Corrupt. Metres, two decimals.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .events import Corrupt, RangeReading, corrupt
from .framing import LineReader, RawLine

ENTER = b"\r\r"
PROMPT = b"dwm> "
MAX_LINE = 512
MAX_RANGE = 200.0
"""m; anything above is a damaged line."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """``dwm> ``: the shell waits for a command."""

    stamp: float


@dataclass(frozen=True, slots=True)
class RangeLine:
    """One line of ``les`` or ``lec``; of ``lec`` also without an anchor."""

    stamp: float
    """s, arrival of its first byte."""
    readings: tuple[RangeReading, ...]
    anchors: tuple[tuple[float, float, float], ...]
    """Configured positions of the anchors, m."""
    position: tuple[float, float, float, int] | None = None
    """The module's estimate x, y, z, m, and quality 0..100; None with fewer than three anchors, or where it found none."""
    source: str = "lec"
    """"lec" or "les"."""


@dataclass(frozen=True, slots=True)
class PositionLine:
    """One line of ``lep``; on a listener it is of another tag."""

    stamp: float
    position: tuple[float, float, float, int]
    """x, y, z, m, and quality 0..100."""


@dataclass(frozen=True, slots=True)
class TextLine:
    """Any other line that the shell prints."""

    stamp: float
    text: str


Event = Prompt | RangeLine | PositionLine | TextLine | Corrupt

COMMANDS = (
    "?", "help", "quit", "ps", "pms", "reset", "si", "ut", "f", "les", "lec", "lep", "utps", "utpg", "nmg", "nmt", "nmtl",
    "nma", "nmi", "nmp", "nmo", "la", "lb", "nls", "aurs", "aurg", "apg", "aps", "acts", "acas", "nis", "scs", "scg", "tlv",
    "av", "aid", "bpc", "stg", "stc", "udi", "uui", "twi", "gc", "gg", "gs", "gt", "frst", "nmb", "akc", "aks", "ans", "ang",
)  # fmt: skip


_NUMBER = r"(-?\d{1,6}\.\d\d)"
_DISTANCE = r"(\d{1,4}\.\d\d)"
_QUALITY = r"(\d{1,3})"
_COORDINATE = r"(-?\d{1,6}\.\d\d|-?nan)"
_ESTIMATE = rf"{_COORDINATE},{_COORDINATE},{_COORDINATE},{_QUALITY}"
"""Of the module's location engine, which may not converge; the ranges beside it are good."""
_BLOCK = re.compile(rf"([0-9A-F]{{4}})\[{_NUMBER},{_NUMBER},{_NUMBER}\]={_DISTANCE}")
_LES = re.compile(
    rf"((?:{_BLOCK.pattern.replace('(', '(?:')} )*{_BLOCK.pattern.replace('(', '(?:')})"
    rf"(?: le_us=\d{{1,9}})?(?: est\[{_ESTIMATE}\])?$"
)
_LEC_ROW = re.compile(rf"AN(\d),([0-9A-F]{{4}}),{_NUMBER},{_NUMBER},{_NUMBER},{_DISTANCE}(?:,|$)")
_POS = re.compile(rf"POS,{_ESTIMATE}$")
_LISTENER = re.compile(rf"POS,\d{{1,3}},([0-9A-F]{{4}}),{_NUMBER},{_NUMBER},{_NUMBER},{_QUALITY},x[0-9a-fA-F]{{2}}$")
_LOG_ROW = re.compile(r"\[\d{6,}\.\d{3} [A-Z]{3}\] ")
_ANSWER = re.compile(
    r"ok$|err(or)?\b|mode: |OUTPUT FRAME|[0-9a-f]{2}( [0-9a-f]{2})*$|x:-?\d+ y:|sensitivity|\*\* |[Uu]sage|uptime"
    r"|DWM1001 |Copyright |License  |Compiled  |Help  |unknown command|Unknown"
)


class ShellProtocol:
    """Bytes of the module in, lines, prompts and Corrupt out. Holds at most one line of MAX_LINE bytes."""

    def __init__(self) -> None:
        self._lines = LineReader(MAX_LINE, ends=(b"\r", b"\n", PROMPT))

    def feed(self, data: bytes, stamp: float) -> list[Event]:
        """Take bytes that arrived at `stamp` s and return the events they complete, in the order of the bytes."""
        events: list[Event] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
                continue
            if line.data.strip():
                events += _parse(line)
            if line.end == PROMPT:
                events.append(Prompt(stamp))
        return events


def _parse(line: RawLine) -> list[Event]:
    """Find what a line holds; the rest of it before that is Corrupt."""
    text = line.data.decode("latin-1").rstrip()
    broken: Corrupt | None = None
    for find in (_find_lec, _find_les, _find_position, _find_text):
        at, event = find(text, line.stamp_at)
        if isinstance(event, Corrupt):
            broken = broken or event
        elif event is not None:
            before = line.data[:at]
            return [*([corrupt(before, "noise before a line")] if before.strip() else []), event]
    return [broken or corrupt(line.data, "not a line of the shell")]


Found = tuple[int, Event | None]
StampAt = Callable[[int], float]


def _find_lec(text: str, stamp_at: StampAt) -> Found:
    start = text.rfind("DIST,")
    if start < 0:
        return 0, None
    bad = corrupt(text.encode("latin-1"), "lec line cut or garbled")
    head = re.match(r"DIST,(?:([1-4]),|(0),?$)", text[start:])
    if not head:
        return start, bad
    at, readings, anchors = start + head.end(), [], []
    for index in range(int(head[1] or 0)):
        row = _LEC_ROW.match(text, at)
        if not row or int(row[1]) != index:
            return start, bad
        readings.append(RangeReading(row[2], float(row[6]), 100))
        anchors.append((float(row[3]), float(row[4]), float(row[5])))
        at = row.end()
    position = None
    if head[1] and (at < len(text) or text.endswith(",")):
        estimate = _POS.match(text, at)
        if not estimate:
            return start, bad
        position = _position(estimate.groups())
    return start, _checked(RangeLine(stamp_at(start), tuple(readings), tuple(anchors), position, "lec"), text)


def _find_les(text: str, stamp_at: StampAt) -> Found:
    match = _LES.search(text)
    if not match:
        cut = "]=" in text or "est[" in text
        return 0, corrupt(text.encode("latin-1"), "les line cut or garbled") if cut else None
    blocks = list(_BLOCK.finditer(text, match.start(1), match.end(1)))
    ids = [block[1] for block in blocks]
    # A line that broke off runs into the next one: the same anchor again begins the newer line.
    first = max((i + 1 for i, name in enumerate(ids) if name in ids[i + 1 :]), default=0)
    blocks = blocks[first:]
    readings = tuple(RangeReading(block[1], float(block[5]), 100) for block in blocks)
    anchors = tuple((float(block[2]), float(block[3]), float(block[4])) for block in blocks)
    position = _position(match.groups()[1:]) if match[2] else None
    start = blocks[0].start()
    return start, _checked(RangeLine(stamp_at(start), readings, anchors, position, "les"), text)


def _checked(line: RangeLine, text: str) -> Event:
    far = any(reading.range > MAX_RANGE for reading in line.readings)
    twice = len({reading.anchor_id for reading in line.readings}) < len(line.readings)
    quality = line.position is not None and line.position[3] > 100
    if far or twice or quality:
        return corrupt(text.encode("latin-1"), "distance, quality or anchors out of range")
    return line


def _find_position(text: str, stamp_at: StampAt) -> Found:
    start = text.rfind("POS,")
    if start < 0:
        return 0, None
    # Behind the rows of a broken lec line a position is the end of that line.
    own = None if "DIST," in text and text[:start].endswith(",") else _POS.match(text, start)
    other = _LISTENER.match(text, start)
    position = _position(own.groups()) if own else _position(other.groups()[1:]) if other else None
    if position is None or position[3] > 100:
        return start, corrupt(text.encode("latin-1"), "lep line cut or garbled")
    return start, PositionLine(stamp_at(start), position)


def _find_text(text: str, stamp_at: StampAt) -> Found:
    row = _LOG_ROW.search(text)
    if row and text[row.start() :].isprintable():
        return row.start(), TextLine(stamp_at(row.start()), text[row.start() :])
    stripped = text.strip()
    known = _ANSWER.match(stripped) or stripped.partition(" ")[0] in COMMANDS
    return 0, TextLine(stamp_at(0), stripped) if known and stripped.isprintable() else None


def _position(groups: Sequence[str]) -> tuple[float, float, float, int] | None:
    if any("nan" in text for text in groups):
        return None
    x, y, z, quality = groups
    return float(x), float(y), float(z), int(quality)


@dataclass(frozen=True, slots=True)
class NodeInfo:
    """The answer of a node to `si`."""

    short_id: str = ""
    """Four hexadecimal digits."""
    pan_id: int | None = None
    firmware: str = ""
    """For example "1.3.0.1"."""
    mode: str = ""
    """"tn" tag, "an" anchor, "ani" initiator."""
    activity: str = ""
    """"act", "pasv" or "off"."""
    connected: bool | None = None
    settings: tuple[tuple[str, str], ...] = ()
    """key, value of the cfg line."""


def parse_node_info(lines: Sequence[str]) -> NodeInfo:
    """Read the lines of `si` (or the one of `nmg`).

    Parameters
    ----------
    lines : text of the TextLine events.

    Returns
    -------
    NodeInfo : fields that did not occur keep their defaults.
    """
    text = "\n".join(lines)
    address, pan = re.search(r"addr=x([0-9A-F]{16})", text), re.search(r"panid=x([0-9A-F]{1,4})", text)
    firmware = re.search(r"fw_ver=x([0-9a-fA-F]{8})", text)
    mode = re.search(r"mode: (\w+) \((\w+)", text)
    joined = re.search(r"uwbmac: (connected|disconnected)", text)
    row = re.search(r"cfg: (.*)", text)
    settings = tuple(re.findall(r"(\w+)=(\S+)", row[1])) if row else ()
    return NodeInfo(
        address[1][-4:] if address else "",
        int(pan[1], 16) if pan else None,
        ".".join(str(b) for b in bytes.fromhex(firmware[1])) if firmware else "",
        mode[1] if mode else "",
        mode[2] if mode else "",
        joined[1] == "connected" if joined else None,
        settings,
    )
