"""`uwblite map`: from recordings to a map."""

import argparse
import shlex
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from .options import add_bag_arguments, add_mounting_arguments, add_settings_arguments, number, numbers, place
from .workers import add_worker_arguments, workers

if TYPE_CHECKING:
    from ..mapping import Stage
    from ..sensor_log import SensorLog
    from .making import Made

HELP = "map a recording: trajectory, anchors, occupancy grid, report"
EPILOG = """\
examples:
  uwblite map run.log --out map/                       everything at its best
  uwblite map run.log.gz --out map/ --laser-flipped    the laser is mounted upside down
  uwblite map run.log --out a/ --without uwb           what wheels and lidar alone can do
  uwblite map run.log --out b/ --preset paper          the paper's plain choices
  uwblite map run.log --out c/ --set grid.resolution=0.02
  uwblite map run.log --out d/ --align walls --crop 0,0,12,8
  uwblite map monday.log tuesday.log --out both/       one map of several recordings: anchors tie them together
  uwblite map monday.log --out monday/ --anchors-from sunday/anchors.csv    in the frame of Sunday's map
  uwblite map run.bag --out map/ --uwb-mapping uwb.toml    a ROS bag with ranges of one's own kind
  uwblite map run.log --out map/ --scheduler tcp://head:8786    the heavy stages on a cluster of dask.distributed
  uwblite map run.log --dry-run                        read, and estimate time and memory

files in --out: map.png (picture), report.html, map.yaml + map.pgm (map_server, nav2), trajectory.tum (evo),
  trajectory_covariance.csv, anchors.csv, range_errors.csv, graph.g2o, graph.pyfg, graph_stamps.csv, config.toml,
  report.json
exit code 3: the files are written, but the result should not be trusted; the reasons are named
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    several = "CARMEN log, plain or .gz, ROS bag or CSV folder; several are mapped together; - reads a log from standard input"
    parser.add_argument("logs", metavar="LOG", nargs="+", help=several)
    out = parser.add_argument("--out", type=place, metavar="DIR", required=True, help="folder for the result")
    parser.add_argument("--force", action="store_true", help="replace a result that is already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")
    text = "read, estimate time and memory, and map nothing; needs no --out"
    parser.add_argument("--dry-run", action=_Instead, nargs=0, default=False, const=out, help=text)
    text = "the CARMEN log's scans with corrected laser poses, as GMapping's users exchange; one CARMEN log only"
    parser.add_argument("--corrected-log", type=place, metavar="FILE", help=text)
    add_worker_arguments(parser, "processes for the heavy stages (1)")
    add_map_arguments(parser)


class _Instead(argparse.Action):
    """A switch with which another option, its `const`, is not required."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: Any) -> None:
        setattr(namespace, self.dest, True)
        self.const.required = False


def add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a map is made of and how, whether of one recording or of many."""
    without = parser.add_argument("--without", action="append", default=[], choices=("uwb", "loops", "lidar"))
    without.help = "leave out a sensor or the loop closures, to see what they give; repeatable"
    text = "read every n-th laser scan only; the others take neither time nor memory (1)"
    counted = number(above=0, whole=True)
    parser.add_argument("--every-nth-scan", metavar="N", type=counted, default=1, help=text)
    output = parser.add_argument_group("map")
    edge = "edge of a cell, m: short for --set grid.resolution=M"
    output.add_argument("--resolution", metavar="M", type=number(above=0), help=edge)
    align = "where the axes lie: odometry (default), first-pose, walls (along x and y), anchors; short for --set align=HOW"
    output.add_argument("--align", metavar="HOW", choices=("odometry", "first-pose", "walls", "anchors"), help=align)
    box = "keep this part of the grid, m: short for --set crop=[...]"
    output.add_argument("--crop", metavar="X0,Y0,X1,Y1", type=numbers(4), help=box)
    output.add_argument("--scale-map", action="store_true", help="write the probabilities too: map_scale.png (mode: scale)")
    output.add_argument("--no-timings", action="store_true", help="leave timings out of report.json: same run, same bytes")
    output.add_argument("--report-timings", action="store_true", help="show the stages' seconds in report.html too")
    beforehand = parser.add_argument_group("known beforehand")
    text = "surveyed anchors, pinned poses, distances, closures, see docs/formats.md"
    beforehand.add_argument("--constraints", type=place, metavar="FILE.toml", help=text)
    text = "go on in the frame of an earlier map: its anchors.csv; anchors that were moved since are named"
    beforehand.add_argument("--anchors-from", type=place, metavar="FILE.csv", help=text)
    text = "map although it is expected to need more than twice the memory that this computer, control group or shell gives"
    parser.add_argument("--ignore-memory", action="store_true", help=text)
    add_settings_arguments(parser)
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..io.folders import sole_writer
    from ..io.results import check_target
    from .options import name_recordings_once

    name_recordings_once(args)
    _check_corrected_log(args)
    if args.dry_run:
        return _dry_run(args)
    with sole_writer(args.out):
        check_target(args.out, force=args.force)
        return _map(args)


def _map(args: argparse.Namespace) -> int:
    from . import console

    began = time.perf_counter()
    logs = _read(args)
    made = _make_shown(args, logs, time.perf_counter() - began)
    if args.corrected_log:
        _write_corrected_log(args, made)
    console.report(args.json, summary_json(args, made), summary_lines(args, made))
    return 3 if made.result.doubts else 0


def _read(args: argparse.Namespace) -> "list[SensorLog]":
    """Return the recordings of the command line; what is wrong with their files is said."""
    from .making import read_logs

    with workers(args.jobs if len(args.logs) > 1 else 1) as executor:
        logs = read_logs(args, executor)
    _report_reader_warnings(logs)
    return logs


def _check_corrected_log(args: argparse.Namespace) -> None:
    """Refuse --corrected-log beforehand where it cannot be written."""
    import os

    from ..errors import UsageError
    from .formats import format_of

    if not args.corrected_log:
        return
    if len(args.logs) > 1 or args.logs[0] == "-" or format_of(args.logs[0]) in ("bag", "csv"):
        raise UsageError("--corrected-log needs one CARMEN log in a file: its lines are read once more; see uwblite convert")
    if os.path.exists(args.corrected_log) and not args.force:
        raise UsageError(f"{args.corrected_log} is there already; give --force to replace it")
    if os.path.exists(args.corrected_log) and os.path.samefile(args.corrected_log, args.logs[0]):
        raise UsageError("--corrected-log names the log itself; give another file")


def _write_corrected_log(args: argparse.Namespace, made: "Made") -> None:
    from ..io.corrected_log import poses_of_scans, write_corrected_log
    from . import console

    poses = partial(poses_of_scans, made.result, made.logs[0])
    written, left_out = write_corrected_log(args.corrected_log, args.logs[0], poses)
    if left_out:
        console.note(
            f"uwblite: {args.corrected_log} has {written} scans; {left_out} laser messages are broken or outside the "
            "trajectory's time and were left out"
        )


def _make_shown(args: argparse.Namespace, logs: "list[SensorLog]", reading: float) -> "Made":
    """Map recordings with a progress bar, on the processes or the cluster that the command line asks for."""
    from . import console
    from .making import make
    from .stage_shares import Overall

    lidar = "lidar" not in args.without and any(log.scans is not None for log in logs)
    progress, overall = console.Progress(), Overall(lidar=lidar)

    def report(stage: "Stage", done: int, total: int) -> None:
        if stage.detail:
            console.note(f"uwblite: {stage}")
        progress(stage, done, total, overall.take(stage, done, total))

    try:
        with workers(args.jobs, args.scheduler) as executor:
            return make(args, logs, reading, report, executor, console.note)
    finally:
        progress.close()


def _report_reader_warnings(logs: list["SensorLog"]) -> None:
    from . import console

    for notes in (log.notes for log in logs):
        if notes.broken:
            number, why = notes.broken_lines[0]
            console.note(f"uwblite: {notes.broken} broken lines skipped; the first is line {number}: {why}")
        for warning in notes.warnings:
            console.note(f"uwblite: {notes.source}: {warning}")


def _dry_run(args: argparse.Namespace) -> int:
    from ..screening.screen import screen
    from . import console
    from .cost import expected_cost, together
    from .making import settings
    from .memory import shortage

    config = settings(args)
    costs = [expected_cost(screen(log, config.detect_laser_flip), config) for log in _read(args)]
    rows = [{"log": name, "expected cost of map": each} for name, each in zip(args.logs, costs, strict=True)]
    whole = together(costs)
    summary = {"recordings": rows, "expected cost of map": whole, "exit_code": 0}
    lines = [_cost_line(log, cost) for log, cost in zip(args.logs, costs, strict=True)]
    console.report(args.json, summary, [*lines, _cost_line("all together", whole)] if len(lines) > 1 else lines)
    if found := shortage(whole["megabytes"]):
        console.note(f"uwblite: {found.text}")
    return 0


def _cost_line(name: str, cost: dict[str, float]) -> str:
    grid = f", a map of {cost['map width m']:.0f} x {cost['map height m']:.0f} m" if cost.get("map cells") else ""
    return f"{name}: about {cost['seconds']:.0f} s of a desktop computer, {cost['megabytes']:.0f} MB{grid}"


def summary_json(args: argparse.Namespace, made: "Made") -> dict[str, Any]:
    """Return the summary for programs; report.json has everything."""
    import os

    from ..io.result_text import notices
    from .making import peak_memory

    result = made.result
    return {
        "out": args.out,
        "files": [os.path.join(args.out, name) for name in made.names],
        "trusted": not result.doubts,
        "doubts": notices(result.doubts),
        "warnings": notices(result.warnings),
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


def summary_lines(args: argparse.Namespace, made: "Made") -> list[str]:
    """Return the summary for people."""
    import os

    from ..findings import DOUBT, folded
    from ..report.printable import duration
    from .wording import anchor_line, calibration_line

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
    lines += [calibration_line(c) for c in shown]
    told = sorted(folded(result.findings), key=lambda group: any(f.severity == DOUBT for f in (group[0], *group[1])))
    for cause, explains in told:
        lines.append(f"{_LABELS[cause.severity]}: {cause}")
        lines += [f"  {cause.cure}"] if cause.severity == DOUBT and cause.cure else []
        lines += [f"  explains {_LABELS[other.severity]}: {other}" for other in explains]
    if result.doubted_stretches:
        lines.append("the rest of the map is as good as it states; map.png marks the stretches that are not")
    lines.append("files: " + " ".join(os.path.join(args.out, name) for name in made.names))
    page, out = shlex.quote(os.path.join(args.out, "report.html")), shlex.quote(args.out)
    lines.append(f"next: open {page} in a browser, or: uwblite view {out}")
    return lines
