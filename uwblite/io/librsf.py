"""Recordings as text of libRSF (T. Pfeifer, TU Chemnitz): one measurement a line, its kind first.

| line | fields |
|---|---|
| odom2diff | stamp v_1 v_2 [v_y] base and their uncertainty: speeds of two wheels, m/s, and the distance from the middle to a wheel, m |
| odom2 | stamp v_x v_y turn_rate and their uncertainty, m/s and rad/s |
| range2 | stamp range uncertainty anchor_x anchor_y anchor_id |

Speeds are integrated as libRSF's motion models do: ahead by (v_1 + v_2) / 2, turning by (v_2 - v_1) / (2 base). Lines of the
truth and other sensors are skipped and counted.
"""  # noqa: E501

import os
from array import array
from collections import Counter

import numpy as np

from .. import se2
from ..arrays import Floats
from ..errors import FormatError
from ..sensor_log import LogNotes, Odometry, SensorLog, fault_of_id
from .readings import ranges_of
from .source import finite, open_source

_LEAST = {b"odom2diff": 8, b"odom2": 5, b"range2": 7}
"""Words of a line, the kind included."""
_WITH_SIDEWAYS = 9
"""Words of an odom2diff with a speed to the left."""


def read_librsf(path: str | os.PathLike[str]) -> SensorLog:
    """Read a recording, plain or gzip; raise FormatError where a line is wrong, or there is no odometry."""
    speeds, ranges, names, skipped = array("d"), array("d"), dict[str, int](), Counter[str]()
    with open_source(path) as source:
        number = 0
        for number, words in (row for rows in source.rows() for row in rows):
            if words[0] not in _LEAST:
                skipped[words[0][:40].decode("ascii", "replace")] += 1
                continue
            kind = words[0].decode()
            if len(words) < _LEAST[words[0]]:
                raise FormatError(f"{kind} has {len(words)} words, expected {_LEAST[words[0]]}", source.path, number)
            values = [finite(word, f"{word[:30]!r} is no finite number", source.path, number) for word in words[1:6]]
            if kind == "range2":
                name = _anchor(words[6], source.path, number)
                ranges.extend((values[0], values[1], names.setdefault(name, len(names))))
            else:
                speeds.extend((values[0], *_motion(kind, values, len(words))))
        sha256 = source.sha256()
    if not speeds:
        raise FormatError("holds no odometry (odom2diff or odom2)", source.path)
    notes = LogNotes(source=source.path, sha256=sha256, lines=number, skipped=dict(sorted(skipped.items())))
    odometry, table = _integrated(np.array(speeds).reshape(-1, 4)), np.array(ranges).reshape(-1, 3)
    stamps, metres, anchor = table.T
    radio = ranges_of(stamps, anchor.astype(np.intp), list(names), metres, np.full(len(table), 100.0)) if names else None
    return SensorLog(odometry, radio, notes=notes)


def _motion(kind: str, values: list[float], words: int) -> tuple[float, float, float]:
    """Return the speed ahead and to the left, m/s, and the turn rate, rad/s, of a line of odometry."""
    if kind == "odom2":
        return values[1], values[2], values[3]
    first, second = values[1], values[2]
    sideways, base = (values[3], values[4]) if words >= _WITH_SIDEWAYS else (0.0, values[3])
    return 0.5 * (first + second), sideways, (second - first) / (2.0 * base) if base else 0.0


def _anchor(word: bytes, path: str, line: int) -> str:
    """Return the name of an anchor: whole numbers are written with decimals too."""
    name = word.decode("ascii", "replace")
    name = name.split(".", 1)[0] if name.replace(".", "", 1).isdigit() else name
    if fault := fault_of_id(name):
        raise FormatError(f"the anchor's id {fault}", path, line)
    return name


def _integrated(rows: Floats) -> Odometry:
    """Return the odometry of speeds (n, 4) s, m/s, m/s, rad/s: each holds until the next."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    with np.errstate(over="ignore", invalid="ignore"):  # a recording refuses what is beyond all measures
        steps = se2.exp(rows[:-1, 1:] * np.diff(rows[:, 0])[:, None])
        return Odometry(rows[:, 0].copy(), se2.chain(np.zeros(3), steps))
