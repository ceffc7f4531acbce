"""`uwblite map`: from recordings to a map."""

import argparse
import shlex
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from .options import add_bag_arguments, add_mounting_arguments, add_settings_arguments, number, numbers, place
from .workers import add_worker_arguments, versions, workers

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..constraints import Constraints
    from ..map_result import MapResult
    from ..mapping import MappingConfig, Progress
    from ..sensor_log import SensorLog

HELP = "map a recording: trajectory, anchors, occupancy grid, report"
EPILOG = """\
examples:
  uwblite map run.log --out map/                       everything at its best
  uwblite map run.log.gz --out map/ --laser-flipped    the laser hangs upside down
  uwblite map run.log --out a/ --without uwb           what wheels and lidar alone can do
  uwblite map run.log --out b/ --preset paper          the paper's plain choices
  uwblite map run.log --out c/ --set grid.resolution=0.02
  uwblite map run.log --out d/ --align walls --crop 0,0,12,8
  uwblite map monday.log tuesday.log --out both/       one map of several recordings: anchors tie them together
  uwblite map monday.log --out monday/ --anchors-from sunday/anchors.csv    in the frame of Sunday's map
  uwblite map run.bag --out map/ --uwb-mapping uwb.toml    a ROS bag with ranges of one's own kind
  uwblite map run.log --out map/ --scheduler tcp://head:8786    the heavy stages on a cluster of dask.distributed
  uwblite map run.log --out map/ --dry-run             read, check and estimate only

files in --out: map.png (picture), report.html, map.yaml + map.pgm (map_server, nav2), trajectory.tum (evo),
  trajectory_covariance.csv, anchors.csv, graph.g2o, graph.pyfg, graph_stamps.csv, config.toml, report.json
exit code 3: the files are written, but the result should not be trusted; the reasons are named
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    several = "CARMEN log, plain or .gz, ROS bag or CSV folder; several are mapped together; - reads a log from standard input"
    parser.add_argument("logs", metavar="LOG", nargs="+", help=several)
    parser.add_argument("--out", type=place, metavar="DIR", required=True, help="folder for the result")
    parser.add_argument("--force", action="store_true", help="replace a result that is already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")
    parser.add_argument("--dry-run", action="store_true", help="read, check and estimate time and memory; write nothing")
    text = "the CARMEN log's scans with corrected laser poses, as GMapping's users exchange; one CARMEN log only"
    parser.add_argument("--corrected-log", metavar="FILE", help=text)
    add_worker_arguments(parser, "processes for the heavy stages (1)")
    add_map_arguments(parser)


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
    beforehand.add_argument("--constraints", metavar="FILE.toml", help=text)
    text = "go on in the frame of an earlier map: its anchors.csv; anchors that were moved since are named"
    beforehand.add_argument("--anchors-from", metavar="FILE.csv", help=text)
    add_settings_arguments(parser)
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..io.locks import sole_writer
    from ..io.results import check_target

    _check_corrected_log(args)
    if args.dry_run:
        return _map(args)
    with sole_writer(args.out):
        check_target(args.out, force=args.force)
        return _map(args)


def _map(args: argparse.Namespace) -> int:
    from . import console

    began = time.perf_counter()
    with workers(args.jobs if len(args.logs) > 1 else 1) as executor:
        logs = read_logs(args, executor)
    reading = time.perf_counter() - began
    _report_reader_warnings(logs)
    if args.dry_run:
        return max(_dry_run(args, log) for log in logs)
    made = _make_shown(args, logs, reading)
    if args.json:
        console.say_json(summary_json(args, made))
    else:
        for line in summary_lines(args, made):
            console.say(line)
    return 3 if made.result.doubts else 0


class Made(NamedTuple):
    """A map that is written."""

    logs: "list[SensorLog]"
    result: "MapResult"
    names: list[str]
    """Of the files in --out, in the order in which a user wants to see them."""
    seconds: float
    """From the first recording's first byte to the last file."""


def read_logs(args: argparse.Namespace, executor: "Executor | None" = None) -> "list[SensorLog]":
    """Return the recordings of the command line, with its mounting."""
    from .formats import read_recording
    from .options import apply_mounting, bag_choices

    read = partial(read_recording, every_nth_scan=args.every_nth_scan, bag=bag_choices(args))
    return [apply_mounting(log, args) for log in (executor.map if executor else map)(read, args.logs)]


def make(
    args: argparse.Namespace,
    logs: "list[SensorLog]",
    reading: float,
    progress: "Progress | None" = None,
    executor: "Executor | None" = None,
) -> Made:
    """Map recordings and write the result; say nothing.

    Parameters
    ----------
    args : the command line: settings, constraints, --out.
    logs : as `read_logs` returns them; the list is emptied, for scans that no map looks at are most of the memory.
    reading : time that it took to read them, s.
    progress, executor : see `build_map`.
    """
    from ..io.result_text import RunRecord
    from ..io.results import write_result
    from ..mapping import build_map
    from ..pipeline.scan_selection import prepared

    config, constraints = settings(args), known(args)
    began = time.perf_counter()
    kept = [prepared(logs.pop(0), config) for _ in range(len(logs))]
    log = kept[0] if len(kept) == 1 else kept
    result = build_map(
        log, config, constraints=constraints, progress=progress, executor=executor, clock=time.perf_counter
    )
    record = RunRecord(
        command=repeat_command(args),
        config=config_text(config),
        versions=versions(),
        given=given_files(args),
        preset=args.preset or "",
        seconds=0.0 if args.no_timings else reading + time.perf_counter() - began,
        reading_seconds=reading,
        peak_rss_bytes=_peak_memory(),
        timings_in_report=args.report_timings,
        scale_map=args.scale_map,
    )
    names = write_result(args.out, kept, result, record)
    if getattr(args, "corrected_log", None):
        _write_corrected_log(args, kept[0], result)
    return Made(kept, result, names, reading + time.perf_counter() - began)


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


def _write_corrected_log(args: argparse.Namespace, log: "SensorLog", result: "MapResult") -> None:
    from ..io.corrected_log import poses_of_scans, write_corrected_log
    from . import console

    written, left_out = write_corrected_log(args.corrected_log, args.logs[0], partial(poses_of_scans, result, log))
    if left_out:
        console.note(
            f"uwblite: {args.corrected_log} has {written} scans; {left_out} laser messages are broken or outside the "
            "trajectory's time and were left out"
        )


def config_text(config: "MappingConfig") -> str:
    """Return the config.toml of a result."""
    from ..config import to_toml

    return to_toml(config, header="settings in force; `uwblite config` explains them")


def given_files(args: argparse.Namespace) -> dict[str, str]:
    """Return the SHA-256 of the files that the command line names beside recordings and settings, by option.

    What can be read once only, such as a pipe, has none.
    """
    import os

    from ..io.files import sha256_of

    named = {"constraints": args.constraints, "anchors-from": args.anchors_from, "uwb-mapping": args.uwb_mapping}
    return {option: sha256_of(file) for option, file in named.items() if file and os.path.isfile(file)}


def settings(args: argparse.Namespace) -> "MappingConfig":
    from ..config import override
    from .options import effective_config

    config = override(effective_config(args), [f"use_{name}=false" for name in args.without])
    short = {"grid.resolution": args.resolution, "align": args.align, "crop": args.crop and list(args.crop)}
    return override(config, [f"{name}={value}" for name, value in short.items() if value is not None])


def known(args: argparse.Namespace) -> "Constraints":
    from ..constraints import Constraints
    from ..io.constraints_file import parse_constraints, read_anchors
    from .options import read_text

    earlier = read_anchors(args.anchors_from) if args.anchors_from else Constraints()
    if not args.constraints:
        return earlier
    return earlier + parse_constraints(read_text(args.constraints), args.constraints)


def _make_shown(args: argparse.Namespace, logs: "list[SensorLog]", reading: float) -> Made:
    """Map recordings with a progress bar, on the processes or the cluster that the command line asks for."""
    from . import console
    from .stage_shares import Overall

    progress = console.Progress(overall=Overall())

    def report(stage: str, done: int, total: int) -> None:
        if stage.startswith("occupancy grid of"):
            console.note(f"uwblite: {stage}")
        progress(stage, done, total)

    try:
        with workers(args.jobs, args.scheduler) as executor:
            return make(args, logs, reading, report, executor)
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


def _dry_run(args: argparse.Namespace, log: "SensorLog") -> int:
    from ..checks.recording import diagnose
    from . import check, console

    diagnosis = diagnose(log)
    cost = check.expected_cost(log)
    if args.json:
        console.say_json(check.summary_json(log.notes.source, diagnosis, cost, ""))
    else:
        for line in check.report_lines(log.notes.source, diagnosis, cost, ""):
            console.say(line)
    return 3 if diagnosis.serious else 0


def repeat_command(args: argparse.Namespace) -> str:
    """Return the command that makes the same map again, with the recordings and the result's config.toml at hand.

    Files stand with their names alone: the result is the same wherever they lie.
    """
    from ..io.result_text import base_name

    words = ["uwblite", "map", *map(base_name, args.logs), "--config", "config.toml"]
    if args.every_nth_scan > 1:
        words.append(f"--every-nth-scan={args.every_nth_scan}")
    for option, value in (("--constraints", args.constraints), ("--anchors-from", args.anchors_from)):
        words += [option, base_name(value)] if value else []
    if args.laser_pose is not None:
        words.append("--laser-pose=" + ",".join(map(repr, args.laser_pose)))
    if args.laser_flipped:
        words.append("--laser-flipped")
    for option in ("odometry_topic", "scan_topic", "imu_topic", "uwb_mapping", "base_frame"):
        if value := getattr(args, option):
            words.append(f"--{option.replace('_', '-')}={base_name(value) if option == 'uwb_mapping' else value}")
    words += [f"--uwb-topic={topic}" for topic in args.uwb_topic]
    if args.tag is not None:
        words.append("--tag=" + ",".join(map(repr, args.tag)))
    if args.anchor_height is not None:
        words.append(f"--anchor-height={args.anchor_height!r}")
    return shlex.join([*words, "--out", "map_again"])


def _peak_memory() -> int:
    """Return the peak resident memory of this process and the largest of its children, bytes; 0 where it is not known."""
    try:
        import resource
    except ImportError:
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def summary_json(args: argparse.Namespace, made: Made) -> dict[str, Any]:
    """Return the summary for programs; report.json has everything."""
    import os

    from ..io.result_text import notices

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
        "peak_rss_bytes": _peak_memory(),
        "exit_code": 3 if result.doubts else 0,
    }


def summary_lines(args: argparse.Namespace, made: Made) -> list[str]:
    """Return the summary for people."""
    import os

    from .console import duration
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
    lines += [f"warning: {text}" for text in result.warnings]
    lines += [f"DOUBT: {text}" for text in result.doubts]
    lines.append("files: " + " ".join(os.path.join(args.out, name) for name in made.names))
    page = shlex.quote(os.path.join(args.out, "report.html"))
    lines.append(f"next: open {page} in a browser, or: uwblite evaluate {shlex.quote(args.out)} --truth truth.tum")
    return lines
