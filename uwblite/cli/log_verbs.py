"""The verbs for recordings, devices, pose graphs and settings: their options and examples."""

import argparse
import re

from .options import (
    LOCAL,
    Verb,
    add_bag_arguments,
    add_mounting_arguments,
    add_settings_arguments,
    number,
    numbers,
    option,
    page_address,
    place,
)

MOST = {"uwb": 9, "lidar": 5, "gyro": 1, "odometry": 1}
"""How many of a kind a log keeps apart."""
TARGETS = ("log", "csv", "mcap", "sqlite3", "g2o", "pyfg", "tum", "kitti", "nav2")
"""Formats that `uwblite convert` writes."""


def _check(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", help="CARMEN log, plain or .gz, ROS bag or CSV folder; - reads a log from standard input")
    option(parser, "--json", "print one JSON object instead of text")
    option(parser, "--map", "map it as well: scales, biases, clock offsets and the doubts of that map; takes as long as a map")
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


CHECK = Verb(
    "say what is wrong with a recording and what to do about it, before mapping it",
    """\
examples:
  uwblite check run.log                    findings, worst first; exit code 3 where one spoils the map
  uwblite check run.log --map              also what only a map can tell; takes as long as one
  uwblite check run.log.gz --json          the same for a script
  uwblite check run.log --laser-flipped    does the laser agree with the wheels that way?
""",
    _check,
)


def _size(text: str) -> int:
    match = re.fullmatch(r"(\d+)([kMG]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 500M")
    return int(match[1]) * {"": 1, "k": 1000, "M": 10**6, "G": 10**9}[match[2]]


def _record(parser: argparse.ArgumentParser) -> None:
    devices = parser.add_argument_group("devices")
    option(devices, "--uwb [NAME:]PORT", "UWB tag (a DWM1001 without a name); repeatable", action="append")
    option(devices, "--lidar [NAME:]PORT", "lidar (a Hokuyo without a name); repeatable", action="append")
    option(devices, "--odometry NAME:PORT", "base: kobuki:PORT, line:PORT?columns=...", action="append")
    gyro = "its heading takes the place of the wheels': line:PORT?columns=t,turn_rate"
    option(devices, "--gyro NAME:PORT", gyro, action="append")
    text = "begin although a port does not exist yet; a device that is lost in mid-run is waited for in any case"
    option(devices, "--wait", text)
    output = parser.add_argument_group("output")
    option(output, "--out FILE", "the log; must not exist unless --append", place, required=True)
    option(output, "--append", "go on with a log that broke off")
    option(output, "--rotate SIZE", "begin a new part at this size, e.g. 500M", _size, 0)
    option(output, "--duration S", "stop after so many seconds", number(above=0))
    option(output, "--sync S", "s between syncs to the disk (1; 0 = each write)", number(least=0), 1.0)
    option(output, "--json", "summary as one JSON object on stdout")
    page = "show the map while it grows, as uwblite watch does, in a process of its own (127.0.0.1:8000)"
    option(output, "--watch [ADDRESS:]PORT", page, page_address, nargs="?", const=LOCAL)
    laser = parser.add_argument_group("lidar")
    option(laser, "--lidar-steps A:B", "first and last step, e.g. 128:640 (all: 44:725)")
    merged, skipped = number(1, 99, whole=True), number(0, 9, whole=True)
    option(laser, "--lidar-cluster N", "steps merged into one reading (1)", merged)
    option(laser, "--lidar-skip N", "scans left out between two (0)", skipped)
    narrow = "2-character readings up to 4.095 m, for slow RS-232"
    laser.add_argument("--lidar-narrow", action="store_const", const=1, help=narrow)
    option(laser, "--lidar-baud N", "bit/s to try first on RS-232 (115200)", number(whole=True))
    mounting = parser.add_argument_group("mounting, for the log")
    pose = "laser on the base: m, m, rad; once for each --lidar, in their order"
    option(mounting, "--laser-pose X,Y,THETA", pose, numbers(3), action="append")
    flipped, which = "the laser is mounted upside down; K: the K-th lidar", number(1, MOST["lidar"], whole=True)
    option(mounting, "--laser-flipped K", flipped, which, nargs="?", const=1, action="append")
    tag = "UWB tag on the base, z above the floor: m; once for each --uwb, in their order"
    option(mounting, "--tag X,Y,Z", tag, numbers(3), action="append")
    option(mounting, "--anchor-height H", "height of the anchors above the floor, m", number())


RECORD = Verb(
    "record UWB tag, lidar, base and gyro into a log that `uwblite map` reads",
    """\
examples:
  uwblite devices                                     what is plugged in, and is it set up?
  uwblite record --uwb /dev/serial/by-id/usb-SEGGER... --lidar /dev/serial/by-id/usb-Hokuyo... \\
                 --odometry kobuki:/dev/kobuki --out run.log
  uwblite record --odometry "line:/dev/ttyUSB0?columns=t,left,right&tick=1.2e-4&wheel_base=0.3&time_unit=0.001" \\
                 --uwb shell:/dev/ttyACM0 --out run.log --duration 600
  uwblite record --lidar socket://robot.local:2001 --odometry kobuki:socket://robot.local:2002 --out run.log
  uwblite record ... --out run.log --append           go on after a crash
  uwblite record ... --out run.log --watch 0.0.0.0:8000  the map while it grows, on every phone in the network
  uwblite record --uwb tlv:/dev/ttyACM0 --tag 0.2,0,0.6 --uwb tlv:/dev/ttyACM1 --tag=-0.2,0,0.6 --odometry ...
                                                      a tag in front and one behind

devices (a path, a by-id path, socket://host:port or any other pyserial URL):
  each is written [NAME:]PORT[?option=value&...]; `uwblite devices --kinds` lists the names with their options

The log is CARMEN text. Each line is with the kernel as soon as it is written, so a crash loses at most the last one, and
with the disk after --sync seconds. Losses, reconnects and warnings stand in it as COMMENT lines. A recording ends with
--duration, Ctrl-C (exit code 130), SIGTERM or a closed terminal (0). Exit code 3: written, but a device was silent or
lost much.
PARAM lines written besides the mounting: laser_time_increment (s between rays), laser_range_min (m), laser_product,
laser_firmware, laser_serial, uwb_tag_id, uwb_pan_id, uwb_tag_firmware, host_monotonic_zero (log time minus the
computer's monotonic clock, s).
""",
    _record,
    matrices=False,
)


def _watch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="CARMEN log that is being written, its first part where it has several")
    option(parser, "--port N", "port (8000; 0 = any)", number(0, 65535, whole=True), 8000)
    option(parser, "--host ADDRESS", "address to listen on (this computer alone)", default="127.0.0.1")
    option(parser, "--out DIR", "folder for the latest map (LOG_watch)", place)
    option(parser, "--force", "replace a map that is already in --out")
    add_settings_arguments(parser)
    add_mounting_arguments(parser)


WATCH = Verb(
    "follow a growing log: the map so far, silent sensors and what to drive next, on a page for phone and computer",
    """\
examples:
  uwblite watch run.log                       http://127.0.0.1:8000/ on this computer
  uwblite watch run.log --host 0.0.0.0        for every phone and computer in the network
  uwblite record ... --out run.log --watch    records and watches
  uwblite watch run.log --laser-flipped       how the map is made, as for uwblite map

The log may be written by anything, may have parts (record --rotate), and need not be there yet. It is mapped again and again
in a process of the lowest priority, into LOG_watch, with scans left out so that a round takes a tenth of the time since the
last one at most; once the log rests, from all scans. Whoever can reach the page can see it, and nobody can change anything.
""",
    _watch,
    matrices=False,
)


def _pan_id(text: str) -> int:
    try:
        value = int(text, 16)
    except ValueError:
        value = -1
    if not 0 < value <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is not a network id such as 0xC0DE")
    return value


def _devices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("ports", metavar="PORT", nargs="*", help="ports to look at (default: those of a known kind)")
    option(parser, "--list", "list the ports and open none")
    option(parser, "--kinds", "list the devices that can be recorded, with their options")
    option(parser, "--pan-id ID", "network id that the tag should have, e.g. 0xC0DE", _pan_id)
    option(parser, "--json", "one JSON object on stdout")


DEVICES = Verb(
    "list tag, lidar and base that are plugged in, and say how to fix what is not right",
    """\
examples:
  uwblite devices                              look at every port of a known kind
  uwblite devices /dev/ttyUSB0 /dev/serial0    look at these ports, whatever they are
  uwblite devices --pan-id 0xC0DE              and is the tag in this network?
  uwblite devices --list                       only list ports; nothing is opened
  uwblite devices --kinds                      what can be recorded, with names and options

Looking at a port opens it, listens for a moment and asks who is there. Ports of an unknown kind are only opened when they
are named. Nothing is changed: every finding names what to type. Exit code 0: all is well; 1: no device was found; 3: something
needs mending.
""",
    _devices,
    matrices=False,
)


def _convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", help="what to convert; - reads a log from standard input")
    parser.add_argument("target", type=place, nargs="?", help="what to make; its ending names the format, or --to does")
    parser.add_argument("--to", choices=TARGETS, help="format of the target where its ending names none")
    option(parser, "--force", "replace a file that is already there")
    option(parser, "--json", "print a summary as one JSON object instead of text")
    text = "recording that a map was made of, for its scans and odometry; repeatable, in their order"
    option(parser, "--recording LOG", text, action="append", default=[])
    option(parser, "--list", "list the topics of a bag and stop")
    add_bag_arguments(parser)
    part = parser.add_argument_group("part and units")
    unit = number(above=0)
    option(part, "--start S", "leave out what is earlier, s after the first odometry", number())
    option(part, "--end S", "leave out what is later, s after the first odometry", number())
    option(part, "--time-unit S", "seconds per unit of the stamps (1)", unit, 1.0)
    option(part, "--odometry-unit M", "metres per unit of the odometry (1)", unit, 1.0)
    option(part, "--angle-unit RAD", "radians per unit of its heading (1)", unit, 1.0)
    option(part, "--range-unit M", "metres per unit of the ranges (1)", unit, 1.0)
    option(part, "--laser-unit M", "metres per unit of the laser (1)", unit, 1.0)
    add_mounting_arguments(parser)


CONVERT = Verb(
    "convert recordings (CARMEN log, ROS 1/2 bag, CSV folder), maps, trajectories and pose graphs (g2o, TORO, PyFG)",
    """\
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
""",
    _convert,
)


def _optimize(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("graph", help=".g2o, TORO (.graph, .toro) or .pyfg file, plain or .gz; - reads standard input")
    option(parser, "--out FILE", "optimised graph; .g2o or .pyfg by its name, .gz compresses", place)
    option(parser, "--trajectory FILE", "poses as a TUM trajectory, as evo reads it", place)
    option(parser, "--from-odometry", "forget the file's estimates, start from the odometry")
    way = parser.add_mutually_exclusive_group()
    adding = "start from the odometry and add poses in the order of time, anchors when their ranges place them"
    option(way, "--incremental", adding)
    deciding = "decide which loop closures and ranges are outliers, by graduated non-convexity, and leave them out"
    option(way, "--robust", deciding)
    option(parser, "--kernel NAME", "robust kernel on edges that close loops, and ranges", default="none")
    option(parser, "--kernel-scale K", "standard deviations where it bends (2)", number(above=0), 2.0)
    option(parser, "--set NAME=VALUE", "solver setting, e.g. max_iterations=200; repeatable", action="append", default=[])
    option(parser, "--force", "replace files that are already there")
    option(parser, "--json", "print a summary as one JSON object instead of text")


OPTIMIZE = Verb(
    "optimise a pose graph: g2o, TORO or PyFG in, optimised graph and trajectory out",
    """\
examples:
  uwblite optimize graph.g2o --out optimised.g2o
  uwblite optimize graph.pyfg --out optimised.pyfg --trajectory path.tum --from-odometry
  uwblite optimize loops.g2o --out straight.g2o --kernel huber --kernel-scale 2
  uwblite optimize graph.pyfg --incremental --out optimised.pyfg   the odometry bends so far that all at once fails
  uwblite optimize loops.g2o --robust --out straight.g2o           some loop closures or ranges are false
  uwblite optimize graph.g2o --json                chi2 and iterations only, nothing is written

exit code 3: the search did not converge
""",
    _optimize,
)


def _config(parser: argparse.ArgumentParser) -> None:
    add_settings_arguments(parser)
    option(parser, "--all", "list settings for experiments too")
    option(parser, "--no-comments", "values only")


CONFIG = Verb(
    "print the settings with their meaning, as a file for --config",
    """\
examples:
  uwblite config > my.toml                      the settings, each with unit, meaning and default
  uwblite config --all                          also those for experiments
  uwblite config --preset paper                 the settings of a preset
  uwblite config --set icp.max_iterations=30    try a change: names and ranges are checked
  uwblite config --config my.toml               check a file and show the effective settings
""",
    _config,
    matrices=False,
)
