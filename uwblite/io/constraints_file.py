"""Reading of prior knowledge: a TOML file of constraints, and the anchors.csv of an earlier map."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from .. import constraints as known
from ..config import from_dict, parse_toml, to_toml
from ..constraints import Constraints, GivenAnchor
from ..errors import ConfigError, FormatError
from ..sensor_log import MOST_METRES, MOST_SECONDS
from ..sensor_log.sensors import last_places
from .csv_table import read_csv
from .source import read_settings

_TABLES: Mapping[str, tuple[type, str, tuple[str, ...]]] = {
    "anchor": (GivenAnchor, "anchors", ("id", "position")),
    "pose": (known.GivenPose, "poses", ("stamp", "pose")),
    "anchor_distance": (known.GivenDistance, "distances", ("anchors", "distance")),
    "landmark": (known.GivenLandmark, "landmarks", ("name", "position")),
    "landmark_distance": (known.GivenLandmarkDistance, "landmark_distances", ("landmarks", "distance")),
    "closure": (known.GivenClosure, "closures", ("stamps",)),
    "forbidden_closure": (known.ForbiddenClosure, "forbidden", ("stamps",)),
}
"""Class, field of Constraints and needed fields of each table."""


def read_constraints(path: str | None, anchors_from: str | None) -> Constraints:
    """Return what is known beforehand: the constraints of a file and the anchors of an earlier map, where they are named."""
    earlier = read_anchors(anchors_from) if anchors_from else Constraints()
    return earlier + parse_constraints(read_settings(path), path) if path else earlier


def parse_constraints(text: str, path: str = "") -> Constraints:
    """Return the constraints of a TOML text, tables with the fields of their classes; path is its name for error messages."""
    path = path or "constraints"
    data = parse_toml(text, path)
    entries: dict[str, tuple[Any, ...]] = {}
    for name, tables in data.items():
        if name not in _TABLES or not isinstance(tables, list):
            tables_known = ", ".join(f"[[{k}]]" for k in _TABLES)
            raise ConfigError(f"{path}: unknown table {name!r}; it may hold {tables_known}")
        kind, field, needed = _TABLES[name]
        where = f"{path}: [[{name}]] number"
        entries[field] = tuple(_entry(kind, needed, table, f"{where} {k}") for k, table in enumerate(tables, 1))
    return Constraints(**entries)


def constraints_text(constraints: Constraints) -> str:
    """Return constraints as TOML, such that `parse_constraints` gives them again."""
    entries = ((name, entry) for name, (_, field, _) in _TABLES.items() for entry in getattr(constraints, field))
    return "".join(f"\n[[{name}]]\n{to_toml(entry)}" for name, entry in entries)


def _entry(kind: type, needed: tuple[str, ...], table: Any, where: str) -> Any:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is not a table")
    missing = [name for name in needed if name not in table]
    if missing:
        raise ConfigError(f"{where} needs {missing[0]}")
    for name, value in table.items():
        most = MOST_SECONDS if name.startswith("stamp") else MOST_METRES
        if any(isinstance(v, int | float) and abs(v) > most for v in (value if isinstance(value, list) else [value])):
            raise ConfigError(f"{where}: {name} is beyond {most:g}: nobody measured that")
    try:
        return from_dict(kind, table)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def read_anchors(path: str | os.PathLike[str]) -> Constraints:
    """Return the placed anchors of an earlier map's anchors.csv as known places; they may have been moved since.

    Where the map has an anchor at several places (``5C0B``, later ``5C0B@2``), the last one counts. Sigmas are taken as
    the larger of x and y, and at least 2 cm: an earlier map's own frame is not more certain than that.
    """
    table = read_csv(path)
    names = table.texts("id")
    for column in ("x", "y"):
        table.texts(column)
    values = table.numbers("x", "y", "sigma_x", "sigma_y", default=np.nan)
    status = table.texts("status", default="ok")
    placed: dict[str, tuple[tuple[float, float], float]] = {}
    for name, (x, y, sigma_x, sigma_y), state in zip(names, values.tolist(), status, strict=True):
        if np.isfinite(x) and np.isfinite(y) and state == "ok":
            sigma = float(np.nanmax([sigma_x, sigma_y, 0.02]))
            placed[name] = (x, y), sigma
    last = {radio: name for radio, name in last_places(names).items() if name in placed}
    if not last:
        raise FormatError("no anchor in it has a place; it must be the anchors.csv of a map", os.fspath(path))
    return Constraints(anchors=tuple(GivenAnchor(radio, *placed[name], movable=True) for radio, name in last.items()))
