"""`uwblite plan-anchors`: where the next anchors help most."""

import argparse
from typing import Any

import numpy as np

from ..io.files import write_text
from ..io.png import write_png
from ..radio.anchor_planning import AnchorPlan, plan_anchors
from ..report.drawn_map import DrawnAnchor
from ..report.picture import draw_errors, side_by_side
from ..report.printable import signed
from . import console
from .inputs import begin_plan

_HEAD = "id,x,y,mean_error,error_95"
"""Of the table."""


def run(args: argparse.Namespace) -> int:
    table, picture, grid, anchors = begin_plan(args, _HEAD)
    placed = [DrawnAnchor(a.id, a.position) for a in anchors if np.isfinite(a.position).all() and not args.from_nothing]
    plan = plan_anchors(grid, np.array([a.position for a in placed]).reshape(-1, 2), args.count, reach=args.reach)
    figures = _figures(args, plan, len(placed))
    write_text(table, _table(figures))
    new = [DrawnAnchor(f"new{k}", place, kind="proposed") for k, place in enumerate(plan.places, 1)]
    about = "Expected error of a position"
    today = plan.errors[0], placed, f"{about}, {len(placed)} anchors"
    then = plan.errors[-1], [*placed, *new], f"{about}, {len(new)} more"
    write_png(picture, side_by_side([draw_errors(grid, plan.points, *panel) for panel in (today, then)]))
    lines = [f"{len(placed)} anchors today: {_errors(figures['today'])}"]
    lines += [f"{a['id']}: x {signed(a['x'])} m, y {signed(a['y'])} m: {_errors(a)}" for a in figures["anchors"]]
    console.report(args.json, figures | {"files": [table, picture]}, [*lines, f"files: {table} {picture}"])
    return 0


def _errors(figures: dict[str, Any]) -> str:
    mean, most = figures["mean_error"], figures["error_95"]
    return f"expected error of a position {mean:.2f} m, in 95 % of the free space below {most:.2f} m"


def _figures(args: argparse.Namespace, plan: AnchorPlan, today: int) -> dict[str, Any]:
    errors = [{"mean_error": float(e.mean()), "error_95": float(np.quantile(e, 0.95))} for e in plan.errors]
    places = [{"id": f"new{k}", "x": float(x), "y": float(y)} for k, (x, y) in enumerate(plan.places, 1)]
    return {
        "map": args.map,
        "reach": args.reach,
        "today": {"anchors": today, **errors[0]},
        "anchors": [place | error for place, error in zip(places, errors[1:], strict=True)],
    }


def _table(figures: dict[str, Any]) -> str:
    lines = [_HEAD]
    lines += [f"{a['id']},{a['x']:.3f},{a['y']:.3f},{a['mean_error']:.3f},{a['error_95']:.3f}" for a in figures["anchors"]]
    return "\n".join(lines) + "\n"
