"""What the options of all verbs are made of: readers of their values, and the groups that several verbs share."""

import argparse
import math
from collections.abc import Callable
from typing import Any, NamedTuple


class Verb(NamedTuple):
    """A verb of the command line; what it does is `run` of the module of its name, loaded when it is asked for."""

    help: str
    epilog: str
    """Examples first."""
    add_arguments: Callable[[argparse.ArgumentParser], None]
    matrices: bool = True
    """Whether it makes or reads maps in this process, for which numpy and scipy must fit into memory."""


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --preset, --config and --set."""
    group = parser.add_argument_group("settings (a later one wins: preset, file, --set)")
    group.add_argument("--preset", metavar="NAME", help="start from a preset: default or paper")
    group.add_argument("--config", type=place, metavar="FILE.toml", help="settings from a file, as `uwblite config` prints it")
    example = "change one setting, e.g. icp.max_iterations=30; repeatable"
    group.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help=example)


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


LOCAL = ("127.0.0.1", 8000)
"""Where a page is found that nobody has put elsewhere."""


def page_address(text: str) -> tuple[str, int]:
    """Read [ADDRESS:]PORT; without an address, of this computer alone."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit()) or not 0 < int(port) <= 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port such as 8000 or 0.0.0.0:8000")
    return host or LOCAL[0], int(port)
