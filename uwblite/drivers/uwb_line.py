"""UWB boards that print ranges as text lines: any of them by columns, some by name. Sans-I/O.

Every line may hold several readings. Only two-way ranges from this tag to anchors are taken: positions, time differences
and angles are not ranges, and the ranges that an anchor prints of many tags are not of this robot. Sources: examples of
Makerfabs (DW1000 library, AT firmware), users' programs for the BU01, Qorvo's CLI for the DWM3001CDK as users show it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from ..errors import ConfigError
from .events import Action, Corrupt, Lost, Note, RangeEpoch, RangeReading
from .session import Identity
from .text_lines import Line, LineDriver, columns_of, number_of

MOST_RANGE = 1000.0
"""m; no UWB radio reaches further."""
MOST_LEAP, NEAR = 100_000, 3
"""Rounds that may be lost together; rounds within which the next one must follow a leap, as a damaged digit leaps too."""
NAME = re.compile(r"[A-Za-z0-9_.:-]{1,32}")


@dataclass(frozen=True, slots=True)
class Ranges:
    """The content of a line."""

    readings: tuple[RangeReading, ...] = ()
    time: float | None = None
    """The board's own time, its own unit; None = not sent."""
    tag: str = ""
    """Who measured, where the line contains it."""
    round: int | None = None
    """Number of the ranging round; None = not sent."""
    modulus: int = 0
    """It wraps there; 0 = it does not."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A line that holds something else than ranges."""

    what: str
    """Clause for people."""


Parse = Callable[[str], Ranges | Refused | str | None]
"""A line -> its content; text = why it is damaged; None = not meant for us."""

# ---- boards with a form of their own

_NO_RANGE = re.compile(r"\b(TDOA|PDOA|AOA|POS|position|azimuth|le_us)\b", re.IGNORECASE)


def _each(pattern: str, unit: float, number: str = "$^") -> Parse:
    """Return what reads every match of a pattern with the groups id and range, and the number of the round."""
    form, numbered = re.compile(pattern), re.compile(number)

    def parse(line: str) -> Ranges | Refused | str | None:
        found = tuple(reading(m["id"], float(m["range"]) * unit) for m in form.finditer(line))
        if found:
            stated = numbered.search(line)
            return Ranges(found, round=int(stated[1]) if stated else None)
        return Refused("positions or angles") if _NO_RANGE.search(line) else None

    return parse


_NUMBERS = r"((?:-?\d+)?(?:,(?:-?\d+)?)*)"
_AT_RANGE = re.compile(
    rf"AT\+RANGE=tid:(\d+),\s*mask:[0-9A-Fa-f]+,\s*seq:\s*(\d{{1,3}}),\s*range:\s*\({_NUMBERS}\)(?:.*?ancid:\s*\({_NUMBERS}\))?"
)


def _at_range(line: str) -> Ranges | str | None:
    """Read the lists of Makerfabs' AT firmware; a range of 0 is none, without ancid the places in the list are the ids."""
    if "AT+RANGE" not in line:
        return None
    match = _AT_RANGE.search(line)
    if match is None:
        return "damaged list of ranges"
    centimetres = match[3].split(",")
    names = match[4].split(",") if match[4] else [str(i) for i in range(len(centimetres))]
    if len(names) != len(centimetres):
        return "as many ranges as anchors were expected"
    pairs = [(name, int(text)) for name, text in zip(names, centimetres, strict=True) if name and text]
    found = tuple(reading(name, cm / 100) for name, cm in pairs if cm > 0 and int(name) >= 0)
    return Ranges(found, tag=match[1], round=int(match[2]), modulus=256)


BOARDS: dict[str, Parse] = {
    # from: 1782	 Range: 3.21 m	 RX power: -65.10 dBm
    "makerfabs": _each(r"from:\s*(?P<id>[0-9A-Fa-f]{1,4})\s+Range:\s*(?P<range>-?\d+\.?\d*)\s*m\b", 1.0),
    # AT+RANGE=tid:0,mask:0F,seq:182,range:(232,401,518,633,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)
    "makerfabs-at": _at_range,
    # an0:1.23m
    "bu01": _each(r"\ban(?P<id>\d+):(?P<range>\d+\.\d+)m", 1.0),
    # {"Block":27, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":245,"CFO_100ppm":87},{"Addr":"0x0002","Status":"Err"}]}
    # [mac_address=0x0001, status="SUCCESS", distance[cm]=245];
    "dwm3001": _each(
        r'(?:"Addr"\s*:\s*"|mac_address=)0x(?P<id>[0-9A-Fa-f]{4})"?\s*,\s*"?[Ss]tatus"?\s*[:=]\s*"(?:Ok|SUCCESS)"\s*,'
        r'\s*(?:"D_cm"\s*:|distance\[cm\]=)\s*(?P<range>-?\d+)', 0.01, r'(?:"Block"\s*:|block_index=)\s*(\d{1,9})\b',
    ),
}  # fmt: skip


def reading(anchor: str, metres: float, quality: float = 100.0) -> RangeReading:
    """Return a reading; anchors' names in capitals, as hexadecimal addresses are written."""
    return RangeReading(anchor.upper(), metres, round(min(max(quality, 0.0), 100.0)))


def within_reach(parse: Parse) -> Parse:
    """Return what reads lines as `parse` does and calls those damaged whose ranges no radio has."""

    def checked(line: str) -> Ranges | Refused | str | None:
        content = parse(line)
        far = isinstance(content, Ranges) and any(abs(r.range) > MOST_RANGE for r in content.readings)
        return f"a range beyond {MOST_RANGE:.0f} m" if far else content

    return checked


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
        values = columns_of(line, form.columns, form.prefix)
        if values is None or isinstance(values, str):
            return values
        if not NAME.fullmatch(values.get("id", "x")):
            return "column id is no name"
        numbers = {k: number_of(v) for k, v in values.items() if k not in ("id", "tag")}
        wrong = next((k for k, v in numbers.items() if v is None), None)
        if wrong:
            return f"column {wrong} is not a number"
        quality = numbers.get("quality") or 0.0 if "quality" in numbers else 100.0
        found = [(k[6:] or values["id"], v) for k, v in numbers.items() if k.startswith("range") and v is not None]
        return Ranges(tuple(reading(k, v * form.unit, quality) for k, v in found), numbers.get("t"), values.get("tag", ""))

    return parse


class UwbLineDriver(LineDriver):
    """A UWB tag that prints lines. Nothing is ever sent.

    Parameters
    ----------
    parse : a line -> its content.
    title : of the board, for people.
    baud : bit/s.
    time_unit : s per unit of column t.
    tag : the tag whose ranges to take, where lines name several; "" = the first that is seen.
    """

    def __init__(self, parse: Parse, title: str, baud: int = 115200, time_unit: float = 1.0, tag: str = "") -> None:
        super().__init__(within_reach(parse), title, baud, time_unit)
        self._tag, self._leap = tag, 0
        self._round: int | None = None

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
        missed: list[Action] = [Lost(event.stamp, count)] if (count := self._missed(content)) else []
        if not content.readings:
            return missed
        if self.leaps(content.time, event.stamp):
            return [Corrupt(b"", "line whose time leaps")]
        stamp, _, lost = self.timed(content.time, event.stamp)
        return [*missed, *lost, RangeEpoch(stamp, content.readings)]

    def _missed(self, line: Ranges) -> int:
        """Return how many rounds were missed before the line before this one, by their numbers; 0 where the board restarted."""
        if line.round is None:
            return 0
        step = 1 if self._round is None else line.round - self._round
        step = step % line.modulus if line.modulus else step
        leap, self._leap, self._round = self._leap, step - 1 if 1 < step <= MOST_LEAP else 0, line.round
        return leap if 0 < step <= NEAR else 0

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity(self.title, (("tag", self._tag),) if self._tag else ())
