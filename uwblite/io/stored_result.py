"""A result that `uwblite map` has written, read back: for other formats, for the local page, for planning anchors."""

import json
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..errors import ConfigError, FormatError
from ..grid.occupancy_grid import OccupancyGrid
from ..sensor_log import MOST_ANCHORS
from .csv_table import read_csv
from .folders import mend
from .map_server import read_map
from .tum import read_tum

_CONTRACT = re.compile(
    r"trajectory(_\d+)?\.tum|trajectory_covariance\.csv|anchors\.csv|range_errors\.csv|map\.(pgm|yaml|png)|map_scale\.(png|yaml)"
    r"|graph\.(g2o|pyfg)|graph_stamps\.csv|config\.toml|report\.(html|json)"
)


def is_of_result(name: str) -> bool:
    """Return whether a file's name is one of those that a result may hold."""
    return _CONTRACT.fullmatch(name) is not None


def repair_result(folder: str | os.PathLike[str]) -> None:
    """Finish a replacement of a result that a crash has interrupted, where there is one and it may be finished."""
    with suppress(OSError):
        mend(folder, is_of_result)


@dataclass(frozen=True, slots=True, eq=False)
class StoredAnchor:
    """An anchor of a result."""

    id: str
    position: Floats
    """(2,) m, map frame; nan where it has none."""
    covariance: Floats
    """(2, 2) m^2."""
    status: str
    """'ok', 'mirror-ambiguous', 'unplaced' or 'distrusted'."""
    bias: float = float("nan")
    """m, added to every range; nan where the table does not contain it."""
    residual_rms: float = float("nan")
    """m, spread of its range residuals; nan where the table does not contain it."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredRanges:
    """The ranges of a result, with their errors."""

    anchors: tuple[str, ...]
    """(m,) as in the table of the anchors."""
    errors: Floats
    """(m,) m, measured minus expected, the anchor's bias taken off."""
    tags: Floats
    """(m, 2) m, map frame: where the tag was."""
    headings: Floats
    """(m,) rad, of the base."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredClosure:
    """A candidate of a loop closure."""

    stamps: tuple[float, float]
    """s, each on the clock of its recording."""
    recordings: tuple[int, int]
    """Counted from 1."""
    places: Floats
    """(2, 2) m, map frame: where the robot was at both times."""
    accepted: bool
    reason: str
    pose: Floats | None = None
    """(3,) measured pose of the second place in the first; m, m, rad; None where the report does not contain it."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredResult:
    """The folder that `uwblite map` wrote."""

    folder: Path
    trajectories: tuple[tuple[Floats, Floats], ...]
    """Of each recording: stamps (n,) s, poses (n, 3) m, m, rad, map frame."""
    keyframe_stamps: Floats
    """(k,) s."""
    keyframe_recordings: Ints
    """(k,) counted from 1."""
    keyframe_covariances: Floats
    """(k, 3, 3) m, m, rad, map frame."""
    anchors: tuple[StoredAnchor, ...]
    closures: tuple[StoredClosure, ...]
    ranges: StoredRanges
    """None of them where the folder has no table of their errors, as those of earlier versions have not."""
    grid: OccupancyGrid | None = None
    report: dict[str, Any] = field(default_factory=dict)
    """report.json, as it stands there; empty where there is none."""

    @property
    def laser_delay(self) -> float:
        """Offset of the lidar's clock, s: a scan stamped t was taken at t + laser_delay by the trajectory's clock; 0 where
        the report does not contain it."""
        entries = self.report.get("calibration") or []
        delays = [e.get("value") for e in entries if isinstance(e, dict) and e.get("name") == "laser_delay"]
        return float(delays[0]) if delays and isinstance(delays[0], int | float) else 0.0

    def pose_at(self, recording: int, stamps: Floats) -> Floats:
        """Return the poses (..., 3) of a recording, counted from 1, at times of its clock, s."""
        return se2.interpolate_trajectory(*self.trajectories[recording - 1], stamps)

    def trail(self, stamps: Floats, wheels: Floats, most: int) -> Floats:
        """Return about `most` poses (k, 3) since the last trajectory ends, by stamps (n,) and poses (n, 3) of the odometry."""
        known, poses = self.trajectories[-1]
        later = np.flatnonzero(stamps > known[-1])
        if not len(later) or stamps[0] > known[-1]:
            return poses[-1:]
        T_map_odom = se2.compose(poses[-1], se2.inverse(se2.interpolate_trajectory(stamps, wheels, known[-1])))
        chosen = np.union1d(later[:: max(len(later) // most, 1)], later[-1:])
        return np.concatenate([poses[-1:], se2.compose(T_map_odom, wheels[chosen])])


def read_result(folder: str | os.PathLike[str]) -> StoredResult:
    """Read a result; raise FormatError where a folder holds none, or a file in it is not what it should be."""
    path = Path(folder)
    repair_result(path)
    if not (path / "trajectory.tum").is_file():
        raise FormatError("holds no result of a map (no trajectory.tum)", os.fspath(path))
    later = (path / f"trajectory_{k}.tum" for k in range(2, 1 + len(list(path.glob("trajectory*.tum")))))
    trajectories = tuple(read_tum(p) for p in (path / "trajectory.tum", *(p for p in later if p.is_file())))
    report = _report(path / "report.json")
    stamps, recordings, covariances = _keyframes(path / "trajectory_covariance.csv", len(trajectories))
    anchors, ranges = _anchors(path / "anchors.csv"), _ranges(path / "range_errors.csv")
    grid = read_map(path / "map.yaml") if (path / "map.yaml").exists() else None
    result = StoredResult(path, trajectories, stamps, recordings, covariances, anchors, (), ranges, grid, report)
    return replace(result, closures=tuple(_closures(result)))


def read_space(path: str, warnings: list[str]) -> tuple[OccupancyGrid, tuple[StoredAnchor, ...]]:
    """Return the grid of a result, or of the map.yaml of any map, and the anchors where they are known."""
    if not os.path.isdir(path):
        return read_map(path, warnings), ()
    result = read_result(path)
    if result.grid is None:
        raise ConfigError(f"{path} has no map.yaml: without a map there is no free space to plan in")
    return result.grid, result.anchors


def _ranges(path: Path) -> StoredRanges:
    if not path.is_file():
        return StoredRanges((), np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    table = read_csv(path)
    values = table.numbers("error", "x", "y", "theta")
    return StoredRanges(table.texts("anchor"), values[:, 0], values[:, 1:3], values[:, 3])


def _report(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is no JSON ({error})", os.fspath(path)) from None
    if not isinstance(content, dict):
        raise FormatError("is not the report of a map", os.fspath(path))
    return content


def _keyframes(path: Path, recordings: int) -> tuple[Floats, Ints, Floats]:
    """Return stamps (k,), recordings (k,) and covariances (k, 3, 3) of the keyframes; none where the file is missing."""
    if not path.exists():
        return np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros((0, 3, 3))
    table = read_csv(path)
    stamps, upper = table.numbers("stamp")[:, 0], table.numbers("xx", "xy", "xtheta", "yy", "ytheta", "thetatheta")
    covariances = np.empty((len(upper), 3, 3))
    row, col = np.triu_indices(3)
    covariances[:, row, col] = covariances[:, col, row] = upper
    number = table.numbers("recording", default=1.0)[:, 0].astype(np.intp)
    if len(number) and not 1 <= number.min() <= number.max() <= recordings:
        raise FormatError(f"names recording {number.max()}; the folder holds {recordings} trajectories", table.path)
    return stamps, number, covariances


def _anchors(path: Path) -> tuple[StoredAnchor, ...]:
    if not path.exists():
        return ()
    table = read_csv(path)
    if (rows := len(table.texts("id"))) > MOST_ANCHORS:
        raise FormatError(f"has {rows} anchors, more than {MOST_ANCHORS}: it must be the anchors.csv of one map", table.path)
    values = table.numbers("x", "y", "sigma_x", "sigma_y", "covariance_xy", "bias", "residual_rms", default=np.nan)
    anchors = []
    texts = table.texts("id"), table.texts("status", default="ok")
    for name, status, (x, y, sx, sy, xy, bias, rms) in zip(*texts, values, strict=True):
        off = 0.0 if np.isnan(xy) else xy
        anchors.append(StoredAnchor(name, np.array([x, y]), np.array([[sx**2, off], [off, sy**2]]), status, bias, rms))
    return tuple(anchors)


def _pose(values: Any) -> Floats | None:
    good = isinstance(values, list) and len(values) == 3 and all(isinstance(v, int | float) for v in values)
    return np.array(values, dtype=np.float64) if good else None


def _closures(result: StoredResult) -> Iterator[StoredClosure]:
    """Yield the closures of a result's report; those of keyframes that the tables do not know are left out."""
    for entry in result.report.get("closures") or ():
        i, j = entry.get("i"), entry.get("j")
        if not all(isinstance(k, int) and 0 <= k < len(result.keyframe_stamps) for k in (i, j)):
            continue
        (one, other), (start, end) = result.keyframe_recordings[[i, j]].tolist(), result.keyframe_stamps[[i, j]].tolist()
        places = np.array([result.pose_at(n, np.array(t))[:2] for n, t in ((one, start), (other, end))])
        kept, why = entry.get("accepted", entry.get("outcome") == "accepted"), str(entry.get("reason", ""))
        yield StoredClosure((start, end), (one, other), places, bool(kept), why, _pose(entry.get("T_i_j")))
