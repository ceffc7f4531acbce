"""Text of one record a line, ``TAG [stamp] names... numbers...``, as g2o, TORO and PyFG files are written."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Floats, Ints, Table, concatenated
from ..errors import FormatError
from .source import OVERLONG_LINE, TextSource, number_table

_TAGS_COUNTED = 100
_FARTHEST = 1e9
"""m; no place on Earth is farther. Squares and products of what is measured must stay finite too."""
_MOST = 1e30
"""Of an information or covariance: a femtometre in one direction, a light year in the other."""


@dataclass(frozen=True, slots=True)
class Layout:
    """What stands on a line behind its tag."""

    names: int
    """How many names (vertex ids)."""
    numbers: int
    """How many numbers."""
    stamped: bool = False
    """Whether a time stands before the names."""
    places: int = 0
    """How many of the numbers, from the first on, are places, angles or distances; the others are uncertainties."""
    listed: bool = False
    """Whether a line may hold several names, each a record of its own; it holds nothing else."""


@dataclass(frozen=True, slots=True, eq=False)
class Records(Table):
    """All lines of one tag."""

    lines: Ints
    """(n,) line number in the file."""
    stamps: Floats
    """(n,) s; 0 where lines bear no time."""
    names: Ints
    """(n, names) index into RecordFile.names."""
    numbers: Floats
    """(n, numbers), finite."""

    def __len__(self) -> int:
        return len(self.lines)


@dataclass(slots=True, eq=False)
class RecordFile:
    """A file taken apart."""

    path: str
    names: list[bytes]
    """Every name once, in the order of first appearance."""
    records: dict[str, Records]
    """By tag; every tag asked for is there."""
    skipped: dict[str, int] = field(default_factory=dict)
    """Tags that were not asked for, and how many lines have them."""

    def error(self, problem: str, line: int | None = None) -> FormatError:
        """Return an error that names file and line."""
        return FormatError(problem, self.path, line)


def read_records(source: TextSource, layouts: Mapping[str, Layout]) -> RecordFile:
    """Read all records of a file, in blocks.

    Parameters
    ----------
    layouts : by tag; lines of other tags are counted, comments (#) and blank lines are not.

    Raises
    ------
    FormatError : a line of a known tag has another number of fields, or a number that is none or not finite.
    """
    known = {tag.encode(): layout for tag, layout in layouts.items()}
    parts: dict[bytes, list[Records]] = {tag: [] for tag in known}
    names: dict[bytes, int] = {}
    result = RecordFile(source.path, [], {})
    for block in source.rows():
        rows: dict[bytes, list[tuple[int, list[bytes]]]] = {}
        for number, tokens in block:
            if tokens[0] in known:
                rows.setdefault(tokens[0], []).append((number, tokens))
            else:
                _count(result, tokens[0], number)
        for tag, lines in rows.items():
            parts[tag].append(_table(lines, known[tag], names, result))
    result.names = list(names)
    result.records = {tag.decode(): concatenated(lines or [_nothing(known[tag])]) for tag, lines in parts.items()}
    return result


def _count(result: RecordFile, tag: bytes, line: int) -> None:
    if tag.startswith(OVERLONG_LINE) or not (tag.isascii() and tag.decode().isprintable()):
        raise result.error("this is no graph file: a line begins with binary data or is longer than a megabyte", line)
    name = tag.decode()[:40]
    if name not in result.skipped and len(result.skipped) >= _TAGS_COUNTED:
        name = "others"
    result.skipped[name] = result.skipped.get(name, 0) + 1


def _table(rows: list[tuple[int, list[bytes]]], layout: Layout, names: dict[bytes, int], result: RecordFile) -> Records:
    """Turn the tokens of lines of one tag into arrays."""
    if layout.listed:
        rows = [(line, [tokens[0], *name]) for line, tokens in rows for name in ([[n] for n in tokens[1:]] or [[]])]
    first = 1 + layout.stamped
    width = first + layout.names + layout.numbers
    for line, tokens in rows:
        if len(tokens) != width:
            raise result.error(f"{tokens[0].decode()} has {len(tokens) - 1} fields, expected {width - 1}", line)
    values = number_table([(n, tokens[1:first] + tokens[first + layout.names :]) for n, tokens in rows], result.path)
    most = np.full(values.shape[1], _MOST)
    most[layout.stamped : layout.stamped + layout.places] = _FARTHEST
    far = np.flatnonzero((np.abs(values) > most).any(axis=1))
    if len(far):
        raise result.error("a number is beyond anything that is measured; are the units right?", rows[far[0]][0])
    indices = [[names.setdefault(name, len(names)) for name in tokens[first : first + layout.names]] for _, tokens in rows]
    return Records(
        np.array([line for line, _ in rows], dtype=np.intp),
        values[:, 0] if layout.stamped else np.zeros(len(rows)),
        np.array(indices, dtype=np.intp).reshape(len(rows), layout.names),
        values[:, 1:] if layout.stamped else values,
    )


def _nothing(layout: Layout) -> Records:
    none = np.zeros(0, dtype=np.intp)
    return Records(none, np.zeros(0), none.reshape(0, layout.names), np.zeros((0, layout.numbers)))
