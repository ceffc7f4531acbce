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


def option(group: Any, name: str, help_text: str, kind: Callable[[str], Any] = str, default: Any = None, **more: Any) -> None:
    """Declare an option ``--name METAVAR`` whose value `kind` reads; without METAVAR it is a switch."""
    words = name.split(" ", 1)
    if len(words) == 1:
        group.add_argument(name, action="store_true", help=help_text)
    else:
        group.add_argument(words[0], metavar=words[1], type=kind, default=default, help=help_text, **more)


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --preset, --config and --set."""
    group = parser.add_argument_group("settings (a later one wins: preset, file, --set)")
    option(group, "--preset NAME", "start from a preset: default or paper")
    option(group, "--config FILE.toml", "settings from a file, as `uwblite config` prints it", place)
    option(group, "--set NAME=VALUE", "change one setting, e.g. icp.max_iterations=30; repeatable", action="append", default=[])


def add_mounting_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how the sensors are mounted; the log's own PARAM lines hold where these are not given."""
    group = parser.add_argument_group("mounting (overrides what stands in the log)")
    option(group, "--laser-pose X,Y,THETA", "laser on the base: m, m, rad", numbers(3))
    option(group, "--laser-flipped", "the laser is mounted upside down")
    option(group, "--tag X,Y,Z", "UWB tag on the base, z above the floor: m", numbers(3))
    option(group, "--anchor-height H", "height of all anchors above the floor, m", number())


def add_bag_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare which topics of a ROS bag are read; recordings of other kinds have none."""
    bag = parser.add_argument_group("ROS bags (topics are guessed by their types where these are not given)")
    option(bag, "--odometry-topic TOPIC", "nav_msgs/Odometry of the wheels", default="")
    scans = "sensor_msgs/LaserScan; of a .log its messages, e.g. ROBOTLASER2 for the second lidar"
    option(bag, "--scan-topic TOPIC", scans, default="")
    option(bag, "--imu-topic TOPIC", "sensor_msgs/Imu for the heading; none = the odometry's", default="")
    option(bag, "--uwb-topic TOPIC", "ranges; repeatable", action="append", default=[])
    option(bag, "--uwb-mapping FILE.toml", "where ranges stand in messages: docs/formats.md", place)
    option(bag, "--base-frame FRAME", "frame of the robot (the odometry's child frame)", default="")


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
