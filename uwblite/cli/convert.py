"""`uwblite convert`: recordings and pose graphs between formats."""

import argparse
import os
from typing import TYPE_CHECKING

from ..errors import ConfigError
from .options import add_bag_arguments, add_mounting_arguments, number, place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..arrays import Floats
    from ..sensor_log import SensorLog

HELP = "convert recordings (CARMEN log, ROS 1/2 bag, CSV folder), maps, trajectories and pose graphs (g2o, TORO, PyFG)"
EPILOG = """\
examples:
  uwblite convert record.bag run.log.gz                ROS 1 bag, ROS 2 folder, .mcap or .db3 -> log
  uwblite convert record.bag --list                    which topics are there, and which would be read
  uwblite convert record.bag run.log --uwb-mapping uwb.toml --scan-topic /scan
  uwblite convert run.log tables/                      -> odometry.csv, ranges.csv, scans.csv, sensors.toml
  uwblite convert tables/ run.log --odometry-unit 0.001
  uwblite convert run.log run.mcap                     -> ROS 2 bag, one file; bag/ --to sqlite3 or mcap: a folder
  uwblite convert run.log part.log --start 60 --end 120
  uwblite convert graph.g2o graph.pyfg
  uwblite convert map/ map.mcap --recording run.log    a map for Foxglove and RViz: /map, tf, path, anchors, closures
  uwblite convert map/ scans.g2o --recording run.log   its pose graph with the scans (ROBOTLASER1)
  uwblite convert map/ nav2/ --to nav2                 a bundle for nav2: map, keep-out mask, parameters, initial pose
  uwblite convert map/ path.kitti                      trajectories: .tum and .kitti, as evo reads them; run.log too

bags need the package rosbags, in the environment of uwblite (without it the error gives the command)
"""
_RECORDINGS = ("log", "csv", "mcap", "sqlite3", "tum", "kitti")
_TARGETS = ("log", "csv", "mcap", "sqlite3", "g2o", "pyfg", "tum", "kitti", "nav2")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("source", help="what to convert; - reads a log from standard input")
    parser.add_argument("target", type=place, nargs="?", help="what to make; its ending names the format, or --to does")
    parser.add_argument("--to", choices=_TARGETS, help="format of the target where its ending names none")
    parser.add_argument("--force", action="store_true", help="replace a file that is already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")
    text = "recording that a map was made of, for its scans and odometry; repeatable, in their order"
    parser.add_argument("--recording", metavar="LOG", action="append", default=[], help=text)
    parser.add_argument("--list", action="store_true", help="list the topics of a bag and stop")
    add_bag_arguments(parser)
    part = parser.add_argument_group("part and units")
    unit = number(above=0)
    part.add_argument("--start", metavar="S", type=number(), help="leave out what is earlier, s after the first odometry")
    part.add_argument("--end", metavar="S", type=number(), help="leave out what is later, s after the first odometry")
    part.add_argument("--time-unit", metavar="S", type=unit, default=1.0, help="seconds per unit of the stamps (1)")
    part.add_argument("--odometry-unit", metavar="M", type=unit, default=1.0, help="metres per unit of the odometry (1)")
    part.add_argument("--angle-unit", metavar="RAD", type=unit, default=1.0, help="radians per unit of its heading (1)")
    part.add_argument("--range-unit", metavar="M", type=unit, default=1.0, help="metres per unit of the ranges (1)")
    part.add_argument("--laser-unit", metavar="M", type=unit, default=1.0, help="metres per unit of the laser (1)")
    add_mounting_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from .formats import format_of

    kind = format_of(args.source)
    if args.list:
        return _list(args, kind)
    if not args.target:
        raise ConfigError("name a target: uwblite convert SOURCE TARGET")
    to = _target_format(args)
    if args.recording and kind != "map":
        raise ConfigError(f"--recording goes with a map, and {args.source} is none")
    if kind in ("g2o", "pyfg", "isam") and to in ("", "g2o", "pyfg"):
        return _convert_graph(args)
    if kind == "map":
        return _convert_map(args, to)
    if kind in ("tum", "kitti"):
        return _convert_trajectory(args, to)
    return _convert_recording(args, to)


def _target_format(args: argparse.Namespace) -> str:
    """Return the format that --to or the target's name states; '' where neither does."""
    from .formats import format_of, format_of_name

    if args.to:
        return str(args.to)
    if args.target.endswith(".mcap"):
        return "mcap"
    return format_of(args.target) if os.path.isdir(args.target) else format_of_name(args.target)


def _list(args: argparse.Namespace, kind: str) -> int:
    from ..io.bag_topics import unread_warning
    from ..io.rosbag import plan_bag
    from . import console
    from .options import bag_choices

    if kind != "bag":
        raise ConfigError(f"{args.source} is not a bag; --list shows the topics of bags")
    topics, plan = plan_bag(args.source, *bag_choices(args))
    if args.json:
        rows = [{"topic": t.name, "type": t.type, "messages": t.count, "role": plan.role(t.name) or None} for t in topics]
        console.say_json({"topics": rows, "unread": list(plan.unread), "exit_code": 0})
        return 0
    width = max((len(t.name) for t in topics), default=0)
    for t in topics:
        role = plan.role(t.name) or ("ranges?" if t.name in plan.unread else "")
        console.say(f"{t.count:>8}  {t.name:<{width}}  {t.type}{f'  <- {role}' if role else ''}")
    if plan.unread:
        console.say(unread_warning(plan))
    return 0


def _convert_graph(args: argparse.Namespace) -> int:
    from . import console
    from .formats import graph_format, read_graph, refuse_existing, write_graph

    graph_format(args.target)
    refuse_existing(args.force, args.target)
    file = read_graph(args.source)
    for warning in file.warnings:
        console.note(f"uwblite: {args.source}: {warning}")
    write_graph(args.target, file)
    skipped = {f"{name} skipped": count for name, count in file.skipped.items()}
    return _say(args, {"poses": len(file.graph.poses), "landmarks": len(file.graph.anchors), **skipped}, warnings=file.warnings)


def _convert_map(args: argparse.Namespace, to: str) -> int:
    from ..io.corrected_log import write_graph_with_scans
    from ..io.result_bag import write_result_bag
    from ..io.stored_result import read_result
    from . import console
    from .formats import read_recording, refuse_existing
    from .options import apply_mounting, bag_choices

    if to not in ("mcap", "sqlite3", "g2o", "tum", "kitti", "nav2"):
        raise ConfigError(f"{args.target}: not a format for a map; use --to nav2, mcap, sqlite3, g2o, tum or kitti")
    if to == "nav2":
        return _convert_to_nav2(args)
    refuse_existing(args.force, args.target)
    result = read_result(args.source)
    if to in ("tum", "kitti"):
        if len(result.trajectories) > 1:
            console.note(f"uwblite: {args.source} holds {len(result.trajectories)} trajectories; this is the first of them")
        return _write_trajectory(args, to, *result.trajectories[0])
    logs = [apply_mounting(read_recording(name, bag=bag_choices(args)), args) for name in args.recording]
    if to == "g2o":
        scans = write_graph_with_scans(args.target, result, logs)
        return _say(args, {"poses": len(result.keyframe_stamps), "poses with a scan": scans})
    write_result_bag(args.target, result, logs, storage=to)
    without = "" if logs else "without scans and odometry, which --recording adds"
    return _say(args, {"anchors": len(result.anchors), "closures": len(result.closures)}, note=without)


def _convert_to_nav2(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ..io.nav2_bundle import FILES, write_nav2_bundle
    from ..io.stored_result import read_result
    from .formats import refuse_existing

    if os.path.exists(args.target) and not os.path.isdir(args.target):
        raise ConfigError(f"{args.target} is a file; --to nav2 makes a folder")
    if os.path.isdir(args.target) and os.path.samefile(args.source, args.target):
        raise ConfigError(f"{args.target} is the map itself; choose another folder for the bundle")
    refuse_existing(args.force, *(str(Path(args.target) / name) for name in FILES))
    result = read_result(args.source)
    return _say(args, {"files": len(write_nav2_bundle(args.target, result)), "anchors": len(result.anchors)})


def _convert_trajectory(args: argparse.Namespace, to: str) -> int:
    from ..io.tum import read_tum
    from .formats import format_of, refuse_existing

    if format_of(args.source) == "kitti":
        raise ConfigError(f"{args.source}: KITTI poses have no times; only TUM files are read")
    if to not in ("tum", "kitti", "csv", "log"):
        raise ConfigError(f"{args.target}: not a format for a trajectory; use --to tum, kitti, csv or log")
    refuse_existing(args.force, args.target)
    stamps, poses = read_tum(args.source)
    if to in ("tum", "kitti"):
        return _write_trajectory(args, to, stamps, poses)
    import numpy as np

    from ..sensor_log import Odometry, SensorLog

    order = np.argsort(stamps, kind="stable")
    _write(args, to, SensorLog(Odometry(stamps[order], poses[order])))
    return _say(args, {"odometry readings": len(poses)}, note="ranges.csv and scans.csv may be added" if to == "csv" else "")


def _write_trajectory(args: argparse.Namespace, to: str, stamps: "Floats", poses: "Floats") -> int:
    from ..io.tum import write_trajectory

    write_trajectory(args.target, to, stamps, poses)
    return _say(args, {"poses": len(poses)})


def _say(args: argparse.Namespace, counts: dict[str, int], *, note: str = "", warnings: "Sequence[str]" = ()) -> int:
    """Say what was written, as text or as one JSON object."""
    from . import console

    if args.json:
        console.say_json({"out": args.target, "counts": counts, "note": note, "warnings": list(warnings), "exit_code": 0})
    else:
        made = ", ".join(f"{count} {name}" for name, count in counts.items())
        console.say(f"{args.target}: {made}{f'; {note}' if note else ''}")
    return 0


def _convert_recording(args: argparse.Namespace, to: str) -> int:
    from . import console
    from .formats import read_recording, refuse_existing
    from .options import apply_mounting, bag_choices

    if to in ("", "bag", "g2o", "pyfg", "map", "nav2"):
        hint = "a ROS 1 bag cannot be written; use --to mcap" if to == "bag" else f"use --to {', '.join(_RECORDINGS)}"
        raise ConfigError(f"{args.target}: not a format for a recording; {hint}")
    refuse_existing(args.force, args.target)
    log = apply_mounting(_scaled(read_recording(args.source, bag=bag_choices(args)), args), args)
    log = _cropped(log, args.start, args.end)
    for warning in log.notes.warnings:
        console.note(f"uwblite: {args.source}: {warning}")
    _write(args, to, log)
    ranges = 0 if log.ranges is None else len(log.ranges.stamps)
    scans = 0 if log.scans is None else len(log.scans.stamps)
    counts = {"odometry readings": len(log.odometry.stamps), "ranges": ranges, "scans": scans}
    if log.gyro is not None:
        counts["headings of the gyro"] = len(log.gyro.stamps)
    _say(args, counts, warnings=log.notes.warnings)
    if to == "log" and not args.json:
        console.say(f"next: uwblite check {args.target}")
    return 0


def _write(args: argparse.Namespace, to: str, log: "SensorLog") -> None:
    if to == "log":
        from ..io.carmen import write_log

        write_log(args.target, log)
    elif to in ("tum", "kitti"):
        from ..io.tum import write_trajectory

        write_trajectory(args.target, to, log.odometry.stamps, log.odometry.poses)
    elif to == "csv":
        from ..io.csv_folder import write_csv_folder

        write_csv_folder(args.target, log, force=args.force)
    else:
        from ..io.rosbag_writer import write_bag

        write_bag(args.target, log, storage=to)


def _scaled(log: "SensorLog", args: argparse.Namespace) -> "SensorLog":
    """Return the recording in metres, radians and seconds."""
    import dataclasses

    if args.time_unit != 1.0:
        log = log.with_time_unit(args.time_unit)
    odometry = dataclasses.replace(
        log.odometry, poses=log.odometry.poses * (args.odometry_unit, args.odometry_unit, args.angle_unit)
    )
    ranges, scans, unit = log.ranges, log.scans, args.laser_unit
    if ranges is not None:
        ranges = dataclasses.replace(ranges, ranges=ranges.ranges * args.range_unit)
    if scans is not None and unit != 1.0:
        scaled = {name: getattr(scans, name) * unit for name in ("range_min", "range_max")}
        scans = dataclasses.replace(scans, ranges=scans.ranges * scans.ranges.dtype.type(unit), **scaled)
    return dataclasses.replace(log, odometry=odometry, ranges=ranges, scans=scans)


def _cropped(log: "SensorLog", start: float | None, end: float | None) -> "SensorLog":
    if start is None and end is None:
        return log
    first = float(log.odometry.stamps[0])
    inf = float("inf")
    return log.crop(-inf if start is None else first + start, inf if end is None else first + end)
