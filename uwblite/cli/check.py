"""`uwblite check`: is a recording fit to be mapped, and what is to be done about it."""

import argparse
import dataclasses
import time
from typing import Any

from ..assessment.recording import Diagnosis, diagnose, screened
from ..errors import UwbliteError
from ..findings import folded
from ..pipeline.expected_cost import SECONDS_AT_LEAST, expected_cost
from ..report.printable import calibration_text, duration, percent, signed
from ..sensor_log import SensorLog
from . import console
from .inputs import recording


def run(args: argparse.Namespace) -> int:
    log = recording(args, args.log)
    began = time.perf_counter()
    repaired = screened(log)
    needs = {} if repaired is None else expected_cost(repaired)
    if args.map:
        diagnosis, seconds = examined(log, repaired, began)
        needs |= {"seconds": round(seconds, 1)} if needs else {}
    else:
        diagnosis = diagnose(log, repaired=repaired)
    console.report(
        args.json, summary_json(args.log, diagnosis, needs), report_lines(args.log, diagnosis, needs, mapped=args.map)
    )
    return 3 if diagnosis.doubts else 0


def examined(log: SensorLog, repaired: SensorLog | None, began: float) -> tuple[Diagnosis, float]:
    """Diagnose a recording by mapping it as well: what `uwblite map` will doubt or refuse, this doubts.

    `repaired` is the recording screened, None where a map refuses it. Returns also the seconds that `uwblite map` will take.
    """
    from ..mapping import MappingConfig, build_map
    from ..pipeline.recordings import thinned

    config = MappingConfig()
    try:
        made = build_map(log if repaired is None else thinned(repaired, config.keyframes, config.grid), config)
    except UwbliteError as error:
        return diagnose(log, refused=str(error), repaired=repaired), SECONDS_AT_LEAST
    seconds = SECONDS_AT_LEAST + time.perf_counter() - began
    return diagnose(log, result=made, repaired=repaired), seconds


def summary_json(name: str, diagnosis: Diagnosis, cost: dict[str, float]) -> dict[str, Any]:
    return {
        "log": name,
        "findings": [dataclasses.asdict(f) for f in diagnosis.findings],
        "figures": diagnosis.figures,
        "expected cost of map": cost,
        "exit_code": 3 if diagnosis.doubts else 0,
    }


def report_lines(name: str, diagnosis: Diagnosis, cost: dict[str, float], *, mapped: bool) -> list[str]:
    """Return the findings and figures as lines of text; what a finding explains stands below it."""
    lines = [f"{name}: {_counts(diagnosis.figures)}", ""]
    for finding, explains in folded(diagnosis.findings):
        sensor = f"{finding.sensor}: " if finding.sensor else ""
        lines.append(f"{finding.severity.upper():<8} {sensor}{finding.text}")
        lines += [f"         -> {finding.cure}"] if finding.cure else []
        lines += [f"         explains {other.severity}: {other.text}" for other in explains]
    if not diagnosis.findings:
        lines.append("nothing to complain about")
    lines += ["", *_anchor_lines(diagnosis.figures)]
    values = diagnosis.figures.get("radio calibration", {}).items()
    lines += [calibration_text(name, **value) for name, value in values if "value" in value and ":" not in name]
    if cost:
        grid = f", a map of {cost['map width m']:.0f} x {cost['map height m']:.0f} m" if cost["map cells"] else ""
        lines.append(f"expected cost: about {cost['seconds']:.0f} s, {cost['megabytes']:.0f} MB{grid}")
    if not mapped:
        lines.append(_ONLY_A_MAP)
    doubts = len(diagnosis.doubts)
    lines.append(
        f"fix the {doubts} doubt{'s' if doubts > 1 else ''} first" if doubts else f"next: uwblite map {name} --out map/"
    )
    return lines


_ONLY_A_MAP = (
    "only a map tells: scales, biases and clock offsets; anchors that moved or have a mirror image; whether the sensors agree "
    "throughout (--map here, or `uwblite map`)"
)


def _counts(figures: dict[str, Any]) -> str:
    odometry = figures["odometry"]
    span, readings = duration(odometry["duration s"]), f"{odometry['count']} odometry readings"
    parts = [f"{span}, {odometry['path m']:.1f} m by {readings}"]
    parts[0] += f" ({odometry['rate Hz']:.1f} Hz)"
    if "uwb" in figures:
        many = len(figures["uwb"]["anchors"])
        parts.append(f"{figures['uwb']['count']} ranges to {many} anchor{'s' if many != 1 else ''}")
    if "lidar" in figures:
        lidar = figures["lidar"]
        parts.append(
            f"{lidar['count']} scans of {lidar['beams']} beams over {lidar['field of view deg']:.0f} deg"
            f" ({lidar['rate Hz']:.1f} Hz, {percent(lidar['share of beams that hit'])} hit)"
        )
    return ", ".join(parts)


def _anchor_lines(figures: dict[str, Any]) -> list[str]:
    lines = []
    guesses = figures.get("radio calibration", {}).get("bias guess m", {})
    for anchor_id, a in figures.get("uwb", {}).get("anchors", {}).items():
        line = f"anchor {anchor_id}: {a['count']} ranges"
        if "noise m" in a:
            line += (
                f" ({a['rate Hz']:.2f} Hz) of {a['nearest m']:.2f} to {a['farthest m']:.2f} m, noise {a['noise m']:.3f} m,"
                f" {a['zeros']} zero, {a['absurd']} absurd, {a['spikes']} spikes"
            )
        if anchor_id in guesses:
            line += f", bias guess {signed(guesses[anchor_id]['bias'], plus=True)} \u00b1{guesses[anchor_id]['sigma']:.2f} m"
        lines.append(line)
    if coverage := figures.get("uwb", {}).get("coverage"):
        lines.append("anchors in reach: " + ", ".join(f"{name} {percent(share)}" for name, share in coverage.items()))
    return lines
