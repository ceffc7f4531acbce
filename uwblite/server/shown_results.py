"""A result as the page shows it: figures, path, anchors and closures, ready for JSON."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..constraints import Constraints
from ..io.map_server import trinary_image
from ..io.png import encode_png
from ..io.result_text import settings_line
from ..io.stored_result import StoredResult
from ..report.svg_map import free_sides
from .advice import text_of
from .drawing import NAME_HEIGHT
from .edits import wish_for

_MOST_POINTS = 3000
"""Of a path."""
_MARGIN = 0.5
"""m around a map."""
_MOST_CLOSURES = 3000
"""Accepted ones come first."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownResult:
    """A result on the page."""

    name: str
    result: StoredResult
    grid_png: bytes | None
    """The map as a grey picture, largest y on top."""
    sides: tuple[str, ...]
    """Of its anchors: where their names cover no walls."""


def shown_result(result: StoredResult) -> ShownResult:
    """Return a result as the page needs it."""
    grid = None if result.grid is None else encode_png(trinary_image(result.grid))
    places = [a.position for a in result.anchors if np.isfinite(a.position).all()]
    corners = [] if result.grid is None else [result.grid.geometry.origin, result.grid.geometry.corner]
    points = np.array([*places, *corners, *([] if places or corners else [np.zeros(2)])])
    frame = np.stack([points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN])
    sides = free_sides([(a.id, a.position) for a in result.anchors], result.grid, frame, (NAME_HEIGHT,))
    return ShownResult(os.path.basename(os.path.abspath(result.folder)), result, grid, tuple(sides))


def described(shown: ShownResult, edits: Constraints) -> dict[str, Any]:
    """Return everything that the page shows of a result; lengths in metres, map frame."""
    result, report = shown.result, shown.result.report
    pinned = {a.id: a for a in edits.anchors}
    order = sorted(range(len(result.closures)), key=lambda k: not result.closures[k].accepted)[:_MOST_CLOSURES]
    return {
        "name": shown.name,
        "doubts": [text_of(d) for d in report.get("doubts") or ()],
        "warnings": [text_of(w) for w in report.get("warnings") or ()],
        "recordings": [os.path.basename(str(i.get("source", ""))) for i in report.get("inputs") or ()],
        "settings": settings_line(report.get("preset") or "", report.get("changed_settings") or ()),
        "accepted": sum(c.accepted for c in result.closures),
        "candidates": len(result.closures),
        "seconds": (report.get("timings") or {}).get("total"),
        "image": _image(result),
        "paths": [_thinned(poses) for _, poses in result.trajectories],
        "anchors": [
            {
                "id": a.id,
                "place": [float(v) for v in a.position] if np.isfinite(a.position).all() else None,
                "sigma": [float(v) for v in np.sqrt(np.diag(a.covariance))] if np.isfinite(a.covariance).all() else None,
                "side": side,
                "status": a.status,
                "pinned": list(pinned[a.id].position) if a.id in pinned else None,
            }
            for a, side in zip(result.anchors, shown.sides, strict=True)
        ],
        "closures": [
            {
                "number": k,
                "stamps": list(result.closures[k].stamps),
                "recordings": list(result.closures[k].recordings),
                "places": result.closures[k].places.tolist(),
                "accepted": result.closures[k].accepted,
                "reason": result.closures[k].reason,
                "wish": wish_for(edits, result.closures[k]),
            }
            for k in order
        ],
    }


def _image(result: StoredResult) -> dict[str, float] | None:
    if result.grid is None:
        return None
    g = result.grid.geometry
    x, y = g.origin.tolist()
    return {"x": x, "y": y, "width": g.cols * g.resolution, "height": g.rows * g.resolution}


def _thinned(poses: np.ndarray[Any, Any]) -> list[list[float]]:
    step = max(-(-len(poses) // _MOST_POINTS), 1)
    return [[round(x, 3), round(y, 3)] for x, y in poses[::step, :2].tolist()]
