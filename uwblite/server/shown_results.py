"""A result as the pages show it: head, anchors, closures and drawing, ready for JSON."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..constraints import Constraints
from ..io.map_server import trinary_image
from ..io.png import encode_png
from ..io.result_text import settings_line
from ..io.stored_result import StoredResult
from ..report.drawn_map import DrawnAnchor, DrawnClosure, DrawnMap, shown_closures
from ..report.svg_map import map_svg
from .advice import text_of
from .edits import wish_for


@dataclass(frozen=True, slots=True, eq=False)
class ShownResult:
    """A result on the page of `uwblite view`."""

    result: StoredResult
    grid_png: bytes | None
    """The map as a grey picture, largest y on top."""
    svg: str


def shown_result(result: StoredResult, image: str) -> ShownResult:
    """Return a result as the page needs it, whose grid's picture has this address."""
    png = grid_png(result)
    return ShownResult(result, png, map_svg(drawn_result(result), image))


def grid_png(result: StoredResult) -> bytes | None:
    """Return the picture of the bare grid, one pixel a cell, largest y on top; None = there is no grid."""
    return None if result.grid is None else encode_png(trinary_image(result.grid))


def drawn_result(result: StoredResult) -> DrawnMap:
    """Return what is drawn of a result that was read back."""
    anchors = [
        DrawnAnchor(a.id, a.position, a.covariance, "ok" if a.status == "ok" else "doubt", f"anchor {a.id}: {a.status}")
        for a in result.anchors
    ]
    closures = [DrawnClosure(c.places, c.accepted, c.reason) for c in result.closures]
    return DrawnMap(result.grid, [poses for _, poses in result.trajectories], anchors, closures)


def shown_head(result: StoredResult) -> dict[str, Any]:
    """Return a result's doubts, warnings and counts of closures."""
    return {
        "doubts": [text_of(d) for d in result.report.get("doubts") or ()],
        "warnings": [text_of(w) for w in result.report.get("warnings") or ()],
        "accepted": sum(c.accepted for c in result.closures),
        "candidates": len(result.closures),
    }


def shown_anchors(result: StoredResult) -> list[dict[str, Any]]:
    """Return a result's anchors in their order; m, map frame."""
    return [
        {
            "id": a.id,
            "status": a.status,
            "place": a.position.tolist() if np.isfinite(a.position).all() else None,
            "sigma": np.sqrt(np.diag(a.covariance)).tolist() if np.isfinite(a.covariance).all() else None,
        }
        for a in result.anchors
    ]


def described(shown: ShownResult, edits: Constraints) -> dict[str, Any]:
    """Return everything that the page of `uwblite view` shows of a result."""
    result, report = shown.result, shown.result.report
    pinned = {a.id: list(a.position) for a in edits.anchors}
    closures = [(k, result.closures[k]) for k in shown_closures(c.accepted for c in result.closures)]
    return shown_head(result) | {
        "name": os.path.basename(os.path.abspath(result.folder)),
        "recordings": [os.path.basename(str(i.get("source", ""))) for i in report.get("inputs") or ()],
        "settings": settings_line(report.get("preset") or "", report.get("changed_settings") or ()),
        "svg": shown.svg,
        "anchors": [anchor | {"pinned": pinned.get(anchor["id"])} for anchor in shown_anchors(result)],
        "closures": [
            {
                "number": k,
                "stamps": c.stamps,
                "recordings": c.recordings,
                "accepted": c.accepted,
                "reason": c.reason,
                "wish": wish_for(edits, c),
            }
            for k, c in closures
        ],
    }
