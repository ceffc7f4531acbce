"""`uwblite plan`: a path through a map."""

import argparse
import os
from typing import TYPE_CHECKING, Any

from .options import number, numbers, place

if TYPE_CHECKING:
    from ..grid.occupancy_grid import OccupancyGrid
    from ..io.stored_result import StoredAnchor
    from ..navigation.planner import PlannedPath

HELP = "plan a path through the free space of a map, for a round robot"
EPILOG = """\
examples:
  uwblite plan --map map/ --from 0,0 --to 4.5,3 --radius 0.2           -> plan.csv and plan.png
  uwblite plan --map map/ --from 0,0,1.57 --to 4.5,3 --via 2,1 --via 2,3 --radius 0.2
  uwblite plan --map map/map.yaml --from 0,0 --to 9,2 --radius 0.2 --unknown price --step 0.25 --json

Every point of the path is at least the radius away from all walls; it keeps farther away where that costs little. A place
that cannot be reached ends with exit code 1 and the nearest one that can.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--map", metavar="DIR", required=True, help="folder that uwblite map wrote, or the map.yaml of any map")
    where = "X,Y in the map's frame, m"
    parser.add_argument("--from", dest="start", metavar="X,Y[,THETA]", type=numbers(2, 3), required=True, help=f"{where}, rad")
    parser.add_argument("--to", dest="goal", metavar="X,Y", type=numbers(2), required=True, help=where)
    parser.add_argument("--via", metavar="X,Y", type=numbers(2), action="append", default=[], help="pass here; repeatable")
    parser.add_argument("--radius", metavar="M", type=number(0, 1000), required=True, help="of the robot, m")
    text = "unknown space: refuse it (default), or price it five times as dear as free space"
    parser.add_argument("--unknown", choices=("refuse", "price"), default="refuse", help=text)
    parser.add_argument("--step", metavar="M", type=number(least=0.001), default=0.1, help="largest step of the path, m (0.1)")
    parser.add_argument("--out", metavar="NAME", type=place, default="plan", help="NAME.csv and NAME.png are written (plan)")
    parser.add_argument("--force", action="store_true", help="replace files that are already there")
    parser.add_argument("--json", action="store_true", help="print one JSON object, with the path, instead of text")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    import numpy as np

    from ..io.files import write_text
    from ..io.png import write_png
    from ..navigation.planner import NoPathError, make_planner
    from ..report.picture import PictureAnchor, draw_map
    from . import console
    from .formats import refuse_existing

    table, picture = f"{args.out}.csv", f"{args.out}.png"
    refuse_existing(args.force, table, picture)
    grid, anchors = _read(args.map)
    try:
        planner = make_planner(grid, args.radius, unknown=args.unknown)
        path = planner.plan(np.array(args.start), [np.array(p) for p in (*args.via, args.goal)], step=args.step)
    except NoPathError as error:
        if args.json:
            console.say_json({"error": str(error), "nearest": error.nearest, "exit_code": 1})
        raise
    write_text(table, _table(path))
    shown = [PictureAnchor(a.id, a.position) for a in anchors]
    write_png(picture, draw_map(grid, path.poses, anchors=shown, caption=f"{path.length:.2f} m, radius {args.radius:g} m"))
    if args.json:
        console.say_json(_figures(args, path) | {"files": [table, picture], "exit_code": 0})
        return 0
    steps, least = len(path.poses) - 1, path.clearances.min()
    console.say(f"{path.length:.2f} m in {steps} steps, never nearer than {least:.2f} m to a wall")
    if (leaving := _leaving(path, args.radius)) > 0.0:
        where = "in unknown space, or nearer to a wall than the radius"
        console.say(f"warning: the start is {where}; the first {leaving:.2f} m leave it")
    console.say(f"files: {table} {picture}")
    return 0


def _read(folder: str) -> "tuple[OccupancyGrid, tuple[StoredAnchor, ...]]":
    """Return the grid of a result or of a map.yaml, and the anchors where they are known."""
    from ..errors import ConfigError
    from ..io.map_server import read_map
    from ..io.stored_result import read_result
    from . import console

    if not os.path.isdir(folder):
        warnings = list[str]()
        grid = read_map(folder, warnings)
        for warning in warnings:
            console.note(f"uwblite: {folder}: {warning}")
        return grid, ()
    result = read_result(folder)
    if result.grid is None:
        raise ConfigError(f"{folder} has no map.yaml: without a map there is no free space to plan in")
    return result.grid, result.anchors


def _leaving(path: "PlannedPath", radius: float) -> float:
    """Return the length of the way at the beginning that keeps no clearance, m."""
    kept = path.clearances >= radius
    return float(path.distances[kept.argmax() if kept.any() else -1])


def _table(path: "PlannedPath") -> str:
    """Return the path as CSV; m, m, rad, m from the start, m from the nearest obstacle."""
    rows = zip(path.poses.tolist(), path.distances.tolist(), path.clearances.tolist(), strict=True)
    lines = [f"{x:.4f},{y:.4f},{theta:.4f},{far:.4f},{clear:.3f}" for (x, y, theta), far, clear in rows]
    return "\n".join(["x,y,theta,distance,clearance", *lines]) + "\n"


def _figures(args: argparse.Namespace, path: "PlannedPath") -> dict[str, Any]:
    return {
        "map": args.map,
        "radius": args.radius,
        "length": path.length,
        "cost": path.cost,
        "least_clearance": path.clearances.min(),
        "leaving": _leaving(path, args.radius),
        "poses": path.poses,
    }
