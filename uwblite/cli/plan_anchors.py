"""`uwblite plan-anchors`: where the next anchors help most."""

import argparse
from typing import TYPE_CHECKING, Any

from .options import number
from .wording import signed

if TYPE_CHECKING:
    from ..io.stored_result import StoredResult
    from ..radio.anchor_planning import AnchorPlan

HELP = "say where further anchors help most, by the expected error of a position over the free space of a map"
EPILOG = """\
examples:
  uwblite plan-anchors --map map/ --count 2                 -> anchor_plan.csv and anchor_plan.png
  uwblite plan-anchors --map map/ --count 1 --reach 12      the radios reach 12 m
  uwblite plan-anchors --map map/ --count 3 --from-nothing  as if there were no anchors yet

The error at a place is that of a position from one range to each anchor within reach: 0.1 m of noise in line of sight, 0.5 m
through walls. Anchors are put half a metre from walls; where that cannot be done, the picture shows what is nearly as good.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--map", metavar="DIR", required=True, help="folder that uwblite map wrote: map.yaml, anchors.csv")
    parser.add_argument("--count", metavar="N", type=number(above=0, whole=True), default=1, help="how many anchors (1)")
    parser.add_argument("--reach", metavar="M", type=number(above=0), default=25.0, help="m up to which a radio reaches (25)")
    parser.add_argument("--from-nothing", action="store_true", help="leave out the anchors that are there")
    parser.add_argument("--out", metavar="NAME", default="anchor_plan", help="NAME.csv and NAME.png are written (anchor_plan)")
    parser.add_argument("--force", action="store_true", help="replace files that are already there")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    import numpy as np

    from ..errors import ConfigError
    from ..io.files import write_text
    from ..io.png import write_png
    from ..io.stored_result import read_result
    from ..radio.anchor_planning import plan_anchors
    from . import console
    from .formats import refuse_existing

    table, picture = f"{args.out}.csv", f"{args.out}.png"
    refuse_existing(args.force, table, picture)
    result = read_result(args.map)
    if result.grid is None:
        raise ConfigError(f"{args.map} has no map.yaml: without a map there is no free space to plan for")
    placed = [a.position for a in result.anchors if np.isfinite(a.position).all() and not args.from_nothing]
    plan = plan_anchors(result.grid, np.array(placed).reshape(-1, 2), args.count, reach=args.reach)
    figures = _figures(args, plan, len(placed))
    write_text(table, _table(figures))
    write_png(picture, _picture(result, plan, args.from_nothing))
    if args.json:
        console.say_json({**figures, "files": [table, picture]})
        return 0
    console.say(f"{len(placed)} anchors today: {_errors(figures['today'])}")
    for new in figures["anchors"]:
        console.say(f"{new['id']}: x {signed(new['x'])} m, y {signed(new['y'])} m: {_errors(new)}")
    console.say(f"files: {table} {picture}")
    return 0


def _errors(figures: dict[str, Any]) -> str:
    mean, most = figures["mean_error"], figures["error_95"]
    return f"expected error of a position {mean:.2f} m, in 95 % of the free space below {most:.2f} m"


def _figures(args: argparse.Namespace, plan: "AnchorPlan", today: int) -> dict[str, Any]:
    import numpy as np

    errors = [{"mean_error": float(e.mean()), "error_95": float(np.quantile(e, 0.95))} for e in plan.errors]
    places = [{"id": f"new{k}", "x": float(x), "y": float(y)} for k, (x, y) in enumerate(plan.places, 1)]
    return {
        "map": args.map,
        "reach": args.reach,
        "today": {"anchors": today, **errors[0]},
        "anchors": [place | error for place, error in zip(places, errors[1:], strict=True)],
    }


def _table(figures: dict[str, Any]) -> str:
    """Return the places as CSV; lengths in metres; errors with this anchor and those before it."""
    lines = ["id,x,y,mean_error,error_95"]
    lines += [f"{a['id']},{a['x']:.3f},{a['y']:.3f},{a['mean_error']:.3f},{a['error_95']:.3f}" for a in figures["anchors"]]
    return "\n".join(lines) + "\n"


def _picture(result: "StoredResult", plan: "AnchorPlan", from_nothing: bool) -> Any:
    """Return the map today and with the new anchors, side by side, coloured by the expected error."""
    from ..report.error_map import draw_errors, side_by_side
    from ..report.picture import PictureAnchor

    assert result.grid is not None
    there = [] if from_nothing else [PictureAnchor(a.id, a.position) for a in result.anchors]
    new = [PictureAnchor(f"new{k}", place, proposed=True) for k, place in enumerate(plan.places, 1)]
    about = "Expected error of a position"
    shown = [
        (plan.errors[0], there, f"{about}, {len(there)} anchors"),
        (plan.errors[-1], [*there, *new], f"{about}, {len(new)} more"),
    ]
    return side_by_side([draw_errors(result.grid, plan.points, *panel) for panel in shown])
