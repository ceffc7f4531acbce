"""DWM1001 with PANS R2: the text shell of the UART. Sans-I/O.

Two CR within a second open the shell, ``quit`` leaves it. ``les``, ``lec`` and ``lep`` switch a stream of lines on and,
given again, off; an empty line repeats the last command, so that a "wake-up" CR toggles a stream. A prompt ``dwm> `` has
no line end, so a prompt, an echo or the rest of an escape sequence may be glued to the front of a line, and at 10 Hz
lines are cut and lose or double characters: what does not parse to the last character is Corrupt. Metres, two decimals.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .dwm1001_tlv import ACTIVE, JOINED, Fact, NodeConfig, Status, UpdateRate, Value
from .events import Corrupt, RangeReading
from .framing import LineReader, RawLine

ENTER = b"\r\r"
PROMPT = b"dwm> "
MAX_LINE = 512
MAX_RANGE = 200.0
"""m; anything above is a damaged line."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """``dwm> ``: the shell waits for a command."""


@dataclass(frozen=True, slots=True)
class RangeLine:
    """One line of ``les`` or ``lec``; of ``lec`` also without an anchor."""

    stamp: float
    """s, arrival of its first byte."""
    readings: tuple[RangeReading, ...]
    source: str = "lec"
    """"lec" or "les"."""


@dataclass(frozen=True, slots=True)
class PositionLine:
    """One line of ``lep``; on a listener it is of another tag."""


@dataclass(frozen=True, slots=True)
class TextLine:
    """Any other line that the shell prints."""

    text: str


Event = Prompt | RangeLine | PositionLine | TextLine | Corrupt

_COMMAND = re.compile(
    r"\?|help|quit|ps|pms|reset|si|ut|f|le[scp]|utp[sg]|nm[gtaipob]|nmtl|l[ab]|nls|aur[sg]|ap[gs]|ac[ta]s|nis|sc[sg]|tlv|av|aid|bpc"
    r"|st[gc]|udi|uui|twi|g[cgst]|frst|ak[cs]|an[sg]"
)
_NUMBER, _DISTANCE, _QUALITY = r"-?\d{1,6}\.\d\d", r"(\d{1,4}\.\d\d)", r"(?:100|\d{1,2})"
_PLACE = f"{_NUMBER},{_NUMBER},{_NUMBER}"
_ESTIMATE = rf"(?:(?:{_NUMBER}|-?nan),){{3}}{_QUALITY}"
"""Of the module's location engine, which may not converge; the ranges beside it are good."""
_BLOCK = re.compile(rf"([0-9A-F]{{4}})\[{_PLACE}\]={_DISTANCE}")
_BLOCKS = _BLOCK.pattern.replace("(", "(?:")
_LES = re.compile(rf"((?:{_BLOCKS} )*{_BLOCKS})(?: le_us=\d{{1,9}})?(?: est\[{_ESTIMATE}\])?$")
_LEC_ROW = re.compile(rf"AN(\d),([0-9A-F]{{4}}),{_PLACE},{_DISTANCE}(?:,|$)")
_LEC_END = re.compile(rf"POS,{_ESTIMATE}$")
_POS = re.compile(rf"POS,{_PLACE},{_QUALITY}$")
_LISTENER = re.compile(rf"POS,\d{{1,3}},[0-9A-F]{{4}},{_PLACE},{_QUALITY},x[0-9a-fA-F]{{2}}$")
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
        events: list[Event] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
                continue
            if line.data.strip():
                events += _parse(line)
            if line.end == PROMPT:
                events.append(Prompt())
        return events


def _parse(line: RawLine) -> list[Event]:
    """Find what a line holds; the rest of it before that is Corrupt."""
    text = line.data.decode("latin-1").rstrip()
    broken: Corrupt | None = None
    for find in (_find_lec, _find_les, _find_position, _find_text):
        start, event = find(text, line.stamp_at)
        if isinstance(event, Corrupt):
            broken = broken or event
        elif event is not None:
            return [*([Corrupt("noise before a line")] if line.data[:start].strip() else []), event]
    return [broken or Corrupt("not a line of the shell")]


Found = tuple[int, Event | None]
StampAt = Callable[[int], float]


def _find_lec(text: str, stamp_at: StampAt) -> Found:
    start = text.rfind("DIST,")
    if start < 0:
        return 0, None
    bad = Corrupt("lec line cut or garbled")
    head = re.match(r"DIST,(?:([1-4]),|(0),?$)", text[start:])
    if not head:
        return start, bad
    place, readings = start + head.end(), []
    for index in range(int(head[1] or 0)):
        row = _LEC_ROW.match(text, place)
        if not row or int(row[1]) != index:
            return start, bad
        readings.append(RangeReading(row[2], float(row[3]), 100))
        place = row.end()
    if head[1] and (place < len(text) or text.endswith(",")) and not _LEC_END.match(text, place):
        return start, bad
    return start, _checked(RangeLine(stamp_at(start), tuple(readings), "lec"))


def _find_les(text: str, stamp_at: StampAt) -> Found:
    match = _LES.search(text)
    if not match:
        cut = "]=" in text or "est[" in text
        return 0, Corrupt("les line cut or garbled") if cut else None
    blocks = list(_BLOCK.finditer(text, match.start(1), match.end(1)))
    ids = [block[1] for block in blocks]
    # A line that broke off runs into the next one: the same anchor again begins the newer line.
    first = max((i + 1 for i, name in enumerate(ids) if name in ids[i + 1 :]), default=0)
    readings = tuple(RangeReading(block[1], float(block[2]), 100) for block in blocks[first:])
    start = blocks[first].start()
    return start, _checked(RangeLine(stamp_at(start), readings, "les"))


def _checked(line: RangeLine) -> Event:
    far = any(reading.range > MAX_RANGE for reading in line.readings)
    if far or len({reading.anchor_id for reading in line.readings}) < len(line.readings):
        return Corrupt("distance or anchors out of range")
    return line


def _find_position(text: str, _stamp_at: StampAt) -> Found:
    start = text.rfind("POS,")
    if start < 0:
        return 0, None
    # Behind the rows of a broken lec line a position is the end of that line.
    if _LISTENER.match(text, start) or (_POS.match(text, start) and not ("DIST," in text and text[:start].endswith(","))):
        return start, PositionLine()
    return start, Corrupt("lep line cut or garbled")


def _find_text(text: str, _stamp_at: StampAt) -> Found:
    row = _LOG_ROW.search(text)
    if row and text[row.start() :].isprintable():
        return row.start(), TextLine(text[row.start() :])
    stripped = text.strip()
    known = _ANSWER.match(stripped) or _COMMAND.fullmatch(stripped.partition(" ")[0])
    return 0, TextLine(stripped) if known and stripped.isprintable() else None


ACTIVITY = {"off": 0, "pasv": 1, "act": ACTIVE}
"""Of the radio: ``uwb_mode`` of a configuration."""


def node_facts(lines: Sequence[str]) -> list[Fact]:
    """Return what the text lines of `si` (or the one of `nmg`) say of a node, as its binary interface answers it."""
    text = "\n".join(lines)
    numbers = {"node_id": r"addr=x([0-9A-F]{16})", "pan_id": r"panid=x([0-9A-F]{1,4})", "firmware": r"fw_ver=x([0-9a-fA-F]{8})"}
    matches = {name: re.search(form, text) for name, form in numbers.items()}
    facts: list[Fact] = [Value(name, int(match[1], 16)) for name, match in matches.items() if match]
    if joined := re.search(r"uwbmac: (connected|disconnected)", text):
        facts.append(Status(JOINED if joined[1] == "connected" else 0))
    row, mode = re.search(r"cfg: (.*)", text), re.search(r"mode: (\w+) \((\w+)", text)
    settings: dict[str, str] = dict(re.findall(r"(\w+)=(\S+)", row[1])) if row else {}
    anchor, activity = (mode[1] != "tn", ACTIVITY.get(mode[2], 0)) if mode else (False, ACTIVE)
    facts.append(NodeConfig(anchor, settings.get("stat_det") == "1", settings.get("lp") == "1", activity))
    normal = settings.get("upd_rate_norm", "1")
    return [*facts, UpdateRate(int(normal) / 10, int(normal) / 10)] if normal.isdecimal() else facts
