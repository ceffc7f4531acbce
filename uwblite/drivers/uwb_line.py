"""UWB boards that print ranges as text lines: any of them by columns, some by name; `uwb_driver` reads them. Sans-I/O.

Every line may hold several readings. Only two-way ranges from this tag to anchors are taken: positions, time differences
and angles are not ranges, and the ranges that an anchor prints of many tags are not of this robot. Sources: examples of
Makerfabs (DW1000 library, AT firmware), users' programs for the BU01, Qorvo's CLI for the DWM3001CDK as users show it.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass

from ..errors import ConfigError
from .events import RangeReading
from .text_lines import columns_of, number_of

MOST_RANGE = 1000.0
"""m; no UWB radio reaches further."""
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
DAMAGED = "line of ranges cut or garbled"


def _each(whole: str, row: str, part: str, unit: float = 1.0, number: str = "$^") -> Parse:
    """Return what reads lines of one form, all of it or nothing.

    Parameters
    ----------
    whole : form of a line. row : of each range in it, with a group for the anchor and one for the range, empty = none.
    part : what such lines alone hold: another line that has it was one of them.
    unit : m per unit of range. number : of the round, where the line states it.
    """
    whole_form, row_form, part_form, number_form = (re.compile(form) for form in (whole, row, part, number))

    def parse(line: str) -> Ranges | Refused | str | None:
        if whole_form.fullmatch(line):
            stated = number_form.search(line)
            found = tuple(reading(anchor, float(reach) * unit) for anchor, reach in row_form.findall(line) if reach)
            return Ranges(found, round=int(stated[1]) if stated else None)
        if part_form.search(line):
            return DAMAGED
        return Refused("positions or angles") if _NO_RANGE.search(line) else None

    return parse


_NUMBERS = r"((?:-?\d+)?(?:,(?:-?\d+)?)*)"
_AT_RANGE = re.compile(
    rf"AT\+RANGE=tid:(\d+),\s*mask:[0-9A-Fa-f]+,\s*seq:\s*(\d{{1,3}}),\s*range:\s*\({_NUMBERS}\)"
    rf"(?:,\s*rssi:\s*\([-\d.,\s]*\))?(?:,\s*ancid:\s*\({_NUMBERS}\))?(?:,\s*rssi:\s*\([-\d.,\s]*\))?"
)
_AT_PART = re.compile(r"AT.RANGE|tid:|mask:|seq:|ancid|range:")


def _at_range(line: str) -> Ranges | str | None:
    """Read the lists of Makerfabs' AT firmware; a range of 0 is none, without ancid the places in the list are the ids."""
    match = _AT_RANGE.fullmatch(line)
    if match is None:
        return DAMAGED if _AT_PART.search(line) else None
    centimetres = match[3].split(",")
    names = match[4].split(",") if match[4] else [str(i) for i in range(len(centimetres))]
    if len(names) != len(centimetres):
        return "as many ranges as anchors were expected"
    pairs = [(name, int(text)) for name, text in zip(names, centimetres, strict=True) if name and text]
    found = tuple(reading(name, cm / 100) for name, cm in pairs if cm > 0 and int(name) >= 0)
    return Ranges(found, tag=match[1], round=int(match[2]), modulus=256)


_SESSION_ROW = r'\[mac_address=0x([0-9A-Fa-f]{4}), status="[A-Z_]+"(?:, distance\[cm\]=(-?\d+))?(?:, [\w\[\]]+=-?[\d.]+)*\]'
_session = _each(
    rf"(?:SESSION_INFO_NTF: \{{[\w=, ]+)?(?:{_SESSION_ROW}[;}}\s]*)*", _SESSION_ROW,
    "SESSION|session_|mac_addr|status=|distance", 0.01, r"block_index=(\d{1,9})\b",
)  # fmt: skip


def _dwm3001(line: str) -> Ranges | Refused | str | None:
    """Read both forms of Qorvo's CLI."""
    if '"results' not in line and '"Addr"' not in line:
        return _session(line)
    try:
        record = json.loads(line)
        rows = [(str(row["Addr"]), row.get("D_cm") if row["Status"] == "Ok" else None) for row in record["results"]]
        number = int(record["Block"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return DAMAGED
    if not all(re.fullmatch("0x[0-9A-Fa-f]{4}", name) and (cm is None or type(cm) is int) for name, cm in rows):
        return DAMAGED
    return Ranges(tuple(reading(name[2:], cm / 100) for name, cm in rows if cm is not None), round=number)


BOARDS: dict[str, Parse] = {
    # from: 1782\t Range: 3.21 m\t RX power: -65.10 dBm
    "makerfabs": _each(
        r"from:\s*[0-9A-Fa-f]{1,4}\s+Range:\s*-?\d+\.\d+\s*m(?:\s+RX power:\s*(?:-?\d+\.\d+|-?inf|nan|ovf)\s*dBm)?",
        r"from:\s*([0-9A-Fa-f]{1,4})\s+Range:\s*(-?\d+\.\d+)", "from:|Range:|RX power|dBm",
    ),
    # AT+RANGE=tid:0,mask:0F,seq:182,range:(232,401,518,633,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)
    "makerfabs-at": _at_range,
    # an0:1.23m
    "bu01": _each(r"(?:an\d:\d{1,3}\.\d\dm[\s,;]*)+", r"an(\d):(\d{1,3}\.\d\d)m", r"an.?:|\d\.\d\dm|\d:\d+\.\d\d"),
    # {"Block":27, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":245,"CFO_100ppm":87},{"Addr":"0x0002","Status":"Err"}]}
    # SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=2
    #  [mac_address=0x0001, status="SUCCESS", distance[cm]=245];      on lines of their own, or all on one
    "dwm3001": _dwm3001,
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
