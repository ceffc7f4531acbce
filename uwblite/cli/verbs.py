"""The verbs in the order in which a user meets them: what each is for, examples first, and its options."""

import argparse
import re
from typing import Any

from .options import BAG, LOCAL, MOUNTING, SETTINGS, Add, Verb, either, group, number, numbers, option, page_address, place

MOST = {"uwb": 9, "lidar": 5, "gyro": 1, "odometry": 1}
"""How many of a kind a log keeps apart."""
TARGETS = ("log", "csv", "mcap", "sqlite3", "g2o", "pyfg", "tum", "kitti", "nav2")
"""Formats that `uwblite convert` writes."""


COUNT, ABOVE_ZERO, PORT = number(above=0, whole=True), number(above=0), number(0, 65535, whole=True)
REPEATED: dict[str, Any] = {"action": "append", "default": []}
PAGE: dict[str, Any] = {"nargs": "?", "const": LOCAL}


def _size(text: str) -> int:
    match = re.fullmatch(r"(\d+)([kMG]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 500M")
    return int(match[1]) * {"": 1, "k": 1000, "M": 10**6, "G": 10**9}[match[2]]


def _pan_id(text: str) -> int:
    try:
        value = int(text, 16)
    except ValueError:
        value = -1
    if not 0 < value <= 0xFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is not a network id such as 0xC0DE")
    return value


class _Instead(argparse.Action):
    """A switch with which another option, its `const`, is not required."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: Any) -> None:
        setattr(namespace, self.dest, True)
        next(action for action in parser._actions if action.dest == self.const).required = False


def workers(jobs: str) -> Add:
    """Return --jobs, with its help, and --scheduler."""
    return either(
        option("--jobs N", jobs, COUNT, 1),
        option("--scheduler ADDRESS", "hand the work to a dask.distributed scheduler, such as tcp://head:8786", default=""),
    )


MAP_OPTIONS = (
    option("--without", "leave out a sensor or the closures; repeatable", **REPEATED, choices=("uwb", "loops", "lidar")),
    option("--every-nth-scan N", "read every n-th laser scan only; the others cost nothing (1)", COUNT, 1),
    group(
        "map",
        option("--resolution M", "edge of a cell, m: short for --set grid.resolution=M", ABOVE_ZERO),
        option("--align", "where the axes lie (odometry)", choices=("odometry", "first-pose", "walls", "anchors")),
        option("--crop X0,Y0,X1,Y1", "keep this part of the grid, m: short for --set crop=[...]", numbers(4)),
        option("--scale-map", "write the probabilities too: map_scale.png (mode: scale)"),
        option("--no-timings", "leave timings out of report.json: same run, same bytes"),
    ),
    group(
        "known beforehand",
        option("--constraints FILE.toml", "surveyed anchors, pinned poses, distances, closures, see docs/formats.md", place),
        option("--anchors-from FILE.csv", "the frame of an earlier map: its anchors.csv; moved anchors are named", place),
    ),
    option("--ignore-memory", "map although it needs more than twice the memory that computer, control group or shell gives"),
    SETTINGS,
    MOUNTING,
    BAG,
)


MAP = Verb(
    "map a recording: trajectory, anchors, occupancy grid, report",
    """\
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
""",
    (
        option("logs", "CARMEN log, ROS bag or CSV folder; several make one map; - = standard input", metavar="LOG", nargs="+"),
        option("--out", "folder for the result", type=place, metavar="DIR", required=True),
        option("--force", "replace a result that is already there"),
        option("--json", "print a summary as one JSON object instead of text"),
        option(
            "--dry-run",
            "estimate time and memory, map nothing; needs no --out",
            action=_Instead,
            nargs=0,
            default=False,
            const="out",
        ),
        option("--corrected-log FILE", "the log's scans with corrected laser poses, as GMapping's users exchange", place),
        workers("processes for the heavy stages (1)"),
        *MAP_OPTIONS,
    ),
)


BATCH = Verb(
    "map many recordings, each on its own: a folder for each, and a table",
    """\
examples:
  uwblite batch *.log --out maps/                        maps/NAME/ for each recording, maps/batch.html, maps/batch.csv
  uwblite batch *.log --out maps/ --jobs 4               four recordings at a time
  uwblite batch *.log --out maps/ --scheduler tcp://head:8786    on the workers of a dask.distributed scheduler
  uwblite batch *.log --out maps/ --anchors-from site/anchors.csv    all of them in one frame

What is finished is kept: the same command again, after a crash or with further recordings, maps only what is missing.
A recording that fails does not stop the others. Workers of a scheduler read and write the files themselves, so they must
see them under the same names.

exit code 1: a recording failed; 3: a result should not be trusted; the table names them
""",
    (
        option("logs", "CARMEN log, plain or .gz, ROS bag or CSV folder", metavar="LOG", nargs="+"),
        option("--out DIR", "folder for the results, a folder for each, and the table", place, required=True),
        option("--force", "replace results that were made of other recordings or with other settings"),
        option("--json", "print the table as one JSON object instead of text"),
        workers("recordings that are mapped at a time, each in a process (1)"),
        *MAP_OPTIONS,
    ),
)


VIEW = Verb(
    "look at results in the browser, side by side; reject or force closures, pin anchors, and map again",
    """\
examples:
  uwblite view map/                          one result
  uwblite view before/ after/                two of them side by side: settings, days, presets
  uwblite view map/ run.log                  with the recording, to map it again after a correction
  uwblite view map/ run.log --port 8765      always the same address

A click on a closure or an anchor offers what can be done with it; it goes into the constraints file that is named at the
start, and "Map again" makes DIR_2, DIR_3 ... beside DIR. The page is served to this computer alone; Ctrl-C ends it.
""",
    (
        option("paths", "result of uwblite map, or a recording; those beside results are found", metavar="DIR|FILE", nargs="+"),
        option("--port N", "port (any that is free)", PORT, 0),
        option("--constraints FILE.toml", "where corrections go (DIR_constraints.toml)", place),
        option("--open", "open the page in the browser"),
    ),
    matrices=False,
)


LIVE = group(
    "live (docs/navigation.md)",
    option("--live", "follow the log, or devices, and say the pose as it becomes known"),
    option("--rate HZ", "lines per second of driving (10)", ABOVE_ZERO, 10.0),
    option("--idle S", "end when the log has not grown for so long (never)", ABOVE_ZERO),
    option("--late S", "without data for so long, and three of its periods, a sensor is silent (2)", ABOVE_ZERO, 2.0),
    option("--lost-after S", "without any data for so long the pose counts as lost (10)", ABOVE_ZERO, 10.0),
    option(
        "--serve [ADDRESS:]PORT",
        "show the pose on a page; an address opens it to others, such as 0.0.0.0:8000",
        page_address,
        **PAGE,
    ),
    option("--odometry NAME:PORT", "device, as for uwblite record", action="append"),
    option("--lidar [NAME:]PORT", "device, as for uwblite record", action="append"),
    option("--uwb [NAME:]PORT", "device, as for uwblite record; repeatable", action="append"),
    option("--gyro NAME:PORT", "device, as for uwblite record", action="append"),
)


LOCALIZE = Verb(
    "find the trajectory of a new recording in an existing map, by its anchors and walls",
    """\
examples:
  uwblite localize new.log --map map/ --out new.tum
  uwblite localize new.log --map map/ --out new.tum --picture new.png --covariance new.csv
  uwblite localize new.log --map map/ --out new/       all of these in a folder, and report.json

  uwblite localize run.log --live --map map/             follow a log that is being recorded: JSON lines on stdout
  ssh robot cat run.log | uwblite localize - --live --map map/
  uwblite localize --live --map map/ --odometry kobuki:/dev/kobuki --lidar /dev/ttyACM1 --uwb /dev/ttyACM0

The start pose need not be known: ranges and scans are searched for in the whole map, as with --live; then the recording is
tracked forwards and backwards and both are averaged. Ranges alone determine it to a decimetre. The map is not changed.
With --live, a line a tenth of a second: stamp, pose, covariance, quality (0..1), lost, and why; see docs/navigation.md.
exit code 3: written, but doubted: the walls do not fit, or much of it is not localized; the reasons are named
exit code 1: found nowhere for certain; nothing is written
""",
    (
        option(
            "log", "CARMEN log, ROS bag or CSV folder; - = standard input; none with --live on devices", nargs="?", default=""
        ),
        option("--map DIR", "folder that uwblite map wrote: anchors.csv, map.yaml", required=True),
        option("--out FILE.tum|DIR", "trajectory; a name without .tum is a folder for it, covariances and report", place),
        option("--covariance FILE.csv", "covariance of every keyframe", place),
        option("--picture FILE.png", "the path drawn on the map", place),
        option("--force", "replace files that are already there"),
        option("--json", "print a summary as one JSON object instead of text"),
        LIVE,
        SETTINGS,
        MOUNTING,
        BAG,
    ),
)


PLAN = Verb(
    "plan a path through the free space of a map, for a round robot",
    """\
examples:
  uwblite plan --map map/ --from 0,0 --to 4.5,3 --radius 0.2           -> plan.csv and plan.png
  uwblite plan --map map/ --from 0,0,1.57 --to 4.5,3 --via 2,1 --via 2,3 --radius 0.2
  uwblite plan --map map/map.yaml --from 0,0 --to 9,2 --radius 0.2 --unknown price --step 0.25 --json

Every point of the path is at least the radius away from all walls; it keeps farther away where that costs little. A place
that cannot be reached ends with exit code 1 and the nearest one that can.
""",
    (
        option("--map DIR", "folder that uwblite map wrote, or the map.yaml of any map", required=True),
        option("--from X,Y[,THETA]", f"""{"X,Y in the map's frame, m"}, rad""", numbers(2, 3), dest="start", required=True),
        option("--to X,Y", "X,Y in the map's frame, m", numbers(2), dest="goal", required=True),
        option("--via X,Y", "pass here; repeatable", numbers(2), [], action="append"),
        option("--radius M", "of the robot, m", number(0, 1000), required=True),
        option(
            "--unknown",
            "unknown space: five times as dear as free space, or refused (default)",
            choices=("refuse", "price"),
            default="refuse",
        ),
        option("--step M", "largest step of the path, m (0.1)", number(least=0.001), 0.1),
        option("--out NAME", "NAME.csv and NAME.png are written (plan)", place, "plan"),
        option("--force", "replace files that are already there"),
        option("--json", "print one JSON object, with the path, instead of text"),
    ),
)


CHECK = Verb(
    "say what is wrong with a recording and what to do about it, before mapping it",
    """\
examples:
  uwblite check run.log                    findings, worst first; exit code 3 where one spoils the map
  uwblite check run.log --map              also what only a map can tell; takes as long as one
  uwblite check run.log.gz --json          the same for a script
  uwblite check run.log --laser-flipped    does the laser agree with the wheels that way?
""",
    (
        option("log", "CARMEN log, plain or .gz, ROS bag or CSV folder; - reads a log from standard input"),
        option("--json", "print one JSON object instead of text"),
        option("--map", "map it as well: scales, biases, clock offsets and the doubts of that map; takes as long as a map"),
        MOUNTING,
        BAG,
    ),
)


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
  uwblite record --lidar "/dev/ttyUSB1?steps=128:640&cluster=2" ...   a Hokuyo on slow RS-232
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
    (
        group(
            "devices",
            option("--uwb [NAME:]PORT", "UWB tag (a DWM1001 without a name); repeatable", action="append"),
            option("--lidar [NAME:]PORT", "lidar (a Hokuyo without a name); repeatable", action="append"),
            option("--odometry NAME:PORT", "base: kobuki:PORT, line:PORT?columns=...", action="append"),
            option("--gyro NAME:PORT", "its heading replaces the wheels': line:PORT?columns=t,turn_rate", action="append"),
            option("--wait", "begin although a port is not there yet; a device lost in mid-run is always waited for"),
        ),
        group(
            "output",
            option("--out FILE", "the log; must not exist unless --append", place, required=True),
            option("--append", "go on with a log that broke off"),
            option("--rotate SIZE", "begin a new part at this size, e.g. 500M", _size, 0),
            option("--duration S", "stop after so many seconds", ABOVE_ZERO),
            option("--sync S", "s between syncs to the disk (1; 0 = each write)", number(least=0), 1.0),
            option("--json", "summary as one JSON object on stdout"),
            option(
                "--watch [ADDRESS:]PORT",
                "show the map while it grows, as uwblite watch does (127.0.0.1:8000)",
                page_address,
                **PAGE,
            ),
        ),
        group(
            "mounting, for the log",
            option("--laser-pose X,Y,THETA", "of each --lidar in turn, on the base: m, m, rad", numbers(3), action="append"),
            option(
                "--laser-flipped K",
                "the laser is mounted upside down; K: the K-th lidar",
                number(1, MOST["lidar"], whole=True),
                nargs="?",
                const=1,
                action="append",
            ),
            option("--tag X,Y,Z", "of each --uwb in turn, on the base, z above the floor: m", numbers(3), action="append"),
            option("--anchor-height H", "height of the anchors above the floor, m", number()),
        ),
    ),
    matrices=False,
)


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
    (
        option("log", "CARMEN log that is being written, its first part where it has several", metavar="LOG"),
        option("--port N", "port (8000; 0 = any)", PORT, 8000),
        option("--host ADDRESS", "address to listen on (this computer alone)", default="127.0.0.1"),
        option("--out DIR", "folder for the latest map (LOG_watch)", place),
        option("--force", "replace a map that is already in --out"),
        SETTINGS,
        MOUNTING,
    ),
    matrices=False,
)


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
    (
        option("ports", "ports to look at (default: those of a known kind)", metavar="PORT", nargs="*"),
        option("--list", "list the ports and open none"),
        option("--kinds", "list the devices that can be recorded, with their options"),
        option("--pan-id ID", "network id that the tag should have, e.g. 0xC0DE", _pan_id),
        option("--json", "one JSON object on stdout"),
    ),
    matrices=False,
)


PLAN_ANCHORS = Verb(
    "say where further anchors help most, by the expected error of a position over the free space of a map",
    """\
examples:
  uwblite plan-anchors --map map/ --count 2                 -> anchor_plan.csv and anchor_plan.png
  uwblite plan-anchors --map map/ --count 1 --reach 12      the radios reach 12 m
  uwblite plan-anchors --map map/ --count 3 --from-nothing  as if there were no anchors yet

The error at a place is that of a position from one range to each anchor within reach: 0.1 m of noise in line of sight, 0.5 m
through walls. Anchors are put half a metre from walls; where that cannot be done, the picture shows what is nearly as good.
""",
    (
        option("--map DIR", "folder that uwblite map wrote, or the map.yaml of any map", required=True),
        option("--count N", "how many anchors (1)", COUNT, 1),
        option("--reach M", "m up to which a radio reaches (25)", ABOVE_ZERO, 25.0),
        option("--from-nothing", "leave out the anchors that are there"),
        option("--out NAME", "NAME.csv and NAME.png are written (anchor_plan)", default="anchor_plan"),
        option("--force", "replace files that are already there"),
        option("--json", "print one JSON object instead of text"),
    ),
)


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
    (
        option("source", "what to convert; - reads a log from standard input"),
        option("target", "what to make; its ending names the format, or --to does", type=place, nargs="?"),
        option("--to", "format of the target where its ending names none", choices=TARGETS),
        option("--force", "replace a file that is already there"),
        option("--json", "print a summary as one JSON object instead of text"),
        option("--recording LOG", "recording of the map, for scans and odometry; repeatable, in their order", **REPEATED),
        option("--list", "list the topics of a bag and stop"),
        BAG,
        group(
            "part and units",
            option("--start S", "leave out what is earlier, s after the first odometry", number()),
            option("--end S", "leave out what is later, s after the first odometry", number()),
            option("--time-unit S", "seconds per unit of the stamps (1)", ABOVE_ZERO, 1.0),
            option("--odometry-unit M", "metres per unit of the odometry (1)", ABOVE_ZERO, 1.0),
            option("--angle-unit RAD", "radians per unit of its heading (1)", ABOVE_ZERO, 1.0),
            option("--range-unit M", "metres per unit of the ranges (1)", ABOVE_ZERO, 1.0),
            option("--laser-unit M", "metres per unit of the laser (1)", ABOVE_ZERO, 1.0),
        ),
        MOUNTING,
    ),
)


EVALUATE = Verb(
    "compare a map, its trajectory and anchors with the truth",
    """\
examples:
  uwblite evaluate map/ --truth truth.tum
  uwblite evaluate map/ --truth truth.tum --anchors truth_anchors.csv --landmarks columns.csv
  uwblite evaluate map/ --truth truth.tum --json
  uwblite evaluate map/ --relations truth.relations.gz
  uwblite evaluate both/ --truth monday.tum --truth tuesday.tum    a map of two recordings
  uwblite evaluate both/ --truth tuesday.tum --recording 2         only the second of them

The trajectory is aligned with the truth by the best rigid motion, without scale; ATE and RPE are those of evo_ape -a and
evo_rpe. Several truths, in one frame, are of the recordings in their order: each is judged alone and all together, under
one motion. Columns are searched in the map; the distances between them are what is judged.

files (lengths in metres):
  --truth      stamp x y z qx qy qz qw        identity quaternions throughout = the heading is not known
  --anchors    id,x,y
  --landmarks  name,x,y,radius[,neighbours]   neighbours: names separated by blanks; only these distances are judged
  --relations  stamp1 stamp2 x y z roll pitch yaw: the scan of stamp2 as seen from that of stamp1. Poses are asked at the
               lidar's clock, as the map found it; relations without an answer are counted and reported
""",
    (
        option("dir", "folder that uwblite map wrote: trajectory.tum, anchors.csv, map.yaml"),
        option("--truth FILE.tum", "true poses; one per recording", place, action="append"),
        option("--relations FILE", "true relative poses of scans (Kuemmerle et al. 2009)", place),
        option("--recording N", "the recording that a single truth is of (1)", COUNT),
        option("--anchors FILE.csv", "true anchors", place),
        option("--landmarks FILE.csv", "true columns", place),
        option("--delta M", "m of path per stretch of the RPE (1)", ABOVE_ZERO, 1.0),
        option("--max-gap S", "leave out truth in longer gaps, s (1)", ABOVE_ZERO, 1.0),
        option("--search-radius M", "m around a column's place (1)", ABOVE_ZERO, 1.0),
        option("--json", "print one JSON object instead of the table"),
    ),
)

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
    (
        option("graph", ".g2o, TORO (.graph, .toro) or .pyfg file, plain or .gz; - reads standard input"),
        option("--out FILE", "optimised graph; .g2o or .pyfg by its name, .gz compresses", place),
        option("--trajectory FILE", "poses as a TUM trajectory, as evo reads it", place),
        option("--from-odometry", "forget the file's estimates, start from the odometry"),
        option("--incremental", "from the odometry, straightened by ranges outwards from where they place anchors best"),
        option("--robust", "leave out closures and ranges that are outliers by graduated non-convexity"),
        option("--kernel NAME", "robust kernel on edges that close loops, and ranges", default="none"),
        option("--kernel-scale K", "standard deviations where it bends (2)", ABOVE_ZERO, 2.0),
        option("--set NAME=VALUE", "solver setting, e.g. max_iterations=200; repeatable", **REPEATED),
        option("--force", "replace files that are already there"),
        option("--json", "print a summary as one JSON object instead of text"),
    ),
)


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
    (SETTINGS, option("--all", "list settings for experiments too"), option("--no-comments", "values only")),
    matrices=False,
)


VERBS = {
    "map": MAP,
    "batch": BATCH,
    "view": VIEW,
    "localize": LOCALIZE,
    "plan": PLAN,
    "check": CHECK,
    "record": RECORD,
    "watch": WATCH,
    "devices": DEVICES,
    "plan-anchors": PLAN_ANCHORS,
    "convert": CONVERT,
    "evaluate": EVALUATE,
    "optimize": OPTIMIZE,
    "config": CONFIG,
}
"""`uwblite VERB` is `run` of the module of that name, with _ for -."""
