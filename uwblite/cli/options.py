"""What the rows of verbs.py are made of: options, readers of their values, groups that several verbs share; and the options
in place of the settings and arguments that the library names."""

import argparse
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from ..findings import Finding

Add = Callable[[Any], object]
"""Declares options in a parser or a group of its options."""


class Verb(NamedTuple):
    """A verb of the command line; what it does is `run` of the module of its name, loaded when it is asked for."""

    help: str
    epilog: str
    """Examples first."""
    options: tuple[Add, ...]
    matrices: bool = True
    """Whether it makes or reads maps in this process, for which numpy and scipy must fit into memory."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        for add in self.options:
            add(parser)


def option(name: str, help_text: str, kind: Callable[[str], Any] = str, default: Any = None, **more: Any) -> Add:
    """Return an option ``--name METAVAR`` whose value `kind` reads, a switch ``--name``, or a place ``name``.

    Further arguments are those of argparse; a name without METAVAR takes nothing else.
    """
    word, _, metavar = name.partition(" ")
    if metavar:
        more |= {"metavar": metavar, "type": kind, "default": default}
    elif more or default is not None:
        more |= {"default": default}
    elif word.startswith("-"):
        more = {"action": "store_true"}
    return lambda parser: parser.add_argument(word, help=help_text, **more)


def group(title: str, *options: Add) -> Add:
    """Return options below a title."""
    return lambda parser: Verb("", "", options).add_arguments(parser.add_argument_group(title))


def either(*options: Add) -> Add:
    """Return options of which one at most may be given."""
    return lambda parser: Verb("", "", options).add_arguments(parser.add_mutually_exclusive_group())


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


SETTINGS = group(
    "settings (a later one wins: preset, file, --set)",
    option("--preset NAME", "start from a preset: default or paper"),
    option("--config FILE.toml", "settings from a file, as `uwblite config` prints it", place),
    option("--set NAME=VALUE", "change one setting, e.g. icp.max_iterations=30; repeatable", action="append", default=[]),
)
MOUNTING = group(
    "mounting (overrides what stands in the log)",
    option("--laser-pose X,Y,THETA", "laser on the base: m, m, rad", numbers(3)),
    option("--laser-flipped", "the laser is mounted upside down"),
    option("--tag X,Y,Z", "UWB tag on the base, z above the floor: m", numbers(3)),
    option("--anchor-height H", "height of all anchors above the floor, m", number()),
)
BAG = group(
    "ROS bags (topics are guessed by their types where these are not given)",
    option("--odometry-topic TOPIC", "nav_msgs/Odometry of the wheels", default=""),
    option(
        "--scan-topic TOPIC", "sensor_msgs/LaserScan; of a .log its messages, e.g. ROBOTLASER2 for the second lidar", default=""
    ),
    option("--imu-topic TOPIC", "sensor_msgs/Imu for the heading; none = the odometry's", default=""),
    option("--uwb-topic TOPIC", "ranges; repeatable", action="append", default=[]),
    option("--uwb-mapping FILE.toml", "where ranges stand in messages: docs/formats.md", place),
    option("--base-frame FRAME", "frame of the robot (the odometry's child frame)", default=""),
)


OPTIONS = {
    **{name: f"--{name}" for name in ("append", "crop", "force")},
    **{f"{unit}_unit": f"uwblite convert --{unit}-unit" for unit in ("range", "odometry", "laser", "time", "angle")},
    **{f"topics.{topic}": f"--{topic}-topic" for topic in ("odometry", "scan", "imu")},
    "to": "--to",
    "topics.base_frame": "--base-frame",
    "mappings": "--uwb-mapping",
    "mounting.laser_flipped": "--laser-flipped",
    "mounting.T_base_laser": "--laser-pose",
    "mounting.tag_position": "--tag",
    "mounting.anchor_height": "--anchor-height",
    "start": "uwblite convert run.log after.log --start",
    "end": "uwblite convert run.log before.log --end",
    "folder": "--out",
    "shell": "--uwb shell:PORT",
}
"""What sets on the command line what a text of the library has in backticks, alone or with its value."""


def name_options(text: str) -> str:
    """Return a text of the library with options in place of the settings and arguments that it names."""
    return re.sub(r"`([\w.]+)(=[^`]*)?`", _option, text) if "`" in text else text


def _option(match: "re.Match[str]") -> str:
    name, value = match[1], match[2] or ""
    option = OPTIONS[name] + value if name in OPTIONS else match[0]
    return f"`{option}`" if " " in option else option


def name_options_in(findings: "Iterable[Finding]") -> "tuple[Finding, ...]":
    """Return findings whose texts and cures name options."""
    return tuple(replace(f, text=name_options(f.text), cure=name_options(f.cure)) for f in findings)
