"""`uwblite localize`: where a robot drove within a map that is there already."""

import argparse
import os
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from .live import add_live_arguments, run_live
from .options import add_bag_arguments, add_mounting_arguments, add_settings_arguments, place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..grid.occupancy_grid import OccupancyGrid
    from ..localization.localize import Localization

HELP = "find the trajectory of a new recording in an existing map, by its anchors and walls"
EPILOG = """\
examples:
  uwblite localize new.log --map map/ --out new.tum
  uwblite localize new.log --map map/ --out new.tum --picture new.png --covariance new.csv
  uwblite localize new.log --map map/ --out new/       all of these in a folder, and report.json

  uwblite localize run.log --live --map map/             follow a log that is being recorded: JSON lines on stdout
  ssh robot cat run.log | uwblite localize - --live --map map/
  uwblite localize --live --map map/ --odometry kobuki:/dev/kobuki --lidar /dev/ttyACM1 --uwb /dev/ttyACM0

The start pose need not be known: the anchors' ids tie the recording to the map. Where fewer than two of them are in reach,
the walls are sought in the whole map; without lidar, the anchors alone say it to a decimetre or two. The map is not changed.
With --live, a line a tenth of a second: stamp, pose, covariance, quality (0..1), lost, and why; see docs/navigation.md.
exit code 3: written, but the walls do not fit, or an anchor was moved; the reasons are named
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    text = "CARMEN log, plain or .gz, ROS bag or CSV folder; - reads a log from standard input; none with --live on devices"
    parser.add_argument("log", nargs="?", default="", help=text)
    parser.add_argument("--map", metavar="DIR", required=True, help="folder that uwblite map wrote: anchors.csv, map.yaml")
    out = "trajectory in the map's frame, FILE.tum; any other name is a folder for it, its covariances and a report"
    parser.add_argument("--out", type=place, metavar="FILE.tum|DIR", help=out)
    parser.add_argument("--covariance", type=place, metavar="FILE.csv", help="covariance of every keyframe")
    parser.add_argument("--picture", type=place, metavar="FILE.png", help="the path drawn on the map")
    parser.add_argument("--force", action="store_true", help="replace files that are already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")
    add_live_arguments(parser)
    add_settings_arguments(parser)
    add_mounting_arguments(parser)
    add_bag_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..errors import UsageError

    if args.live:
        return run_live(args)
    if not args.log or not args.out:
        raise UsageError("localize needs a recording and --out, or --live; see uwblite localize --help")
    from ..io.constraints_file import read_anchors
    from ..io.map_server import read_map
    from ..io.result_text import json_lines
    from ..io.results import repair_result
    from ..localization.localize import localize
    from . import console
    from .formats import read_recording, refuse_existing
    from .options import apply_mounting, bag_choices, effective_config

    files = _files(args)
    refuse_existing(args.force, *files.values())
    config = effective_config(args)
    repair_result(args.map)
    yaml = os.path.join(args.map, "map.yaml")
    grid = read_map(yaml) if os.path.exists(yaml) else None
    anchors = read_anchors(os.path.join(args.map, "anchors.csv"), least=1 if grid is None else 0)
    log = apply_mounting(read_recording(args.log, bag=bag_choices(args)), args)
    progress = console.Progress()
    try:
        found = localize(log, anchors, grid, config, progress=progress, clock=time.perf_counter)
    finally:
        progress.close()
    summary = _summary(found, list(files.values()))
    about = {"source": log.notes.source, "sha256": log.notes.sha256, "map": args.map}
    picture = _picture(found, grid, os.path.basename(args.log)) if "picture" in files else None
    with _together(files, args.out) as places:
        _write(places, found, picture, json_lines(about | summary))
    if args.json:
        console.say_json(summary)
    else:
        _say(found, list(files.values()))
    return 3 if found.result.doubts else 0


@contextmanager
def _together(files: dict[str, str], folder: str) -> "Iterator[dict[str, str]]":
    """Give places to write files to; those of a folder of ours appear in it all together."""
    from ..io.folders import replacing_folder

    if "report" not in files:
        yield files
        return
    home = os.path.realpath(folder)
    inside = {what: os.path.basename(name) for what, name in files.items() if os.path.dirname(os.path.realpath(name)) == home}
    with replacing_folder(folder, (_OWN | set(inside.values())).__contains__) as waiting:
        yield files | {what: str(waiting / name) for what, name in inside.items()}


def _write(places: dict[str, str], found: "Localization", picture: Any, report: str) -> None:
    from ..io.files import write_text
    from ..io.png import write_png
    from ..io.result_text import covariance_csv
    from ..io.tum import write_tum

    write_tum(places["trajectory"], found.result.stamps, found.result.trajectory)
    if "covariance" in places:
        write_text(places["covariance"], covariance_csv(found.result))
    if "picture" in places:
        write_png(places["picture"], picture)
    if "report" in places:
        write_text(places["report"], report)


_OWN = {"trajectory.tum", "trajectory_covariance.csv", "path.png", "report.json"}
"""What a folder of a localisation holds."""


def _files(args: argparse.Namespace) -> dict[str, str]:
    """Return the files to be written, by what they hold."""
    from ..errors import ConfigError

    if args.out.endswith((".tum", ".tum.gz")):
        named = {"trajectory": args.out, "covariance": args.covariance, "picture": args.picture}
        return {what: name for what, name in named.items() if name}
    if os.path.realpath(args.out) == os.path.realpath(args.map):
        raise ConfigError(f"--out {args.out} is the map itself, which is not changed; choose another folder")
    if os.path.isfile(args.out):
        raise ConfigError(f"{args.out} is a file; name a folder, or a trajectory that ends in .tum")
    if os.path.exists(os.path.join(args.out, "map.yaml")):
        raise ConfigError(f"{args.out} holds a map, which a localisation does not replace; choose another folder")
    names = {"trajectory": "trajectory.tum", "covariance": "trajectory_covariance.csv", "picture": "path.png"}
    own = {what: os.path.join(args.out, name) for what, name in (names | {"report": "report.json"}).items()}
    return own | {what: name for what in ("covariance", "picture") if (name := getattr(args, what))}


def _picture(found: "Localization", grid: "OccupancyGrid | None", caption: str) -> Any:
    from ..report.picture import PictureAnchor, draw_map

    anchors = [PictureAnchor(a.id, a.position, a.covariance) for a in found.result.anchors]
    return draw_map(grid, found.result.trajectory, anchors=anchors, caption=caption)


def _summary(found: "Localization", files: list[str]) -> dict[str, Any]:
    """Return what was found, ready for JSON."""
    from ..io.result_text import notices

    result = found.result
    x, y, theta = found.correction.tolist()
    return {
        "files": files,
        "poses": len(result.stamps),
        "correction_by_walls": {"x": x, "y": y, "theta": theta},
        "overlap": found.overlap if found.overlap == found.overlap else None,
        "warnings": notices(result.warnings),
        "doubts": notices(result.doubts),
        "exit_code": 3 if result.doubts else 0,
    }


def _say(found: "Localization", files: list[str]) -> None:
    from . import console
    from .wording import signed

    result = found.result
    x, y, theta = found.correction.tolist()
    start = result.trajectory[0]
    console.say(f"{len(result.stamps)} poses; the recording began at x {signed(start[0])} m, y {signed(start[1])} m")
    if found.overlap == found.overlap:
        console.say(
            f"{100 * found.overlap:.0f} % of the walls lie on those of the map; the path was moved by"
            f" x {signed(x, 3, plus=True)} m, y {signed(y, 3, plus=True)} m, {signed(theta, 4, plus=True)} rad"
        )
    else:
        console.say("no walls to compare: the position rests on the anchors")
    for text in result.warnings:
        console.say(f"warning: {text}")
    for text in result.doubts:
        console.say(f"DOUBT: {text}")
    console.say("files: " + " ".join(files))
