"""`uwblite plan`: a path through a map."""

import argparse
from typing import Any

import numpy as np

from ..io.files import write_text
from ..io.png import write_png
from ..navigation.planner import NoPathError, PlannedPath, make_planner
from ..report.drawn_map import DrawnAnchor, DrawnMap
from ..report.picture import draw_map
from . import console
from .inputs import begin_plan

_HEAD = "x,y,theta,distance,clearance"
"""Of the table."""
_ROW = "%.4f,%.4f,%.4f,%.4f,%.3f"
"""As text three times as fast as an f-string: a long path has 200,000 rows."""


def run(args: argparse.Namespace) -> int:
    table, picture, grid, anchors = begin_plan(args, _HEAD)
    try:
        places = [np.array(p) for p in (args.start, *args.via, args.goal)]
        path = make_planner(grid, args.radius, unknown=args.unknown).plan(places[0], places[1:], step=args.step)
    except NoPathError as error:
        if args.json:
            console.say_json({"error": str(error), "nearest": error.nearest, "exit_code": 1})
        raise
    write_text(table, _table(path))
    corners = np.union1d(np.flatnonzero(np.diff(path.poses[:, 2], prepend=np.nan)), len(path.poses) - 1)
    drawn = DrawnMap(grid, [path.poses[corners]], [DrawnAnchor(a.id, a.position) for a in anchors])
    write_png(picture, draw_map(drawn, caption=f"{path.length:.2f} m, radius {args.radius:g} m"))
    lines = [f"{path.length:.2f} m in {len(path.poses) - 1} steps, never nearer than {path.clearances.min():.2f} m to a wall"]
    if (leaving := _leaving(path, args.radius)) > 0.0:
        where = "in unknown space, or nearer to a wall than the radius"
        lines.append(f"warning: the start is {where}; the first {leaving:.2f} m leave it")
    figures = _figures(args, path) | {"files": [table, picture], "exit_code": 0}
    console.report(args.json, figures, [*lines, f"files: {table} {picture}"])
    return 0


def _leaving(path: PlannedPath, radius: float) -> float:
    """Return the length of the way at the beginning that keeps no clearance, m."""
    kept = path.clearances >= radius
    return float(path.distances[kept.argmax() if kept.any() else -1])


def _table(path: PlannedPath) -> str:
    rows = np.column_stack([path.poses, path.distances, path.clearances]).tolist()
    return "\n".join([_HEAD, *(_ROW % tuple(row) for row in rows)]) + "\n"


def _figures(args: argparse.Namespace, path: PlannedPath) -> dict[str, Any]:
    return {
        "map": args.map,
        "radius": args.radius,
        "length": path.length,
        "cost": path.cost,
        "least_clearance": path.clearances.min(),
        "leaving": _leaving(path, args.radius),
        "poses": path.poses,
    }
