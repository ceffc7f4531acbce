"""A map's result as one HTML page: no network, no plotting library, the same bytes for the same result.

Everything that comes from a log (names of files and anchors, reasons) is escaped, the page's policy forbids anything
from elsewhere, and its script reads only the page itself.
"""

import base64
from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .map_result import AnchorEstimate, LoopClosure, MapResult
from .report_page import PAGE, SCRIPT, STYLE

Floats = NDArray[np.float64]

MOST_POINTS = 4000
"""Points of one line drawn at most."""
MOST_RESIDUALS = 1500
"""Residuals of one anchor drawn at most."""
MOST_CLOSURES = 1500
"""Rejected closures drawn and listed at most; accepted ones all are."""
NLOS_BELOW = 0.5
"""Ranges of less weight are marked as outliers or blocked sight."""


def render(
    result: MapResult,
    *,
    title: str,
    command: str,
    facts: tuple[tuple[str, str], ...] = (),
    grid_png: bytes | None = None,
    timings: bool = False,
) -> str:
    """Return the page.

    Parameters
    ----------
    result : the map.
    title : name of the recording.
    command : command line that makes the same map again.
    facts : (name, value) pairs for the head of the page: input hash, version, settings.
    grid_png : picture of the bare grid, one pixel a cell, highest y first.
    timings : whether to show the seconds of each stage; the page then differs from run to run.
    """
    sections = (
        _banner(result),
        _section("Map", _map(result, grid_png)),
        _section("Anchors", _anchor_table(result.anchors)),
        _section("Range residuals", _residuals(result)) if len(result.range_table.get("stamp", ())) else "",
        _section("Calibration", _calibration_table(result)),
        _section("Loop closures", _closure_table(result)),
        _section("Stages", _stage_table(result, timings)),
        _section("Again", f"<p>The exact command that makes this map again:</p><pre>{escape(command)}</pre>"),
    )
    table = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    body = f"<h1>{escape(title)}</h1><div class=scroll><table class=facts>{table}</table></div>" + "".join(sections)
    return PAGE.format(title=escape(title), style=STYLE, script=SCRIPT, body=body)


def _section(title: str, content: str) -> str:
    return f'<section id="{title.lower().replace(" ", "-")}"><h2>{title}</h2>{content}</section>'


def _banner(result: MapResult) -> str:
    parts = []
    if result.doubts:
        items = "".join(f"<li>{escape(text)}</li>" for text in result.doubts)
        parts.append(
            f'<div class="box bad" role=alert><b>Do not trust this map before these are settled:</b><ul>{items}</ul></div>'
        )
    if result.warnings:
        items = "".join(f"<li>{escape(text)}</li>" for text in result.warnings)
        parts.append(f'<div class="box warn"><b>Worth knowing:</b><ul>{items}</ul></div>')
    if not parts:
        parts.append('<div class="box good">No warnings.</div>')
    return f'<section id="warnings">{"".join(parts)}</section>'


def _number(value: float, digits: int = 3, sign: bool = False) -> str:
    return f"{value:{'+' if sign else ''}.{digits}f}".replace("-", "\u2212") if np.isfinite(value) else "\u2013"


def _thin(n: int, most: int) -> NDArray[np.int64]:
    """Return at most about `most` of n indices, evenly spread, the last included."""
    return np.unique(np.append(np.arange(0, n, max(1, -(-n // most))), n - 1)) if n else np.zeros(0, dtype=np.int64)


def _coordinates(points: Floats, digits: int = 3) -> str:
    """Return points (n, 2) as SVG coordinates, y upwards turned into y downwards."""
    return " ".join(f"{x:.{digits}f},{-y:.{digits}f}" for x, y in points.tolist())


def _extent(result: MapResult) -> tuple[float, float, float, float]:
    """Return the box of everything drawn: x, y (downwards) of the corner, width, height, m."""
    parts = [result.trajectory[:, :2], result.graph.poses[:, :2]]
    parts += [np.asarray(a.position)[None] for a in result.anchors]
    if result.grid is not None:
        geometry = result.grid.geometry
        parts.append(np.stack([geometry.origin, geometry.corner]))
    points = np.concatenate(parts)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * float(np.max(high - low)) + 0.5
    return (
        float(low[0]) - margin,
        -float(high[1]) - margin,
        float(high[0] - low[0]) + 2 * margin,
        float(high[1] - low[1]) + 2 * margin,
    )


def _map(result: MapResult, grid_png: bytes | None) -> str:
    x, y, width, height = _extent(result)
    size = max(width, height)
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
    parts.append('<g class="trajectory">')
    for session in np.unique(result.session):
        path = result.trajectory[result.session == session, :2]
        parts.append(f'<polyline class="s{int(session) % 6}" points="{_coordinates(path[_thin(len(path), MOST_POINTS)])}"/>')
    start = result.trajectory[0]
    parts.append(
        f'<circle class="start" cx="{start[0]:.3f}" cy="{-start[1]:.3f}" r="{size / 150:.3f}"><title>start</title></circle></g>'
    )
    parts.append('<g class="anchors">' + "".join(_anchor_mark(a, size) for a in result.anchors) + "</g>")
    bar = _scale_length(size)
    svg = (
        f'<svg id="map-view" viewBox="{x:.3f} {y:.3f} {width:.3f} {height:.3f}" role="img" aria-label="map"'
        f' style="--s:{size / 900:.6f};aspect-ratio:{width:.3f}/{height:.3f}">{"".join(parts)}'
        f'<g class="bar"><path d="M{x + size / 40:.3f} {y + height - size / 40:.3f}h{bar:g}"/>'
        f'<text x="{x + size / 40:.3f}" y="{y + height - size / 25:.3f}">{bar:g} m</text></g></svg>'
    )
    layers = (("grid", "map"), ("trajectory", "trajectory"), ("anchors", "anchors, 2\u03c3"), ("kept", "closures kept"))
    boxes = "".join(f'<label><input type=checkbox checked data-layer="{k}"> {escape(v)}</label>' for k, v in layers)
    boxes += '<label><input type=checkbox data-layer="rejected"> closures rejected</label>'
    buttons = '<button id="zoom-in" aria-label="zoom in">+</button><button id="zoom-out" aria-label="zoom out">\u2212</button>'
    hint = "<p class=hint>Wheel or pinch zooms, dragging moves, point at things for details.</p>"
    return f'<div class=controls>{boxes}{buttons}<button id="zoom-all">all</button></div><div class=mapbox>{svg}</div>{hint}'


def _scale_length(size: float) -> float:
    """Return a round length of about a fifth of the size, m."""
    power = 10.0 ** np.floor(np.log10(size / 5.0))
    return float(max(k * power for k in (1.0, 2.0, 5.0) if k * power <= size / 5.0))


def _anchor_mark(anchor: AnchorEstimate, size: float) -> str:
    if not np.isfinite(anchor.position).all():
        return ""
    cx, cy = float(anchor.position[0]), -float(anchor.position[1])
    label = (
        f"anchor {anchor.id}: x {_number(anchor.position[0], 2)} \u00b1{_sigma(anchor, 0):.2f} m, "
        f"y {_number(anchor.position[1], 2)} \u00b1{_sigma(anchor, 1):.2f} m, {anchor.status} {anchor.reason}"
    )
    r = size / 110
    state = "ok" if anchor.status == "ok" else "doubt"
    mark = (
        f'<g class="anchor {state}"><title>{escape(label.strip())}</title>{_ellipse(anchor, cx, cy)}'
        f'<g transform="translate({cx:.3f} {cy:.3f})"><path d="M0-9L8 5H-8z"/><text>{escape(anchor.id)}</text></g>'
    )
    if anchor.alternative is not None and np.isfinite(anchor.alternative).all():
        mark += f'<circle class="mirror" cx="{anchor.alternative[0]:.3f}" cy="{-anchor.alternative[1]:.3f}" r="{r:.3f}"/>'
    return mark + "</g>"


def _sigma(anchor: AnchorEstimate, axis: int) -> float:
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


def _shown_closures(result: MapResult) -> tuple[list[LoopClosure], list[LoopClosure]]:
    kept = [c for c in result.closures if c.accepted]
    rejected = [c for c in result.closures if not c.accepted]
    return kept, [rejected[k] for k in _thin(len(rejected), MOST_CLOSURES)]


def _closure_lines(result: MapResult) -> str:
    groups = []
    for name, closures in zip(("kept", "rejected"), _shown_closures(result), strict=True):
        lines = []
        for c in closures:
            (x1, y1), (x2, y2) = result.graph.poses[c.i, :2].tolist(), result.graph.poses[c.j, :2].tolist()
            label = f"{c.i}\u2013{c.j}: {c.reason} (fitness {c.fitness:.3f} m, overlap {100 * c.overlap:.0f} %)"
            lines.append(f'<path d="M{x1:.3f} {-y1:.3f}L{x2:.3f} {-y2:.3f}"><title>{escape(label)}</title></path>')
        hidden = " hidden" if name == "rejected" else ""
        groups.append(f'<g class="closure {name}{hidden}">{"".join(lines)}</g>')
    return "".join(groups)


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]], empty: str) -> str:
    if not rows:
        return f"<p>{escape(empty)}</p>"
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"


def _anchor_table(anchors: tuple[AnchorEstimate, ...]) -> str:
    head = (
        "anchor",
        "x, m",
        "\u00b1",
        "y, m",
        "\u00b1",
        "bias, m",
        "\u00b1",
        "ranges",
        "down-weighted",
        "residual rms, m",
        "status",
    )
    rows = [
        (
            a.id,
            _number(a.position[0]),
            _number(_sigma(a, 0)),
            _number(a.position[1]),
            _number(_sigma(a, 1)),
            _number(a.bias, sign=True),
            _number(a.bias_sigma),
            str(a.ranges),
            f"{100 * (1 - a.used_share):.0f} %" if np.isfinite(a.used_share) else "\u2013",
            _number(a.residual_rms),
            f"{a.status}: {a.reason}" if a.reason else a.status,
        )
        for a in anchors
    ]
    return _table(head, rows, "The recording has no anchors.")


def _calibration_table(result: MapResult) -> str:
    head = ("name", "value", "\u00b1", "unit", "meaning", "state")
    rows = [
        (
            c.name,
            _number(c.value, 4, True),
            _number(c.sigma, 4),
            c.unit,
            c.meaning,
            f"{c.state}: {c.reason}" if c.reason else c.state,
        )
        for c in result.calibration
    ]
    return _table(head, rows, "Nothing was calibrated.")


def _closure_table(result: MapResult) -> str:
    kept, rejected = _shown_closures(result)
    count = sum(c.accepted for c in result.closures)
    reasons = Counter(c.reason for c in result.closures if not c.accepted)
    text = f"<p>{count} of {len(result.closures)} candidates kept.</p>" if result.closures else ""
    if reasons:
        text += _table(("rejected because", "candidates"), [(why, str(n)) for why, n in reasons.most_common(30)], "")
    rows = [
        (f"{c.i}\u2013{c.j}", "kept" if c.accepted else "rejected", f"{c.fitness:.3f}", f"{100 * c.overlap:.0f} %", c.reason)
        for c in [*kept, *rejected]
    ]
    listing = _table(("keyframes", "", "fitness, m", "overlap", "why"), rows, "No loop closure was looked for or found.")
    return text + (f"<details><summary>All of them</summary>{listing}</details>" if rows else listing)


def _stage_table(result: MapResult, timings: bool) -> str:
    head = ("stage", "\u03c7\u00b2", "degrees of freedom", "\u03c7\u00b2 / dof", *(("seconds",) if timings else ()), "figures")
    rows = []
    for stage in result.stages:
        chi2, dof = stage.figures.get("chi2"), stage.figures.get("dof")
        ratio = _number(chi2 / dof) if chi2 is not None and dof else ""
        others = ", ".join(f"{k} {_figure(v)}" for k, v in stage.figures.items() if k not in ("chi2", "dof"))
        time = (f"{stage.seconds:.2f}",) if timings else ()
        rows.append((stage.name, "" if chi2 is None else f"{chi2:.1f}", "" if dof is None else str(dof), ratio, *time, others))
    hint = "" if timings else "<p class=hint>The timings of each stage stand in report.json, beside this page.</p>"
    return _table(head, rows, "") + hint


def _figure(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return "(" + ", ".join(f"{k} {_figure(v)}" for k, v in value.items()) + ")"
    if isinstance(value, list | tuple):
        return f"{len(value)} values" if len(value) > 6 else ", ".join(map(_figure, value))
    return str(value)


def _residuals(result: MapResult) -> str:
    table = {name: np.asarray(values) for name, values in result.range_table.items()}
    start, end = float(table["stamp"].min()), float(table["stamp"].max())
    parts = [
        "<p class=hint>Expected minus measured range over time; <span class=nlos-text>marked</span>: down-weighted (NLOS?).</p>"
    ]
    for index, anchor in enumerate(result.anchors):
        mine = np.flatnonzero(table["anchor"] == index)
        mine = mine[np.isfinite(table["residual"][mine])]
        if len(mine):
            parts.append(
                _residual_plot(anchor.id, table, mine[_thin(len(mine), MOST_RESIDUALS)], start, max(end - start, 1e-9))
            )
    return "".join(parts)


def _dots(x: Floats, y: Floats) -> str:
    return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _residual_plot(anchor_id: str, table: dict[str, Floats], which: NDArray[np.int64], start: float, span: float) -> str:
    residual, good = table["residual"][which], table["weight"][which] >= NLOS_BELOW
    inner = float(np.quantile(np.abs(residual[good]), 0.99)) if good.any() else 0.0
    limit = max(1.5 * inner, 0.1)
    x = 1000.0 * (table["stamp"][which] - start) / span
    y = 60.0 - 55.0 * np.clip(residual / limit, -1.0, 1.0)
    dots = "".join(
        f'<path class="{name}" d="{_dots(x[sel], y[sel])}"/>'
        for name, sel in (("los", good), ("nlos", ~good))
        if sel.any()
    )
    return (
        f"<figure><figcaption>{escape(anchor_id)} <span class=hint>\u00b1{limit:.2f} m, {span:.0f} s,"
        f" {100 * float(np.mean(~good)):.0f} % marked</span></figcaption>"
        f'<svg class="residuals" viewBox="0 0 1000 120" preserveAspectRatio="none" role="img"'
        f' aria-label="residuals of {escape(anchor_id)}">'
        f'<path class="axis" d="M0 60H1000"/>{dots}</svg></figure>'
    )
