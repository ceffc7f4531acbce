"""The verbs that make, show, use and judge maps: their options and examples."""

import argparse
from typing import Any

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


def _add_worker_arguments(parser: argparse.ArgumentParser, jobs: str) -> None:
    """Declare --jobs, with its help, and --scheduler."""
    where = parser.add_mutually_exclusive_group()
    option(where, "--jobs N", jobs, number(above=0, whole=True), 1)
    text = "hand the work to the workers of a dask.distributed scheduler, such as tcp://head:8786"
    option(where, "--scheduler ADDRESS", text, default="")


def _add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a map is made of and how, whether of one recording or of many."""
    without = parser.add_argument("--without", action="append", default=[], choices=("uwb", "loops", "lidar"))
    without.help = "leave out a sensor or the loop closures, to see what they give; repeatable"
    text = "read every n-th laser scan only; the others take neither time nor memory (1)"
    counted = number(above=0, whole=True)
    option(parser, "--every-nth-scan N", text, counted, 1)
    output = parser.add_argument_group("map")
    option(output, "--resolution M", "edge of a cell, m: short for --set grid.resolution=M", number(above=0))
    align = "where the axes lie: odometry (default), first-pose, walls (along x and y), anchors; short for --set align=HOW"
    option(output, "--align HOW", align, choices=("odometry", "first-pose", "walls", "anchors"))
    option(output, "--crop X0,Y0,X1,Y1", "keep this part of the grid, m: short for --set crop=[...]", numbers(4))
    option(output, "--scale-map", "write the probabilities too: map_scale.png (mode: scale)")
    option(output, "--no-timings", "leave timings out of report.json: same run, same bytes")
    option(output, "--report-timings", "show the stages' seconds in report.html too")
    beforehand = parser.add_argument_group("known beforehand")
    text = "surveyed anchors, pinned poses, distances, closures, see docs/formats.md"
    option(beforehand, "--constraints FILE.toml", text, place)
    text = "go on in the frame of an earlier map: its anchors.csv; anchors that were moved since are named"
    option(beforehand, "--anchors-from FILE.csv", text, place)
    text = "map although it is expected to need more than twice the memory that this computer, control group or shell gives"
    option(parser, "--ignore-memory", text)
    add_settings_arguments(parser)
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


class _Instead(argparse.Action):
    """A switch with which another option, its `const`, is not required."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: Any) -> None:
        setattr(namespace, self.dest, True)
        self.const.required = False


def _map(parser: argparse.ArgumentParser) -> None:
    several = "CARMEN log, plain or .gz, ROS bag or CSV folder; several are mapped together; - reads a log from standard input"
    parser.add_argument("logs", metavar="LOG", nargs="+", help=several)
    out = parser.add_argument("--out", type=place, metavar="DIR", required=True, help="folder for the result")
    option(parser, "--force", "replace a result that is already there")
    option(parser, "--json", "print a summary as one JSON object instead of text")
    text = "read, estimate time and memory, and map nothing; needs no --out"
    parser.add_argument("--dry-run", action=_Instead, nargs=0, default=False, const=out, help=text)
    text = "the CARMEN log's scans with corrected laser poses, as GMapping's users exchange; one CARMEN log only"
    option(parser, "--corrected-log FILE", text, place)
    _add_worker_arguments(parser, "processes for the heavy stages (1)")
    _add_map_arguments(parser)


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
    _map,
)


def _batch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", metavar="LOG", nargs="+", help="CARMEN log, plain or .gz, ROS bag or CSV folder")
    option(parser, "--out DIR", "folder for the results, a folder for each, and the table", place, required=True)
    option(parser, "--force", "replace results that were made of other recordings or with other settings")
    option(parser, "--json", "print the table as one JSON object instead of text")
    _add_worker_arguments(parser, "recordings that are mapped at a time, each in a process (1)")
    _add_map_arguments(parser)


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
    _batch,
)


def _view(parser: argparse.ArgumentParser) -> None:
    text = "result of uwblite map, or a recording that one was made of; recordings beside the results are found by themselves"
    parser.add_argument("paths", metavar="DIR|FILE", nargs="+", help=text)
    option(parser, "--port N", "port (any that is free)", number(0, 65535, whole=True), 0)
    option(parser, "--constraints FILE.toml", "where corrections go (DIR_constraints.toml)", place)
    option(parser, "--open", "open the page in the browser")


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
    _view,
    matrices=False,
)


def _add_live_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of --live."""
    group = parser.add_argument_group("live (docs/navigation.md)")
    option(group, "--live", "follow the log, or devices, and say the pose as it becomes known")
    option(group, "--rate HZ", "lines per second of driving (10)", number(above=0), 10.0)
    option(group, "--idle S", "end when the log has not grown for so long (never)", number(above=0))
    late = "without data of a sensor for so long, and three of its periods, it is said to be silent (2)"
    option(group, "--late S", late, number(above=0), 2.0)
    option(group, "--lost-after S", "without any data for so long the pose counts as lost (10)", number(above=0), 10.0)
    page = "show the pose on the map, on a page for this computer; an address opens it to others, such as 0.0.0.0:8000"
    option(group, "--serve [ADDRESS:]PORT", page, page_address, nargs="?", const=LOCAL)
    for name, form in (("odometry", "NAME:PORT"), ("lidar", "[NAME:]PORT"), ("uwb", "[NAME:]PORT"), ("gyro", "NAME:PORT")):
        help_text = "device, as for uwblite record" + ("; repeatable" if name == "uwb" else "")
        group.add_argument(f"--{name}", metavar=form, action="append", help=help_text)


def _localize(parser: argparse.ArgumentParser) -> None:
    text = "CARMEN log, plain or .gz, ROS bag or CSV folder; - reads a log from standard input; none with --live on devices"
    parser.add_argument("log", nargs="?", default="", help=text)
    option(parser, "--map DIR", "folder that uwblite map wrote: anchors.csv, map.yaml", required=True)
    out = "trajectory in the map's frame, FILE.tum; any other name is a folder for it, its covariances and a report"
    option(parser, "--out FILE.tum|DIR", out, place)
    option(parser, "--covariance FILE.csv", "covariance of every keyframe", place)
    option(parser, "--picture FILE.png", "the path drawn on the map", place)
    option(parser, "--force", "replace files that are already there")
    option(parser, "--json", "print a summary as one JSON object instead of text")
    _add_live_arguments(parser)
    add_settings_arguments(parser)
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


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
    _localize,
)


def _plan(parser: argparse.ArgumentParser) -> None:
    option(parser, "--map DIR", "folder that uwblite map wrote, or the map.yaml of any map", required=True)
    where = "X,Y in the map's frame, m"
    option(parser, "--from X,Y[,THETA]", f"{where}, rad", numbers(2, 3), dest="start", required=True)
    option(parser, "--to X,Y", where, numbers(2), dest="goal", required=True)
    option(parser, "--via X,Y", "pass here; repeatable", numbers(2), [], action="append")
    option(parser, "--radius M", "of the robot, m", number(0, 1000), required=True)
    text = "unknown space: refuse it (default), or price it five times as dear as free space"
    parser.add_argument("--unknown", choices=("refuse", "price"), default="refuse", help=text)
    option(parser, "--step M", "largest step of the path, m (0.1)", number(least=0.001), 0.1)
    option(parser, "--out NAME", "NAME.csv and NAME.png are written (plan)", place, "plan")
    option(parser, "--force", "replace files that are already there")
    option(parser, "--json", "print one JSON object, with the path, instead of text")


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
    _plan,
)


def _plan_anchors(parser: argparse.ArgumentParser) -> None:
    option(parser, "--map DIR", "folder that uwblite map wrote: map.yaml, anchors.csv", required=True)
    option(parser, "--count N", "how many anchors (1)", number(above=0, whole=True), 1)
    option(parser, "--reach M", "m up to which a radio reaches (25)", number(above=0), 25.0)
    option(parser, "--from-nothing", "leave out the anchors that are there")
    option(parser, "--out NAME", "NAME.csv and NAME.png are written (anchor_plan)", default="anchor_plan")
    option(parser, "--force", "replace files that are already there")
    option(parser, "--json", "print one JSON object instead of text")


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
    _plan_anchors,
)


def _evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dir", help="folder that uwblite map wrote: trajectory.tum, anchors.csv, map.yaml")
    option(parser, "--truth FILE.tum", "true poses; one per recording", place, action="append")
    option(parser, "--relations FILE", "true relative poses of scans (Kuemmerle et al. 2009)", place)
    counted, length = number(above=0, whole=True), number(above=0)
    option(parser, "--recording N", "the recording that a single truth is of (1)", counted)
    option(parser, "--anchors FILE.csv", "true anchors", place)
    option(parser, "--landmarks FILE.csv", "true columns", place)
    option(parser, "--walls FILE.csv", "true walls", place)
    option(parser, "--delta M", "m of path per stretch of the RPE (1)", length, 1.0)
    option(parser, "--max-gap S", "leave out truth in longer gaps, s (1)", length, 1.0)
    option(parser, "--search-radius M", "m around a column's place (1)", length, 1.0)
    option(parser, "--tolerance M", "m from a wall that count as on it (0.1)", length, 0.1)
    option(parser, "--json", "print one JSON object instead of the table")


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
  --walls      x1,y1,x2,y2
  --relations  stamp1 stamp2 x y z roll pitch yaw: the scan of stamp2 as seen from that of stamp1. Poses are asked at the
               lidar's clock, as the map found it; relations without an answer are counted and reported
""",
    _evaluate,
)
