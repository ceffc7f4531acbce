"""`uwblite localize`: where a robot drove within a map that is there already."""

import argparse
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from ..errors import ConfigError, UsageError
from ..io.files import write_text
from ..io.folders import refuse_foreign, replacing_folder, unmarked
from ..io.formats import refuse_existing
from ..io.png import write_png
from ..io.result_text import covariance_csv, json_lines
from ..io.stored_result import read_result
from ..io.tum import write_tum
from ..localization.known_map import from_result
from ..localization.localize import Localization, localize
from ..report.drawn_map import DrawnAnchor, DrawnMap
from ..report.picture import draw_map
from ..report.printable import percent, signed
from . import console
from .inputs import effective_config, recording
from .live import run_live, tell_doubts


def run(args: argparse.Namespace) -> int:
    if args.live:
        return run_live(args)
    if not args.log or not args.out:
        raise UsageError("localize needs a recording and --out, or --live; see uwblite localize --help")

    files = _files(args)
    refuse_existing(args.force, *files.values())
    config = effective_config(args)
    earlier = read_result(args.map)
    tell_doubts(earlier)
    known = from_result(earlier)
    log = recording(args, args.log).without(uwb=not config.use_uwb, lidar=not config.use_lidar)
    with closing(console.Progress()) as progress:
        localization = localize(log, known, turn_laser=config.detect_laser_flip, progress=progress)
    summary = _summary(localization, list(files.values()))
    about = {"source": log.notes.source, "sha256": log.notes.sha256, "map": args.map}
    anchors = [DrawnAnchor(a.id, a.position, a.covariance) for a in earlier.anchors]
    drawn = DrawnMap(earlier.grid, [localization.trajectory], anchors)
    picture = draw_map(drawn, caption=os.path.basename(args.log)) if "picture" in files else None
    with _appearing_together(files, args.out) as places:
        _write(places, localization, picture, json_lines(about | summary))
    console.report(args.json, summary, _lines(localization, list(files.values())))
    return 3 if localization.doubts else 0


@contextmanager
def _appearing_together(files: dict[str, str], folder: str) -> Iterator[dict[str, str]]:
    """Give the names under which to write files; all those of a folder, which has a report, appear at once."""
    if "report" not in files:
        yield files
        return
    home = os.path.realpath(folder)
    inside = {what: os.path.basename(name) for what, name in files.items() if os.path.dirname(os.path.realpath(name)) == home}
    with replacing_folder(folder, {*_NAMES.values(), *inside.values()}.__contains__) as waiting:
        yield files | {what: str(waiting / name) for what, name in inside.items()}


def _write(places: dict[str, str], localization: Localization, picture: Any, report: str) -> None:
    write_tum(places["trajectory"], localization.stamps, localization.trajectory)
    if "covariance" in places:
        write_text(places["covariance"], covariance_csv(localization.stamps, localization.covariances))
    if "picture" in places:
        write_png(places["picture"], picture)
    if "report" in places:
        write_text(places["report"], report)


_NAMES = {
    "trajectory": "trajectory.tum",
    "covariance": "trajectory_covariance.csv",
    "picture": "path.png",
    "report": "report.json",
}
"""What a folder of a localisation holds."""
_REPORT = '{\n "source": '
"""Beginning of its report, by which it is known."""


def _files(args: argparse.Namespace) -> dict[str, str]:
    if args.out.endswith((".tum", ".tum.gz")):
        named = {"trajectory": args.out, "covariance": args.covariance, "picture": args.picture}
        return {what: name for what, name in named.items() if name}
    if os.path.realpath(args.out) == os.path.realpath(args.map):
        raise ConfigError(f"--out {args.out} is the map itself, which is not changed; choose another folder")
    if os.path.isfile(args.out):
        raise ConfigError(f"{args.out} is a file; name a folder, or a trajectory that ends in .tum")
    if os.path.exists(os.path.join(args.out, "map.yaml")):
        raise ConfigError(f"{args.out} holds a map, which a localisation does not replace; choose another folder")
    refuse_foreign(unmarked(Path(args.out), _NAMES.values(), _NAMES["report"], _REPORT))
    files = {what: os.path.join(args.out, name) for what, name in _NAMES.items()}
    return files | {what: name for what in ("covariance", "picture") if (name := getattr(args, what))}


def _summary(localization: Localization, files: list[str]) -> dict[str, Any]:
    return {
        "files": files,
        "poses": len(localization.stamps),
        "localized": localization.localized,
        "overlap": localization.overlap if localization.overlap == localization.overlap else None,
        "warnings": [finding.record() for finding in localization.warnings],
        "doubts": [finding.record() for finding in localization.doubts],
        "exit_code": 3 if localization.doubts else 0,
    }


def _lines(localization: Localization, files: list[str]) -> list[str]:
    start = localization.trajectory[0]
    sigma = sorted((c[0, 0] + c[1, 1]) ** 0.5 for c in localization.covariances)[len(localization.covariances) // 2]
    walls = f"{percent(localization.overlap)} of the lidar's points in known space lie on walls of the map"
    return [
        f"{len(localization.stamps)} poses; the recording began at x {signed(start[0])} m, y {signed(start[1])} m",
        f"{percent(localization.localized)} of the recording is localized, typically to ±{sigma:.2f} m",
        walls if localization.overlap == localization.overlap else "no walls to compare: the position rests on the anchors",
        *(f"warning: {text}" for text in localization.warnings),
        *(f"DOUBT: {text}" for text in localization.doubts),
        "files: " + " ".join(files),
    ]
