"""A result as text: report.json and the CSV files of anchors and covariances."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats, Ints
from ..map_result import MapResult
from ..report.printable import csv_field, json_ready
from ..sensor_log import LogNotes, SensorLog

SCHEMA = 3
"""Version of report.json; it grows when a field changes its meaning or goes."""

_ANCHOR_FIELDS: tuple[str, ...] = ("id", "position", "covariance", "ranges", "used_share", "bias", "bias_sigma", "residual_rms")
_ANCHOR_FIELDS += ("status", "reason", "alternative")
_GRID_FIELDS = ("resolution", "origin", "rows", "cols")
_CALIBRATION_FIELDS = ("name", "value", "sigma", "unit", "meaning", "state", "reason")


@dataclass(frozen=True, slots=True)
class RunRecord:
    """What is to be remembered of the run that made a result."""

    command: str
    """Command line that makes the same map again."""
    config: str
    """Effective settings as TOML."""
    versions: dict[str, str] = field(default_factory=dict)
    """Of uwblite, Python and the libraries."""
    given: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the files that are named beside recordings and settings, by the name of their option."""
    preset: str = ""
    changed: tuple[str, ...] = ()
    """Settings that differ from the preset's, as --set takes them."""
    seconds: float = 0.0
    """Wall time of the whole run; 0 = not to be recorded."""
    reading_seconds: float = 0.0
    peak_rss_bytes: int = 0
    scale_map: bool = False
    """Write the map as probabilities too: map_scale.png and its YAML."""


def settings_line(preset: str, changed: Sequence[str]) -> str:
    """Return in one line which settings a map was made with."""
    return " with ".join(filter(None, (preset or "defaults", ", ".join(changed))))


def _decimal(value: float, digits: int = 6) -> str:
    """Return a number for a CSV file; empty where it is not finite."""
    return f"{value + 0.0:.{digits}f}" if np.isfinite(value) else ""


def covariance_csv(stamps: Floats, covariances: Floats, recordings: Ints | None = None, trusted: Bools | None = None) -> str:
    """Return stamp, covariance (upper triangle; m^2, m rad, rad^2; map frame), recording and trust of every pose as CSV.

    Parameters
    ----------
    recordings : (n,) of each pose, from 0; None = there is one. trusted : (n,) poses that no doubt concerns; None = all.
    """
    lines = ["stamp,xx,xy,xtheta,yy,ytheta,thetatheta,recording,trusted"]
    upper = np.triu_indices(3)
    owners = [0] * len(stamps) if recordings is None else recordings.tolist()
    sound = [True] * len(stamps) if trusted is None else trusted.tolist()
    for stamp, matrix, recording, trust in zip(stamps.tolist(), covariances, owners, sound, strict=True):
        lines.append(f"{stamp:.6f}," + ",".join(f"{v:.6e}" for v in matrix[upper].tolist()) + f",{recording + 1},{trust:d}")
    return "\n".join(lines) + "\n"


def stamps_csv(result: MapResult) -> str:
    """Return number, stamp (s, on the clock of its recording) and recording of every pose of the graph as CSV."""
    rows = zip(result.keyframe_stamps.tolist(), result.keyframe_recording.tolist(), strict=True)
    return "id,stamp,recording\n" + "".join(f"{k},{stamp:.6f},{recording + 1}\n" for k, (stamp, recording) in enumerate(rows))


def anchors_csv(result: MapResult) -> str:
    """Return the anchors as CSV; positions, sigmas and biases in metres, empty where unknown."""
    lines = [
        "id,x,y,sigma_x,sigma_y,ranges,used_share,bias,bias_sigma,residual_rms,status,"
        "covariance_xy,alternative_x,alternative_y,reason,since"
    ]
    for a in result.anchors:
        other = np.full(2, np.nan) if a.alternative is None else a.alternative
        places = [_decimal(v) for v in (*a.position, *np.sqrt(np.maximum(np.diag(a.covariance), 0.0)))]
        figures = [_decimal(v, 4) for v in (a.used_share, a.bias, a.bias_sigma, a.residual_rms)]
        alternative = [_decimal(v) for v in other]
        values = (a.id, *places, str(a.ranges), *figures, a.status, _decimal(a.covariance[0, 1], 9), *alternative)
        lines.append(",".join(map(csv_field, (*values, a.reason, _decimal(a.since)))))
    return "\n".join(lines) + "\n"


def range_errors_csv(result: MapResult) -> str:
    """Return the error of every range to an anchor that has a place, with the tag's place and the base's heading, as CSV.

    The error is measured minus expected, the anchor's bias taken off.
    """
    lines, table = ["stamp,anchor,range,error,weight,x,y,theta,recording"], result.range_table
    columns = [np.asarray(table[name]).tolist() for name in _RANGE_COLUMNS] if table else []
    names = [csv_field(a.id) if np.isfinite(a.position).all() else None for a in result.anchors]
    for stamp, anchor, metres, residual, weight, x, y, theta, recording in zip(*columns, strict=True):
        name = names[int(anchor)]
        if name is not None and math.isfinite(residual):
            values = f"{metres:.4f},{residual:.4f},{weight:.4f},{x:.4f},{y:.4f},{theta:.5f},{int(recording) + 1}"
            lines.append(f"{stamp:.6f},{name},{values}")
    return "\n".join(lines) + "\n"


_RANGE_COLUMNS = ("stamp", "anchor", "range", "residual", "weight", "x", "y", "theta", "recording")


def summary(logs: Sequence[SensorLog], result: MapResult, record: RunRecord, hashes: dict[str, str]) -> dict[str, Any]:
    """Return the result as report.json has it (JSON-ready); see docs/formats.md."""
    grid = result.grid
    seen = {} if grid is None else {"scans_used": grid.scans_used, "missing_share": grid.missing_share}
    content = {
        "schema": SCHEMA,
        "versions": record.versions,
        "command": record.command,
        "preset": record.preset,
        "changed_settings": list(record.changed),
        "config_sha256": hashlib.sha256(record.config.encode()).hexdigest(),
        "given": record.given,
        "inputs": [_input_entry(log.notes) for log in logs],
        "recording": recording_figures(logs, result),
        "trusted": not result.doubts,
        "doubts": [finding.record() for finding in result.doubts],
        "doubted_stretches": [
            {"recording": number, "start": first, "end": last} for number, first, last in result.doubted_stretches
        ],
        "warnings": [finding.record() for finding in result.warnings],
        "anchors": [{name: getattr(a, name) for name in _ANCHOR_FIELDS} for a in result.anchors],
        "calibration": [{name: getattr(c, name) for name in _CALIBRATION_FIELDS} for c in result.calibration],
        "shape": {"poses": result.shape_poses, "covariances": result.shape_covariances},
        "closures": [_closure_entry(c, result.keyframe_stamps) for c in result.closures],
        "stages": [{"name": s.name, **s.figures, "work": s.work} for s in result.stages],
        "map": None if grid is None else {name: getattr(grid.geometry, name) for name in _GRID_FIELDS} | seen,
        "files": hashes,
    }
    if record.seconds:
        content["timings"] = {
            "total": round(record.seconds, 3),
            "reading": round(record.reading_seconds, 3),
            "stages": [[s.name, round(s.seconds, 4)] for s in result.stages],
            "peak_rss_bytes": record.peak_rss_bytes,
        }
    ready: dict[str, Any] = json_ready(content, _rounded)
    return ready


def recording_figures(logs: Sequence[SensorLog], result: MapResult) -> dict[str, Any]:
    """Return duration, s, distance, m, and counts of all recordings together."""
    steps = np.hypot(*np.diff(result.trajectory[:, :2], axis=0).T)
    return {
        "duration": sum(float(log.odometry.stamps[-1] - log.odometry.stamps[0]) for log in logs),
        "travelled": float(steps[np.diff(result.recording) == 0].sum()),
        "odometry": sum(len(log.odometry.stamps) for log in logs),
        "ranges": sum(0 if log.ranges is None else len(log.ranges.stamps) for log in logs),
        "scans": sum(log.notes.scans_left_out + (0 if log.scans is None else len(log.scans.stamps)) for log in logs),
    }


def base_name(path: str) -> str:
    """Return the last part of a path: what stands in a result must not depend on the folder that the recording lies in."""
    return path.rstrip("/").rpartition("/")[2] or path


def _input_entry(notes: LogNotes) -> dict[str, Any]:
    return {
        "source": base_name(notes.source),
        "sha256": notes.sha256,
        "lines": notes.lines,
        "broken_lines": notes.broken,
        "first_broken": [{"line": number, "why": why} for number, why in notes.broken_lines],
        "skipped": notes.skipped,
        "reader_warnings": list(notes.warnings),
    }


def json_lines(content: dict[str, Any]) -> str:
    """Return JSON with a line for each field, and for each entry of a list of tables."""

    def text(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n  " + ",\n  ".join(json.dumps(v, allow_nan=False) for v in value) + "\n ]"
        return json.dumps(value, allow_nan=False)

    return "{\n " + ",\n ".join(f"{json.dumps(k)}: {text(v)}" for k, v in content.items()) + "\n}\n"


def _closure_entry(closure: Any, stamps: NDArray[np.float64]) -> dict[str, Any]:
    names = ("i", "j", "T_i_j", "information", "fitness", "overlap", "accepted", "outcome", "reason")
    entry = {name: getattr(closure, name) for name in names}
    return {**entry, "stamp_i": float(stamps[closure.i]), "stamp_j": float(stamps[closure.j])}


def _rounded(value: float) -> float:
    """Return nine digits of a measurement; of a time since 1970 a microsecond."""
    return round(value, 6) if abs(value) > 1e3 else float(f"{value:.9g}")
