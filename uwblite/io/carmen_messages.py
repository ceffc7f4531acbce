"""What all CARMEN messages share: numbers, stamps, time order, and lines that are broken."""

import math

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..sensor_log import MOST_METRES, MOST_SECONDS


class BrokenLine(ValueError):
    """One line cannot be used; the text says why. It never leaves the reader."""


def numbers(tokens: list[bytes], what: str, count: int) -> list[float]:
    """Return exactly `count` finite numbers."""
    if len(tokens) != count:
        raise BrokenLine(f"{what} has too few fields")
    values = [float(token) for token in tokens]
    if not math.isfinite(sum(values)):
        raise BrokenLine(f"{what} holds a number that is not finite")
    if max(map(abs, values)) > MOST_METRES:
        raise BrokenLine(f"{what} holds a number beyond anything that a robot measures")
    return values


def stamp_of(tokens: list[bytes]) -> float:
    """Return the time of a message, s, from `ipc_timestamp host logger_timestamp` or `host logger_timestamp`."""
    stamp = float(tokens[0] if len(tokens) == 3 else tokens[1])
    if not math.isfinite(stamp):
        raise BrokenLine("the stamp is not finite")
    if abs(stamp) > MOST_SECONDS:
        raise BrokenLine("the stamp is no time")
    return stamp


def is_message_name(name: bytes) -> bool:
    """Return whether a word could be the name of a message of some CARMEN module: capitals, digits, _ and -."""
    plain = name.replace(b"_", b"").replace(b"-", b"")
    return 2 <= len(name) <= 40 and plain.isalnum() and plain.isupper() and plain[:1].isalpha()


def why_broken(error: ValueError) -> str:
    """Return one short printable line about a broken line."""
    text = str(error).replace("could not convert string to float", "not a number")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= 100 else text[:97] + "..."


CONFIRMED = 0.5
"""s; a recorder may hold a range back until the next one confirms it."""
_NEXT = 2.0
"""s; a part of a log that follows another begins so much later at most."""


def time_order(stamps: Floats, what: str, warnings: list[str], set_back: dict[str, float] | None = None) -> NDArray[np.intp]:
    """Return the order (n,) that sorts stamps; equal stamps keep their places. Warn when some come late.

    Parameters
    ----------
    set_back : takes by how much the clock was set back at most, s, by what.
    """
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps) - CONFIRMED))
    if late:
        warnings.append(f"{late} of {len(stamps)} {what} messages came out of time order; sorted by stamp")
        if set_back is not None:
            set_back[what] = 0.0 if _in_parts(stamps) else float(np.max(np.maximum.accumulate(stamps) - stamps))
    return np.argsort(stamps, kind="stable")


def _in_parts(stamps: Floats) -> bool:
    """Return whether stamps (n,) are those of one clock in parts that only stand in another order, as `cat` writes them.

    Sorted, one part follows the other; a clock that was set back goes through the same time again, or leaves a gap.
    """
    steps = np.diff(stamps, prepend=np.inf)
    begins = np.flatnonzero((steps < -CONFIRMED) | (steps > _NEXT))
    first, last = np.minimum.reduceat(stamps, begins), np.maximum.reduceat(stamps, begins)
    order = np.argsort(first)
    gap, as_written = first[order][1:] - last[order][:-1], np.diff(order) == 1
    return bool(np.all((gap >= -CONFIRMED) & (as_written | (gap <= _NEXT))))
