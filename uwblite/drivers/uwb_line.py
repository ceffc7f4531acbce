"""UWB boards that print ranges as text lines: any of them by columns, some by name. Sans-I/O.

Every line may hold several readings. Only two-way ranges from this tag to anchors are taken: positions, time differences
and angles are not ranges, and the ranges that an anchor prints of many tags are not of this robot. Sources: examples of
Makerfabs (DW1000 library, AT firmware), users' programs for the BU01, Qorvo's CLI for the DWM3001CDK as users show it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..errors import ConfigError
from .clock import DeviceClock
from .events import Action, Corrupt, Lost, Note, RangeEpoch, RangeReading, corrupt
from .framing import LineReader
from .session import Driver, Identity, Script, Wait

MAX_LINE = 1024
MOST_RANGE = 1000.0
"""m; no UWB radio hears further."""
NAME = re.compile(r"[A-Za-z0-9_.:-]{1,32}")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Ranges:
    """What a line says."""

    readings: tuple[RangeReading, ...] = ()
    time: float | None = None
    """The board's own time, its own unit; None = not told."""
    tag: str = ""
    """Who measured, where the line says so."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A line that holds something else than ranges."""

    what: str
    """Clause for people."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line that was understood."""

    stamp: float
    """s, arrival of its first byte."""
    content: Ranges | Refused


Parse = Callable[[str], Ranges | Refused | str | None]
"""A line -> what it says; text = why it is damaged; None = not meant for us."""

# ---- boards with a form of their own

_NO_RANGE = re.compile(r"\b(TDOA|PDOA|AOA|POS|position|azimuth|le_us)\b", re.IGNORECASE)


def _each(pattern: str, unit: float) -> Parse:
    """Return what reads every match of a pattern with the groups id and range."""
    form = re.compile(pattern)

    def parse(line: str) -> Ranges | Refused | str | None:
        found = tuple(reading(m["id"], float(m["range"]) * unit) for m in form.finditer(line))
        if found:
            return Ranges(found)
        return Refused("positions or angles") if _NO_RANGE.search(line) else None

    return parse


_NUMBERS = r"((?:-?\d+)?(?:,(?:-?\d+)?)*)"
_AT_RANGE = re.compile(
    rf"AT\+RANGE=tid:(\d+),mask:[0-9A-Fa-f]+,seq:\d+,range:\({_NUMBERS}\)(?:.*?ancid:\({_NUMBERS}\))?"
)


def _at_range(line: str) -> Ranges | str | None:
    """Read the lists of Makerfabs' AT firmware; a range of 0 is none, without ancid the places in the list are the ids."""
    if "AT+RANGE" not in line:
        return None
    match = _AT_RANGE.search(line)
    if match is None:
        return "damaged list of ranges"
    centimetres = match[2].split(",")
    names = match[3].split(",") if match[3] else [str(i) for i in range(len(centimetres))]
    if len(names) != len(centimetres):
        return "as many ranges as anchors were expected"
    pairs = [(name, int(text)) for name, text in zip(names, centimetres, strict=True) if name and text]
    return Ranges(tuple(reading(name, cm / 100) for name, cm in pairs if cm > 0 and int(name) >= 0), tag=match[1])


BOARDS: dict[str, Parse] = {
    # from: 1782	 Range: 3.21 m	 RX power: -65.10 dBm
    "makerfabs": _each(r"from:\s*(?P<id>[0-9A-Fa-f]{1,4})\s+Range:\s*(?P<range>-?\d+\.?\d*)\s*m\b", 1.0),
    # AT+RANGE=tid:0,mask:0F,seq:182,range:(232,401,518,633,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)
    "makerfabs-at": _at_range,
    # an0:1.23m
    "bu01": _each(r"\ban(?P<id>\d+):(?P<range>\d+\.\d+)m", 1.0),
    # [mac_address=0x0001, status="SUCCESS", distance[cm]=245];
    "dwm3001": _each(r'mac_address=0x(?P<id>[0-9A-Fa-f]{4}),\s*status="SUCCESS",\s*distance\[cm\]=(?P<range>-?\d+)', 0.01),
}  # fmt: skip


def reading(anchor: str, metres: float, quality: float = 100.0) -> RangeReading:
    """Return a reading; anchors' names in capitals, as hexadecimal addresses are written."""
    return RangeReading(anchor.upper(), metres, round(min(max(quality, 0.0), 100.0)))


# ---- boards by columns


@dataclass(frozen=True, slots=True)
class LineColumns:
    """How to read a line."""

    columns: tuple[str, ...]
    """``id``, ``range``, ``range:NAME`` (the range to an anchor that has a column of its own), ``t``, ``quality``, ``tag``;
    ``-`` = skip."""
    unit: float = 1.0
    """m per unit of range."""
    prefix: str = ""
    """Text before the columns; lines without it are ignored."""


def parse_columns(columns: str, unit: float, prefix: str) -> LineColumns:
    """Build LineColumns from what a user wrote.

    Raises
    ------
    ConfigError : an unknown column, or no range.
    """
    names = tuple(name.strip() for name in columns.split(","))
    fixed = [name for name in names if name.startswith("range:")]
    unknown = [n for n in names if n not in ("id", "range", "t", "quality", "tag", "-") and n not in fixed]
    twice = [name for name in names if name != "-" and names.count(name) > 1]
    if unknown or twice or any(not NAME.fullmatch(name[6:]) for name in fixed):
        bad = (unknown + twice + fixed)[0]
        raise ConfigError(f"uwb line: column {bad!r}; known are id, range, range:NAME, t, quality, tag, - to skip, each once")
    if not fixed and not {"id", "range"} <= set(names):
        raise ConfigError("uwb line: columns must hold id,range, or one range:NAME for each anchor")
    return LineColumns(names, unit, prefix)


def by_columns(form: LineColumns) -> Parse:
    """Return what reads lines by columns, parted by commas, semicolons or blanks."""

    def parse(line: str) -> Ranges | str | None:
        at = line.rfind(form.prefix) if form.prefix else 0
        if at < 0:
            return None
        fields = re.split(r"[,;\s]+", line[at + len(form.prefix) :].strip(" ,;\t"))
        if len(fields) != len(form.columns):
            return f"{len(fields)} columns instead of {len(form.columns)}"
        values = dict(zip(form.columns, fields, strict=True))
        named = {k: v for k, v in values.items() if k.startswith("range") or k in ("t", "quality")}
        wrong = next((k for k, v in named.items() if not NUMBER.fullmatch(v)), None)
        if wrong or not NAME.fullmatch(values.get("id", "x")):
            return f"column {wrong} is not a number" if wrong else "column id is no name"
        quality = float(values.get("quality", 100.0))
        found = [(k[6:], float(v)) for k, v in values.items() if k.startswith("range:")]
        if "range" in values:
            found.append((values["id"], float(values["range"])))
        readings = tuple(reading(name, value * form.unit, quality) for name, value in found)
        return Ranges(readings, float(values["t"]) if "t" in values else None, values.get("tag", ""))

    return parse


# ---- bytes to events


class UwbLineProtocol:
    """Bytes in, Line and Corrupt out. Holds at most one line of MAX_LINE bytes.

    Parameters
    ----------
    parse : what a line says.
    """

    def __init__(self, parse: Parse) -> None:
        self._parse = parse
        self._lines = LineReader(MAX_LINE)

    def feed(self, data: bytes, stamp: float) -> list[Line | Corrupt]:
        """Take bytes that arrived at `stamp` s and return the events they complete.

        Parameters
        ----------
        data : bytes from the port.
        stamp : arrival, s, clock of the host.

        Returns
        -------
        list of Line or Corrupt.
        """
        events: list[Line | Corrupt] = []
        for line in self._lines.feed(data, stamp):
            if isinstance(line, Corrupt):
                events.append(line)
            elif line.data.strip() and not line.cut:
                events += self._take(line.data.strip(), line.stamp_at(0))
        return events

    def _take(self, data: bytes, stamp: float) -> list[Line | Corrupt]:
        content = self._parse(data.decode("ascii", "replace"))
        if content is None:
            return []
        if isinstance(content, str):
            return [corrupt(data, content)]
        far = isinstance(content, Ranges) and any(abs(r.range) > MOST_RANGE for r in content.readings)
        return [corrupt(data, f"a range beyond {MOST_RANGE:.0f} m")] if far else [Line(stamp, content)]


class UwbLineDriver(Driver):
    """A UWB tag that prints lines. Nothing is ever sent.

    Parameters
    ----------
    parse : what a line says.
    title : of the board, for people.
    baud : bit/s.
    time_unit : s per unit of column t.
    tag : the tag whose ranges to take, where lines name several; "" = the first that is seen.
    """

    def __init__(self, parse: Parse, title: str, baud: int = 115200, time_unit: float = 1.0, tag: str = "") -> None:
        super().__init__()
        self.baud, self._parse, self._title, self._tag = baud, parse, title, tag
        self._protocol = UwbLineProtocol(parse)
        self._clock = DeviceClock(time_unit, proven=False)

    def begin(self) -> None:
        """Forget half a line."""
        self._protocol = UwbLineProtocol(self._parse)

    def parse(self, data: bytes, now: float) -> list[Any]:
        """Return Line and Corrupt."""
        return self._protocol.feed(data, now)

    def script(self) -> Script[None]:
        """Pass over the first line, of which the port may have shown only the end; then listen."""
        yield Wait(None)
        yield from super().script()

    def take(self, event: Line) -> list[Action]:
        """Turn a line into ranges."""
        content = event.content
        if isinstance(content, Refused):
            text = f"uwb: it prints {content.what}, which are no ranges: set it to two-way ranging, and to print distances"
            return self.say_once(Note("error", "uwb-no-ranges", text))
        if content.tag and content.tag != (self._tag or content.tag):
            text = f"uwb: ranges of tag {content.tag} besides those of tag {self._tag} are left out; tag=ID chooses"
            return self.say_once(Note("warning", "uwb-other-tag", text))
        self._tag, self.ready = content.tag or self._tag, True
        if not content.readings:
            return []
        if content.time is None:
            return [RangeEpoch(event.stamp, content.readings)]
        clock = self._clock.read(content.time, event.stamp)
        lost: list[Action] = [Lost(clock.stamp, clock.missing)] if clock.missing else []
        return [*lost, RangeEpoch(clock.stamp, content.readings)]

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity(self._title, (("tag", self._tag),) if self._tag else ())
