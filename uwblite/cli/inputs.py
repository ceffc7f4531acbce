"""What a command line names: settings, recordings with the mounting of their sensors, and the words that name them again."""

import argparse
import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from ..config import merge, override, parse_toml
from ..errors import ConfigError, UsageError
from ..io.bag_topics import BagTopics
from ..io.folders import refuse_foreign_picture
from ..io.formats import read_recording, refuse_existing
from ..io.log_parts import each_once
from ..io.source import read_settings
from ..io.uwb_mapping import UwbMapping, parse_mappings
from ..sensor_log import SensorLog, SensorMounting
from . import console

if TYPE_CHECKING:
    from ..grid.occupancy_grid import OccupancyGrid
    from ..io.stored_result import StoredAnchor
    from ..pipeline.mapping_config import MappingConfig


def begin_plan(args: argparse.Namespace, head: str) -> "tuple[str, str, OccupancyGrid, tuple[StoredAnchor, ...]]":
    """Return the names of a plan's table, which begins so, and of its picture, which may be written, and the map it is for."""
    from ..io.stored_result import read_space  # what reads recordings does without maps

    table, picture = f"{args.out}.csv", f"{args.out}.png"
    refuse_existing(args.force, table, picture)
    refuse_foreign_picture(table, picture, head)
    warnings = list[str]()
    grid, anchors = read_space(args.map, warnings)
    console.note_of(args.map, warnings)
    return table, picture, grid, anchors


def name_recordings_once(args: argparse.Namespace) -> None:
    """Let what `*.log` names stand for recordings, each once, where it names several parts of one, or one twice."""
    logs = each_once(args.logs)
    if len(logs) < len(args.logs):
        files = f"{len(args.logs)} files are {len(logs)} recording{'s' * (len(logs) > 1)}"
        console.note(f"uwblite: {files}: a recording in several parts, or named twice, counts once")
    args.logs = logs


def effective_config(args: argparse.Namespace) -> "MappingConfig":
    """Return the settings that --preset, --config and --set amount to.

    Raises
    ------
    UsageError : a preset or setting does not exist, or has a value that it cannot have.
    """
    from ..pipeline.mapping_config import MappingConfig, preset  # a check of a recording does without the pipeline

    # The user's mounting of the laser overrides what the scans show.
    implied = ["detect_laser_flip=false"] if getattr(args, "laser_flipped", False) else []
    text = read_settings(args.config) if args.config else ""
    try:
        config = preset(args.preset) if args.preset else MappingConfig()
        config = merge(config, parse_toml(text, args.config))
        return override(config, [*implied, *args.set])
    except ConfigError as error:
        raise UsageError(str(error)) from None


def bag_choices(args: argparse.Namespace) -> tuple[BagTopics, tuple[UwbMapping, ...]]:
    """Return the topics and mappings that the command line names."""
    mappings = parse_mappings(read_settings(args.uwb_mapping), args.uwb_mapping) if args.uwb_mapping else ()
    return BagTopics(args.odometry_topic, args.scan_topic, tuple(args.uwb_topic), args.imu_topic, args.base_frame), mappings


def recording(args: argparse.Namespace, path: str) -> SensorLog:
    """Return a recording of any kind, with what the command line says of its topics and mounting."""
    return apply_mounting(read_recording(path, bag=bag_choices(args)), args)


def apply_mounting(log: SensorLog, args: argparse.Namespace) -> SensorLog:
    """Return the log with the mounting of the command line in place of its own."""
    return dataclasses.replace(log, mounting=mounted(log.mounting, args))


def mounted(mounting: SensorMounting, args: argparse.Namespace) -> SensorMounting:
    """Return a mounting with what the command line says in place of its own."""
    stated = {
        "T_base_laser": None if args.laser_pose is None else np.array(args.laser_pose),
        "laser_is_base": None if args.laser_pose is None else False,
        "laser_flipped": args.laser_flipped or None,
        "tag_position": None if args.tag is None else np.array(args.tag),
        "anchor_height": args.anchor_height,
        "anchor_heights": None if args.anchor_height is None else {},
    }
    return dataclasses.replace(mounting, **{name: value for name, value in stated.items() if value is not None})


def mounting_words(args: argparse.Namespace) -> list[str]:
    """Return the options that state the same mounting again."""
    stated = {"laser-pose": args.laser_pose, "tag": args.tag, "anchor-height": args.anchor_height}
    words = [f"--{name}={','.join(map(repr, np.ravel(v).tolist()))}" for name, v in stated.items() if v is not None]
    return ["--laser-flipped"] * args.laser_flipped + words
