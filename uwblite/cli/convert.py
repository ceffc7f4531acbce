"""`uwblite convert`: recordings and pose graphs between formats."""

import argparse
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..io.carmen import write_log
from ..io.corrected_log import write_graph_with_scans
from ..io.csv_folder import write_csv_folder
from ..io.formats import format_of, format_of_name, graph_format, read_graph, refuse_existing, write_graph
from ..io.ros_results import FILES, write_nav2_bundle
from ..io.stored_result import read_result
from ..io.tum import read_tum, write_trajectory
from ..sensor_log import Odometry, SensorLog
from . import console
from .inputs import bag_choices, recording

_RECORDINGS = ("log", "csv", "mcap", "sqlite3", "tum", "kitti")


def run(args: argparse.Namespace) -> int:
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
    if args.to:
        return str(args.to)
    if args.target.endswith(".mcap"):
        return "mcap"
    return format_of(args.target) if os.path.isdir(args.target) else format_of_name(args.target)


def _list(args: argparse.Namespace, kind: str) -> int:
    from ..io.bag_topics import unread_warning
    from ..io.rosbag import plan_bag

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
    graph_format(args.target)
    refuse_existing(args.force, args.target)
    file = read_graph(args.source)
    console.note_of(args.source, file.warnings)
    write_graph(args.target, file)
    skipped = {f"{name} skipped": count for name, count in file.skipped.items()}
    return _say(args, {"poses": len(file.graph.poses), "landmarks": len(file.graph.anchors), **skipped}, warnings=file.warnings)


def _convert_map(args: argparse.Namespace, to: str) -> int:
    from ..io.ros_results import write_result_bag

    if to not in ("mcap", "sqlite3", "g2o", "tum", "kitti", "nav2"):
        raise ConfigError(f"{args.target}: not a format for a map; use --to nav2, mcap, sqlite3, g2o, tum or kitti")
    if to == "nav2":
        return _convert_to_nav2(args)
    refuse_existing(args.force, args.target)
    result = read_result(args.source)
    if to in ("tum", "kitti"):
        if len(result.trajectories) > 1:
            console.note(f"uwblite: {args.source} holds {len(result.trajectories)} trajectories; this is the first of them")
        return _write_trajectory(args, to, result.trajectories[0])
    logs = [recording(args, name) for name in args.recording]
    if to == "g2o":
        scans = write_graph_with_scans(args.target, result, logs)
        return _say(args, {"poses": len(result.keyframe_stamps), "poses with a scan": scans})
    write_result_bag(args.target, result, logs, storage=to)
    without = "" if logs else "without scans and odometry, which --recording adds"
    return _say(args, {"anchors": len(result.anchors), "closures": len(result.closures)}, note=without)


def _convert_to_nav2(args: argparse.Namespace) -> int:
    if os.path.exists(args.target) and not os.path.isdir(args.target):
        raise ConfigError(f"{args.target} is a file; --to nav2 makes a folder")
    if os.path.isdir(args.target) and os.path.samefile(args.source, args.target):
        raise ConfigError(f"{args.target} is the map itself; choose another folder for the bundle")
    refuse_existing(args.force, *(str(Path(args.target) / name) for name in FILES))
    result = read_result(args.source)
    return _say(args, {"files": len(write_nav2_bundle(args.target, result)), "anchors": len(result.anchors)})


def _convert_trajectory(args: argparse.Namespace, to: str) -> int:
    if format_of(args.source) == "kitti":
        raise ConfigError(f"{args.source}: KITTI poses have no times; only TUM files are read")
    if to not in ("tum", "kitti", "csv", "log"):
        raise ConfigError(f"{args.target}: not a format for a trajectory; use --to tum, kitti, csv or log")
    refuse_existing(args.force, args.target)
    stamps, poses = read_tum(args.source)
    if to in ("tum", "kitti"):
        return _write_trajectory(args, to, (stamps, poses))

    order = np.argsort(stamps, kind="stable")
    _write(args, to, SensorLog(Odometry(stamps[order], poses[order])))
    return _say(args, {"odometry readings": len(poses)}, note="ranges.csv and scans.csv may be added" if to == "csv" else "")


def _write_trajectory(args: argparse.Namespace, to: str, trajectory: tuple[Any, Any]) -> int:
    write_trajectory(args.target, to, *trajectory)
    return _say(args, {"poses": len(trajectory[0])})


def _say(args: argparse.Namespace, counts: dict[str, int], *, note: str = "", warnings: Sequence[str] = ()) -> int:
    """Say what was written, as text or as one JSON object."""
    figures = {"out": args.target, "counts": counts, "note": note, "warnings": list(warnings), "exit_code": 0}
    made = ", ".join(f"{count} {name}" for name, count in counts.items())
    console.report(args.json, figures, [f"{args.target}: {made}{f'; {note}' if note else ''}"])
    return 0


def _convert_recording(args: argparse.Namespace, to: str) -> int:
    if to in ("", "bag", "g2o", "pyfg", "map", "nav2"):
        hint = "a ROS 1 bag cannot be written; use --to mcap" if to == "bag" else f"use --to {', '.join(_RECORDINGS)}"
        raise ConfigError(f"{args.target}: not a format for a recording; {hint}")
    refuse_existing(args.force, args.target)
    log = _scaled(recording(args, args.source), args)
    log = _cropped(log, args.start, args.end)
    console.note_of(args.source, log.notes.warnings)
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


def _write(args: argparse.Namespace, to: str, log: SensorLog) -> None:
    if to == "log":
        write_log(args.target, log)
    elif to in ("tum", "kitti"):
        write_trajectory(args.target, to, log.odometry.stamps, log.odometry.poses)
    elif to == "csv":
        write_csv_folder(args.target, log, force=args.force)
    else:
        from ..io.rosbag_writer import write_bag

        write_bag(args.target, log, storage=to)


def _scaled(log: SensorLog, args: argparse.Namespace) -> SensorLog:
    """Return the recording in metres, radians and seconds."""
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


def _cropped(log: SensorLog, start: float | None, end: float | None) -> SensorLog:
    if start is None and end is None:
        return log
    first = float(log.odometry.stamps[0])
    inf = float("inf")
    return log.crop(-inf if start is None else first + start, inf if end is None else first + end)
