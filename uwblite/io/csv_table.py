"""Small tables with a header line: truth and results as comma-separated text, columns found by name."""

import csv
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..errors import FormatError
from .source import open_source


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """A table read from a file."""

    path: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """1-based line number of each row."""

    def texts(self, column: str, *, default: str | None = None) -> tuple[str, ...]:
        """Return a column as text; `default` stands for one that is absent, None = it must be there."""
        if column in self.header:
            place = self.header.index(column)
            return tuple(row[place] for row in self.rows)
        if default is None:
            raise FormatError(f"has no column {column!r}; its header is {','.join(self.header)!r}", self.path, 1)
        return (default,) * len(self.rows)

    def numbers(self, *columns: str, default: float | None = None) -> Floats:
        """Return columns as numbers (rows, columns); default : of what is absent or empty, None = it must be there."""
        values = [self._column(c, default) for c in columns]
        return np.array(values, dtype=np.float64).reshape(len(columns), len(self.rows)).T

    def _column(self, column: str, default: float | None) -> list[float]:
        numbers = []
        texts = self.texts(column, default=None if default is None else "")
        for text, line in zip(texts, self.lines, strict=True):
            try:
                number = float(text) if text or default is None else default
            except ValueError:
                number = math.inf
            if abs(number) > _FARTHEST:
                raise FormatError(f"{column} is {text[:40]!r}, not a number that makes sense", self.path, line)
            numbers.append(number)
        return numbers


def read_csv(path: str | os.PathLike[str]) -> CsvTable:
    """Read a comma-separated table whose first line names the columns; empty lines and # lines are skipped."""
    name, data = os.fspath(path), b""
    with open_source(name) as source:
        for block in source.blocks():
            data += block
            if len(data) > _LARGEST:
                raise FormatError(f"is larger than {_LARGEST >> 20} MB: not a small table", name)
    try:
        lines = data.decode().splitlines()
    except UnicodeDecodeError:
        raise FormatError("not UTF-8 text", name) from None
    plain = ("" if not line.strip() or line.lstrip().startswith("#") else line for line in lines)
    rows = [(number, tuple(f.strip() for f in row)) for number, row in csv_rows(plain, name)]
    if not rows:
        raise FormatError("holds no table; its first line must name the columns", name)
    header = rows[0][1]
    for number, row in rows:
        if len(row) != len(header):
            raise FormatError(f"has {len(row)} fields where the header names {len(header)}", name, number)
    return CsvTable(name, header, tuple(row for _, row in rows[1:]), tuple(number for number, _ in rows[1:]))


_LARGEST = 1 << 26
"""Bytes of a table that is read."""
_FARTHEST = 1e10
"""m or s; a number beyond it is neither a place on Earth nor a time since 1970."""


def csv_rows(lines: Iterable[str], path: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of its last line and the fields of each row that is not empty."""
    reader = csv.reader(lines)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise FormatError(f"is no comma-separated table ({error})", path, reader.line_num) from None
