"""`uwblite map`: from recordings to a map."""

import argparse
import os
import shlex
from contextlib import closing
from functools import partial
from typing import Any

from ..errors import UsageError
from ..findings import DOUBT, folded
from ..io.corrected_log import poses_of_scans, write_corrected_log
from ..io.folders import sole_writer
from ..io.formats import format_of
from ..io.results import check_target
from ..mapping import Stage
from ..pipeline.expected_cost import expected_cost, together
from ..pipeline.recordings import prepared
from ..report.printable import anchor_line, calibration_text, duration
from . import console
from .inputs import name_recordings_once
from .making import Made, Recordings, make, note_cost, peak_memory, read_logs, settings
from .memory import shortage
from .workers import workers


def run(args: argparse.Namespace) -> int:
    name_recordings_once(args)
    _check_corrected_log(args)
    if args.dry_run:
        return _dry_run(args)
    with sole_writer(args.out):
        check_target(args.out, force=args.force)
        return _map(args)


def _map(args: argparse.Namespace) -> int:
    made = _make_shown(args, _read(args))
    if args.corrected_log:
        _write_corrected_log(args, made)
    console.report(args.json, summary_json(args, made), summary_lines(args, made))
    return 3 if made.result.doubts else 0


def _read(args: argparse.Namespace) -> Recordings:
    """Return the recordings of the command line; what is wrong with their files is said."""
    with workers(args.jobs if len(args.logs) > 1 else 1) as executor:
        recordings = read_logs(args, executor)
    for notes in (log.notes for log in recordings.logs):
        if notes.broken:
            number, why = notes.broken_lines[0]
            console.note(f"uwblite: {notes.broken} broken lines skipped; the first is line {number}: {why}")
        console.note_of(notes.source, notes.warnings)
    return recordings


def _check_corrected_log(args: argparse.Namespace) -> None:
    """Refuse --corrected-log beforehand where it cannot be written."""
    if not args.corrected_log:
        return
    if len(args.logs) > 1 or args.logs[0] == "-" or format_of(args.logs[0]) in ("bag", "csv"):
        raise UsageError("--corrected-log needs one CARMEN log in a file: its lines are read once more; see uwblite convert")
    if os.path.exists(args.corrected_log) and not args.force:
        raise UsageError(f"{args.corrected_log} is there already; give --force to replace it")
    if os.path.exists(args.corrected_log) and os.path.samefile(args.corrected_log, args.logs[0]):
        raise UsageError("--corrected-log names the log itself; give another file")


def _write_corrected_log(args: argparse.Namespace, made: Made) -> None:
    poses = partial(poses_of_scans, made.result, made.logs[0])
    written, left_out = write_corrected_log(args.corrected_log, args.logs[0], poses)
    if left_out:
        console.note(
            f"uwblite: {args.corrected_log} has {written} scans; {left_out} laser messages are broken or outside the "
            "trajectory's time and were left out"
        )
    elif not written:
        console.note(f"uwblite: {args.corrected_log} has no scans: the log has no FLASER, ROBOTLASER1 or RAWLASER1 messages")


def _make_shown(args: argparse.Namespace, recordings: Recordings) -> Made:
    """Map recordings with a progress bar, on the processes or the cluster that the command line asks for."""
    lidar = "lidar" not in args.without and any(log.scans is not None for log in recordings.logs)
    progress, overall = console.Progress(), Overall(lidar=lidar)

    def report(stage: Stage, done: int, total: int) -> None:
        if stage.detail:
            console.note(f"uwblite: {stage}")
        progress(stage, done, total, overall.take(stage, done, total))

    with closing(progress), workers(args.jobs, args.scheduler) as executor:
        return make(args, recordings, report, executor, console.note)


def _dry_run(args: argparse.Namespace) -> int:
    config = settings(args)
    costs = [expected_cost(prepared(log, config), config.grid) for log in _read(args).logs]
    rows = [{"log": name, "expected cost of map": each} for name, each in zip(args.logs, costs, strict=True)]
    whole = together(costs)
    summary = {"recordings": rows, "expected cost of map": whole, "exit_code": 0}
    lines = [_cost_line(log, cost) for log, cost in zip(args.logs, costs, strict=True)]
    console.report(args.json, summary, [*lines, _cost_line("all together", whole)] if len(lines) > 1 else lines)
    note_cost(shortage(whole["megabytes"]), whole["seconds"], console.note)
    return 0


def _cost_line(name: str, cost: dict[str, float]) -> str:
    grid = f", a map of {cost['map width m']:.0f} x {cost['map height m']:.0f} m" if cost.get("map cells") else ""
    return f"{name}: about {cost['seconds']:.0f} s of a desktop computer, {cost['megabytes']:.0f} MB{grid}"


def summary_json(args: argparse.Namespace, made: Made) -> dict[str, Any]:
    """Return the summary for programs; report.json has everything."""
    result = made.result
    return {
        "out": args.out,
        "files": [os.path.join(args.out, name) for name in made.names],
        "trusted": not result.doubts,
        "doubts": [finding.record() for finding in result.doubts],
        "warnings": [finding.record() for finding in result.warnings],
        "anchors": {
            a.id: {"x": a.position[0], "y": a.position[1], "bias": a.bias, "ranges": a.ranges, "status": a.status}
            for a in result.anchors
        },
        "closures": {"accepted": sum(c.accepted for c in result.closures), "candidates": len(result.closures)},
        "calibration": {c.name: c.value for c in result.calibration if c.state == "estimated"},
        "seconds": round(made.seconds, 3),
        "peak_rss_bytes": peak_memory(),
        "exit_code": 3 if result.doubts else 0,
    }


_LABELS = {"doubt": "DOUBT", "warning": "warning", "note": "note"}


def summary_lines(args: argparse.Namespace, made: Made) -> list[str]:
    result, seconds = made.result, made.seconds
    span = sum(float(log.odometry.stamps[-1] - log.odometry.stamps[0]) for log in made.logs)
    lines = [f"mapped {duration(span)} of driving in {duration(seconds)} ({span / max(seconds, 1e-9):.0f} times real time)"]
    kept = sum(c.accepted for c in result.closures)
    if result.grid is not None:
        g = result.grid.geometry
        size = f"{g.cols * g.resolution:.1f} x {g.rows * g.resolution:.1f} m at {g.resolution:g} m"
        lines[0] += f": {size}, {len(result.keyframe_stamps)} keyframes, {kept} of {len(result.closures)} loop closures"
    lines += [anchor_line(a) for a in result.anchors]
    shown = (c for c in result.calibration if c.state == "estimated" and c.key.anchor is None and abs(c.value) > 2.0 * c.sigma)
    lines += [calibration_text(c.name, c.value, c.sigma, c.unit, c.meaning) for c in shown]
    groups = sorted(folded(result.findings), key=lambda group: any(f.severity == DOUBT for f in (group[0], *group[1])))
    for cause, explains in groups:
        lines.append(f"{_LABELS[cause.severity]}: {cause}")
        lines += [f"  {cause.cure}"] if cause.severity == DOUBT and cause.cure else []
        lines += [f"  explains {_LABELS[other.severity]}: {other}" for other in explains]
    if result.doubted_stretches:
        lines.append("the rest of the map is as good as it states; map.png marks the stretches that are not")
    lines.append("files: " + " ".join(os.path.join(args.out, name) for name in made.names))
    page, out = shlex.quote(os.path.join(args.out, "report.html")), shlex.quote(args.out)
    lines.append(f"next: open {page} in a browser, or: uwblite view {out}")
    return lines


_SHARES = {
    "keyframes": (0.04, 0.03),
    "edges": (0.01, 0.01),
    "bootstrap": (0.02, 0.24),
    "first optimisation": (0.03, 0.26),
    "constraints": (0.01, 0.01),
    "clouds": (0.04, 0.0),
    "keyframes added": (0.03, 0.0),
    "scan-to-scan matching": (0.36, 0.0),
    "clouds made again": (0.06, 0.0),
    "ranges re-estimated": (0.02, 0.0),
    "loose links": (0.01, 0.0),
    "long stretches": (0.01, 0.0),
    "loop closure": (0.18, 0.0),
    "second optimisation": (0.01, 0.01),
    "joint refinement": (0.11, 0.0),
    "matched once more": (0.01, 0.0),
    "surfaces": (0.05, 0.0),
    "scans between keyframes": (0.07, 0.0),
    "map consistency": (0.01, 0.0),
    "landmark distances": (0.01, 0.01),
    "occupancy grid": (0.05, 0.01),
    "summary": (0.01, 0.42),
}
"""Share of the work of each stage, in the order in which they come: with lidar the means over two recordings with radio and six
without, and the means over two with radio alone, where the last optimisation counts to the summary."""


class Overall:
    def __init__(self, *, lidar: bool = True) -> None:
        self._shares = [(name, with_lidar if lidar else alone) for name, (with_lidar, alone) in _SHARES.items()]
        self.share = 0.0
        """Of the whole work, 0..1; never falls."""

    def take(self, stage: Stage, done: int, total: int) -> float:
        """Return the share of the whole work that is done; a stage that is not known leaves it as it is.

        Each lap of a stage, whose number is not known beforehand, takes half of what is left of its share.
        """
        within = min(done / total, 1.0) if total > 0 else 0.0
        if stage.lap:
            within = 1.0 - 0.5 ** (stage.lap - 1 + within)
        before = 0.0
        whole = sum(share for _, share in self._shares)
        for known, share in self._shares:
            if known == stage.name:
                self.share = max(self.share, (before + share * within) / whole)
                break
            before += share
        return self.share
