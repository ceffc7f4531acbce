"""`uwblite localize`: where a robot drove within a map that is there already."""

import argparse
import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from .live import add_live_arguments, run_live, tell_doubts
from .options import add_bag_arguments, add_mounting_arguments, add_settings_arguments, place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..io.stored_result import StoredResult
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

The start pose need not be known: ranges and scans are searched for in the whole map, as with --live; then the recording is
tracked forwards and backwards and both are averaged. Ranges alone determine it to a decimetre. The map is not changed.
With --live, a line a tenth of a second: stamp, pose, covariance, quality (0..1), lost, and why; see docs/navigation.md.
exit code 3: written, but doubted: the walls do not fit, or much of it is not localized; the reasons are named
exit code 1: found nowhere for certain; nothing is written
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
    from ..io.result_text import json_lines
    from ..io.stored_result import read_result
    from ..localization.known_map import from_result
    from ..localization.localize import localize
    from . import console
    from .formats import read_recording, refuse_existing
    from .options import apply_mounting, bag_choices, effective_config

    files = _files(args)
    refuse_existing(args.force, *files.values())
    config = effective_config(args)
    earlier = read_result(args.map)
    tell_doubts(earlier)
    known = from_result(earlier)
    log = apply_mounting(read_recording(args.log, bag=bag_choices(args)), args)
    log = log.without(uwb=not config.use_uwb, lidar=not config.use_lidar)
    progress = console.Progress()
    try:
        found = localize(log, known, turn_laser=config.detect_laser_flip, progress=progress)
    finally:
        progress.close()
    summary = _summary(found, list(files.values()))
    about = {"source": log.notes.source, "sha256": log.notes.sha256, "map": args.map}
    picture = _picture(found, earlier, os.path.basename(args.log)) if "picture" in files else None
    with _together(files, args.out) as places:
        _write(places, found, picture, json_lines(about | summary))
    if args.json:
        console.say_json(summary)
    else:
        _say(found, list(files.values()))
    return 3 if found.doubts else 0


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

    write_tum(places["trajectory"], found.stamps, found.trajectory)
    if "covariance" in places:
        write_text(places["covariance"], covariance_csv(found.stamps, found.covariances))
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


def _picture(found: "Localization", earlier: "StoredResult", caption: str) -> Any:
    from ..report.picture import PictureAnchor, draw_map

    anchors = [PictureAnchor(a.id, a.position, a.covariance) for a in earlier.anchors]
    return draw_map(earlier.grid, found.trajectory, anchors=anchors, caption=caption)


def _summary(found: "Localization", files: list[str]) -> dict[str, Any]:
    """Return what was found, ready for JSON."""
    from ..io.result_text import notices

    return {
        "files": files,
        "poses": len(found.stamps),
        "localized": found.localized,
        "overlap": found.overlap if found.overlap == found.overlap else None,
        "warnings": notices(found.warnings),
        "doubts": notices(found.doubts),
        "exit_code": 3 if found.doubts else 0,
    }


def _say(found: "Localization", files: list[str]) -> None:
    from . import console
    from .wording import signed

    start = found.trajectory[0]
    sigma = sorted((c[0, 0] + c[1, 1]) ** 0.5 for c in found.covariances)[len(found.covariances) // 2]
    console.say(f"{len(found.stamps)} poses; the recording began at x {signed(start[0])} m, y {signed(start[1])} m")
    console.say(f"{100 * found.localized:.0f} % of the recording is localized, typically to ±{sigma:.2f} m")
    if found.overlap == found.overlap:
        console.say(f"{100 * found.overlap:.0f} % of the lidar's points in known space lie on walls of the map")
    else:
        console.say("no walls to compare: the position rests on the anchors")
    for text in found.warnings:
        console.say(f"warning: {text}")
    for text in found.doubts:
        console.say(f"DOUBT: {text}")
    console.say("files: " + " ".join(files))
