"""A map as SVG, for the report and the local pages: the size of marks and names follows the custom property --s."""

import math

import numpy as np

from ..arrays import Floats
from .canvas import PATHS
from .drawn_map import DrawnAnchor, DrawnMap, ellipse, free_sides, shown_closures, thin
from .printable import escape

_MOST_POINTS = 4000
"""Points of one line drawn at most."""
DESK, _PHONE = 900, 360
"""Pixels of a map's longer side, about."""
_TEXT = 14
"""Pixels of a name."""
_BAR, _BELOW = 1 / 5, 1 / 40
"""Longest length of the scale bar, and its distance from the corner, as shares of the map's longer side."""


def map_svg(drawn: DrawnMap, image: str) -> str:
    """Return the map as SVG markup, with the style of `page`.

    `image` is the address of the picture of the bare grid, one pixel a cell, highest y first; "" = none.
    """
    box = drawn.box()
    (left, _), (width, height) = box[0].tolist(), np.ptp(box, axis=0).tolist()
    top, size = -float(box[1, 1]), max(width, height)
    parts = [_image(drawn, image)] if image and drawn.grid is not None else []
    parts += ["".join(_closures(drawn)), '<g class="trajectory">']
    lines = [(f"path path{k % len(PATHS)}", path) for k, path in enumerate(drawn.paths)]
    lines += [("doubted", path) for path in drawn.doubted]
    parts += [f'<polyline class="{name}" points="{_points(p[thin(len(p), _MOST_POINTS)])}"/>' for name, p in lines]
    for k, path in enumerate(drawn.paths):
        for name, place in (("start", path[:1]), ("end", path[-1:])):
            mark = f'<circle class="{name} path{k % len(PATHS)}"'
            parts += [f'{mark} {_at(p, "cx", "cy")}><title>{name}</title></circle>' for p in place]
    sides = free_sides(drawn, box, (_TEXT / _PHONE, _TEXT / DESK))
    marks = "".join(_anchor(k, anchor, sides[k]) for k, anchor in enumerate(drawn.anchors))
    bar, x, y = round_length(_BAR * size), left + _BELOW * size, top + height - _BELOW * size
    scale_bar = f'<path d="M0 0h{bar:g}"/><text dy="-.4em">{bar:g} m</text>'
    return (
        f'<svg class="map" viewBox="{left:.3f} {top:.3f} {width:.3f} {height:.3f}" role="img" aria-label="map"'
        f' style="--s:{size / DESK:.6f};aspect-ratio:{width:.3f}/{height:.3f}">{"".join(parts)}</g>'
        f'<g class="anchors">{marks}</g>'
        f'<g class="bar" transform="translate({x:.3f} {y:.3f})">{scale_bar}</g></svg>'
    )


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not longer, m."""
    power = 10.0 ** math.floor(math.log10(longest))
    return float(max(f * power for f in (1.0, 2.0, 5.0) if f * power <= longest))


def _image(drawn: DrawnMap, address: str) -> str:
    assert drawn.grid is not None
    low, high = drawn.grid.geometry.origin, drawn.grid.geometry.corner
    width, height = (high - low).tolist()
    place = f'{_at(np.array([low[0], high[1]]), "x", "y")} width="{width:.4f}" height="{height:.4f}"'
    return f'<image class="grid" {place} preserveAspectRatio="none" href="{address}"/>'


def _at(place: Floats, x: str, y: str) -> str:
    """Return a place (2,) as two attributes, y turned downwards."""
    return f'{x}="{place[0]:.4f}" {y}="{-place[1]:.4f}"'


def _points(points: Floats) -> str:
    """Return points (n, 2) as SVG has them, y turned downwards."""
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in points[:, :2].tolist())


def _closures(drawn: DrawnMap) -> list[str]:
    shown = [(k, drawn.closures[k]) for k in shown_closures(c.accepted for c in drawn.closures)]
    groups = []
    for name, accepted in (("kept", True), ("rejected hidden", False)):
        lines = [
            f'<polyline data-closure="{k}" points="{_points(c.ends)}"><title>{escape(c.text)}</title></polyline>'
            for k, c in shown
            if c.accepted is accepted
        ]
        groups.append(f'<g class="closure {name}">{"".join(lines)}</g>')
    return groups


def _anchor(number: int, anchor: DrawnAnchor, side: str) -> str:
    """Return triangle, name, ellipse of two standard deviations and mirror image of an anchor that has a place."""
    if not np.isfinite(anchor.position).all():
        return ""
    (x, y), name = anchor.position.tolist(), escape(anchor.id)
    parts = [f'<g class="anchor {anchor.kind}" data-anchor="{number}"><title>{escape(anchor.text)}</title>']
    if (axes := ellipse(anchor.covariance)) is not None:
        turn = f"translate({x:.3f} {-y:.3f}) rotate({-math.degrees(axes[2]):.2f})"
        parts.append(f'<ellipse rx="{axes[0]:.4f}" ry="{axes[1]:.4f}" transform="{turn}"/>')
    if anchor.alternative is not None and np.isfinite(anchor.alternative).all():
        parts.append(f'<circle class="mirror" {_at(anchor.alternative, "cx", "cy")}/>')
    mark = f'<path d="M0-9L8 5H-8z"/><text class="{side}">{name}</text>'
    return "".join([*parts, f'<g transform="translate({x:.3f} {-y:.3f})">{mark}</g></g>'])
