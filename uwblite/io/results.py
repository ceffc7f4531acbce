"""The folder that `uwblite map` writes: which files, in which formats, and all of them or none.

| file | what |
|---|---|
| trajectory.tum | pose at every odometry stamp, map frame; trajectory_2.tum ... for further recordings |
| trajectory_covariance.csv | stamp and covariance of every keyframe |
| anchors.csv | anchors with sigmas, biases, shares of ranges used |
| map.pgm, map.yaml | the map for map_server and nav2 |
| map.png | picture of the map with path, anchors, closures |
| graph.g2o, graph.pyfg | the optimised pose graph; graph_stamps.csv has the time of each pose |
| config.toml | the settings that were in force |
| report.html | everything on one page |
| report.json | the same for programs; hashes of the other files |

Every file is complete on the disk before the first takes its place, so that a full disk or a crash leaves the previous
result whole; report.json comes last and holds the hash of each, so that a mixture can be told.
"""

import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from ..map_picture import PictureAnchor, draw_map
from ..map_result import MapResult
from ..report import render
from ..sensor_log import LogNotes, SensorLog
from .files import write_text
from .g2o import write_g2o
from .map_server import trinary_image, write_map
from .png import encode_png, write_png
from .pyfg import write_pyfg
from .tum import write_tum

SCHEMA = 1
"""Version of report.json; it grows when a field changes its meaning or goes."""

_CONTRACT = re.compile(
    r"trajectory(_\d+)?\.tum|trajectory_covariance\.csv|anchors\.csv|map\.(pgm|yaml|png)|map_scale\.(png|yaml)"
    r"|graph\.(g2o|pyfg)|graph_stamps\.csv|config\.toml|report\.(html|json)"
)
_CALIBRATION_FIELDS = ("name", "value", "sigma", "unit", "meaning", "state", "reason")
_WAITING = ".uwblite-partial-"


@dataclass(frozen=True, slots=True)
class RunRecord:
    """What is to be remembered of the run that made a result."""

    command: str
    """Command line that makes the same map again."""
    config: str
    """Effective settings as TOML."""
    versions: dict[str, str] = field(default_factory=dict)
    """Of uwblite, Python and the libraries."""
    preset: str = ""
    seconds: float = 0.0
    """Wall time of the whole run; 0 = not to be recorded."""
    reading_seconds: float = 0.0
    peak_rss_bytes: int = 0
    timings_in_report: bool = False
    """Show the stages' seconds in report.html too; it then differs from run to run."""
    scale_map: bool = False
    """Write the map as probabilities too: map_scale.png and its YAML."""


def check_target(folder: str | os.PathLike[str], *, force: bool) -> None:
    """Refuse a folder that cannot or must not be written, before the work is done.

    Raises
    ------
    ConfigError : it holds a result and force is not given, or it is not a folder.
    OSError : it cannot be written.
    """
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ConfigError(f"{path} is not a folder; choose another --out")
    held = sorted(p.name for p in path.iterdir() if _CONTRACT.fullmatch(p.name)) if path.is_dir() else []
    if held and not force:
        raise ConfigError(f"{path} already holds a result ({held[0]}, ...); use --force to replace it, or another --out")
    nearest = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(13, os.strerror(13), str(nearest))


def write_result(
    folder: str | os.PathLike[str], logs: Sequence[SensorLog], result: MapResult, record: RunRecord
) -> list[str]:
    """Write a result into a folder, made where it is missing; files of an earlier result are replaced.

    Parameters
    ----------
    folder : where to write.
    logs : the recordings, in the order of the result's sessions.
    result, record : what was made of them, and how.

    Returns
    -------
    Names of the files, in the order in which a user wants to see them.

    Raises
    ------
    OSError : the disk is full or cannot be written; an earlier result is untouched.
    """
    with _replacing(Path(folder)) as waiting:
        _write_trajectories(waiting, result)
        write_text(waiting / "trajectory_covariance.csv", covariance_csv(result))
        write_text(waiting / "anchors.csv", anchors_csv(result))
        grid_png = None
        if result.grid is not None:
            write_map(waiting, result.grid)
            grid_png = encode_png(trinary_image(result.grid))
            if record.scale_map:
                write_map(waiting, result.grid, name="map_scale", mode="scale")
        write_png(waiting / "map.png", picture(result, ", ".join(os.path.basename(log.notes.source) for log in logs)))
        _write_graphs(waiting, result)
        write_text(waiting / "config.toml", record.config)
        page = render(
            result,
            title=_title(logs),
            command=record.command,
            facts=_facts(logs, result, record),
            grid_png=grid_png,
            timings=record.timings_in_report,
        )
        write_text(waiting / "report.html", page)
        hashes = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(waiting.iterdir())}
        write_text(waiting / "report.json", _json_lines(summary(logs, result, record, hashes)))
        names = sorted((p.name for p in waiting.iterdir()), key=_order)
    return names


def _order(name: str) -> tuple[int, str]:
    first = ("map.png", "report.html", "map.yaml", "map.pgm", "trajectory.tum", "anchors.csv", "report.json")
    return (first.index(name) if name in first else len(first), name)


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """Give a folder to write into; when the block ends well its files take their places.

    A new folder appears whole, by one rename. Into an existing one the finished files are renamed one by one, which
    needs no space and no time; files of an earlier result that have no successor go.
    """
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = not folder.is_dir()
    home = folder.absolute().parent if fresh else folder
    for left in home.glob(f"{_WAITING}*" if not fresh else f".{folder.name}{_WAITING}*"):
        shutil.rmtree(left, ignore_errors=True)
    waiting = home / f"{f'.{folder.name}' if fresh else ''}{_WAITING}{secrets.token_hex(4)}"
    waiting.mkdir()
    try:
        yield waiting
        if fresh:
            with suppress(OSError):
                folder.rmdir()
            os.replace(waiting, folder)
            return
        names = {p.name for p in waiting.iterdir()}
        for name in sorted(names, key=lambda n: (n == "report.json", n)):
            os.replace(waiting / name, folder / name)
        for old in folder.iterdir():
            if _CONTRACT.fullmatch(old.name) and old.name not in names:
                old.unlink()
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


def _title(logs: Sequence[SensorLog]) -> str:
    return ", ".join(log.notes.source or "recording" for log in logs)


def _write_trajectories(folder: Path, result: MapResult) -> None:
    for session in np.unique(result.session).tolist():
        mine = result.session == session
        name = "trajectory.tum" if session == 0 else f"trajectory_{session + 1}.tum"
        write_tum(folder / name, result.stamps[mine], result.trajectory[mine])


def _write_graphs(folder: Path, result: MapResult) -> None:
    write_g2o(folder / "graph.g2o", result.graph)
    ids = tuple(a.id for a in result.anchors)
    write_pyfg(folder / "graph.pyfg", result.graph, ids, result.keyframe_stamps)
    rows = "".join(f"{k},{stamp:.6f}\n" for k, stamp in enumerate(result.keyframe_stamps.tolist()))
    write_text(folder / "graph_stamps.csv", "id,stamp\n" + rows)


def _decimal(value: float, digits: int = 6) -> str:
    """Return a number for a CSV file; empty where it is not finite."""
    return f"{value + 0.0:.{digits}f}" if np.isfinite(value) else ""


def covariance_csv(result: MapResult) -> str:
    """Return stamp and covariance (upper triangle; m^2, m rad, rad^2; map frame) of every keyframe as CSV."""
    lines = ["stamp,xx,xy,xtheta,yy,ytheta,thetatheta"]
    upper = np.triu_indices(3)
    for stamp, matrix in zip(result.keyframe_stamps.tolist(), result.keyframe_covariances, strict=True):
        lines.append(f"{stamp:.6f}," + ",".join(f"{v:.6e}" for v in matrix[upper].tolist()))
    return "\n".join(lines) + "\n"


def anchors_csv(result: MapResult) -> str:
    """Return the anchors as CSV; positions, sigmas and biases in metres, empty where unknown."""
    lines = [
        "id,x,y,sigma_x,sigma_y,ranges,used_share,bias,bias_sigma,residual_rms,status,"
        "covariance_xy,alternative_x,alternative_y,reason"
    ]
    for a in result.anchors:
        other = np.full(2, np.nan) if a.alternative is None else a.alternative
        sigmas = np.sqrt(np.maximum(np.diag(a.covariance), 0.0))
        values = (
            a.id,
            *(_decimal(v) for v in (*a.position, *sigmas)),
            str(a.ranges),
            *(_decimal(v, 4) for v in (a.used_share, a.bias, a.bias_sigma, a.residual_rms)),
            a.status,
            _decimal(a.covariance[0, 1], 9),
            *(_decimal(v) for v in other),
            a.reason,
        )
        lines.append(",".join(map(_quoted, values)))
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if re.search(r'[",\r\n]', text) else text


def picture(result: MapResult, caption: str) -> NDArray[np.uint8]:
    """Return the picture of the map with path, anchors and accepted closures."""
    parts = [np.vstack([result.trajectory[result.session == s, :2], [[np.nan, np.nan]]]) for s in np.unique(result.session)]
    poses = result.graph.poses
    kept = [(*poses[c.i, :2], *poses[c.j, :2]) for c in result.closures if c.accepted]
    anchors = [PictureAnchor(a.id, a.position, a.covariance) for a in result.anchors]
    closures = np.array(kept, dtype=np.float64).reshape(-1, 4)
    return draw_map(result.grid, np.vstack(parts), anchors=anchors, closures=closures, caption=caption)


def _travelled(result: MapResult) -> float:
    steps = np.hypot(*np.diff(result.trajectory[:, :2], axis=0).T)
    return float(steps[np.diff(result.session) == 0].sum())


def _facts(logs: Sequence[SensorLog], result: MapResult, record: RunRecord) -> tuple[tuple[str, str], ...]:
    sums = _recording(logs, result)
    facts = [
        ("recording", "{duration:.0f} s, {travelled:.1f} m, {ranges} ranges, {scans} scans".format(**sums)),
        *(("sha256", log.notes.sha256) for log in logs),
        ("settings", record.preset or "defaults"),
        ("made by", ", ".join(f"{name} {version}" for name, version in record.versions.items())),
    ]
    return tuple((name, value) for name, value in facts if value)


def summary(logs: Sequence[SensorLog], result: MapResult, record: RunRecord, hashes: dict[str, str]) -> dict[str, Any]:
    """Return the result as report.json has it (JSON-ready); see docs/formats.md."""
    grid = result.grid
    content = {
        "schema": SCHEMA,
        "versions": record.versions,
        "command": record.command,
        "preset": record.preset,
        "config_sha256": hashlib.sha256(record.config.encode()).hexdigest(),
        "inputs": [_input_entry(log.notes) for log in logs],
        "recording": _recording(logs, result),
        "trusted": not result.doubts,
        "doubts": list(result.doubts),
        "warnings": list(result.warnings),
        "anchors": [_anchor_entry(a) for a in result.anchors],
        "calibration": [{name: getattr(c, name) for name in _CALIBRATION_FIELDS} for c in result.calibration],
        "closures": [_closure_entry(c, result.keyframe_stamps) for c in result.closures],
        "stages": [{"name": s.name, **s.figures} for s in result.stages],
        "map": None
        if grid is None
        else {
            "resolution": grid.geometry.resolution,
            "origin": grid.geometry.origin,
            "rows": grid.geometry.rows,
            "cols": grid.geometry.cols,
            "scans_used": grid.scans_used,
        },
        "files": hashes,
    }
    if record.seconds:
        content["timings"] = {
            "total": round(record.seconds, 3),
            "reading": round(record.reading_seconds, 3),
            "stages": [[s.name, round(s.seconds, 4)] for s in result.stages],
            "peak_rss_bytes": record.peak_rss_bytes,
        }
    ready: dict[str, Any] = _ready(content)
    return ready


def _recording(logs: Sequence[SensorLog], result: MapResult) -> dict[str, Any]:
    """Return duration, s, distance, m, and counts of all recordings together."""
    return {
        "duration": sum(float(log.odometry.stamps[-1] - log.odometry.stamps[0]) for log in logs),
        "travelled": _travelled(result),
        "odometry": sum(len(log.odometry.stamps) for log in logs),
        "ranges": sum(0 if log.ranges is None else len(log.ranges.stamps) for log in logs),
        "scans": sum(0 if log.scans is None else len(log.scans.stamps) for log in logs),
    }


def _input_entry(notes: LogNotes) -> dict[str, Any]:
    return {
        "source": notes.source,
        "sha256": notes.sha256,
        "lines": notes.lines,
        "broken_lines": notes.broken,
        "first_broken": [{"line": number, "why": why} for number, why in notes.broken_lines],
        "skipped": notes.skipped,
        "reader_warnings": list(notes.warnings),
    }


def _json_lines(content: dict[str, Any]) -> str:
    """Return JSON with a line for each field, and for each entry of a list of tables."""

    def text(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n  " + ",\n  ".join(json.dumps(v, allow_nan=False) for v in value) + "\n ]"
        return json.dumps(value, allow_nan=False)

    return "{\n " + ",\n ".join(f"{json.dumps(k)}: {text(v)}" for k, v in content.items()) + "\n}\n"


def _anchor_entry(anchor: Any) -> dict[str, Any]:
    names = ("id", "position", "covariance", "ranges", "used_share", "bias", "bias_sigma", "residual_rms", "status", "reason")
    return {name: getattr(anchor, name) for name in (*names, "alternative")}


def _closure_entry(closure: Any, stamps: NDArray[np.float64]) -> dict[str, Any]:
    names = ("i", "j", "T_i_j", "information", "fitness", "overlap", "accepted", "reason")
    entry = {name: getattr(closure, name) for name in names}
    return {**entry, "stamp_i": float(stamps[closure.i]), "stamp_j": float(stamps[closure.j])}


def _ready(value: Any) -> Any:
    """Return a value as JSON has it: nine significant digits, null where it is not finite."""
    if isinstance(value, dict):
        return {str(k): _ready(v) for k, v in value.items()}
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_ready(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if np.isfinite(value) else None
    return value


