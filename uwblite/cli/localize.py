"""`uwblite localize`: where a robot drove within a map that is there already."""

import argparse
import os
import time
from typing import TYPE_CHECKING, Any

from .options import add_mounting_arguments, add_settings_arguments

if TYPE_CHECKING:
    from ..localize import Localization
    from ..occupancy_grid import OccupancyGrid
    from ..sensor_log import SensorLog

HELP = "find the trajectory of a new recording in an existing map, by its anchors and walls"
EPILOG = """\
examples:
  uwblite localize new.log --map map/ --out new.tum
  uwblite localize new.log --map map/ --out new.tum --picture new.png --covariance new.csv

The start pose need not be known: the anchors' ids tie the recording to the map. The map is not changed.
exit code 3: written, but the walls do not fit, or an anchor was moved; the reasons are named
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("log", help="CARMEN log, plain or .gz, ROS bag or CSV folder; - reads a log from standard input")
    parser.add_argument("--map", metavar="DIR", required=True, help="folder that uwblite map wrote: anchors.csv, map.yaml")
    parser.add_argument("--out", metavar="FILE.tum", required=True, help="trajectory in the map's frame")
    parser.add_argument("--covariance", metavar="FILE.csv", help="covariance of every keyframe")
    parser.add_argument("--picture", metavar="FILE.png", help="the path drawn on the map")
    parser.add_argument("--force", action="store_true", help="replace files that are already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")
    add_settings_arguments(parser)
    add_mounting_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..io.constraints_file import read_anchors
    from ..io.files import write_text
    from ..io.map_server import read_map
    from ..io.png import write_png
    from ..io.result_text import covariance_csv
    from ..io.tum import write_tum
    from ..localize import localize
    from . import console
    from .formats import read_recording, refuse_existing
    from .options import apply_mounting, effective_config

    refuse_existing(args.force, args.out, args.covariance, args.picture)
    config = effective_config(args)
    anchors = read_anchors(os.path.join(args.map, "anchors.csv"))
    yaml = os.path.join(args.map, "map.yaml")
    grid = read_map(yaml) if os.path.exists(yaml) else None
    log = apply_mounting(read_recording(args.log), args)
    progress = console.Progress()
    try:
        found = localize(log, anchors, grid, config, progress=progress, clock=time.perf_counter)
    finally:
        progress.close()
    write_tum(args.out, found.result.stamps, found.result.trajectory)
    if args.covariance:
        write_text(args.covariance, covariance_csv(found.result))
    if args.picture:
        write_png(args.picture, _picture(found, grid, os.path.basename(args.log)))
    _say(args, log, found)
    return 3 if found.result.doubts else 0


def _picture(found: "Localization", grid: "OccupancyGrid | None", caption: str) -> Any:
    from ..map_picture import PictureAnchor, draw_map

    anchors = [PictureAnchor(a.id, a.position, a.covariance) for a in found.result.anchors]
    return draw_map(grid, found.result.trajectory, anchors=anchors, caption=caption)


def _say(args: argparse.Namespace, log: "SensorLog", found: "Localization") -> None:
    from . import console
    from .wording import signed

    result = found.result
    x, y, theta = found.correction.tolist()
    if args.json:
        console.say_json(
            {
                "files": [f for f in (args.out, args.covariance, args.picture) if f],
                "poses": len(result.stamps),
                "correction_by_walls": {"x": x, "y": y, "theta": theta},
                "overlap": found.overlap,
                "warnings": result.warnings,
                "doubts": result.doubts,
                "exit_code": 3 if result.doubts else 0,
            }
        )
        return
    start = result.trajectory[0]
    console.say(f"{len(result.stamps)} poses; the drive began at x {signed(start[0])} m, y {signed(start[1])} m")
    if found.overlap == found.overlap:
        console.say(
            f"{100 * found.overlap:.0f} % of the walls lie on those of the map; they moved the path by"
            f" x {signed(x, 3, plus=True)} m, y {signed(y, 3, plus=True)} m, {signed(theta, 4, plus=True)} rad"
        )
    else:
        console.say("no walls to compare: the position rests on the anchors")
    for text in result.warnings:
        console.say(f"warning: {text}")
    for text in result.doubts:
        console.say(f"DOUBT: {text}")
    console.say("files: " + " ".join(f for f in (args.out, args.covariance, args.picture) if f))
