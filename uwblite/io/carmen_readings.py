"""The readings of laser messages: found by their blanks, decoded for a whole block of lines at a time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from .carmen_words import BrokenLine
from .decimal_text import decode_equal_widths, decode_fixed_point


@dataclass(slots=True, eq=False)
class Pending:
    """One message of the block at hand, parsed but for its readings."""

    number: int
    first: int
    """Index into the gaps of the gap behind the first reading."""
    readings: Floats | None
    """Readings, where they were read the general way."""
    stamp: float


@dataclass(slots=True, eq=False)
class Block:
    """Some whole lines of a log."""

    text: bytes
    """The lines, each with its line end."""
    array: NDArray[np.uint8]
    """The same, padded to a multiple of 8 bytes."""
    gaps: Ints
    """Index of every blank, tab or line end in the text."""

    @staticmethod
    def of(text: bytes) -> "Block":
        """Return the block of a text."""
        array = np.frombuffer(text + b"\n" * (-len(text) % 8), dtype=np.uint8)
        return Block(text, array, np.flatnonzero(array[: len(text)] <= 32))

    def decode_rows(self, beams: int, pending: list[Pending]) -> tuple[NDArray[np.float32], list[ValueError | None]]:
        """Return the readings (k, beams) of messages, the quick ways first, and by message what is wrong with it."""
        errors: list[ValueError | None] = [None] * len(pending)
        first = np.array([p.first for p in pending], dtype=np.intp)
        left = np.array([p.readings is None for p in pending])
        begins = self.gaps[np.maximum(first - 1, 0)] + 1
        ends = self.gaps[first + beams - 1]
        values = np.empty((len(pending), beams), dtype=np.float32)
        for decode in (self._decode_equal_widths, self._decode_fixed_point):
            rows = np.flatnonzero(left)
            if len(rows):
                decoded, plain = decode(beams, first[rows], begins[rows], ends[rows])
                values[rows[plain]] = decoded[plain]
                left[rows[plain]] = False
        for row in np.flatnonzero(left | np.array([p.readings is not None for p in pending])):
            readings = pending[row].readings
            try:
                if readings is None:
                    readings = np.array(self.text[begins[row] : ends[row]].split(), dtype=np.float64)
                    if len(readings) != beams:
                        raise BrokenLine("readings are parted unevenly")
                values[row] = np.clip(readings, -1.0, 1e30)
            except ValueError as error:
                errors[row] = error
        return values, errors

    def _decode_equal_widths(self, beams: int, first: Ints, begins: Ints, ends: Ints) -> tuple[NDArray[np.float32], Bools]:
        """Decode rows of numbers that are all as wide as the first one of all."""
        width, decimals = self._form(begins[0], self.gaps[first[0]])
        fits = ends - begins == beams * (width + 1) - 1
        values = np.empty((len(first), beams), dtype=np.float32)
        if 1 <= decimals <= 6 and decimals + 2 <= width <= 9:
            values[fits], fits[fits] = decode_equal_widths(self.array, begins[fits], beams, width, decimals)
        else:
            fits[:] = False
        return values, fits

    def _decode_fixed_point(self, beams: int, first: Ints, begins: Ints, ends: Ints) -> tuple[NDArray[np.float32], Bools]:
        """Decode rows of numbers with as many decimals as the first one of all."""
        _, decimals = self._form(begins[0], self.gaps[first[0]])
        if not 1 <= decimals <= 6:
            return np.empty((len(first), beams), dtype=np.float32), np.zeros(len(first), dtype=np.bool_)
        index = first[:, None] + np.arange(beams)
        return decode_fixed_point(self.array, self.gaps[index], self.gaps[index - 1] + 1, decimals)

    def _form(self, begin: int, end: int) -> tuple[int, int]:
        """Return how wide a number is and how many decimals it has, 0 without a dot."""
        number = self.text[begin:end]
        return len(number), len(number) - 1 - number.find(b".") if b"." in number else 0
