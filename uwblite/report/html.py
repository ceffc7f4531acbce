"""A map's result as one HTML page: no network, no plotting library, the same bytes for the same result.

Everything that comes from a log (names of files and anchors, reasons) is escaped, the page's policy forbids anything
from elsewhere, and its script reads only the page itself.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape as escape_markup

import numpy as np

from ..arrays import Floats, Ints
from ..findings import DOUBT, Finding, folded
from ..map_result import OUTCOMES, AnchorEstimate, CalibrationEstimate, MapResult
from .page import PAGE, SCRIPT, STYLE
from .printable import duration, printable, sigma_text
from .svg_map import draw, number, shown_closures, sigma, thin

MOST_RESIDUALS = 1500
"""Residuals of one anchor drawn at most."""


def escape(text: str) -> str:
    """Return text without markup and without what cannot be printed."""
    return escape_markup(printable(text))


@dataclass(frozen=True, slots=True)
class Heading:
    """What a page says of how its map was made."""

    title: str
    command: str
    """Command line that makes the same map again."""
    lead: str = ""
    """The result in a line, under the verdict."""
    facts: tuple[tuple[str, str], ...] = ()
    """(name, value): input hash, version, settings."""


def render(result: MapResult, heading: Heading, grid_png: bytes | None = None) -> str:
    """Return the page.

    Parameters
    ----------
    grid_png : picture of the bare grid, one pixel a cell, highest y first.
    """
    again = f"<p>{escape(_WHERE.format(heading.title))}</p><pre>{escape(heading.command)}</pre>"
    table = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in heading.facts)
    sections = (
        _banner(result, heading.lead),
        _section("Map", draw(result, grid_png)),
        _section("Anchors", _anchor_table(result.anchors)),
        _section("Range residuals", _residuals(result)) if len(result.range_table.get("stamp", ())) else "",
        _section("Calibration", _calibration_table(result)),
        _section("Loop closures", _closure_table(result)),
        _section("Stages", _stage_table(result)),
        _section("Again", f"<div class=scroll><table class=facts>{table}</table></div>{again}"),
    )
    body = f"<h1>{escape(heading.title)}</h1>" + "".join(sections)
    return PAGE.format(title=escape(heading.title), style=STYLE, script=SCRIPT, body=body)


_WHERE = "The command that makes this map again, byte for byte, in the folder of {}:"


def _section(title: str, content: str) -> str:
    return f'<section id="{title.lower().replace(" ", "-")}"><h2>{title}</h2>{content}</section>'


def _banner(result: MapResult, lead: str) -> str:
    groups = [(cause, rest, any(f.severity == DOUBT for f in (cause, *rest))) for cause, rest in folded(result.findings)]
    boxes = (
        ('"box bad" role=alert', "Do not trust this map before these are resolved:", True),
        ('"box warn"', "Worth knowing:", False),
    )
    items = (
        (kind, head, "".join(_item(cause, rest) for cause, rest, doubted in groups if doubted is bad))
        for kind, head, bad in boxes
    )
    text = "".join(f"<div class={kind}><b>{head}</b><ul>{listed}</ul></div>" for kind, head, listed in items if listed)
    text = text or '<div class="box good">No warnings.</div>'
    return f'<section id="warnings">{text}<p class=lead>{escape(lead)}</p></section>'


def _item(finding: Finding, explains: Sequence[Finding] = ()) -> str:
    """Return a finding as an item of a list: its text, what to do, commands as code, and what it explains."""
    cure = re.sub("`([^`]*)`", r"<code>\1</code>", escape(finding.cure))
    more = "".join(_item(other) for other in explains)
    more = f"<details><summary>explains {len(explains)} more</summary><ul>{more}</ul></details>" if more else ""
    return f"<li class={escape(finding.kind)}>{escape(finding.text)}{f'<br>{cure}' if cure else ''}{more}</li>"


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]], empty: str) -> str:
    """Return a table; on a phone a row of more than two columns is a block with a line for each."""
    if not rows:
        return f"<p>{escape(empty)}</p>"
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    kind, names = ("cards", head) if len(head) > 2 else ("", ("",) * len(head))
    body = "".join("<tr>" + "".join(map(_cell, row, names)) + "</tr>" for row in rows)
    return f'<div class=scroll><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str, name: str) -> str:
    """Return a cell of a table; one that holds a sentence may be wrapped, but not to a word a line."""
    words = " class=words" if len(text) > 20 and " " in text else ""
    named = f' data-name="{escape(name)}"' if name else ""
    return f"<td{words}{named}>{escape(text)}</td>"


def _with_sigma(value: float, sigma: float, digits: int = 3, sign: bool = False) -> str:
    return f"{number(value, digits, sign)} \u00b1{sigma_text(sigma, digits)}" if np.isfinite(value) else number(value)


def _anchor_table(anchors: tuple[AnchorEstimate, ...]) -> str:
    head = ("anchor", "status", "x, m", "y, m", "bias, m", "ranges", "disagree", "residual rms, m")
    rows = [
        (
            a.id,
            f"{a.status}: {a.reason}" if a.reason else a.status,
            _with_sigma(a.position[0], sigma(a, 0)),
            _with_sigma(a.position[1], sigma(a, 1)),
            _with_sigma(a.bias, a.bias_sigma, sign=True),
            str(a.ranges),
            f"{100 * (1 - a.used_share):.0f} %" if np.isfinite(a.used_share) else "\u2013",
            number(a.residual_rms),
        )
        for a in anchors
    ]
    return _table(head, rows, "The recording has no anchors.")


def _calibration_table(result: MapResult) -> str:
    """Return what was calibrated, and, folded away, what the recording does not show."""
    head = ("meaning", "value", "name")
    estimated = [_calibration_row(c) for c in result.calibration if c.state == "estimated"]
    text = _table(head, estimated, "Nothing was calibrated.")
    if silent := [(*_calibration_row(c), c.reason) for c in result.calibration if c.state != "estimated"]:
        rest = _table((*head, "why it stays at what was assumed"), silent, "")
        text += f"<details><summary>{len(silent)} more that the recording does not show</summary>{rest}</details>"
    return text


def _calibration_row(value: CalibrationEstimate) -> tuple[str, ...]:
    """Return meaning, value with sigma and unit, and name; ratios in per cent, heights in metres."""
    if value.is_height:
        height, most = np.sqrt(np.maximum([value.value, value.value + 2.0 * value.sigma], 0.0)).tolist()
        return f"height of anchor {value.key.anchor} above or below the tag", f"{height:.2f} m, below {most:.2f} m", value.name
    scale, digits, unit = (100.0, 2, "%") if value.unit == "1" else (1.0, 4, value.unit)
    return value.meaning, f"{_with_sigma(scale * value.value, scale * value.sigma, digits, True)} {unit}", value.name


def _closure_table(result: MapResult) -> str:
    kept, rejected = shown_closures(result)
    count = sum(c.accepted for c in result.closures)
    outcomes = Counter(OUTCOMES[c.outcome] for c in result.closures if not c.accepted)
    text = f"<p>{count} of {len(result.closures)} candidates accepted.</p>" if result.closures else ""
    if outcomes:
        text += _table(("rejected because", "candidates"), [(why, str(n)) for why, n in outcomes.most_common()], "")
    state = {True: "accepted", False: "rejected"}
    rows = [
        (f"{c.i}\u2013{c.j}", state[bool(c.accepted)], f"{c.fitness:.3f}", f"{100 * c.overlap:.0f} %", c.reason)
        for c in [*kept, *rejected]
    ]
    listing = _table(("keyframes", "outcome", "fitness, m", "overlap", "why"), rows, "No loop closure was looked for or found.")
    return text + (f"<details><summary>All of them</summary>{listing}</details>" if rows else listing)


def _stage_table(result: MapResult) -> str:
    head = ("stage", "\u03c7\u00b2 / degrees of freedom", "figures")
    rows = []
    for stage in result.stages:
        chi2, dof = stage.figures.get("chi2"), stage.figures.get("dof")
        ratio = f"{chi2:.0f} / {dof} = {number(chi2 / dof, 2)}" if chi2 is not None and dof else ""
        values = {name: value for name, value in stage.figures.items() if isinstance(value, int | float) and value}
        shown = ", ".join(text.format(values[name]) for name, text in _FIGURES.items() if name in values)
        if ratio or shown:
            rows.append((stage.name, ratio, shown))
    return f"<details><summary>{len(rows)} stages</summary>{_table(head, rows, '')}<p class=hint>{_ABOUT_STAGES}</p></details>"


_FIGURES = {
    "keyframes": "{} keyframes",
    "travelled": "{:.1f} m",
    "odometry": "{} steps of odometry",
    "ranges": "{} ranges",
    "placed": "{} anchors placed",
    "points": "{} points",
    "pairs": "{} pairs of scans",
    "used": "{} of them used",
    "submaps": "{} sub-maps",
    "candidates": "{} candidates",
    "accepted": "{} accepted",
    "walls": "{} walls",
    "columns": "{} columns",
    "rays": "{} rays",
    "sigma": "scatter {:.4f} m",
    "range_sigma": "scatter of ranges {:.3f} m",
    "shift": "poses moved by {:.4f} m",
    "visits": "{} visits of places seen before",
    "scans": "{} scans drawn",
    "free_space_violation": "{:.2%} of the rays end in free space",
    "iterations": "{} iterations",
}
"""Figures of stages that are shown, and how."""

_ABOUT_STAGES = (
    "Each line is what its stage did; later ones add keyframes and weigh anew. \u03c7\u00b2 below the degrees of freedom is"
    " intended: ranges, and scans that are matched several times, have errors in common and are given less weight for it."
    " report.json has all figures, and the time of each stage."
)


def _residuals(result: MapResult) -> str:
    table = {name: np.asarray(values) for name, values in result.range_table.items()}
    several = len(np.unique(result.recording)) > 1
    # The clocks of several recordings have nothing in common: their ranges are drawn one after another.
    time = np.arange(len(table["stamp"]), dtype=np.float64) if several else table["stamp"] - table["stamp"].min()
    span = max(float(time.max()), 1e-9)
    ends = ("first recording", "last recording") if several else ("0 s", duration(span))
    parts = [
        "<p class=hint>Measured minus expected range over time: above zero the range is too long;"
        " <span class=nlos-text>marked</span>: does not agree with the map, as where something blocks the line of sight (NLOS)."
        " What lies beyond the scale is drawn at its edge.</p>"
    ]
    for index, anchor in enumerate(result.anchors):
        rows = np.flatnonzero(table["anchor"] == index)
        rows = rows[np.isfinite(table["residual"][rows])]
        if len(rows):
            parts.append(_residual_plot(anchor.id, table, rows[thin(len(rows), MOST_RESIDUALS)], time / span, ends))
    return "".join(parts)


def _dots(x: Floats, y: Floats) -> str:
    return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _residual_plot(anchor_id: str, table: dict[str, Floats], which: Ints, time: Floats, ends: tuple[str, str]) -> str:
    residual, good = table["residual"][which], table["agrees"][which] > 0
    inner = float(np.quantile(np.abs(residual[good]), 0.99)) if good.any() else 0.0
    limit = max(2.0 * inner, 0.1)
    x = 1000.0 * time[which]
    y = 60.0 - 55.0 * np.clip(residual / limit, -1.0, 1.0)
    dots = "".join(
        f'<path class="{name}" d="{_dots(x[sel], y[sel])}"/>' for name, sel in (("los", good), ("nlos", ~good)) if sel.any()
    )
    scale = "".join(f"<span>{number(value, 2, True)} m</span>" for value in (limit, -limit))
    marked = f"<span class=hint>{100 * float(np.mean(~good)):.0f} % marked</span>"
    return (
        f"<figure><figcaption>{escape(anchor_id)} {marked}</figcaption><div class=plot><div class=scale>{scale}</div>"
        '<svg class="residuals" viewBox="0 0 1000 120" preserveAspectRatio="none" role="img"'
        f' aria-label="residuals of {escape(anchor_id)}"><path class="axis" d="M0 60H1000"/>{dots}</svg></div>'
        f"<div class=ends>{''.join(f'<span>{end}</span>' for end in ends)}</div></figure>"
    )
