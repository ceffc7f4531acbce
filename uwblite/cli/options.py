"""Options that several verbs share: numbers, the settings of the mapper, and how the sensors are mounted."""

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..io.bag_topics import BagTopics
    from ..io.uwb_mapping import UwbMapping
    from ..mapping import MappingConfig
    from ..sensor_log import SensorLog, SensorMounting


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --preset, --config and --set."""
    group = parser.add_argument_group("settings (a later one wins: preset, file, --set)")
    group.add_argument("--preset", metavar="NAME", help="start from a preset: default or paper")
    group.add_argument("--config", type=place, metavar="FILE.toml", help="settings from a file, as `uwblite config` prints it")
    example = "change one setting, e.g. icp.max_iterations=30; repeatable"
    group.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help=example)


def name_recordings_once(args: argparse.Namespace) -> None:
    """Let what `*.log` names stand for recordings, each once, where it names several parts of one, or one twice."""
    from ..io.log_parts import each_once
    from . import console

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
    from ..config import merge, override, parse_toml
    from ..errors import ConfigError, UsageError
    from ..io.source import read_settings
    from ..pipeline.mapping_config import MappingConfig, preset

    # The user's mounting of the laser overrides what the scans show.
    given = ["detect_laser_flip=false"] if getattr(args, "laser_flipped", False) else []
    text = read_settings(args.config) if args.config else ""
    try:
        config = preset(args.preset) if args.preset else MappingConfig()
        config = merge(config, parse_toml(text, args.config))
        return override(config, [*given, *args.set])
    except ConfigError as error:
        raise UsageError(str(error)) from None


def add_mounting_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how the sensors are mounted; the log's own PARAM lines hold where these are not given."""
    group = parser.add_argument_group("mounting (overrides what stands in the log)")
    group.add_argument("--laser-pose", metavar="X,Y,THETA", type=numbers(3), help="laser on the base: m, m, rad")
    group.add_argument("--laser-flipped", action="store_true", help="the laser is mounted upside down")
    group.add_argument("--tag", metavar="X,Y,Z", type=numbers(3), help="UWB tag on the base, z above the floor: m")
    group.add_argument("--anchor-height", metavar="H", type=number(), help="height of all anchors above the floor, m")


def add_bag_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare which topics of a ROS bag are read; recordings of other kinds have none."""
    bag = parser.add_argument_group("ROS bags (topics are guessed by their types where these are not given)")
    bag.add_argument("--odometry-topic", metavar="TOPIC", default="", help="nav_msgs/Odometry of the wheels")
    scans = "sensor_msgs/LaserScan; of a .log its messages, e.g. ROBOTLASER2 for the second lidar"
    bag.add_argument("--scan-topic", metavar="TOPIC", default="", help=scans)
    bag.add_argument("--imu-topic", metavar="TOPIC", default="", help="sensor_msgs/Imu for the heading; none = the odometry's")
    bag.add_argument("--uwb-topic", metavar="TOPIC", action="append", default=[], help="ranges; repeatable")
    bag.add_argument("--uwb-mapping", type=place, metavar="FILE.toml", help="where ranges stand in messages: docs/formats.md")
    bag.add_argument("--base-frame", metavar="FRAME", default="", help="frame of the robot (the odometry's child frame)")


def bag_choices(args: argparse.Namespace) -> "tuple[BagTopics, tuple[UwbMapping, ...]]":
    """Return the topics and mappings that the command line names."""
    from ..io.bag_topics import BagTopics
    from ..io.source import read_settings
    from ..io.uwb_mapping import parse_mappings

    mappings = parse_mappings(read_settings(args.uwb_mapping), args.uwb_mapping) if args.uwb_mapping else ()
    return BagTopics(args.odometry_topic, args.scan_topic, tuple(args.uwb_topic), args.imu_topic, args.base_frame), mappings


def number(
    least: float = -math.inf, most: float = math.inf, above: float = -math.inf, whole: bool = False
) -> Callable[[str], Any]:
    """Return a reader of a finite number from `least` to `most`, greater than `above`."""
    wanted = "a whole number" if whole else "a number"
    if math.isfinite(above):
        wanted += f" above {above}"
    elif math.isfinite(least):
        wanted += f" from {least} to {most}" if math.isfinite(most) else f" of at least {least}"

    def parse(text: str) -> Any:
        try:
            value = int(text) if whole else float(text)
            good = math.isfinite(value) and least <= value <= most and value > above
        except (ValueError, OverflowError):
            good = False
        if not good:
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
        return value

    return parse


def place(text: str) -> str:
    """Read the name of a file or folder; an empty one, as of a variable that is not set, would be taken as not given."""
    if not text.strip():
        raise argparse.ArgumentTypeError("an empty name names no file or folder; . is the current folder")
    return text


def numbers(count: int, most: int = 0) -> Callable[[str], tuple[float, ...]]:
    """Return a reader of so many numbers, or up to `most`, separated by commas."""
    wanted = f"{count} or {most}" if most else f"{count}"

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not count <= len(values) <= max(most, count) or not all(abs(value) <= _LARGEST for value in values):
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted} numbers separated by commas, of at most {_LARGEST:g}")
        return values

    return parse


_LARGEST = 1e7
"""m; no place on Earth is farther from another one."""


def apply_mounting(log: "SensorLog", args: argparse.Namespace) -> "SensorLog":
    """Return the log with the mounting of the command line in place of its own."""
    import dataclasses

    return dataclasses.replace(log, mounting=mounted(log.mounting, args))


def mounted(mounting: "SensorMounting", args: argparse.Namespace) -> "SensorMounting":
    """Return a mounting with what the command line says in place of its own."""
    import dataclasses

    import numpy as np

    if args.laser_pose is not None:
        mounting = dataclasses.replace(mounting, T_base_laser=np.array(args.laser_pose), laser_is_base=False)
    if args.laser_flipped:
        mounting = dataclasses.replace(mounting, laser_flipped=True)
    if args.tag is not None:
        mounting = dataclasses.replace(mounting, tag_position=np.array(args.tag))
    if args.anchor_height is not None:
        mounting = dataclasses.replace(mounting, anchor_height=args.anchor_height, anchor_heights={})
    return mounting
