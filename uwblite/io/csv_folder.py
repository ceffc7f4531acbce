"""A recording as a folder of CSV files, for spreadsheets and other programs; docs/formats.md lists files and columns."""

import dataclasses
import hashlib
import io
import os
from array import array
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from ..arrays import Floats
from ..config import from_dict, parse_toml, setting, to_toml
from ..errors import ConfigError, FormatError
from ..report.printable import csv_field
from ..sensor_log import Gyro, LaserScans, LogNotes, Odometry, SensorLog, SensorMounting, UwbRanges, fault_of_id, one_word
from .carmen_stamps import false_stamps, placed
from .csv_table import csv_rows
from .files import replacing, write_text
from .folders import refuse_foreign, replacing_folder, unmarked
from .readings import ranges_of, reach_of
from .source import finite, open_source


@dataclasses.dataclass(frozen=True, slots=True)
class Scans:
    """Geometry that all scans share."""

    angle_min: float = setting(0.0, minimum=-7.0, maximum=7.0)
    """Angle of the first beam in the laser frame, rad."""
    angle_increment: float = -1.0
    """Angle between beams, rad; negative where they run clockwise."""
    time_increment: float = 0.0
    """Time between beams, s."""
    range_min: float = 0.02
    """Shorter readings are invalid, m."""
    range_max: float = 30.0
    """What the scanner reaches, m."""


@dataclasses.dataclass(frozen=True, slots=True)
class Mounting:
    """Mounting of the sensors on the base."""

    laser: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, theta of the laser; m, m, rad."""
    laser_flipped: bool = False
    """The laser is mounted upside down."""
    tag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, z of the UWB tag, z above the floor, m."""
    anchor_height: float | None = None
    """Height of all anchors above the floor, m."""
    anchor_heights: dict[str, float] = dataclasses.field(default_factory=dict)
    """Height of single anchors above the floor, m, by id."""


@dataclasses.dataclass(frozen=True, slots=True)
class Sensors:
    """Everything about the sensors that is not a reading."""

    scans: Scans = Scans()
    """Geometry of the scans."""
    mounting: Mounting = Mounting()
    """Mounting of the sensors."""


def write_csv_folder(folder: str | os.PathLike[str], log: SensorLog, *, force: bool = False) -> None:
    """Write a recording as CSV files into a folder, all together; raise ConfigError where others stand there."""
    path = Path(folder)
    present = [path / name for name in _FILES if (path / name).is_file()]
    if present and not force:
        raise ConfigError(f"{path} already holds a recording ({present[0].name}); use `force` to replace it, or another folder")
    refuse_foreign(unmarked(path, _FILES, "sensors.toml", _MARK))
    with replacing_folder(path, _FILES.__contains__) as waiting:
        _write_tables(waiting, log)


_FILES = ("odometry.csv", "gyro.csv", "ranges.csv", "scans.csv", "sensors.toml")
_MARK = f"# {Scans.__doc__}"
"""How sensors.toml begins with comments."""


def _write_tables(path: Path, log: SensorLog) -> None:
    rows = np.column_stack([log.odometry.stamps, log.odometry.poses]).tolist()
    tables = {"odometry": ("stamp,x,y,theta", (",".join(f"{v:.6f}" for v in row) for row in rows))}
    if log.gyro is not None:
        headings = zip(log.gyro.stamps.tolist(), log.gyro.heading.tolist(), strict=True)
        tables["gyro"] = "stamp,heading", (f"{stamp:.6f},{heading:.6f}" for stamp, heading in headings)
    if (r := log.ranges) is not None:
        r.require_one_tag("a CSV folder")
        names = [csv_field(name) for name in r.anchor_ids]
        ranges = zip(*(column.tolist() for column in (r.stamps, r.anchor, r.ranges, r.quality)), strict=True)
        tables["ranges"] = "stamp,anchor,range,quality", (f"{t:.6f},{names[k]},{d:.4f},{q:g}" for t, k, d, q in ranges)
    if (s := log.scans) is not None:
        beams = ",".join(f"r{k}" for k in range(s.ranges.shape[1]))
        cells = (",".join("" if v == np.inf else f"{v:.4f}" for v in readings.tolist()) for readings in s.ranges)
        tables["scans"] = f"stamp,{beams}", (f"{t:.6f},{row}" for t, row in zip(s.stamps.tolist(), cells, strict=True))
    for name, (header, lines) in tables.items():
        with replacing(path / f"{name}.csv") as stream:
            stream.writelines(f"{line}\n".encode() for line in chain((header,), lines))
    write_text(path / "sensors.toml", to_toml(_sensors(log), comments=True))


def _sensors(log: SensorLog) -> Sensors:
    m, s = log.mounting, log.scans
    geometry = Scans()
    if s is not None:
        geometry = Scans(s.angle_min, s.angle_increment, s.time_increment, s.range_min, s.range_max)
    laser, tag = tuple(m.T_base_laser.tolist()), tuple(m.tag_position.tolist())
    return Sensors(geometry, Mounting(laser, m.laser_flipped, tag, m.anchor_height, dict(m.anchor_heights)))


def read_csv_folder(folder: str | os.PathLike[str]) -> SensorLog:
    """Read a recording from a folder of CSV files."""
    path, read, sensors = Path(folder), _Reading(), Sensors()
    if (path / "sensors.toml").exists():
        stated = parse_toml("".join(read.lines(path / "sensors.toml")), str(path / "sensors.toml"))
        if isinstance(scanner := stated.get("scans"), dict) and scanner.get("range_max") != scanner.get("range_max"):
            scanner["range_max"] = np.inf  # nan states none either
        sensors = from_dict(Sensors, stated)
    odometry = read.table(path / "odometry.csv", ("stamp", "x", "y", "theta"), "odometry")
    ranges, scans, gyro = (path / f"{name}.csv" for name in ("ranges", "scans", "gyro"))
    radio = read.ranges(ranges) if ranges.exists() else None
    lidar = read.scans(scans, sensors.scans) if scans.exists() else None
    turns = read.table(gyro, ("stamp", "heading"), "gyro", empty=True) if gyro.exists() else np.zeros((0, 2))
    heading = Gyro(turns[:, 0].copy(), np.unwrap(turns[:, 1])) if len(turns) else None
    m = sensors.mounting
    mounting = SensorMounting(np.array(m.laser), m.laser_flipped, np.array(m.tag), m.anchor_height, m.anchor_heights)
    notes = LogNotes(source=os.fspath(folder), sha256=read.digest.hexdigest(), warnings=tuple(read.warnings))
    return SensorLog(Odometry(odometry[:, 0].copy(), odometry[:, 1:].copy()), radio, lidar, mounting, notes, gyro=heading)


_BEST = "100"
"""Quality of a range of which none is reported."""


def _is_header(row: list[str]) -> bool:
    """Return whether the first row of a table names its columns: a stamp is a number."""
    try:
        float(row[0])
    except ValueError:
        return True
    return False


def _places(row: list[str], names: tuple[str, ...], path: Path, line: int) -> list[int]:
    """Return where the named columns stand by a table's first row, -1 = not there."""
    header = [cell.strip().lower() for cell in row] if _is_header(row) else []
    places = [header.index(name) if name in header else -1 for name in names]
    needed = [k for k, name in enumerate(names) if name != "quality"]
    if all(places[k] >= 0 for k in needed):
        return places
    elsewhere = any(place not in (-1, k) for k, place in enumerate(places))
    if elsewhere or not len(needed) <= len(row) <= len(names):
        raise FormatError(f"{len(row)} columns, expected {','.join(names)}", str(path), line)
    return [k if k < len(row) else -1 for k in range(len(names))]


class _Reading:
    """The files of a folder, read one after another, a block in memory at a time."""

    def __init__(self) -> None:
        self.digest, self.warnings, self.anchors = hashlib.sha256(), list[str](), dict[str, int]()

    def lines(self, path: Path) -> Iterator[str]:
        """Yield the lines of a file."""
        with open_source(path) as source:
            for k, block in enumerate(source.blocks()):
                self.digest.update(block)
                try:
                    yield from io.StringIO(block.decode("utf-8" if k else "utf-8-sig"))
                except UnicodeDecodeError:
                    raise FormatError("not UTF-8 text", str(path)) from None

    def table(self, path: Path, names: tuple[str, ...], what: str, *, empty: bool = False) -> Floats:
        """Return the named columns (n, names), of anchors their numbers, in the order of sound stamps, the first column."""
        cells, places, width = array("d"), list[int](), 0
        for line, row in csv_rows(self.lines(path), str(path)):
            if not places:
                places, width = _places(row, names, path, line), len(row)
                if _is_header(row):
                    continue
            if len(row) != width:
                raise FormatError(f"{len(row)} columns, expected {width}", str(path), line)
            for name, k in zip(names, places, strict=True):
                text = row[k] if k >= 0 else _BEST
                cells.append(self._anchor(text, path, line) if name == "anchor" else _number(text, path, line))
        if not (cells or empty):
            raise FormatError("there are no rows", str(path))
        return self._in_order(np.array(cells).reshape(-1, len(names)), what)

    def _anchor(self, text: str, path: Path, line: int) -> int:
        if text not in self.anchors and (fault := fault_of_id(one_word(text))):
            raise FormatError(f"the anchor's id {fault}", str(path), line)
        return self.anchors.setdefault(text, len(self.anchors))

    def _in_order(self, table: Floats, what: str) -> Floats:
        """Return rows with their stamps in order, those that no clock gives placed by their rows; the header is line 1."""
        stamps = table[:, 0]
        table[:, 0] = placed(np.arange(2, len(stamps) + 2), stamps, false_stamps(stamps), what, self.warnings)
        return table[np.argsort(table[:, 0], kind="stable")]

    def ranges(self, path: Path) -> UwbRanges | None:
        """Return the ranges; None without any."""
        stamps, anchor, metres, quality = self.table(path, ("stamp", "anchor", "range", "quality"), "range", empty=True).T
        names = [one_word(name) for name in self.anchors]
        return ranges_of(stamps, anchor.astype(np.intp), names, metres, quality) if names else None

    def scans(self, path: Path, geometry: Scans) -> LaserScans | None:
        """Return the scans; None without any."""
        stamps, readings, beams = array("d"), array("f"), 0
        for k, (line, row) in enumerate(csv_rows(self.lines(path), str(path))):
            if k == 0 and _is_header(row):
                continue
            beams = beams or len(row) - 1
            if not beams:
                raise FormatError("a stamp without readings; each beam has a column", str(path), line)
            if len(row) != beams + 1:
                raise FormatError(f"{len(row) - 1} beams, the first scan has {beams}", str(path), line)
            try:
                readings.extend([float(cell or "inf") for cell in row[1:]])
            except ValueError:
                raise FormatError("a reading is not a number", str(path), line) from None
            stamps.append(_number(row[0], path, line))
        if not stamps:
            return None
        if geometry.angle_increment == -1.0:
            what = "scans need their geometry in sensors.toml ([scans] angle_min, angle_increment, range_max)"
            raise FormatError(what, str(path))
        times, rows = self._in_order(np.column_stack([stamps, np.arange(len(stamps))]), "scan").T
        ranges = np.array(readings).reshape(-1, beams)[rows.astype(np.intp)]
        g, reach = geometry, geometry.range_max
        with np.errstate(invalid="ignore"):
            ranges[~(ranges >= g.range_min)] = np.nan
        if not g.range_min < reach < np.inf:
            reach = reach_of(ranges, self.warnings)
        return LaserScans(times, ranges, g.angle_min, g.angle_increment, g.time_increment, g.range_min, reach)


def _number(text: str, path: Path, line: int) -> float:
    return finite(text, f"{text[:30]!r} is not a finite number", str(path), line)
