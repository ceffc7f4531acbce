"""A map's result as one HTML page: no network, no plotting library, the same bytes for the same result.

Everything that comes from a log (names of files and anchors, reasons) is escaped, the page's policy forbids anything
from elsewhere, and its script reads only the page itself.
"""

import base64
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats, Ints
from ..findings import DOUBT, Finding, folded
from ..map_result import OUTCOMES, AnchorEstimate, CalibrationEstimate, MapResult
from .canvas import PATHS
from .drawn_map import MOST_SHOWN, drawn_map, shown_closures, thin
from .page import SCALED, ZOOM, document, key
from .printable import DECIMALS, duration, escape, percent, readable, sigma_text, sigmas, signed
from .svg_map import map_svg

_USUAL, _LEAST_LIMIT = 0.99, 0.1
"""Share of the residuals that agree which lies within half the scale of their plot, and the least scale, m."""
_PLOT = 1000, 60
"""Width and half height of a plot of residuals."""
_LONG = 20
"""Letters of a sentence; a cell of more may be wrapped."""

_STYLE = """
main{max-width:70rem;margin:0 auto;padding:1rem}
h1{font-size:1.5rem;overflow-wrap:anywhere}h2{font-size:1.15rem;margin:1.6rem 0 .5rem}
.scroll{overflow-x:auto;background:linear-gradient(90deg,var(--card) 40%,transparent) 0 0/2.5rem 100% local no-repeat,
linear-gradient(270deg,var(--card) 40%,transparent) 100% 0/2.5rem 100% local no-repeat,
linear-gradient(90deg,var(--shade),transparent) 0 0/.9rem 100% no-repeat,
linear-gradient(270deg,var(--shade),transparent) 100% 0/.9rem 100% no-repeat}
th,td{padding:.2rem .6rem;border-bottom:1px solid var(--line)}
td{white-space:nowrap}td.words{white-space:normal;min-width:15rem}
summary{cursor:pointer;padding:.4rem 0}
.facts td{white-space:normal;overflow-wrap:anywhere}.facts th{font-weight:500;color:var(--faint);white-space:nowrap}
.box{padding:.6rem .9rem;border-radius:.4rem;margin:.6rem 0}.box ul{margin:.3rem 0;padding-left:1.2rem}
.hint{color:var(--faint);font-size:.85rem}.lead{margin:.4rem 0;color:var(--faint)}
pre{background:var(--warn);padding:.6rem;border-radius:.4rem;white-space:pre-wrap;overflow-wrap:anywhere}
.controls{display:flex;flex-wrap:wrap;gap:.3rem .9rem;align-items:center;margin:.4rem 0}
.controls label,.buttons{white-space:nowrap}button{font:inherit;min-width:2.2rem;min-height:2.2rem}
.map{touch-action:none;cursor:grab}#place{font-variant-numeric:tabular-nums;float:right;color:var(--ink)}
figure{margin:.6rem 0}figcaption{font-weight:600}
.plot{display:flex;gap:.4rem}.ends{display:flex;justify-content:space-between;margin-left:4.9rem}
.scale{display:flex;flex-direction:column;justify-content:space-between;width:4.5rem;text-align:right}
.scale,.ends{font-size:.75rem;color:var(--faint);font-variant-numeric:tabular-nums}
.residuals{display:block;flex:1;min-width:0;height:7rem;border:1px solid var(--line);border-radius:.3rem}
.residuals path{fill:none;stroke:var(--path0);stroke-width:3;stroke-linecap:round;vector-effect:non-scaling-stroke}
.residuals .axis{stroke:var(--line);stroke-width:1}.residuals .nlos{stroke:var(--nlos)}.nlos-text{color:var(--nlos)}
@media (max-width:40rem){main{padding:.6rem}body{font-size:15px}h1{margin:.3rem 0}h2{margin:1rem 0 .3rem}
.cards thead{display:none}.cards,.cards tbody,.cards tr,.cards td{display:block}
.cards tr{padding:.4rem 0;border-bottom:1px solid var(--line)}
.cards td,.cards td.words{display:flex;gap:.6rem;border:0;padding:.1rem 0;white-space:normal;min-width:0;overflow-wrap:anywhere}
.cards td::before{content:attr(data-name);color:var(--faint);flex:0 0 8rem}.cards td:empty{display:none}
.cards td:first-child{font-weight:600}.cards td:first-child::before{content:none}}
"""


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
    """Return the page; `grid_png` is the picture of the bare grid, one pixel a cell, highest y first."""
    again = f"<p>{escape(_WHERE.format(heading.title))}</p><pre>{escape(heading.command)}</pre>"
    table = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in heading.facts)
    sections = (
        _banner(result, heading.lead),
        _section("Map", _map(result, grid_png)),
        _section("Anchors", _anchor_table(result.anchors)),
        _section("Range residuals", _residuals(result)) if len(result.range_table.get("stamp", ())) else "",
        _section("Calibration", _calibration_table(result)),
        _section("Loop closures", _closure_table(result)),
        _section("Again", f"<div class=scroll><table class=facts>{table}</table></div>{again}"),
    )
    title = escape(heading.title)
    return document(f"{title} \u2013 uwblite", f"<main><h1>{title}</h1>{''.join(sections)}</main>", _STYLE, SCALED + ZOOM)


_WHERE = "The command that makes this map again, byte for byte, in the folder of {}:"


def _section(title: str, content: str) -> str:
    return f'<section id="{title.lower().replace(" ", "-")}"><h2>{title}</h2>{content}</section>'


def _map(result: MapResult, grid_png: bytes | None) -> str:
    """Return the map with its switches and buttons."""
    drawn = drawn_map(result)
    image = f"data:image/png;base64,{base64.b64encode(grid_png).decode()}" if grid_png is not None else ""
    layers = (
        ("grid", key("faint", "map")),
        ("trajectory", key("path0", "trajectory")),
        ("anchors", key("anchor", "anchors, 2\u03c3", "anchors")),
        ("kept", key("accepted", "closures accepted")),
        ("rejected", key("rejected", "closures rejected")),
    )
    boxes = "".join(
        f'<label><input type=checkbox{"" if name == "rejected" else " checked"} data-layer="{name}"> {text}</label>'
        for name, text in layers
    )
    names = (("zoom-in", "+", "zoom in"), ("zoom-out", "\u2212", "zoom out"), ("zoom-all", "all", "all of the map"))
    buttons = " ".join(f'<button id="{name}" aria-label="{label}">{text}</button>' for name, text, label in names)
    several = range(len(drawn.paths)) if len(drawn.paths) > 1 else ()
    keys = [key("start", "start", "disc"), key("path0", "end", "ring")]
    keys += [key(f"path{k % len(PATHS)}", f"recording {k + 1}") for k in several]
    keys += [key("unsure", "an anchor that is not certain", "anchors")] if any(a.kind == "doubt" for a in drawn.anchors) else []
    keys += [key("doubted", "not to be trusted")] if drawn.doubted else []
    return (
        f"{map_svg(drawn, image)}<div class=controls>{boxes}<span class=buttons>{buttons}</span></div><p class=hint>"
        f'<output id="place"></output>{" ".join(keys)}; wheel or pinch zooms, dragging moves; point at things for details.</p>'
    )


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
    words = " class=words" if len(text) > _LONG and " " in text else ""
    named = f' data-name="{escape(name)}"' if name else ""
    return f"<td{words}{named}>{escape(text)}</td>"


def _number(value: float, digits: int = DECIMALS, sign: bool = False) -> str:
    """Return a number with a true minus sign; a dash where it is not finite."""
    return signed(value, digits, plus=sign).replace("-", "\u2212") if np.isfinite(value) else "\u2013"


def _with_sigma(value: float, sigma: float, digits: int = DECIMALS, sign: bool = False) -> str:
    return f"{_number(value, digits, sign)} \u00b1{sigma_text(sigma, digits)}" if np.isfinite(value) else _number(value)


def _anchor_table(anchors: tuple[AnchorEstimate, ...]) -> str:
    head = ("anchor", "status", "x, m", "y, m", "bias, m", "ranges", "disagree", "residual rms, m")
    rows = [
        (
            a.id,
            f"{a.status}: {a.reason}" if a.reason else a.status,
            *map(_with_sigma, a.position.tolist(), sigmas(a)),
            _with_sigma(a.bias, a.bias_sigma, sign=True),
            str(a.ranges),
            percent(1.0 - a.used_share) if np.isfinite(a.used_share) else "\u2013",
            _number(a.residual_rms),
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
    mean, sigma, unit, digits = readable(value.value, value.sigma, value.unit)
    return value.meaning, f"{_with_sigma(mean, sigma, digits, True)} {unit}", value.name


def _closure_table(result: MapResult) -> str:
    count = sum(c.accepted for c in result.closures)
    outcomes = Counter(OUTCOMES[c.outcome] for c in result.closures if not c.accepted)
    text = f"<p>{count} of {len(result.closures)} candidates accepted.</p>" if result.closures else ""
    if outcomes:
        text += _table(("rejected because", "candidates"), [(why, str(n)) for why, n in outcomes.most_common()], "")
    shown = [result.closures[k] for k in shown_closures(c.accepted for c in result.closures)]
    rows = [
        (
            f"{c.i}\u2013{c.j}",
            "accepted" if c.accepted else "rejected",
            f"{c.fitness:.3f}",
            percent(c.overlap),
            c.reason,
        )
        for c in shown
    ]
    listing = _table(("keyframes", "outcome", "fitness, m", "overlap", "why"), rows, "No loop closure was looked for or found.")
    return text + (f"<details><summary>All of them</summary>{listing}</details>" if rows else listing)


def _residuals(result: MapResult) -> str:
    table = {name: np.asarray(values) for name, values in result.range_table.items()}
    several = len(np.unique(result.recording)) > 1
    # The clocks of several recordings have nothing in common: their ranges are drawn one after another.
    time = np.arange(len(table["stamp"]), dtype=np.float64) if several else table["stamp"] - table["stamp"].min()
    ends = ("first recording", "last recording") if several else ("0 s", duration(float(time.max())))
    parts = [
        "<p class=hint>Measured minus expected range over time: above zero the range is too long;"
        " <span class=nlos-text>marked</span>: does not agree with the map, as where something blocks the line of sight (NLOS)."
        " What lies beyond the scale is drawn at its edge.</p>"
    ]
    table["x"] = _PLOT[0] * time / max(float(time.max()), np.finfo(float).tiny)
    for index, anchor in enumerate(result.anchors):
        rows = np.flatnonzero((table["anchor"] == index) & np.isfinite(table["residual"]))
        if len(rows):
            parts.append(_residual_plot(escape(anchor.id), table, rows[thin(len(rows), MOST_SHOWN)], ends))
    return "".join(parts)


def _residual_plot(name: str, table: dict[str, Floats], which: Ints, ends: tuple[str, str]) -> str:
    """Return the plot of some rows of the ranges, at x along it."""
    residual, good = table["residual"][which], table["agrees"][which] > 0
    limit = max(2.0 * float(np.quantile(np.abs(residual[good]), _USUAL)), _LEAST_LIMIT) if good.any() else _LEAST_LIMIT
    width, middle = _PLOT
    places = np.stack([table["x"][which], middle * (1.0 - np.clip(residual / limit, -1.0, 1.0))], axis=1)
    dots = "".join(
        f'<path class="{kind}" d="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in places[chosen].tolist())}"/>'
        for kind, chosen in (("los", good), ("nlos", ~good))
        if chosen.any()
    )
    scale = "".join(f"<span>{_number(value, 2, True)} m</span>" for value in (limit, -limit))
    return (
        f"<figure><figcaption>{name} <span class=hint>{percent(float(np.mean(~good)))} marked</span></figcaption>"
        f'<div class=plot><div class=scale>{scale}</div><svg class="residuals" viewBox="0 -5 {width} {2 * middle + 10}"'
        f' preserveAspectRatio="none" role="img" aria-label="residuals of {name}"><path class="axis" d="M0 {middle}H{width}"/>'
        f"{dots}</svg></div><div class=ends>{''.join(f'<span>{end}</span>' for end in ends)}</div></figure>"
    )
