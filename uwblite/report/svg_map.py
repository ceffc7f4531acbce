"""The zoomable map of the HTML report: an SVG with path, anchors and closures over the picture of the grid."""

import base64
from collections.abc import Sequence
from html import escape

import numpy as np

from ..arrays import Floats, Ints
from ..grid.occupancy_grid import OccupancyGrid
from ..map_result import AnchorEstimate, LoopClosure, MapResult
from .picture import round_length
from .printable import sigma_text

MOST_POINTS = 4000
"""Points of one line drawn at most."""
_NAME = 0.12
"""Room to the right of an anchor for its name, as a share of the map's size on a phone."""
_HEIGHTS = 14.0 / 360.0, 14.0 / 900.0
"""Height of a name on a phone and on a desk, as a share of the map's longer side."""
_LETTER = 0.7
"""Width of a letter, in heights of a line, as the next ones."""
_SIDES = {"right": (0.75, 0.3), "left": (-0.75, 0.3), "below": (0.0, 1.6), "above": (0.0, -0.85)}
"""Where a name stands beside its anchor, in this order, and the foot of its line, y downwards."""
MOST_CLOSURES = 1500
"""Rejected closures drawn and listed at most; accepted ones all are."""


def number(value: float, digits: int = 3, sign: bool = False) -> str:
    """Return a number with a true minus sign; a dash where it is not finite."""
    if not np.isfinite(value):
        return "\u2013"
    # What rounds to zero has no sign.
    return f"{round(value, digits) + 0.0:{'+' if sign else ''}.{digits}f}".replace("-", "\u2212")


def thin(n: int, most: int) -> Ints:
    """Return at most about `most` of n indices, evenly spread, the last included."""
    return np.unique(np.append(np.arange(0, n, max(1, -(-n // most))), n - 1)) if n else np.zeros(0, dtype=np.intp)


def _coordinates(points: Floats) -> str:
    """Return points (n, 2) as SVG coordinates, y upwards turned into y downwards."""
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in points.tolist())


def _extent(result: MapResult) -> tuple[float, float, float, float]:
    """Return the box of everything drawn: x, y (downwards) of the corner, width, height, m."""
    places = np.array([a.position for a in result.anchors]).reshape(-1, 2)
    parts = [result.trajectory[:, :2], result.graph.poses[:, :2], places]
    if result.grid is not None:
        parts.append(np.stack([result.grid.geometry.origin, result.grid.geometry.corner]))
    points = np.concatenate(parts)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    size = float(np.max(high - low))
    high[0] = max([high[0], *(places[np.isfinite(places).all(axis=1), 0] + _NAME * size)])
    margin = 0.03 * size + 0.5
    (x, y), (width, height) = (low - margin).tolist(), (high - low + 2 * margin).tolist()
    return x, -(y + height), width, height


def draw(result: MapResult, grid_png: bytes | None) -> str:
    """Return the map with its switches and buttons as HTML."""
    x, y, width, height = _extent(result)
    size = max(width, height)
    frame = np.array([[x, -y - height], [x + width, -y]])
    sides = free_sides([(a.id, a.position) for a in result.anchors], result.grid, frame, _HEIGHTS)
    marks = [_anchor_mark(a, size, side) for a, side in zip(result.anchors, sides, strict=True)]
    parts = []
    if grid_png is not None and result.grid is not None:
        geometry = result.grid.geometry
        corner, data = geometry.corner, base64.b64encode(grid_png).decode()
        parts.append(
            f'<image class="grid" x="{geometry.origin[0]:.4f}" y="{-corner[1]:.4f}" preserveAspectRatio="none"'
            f' width="{corner[0] - geometry.origin[0]:.4f}" height="{corner[1] - geometry.origin[1]:.4f}"'
            f' href="data:image/png;base64,{data}"/>'
        )
    parts.append(_closure_lines(result))
    recordings = np.unique(result.recording).tolist()
    paths = [(f"s{k % 4}", result.trajectory[result.recording == k, :2]) for k in recordings]
    paths += [("doubted", path) for path in result.doubted_paths()]
    lines = [f'<polyline class="{kind}" points="{_coordinates(p[thin(len(p), MOST_POINTS)])}"/>' for kind, p in paths]
    parts += ['<g class="trajectory">', *lines, *(_end_marks(result, recording, size) for recording in recordings), "</g>"]
    parts.append(f'<g class="anchors">{"".join(marks)}</g>')
    bar = round_length(size / 5.0)
    svg = (
        f'<svg id="map-view" viewBox="{x:.3f} {y:.3f} {width:.3f} {height:.3f}" role="img" aria-label="map"'
        f' style="--s:{size / 900:.6f};aspect-ratio:{width:.3f}/{height:.3f}">{"".join(parts)}'
        f'<g class="bar"><path d="M{x + size / 40:.3f} {y + height - size / 40:.3f}h{bar:g}"/>'
        f'<text x="{x + size / 40:.3f}" y="{y + height - size / 25:.3f}">{bar:g} m</text></g></svg>'
    )
    layers = (("grid", "map"), ("trajectory", "trajectory"), ("anchors", "anchors, 2\u03c3"), ("kept", "closures accepted"))
    boxes = "".join(_switch(name, text, True) for name, text in layers) + _switch("rejected", "closures rejected", False)
    names = (("zoom-in", "+", "zoom in"), ("zoom-out", "\u2212", "zoom out"), ("zoom-all", "all", "all of the map"))
    buttons = " ".join(f'<button id="{name}" aria-label="{label}">{text}</button>' for name, text, label in names)
    unclear = "orange triangle: an anchor that is not certain; " if any(a.status != "ok" for a in result.anchors) else ""
    unclear += "yellow: a stretch that is not to be trusted; " if result.doubted_stretches else ""
    words = f"Green: start; ring: end; {unclear}wheel or pinch zooms, dragging moves; point at things for details."
    keys = "".join(f'<i class="key path{r % 4}"></i> recording {r + 1} ' for r in recordings if len(recordings) > 1)
    hint = f'<p class=hint><output id="place"></output>{keys}{words}</p>'
    return f"<div class=mapbox>{svg}</div><div class=controls>{boxes}<span class=buttons>{buttons}</span></div>{hint}"


def _end_marks(result: MapResult, recording: int, size: float) -> str:
    """Return the disc where a recording starts and the ring where it ends."""
    places = result.trajectory[result.recording == recording][[0, -1], :2].tolist()
    kinds = (("start", "start"), (f"end s{recording % 4}", "end"))
    return "".join(
        f'<circle class="{kind}" cx="{x:.3f}" cy="{-y:.3f}" r="{size / 150:.3f}"><title>{title}</title></circle>'
        for (x, y), (kind, title) in zip(places, kinds, strict=True)
    )


def _switch(name: str, text: str, on: bool) -> str:
    """Return the switch of a layer of the map, with the colour it has there."""
    state = " checked" if on else ""
    return f'<label><input type=checkbox{state} data-layer="{name}"> <i class="key key-{name}"></i> {escape(text)}</label>'


def free_sides(
    names: Sequence[tuple[str, Floats]], grid: OccupancyGrid | None, frame: Floats, heights: Sequence[float]
) -> list[str]:
    """Return on which side of its mark each name covers the fewest walls, within the map where that is possible.

    Parameters
    ----------
    names : each with the place (2,) that it belongs to, m.
    frame : lower and upper corner of the map (2, 2), m.
    heights : of a line of text, as shares of the map's longer side; more than one where it is shown in several sizes.

    Returns
    -------
    "right", "left", "below" or "above", the first of those that are equally good.
    """
    walls, size = np.zeros((0, 2)) if grid is None else grid.occupied_points(), float(np.ptp(frame, axis=0).max())

    def cost(side: str, letters: int, place: Floats) -> tuple[int, int]:
        x, foot = _SIDES[side]
        left = {"right": x, "left": x - _LETTER * letters}.get(side, -0.5 * _LETTER * letters)
        box = np.array([[left, -foot], [left + _LETTER * letters, 1.0 - foot]])
        boxes = [place + box * size * height for height in heights]
        outside = sum(bool((b[0] < frame[0]).any() or (b[1] > frame[1]).any()) for b in boxes)
        return outside, sum(int(((walls >= b[0]) & (walls <= b[1])).all(axis=1).sum()) for b in boxes)

    costs = [{side: cost(side, len(name), place) for side in _SIDES} for name, place in names]
    return [min(each, key=each.__getitem__) for each in costs]


def _anchor_mark(anchor: AnchorEstimate, size: float, side: str) -> str:
    if not np.isfinite(anchor.position).all():
        return ""
    cx, cy = float(anchor.position[0]), -float(anchor.position[1])
    label = (
        f"anchor {anchor.id}: x {number(anchor.position[0], 2)} \u00b1{sigma_text(sigma(anchor, 0), 2)} m, "
        f"y {number(anchor.position[1], 2)} \u00b1{sigma_text(sigma(anchor, 1), 2)} m, {anchor.status} {anchor.reason}"
    )
    r = size / 110
    state = "ok" if anchor.status == "ok" else "doubt"
    mark = (
        f'<g class="anchor {state}"><title>{escape(label.strip())}</title>{_ellipse(anchor, cx, cy)}'
        f'<g transform="translate({cx:.3f} {cy:.3f})"><path d="M0-9L8 5H-8z"/>'
        f'<text class="{side}">{escape(anchor.id)}</text></g>'
    )
    if anchor.alternative is not None and np.isfinite(anchor.alternative).all():
        mark += f'<circle class="mirror" cx="{anchor.alternative[0]:.3f}" cy="{-anchor.alternative[1]:.3f}" r="{r:.3f}"/>'
    return mark + "</g>"


def sigma(anchor: AnchorEstimate, axis: int) -> float:
    """Return the standard deviation of an anchor along an axis, m."""
    return float(np.sqrt(max(anchor.covariance[axis, axis], 0.0)))


def _ellipse(anchor: AnchorEstimate, cx: float, cy: float) -> str:
    """Return the 2-sigma ellipse: half axes 2 sqrt(eigenvalue) along the eigenvectors, y turned downwards."""
    if not np.isfinite(anchor.covariance).all():
        return ""
    values, vectors = np.linalg.eigh(anchor.covariance)
    minor, major = 2.0 * np.sqrt(np.maximum(values, 0.0))
    angle = -float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    turn = f'transform="rotate({angle:.2f} {cx:.3f} {cy:.3f})"'
    return f'<ellipse cx="{cx:.3f}" cy="{cy:.3f}" rx="{major:.4f}" ry="{minor:.4f}" {turn}/>'


def shown_closures(result: MapResult) -> tuple[list[LoopClosure], list[LoopClosure]]:
    """Return all accepted closures and a sample of the rejected ones."""
    kept = [c for c in result.closures if c.accepted]
    rejected = [c for c in result.closures if not c.accepted]
    return kept, [rejected[k] for k in thin(len(rejected), MOST_CLOSURES)]


def _closure_lines(result: MapResult) -> str:
    groups = []
    for name, closures in zip(("kept", "rejected"), shown_closures(result), strict=True):
        lines = []
        for c in closures:
            (x1, y1), (x2, y2) = result.graph.poses[c.i, :2].tolist(), result.graph.poses[c.j, :2].tolist()
            label = f"{c.i}\u2013{c.j}: {c.reason} (fitness {c.fitness:.3f} m, overlap {100 * c.overlap:.0f} %)"
            lines.append(f'<path d="M{x1:.3f} {-y1:.3f}L{x2:.3f} {-y2:.3f}"><title>{escape(label)}</title></path>')
        hidden = " hidden" if name == "rejected" else ""
        groups.append(f'<g class="closure {name}{hidden}">{"".join(lines)}</g>')
    return "".join(groups)
