"""The words of CARMEN messages: numbers, stamps, what stands around the readings of a laser, broken lines, time order."""

import math
import re
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..errors import ConfigError
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


def time_order(stamps: Floats, what: str, warnings: list[str], set_back: dict[str, float] | None = None) -> Ints:
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


MAX_BEAMS = 100_000
"""A message that claims more readings is broken."""
RANK = {b"RAWLASER1": 0, b"FLASER": 1, b"ROBOTLASER1": 2}
"""Messages that may carry the same scans; only those of the highest rank in the log are used."""
HEAD = {b"RAWLASER1": 9, b"FLASER": 2, b"ROBOTLASER1": 9}
"""Words before the readings."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Geometry that a message gives; messages with equal layout go into one array."""

    beams: int
    angle_min: float = 0.0
    angle_increment: float = 0.0
    range_max: float = 0.0
    """m; 0 where the message does not give it."""


def kinds_of(message: str) -> dict[bytes, bytes]:
    """Return the messages that hold the scans of one lidar, each with the kind that it is read as.

    Parameters
    ----------
    message : name of the only message to read, such as ROBOTLASER2 of the second lidar; empty = the first lidar's.

    Raises
    ------
    ConfigError : scans are not read from such a message.
    """
    if not message:
        return {name: name for name in RANK}
    kind = "FLASER" if message == "RLASER" else re.sub("(?<=LASER)[1-5]$", "1", message)
    if kind.encode() not in RANK:
        raise ConfigError(f"scans are not read from {message!r}; choose ROBOTLASER1 to 5, RAWLASER1 to 5, FLASER or RLASER")
    return {message.encode(): kind.encode()}


def parse_head(name: bytes, tokens: list[bytes]) -> Layout:
    """Read the words before the readings."""
    what = name.decode()
    if len(tokens) != HEAD[name]:
        raise BrokenLine(f"{what}: fields are parted unevenly")
    beams = int(tokens[-1])
    if not 1 <= beams <= MAX_BEAMS:
        raise BrokenLine(f"{what} announces {beams} readings")
    if name == b"FLASER":
        return Layout(beams)
    angle_min, fov, increment = numbers(tokens[2:5], what, 3)
    stated = float(tokens[5])
    range_max = stated if 0.0 < stated <= MOST_METRES else 0.0  # an infinite one is none
    if increment == 0.0:
        increment = fov / max(beams - 1, 1)
    if abs(increment) * (beams - 1) > 2.1 * math.pi or abs(angle_min) > 2.1 * math.pi:
        raise BrokenLine(f"{what}: {beams} readings {increment:g} rad apart are more than a turn")
    return Layout(beams, angle_min, increment, range_max)


def split_tail(name: bytes, tail: list[bytes], ipc_left_out: bool) -> tuple[int, float]:
    """Return which word behind the readings the poses of laser and robot begin at (RAWLASER1 has none), and the stamp, s."""
    if name == b"FLASER":
        if len(tail) not in (8, 9):
            raise BrokenLine(f"FLASER has {len(tail)} fields behind its readings, expected 9")
        return 0, stamp_of(tail[6:])
    rest = tail[1 + int(tail[0]) :] if tail and len(tail[0]) < 10 and tail[0].isdigit() else tail
    if name == b"RAWLASER1":
        rest = rest if len(rest) in (2, 3) else tail
        if len(rest) not in (2, 3):
            raise BrokenLine(f"RAWLASER1 has {len(tail)} fields behind its readings, expected 4 + remissions")
        return len(tail) - len(rest), stamp_of(rest)
    rest = rest if 12 <= len(rest) <= 14 else tail
    if not 12 <= len(rest) <= 14:
        raise BrokenLine(f"ROBOTLASER1 has {len(tail)} fields behind its readings, expected 15 + remissions")
    # 14 = with turn_axis and ipc_timestamp, 12 = with neither; 13 is one of them.
    has_ipc = len(rest) == 14 or (len(rest) == 13 and not ipc_left_out)
    return len(tail) - len(rest), stamp_of(rest[-3:] if has_ipc else rest[-2:])
