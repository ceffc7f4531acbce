"""The folder that `uwblite map` writes, all of its files or none; docs/formats.md lists them.

A result is replaced as a whole, see folders.py. report.json holds the hash of every other file.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import ConfigError
from ..map_result import MapResult
from ..report.drawn_map import drawn_map
from ..report.html import Heading, render
from ..report.picture import draw_map
from ..report.printable import duration
from ..sensor_log import SensorLog
from .files import sha256_of, write_text
from .folders import check_free, refuse_foreign, replacing_folder
from .g2o import write_g2o
from .graph_file import plain_edges
from .map_server import trinary_image, write_map
from .png import encode_png, write_png
from .pyfg import write_pyfg
from .result_text import (
    RunRecord,
    anchors_csv,
    base_name,
    covariance_csv,
    json_lines,
    range_errors_csv,
    recording_figures,
    settings_line,
    stamps_csv,
    summary,
)
from .stored_result import is_of_result, repair_result
from .tum import write_tum


def check_target(folder: str | os.PathLike[str], *, force: bool) -> None:
    """Refuse a folder that cannot be written (OSError), or that holds a result or files that must stay (ConfigError)."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ConfigError(f"{path} is not a folder; choose another `folder`")
    present = sorted(p.name for p in path.iterdir() if is_of_result(p.name)) if path.is_dir() else []
    if present and not force:
        raise ConfigError(f"{path} already holds a result ({present[0]}, ...); use `force` to replace it, or another `folder`")
    check_free(path, is_of_result)
    if present:
        repair_result(path)
        refuse_foreign(path / name for name in present if not _is_written(path, name))
    nearest = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(13, os.strerror(13), str(nearest))


def _is_written(folder: Path, name: str) -> bool:
    """Return whether a file is as the result in its folder was written: report.json knows the hash of every other file."""
    try:
        hashes = json.loads((folder / "report.json").read_bytes())["files"]
        return name == "report.json" or hashes.get(name) == sha256_of(folder / name)
    except (OSError, ValueError, RecursionError, LookupError, TypeError, AttributeError):
        return not (folder / name).exists()


def write_result(folder: str | os.PathLike[str], logs: Sequence[SensorLog], result: MapResult, record: RunRecord) -> list[str]:
    """Write a result into a folder, made where it is missing, in place of an earlier one, untouched where an error is raised.

    Parameters
    ----------
    logs : the recordings, in the order of the result's recordings.

    Returns
    -------
    Names of the files, in the order in which a user wants to see them.
    """
    check_target(folder, force=True)
    with replacing_folder(folder, is_of_result) as waiting:
        for number in np.unique(result.recording).tolist():
            chosen, name = result.recording == number, f"trajectory_{number + 1}.tum" if number else "trajectory.tum"
            write_tum(waiting / name, result.stamps[chosen], result.trajectory[chosen])
        stamps, recording = result.keyframe_stamps, result.keyframe_recording
        table = covariance_csv(stamps, result.keyframe_covariances, recording, result.trusted(stamps, recording))
        write_text(waiting / "trajectory_covariance.csv", table)
        write_text(waiting / "anchors.csv", anchors_csv(result))
        if result.range_table:
            write_text(waiting / "range_errors.csv", range_errors_csv(result))
        grid_png = None
        if result.grid is not None:
            write_map(waiting, result.grid)
            grid_png = encode_png(trinary_image(result.grid))
            if record.scale_map:
                write_map(waiting, result.grid, name="map_scale", mode="scale")
        write_png(waiting / "map.png", draw_map(drawn_map(result), caption=_caption(logs, result)))
        ids, plain = tuple(a.id for a in result.anchors), plain_edges(result.graph)
        write_g2o(waiting / "graph.g2o", result.graph, plain=plain)
        write_pyfg(waiting / "graph.pyfg", result.graph, ids, result.keyframe_stamps, plain=plain)
        write_text(waiting / "graph_stamps.csv", stamps_csv(result))
        write_text(waiting / "config.toml", record.config)
        heading = Heading(_title(logs), record.command, _lead(logs, result), _facts(logs, record))
        page = render(result, heading, grid_png)
        write_text(waiting / "report.html", page)
        hashes = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(waiting.iterdir())}
        write_text(waiting / "report.json", json_lines(summary(logs, result, record, hashes)))
        return sorted((p.name for p in waiting.iterdir()), key=_order)


def _order(name: str) -> tuple[int, str]:
    first = ("map.png", "report.html", "map.yaml", "map.pgm", "trajectory.tum", "anchors.csv", "report.json")
    return (first.index(name) if name in first else len(first), name)


def _title(logs: Sequence[SensorLog]) -> str:
    return ", ".join(base_name(log.notes.source) or "recording" for log in logs)


def _caption(logs: Sequence[SensorLog], result: MapResult) -> str:
    """Return what the picture shows in a line: a name alone, mostly run.log, means nothing."""
    sums, kept = recording_figures(logs, result), sum(c.accepted for c in result.closures)
    driven = f"{sums['travelled']:.0f} m in {duration(sums['duration'])}"
    counts = f"{driven}, {len(result.anchors)} anchors, {kept} closures"
    return f"{_title(logs[:2])}{' ...' if len(logs) > 2 else ''}: {counts}"


def _lead(logs: Sequence[SensorLog], result: MapResult) -> str:
    """Return recording and map in a line."""
    sums, kept = recording_figures(logs, result), sum(c.accepted for c in result.closures)
    driven = f"{duration(sums['duration'])}, {sums['travelled']:.1f} m, {sums['ranges']} ranges, {sums['scans']} scans"
    closures, size = f"{kept} of {len(result.closures)} loop closures" if result.closures else "", ""
    if result.grid is not None:
        g = result.grid.geometry
        size = f"{g.cols * g.resolution:.1f} x {g.rows * g.resolution:.1f} m at {g.resolution:g} m"
    return "; ".join(filter(None, (driven, size, closures)))


def _facts(logs: Sequence[SensorLog], record: RunRecord) -> tuple[tuple[str, str], ...]:
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    facts = (("settings", settings_line(record.preset, record.changed)), ("made by", versions))
    return tuple((name, value) for name, value in (*(("sha256", log.notes.sha256) for log in logs), *facts) if value)
