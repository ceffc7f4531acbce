"""UWB tags that only send: boards that print ranges as text lines, any by columns, some by name; and what reads them. Sans-I/O.

Every line may hold several readings. Only two-way ranges from this tag to anchors are taken: positions, time differences
and angles are not ranges, and the ranges that an anchor prints of many tags are not of this robot. Sources: examples of
Makerfabs (DW1000 library, AT firmware), users' programs for the BU01, Qorvo's CLI for the DWM3001CDK as users show it.
"""

import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .continuity import RangeGuard
from .events import Action, Corrupt, Lost, Note, RangeEpoch, RangeReading
from .session import ByteProtocol, Identity
from .text_lines import Line, LineDriver, columns_of, named_columns

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


class Refused:
    """A line that holds positions or angles, and no ranges."""


Parse = Callable[[str], Ranges | Refused | str | None]
"""A line -> its content; text = why it is damaged; None = not meant for us."""

# ---- boards with a form of their own

_NO_RANGE = re.compile(r"\b(TDOA|PDOA|AOA|POS|position|azimuth|le_us)\b", re.IGNORECASE)
DAMAGED = "line of ranges cut or garbled"


def _each(whole: str, row: str, part: str, unit: float = 1.0, number: str = "$^") -> Parse:
    """Return what reads lines of one form, all of it or nothing.

    Parameters
    ----------
    row : of each range in it, with a group for the anchor and one for the range, empty = none; `unit` m.
    part : what such lines alone hold: another line that has it was one of them.
    number : of the round, where the line states it.
    """
    whole_form, row_form, part_form, number_form = (re.compile(form) for form in (whole, row, part, number))

    def parse(line: str) -> Ranges | Refused | str | None:
        if whole_form.fullmatch(line):
            stated = number_form.search(line)
            ranges = tuple(reading(anchor, float(reach) * unit) for anchor, reach in row_form.findall(line) if reach)
            return Ranges(ranges, round=int(stated[1]) if stated else None)
        if part_form.search(line):
            return DAMAGED
        return Refused() if _NO_RANGE.search(line) else None

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
    readings = tuple(reading(name, cm / 100) for name, cm in pairs if cm > 0 and int(name) >= 0)
    return Ranges(readings, tag=match[1], round=int(match[2]), modulus=256)


_SESSION_ROW = r'\[mac_address=0x([0-9A-Fa-f]{4}), status="[A-Z_]+"(?:, distance\[cm\]=(-?\d+))?(?:, [\w\[\]]+=-?[\d.]+)*\]'
_session = _each(
    rf"(?:SESSION_INFO_NTF: \{{[\w=, ]+)?(?:{_SESSION_ROW}[;}}\s]*)*",
    _SESSION_ROW,
    "SESSION|session_|mac_addr|status=|distance",
    0.01,
    r"block_index=(\d{1,9})\b",
)


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
        r"from:\s*([0-9A-Fa-f]{1,4})\s+Range:\s*(-?\d+\.\d+)",
        "from:|Range:|RX power|dBm",
    ),
    # AT+RANGE=tid:0,mask:0F,seq:182,range:(232,401,518,633,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)
    "makerfabs-at": _at_range,
    # an0:1.23m
    "bu01": _each(r"(?:an\d:\d{1,3}\.\d\dm[\s,;]*)+", r"an(\d):(\d{1,3}\.\d\d)m", r"an.?:|\d\.\d\dm|\d:\d+\.\d\d"),
    # {"Block":27, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":245,"CFO_100ppm":87},{"Addr":"0x0002","Status":"Err"}]}
    # SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=2
    #  [mac_address=0x0001, status="SUCCESS", distance[cm]=245];      on lines of their own, or all on one
    "dwm3001": _dwm3001,
}


def reading(anchor: str, metres: float, quality: float = 100.0) -> RangeReading:
    """Return a reading; anchors' names in capitals, as hexadecimal addresses are written."""
    return RangeReading(anchor.upper(), metres, round(min(max(quality, 0.0), 100.0)))


def sound_lines(parse: Parse) -> Parse:
    """Return what reads lines as `parse` does and calls those damaged whose ranges no radio has, or that name an anchor twice:
    the beginning of one and the end of another."""

    def checked(line: str) -> Ranges | Refused | str | None:
        content = parse(line)
        readings = content.readings if isinstance(content, Ranges) else ()
        if any(abs(r.range) > MOST_RANGE for r in readings):
            return f"a range beyond {MOST_RANGE:.0f} m"
        return content if len({r.anchor_id for r in readings}) == len(readings) else DAMAGED

    return checked


# ---- boards by columns


def by_columns(columns: str, unit: float = 1.0, prefix: str = "") -> Parse:
    """Return what reads lines by columns, parted by commas, semicolons or blanks.

    Parameters
    ----------
    columns : ``id``, ``range``, ``range:NAME`` (the range to an anchor that has a column of its own), ``t``, ``quality``,
        ``tag``, parted by commas; ``-`` = skip.
    unit : m per unit of range.
    prefix : text before the columns; lines without it are ignored.

    Raises
    ------
    ConfigError : an unknown column, or no range.
    """
    names = named_columns(columns, ("id", "range", "range:", "t", "quality", "tag"), "uwb line")
    ranges = [name for name in names if name.startswith("range")]
    fixed = [name for name in ranges if ":" in name]
    if bad := next((name for name in fixed if not NAME.fullmatch(name[6:])), ""):
        raise ConfigError(f"uwb line: column {bad!r}: NAME in range:NAME is up to 32 letters, digits and _ . : -")
    if not {"id", "range"} <= set(names) and ("range" in names or not fixed):
        raise ConfigError("uwb line: columns must hold id,range, or one range:NAME for each anchor")

    def parse(line: str) -> Ranges | str | None:
        values = columns_of(line, names, prefix, ("id", "tag"))
        if values is None or isinstance(values, str):
            return values
        if not NAME.fullmatch(values.get("id", "x")):
            return "column id is no name"
        quality = values.get("quality", 100.0)
        readings = tuple(reading(name[6:] or values["id"], values[name] * unit, quality) for name in ranges)
        return Ranges(readings, values.get("t"), values.get("tag", ""))

    return parse


MOST_LEAP, NEAR = 100_000, 3
"""Rounds that may be lost together; rounds within which the next one must follow a leap, as a damaged digit leaps too."""
FASTER = 2.0
"""Times the mean rate at which the board counts rounds, for those that are missing."""
OTHER_TAG = "line of a tag that was seen once"
MUCH = 50
"""Rounds in a row without a range after which it is reported."""


class UwbDriver(LineDriver):
    """A UWB tag that sends its ranges unasked. Nothing is ever sent.

    Of several tags in its lines `tag` counts; "" = the first that is seen twice.
    """

    def __init__(self, protocol: ByteProtocol, title: str, baud: int, clock: DeviceClock, tag: str = "") -> None:
        super().__init__(protocol, title, baud, clock)
        self.first_is_whole = clock.proven
        self._tag, self._leap, self._empty = tag, 0, 0
        self._tags: Counter[str] = Counter()
        self._first: Line | None = None
        """The line of a tag that was seen once."""
        self._round: int | None = None
        self._rounds, self._took, self._latest = 0, 0.0, 0.0
        """Rounds between lines with neighbouring numbers, and the time that they took, s; s, arrival of the last line."""
        self._guard = RangeGuard(self.health)

    def time_of(self, content: Ranges | Refused) -> float | None:
        return content.time if isinstance(content, Ranges) else None

    def members(self, event: Line | Corrupt) -> tuple[str, ...]:
        """Return the anchors of a line: some boards print one line for each."""
        content = event.content if isinstance(event, Line) else None
        return tuple(f"{content.tag}/{r.anchor_id}" for r in content.readings) if isinstance(content, Ranges) else ()

    def measured(self, line: Line) -> list[Action]:
        if isinstance(line.content, Refused):
            text = "uwb: it prints positions or angles, which are no ranges: set it to two-way ranging, and to print distances"
            return self.say_once(Note("error", "uwb-no-ranges", text))
        tag = line.content.tag
        if not tag or tag == self._tag:
            return self._ranges(line)
        self._tags[tag] += 1
        if self._tags[tag] == 1:  # its name may be damaged
            dropped: list[Action] = [Corrupt(OTHER_TAG)] if self._tag or self._first else []
            self._first = self._first if self._tag else line
            return dropped
        if self._tag:
            text = f"uwb: ranges of tag {tag} besides those of tag {self._tag} are left out; tag=ID chooses"
            return self.say_once(Note("warning", "uwb-other-tag", text))
        self._tag, first, self._first = tag, self._first, None
        ours = [first] if first is not None and first.content.tag == tag else []
        left: list[Action] = [Corrupt(OTHER_TAG)] * (first is not None and not ours)
        return left + [action for each in (*ours, line) for action in self._ranges(each)]

    def _ranges(self, line: Line) -> list[Action]:
        self.ready, content = True, line.content
        actions: list[Action] = [Lost(count)] if (count := self._missed(content, line.stamp)) else []
        stamp, _, lost = self.timed(line)
        actions += lost
        self._empty = 0 if content.readings else self._empty + 1
        if self._empty == MUCH:
            text = "uwb: rounds come, but without ranges: set tag and anchors to two-way ranging, not to time differences"
            actions += self.say_once(Note("warning", "uwb-no-ranges", text))
        return [*actions, *self._guard.take(RangeEpoch(stamp, content.readings), line.stamp)]

    def _missed(self, line: Ranges, stamp: float) -> int:
        """Return how many rounds were missed before the line before this one, by their numbers; 0 where the board restarted."""
        if line.round is None:
            return 0
        before, pause, usual = self._round, stamp - self._latest, self._took / max(self._rounds, 1)
        self._round, self._latest = line.round, stamp
        step = 1 if before is None else line.round - before
        step = step % line.modulus if line.modulus else step
        if before is not None and 0 < step <= NEAR:
            self._rounds, self._took = self._rounds + step, self._took + pause
        # A number that wraps leaps ahead where the board restarted, too, but there was no time for so many rounds.
        possible = step <= MOST_LEAP and (not line.modulus or (step - NEAR) * usual <= FASTER * pause)
        leap, self._leap = self._leap, step - 1 if step > 1 and possible else 0
        return leap if 0 < step <= NEAR else 0

    def stop(self) -> list[Action]:
        return [*super().stop(), *[Corrupt(OTHER_TAG)] * (self._first is not None), *self._guard.finish()]

    def identity(self) -> Identity:
        return Identity(self.title, (("tag", self._tag),) if self._tag else ())
